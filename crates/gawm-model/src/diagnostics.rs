//! Geometry of latent trajectories: straightening, transition spectrum, principal components. All in f64, on the host.
//!
//! A trajectory is `z` [T, D], row-major, from an evaluation pass. Conventions that the paper leaves open are stated at
//! each function.

/// How straight a trajectory is.
#[derive(Debug, Clone, PartialEq)]
pub struct Straightness {
    /// Cosine between consecutive displacements, T - 2 values; `None` where a displacement is zero.
    pub local: Vec<Option<f64>>,
    /// Mean of the values that exist; `None` if there is none.
    pub score: Option<f64>,
}

/// Singular values of the (uncentred) displacements of a trajectory.
#[derive(Debug, Clone, PartialEq)]
pub struct Spectrum {
    /// Singular values, largest first; min(T - 1, D) of them.
    pub singular_values: Vec<f64>,
    /// Share of the squared sum up to each.
    pub cumulative_energy: Vec<f64>,
    /// Smallest number of directions that hold 95 % of the energy; 0 if nothing moves.
    pub r95: usize,
    /// Participation ratio of the energies, (sum e)^2 / sum e^2: the effective number of directions.
    pub participation_ratio: f64,
}

/// Computes the cosines between consecutive displacements of `z` [T, `d`].
///
/// # Panics
///
/// If the length of `z` is not a multiple of `d`.
pub fn straightness(z: &[f64], d: usize) -> Straightness {
    let displacements = displacements(z, d);
    let cosine = |(a, b): (&[f64], &[f64])| {
        let lengths = (dot(a, a) * dot(b, b)).sqrt();
        (lengths > 0.0).then(|| dot(a, b) / lengths)
    };
    let rows = || displacements.chunks_exact(d);
    let local: Vec<Option<f64>> = rows().zip(rows().skip(1)).map(cosine).collect();
    let found: Vec<f64> = local.iter().flatten().copied().collect();
    let score = (!found.is_empty()).then(|| found.iter().sum::<f64>() / found.len() as f64);
    Straightness { local, score }
}

/// Computes the spectrum of the displacements of `z` [T, `d`].
///
/// # Panics
///
/// If the length of `z` is not a multiple of `d`.
pub fn spectrum(z: &[f64], d: usize) -> Spectrum {
    let displacements = displacements(z, d);
    let (rows, columns) = (displacements.len() / d, d);
    let orthogonal = if rows <= columns {
        orthogonalize(displacements, columns)
    } else {
        orthogonalize(transpose(&displacements, columns), rows)
    };
    let mut singular_values: Vec<f64> =
        orthogonal.chunks_exact(rows.max(columns)).map(|row| dot(row, row).sqrt()).collect();
    singular_values.sort_by(|a, b| b.total_cmp(a));
    let energies: Vec<f64> = singular_values.iter().map(|value| value * value).collect();
    let total: f64 = energies.iter().sum();
    let mut sum = 0.0;
    let cumulate = |energy: &f64| {
        sum += energy;
        if total > 0.0 { sum / total } else { 0.0 }
    };
    let cumulative_energy: Vec<f64> = energies.iter().map(cumulate).collect();
    let r95 = cumulative_energy.iter().position(|&share| share >= 0.95).map_or(0, |index| index + 1);
    let squares: f64 = energies.iter().map(|energy| energy * energy).sum();
    let participation_ratio = if squares > 0.0 { total * total / squares } else { 0.0 };
    Spectrum { singular_values, cumulative_energy, r95, participation_ratio }
}

/// Projects `z` [T, `d`] on its `count` first principal components (centred): [T, count], row-major.
///
/// The sign of a component is free; it is chosen so that the coordinate of largest magnitude is positive.
///
/// # Panics
///
/// If the length of `z` is not a multiple of `d`.
pub fn principal_components(z: &[f64], d: usize, count: usize) -> Vec<f64> {
    assert!(z.len().is_multiple_of(d), "expected rows of {d} values, got {} values", z.len());
    let rows = z.len() / d;
    let mut centred = z.to_vec();
    for column in 0..d {
        let mean = (0..rows).map(|row| z[row * d + column]).sum::<f64>() / rows as f64;
        (0..rows).for_each(|row| centred[row * d + column] -= mean);
    }
    // After one-sided rotations, the columns are the coordinates along the components, up to their order.
    let mut components: Vec<Vec<f64>> = if rows <= d {
        let directions = orthogonalize(centred.clone(), d);
        let project = |direction: &[f64]| {
            let length = dot(direction, direction).sqrt();
            let along = |row: &[f64]| if length > 0.0 { dot(row, direction) / length } else { 0.0 };
            centred.chunks_exact(d).map(along).collect()
        };
        directions.chunks_exact(d).map(project).collect()
    } else {
        orthogonalize(transpose(&centred, d), rows).chunks_exact(rows).map(<[f64]>::to_vec).collect()
    };
    components.sort_by(|a, b| dot(b, b).total_cmp(&dot(a, a)));
    components.resize(count, vec![0.0; rows]);
    for component in &mut components {
        let largest = component.iter().copied().fold(0.0, |a: f64, b| if b.abs() > a.abs() { b } else { a });
        if largest < 0.0 {
            component.iter_mut().for_each(|value| *value = -*value);
        }
    }
    (0..rows).flat_map(|row| components.iter().map(move |component| component[row])).collect()
}

