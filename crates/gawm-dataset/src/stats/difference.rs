//! How far apart the values of two datasets are, dim by dim.

use serde::Serialize;

use super::{ColumnTotals, DatasetStats, DimTotals};

/// Points at which distribution functions are compared.
const POINTS: usize = 257;
/// Bins of the population stability index.
const BINS: usize = 10;

/// Differences of two datasets.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Difference {
    /// Differences of features, counts and rates, as text.
    pub schema: Vec<String>,
    /// Rows of both.
    pub rows: [u64; 2],
    /// Episodes of both.
    pub episodes: [u64; 2],
    /// The dims that both have, the most different first.
    pub dims: Vec<DimDifference>,
}

/// Difference of one dim.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DimDifference {
    /// Column name.
    pub column: String,
    /// Name of the dim.
    pub dim: String,
    /// Kolmogorov-Smirnov distance: the largest difference of the distribution functions, 0..1.
    pub ks: f64,
    /// Population stability index over the deciles of the first; above 0.25 is commonly called a large shift.
    pub psi: f64,
    /// Means of both.
    pub mean: [f64; 2],
    /// Standard deviations of both.
    pub std: [f64; 2],
}

/// Compares the statistics of two datasets.
pub fn difference(a: &DatasetStats, b: &DatasetStats) -> Difference {
    let mut schema = Vec::new();
    let mut dims = Vec::new();
    if a.fps != b.fps {
        schema.push(format!("fps is {} and {}", a.fps, b.fps));
    }
    let find = |stats: &'_ DatasetStats, name: &str| stats.columns.iter().position(|c| c.name == name);
    for column in &a.columns {
        match find(b, &column.name).map(|i| &b.columns[i]) {
            None => schema.push(format!("column {} is only in the first", column.name)),
            Some(other) => compare_columns(column, other, &mut schema, &mut dims),
        }
    }
    for column in b.columns.iter().filter(|c| find(a, &c.name).is_none()) {
        schema.push(format!("column {} is only in the second", column.name));
    }
    dims.sort_by(|x, y| y.ks.total_cmp(&x.ks).then_with(|| (&x.column, &x.dim).cmp(&(&y.column, &y.dim))));
    let episodes = [a.episodes.len() as u64, b.episodes.len() as u64];
    Difference { schema, rows: [a.rows, b.rows], episodes, dims }
}

fn compare_columns(
    a: &ColumnTotals,
    b: &ColumnTotals,
    schema: &mut Vec<String>,
    dims: &mut Vec<DimDifference>,
) {
    if a.dims.len() != b.dims.len() {
        schema.push(format!("column {} has {} dims and {}", a.name, a.dims.len(), b.dims.len()));
        return;
    }
    for (x, y) in a.dims.iter().zip(&b.dims) {
        if x.name != y.name {
            schema.push(format!("a dim of column {} is {:?} and {:?}", a.name, x.name, y.name));
        }
        if x.unit != y.unit {
            schema.push(format!("{}[{}] is in {:?} and {:?}", a.name, x.name, x.unit, y.unit));
        }
        dims.extend(compare_dims(&a.name, x, y));
    }
}

fn compare_dims(column: &str, a: &DimTotals, b: &DimTotals) -> Option<DimDifference> {
    let (x, y) = (quantile_function(a)?, quantile_function(b)?);
    let mut ks: f64 = 0.0;
    for value in x.iter().chain(&y) {
        // Below and at the value: distributions with steps differ on either side of one.
        let (low, high) = (rank(&x, *value), rank(&y, *value));
        ks = ks.max((low.0 - high.0).abs()).max((low.1 - high.1).abs());
    }
    let mut psi = 0.0;
    for bin in 0..BINS {
        let edge = |k: usize| x[k * (POINTS - 1) / BINS];
        let share = |f: &[f64]| {
            let to = if bin + 1 == BINS { 1.0 } else { rank(f, edge(bin + 1)).1 };
            let from = if bin == 0 { 0.0 } else { rank(f, edge(bin)).1 };
            // Half a point of the quantile function stands for an empty bin.
            (to - from).max(0.5 / POINTS as f64)
        };
        let (p, q) = (share(&x), share(&y));
        psi += (p - q) * (p / q).ln();
    }
    let (p, q) = (a.values.summary(), b.values.summary());
    Some(DimDifference {
        column: column.to_owned(),
        dim: a.name.clone(),
        ks,
        psi,
        mean: [p.mean, q.mean],
        std: [p.std, q.std],
    })
}

fn quantile_function(dim: &DimTotals) -> Option<Vec<f64>> {
    let fractions: [f64; POINTS] = std::array::from_fn(|k| k as f64 / (POINTS - 1) as f64);
    dim.values.sketch.quantiles(fractions).into_iter().collect()
}

/// Returns the share of values below `value` and the share up to it, by a quantile function.
fn rank(quantiles: &[f64], value: f64) -> (f64, f64) {
    let n = (quantiles.len() - 1) as f64;
    let below = quantiles.partition_point(|q| *q < value);
    let up_to = quantiles.partition_point(|q| *q <= value);
    if below == up_to && below > 0 && below < quantiles.len() {
        let (a, b) = (quantiles[below - 1], quantiles[below]);
        let at = (below as f64 - 1.0 + (value - a) / (b - a)) / n;
        return (at, at);
    }
    (below as f64 / n, (up_to as f64 - 1.0).max(0.0) / n)
}

#[cfg(test)]
mod tests {
    use gawm_schema::DimStats;

    use super::*;
    use crate::stats::MotionStats;

    fn dim(values: impl Iterator<Item = f64>) -> DimTotals {
        let mut stats = DimStats::new(false);
        values.for_each(|v| stats.update(v));
        DimTotals {
            name: "x".into(),
            unit: String::new(),
            values: stats,
            motion: MotionStats::default(),
            trace: Vec::new(),
        }
    }

    fn check(shift: f64, expected_ks: f64) {
        let a = dim((0..4000).map(|i| f64::from(i) / 4000.0));
        let b = dim((0..4000).map(|i| f64::from(i) / 4000.0 + shift));
        let found = compare_dims("c", &a, &b).unwrap();
        assert!((found.ks - expected_ks).abs() < 0.01, "{found:?}");
    }

    #[test]
    fn ks_of_shifted_uniforms_is_the_shift() {
        check(0.0, 0.0);
        check(0.25, 0.25);
        check(2.0, 1.0);
    }

    #[test]
    fn equal_distributions_are_stable() {
        let a = dim((0..4000).map(|i| f64::from(i % 97)));
        let found = compare_dims("c", &a, &a).unwrap();
        assert!(found.psi.abs() < 1e-9 && found.ks < 1e-9);
    }
}
