//! A block of the predictor, forward.

use rayon::prelude::*;

use super::PredictorShape;
use super::rows::{self, Modulation, NormState};
use crate::gelu::gelu;
use crate::norm;
use crate::profile::{Kind, span};
use crate::rows::over_rows;

/// Factors of dropout in a block: 0 or 1 / (1 - rate), one for each value.
#[derive(Debug, Clone)]
pub struct BlockMasks {
    /// Of the attention probabilities, [clips, heads, frames, frames].
    pub probabilities: Vec<f32>,
    /// Of what attention adds, [clips, frames, latent].
    pub attention: Vec<f32>,
    /// Of the hidden values of the MLP, [clips, frames, MLP width].
    pub hidden: Vec<f32>,
    /// Of what the MLP adds, [clips, frames, latent].
    pub mlp: Vec<f32>,
}

/// Place of a parameter among those of a block.
pub(super) const MODULATION: usize = 0;
pub(super) const ATTENTION_NORM: usize = 2;
pub(super) const QKV: usize = 4;
pub(super) const OUTPUT: usize = 5;
pub(super) const MLP_NORM: usize = 7;
pub(super) const EXPAND: usize = 9;
pub(super) const CONTRACT: usize = 11;

/// What the forward pass of a block keeps.
#[derive(Debug)]
pub(super) struct BlockState {
    /// Shifts, scales and gates, [rows, 6 latent].
    pub(super) modulation: Vec<f32>,
    pub(super) before: NormState,
    pub(super) qkv: Vec<f32>,
    /// Probabilities before dropout.
    pub(super) weights: Vec<f32>,
    pub(super) attended: Vec<f32>,
    /// What attention adds, before its gate.
    pub(super) attention: Vec<f32>,
    pub(super) after: NormState,
    /// Before the GELU.
    pub(super) expanded: Vec<f32>,
    /// What the MLP adds, before its gate.
    pub(super) mlp: Vec<f32>,
}

pub(super) struct BlockPass<'a> {
    pub(super) shape: &'a PredictorShape,
    pub(super) parameters: &'a [&'a [f32]],
    /// SiLU of the embedded actions.
    pub(super) modulation: &'a [f32],
    pub(super) masks: Option<&'a BlockMasks>,
}

impl BlockPass<'_> {
    /// Shift, scale and gate of the first or the second half of the block.
    pub(super) fn half<'m>(&self, modulation: &'m [f32], second: bool) -> Modulation<'m> {
        let d = self.shape.latent;
        Modulation { values: modulation, stride: 6 * d, first: if second { 3 * d } else { 0 } }
    }

    /// Turns the residual stream into that after the block.
    pub(super) fn forward(&self, x: &mut [f32]) -> BlockState {
        let (shape, d) = (self.shape, self.shape.latent);
        let biased = |which: usize, outputs: usize, inputs: usize, x: &[f32]| {
            let (weight, bias) = (self.parameters[which], self.parameters[which + 1]);
            shape.linear(outputs, inputs).forward(x, weight, Some(bias))
        };
        let modulation = biased(MODULATION, 6 * d, d, self.modulation);
        let (before, y) = self.norm(x, self.half(&modulation, false), ATTENTION_NORM);
        let qkv = shape.linear(3 * shape.inner(), d).forward(&y, self.parameters[QKV], None);
        let (weights, attended) = self.attend(&qkv);
        let mut attention = biased(OUTPUT, d, shape.inner(), &attended);
        span(Kind::Pointwise, 0, || {
            if let Some(masks) = self.masks {
                rows::multiply(&masks.attention, &mut attention);
            }
            rows::add_gated(&attention, d, self.half(&modulation, false), x);
        });
        let (after, y) = self.norm(x, self.half(&modulation, true), MLP_NORM);
        let expanded = biased(EXPAND, shape.mlp_width, d, &y);
        let mut mlp = biased(CONTRACT, d, shape.mlp_width, &self.activate(&expanded));
        span(Kind::Pointwise, 0, || {
            if let Some(masks) = self.masks {
                rows::multiply(&masks.mlp, &mut mlp);
            }
            rows::add_gated(&mlp, d, self.half(&modulation, true), x);
        });
        BlockState { modulation, before, qkv, weights, attended, attention, after, expanded, mlp }
    }

    /// The two norms of a half block, and what they give.
    fn norm(&self, x: &[f32], modulation: Modulation<'_>, which: usize) -> (NormState, Vec<f32>) {
        let d = self.shape.latent;
        let mut state = NormState::new(self.shape.rows(), d);
        let epsilons = [self.shape.plain_epsilon, self.shape.affine_epsilon];
        span(Kind::Norm, 0, || rows::modulated_norm(x, d, modulation, epsilons, &mut state));
        let y = self.affine(&state, which);
        (state, y)
    }

    /// The output of a norm with scale and shift.
    pub(super) fn affine(&self, state: &NormState, which: usize) -> Vec<f32> {
        let mut y = vec![0.0; state.affine.len()];
        let (weight, bias) = (self.parameters[which], self.parameters[which + 1]);
        span(Kind::Norm, 0, || norm::scale_shift(&state.affine, weight, bias, &mut y));
        y
    }

    /// Probabilities before dropout, and what the heads read.
    fn attend(&self, qkv: &[f32]) -> (Vec<f32>, Vec<f32>) {
        let PredictorShape { clips, frames, heads, head_width, .. } = *self.shape;
        let (inner, table) = (self.shape.inner(), heads * frames * frames);
        let (mut weights, mut attended) = (vec![0.0; clips * table], vec![0.0; clips * frames * inner]);
        let outputs = weights.par_chunks_mut(table).zip(attended.par_chunks_mut(frames * inner));
        let clips =
            outputs.zip(qkv.par_chunks(3 * frames * inner)).enumerate().with_min_len(self.min_clips());
        clips.for_each(|(clip, ((weights, attended), qkv))| {
            let mask = self.masks.map_or(&[][..], |masks| &masks.probabilities[clip * table..][..table]);
            span(Kind::AttentionForward, self.operations(), || {
                rows::attend(qkv, [heads, head_width], mask, weights, attended);
            });
        });
        (weights, attended)
    }

    /// Clips that are worth a thread.
    pub(super) fn min_clips(&self) -> usize {
        (16 * 1024 / (self.shape.frames * self.shape.frames * self.shape.inner())).max(1)
    }

    /// Floating-point operations of the attention of a clip, forward.
    pub(super) fn operations(&self) -> usize {
        2 * self.shape.frames * (self.shape.frames + 1) * self.shape.inner()
    }

    /// GELU and dropout.
    fn activate(&self, expanded: &[f32]) -> Vec<f32> {
        let (mut hidden, width) = (vec![0.0; expanded.len()], self.shape.mlp_width);
        over_rows(&mut hidden, width, |first, rows| {
            let part = first * width..first * width + rows.len();
            span(Kind::Gelu, 0, || {
                gelu(&expanded[part.clone()], rows);
                if let Some(masks) = self.masks {
                    rows::multiply(&masks.hidden[part], rows);
                }
            });
        });
        hidden
    }
}
