//! Probes: what can be read from frozen latents, dimension by dimension.
//!
//! A linear (ridge) and a two-layer probe are fitted on the latents of some episodes and scored on those of others. They
//! are scored twice: on encoded latents and on latents that the model predicted some chunks ahead.

mod linear;
mod mlp;

use gawm_model::{Stream, permutation};
use rayon::prelude::*;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::diagnose::{Prediction, Trajectory};
use crate::run::Run;
use crate::statistics::pearson;

use linear::Ridge;
use mlp::Mlp;

/// Settings of the probes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ProbeOptions {
    /// Share of the episodes that probes are fitted on; the others score them.
    pub train_share: f64,
    /// Ridge penalty per sample, on standardised latents.
    pub ridge: f64,
    /// Hidden width of the two-layer probe.
    pub hidden: usize,
    /// Passes over the data of the two-layer probe; more where there are so few rows that these are under 1500 steps.
    pub epochs: usize,
    /// Step of Adam.
    pub learning_rate: f64,
    /// Most rows that are fitted; beyond it they are thinned out evenly.
    pub max_rows: usize,
}

impl Default for ProbeOptions {
    fn default() -> Self {
        ProbeOptions {
            train_share: 0.7,
            ridge: 1e-4,
            hidden: 128,
            epochs: 30,
            learning_rate: 2e-3,
            max_rows: 20_000,
        }
    }
}

/// How well one probe reads one dimension of the state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbeScore {
    /// `linear` or `mlp`.
    pub probe: String,
    /// Chunks ahead; 0 for encoded latents.
    pub chunks: usize,
    /// Dim of the state.
    pub dim: String,
    /// Unit of `rmse`.
    pub unit: String,
    /// 1 - squared error / variance, on episodes that were not fitted; `None` where the dim does not vary.
    pub r2: Option<f64>,
    /// Pearson's correlation; `None` where one side does not vary.
    pub pearson: Option<f64>,
    /// Root mean squared error in `unit`.
    pub rmse: f64,
    /// Values that were scored.
    pub n: usize,
}

/// All probes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ProbeReport {
    /// Ids of the episodes that probes were fitted on.
    pub train_ids: Vec<String>,
    /// Ids of those that scored them.
    pub test_ids: Vec<String>,
    /// Rows that were fitted.
    pub train_rows: usize,
    /// One entry per probe, number of chunks and dim.
    pub scores: Vec<ProbeScore>,
}

/// Latents and targets, row by row.
#[derive(Debug, Clone, Default)]
struct Rows {
    /// [N, D], standardised by the fitted rows.
    x: Vec<f32>,
    /// [N, S], NaN where there is none.
    y: Vec<f64>,
}

