//! The exact GELU, `x Phi(x)` with the normal distribution function, and its derivative `Phi(x) + x phi(x)`.

use crate::simd::{exp, mul_add, normal_cdf, vectorized};

/// 1 / sqrt(2 pi).
const DENSITY_AT_ZERO: f32 = 0.398_942_3;

vectorized! {
    /// Writes the GELU of `x` to `y`.
    ///
    /// # Panics
    ///
    /// If `y` is shorter than `x`.
    pub fn gelu(x: &[f32], y: &mut [f32]) {
        let y = &mut y[..x.len()];
        for (y, x) in y.iter_mut().zip(x) {
            *y = x * normal_cdf::<FMA>(*x);
        }
    }

    /// Turns `x` into its GELU.
    pub fn gelu_in_place(x: &mut [f32]) {
        for x in x.iter_mut() {
            *x *= normal_cdf::<FMA>(*x);
        }
    }

    /// Writes the GELU of `x` to `y` and multiplies `dy`, the gradient of `y`, by its derivative: the gradient of `x`.
    ///
    /// # Panics
    ///
    /// If `y` or `dy` is shorter than `x`.
    pub fn gelu_backward(x: &[f32], y: &mut [f32], dy: &mut [f32]) {
        let (y, dy) = (&mut y[..x.len()], &mut dy[..x.len()]);
        for ((y, dy), x) in y.iter_mut().zip(dy.iter_mut()).zip(x) {
            let cdf = normal_cdf::<FMA>(*x);
            *y = x * cdf;
            *dy *= mul_add::<FMA>(x * DENSITY_AT_ZERO, exp::<FMA>(-0.5 * x * x), cdf);
        }
    }
}
