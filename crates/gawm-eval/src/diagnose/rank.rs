//! How many directions the latents fill.

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::Trajectory;
use super::geometry::eigenvalues;

/// Rank measures of all latents together.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RankReport {
    /// Participation ratio of the covariance, (sum of eigenvalues)^2 / sum of squares: 1 to D.
    pub effective_rank: f64,
    /// RankMe (arXiv:2210.02885): exp of the entropy of the singular values (uncentred): 1 to D.
    pub rankme: f64,
    /// Mean standard deviation of a latent's values.
    pub mean_std: f64,
    /// Width of a latent.
    pub latent_width: usize,
}

/// Computes the rank measures of all latents.
pub fn rank(trajectories: &[Trajectory]) -> RankReport {
    let d = trajectories.first().map_or(1, |trajectory| trajectory.latent_width);
    let mut gram = DMatrix::<f64>::zeros(d, d);
    let mut sum = vec![0.0; d];
    let mut n = 0usize;
    for trajectory in trajectories {
        let z = DMatrix::from_row_iterator(
            trajectory.n_rows,
            d,
            trajectory.z.iter().map(|value| f64::from(*value)),
        );
        gram += z.transpose() * &z;
        for row in z.row_iter() {
            sum.iter_mut().zip(row.iter()).for_each(|(sum, value)| *sum += value);
        }
        n += trajectory.n_rows;
    }
    let count = n.max(1) as f64;
    let mean = nalgebra::DVector::from_iterator(d, sum.iter().map(|sum| sum / count));
    let covariance = &gram / count - &mean * mean.transpose();
    let mean_std = covariance.diagonal().iter().map(|v| v.max(0.0).sqrt()).sum::<f64>() / d as f64;
    let spread = eigenvalues(covariance);
    let (total, squares) = (spread.iter().sum::<f64>(), spread.iter().map(|v| v * v).sum::<f64>());
    let effective_rank = if squares > 0.0 { total * total / squares } else { 0.0 };
    let singular: Vec<f64> = eigenvalues(gram).into_iter().map(f64::sqrt).collect();
    let total: f64 = singular.iter().sum();
    let entropy: f64 = singular
        .iter()
        .map(|value| value / total)
        .filter(|share| *share > 0.0)
        .map(|share| -share * share.ln())
        .sum();
    RankReport { effective_rank, rankme: entropy.exp(), mean_std, latent_width: d }
}

#[cfg(test)]
mod tests {
    use super::*;
    use gawm_model::Stream;

    fn trajectory(z: Vec<f32>, d: usize) -> Trajectory {
        let n_rows = z.len() / d;
        Trajectory {
            id: String::new(),
            n_rows,
            z,
            latent_width: d,
            states: Vec::new(),
            state_width: 0,
            actions: Vec::new(),
            action_valid: vec![true; n_rows],
        }
    }

    #[test]
    fn ranks_count_directions() {
        let mut stream = Stream::new(1, "rank", 0);
        let full = trajectory(stream.normals(20_000 * 4), 4);
        let report = rank(&[full]);
        assert!(
            (report.effective_rank - 4.0).abs() < 0.01 && (report.rankme - 4.0).abs() < 0.01,
            "{report:?}"
        );
        let line: Vec<f32> = stream.normals(1000).into_iter().flat_map(|x| [x, 2.0 * x, 0.0, -x]).collect();
        let report = rank(&[trajectory(line, 4)]);
        assert!(
            (report.effective_rank - 1.0).abs() < 1e-9 && (report.rankme - 1.0).abs() < 1e-5,
            "{report:?}"
        );
    }
}
