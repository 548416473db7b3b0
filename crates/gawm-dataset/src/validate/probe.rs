//! SEMANTIC-012, opt-in: can a linear probe see each state in the pictures at all?
//!
//! A ridge regression from thumbnails of two consecutive frames of each camera is fitted on every other episode and
//! scored on the rest. A target that it does not see at all is hidden from the cameras, or the cameras are not of this
//! robot. A linear probe on thumbnails proves only the gross case: the bound on R2 is accordingly low.

use std::collections::BTreeMap;

use super::{
    Finding, Thresholds,
    image::{CameraRun, THUMB},
    profile::Plan,
};
use crate::read::{Dataset, EpisodeRows, ScanError};

/// Most cameras that are used.
const MAX_CAMERAS: usize = 3;
/// Most rows that are used.
const MAX_ROWS: u64 = 8000;
/// Ridge: share of the mean diagonal that is added to it.
const RIDGE: f64 = 1e-2;

/// Rows of features and targets of one run.
struct Block {
    run_index: usize,
    features: Vec<Vec<f64>>,
    targets: Vec<Vec<f64>>,
}

/// Judges all state dims.
pub(super) fn judge(
    dataset: &Dataset,
    plan: &Plan,
    thresholds: &Thresholds,
    pictures: &[(usize, Vec<CameraRun>)],
) -> Result<Vec<Finding>, ScanError> {
    let by_run: BTreeMap<usize, &Vec<CameraRun>> =
        pictures.iter().map(|(run, cameras)| (*run, cameras)).collect();
    let mut columns: Vec<String> = plan.states.iter().map(|(f, _)| plan.layouts[*f].name.clone()).collect();
    columns.dedup();
    let stride = dataset.n_rows().div_ceil(MAX_ROWS).max(1) as usize;
    let (blocks, _) = dataset
        .scan(&columns, |rows| by_run.get(&rows.run_index).and_then(|p| block(plan, &rows, p, stride)))?;
    let blocks: Vec<Block> = blocks.into_iter().flatten().collect();
    let (train, test): (Vec<&Block>, Vec<&Block>) = blocks.iter().partition(|b| b.run_index % 2 == 0);
    let n_rows: usize = blocks.iter().map(|b| b.features.len()).sum();
    let is_enough =
        (n_rows as f64) >= thresholds.semantic.probe_rows && !train.is_empty() && !test.is_empty();
    let Some(weights) = is_enough.then(|| fit(&train, plan.states.len())).flatten() else {
        return Ok(Vec::new());
    };
    let mut findings = Vec::new();
    for (k, target) in plan.states.iter().enumerate() {
        let Some(r2) = score(&weights, &test, k) else { continue };
        if r2 < thresholds.semantic.probe_r2 {
            let (feature, dim) = plan.name(*target);
            let message = format!(
                "a linear probe of {n_rows} frame pairs sees nothing of it: R2 {r2:.3} on held-out episodes"
            );
            let finding = Finding::new("SEMANTIC-012", message).feature(feature).dim(dim);
            findings.push(finding.measured(r2, thresholds.semantic.probe_r2));
        }
    }
    Ok(findings)
}

fn block(plan: &Plan, rows: &EpisodeRows, cameras: &[CameraRun], stride: usize) -> Option<Block> {
    let states: Option<Vec<&Vec<f64>>> = plan
        .states
        .iter()
        .map(|&(f, d)| rows.column(&plan.layouts[f].name).and_then(|c| c.dims().get(d)))
        .collect();
    let states = states?;
    let mut block = Block { run_index: rows.run_index, features: Vec::new(), targets: Vec::new() };
    for t in (1..rows.n_rows()).step_by(stride) {
        let mut features = vec![1.0];
        for camera in cameras.iter().take(MAX_CAMERAS) {
            let (Some(before), Some(here)) = (camera.thumb(t - 1), camera.thumb(t)) else { break };
            features.extend(here.iter().map(|v| f64::from(*v) / 255.0 - 0.5));
            features.extend(here.iter().zip(before).map(|(a, b)| (f64::from(*a) - f64::from(*b)) / 64.0));
        }
        let is_whole = features.len() == 1 + 2 * THUMB * cameras.len().min(MAX_CAMERAS);
        if is_whole && states.iter().all(|s| s[t].is_finite()) {
            block.features.push(features);
            block.targets.push(states.iter().map(|s| s[t]).collect());
        }
    }
    (!block.features.is_empty()).then_some(block)
}