/// Fits and scores all probes. Empty where there is no state or only one episode.
///
/// # Errors
/// candle failed.
pub fn probe(
    run: &Run,
    trajectories: &[Trajectory],
    predictions: &[Prediction],
    options: &ProbeOptions,
    seed: u64,
) -> candle_core::Result<ProbeReport> {
    let n = trajectories.len();
    let mut order = permutation(&mut Stream::new(seed, "probe/split", 0), n as u32);
    let n_train =
        ((n as f64 * options.train_share).round() as usize).clamp(n.min(1), n.saturating_sub(1).max(1));
    let test: Vec<usize> = order.split_off(n_train.min(n)).into_iter().map(|i| i as usize).collect();
    let train: Vec<usize> = order.into_iter().map(|i| i as usize).collect();
    let ids = |of: &[usize]| of.iter().map(|&index| trajectories[index].id.clone()).collect();
    let mut report =
        ProbeReport { train_ids: ids(&train), test_ids: ids(&test), train_rows: 0, scores: Vec::new() };
    let (d, s) = trajectories.first().map_or((0, 0), |t| (t.latent_width, t.state_width));
    if test.is_empty() || train.is_empty() || s == 0 {
        return Ok(report);
    }
    let mut fitted = collect(trajectories, &train);
    thin(&mut fitted, d, s, options.max_rows);
    report.train_rows = fitted.x.len() / d;
    let scale = Scale::fit(fitted.x.iter().map(|value| f64::from(*value)), d);
    scale.apply(&mut fitted.x);
    let mut scored: Vec<(usize, Rows)> = vec![(0, collect(trajectories, &test))];
    let horizon = predictions.iter().map(|prediction| prediction.chunks).max().unwrap_or(0);
    scored.extend(
        (1..=horizon).map(|chunks| (chunks, collect_predictions(trajectories, predictions, &test, chunks))),
    );
    scored.iter_mut().for_each(|(_, rows)| scale.apply(&mut rows.x));

    let linear: Vec<Ridge> = (0..s)
        .into_par_iter()
        .map(|dim| Ridge::fit(&fitted.x, &column(&fitted.y, s, dim), d, options.ridge))
        .collect();
    let mlp = Mlp::fit(&fitted.x, &fitted.y, d, s, options, seed)?;
    for (chunks, rows) in &scored {
        let read = mlp.predict(&rows.x)?;
        for dim in 0..s {
            let y = column(&rows.y, s, dim);
            let info = &run.hello.state.dims[dim];
            let linear = linear[dim].predict(&rows.x);
            let mlp: Vec<f64> = read.iter().skip(dim).step_by(s).map(|value| f64::from(*value)).collect();
            for (name, predicted) in [("linear", linear), ("mlp", mlp)] {
                let unit = serde_json::to_value(&info.unit).ok();
                let unit = unit.and_then(|unit| unit.as_str().map(str::to_owned)).unwrap_or_default();
                report.scores.push(ProbeScore {
                    probe: name.to_owned(),
                    chunks: *chunks,
                    dim: info.name.clone(),
                    unit,
                    ..score(&predicted, &y, info.scale)
                });
            }
        }
    }
    Ok(report)
}

/// R2, correlation and error of one dim; values without a target are left out.
fn score(predicted: &[f64], y: &[f64], scale: f64) -> ProbeScore {
    let pairs: Vec<(f64, f64)> =
        predicted.iter().copied().zip(y.iter().copied()).filter(|(_, y)| y.is_finite()).collect();
    let n = pairs.len();
    let (predicted, y): (Vec<f64>, Vec<f64>) = pairs.into_iter().unzip();
    let mean = y.iter().sum::<f64>() / n.max(1) as f64;
    let variance: f64 = y.iter().map(|y| (y - mean).powi(2)).sum();
    let error: f64 = predicted.iter().zip(&y).map(|(p, y)| (p - y).powi(2)).sum();
    ProbeScore {
        probe: String::new(),
        chunks: 0,
        dim: String::new(),
        unit: String::new(),
        r2: (variance > 0.0).then(|| 1.0 - error / variance),
        pearson: pearson(&predicted, &y),
        rmse: (error / n.max(1) as f64).sqrt() * scale,
        n,
    }
}

fn collect(trajectories: &[Trajectory], chosen: &[usize]) -> Rows {
    let mut rows = Rows::default();
    for &index in chosen {
        rows.x.extend_from_slice(&trajectories[index].z);
        rows.y.extend_from_slice(&trajectories[index].states);
    }
    rows
}

fn collect_predictions(
    trajectories: &[Trajectory],
    predictions: &[Prediction],
    chosen: &[usize],
    chunks: usize,
) -> Rows {
    let mut rows = Rows::default();
    for prediction in predictions.iter().filter(|p| p.chunks == chunks && chosen.contains(&p.trajectory)) {
        rows.x.extend_from_slice(&prediction.z);
        rows.y.extend_from_slice(trajectories[prediction.trajectory].state(prediction.row));
    }
    rows
}

/// Keeps every k-th row, so that at most `most` are left.
fn thin(rows: &mut Rows, d: usize, s: usize, most: usize) {
    let step = (rows.x.len() / d).div_ceil(most.max(1)).max(1);
    rows.x = rows.x.chunks_exact(d).step_by(step).flatten().copied().collect();
    rows.y = rows.y.chunks_exact(s).step_by(step).flatten().copied().collect();
}

fn column(values: &[f64], width: usize, dim: usize) -> Vec<f64> {
    values.iter().skip(dim).step_by(width).copied().collect()
}

/// Mean and standard deviation of each column; values that are not finite are left out.
#[derive(Debug, Clone)]
struct Scale {
    mean: Vec<f64>,
    std: Vec<f64>,
}