fn displacements(z: &[f64], d: usize) -> Vec<f64> {
    assert!(z.len().is_multiple_of(d), "expected rows of {d} values, got {} values", z.len());
    z.iter().zip(z.iter().skip(d)).map(|(from, to)| to - from).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn transpose(matrix: &[f64], columns: usize) -> Vec<f64> {
    (0..columns).flat_map(|column| matrix.iter().skip(column).step_by(columns).copied()).collect()
}

/// Rotates pairs of rows until all are orthogonal (one-sided Jacobi); their lengths are then the singular values.
fn orthogonalize(mut matrix: Vec<f64>, width: usize) -> Vec<f64> {
    /// Cosine below which two rows count as orthogonal; near the resolution of f64.
    const ORTHOGONAL: f64 = 1e-15;
    /// Sweeps converge quadratically, so that this many are never used.
    const SWEEPS: usize = 60;
    let rows = matrix.len() / width;
    for _ in 0..SWEEPS {
        let mut rotated = false;
        for first in 0..rows {
            for second in first + 1..rows {
                let (head, tail) = matrix.split_at_mut(second * width);
                let a = &mut head[first * width..(first + 1) * width];
                rotated |= rotate(a, &mut tail[..width], ORTHOGONAL);
            }
        }
        if !rotated {
            break;
        }
    }
    matrix
}

/// Makes two rows orthogonal; returns whether they were not.
fn rotate(a: &mut [f64], b: &mut [f64], tolerance: f64) -> bool {
    let (alpha, beta, gamma) = (dot(a, a), dot(b, b), dot(a, b));
    if gamma.abs() <= tolerance * (alpha * beta).sqrt() {
        return false;
    }
    let zeta = (beta - alpha) / (2.0 * gamma);
    let tangent = zeta.signum() / (zeta.abs() + zeta.hypot(1.0));
    let cosine = 1.0 / tangent.hypot(1.0);
    let sine = cosine * tangent;
    for (a, b) in a.iter_mut().zip(b) {
        (*a, *b) = (cosine * *a - sine * *b, sine * *a + cosine * *b);
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Eleven points on a half unit circle.
    fn half_circle() -> Vec<f64> {
        (0..11)
            .flat_map(|i| {
                [
                    (f64::from(i) * 0.1 * std::f64::consts::PI).cos(),
                    (f64::from(i) * 0.1 * std::f64::consts::PI).sin(),
                ]
            })
            .collect()
    }

    #[test]
    fn half_circle_has_the_published_straightness_and_spectrum() {
        let z = half_circle();
        assert!((straightness(&z, 2).score.unwrap() - 0.951_056_60).abs() < 1e-7);
        let spectrum = spectrum(&z, 2);
        assert!((spectrum.singular_values[0] - 0.699_595_9).abs() < 1e-6, "{spectrum:?}");
        assert!((spectrum.singular_values[1] - 0.699_595_3).abs() < 1e-6, "{spectrum:?}");
        assert!((spectrum.cumulative_energy[0] - 0.5).abs() < 1e-6 && spectrum.r95 == 2);
        assert!((spectrum.participation_ratio - 2.0).abs() < 1e-5);
    }

    #[test]
    fn wide_and_tall_matrices_give_the_same_values() {
        // The same rank-2 trajectory in the plane and embedded in 40 dims by orthogonal directions.
        let plane = half_circle();
        let embedded: Vec<f64> = plane
            .chunks_exact(2)
            .flat_map(|p| {
                (0..40).map(|i| if i % 2 == 0 { p[0] } else { p[1] } / 20f64.sqrt()).collect::<Vec<_>>()
            })
            .collect();
        let (a, b) = (spectrum(&plane, 2), spectrum(&embedded, 40));
        for (a, b) in a.singular_values.iter().zip(&b.singular_values) {
            assert!((a - b).abs() < 1e-12, "{a} {b}");
        }
        assert!(b.singular_values[2..].iter().all(|value| *value < 1e-7));
        let (a, b) = (principal_components(&plane, 2, 2), principal_components(&embedded, 40, 2));
        assert!(a.iter().zip(&b).all(|(a, b)| (a - b).abs() < 1e-9), "{a:?} {b:?}");
    }

    #[test]
    fn standing_still_is_counted_and_not_divided_by() {
        let still = straightness(&[1.0, 1.0, 1.0, 2.0, 3.0], 1);
        assert_eq!(still.local, [None, None, Some(1.0)]);
        assert_eq!(spectrum(&[1.0; 6], 2).r95, 0);
    }
}
