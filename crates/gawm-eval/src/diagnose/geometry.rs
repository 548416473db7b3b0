//! Straightening and the spectrum of transitions, per trajectory and over all.

use gawm_model::diagnostics::{Straightness, straightness};
use nalgebra::DMatrix;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Trajectory;
use crate::statistics::mean_std;

/// Geometry of one trajectory.
#[derive(Debug, Clone, PartialEq)]
pub struct TrajectoryGeometry {
    /// Cosines between consecutive displacements, and their mean.
    pub straightness: Straightness,
    /// Share of the squared singular values of the displacements, largest first.
    pub energies: Vec<f64>,
    /// Smallest number of directions that hold 95 % of the energy; 0 if nothing moves.
    pub r95: usize,
}

/// Mean and standard deviation (ddof 1) over trajectories.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Sample standard deviation.
    pub std: f64,
    /// Trajectories that have a value.
    pub n: usize,
}

/// Geometry over all trajectories.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct GeometryReport {
    /// Rows from one latent to the next.
    pub stride: usize,
    /// Mean local straightening per trajectory.
    pub straightening: Option<Spread>,
    /// Pairs of displacements of which one is zero: not counted above.
    pub skipped_pairs: usize,
    /// Directions for 95 % of the energy of the transitions.
    pub r95: Option<Spread>,
    /// Mean over trajectories of the cumulative energy of the first k directions, from k = 1.
    pub mean_cumulative_energy: Vec<f64>,
    /// Mean length of a displacement.
    pub mean_displacement: Option<f64>,
}

/// Computes the geometry of all trajectories, every `stride`-th row.
pub fn geometry(trajectories: &[Trajectory], stride: usize) -> (GeometryReport, Vec<TrajectoryGeometry>) {
    let each: Vec<TrajectoryGeometry> = trajectories
        .par_iter()
        .map(|trajectory| {
            let z = trajectory.strided(stride);
            let straightness = straightness(&z, trajectory.latent_width);
            let (energies, r95) = transition_spectrum(&z, trajectory.latent_width);
            TrajectoryGeometry { straightness, energies, r95 }
        })
        .collect();
    let spread =
        |values: Vec<f64>| mean_std(&values).map(|(mean, std)| Spread { mean, std, n: values.len() });
    let moving: Vec<&TrajectoryGeometry> = each.iter().filter(|one| one.r95 > 0).collect();
    let directions = moving.iter().map(|one| one.energies.len()).max().unwrap_or(0);
    let mut mean_cumulative_energy = vec![0.0; directions];
    for one in &moving {
        let mut sum = 0.0;
        for (k, mean) in mean_cumulative_energy.iter_mut().enumerate() {
            sum += one.energies.get(k).copied().unwrap_or(0.0);
            *mean += sum.min(1.0) / moving.len() as f64;
        }
    }
    let displacements: Vec<f64> = trajectories
        .iter()
        .flat_map(|trajectory| {
            let z = trajectory.strided(stride);
            let d = trajectory.latent_width;
            let length = move |(a, b): (&[f64], &[f64])| {
                a.iter().zip(b).map(|(a, b)| (b - a) * (b - a)).sum::<f64>().sqrt()
            };
            z.chunks_exact(d).zip(z.chunks_exact(d).skip(1)).map(length).collect::<Vec<f64>>()
        })
        .collect();
    let report = GeometryReport {
        stride,
        straightening: spread(each.iter().filter_map(|one| one.straightness.score).collect()),
        skipped_pairs: each
            .iter()
            .flat_map(|one| &one.straightness.local)
            .filter(|local| local.is_none())
            .count(),
        r95: spread(moving.iter().map(|one| one.r95 as f64).collect()),
        mean_cumulative_energy,
        mean_displacement: mean_std(&displacements).map(|(mean, _)| mean),
    };
    (report, each)
}

