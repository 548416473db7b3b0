//! Terms against collapse: SIGReg (arXiv:2511.08544) and the variance and covariance terms of VICReg / PLDM.

use candle_core::{D, Device, Tensor};

use crate::Result;
use crate::pass::Pass;

/// Knots of the integral in [`sigreg`], evenly spaced on [0, 3].
pub const KNOTS: usize = 17;

/// Returns the knots t_k and the weights of the integral, trapezoid weight (doubled for symmetry) x exp(-t^2 / 2).
pub fn sigreg_weights() -> ([f32; KNOTS], [f32; KNOTS]) {
    let step = 3.0 / (KNOTS - 1) as f64;
    let knots: [f32; KNOTS] = std::array::from_fn(|k| (k as f64 * step) as f32);
    let weights = std::array::from_fn(|k| {
        let trapezoid = if k == 0 || k == KNOTS - 1 { step } else { 2.0 * step };
        (trapezoid * (-f64::from(knots[k]).powi(2) / 2.0).exp()) as f32
    });
    (knots, weights)
}

/// Draws `count` directions of unit length for the step of `pass`: shape [D, count].
pub fn sigreg_projections(d: usize, count: usize, pass: &Pass, device: &Device) -> Result<Tensor> {
    let normals = pass.stream("sigreg").normals(d * count);
    let directions = Tensor::from_vec(normals, (d, count), device)?;
    directions.broadcast_div(&directions.sqr()?.sum_keepdim(0)?.sqrt()?)
}

/// SIGReg: how far projections of the latents are from a standard normal (Epps-Pulley statistic).
///
/// `z` has shape [T, B, D] and each frame position is judged over the batch; `directions` [D, R] have unit columns.
///
/// ```text
/// p = z R;  err_k = (mean_b cos(t_k p) - exp(-t_k^2 / 2))^2 + (mean_b sin(t_k p))^2
/// sigreg = mean over T and R of  B x sum_k w_k err_k
/// ```
pub fn sigreg(z: &Tensor, directions: &Tensor) -> Result<Tensor> {
    let (t, b, d) = z.dims3()?;
    let n_directions = directions.dim(1)?;
    let (knots, weights) = sigreg_weights();
    let target: Vec<f32> = knots.iter().map(|t| (-t * t / 2.0).exp()).collect();
    let on_device = |values: &[f32]| Tensor::from_slice(values, KNOTS, z.device());

    let p = z.reshape((t * b, d))?.matmul(directions)?; // [T*B, R]
    let p = p.reshape((t, b, n_directions, 1))?.broadcast_mul(&on_device(&knots)?)?; // [T, B, R, KNOTS]
    let real = p.cos()?.mean(1)?.broadcast_sub(&on_device(&target)?)?.sqr()?; // [T, R, KNOTS]
    let imaginary = p.sin()?.mean(1)?.sqr()?;
    let statistic = (real + imaginary)?.broadcast_mul(&on_device(&weights)?)?.sum(D::Minus1)?; // [T, R]
    statistic.mean_all()? * b as f64
}

/// VICReg's variance term: mean over positions and dims of `relu(1 - sqrt(var + 1e-4))`.
///
/// `z` has shape [N, M, D]; the (unbiased) variance is over N. N = batch is PLDM's `std`, N = time its `std_t`.
pub fn standard_deviation(z: &Tensor) -> Result<Tensor> {
    let n = z.dim(0)?;
    let variance = (z.broadcast_sub(&z.mean_keepdim(0)?)?.sqr()?.sum(0)? / (n as f64 - 1.0))?; // [M, D]
    let deviation = (variance + 1e-4)?.sqrt()?;
    (1.0 - deviation)?.relu()?.mean_all()
}

/// VICReg's covariance term: mean over positions of the squared off-diagonal entries of `z^T z / (N - 1)`, averaged.
///
/// `z` has shape [N, M, D], already centred over the batch; N = batch is PLDM's `cov`, N = time its `cov_t` (which PLDM
/// does not centre over time, so neither do we).
pub fn covariance(z: &Tensor) -> Result<Tensor> {
    let (n, _, d) = z.dims3()?;
    let z = z.transpose(0, 1)?.contiguous()?; // [M, N, D]
    let covariance = (z.t()?.contiguous()?.matmul(&z)? / (n as f64 - 1.0))?; // [M, D, D]
    let all = covariance.sqr()?.sum((1, 2))?; // [M]
    let diagonal = (z.sqr()?.sum(1)? / (n as f64 - 1.0))?.sqr()?.sum(1)?; // [M]
    ((all - diagonal)? / (d * d - d) as f64)?.mean_all()
}
