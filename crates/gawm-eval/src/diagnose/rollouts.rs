//! Open-loop prediction over several chunks, against standing still and against other actions.

use gawm_model::plan::rollout;
use gawm_model::{Pass, Stream, Tensor, permutation};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Trajectory;
use crate::encode::device;
use crate::run::Run;

/// Starts that are rolled out at once.
const STARTS_PER_BLOCK: usize = 128;
/// Most starts over all trajectories; beyond it they are thinned out evenly.
const MAX_STARTS: usize = 1024;

/// Prediction error after a number of chunks.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct HorizonReport {
    /// Chunks ahead.
    pub chunks: usize,
    /// Mean squared error of the prediction, per value of a latent.
    pub prediction: f64,
    /// The same when the latent is predicted to stay as it is.
    pub identity: f64,
    /// The same prediction with the action sequences of other starts.
    pub shuffled: f64,
    /// `prediction / identity`: below 1 the model knows more than that nothing moves. `None` if nothing moves.
    pub against_identity: Option<f64>,
    /// `shuffled / prediction`: 1 means that actions are ignored. `None` if the prediction is perfect.
    pub action_sensitivity: Option<f64>,
}

/// Prediction errors over all starts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RolloutReport {
    /// Real frames that a prediction starts from.
    pub history: usize,
    /// Starts; 0 where no trajectory is long enough.
    pub starts: usize,
    /// Possible starts that were left out because an action within is not valid.
    pub skipped: usize,
    /// One entry per number of chunks.
    pub horizons: Vec<HorizonReport>,
}

/// A predicted latent and the row that it stands for.
#[derive(Debug, Clone, PartialEq)]
pub struct Prediction {
    /// Position of the trajectory.
    pub trajectory: usize,
    /// The row that is predicted.
    pub row: usize,
    /// Chunks ahead.
    pub chunks: usize,
    /// The predicted latent `[D]`.
    pub z: Vec<f32>,
}

/// Where a rollout starts: trajectory and the row of its last real frame.
type Place = (usize, usize);

/// Rolls out from all trajectories: every frameskip rows, with as many real frames as the model was trained on.
///
/// # Errors
/// candle failed.
pub fn rollouts(
    run: &Run,
    trajectories: &[Trajectory],
    horizon: usize,
    seed: u64,
) -> candle_core::Result<(RolloutReport, Vec<Prediction>)> {
    let skip = run.hello.frameskip;
    let history = run.model.architecture().config().predictor.history.min(run.hello.history);
    let (mut places, mut skipped) = (Vec::new(), 0);
    for (index, trajectory) in trajectories.iter().enumerate() {
        let first = (history - 1) * skip;
        let end = trajectory.n_rows.saturating_sub(horizon * skip);
        for row in (first..end).step_by(skip) {
            let actions = &trajectory.action_valid[row - first..row + horizon * skip];
            if actions.iter().all(|valid| *valid) {
                places.push((index, row));
            } else {
                skipped += 1;
            }
        }
    }
    let step = places.len().div_ceil(MAX_STARTS).max(1);
    let places: Vec<Place> = places.into_iter().step_by(step).collect();
    let n = places.len();
    if n == 0 {
        return Ok((RolloutReport { history, starts: 0, skipped, horizons: Vec::new() }, Vec::new()));
    }
    let order = permutation(&mut Stream::new(seed, "diagnose/shuffled-actions", 0), n as u32);
    let donors: Vec<Place> = order.into_iter().map(|index| places[index as usize]).collect();
    let plan = Rollouts { run, trajectories, history, horizon };
    let predicted = plan.all(&places, &places)?;
    let shuffled = plan.all(&places, &donors)?;
    let horizons = (1..=horizon).map(|k| plan.report(&places, &predicted, &shuffled, k)).collect();
    let d = run.model.architecture().config().latent_width;
    let prediction = |(start, chunks): (usize, usize)| {
        let (trajectory, row) = places[start];
        let at = (start * horizon + chunks - 1) * d;
        Prediction { trajectory, row: row + chunks * skip, chunks, z: predicted[at..at + d].to_vec() }
    };
    let all = (0..n).flat_map(|start| (1..=horizon).map(move |chunks| (start, chunks)));
    Ok((RolloutReport { history, starts: n, skipped, horizons }, all.map(prediction).collect()))
}

struct Rollouts<'a> {
    run: &'a Run,
    trajectories: &'a [Trajectory],
    history: usize,
    horizon: usize,
}

impl Rollouts<'_> {
    /// Rolls out from `places` under the future actions of `donors`: [places, horizon, D], row-major.
    fn all(&self, places: &[Place], donors: &[Place]) -> candle_core::Result<Vec<f32>> {
        let pairs: Vec<(Place, Place)> = places.iter().copied().zip(donors.iter().copied()).collect();
        let blocks: Vec<candle_core::Result<Vec<f32>>> =
            pairs.par_chunks(STARTS_PER_BLOCK).map(|block| self.block(block)).collect();
        Ok(blocks.into_iter().collect::<candle_core::Result<Vec<_>>>()?.concat())
    }

    fn block(&self, pairs: &[(Place, Place)]) -> candle_core::Result<Vec<f32>> {
        let (skip, h) = (self.run.hello.frameskip, self.history);
        let d = self.run.model.architecture().config().latent_width;
        let width = self.run.hello.shape.action_width;
        let (mut z, mut chunks) = (Vec::new(), Vec::new());
        for ((trajectory, row), (donor, donor_row)) in pairs {
            let (own, other) = (&self.trajectories[*trajectory], &self.trajectories[*donor]);
            for back in (0..h).rev() {
                z.extend_from_slice(own.latent(row - back * skip));
            }
            let actions = |from: &Trajectory, first: usize, n: usize| {
                let dims = from.actions.len() / from.n_rows;
                from.actions[first * dims..(first + n) * dims].to_vec()
            };
            chunks.extend(actions(own, row - (h - 1) * skip, (h - 1) * skip));
            chunks.extend(actions(other, *donor_row, self.horizon * skip));
        }
        let (n, device) = (pairs.len(), device(&self.run.model));
        let z = Tensor::from_vec(z, (n, h, d), &device)?;
        let chunks = Tensor::from_vec(chunks, (n, h - 1 + self.horizon, width), &device)?;
        rollout(&self.run.model, &z, &chunks, &Pass::eval())?.flatten_all()?.to_vec1() // Sync: waits for the device.
    }

    fn report(&self, places: &[Place], predicted: &[f32], shuffled: &[f32], k: usize) -> HorizonReport {
        let (skip, d) = (self.run.hello.frameskip, self.run.model.architecture().config().latent_width);
        let distance = |a: &[f32], b: &[f32]| {
            a.iter().zip(b).map(|(a, b)| f64::from(a - b).powi(2)).sum::<f64>() / d as f64
        };
        let mut sums = [0.0; 3];
        for (start, (trajectory, row)) in places.iter().enumerate() {
            let own = &self.trajectories[*trajectory];
            let (now, then) = (own.latent(*row), own.latent(row + k * skip));
            let at = (start * self.horizon + k - 1) * d;
            sums[0] += distance(&predicted[at..at + d], then);
            sums[1] += distance(now, then);
            sums[2] += distance(&shuffled[at..at + d], then);
        }
        let [prediction, identity, shuffled] = sums.map(|sum| sum / places.len() as f64);
        HorizonReport {
            chunks: k,
            prediction,
            identity,
            shuffled,
            against_identity: (identity > 0.0).then(|| prediction / identity),
            action_sensitivity: (prediction > 0.0).then(|| shuffled / prediction),
        }
    }
}
