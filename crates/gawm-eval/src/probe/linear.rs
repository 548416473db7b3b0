//! Ridge regression by normal equations.

use nalgebra::{Cholesky, DMatrix, DVector};

/// A linear function of a latent.
#[derive(Debug, Clone)]
pub(super) struct Ridge {
    weights: Vec<f64>,
    offset: f64,
}

impl Ridge {
    /// Fits `y` [N] on `x` [N, d] with penalty `ridge` per sample; rows without a target are left out.
    pub(super) fn fit(x: &[f32], y: &[f64], d: usize, ridge: f64) -> Ridge {
        let known: Vec<usize> = (0..y.len()).filter(|&row| y[row].is_finite()).collect();
        let n = known.len();
        if n == 0 {
            return Ridge { weights: vec![0.0; d], offset: 0.0 };
        }
        let offset = known.iter().map(|&row| y[row]).sum::<f64>() / n as f64;
        let values = known.iter().flat_map(|&row| &x[row * d..(row + 1) * d]).map(|value| f64::from(*value));
        let x = DMatrix::from_row_iterator(n, d, values);
        let mean = x.row_mean();
        let centred = DMatrix::from_fn(n, d, |row, column| x[(row, column)] - mean[column]);
        let target = DVector::from_iterator(n, known.iter().map(|&row| y[row] - offset));
        let mut gram = centred.transpose() * &centred;
        (0..d).for_each(|i| gram[(i, i)] += ridge.max(1e-12) * n as f64);
        let right = centred.transpose() * target;
        let weights = match Cholesky::new(gram) {
            Some(factor) => factor.solve(&right).iter().copied().collect(),
            None => vec![0.0; d], // only for latents that are not finite, which are refused before
        };
        let shift: f64 = mean.iter().zip(&weights).map(|(mean, weight)| mean * weight).sum();
        Ridge { weights, offset: offset - shift }
    }

    /// Reads `x` [N, d].
    pub(super) fn predict(&self, x: &[f32]) -> Vec<f64> {
        let read = |row: &[f32]| {
            self.offset + row.iter().zip(&self.weights).map(|(x, weight)| f64::from(*x) * weight).sum::<f64>()
        };
        x.chunks_exact(self.weights.len()).map(read).collect()
    }
}