/// Fits all targets; weights are [target][feature].
fn fit(train: &[&Block], n_targets: usize) -> Option<Vec<Vec<f64>>> {
    let n = train.first()?.features.first()?.len();
    let mut normal = vec![vec![0.0; n]; n];
    let mut right = vec![vec![0.0; n]; n_targets];
    for (x, y) in train.iter().flat_map(|b| b.features.iter().zip(&b.targets)) {
        for i in 0..n {
            normal[i][..=i].iter_mut().zip(x).for_each(|(a, v)| *a += x[i] * v);
        }
        for (sums, target) in right.iter_mut().zip(y) {
            sums.iter_mut().zip(x).for_each(|(a, v)| *a += target * v);
        }
    }
    let ridge = RIDGE * (0..n).map(|i| normal[i][i]).sum::<f64>() / n as f64;
    for (i, row) in normal.iter_mut().enumerate().skip(1) {
        row[i] += ridge;
    }
    let factor = cholesky(normal)?;
    Some(right.into_iter().map(|b| back_substitute(&factor, b)).collect())
}

/// Returns the lower Cholesky factor of a positive definite matrix given by its lower triangle.
fn cholesky(mut a: Vec<Vec<f64>>) -> Option<Vec<Vec<f64>>> {
    for i in 0..a.len() {
        for j in 0..=i {
            let (head, tail) = a.split_at_mut(i);
            let known: f64 = if i == j {
                tail[0][..j].iter().map(|v| v * v).sum()
            } else {
                tail[0][..j].iter().zip(&head[j][..j]).map(|(x, y)| x * y).sum()
            };
            let value = tail[0][j] - known;
            tail[0][j] = if i == j { (value > 0.0).then(|| value.sqrt())? } else { value / head[j][j] };
        }
    }
    Some(a)
}

fn back_substitute(factor: &[Vec<f64>], mut b: Vec<f64>) -> Vec<f64> {
    for i in 0..b.len() {
        let known: f64 = factor[i][..i].iter().zip(&b).map(|(l, v)| l * v).sum();
        b[i] = (b[i] - known) / factor[i][i];
    }
    for i in (0..b.len()).rev() {
        let known: f64 = (i + 1..b.len()).map(|k| factor[k][i] * b[k]).sum();
        b[i] = (b[i] - known) / factor[i][i];
    }
    b
}

/// Returns R2 of one target on held-out blocks, `None` where it is constant there.
fn score(weights: &[Vec<f64>], test: &[&Block], target: usize) -> Option<f64> {
    let rows = || test.iter().flat_map(|b| b.features.iter().zip(&b.targets));
    let n = rows().count() as f64;
    let mean = rows().map(|(_, y)| y[target]).sum::<f64>() / n;
    let (mut residual, mut total) = (0.0, 0.0);
    for (x, y) in rows() {
        let guess: f64 = x.iter().zip(&weights[target]).map(|(a, w)| a * w).sum();
        residual += (y[target] - guess).powi(2);
        total += (y[target] - mean).powi(2);
    }
    (total > 1e-9 * n * mean.abs().max(1e-3).powi(2)).then(|| 1.0 - residual / total)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn world(shows: bool) -> Vec<Block> {
        (0..4u32)
            .map(|run| {
                let state = |t: u32| f64::from((t * 37 + run * 11) % 101) / 101.0;
                let seen = |t: u32| if shows { state(t) } else { f64::from((t * 53 + run * 29) % 97) / 97.0 };
                Block {
                    run_index: run as usize,
                    features: (0..200).map(|t| vec![1.0, seen(t), 0.5 - seen(t)]).collect(),
                    targets: (0..200).map(|t| vec![state(t)]).collect(),
                }
            })
            .collect()
    }

    fn check(shows: bool, expected: impl Fn(f64) -> bool) {
        let blocks = world(shows);
        let (train, test): (Vec<&Block>, Vec<&Block>) = blocks.iter().partition(|b| b.run_index % 2 == 0);
        let r2 = score(&fit(&train, 1).unwrap(), &test, 0).unwrap();
        assert!(expected(r2), "{r2}");
    }

    #[test]
    fn what_is_in_the_picture_is_seen_and_what_is_not_is_not() {
        check(true, |r2| r2 > 0.95);
        check(false, |r2| r2 < 0.05);
    }
}
