//! Goal retrieval: is the frame whose latent is nearest to a goal's also nearest in the world?

use gawm_model::{Stream, permutation};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::Trajectory;
use crate::statistics::{mean_std, median, spearman};

/// Most goals that are asked for.
const MAX_GOALS: usize = 200;
/// Most frames that are searched.
const MAX_FRAMES: usize = 4000;

/// How well latent distance finds goals. State distances are Euclidean, over standardised dims.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct RetrievalReport {
    /// Goals asked for.
    pub goals: usize,
    /// Frames searched; those of a goal's own episode are left out.
    pub frames: usize,
    /// Median state distance of the frame nearest in latent space.
    pub latent: f64,
    /// Median state distance of the frame nearest in state space: the best possible.
    pub best: f64,
    /// Median state distance of a random frame.
    pub random: f64,
    /// Spearman's correlation of latent and state distance to a goal, mean over goals.
    pub rank_correlation: f64,
}

/// Asks for goals `offset` rows into the trajectories; `None` without states or with fewer than two trajectories.
pub fn retrieval(trajectories: &[Trajectory], offset: usize, seed: u64) -> Option<RetrievalReport> {
    let has_state =
        |t: &Trajectory, row: usize| t.state_width > 0 && t.state(row).iter().all(|v| v.is_finite());
    let rows = |first: usize| -> Vec<(usize, usize)> {
        let of = |(index, t): (usize, &Trajectory)| (first..t.n_rows).map(move |row| (index, row));
        trajectories
            .iter()
            .enumerate()
            .flat_map(of)
            .filter(|&(index, row)| has_state(&trajectories[index], row))
            .collect()
    };
    let goals = sample(rows(offset), MAX_GOALS, &mut Stream::new(seed, "retrieval/goals", 0));
    let frames = sample(rows(0), MAX_FRAMES, &mut Stream::new(seed, "retrieval/frames", 0));
    let answers: Vec<[f64; 4]> =
        goals.par_iter().filter_map(|goal| answer(trajectories, *goal, &frames)).collect();
    let column = |index: usize| -> Vec<f64> { answers.iter().map(|answer| answer[index]).collect() };
    Some(RetrievalReport {
        goals: answers.len(),
        frames: frames.len(),
        latent: median(&column(0))?,
        best: median(&column(1))?,
        random: median(&column(2))?,
        rank_correlation: mean_std(&column(3))?.0,
    })
}

/// State distance of the frames nearest in latents and nearest in states, the median frame's, and the correlation.
fn answer(trajectories: &[Trajectory], goal: (usize, usize), frames: &[(usize, usize)]) -> Option<[f64; 4]> {
    let (index, row) = goal;
    let own = &trajectories[index];
    let (mut latent, mut state) = (Vec::new(), Vec::new());
    for &(other, at) in frames.iter().filter(|(other, _)| *other != index) {
        let squares = |(a, b): (&f32, &f32)| f64::from(a - b).powi(2);
        let frame = &trajectories[other];
        latent.push(own.latent(row).iter().zip(frame.latent(at)).map(squares).sum::<f64>());
        state.push(
            own.state(row).iter().zip(frame.state(at)).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt(),
        );
    }
    let nearest = (0..latent.len()).min_by(|&a, &b| latent[a].total_cmp(&latent[b]))?;
    let best = state.iter().copied().fold(f64::INFINITY, f64::min);
    Some([state[nearest], best, median(&state)?, spearman(&latent, &state).unwrap_or(0.0)])
}

fn sample(rows: Vec<(usize, usize)>, most: usize, stream: &mut Stream) -> Vec<(usize, usize)> {
    let mut order = permutation(stream, u32::try_from(rows.len()).unwrap_or(u32::MAX));
    order.truncate(most);
    order.into_iter().map(|index| rows[index as usize]).collect()
}
