//! The predictor in training: a causal transformer over a few tokens per clip, modulated by the actions.
//!
//! ```text
//! [shift1, scale1, gate1, shift2, scale2, gate2] = W SiLU(c) + b
//! x = x + gate1 * drop(Attn(LN(LN0(x) * (1 + scale1) + shift1)))
//! x = x + gate2 * drop( MLP(LN(LN0(x) * (1 + scale2) + shift2)))
//! ```
//!
//! Unlike the encoder it has few tokens and many weights, so that products are split over threads by weights
//! ([`crate::linear`]) and what lies between them is done row by row in single passes. Dropout masks come from the caller,
//! which draws them from its counters.

mod adapter;
mod backward;
mod block;
mod rows;

use crate::linear::LinearShape;
use crate::norm;
use crate::profile::{Kind, span};

pub use adapter::Predictor;
pub use block::BlockMasks;

use block::{BlockPass, BlockState};

/// Sizes of a predictor and of what it is given.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PredictorShape {
    /// Number of clips.
    pub clips: usize,
    /// Tokens of a clip; at least 1 and at most as many as there are positions.
    pub frames: usize,
    /// Width of a token.
    pub latent: usize,
    /// Number of attention heads.
    pub heads: usize,
    /// Width of a head.
    pub head_width: usize,
    /// Hidden width of the MLPs.
    pub mlp_width: usize,
    /// Epsilon of the norms without scale and shift.
    pub plain_epsilon: f32,
    /// Epsilon of the norms with scale and shift.
    pub affine_epsilon: f32,
}

/// Parameters outside the blocks, first in order: position table [positions, latent], weight and bias of the last norm.
pub const OUTER_PARAMETERS: usize = 3;
/// Parameters of a block: weight and bias of the modulation, of the norm before attention, weight of q, k, v together (no
/// bias), weight and bias of the output, of the norm before the MLP, of its expansion and its contraction.
pub const BLOCK_PARAMETERS: usize = 13;

/// What a forward pass keeps.
#[derive(Debug)]
pub struct PredictorState {
    /// SiLU of the embedded actions.
    modulation: Vec<f32>,
    blocks: Vec<BlockState>,
    xhat: Vec<f32>,
    rstd: Vec<f32>,
}

/// The gradients of a backward pass.
#[derive(Debug)]
pub struct PredictorGradients {
    /// Of the latents, [clips, frames, latent].
    pub z: Vec<f32>,
    /// Of the embedded actions, in the same shape.
    pub c: Vec<f32>,
    /// Of the parameters, in their order.
    pub parameters: Vec<Vec<f32>>,
}

impl PredictorShape {
    /// Number of tokens.
    fn rows(&self) -> usize {
        self.clips * self.frames
    }

    /// Width of all heads.
    fn inner(&self) -> usize {
        self.heads * self.head_width
    }

    fn linear(&self, outputs: usize, inputs: usize) -> LinearShape {
        LinearShape { rows: self.rows(), outputs, inputs }
    }

    /// Maps latents `z` under embedded actions `c`, both [clips, frames, latent], to an output of the same shape.
    ///
    /// `parameters` are those of [`OUTER_PARAMETERS`] and of each block ([`BLOCK_PARAMETERS`]) in the order given there.
    /// `masks` holds one element per block, or none for a pass without dropout.
    ///
    /// # Panics
    ///
    /// If a slice has not the size that the shape says.
    pub fn forward(
        &self,
        z: &[f32],
        c: &[f32],
        parameters: &[&[f32]],
        masks: &[BlockMasks],
    ) -> (Vec<f32>, PredictorState) {
        let (outer, blocks) = parameters.split_at(OUTER_PARAMETERS);
        let window = self.frames * self.latent;
        assert_eq!([z.len(), c.len()], [self.clips * window; 2], "predictor: size of latents and actions");
        let (mut x, mut modulation) = (z.to_vec(), c.to_vec());
        span(Kind::Pointwise, 0, || {
            x.chunks_exact_mut(window).for_each(|x| norm::add(&outer[0][..window], x));
            rows::silu(&mut modulation);
        });
        let blocks = blocks.chunks_exact(BLOCK_PARAMETERS).enumerate().map(|(index, parameters)| {
            let pass =
                BlockPass { shape: self, parameters, modulation: &modulation, masks: masks.get(index) };
            pass.forward(&mut x)
        });
        let blocks = blocks.collect();
        let (mut xhat, mut rstd) = (vec![0.0; x.len()], vec![0.0; self.rows()]);
        span(Kind::Norm, 0, || {
            norm::normalize(&x, self.latent, self.affine_epsilon, &mut xhat, &mut rstd);
            norm::scale_shift(&xhat, outer[1], outer[2], &mut x);
        });
        (x, PredictorState { modulation, blocks, xhat, rstd })
    }

    /// Returns the gradients, given that of the output, [clips, frames, latent].
    ///
    /// The other arguments are those of the forward pass that returned `state`.
    ///
    /// # Panics
    ///
    /// If a slice has not the size that the shape says.
    pub fn backward(
        &self,
        c: &[f32],
        parameters: &[&[f32]],
        masks: &[BlockMasks],
        state: PredictorState,
        d_output: &[f32],
    ) -> PredictorGradients {
        let (outer, blocks) = parameters.split_at(OUTER_PARAMETERS);
        let (d, window) = (self.latent, self.frames * self.latent);
        let PredictorState { modulation, blocks: states, xhat, rstd } = state;
        let (mut d_weight, mut d_bias) = (vec![0.0; d], vec![0.0; d]);
        let mut dx = vec![0.0; d_output.len()];
        span(Kind::Norm, 0, || {
            norm::scale_shift_backward(d_output, &xhat, &mut d_weight, &mut d_bias);
            norm::normalize_backward(&mut d_output.to_vec(), &xhat, &rstd, outer[1], &mut dx);
        });
        let mut d_modulation = vec![0.0; modulation.len()];
        let mut of_blocks = Vec::with_capacity(states.len());
        for (index, (parameters, state)) in
            blocks.chunks_exact(BLOCK_PARAMETERS).zip(states).enumerate().rev()
        {
            let pass =
                BlockPass { shape: self, parameters, modulation: &modulation, masks: masks.get(index) };
            of_blocks.push(pass.backward(state, &mut dx, &mut d_modulation));
        }
        let mut d_positions = vec![0.0; outer[0].len()];
        span(Kind::Pointwise, 0, || {
            dx.chunks_exact(window).for_each(|dx| norm::add(dx, &mut d_positions[..window]));
            rows::silu_backward(c, &mut d_modulation);
        });
        let mut parameters = vec![d_positions, d_weight, d_bias];
        parameters.extend(of_blocks.into_iter().rev().flatten());
        PredictorGradients { z: dx, c: d_modulation, parameters }
    }
}
