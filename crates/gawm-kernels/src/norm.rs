//! Layer normalisation of rows, forward and backward.
//!
//! ```text
//! xhat = (x - mean) * rstd,  rstd = 1 / sqrt(var + epsilon),  y = xhat * weight + bias
//! dx = rstd * (g - mean(g) - xhat * mean(g * xhat)),  g = dy * weight
//! ```
//!
//! The backward pass needs `xhat` and `rstd` only, so that these are what a layer keeps.

use crate::simd::{dot, mul_add, sum, vectorized};

vectorized! {
    /// Normalises each row of `x` [rows, width] into `xhat` and writes `1 / sqrt(var + epsilon)` of each row to `rstd`.
    ///
    /// # Panics
    ///
    /// If `xhat` or `rstd` is shorter than `x` has elements or rows.
    pub fn normalize(x: &[f32], width: usize, epsilon: f32, xhat: &mut [f32], rstd: &mut [f32]) {
        let inverse = 1.0 / width as f32;
        let rows = x.len() / width;
        let (xhat, rstd) = (&mut xhat[..rows * width], &mut rstd[..rows]);
        for ((x, y), rstd) in x.chunks_exact(width).zip(xhat.chunks_exact_mut(width)).zip(rstd) {
            let mean = sum(x) * inverse;
            for (y, x) in y.iter_mut().zip(x) {
                *y = x - mean;
            }
            let variance = dot::<FMA>(y, y) * inverse;
            *rstd = 1.0 / (variance + epsilon).sqrt();
            for y in y.iter_mut() {
                *y *= *rstd;
            }
        }
    }

    /// Scales and shifts each row: `y = xhat * weight + bias`.
    ///
    /// # Panics
    ///
    /// If `y` is shorter than `xhat`.
    pub fn scale_shift(xhat: &[f32], weight: &[f32], bias: &[f32], y: &mut [f32]) {
        let width = weight.len();
        let y = &mut y[..xhat.len()];
        for (x, y) in xhat.chunks_exact(width).zip(y.chunks_exact_mut(width)) {
            for (((y, x), w), b) in y.iter_mut().zip(x).zip(weight).zip(bias) {
                *y = mul_add::<FMA>(*x, *w, *b);
            }
        }
    }

    /// Adds the gradients of `weight` and `bias`: columns of `dy * xhat` and of `dy`.
    pub fn scale_shift_backward(dy: &[f32], xhat: &[f32], dweight: &mut [f32], dbias: &mut [f32]) {
        let width = dweight.len();
        for (dy, x) in dy.chunks_exact(width).zip(xhat.chunks_exact(width)) {
            for (((dw, db), dy), x) in dweight.iter_mut().zip(dbias.iter_mut()).zip(dy).zip(x) {
                *dw = mul_add::<FMA>(*dy, *x, *dw);
                *db += dy;
            }
        }
    }

    /// Adds the gradient of `x` to `dx`, given that of `y = xhat * weight + bias`. Overwrites `dy`.
    ///
    /// # Panics
    ///
    /// If `dx`, `xhat` or `rstd` is shorter than `dy` has elements or rows.
    pub fn normalize_backward(dy: &mut [f32], xhat: &[f32], rstd: &[f32], weight: &[f32], dx: &mut [f32]) {
        let width = weight.len();
        let inverse = 1.0 / width as f32;
        let rows = dy.len() / width;
        let (xhat, rstd, dx) = (&xhat[..rows * width], &rstd[..rows], &mut dx[..rows * width]);
        let pairs = dy.chunks_exact_mut(width).zip(xhat.chunks_exact(width));
        for (((g, x), rstd), dx) in pairs.zip(rstd).zip(dx.chunks_exact_mut(width)) {
            for (g, w) in g.iter_mut().zip(weight) {
                *g *= w;
            }
            let mean = sum(g) * inverse;
            let along = dot::<FMA>(g, x) * inverse;
            for ((dx, g), x) in dx.iter_mut().zip(g.iter()).zip(x) {
                *dx = mul_add::<FMA>(*rstd, mul_add::<FMA>(-along, *x, g - mean), *dx);
            }
        }
    }

    /// Adds the columns of `x`, `[rows, width]`, to `sums`, `[width]`.
    pub fn add_columns(x: &[f32], sums: &mut [f32]) {
        for row in x.chunks_exact(sums.len()) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum += x;
            }
        }
    }

    /// Adds the columns of the squares of `x`, `[rows, width]`, to `sums`, `[width]`.
    pub fn add_squares(x: &[f32], sums: &mut [f32]) {
        for row in x.chunks_exact(sums.len()) {
            for (sum, x) in sums.iter_mut().zip(row) {
                *sum = mul_add::<FMA>(*x, *x, *sum);
            }
        }
    }

    /// Subtracts `row` from each row of `x`.
    pub fn subtract_row(row: &[f32], x: &mut [f32]) {
        for x in x.chunks_exact_mut(row.len()) {
            for (x, row) in x.iter_mut().zip(row) {
                *x -= row;
            }
        }
    }

    /// Multiplies each row of `x` by `row`.
    pub fn multiply_row(row: &[f32], x: &mut [f32]) {
        for x in x.chunks_exact_mut(row.len()) {
            for (x, row) in x.iter_mut().zip(row) {
                *x *= row;
            }
        }
    }

    /// Backward of a batch norm: `dy = scale * (dy - mean - xhat * along)`, where `mean` and `along` are the means over the
    /// batch of `dy` and of `dy * xhat`, and `scale` is `rstd * weight`, all per column.
    pub fn batch_backward(dy: &mut [f32], xhat: &[f32], scale: &[f32], mean: &[f32], along: &[f32]) {
        let width = scale.len();
        for (dy, xhat) in dy.chunks_exact_mut(width).zip(xhat.chunks_exact(width)) {
            let columns = scale.iter().zip(mean).zip(along);
            for ((dy, xhat), ((scale, mean), along)) in dy.iter_mut().zip(xhat).zip(columns) {
                *dy = scale * mul_add::<FMA>(-along, *xhat, *dy - mean);
            }
        }
    }

    /// Adds `x` to `y`, element by element.
    pub fn add(x: &[f32], y: &mut [f32]) {
        for (y, x) in y.iter_mut().zip(x) {
            *y += x;
        }
    }
}
