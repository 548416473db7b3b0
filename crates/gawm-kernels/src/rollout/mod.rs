//! Rolling latents forward under actions, without gradients: the inner loop of a planner.
//!
//! A window of the last `history` latents goes through a causal transformer modulated by the actions, whose last output
//! becomes the next latent. Three things are computed once that a plain loop repeats:
//!
//! - while windows only grow, positions and latents of their head stay, so that keys and values are kept and only the
//!   new token is computed; once the window slides, positions begin anew and all its tokens are;
//! - modulations depend on the action alone, so that each is computed once per action and not once per window;
//! - the last block and the projector work on the last token only.
//!
//! Sequences do not see each other: groups of them run in parallel, and no result depends on the grouping.

mod adapter;
mod pass;
mod weights;

use std::sync::Mutex;

use rayon::prelude::*;

use crate::profile::{Kind, span};

pub use adapter::{Roller, RolloutTensors};
pub use weights::RolloutParameters;

use pass::Scratch;
use weights::Packs;

/// Sizes of a predictor and of what surrounds it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RolloutShape {
    /// Latents in a window at most.
    pub history: usize,
    /// Width of a latent.
    pub latent: usize,
    /// Width of an action chunk.
    pub action: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Width of an attention head.
    pub head_width: usize,
    /// Epsilon of the norms without scale and shift.
    pub plain_epsilon: f32,
    /// Epsilon of the norms with scale and shift.
    pub affine_epsilon: f32,
    /// Epsilon of the batch norm.
    pub batch_epsilon: f32,
}

/// Sequences that a thread takes at once, at most: their values fit its cache, and weights are read often enough.
const GROUP: usize = 96;

/// A predictor ready to roll.
#[derive(Debug)]
pub struct Rollout {
    shape: RolloutShape,
    packs: Packs,
    scratches: Mutex<Vec<Scratch>>,
}

impl Rollout {
    /// Arranges the weights.
    ///
    /// # Panics
    ///
    /// If sizes of parameters do not fit each other or the shape.
    pub fn new(shape: RolloutShape, parameters: &RolloutParameters<'_>) -> Rollout {
        assert!(!parameters.blocks.is_empty(), "rollout: expected at least one block");
        let packs = span(Kind::Packing, 0, || Packs::new(&shape, parameters));
        Rollout { shape, packs, scratches: Mutex::default() }
    }

    /// Writes the latents after each action from the last frame on: `output` [N, C - frames + 1, latent].
    ///
    /// `z` [N, frames, latent] are latents of real frames, `actions` [N, C, action] the chunks executed between them and
    /// those to try; C is at least `frames`.
    ///
    /// # Panics
    ///
    /// If sizes do not fit.
    pub fn run(&self, z: &[f32], actions: &[f32], [n, frames, chunks]: [usize; 3], output: &mut [f32]) {
        let RolloutShape { latent, action, .. } = self.shape;
        assert!(0 < frames && frames <= chunks, "rollout: expected at least one frame and as many chunks");
        let steps = chunks - frames + 1;
        assert_eq!(
            [z.len(), actions.len(), output.len()],
            [n * frames * latent, n * chunks * action, n * steps * latent],
            "rollout: sizes of latents, actions and output"
        );
        // As many groups for every thread, and all of about one size.
        let groups = n.div_ceil(GROUP).max(1).next_multiple_of(rayon::current_num_threads());
        let group = n.div_ceil(groups).max(1);
        let inputs = z.par_chunks(group * frames * latent).zip(actions.par_chunks(group * chunks * action));
        output.par_chunks_mut(group * steps * latent).zip(inputs).for_each(|(output, (z, actions))| {
            let taken = self.scratches.lock().unwrap_or_else(std::sync::PoisonError::into_inner).pop();
            let mut scratch = taken.unwrap_or_default();
            let n = z.len() / (frames * latent);
            let pass = pass::Pass { shape: &self.shape, packs: &self.packs, n, frames, chunks };
            pass.run(z, actions, output, &mut scratch);
            self.scratches.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(scratch);
        });
    }
}