impl Scale {
    /// Measures values [N, d], row-major.
    fn fit(x: impl Iterator<Item = f64> + Clone, d: usize) -> Scale {
        let moment = |dim: usize| {
            let values = || x.clone().skip(dim).step_by(d).filter(|value| value.is_finite());
            let n = values().count().max(1) as f64;
            let mean = values().sum::<f64>() / n;
            let std = (values().map(|value| (value - mean).powi(2)).sum::<f64>() / n).sqrt();
            (mean, if std.is_normal() { std } else { 1.0 })
        };
        let (mean, std) = (0..d).map(moment).unzip();
        Scale { mean, std }
    }

    fn apply(&self, x: &mut [f32]) {
        for row in x.chunks_exact_mut(self.mean.len()) {
            for ((value, mean), std) in row.iter_mut().zip(&self.mean).zip(&self.std) {
                *value = ((f64::from(*value) - mean) / std) as f32;
            }
        }
    }

    fn undo(&self, x: &mut [f32]) {
        for row in x.chunks_exact_mut(self.mean.len()) {
            for ((value, mean), std) in row.iter_mut().zip(&self.mean).zip(&self.std) {
                *value = (f64::from(*value) * std + mean) as f32;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Latents of which the state is a linear function, or a product that no line can follow.
    fn data(n: usize, seed: u64) -> (Vec<f32>, Vec<f64>) {
        let mut stream = Stream::new(seed, "probe", 0);
        let x = stream.normals(n * 6);
        let y = x.chunks_exact(6).flat_map(|row| {
            let [a, b, c] = [row[0], row[1], row[2]].map(f64::from);
            // Far from zero, as a cosine near 1 is: a probe that cannot find the mean reads nothing.
            [2.0 * a - b + 0.5, a * c, 50.0 + 0.1 * a]
        });
        (x.clone(), y.collect())
    }

    #[test]
    fn probes_read_what_is_there_and_no_more() {
        let ((x, y), (x_test, y_test)) = (data(4000, 1), data(1000, 2));
        let options = ProbeOptions { epochs: 40, ..ProbeOptions::default() };
        let mlp = Mlp::fit(&x, &y, 6, 3, &options, 3).unwrap().predict(&x_test).unwrap();
        for (dim, linear_low, linear_high, mlp_low) in [(0, 0.999, 1.0, 0.98), (1, -0.1, 0.1, 0.9)] {
            let target = column(&y_test, 3, dim);
            let ridge = Ridge::fit(&x, &column(&y, 3, dim), 6, 1e-6);
            let linear = score(&ridge.predict(&x_test), &target, 3.0);
            let r2 = linear.r2.unwrap();
            assert!((linear_low..=linear_high).contains(&r2), "dim {dim}: linear {r2}");
            let read: Vec<f64> = mlp.iter().skip(dim).step_by(3).map(|value| f64::from(*value)).collect();
            let nonlinear = score(&read, &target, 3.0);
            assert!(nonlinear.r2.unwrap() > mlp_low, "dim {dim}: {nonlinear:?}");
        }
    }

    #[test]
    fn few_rows_and_targets_far_from_zero_are_read() {
        let ((x, y), (x_test, y_test)) = (data(300, 4), data(300, 5));
        let mlp = Mlp::fit(&x, &y, 6, 3, &ProbeOptions::default(), 3).unwrap().predict(&x_test).unwrap();
        for dim in [0, 2] {
            let read: Vec<f64> = mlp.iter().skip(dim).step_by(3).map(|value| f64::from(*value)).collect();
            let r2 = score(&read, &column(&y_test, 3, dim), 1.0).r2.unwrap();
            assert!(r2 > 0.9, "dim {dim}: {r2}");
        }
    }

    #[test]
    fn errors_are_in_physical_units_and_gaps_are_left_out() {
        let score = score(&[1.0, 2.0, 9.0], &[2.0, 3.0, f64::NAN], 10.0);
        assert_eq!((score.n, score.rmse, score.pearson), (2, 10.0, Some(1.0)));
        assert_eq!(score.r2, Some(1.0 - 2.0 / 0.5));
    }
}
