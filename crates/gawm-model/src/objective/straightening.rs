//! Temporal straightening (arXiv:2603.12231): consecutive displacements should point the same way.

use candle_core::{D, Tensor};

use crate::Result;

/// Returns minus the mean cosine between consecutive displacements of `z` [B, T, D]; -1 is a straight line.
///
/// # Errors
///
/// - if a clip has fewer than three frames.
pub fn straightening(z: &Tensor) -> Result<Tensor> {
    let (_, t, _) = z.dims3()?;
    if t < 3 {
        candle_core::bail!("straightening: expected at least 3 frames, got {t}");
    }
    let displacement = (z.narrow(1, 1, t - 1)? - z.narrow(1, 0, t - 1)?)?; // [B, T-1, D]
    let (a, b) = (displacement.narrow(1, 0, t - 2)?, displacement.narrow(1, 1, t - 2)?);
    let product = (&a * &b)?.sum(D::Minus1)?; // [B, T-2]
    (product / (length(&a)? * length(&b)?)?)?.mean_all()?.neg()
}

/// Euclidean length over the last axis, at least 1e-8: [.., D] to [..]. The gradient at zero is zero, not infinite.
fn length(x: &Tensor) -> Result<Tensor> {
    x.sqr()?.sum(D::Minus1)?.maximum(1e-16)?.sqrt()
}