/// Returns the energy shares of the uncentred displacements of `z` [T, `d`], largest first, and r95.
///
/// As `gawm_model::diagnostics::spectrum`, but from the eigenvalues of the smaller Gram matrix: the energies are squares,
/// so nothing is lost, and a trajectory of 200 latents takes milliseconds instead of a tenth of a second.
pub fn transition_spectrum(z: &[f64], d: usize) -> (Vec<f64>, usize) {
    let displacements: Vec<f64> = z.iter().zip(z.iter().skip(d)).map(|(a, b)| b - a).collect();
    let n = displacements.len() / d;
    if n == 0 {
        return (Vec::new(), 0);
    }
    let rows = DMatrix::from_row_slice(n, d, &displacements);
    let energies = eigenvalues(if n <= d { &rows * rows.transpose() } else { rows.transpose() * &rows });
    let total: f64 = energies.iter().sum();
    if total <= 0.0 {
        return (vec![0.0; energies.len()], 0);
    }
    let shares: Vec<f64> = energies.iter().map(|energy| energy / total).collect();
    let mut sum = 0.0;
    let r95 = shares.iter().position(|share| {
        sum += share;
        sum >= 0.95
    });
    (shares, r95.map_or(0, |index| index + 1))
}

/// Returns the eigenvalues of a symmetric matrix that has no negative ones, largest first.
pub(super) fn eigenvalues(matrix: DMatrix<f64>) -> Vec<f64> {
    let mut values: Vec<f64> = matrix.symmetric_eigenvalues().iter().map(|value| value.max(0.0)).collect();
    values.sort_by(|a, b| b.total_cmp(a));
    values
}

#[cfg(test)]
mod tests {
    use super::*;
    use gawm_model::Stream;
    use gawm_model::diagnostics::spectrum;

    #[test]
    fn the_spectrum_is_that_of_the_singular_values() {
        let mut stream = Stream::new(4, "walk", 0);
        for (rows, d) in [(40, 7), (7, 40), (2, 3)] {
            let z: Vec<f64> = stream.normals(rows * d).into_iter().map(f64::from).collect();
            let (ours, reference) = (transition_spectrum(&z, d), spectrum(&z, d));
            assert_eq!(ours.1, reference.r95);
            let mut sum = 0.0;
            for (share, cumulative) in ours.0.iter().zip(&reference.cumulative_energy) {
                sum += share;
                assert!((sum - cumulative).abs() < 1e-12, "{rows}x{d}: {sum} {cumulative}");
            }
        }
    }

    #[test]
    fn half_a_circle_has_the_published_numbers() {
        let angle = |i: usize| std::f64::consts::PI * i as f64 / 10.0;
        let z: Vec<f64> = (0..11).flat_map(|i| [angle(i).cos(), angle(i).sin()]).collect();
        let (shares, r95) = transition_spectrum(&z, 2);
        assert!((shares[0] - 0.5).abs() < 1e-5 && r95 == 2, "{shares:?}");
        let z32: Vec<f32> = z.iter().map(|value| *value as f32).collect();
        let trajectory = Trajectory {
            id: String::new(),
            n_rows: 11,
            z: z32,
            latent_width: 2,
            states: Vec::new(),
            state_width: 0,
            actions: Vec::new(),
            action_valid: vec![true; 11],
        };
        let (report, _) = geometry(&[trajectory], 1);
        let straightening = report.straightening.unwrap();
        assert!((straightening.mean - 0.951_056_6).abs() < 1e-6 && straightening.n == 1, "{straightening:?}");
        assert!((report.mean_cumulative_energy[1] - 1.0).abs() < 1e-9);
    }

    #[test]
    fn standing_still_has_no_spectrum() {
        assert_eq!(transition_spectrum(&[1.0; 6], 2), (vec![0.0; 2], 0));
        assert_eq!(transition_spectrum(&[1.0, 2.0], 2), (Vec::new(), 0));
    }
}
