//! Fixed trajectories: chosen, read, encoded.

use gawm_model::{Stream, permutation};

use super::{DiagnoseError, DiagnoseOptions};
use crate::data::{Data, Episode};
use crate::encode::{encode_frames, fit_frame};
use crate::run::{Run, standardise};

/// Frames that are held decoded at once.
const FRAMES_AT_ONCE: usize = 1024;

/// A trajectory with its latents.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    /// Id of the episode.
    pub id: String,
    /// Number of rows.
    pub n_rows: usize,
    /// Latents [rows, D], row-major.
    pub z: Vec<f32>,
    /// Width D of a latent.
    pub latent_width: usize,
    /// Standardised states [rows, S]; NaN where there is none.
    pub states: Vec<f64>,
    /// Width S of a state.
    pub state_width: usize,
    /// Standardised actions [rows, A'], A' being the width of one action.
    pub actions: Vec<f32>,
    /// Whether the action of each row is one.
    pub action_valid: Vec<bool>,
}

impl Trajectory {
    /// Returns the latent of a row.
    pub fn latent(&self, row: usize) -> &[f32] {
        &self.z[row * self.latent_width..(row + 1) * self.latent_width]
    }

    /// Returns the standardised state of a row.
    pub fn state(&self, row: usize) -> &[f64] {
        &self.states[row * self.state_width..(row + 1) * self.state_width]
    }

    /// Returns the latents of every `stride`-th row in f64, row-major.
    pub fn strided(&self, stride: usize) -> Vec<f64> {
        let rows = self.z.chunks_exact(self.latent_width).step_by(stride);
        rows.flatten().map(|value| f64::from(*value)).collect()
    }
}

/// Chooses episodes: the stored ids, or a draw from the held-out ones. Returns positions and whether they are held out.
///
/// # Errors
/// - [`DiagnoseError::UnknownId`], [`DiagnoseError::TooShort`].
pub fn choose(data: &Data, options: &DiagnoseOptions) -> Result<(Vec<usize>, bool), DiagnoseError> {
    let (pool, is_held_out) = data.held_out();
    if let Some(ids) = &options.ids {
        let position = |id: &String| {
            let found = data.episodes.iter().position(|episode| episode.id == *id);
            found.ok_or_else(|| DiagnoseError::UnknownId { id: id.clone() })
        };
        let chosen: Vec<usize> = ids.iter().map(position).collect::<Result<_, _>>()?;
        let is_held_out = is_held_out && chosen.iter().all(|index| pool.contains(index));
        return Ok((chosen, is_held_out));
    }
    let needed = 2 * options.stride + 1;
    let long: Vec<usize> = pool.iter().copied().filter(|&i| data.episodes[i].n_rows >= needed).collect();
    if long.is_empty() {
        let got = pool.iter().map(|&index| data.episodes[index].n_rows).max().unwrap_or(0);
        return Err(DiagnoseError::TooShort { expected: needed, got });
    }
    let n = u32::try_from(long.len()).unwrap_or(u32::MAX);
    let mut order = permutation(&mut Stream::new(options.seed, "diagnose/trajectories", 0), n);
    order.truncate(options.trajectories);
    order.sort_unstable();
    Ok((order.into_iter().map(|index| long[index as usize]).collect(), is_held_out))
}

/// Reads and encodes episodes, at most `max_rows` rows of each.
///
/// # Errors
/// - [`DiagnoseError`] names the episode whose frames cannot be read or encoded.
pub fn encode(
    run: &Run,
    data: &Data,
    episodes: &[usize],
    max_rows: usize,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Vec<Trajectory>, DiagnoseError> {
    let mut trajectories = Vec::with_capacity(episodes.len());
    for &index in episodes {
        let episode = &data.episodes[index];
        let n_rows = episode.n_rows.min(max_rows);
        let mut z = Vec::new();
        for first in (0..n_rows).step_by(FRAMES_AT_ONCE) {
            let rows: Vec<usize> = (first..n_rows.min(first + FRAMES_AT_ONCE)).collect();
            let frames = data.frames(episode, &rows)?;
            let fitted = frames
                .iter()
                .map(|frame| fit_frame(frame, run.image_size()))
                .collect::<Result<Vec<_>, _>>()
                .map_err(|cause| DiagnoseError::Image { episode: episode.id.clone(), cause })?;
            z.extend(encode_frames(&run.model, &fitted, run.image_size())?);
        }
        trajectories.push(trajectory(run, episode, n_rows, z)?);
        progress(trajectories.len());
    }
    Ok(trajectories)
}

fn trajectory(run: &Run, episode: &Episode, n_rows: usize, z: Vec<f32>) -> Result<Trajectory, DiagnoseError> {
    let latent_width = run.model.architecture().config().latent_width;
    if let Some(position) = z.iter().position(|value| !value.is_finite()) {
        return Err(DiagnoseError::NonFinite { episode: episode.id.clone(), row: position / latent_width });
    }
    let (state_width, action_width) = (run.hello.state.dims.len(), run.hello.action.dims.len());
    let mut states = episode.states[..n_rows * state_width].to_vec();
    states.chunks_exact_mut(state_width.max(1)).for_each(|row| standardise(row, &run.hello.state.dims));
    let mut actions = episode.actions[..n_rows * action_width].to_vec();
    actions.chunks_exact_mut(action_width.max(1)).for_each(|row| standardise(row, &run.hello.action.dims));
    Ok(Trajectory {
        id: episode.id.clone(),
        n_rows,
        z,
        latent_width,
        states,
        state_width,
        actions: actions.into_iter().map(|value| value as f32).collect(),
        action_valid: episode.action_valid[..n_rows].to_vec(),
    })
}
