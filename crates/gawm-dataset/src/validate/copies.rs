//! SPLIT-002 for copies of which one was cut: trajectories are compared at a fixed distance of rows from either end.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    Finding, Thresholds,
    profile::{ALIGNED_ROWS, FINGERPRINT_POINTS, RunProfile},
    split::{MAX_LISTED, across},
};

/// Points of aligned trajectories that copies must have at least.
const MIN_ALIGNED: usize = 5;
/// Most trajectories that one is compared with.
const MAX_NEIGHBOURS: usize = 2000;
/// Least share of the longer one's rows that the shorter one must have.
const LENGTH_SHARE: f64 = 0.7;

/// Finds copies of which one was cut at its begin or its end; `spreads` are the standard deviations of all dims.
pub(super) fn judge(
    thresholds: &Thresholds,
    splits: &BTreeMap<i64, String>,
    runs: &[&RunProfile],
    spreads: &[f64],
    exact: &BTreeSet<(i64, i64)>,
    findings: &mut Vec<Finding>,
) {
    let bound = thresholds.split.near_sigmas;
    let mut found = BTreeSet::new();
    for (side, end) in [(0, "end"), (1, "begin")] {
        let cut = Cut { side, moving: (0..spreads.len()).filter(|d| spreads[*d] > 1e-9).collect(), spreads };
        for (a, b) in cut.neighbours(runs, bound) {
            let pair = (a.episode.min(b.episode), a.episode.max(b.episode));
            if exact.contains(&pair) || a.content_hash == b.content_hash || found.len() >= MAX_LISTED {
                continue;
            }
            let sigmas = cut.distance(a, b);
            if sigmas <= bound && found.insert(pair) {
                let message = format!(
                    "the motion is that of episode {} within {sigmas:.4} standard deviations, cut at its {end} ({} rows and {})",
                    pair.0, a.n_rows, b.n_rows
                );
                findings.push(Finding::new("SPLIT-002", message).episode(pair.1).measured(sigmas, bound));
                across("SPLIT-006", pair.0, pair.1, splits, findings);
            }
        }
    }
}

/// Trajectories counted from one side.
struct Cut<'a> {
    side: usize,
    moving: Vec<usize>,
    spreads: &'a [f64],
}

impl Cut<'_> {
    fn at(&self, run: &RunProfile, dim: usize, point: usize) -> f64 {
        f64::from(run.aligned[self.side][dim * FINGERPRINT_POINTS + point]) / self.spreads[dim]
    }

    /// Returns pairs of different length whose first points have close sums, as those of close trajectories have.
    fn neighbours<'r>(&self, runs: &[&'r RunProfile], bound: f64) -> Vec<(&'r RunProfile, &'r RunProfile)> {
        let n_values = self.spreads.len() * FINGERPRINT_POINTS;
        let sum = |run: &RunProfile| -> f64 {
            let values = self.moving.iter().flat_map(|d| (0..MIN_ALIGNED).map(move |p| (*d, p)));
            values.map(|(d, p)| self.at(run, d, p)).sum()
        };
        let is_usable = |r: &&&RunProfile| {
            r.aligned[self.side].len() == n_values && r.n_rows > MIN_ALIGNED * ALIGNED_ROWS
        };
        let mut order: Vec<(f64, &RunProfile)> =
            runs.iter().filter(is_usable).map(|r| (sum(r), *r)).filter(|(s, _)| s.is_finite()).collect();
        order.sort_by(|a, b| a.0.total_cmp(&b.0).then(a.1.episode.cmp(&b.1.episode)));
        let reach = bound * (self.moving.len() * FINGERPRINT_POINTS) as f64;
        let is_cut = |a: &RunProfile, b: &RunProfile| {
            let (short, long) = (a.n_rows.min(b.n_rows) as f64, a.n_rows.max(b.n_rows) as f64);
            short < long && short >= LENGTH_SHARE * long
        };
        let mut pairs = Vec::new();
        for (i, (sum, a)) in order.iter().enumerate() {
            let near = order[i + 1..].iter().take_while(|(other, _)| other - sum <= reach);
            pairs.extend(near.take(MAX_NEIGHBOURS).filter(|(_, b)| is_cut(a, b)).map(|(_, b)| (*a, *b)));
        }
        pairs
    }

    /// Returns the root mean square distance of the points that both have, in standard deviations.
    fn distance(&self, a: &RunProfile, b: &RunProfile) -> f64 {
        let points = (a.n_rows.min(b.n_rows) / ALIGNED_ROWS).min(FINGERPRINT_POINTS);
        let mut sum = 0.0;
        for &d in &self.moving {
            sum += (0..points).map(|p| (self.at(a, d, p) - self.at(b, d, p)).powi(2)).sum::<f64>();
        }
        (sum / (self.moving.len() * points).max(1) as f64).sqrt()
    }
}
