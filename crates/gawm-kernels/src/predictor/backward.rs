//! A block of the predictor, backward.

use rayon::prelude::*;

use super::block::{
    ATTENTION_NORM, BlockMasks, BlockPass, BlockState, CONTRACT, EXPAND, MLP_NORM, MODULATION, OUTPUT, QKV,
};
use super::rows::{self, Modulation, NormState};
use super::{BLOCK_PARAMETERS, PredictorShape};
use crate::gelu::gelu_backward;
use crate::head::column_sums;
use crate::norm;
use crate::profile::{Kind, span};
use crate::rows::over_two;

/// The gradients of a block's parameters.
type Gradients = [Vec<f32>; BLOCK_PARAMETERS];

impl BlockPass<'_> {
    /// Turns the gradient of the residual stream after the block into that before it, adds that of the modulating input,
    /// and returns those of the parameters.
    pub(super) fn backward(&self, state: BlockState, dx: &mut [f32], d_input: &mut [f32]) -> Gradients {
        let (shape, d) = (self.shape, self.shape.latent);
        let BlockState { modulation, before, qkv, weights, attended, attention, after, expanded, mlp } =
            state;
        let mask = |which: fn(&BlockMasks) -> &Vec<f32>| self.masks.map(|masks| which(masks).as_slice());
        let mut gradients = Gradients::default();
        let mut d_modulation = vec![0.0; modulation.len()];

        let (first, second) = (self.half(&modulation, false), self.half(&modulation, true));
        let dy = self.gate_backward(dx, second, mlp, mask(|masks| &masks.mlp), &mut d_modulation);
        let dy = self.mlp_backward(dy, &after, expanded, &mut gradients);
        self.norm_backward(dy, MLP_NORM, second, &after, &mut d_modulation, dx, &mut gradients);

        let dy = self.gate_backward(dx, first, attention, mask(|masks| &masks.attention), &mut d_modulation);
        let d_attended = self.linear_backward(OUTPUT, [d, shape.inner()], &dy, &attended, &mut gradients);
        let d_qkv = self.attend_backward(&qkv, &weights, &d_attended);
        let linear = shape.linear(3 * shape.inner(), d);
        gradients[QKV] = linear.weight_gradient(&d_qkv, &self.affine(&before, ATTENTION_NORM));
        let dy = linear.input_gradient(&d_qkv, self.parameters[QKV]);
        self.norm_backward(dy, ATTENTION_NORM, first, &before, &mut d_modulation, dx, &mut gradients);

        let d_silu =
            self.linear_backward(MODULATION, [6 * d, d], &d_modulation, self.modulation, &mut gradients);
        norm::add(&d_silu, d_input);
        gradients
    }

    /// Returns the gradient of `x` of a linear layer of sizes [outputs, inputs], and keeps those of weight and bias.
    fn linear_backward(
        &self,
        which: usize,
        [outputs, inputs]: [usize; 2],
        dy: &[f32],
        x: &[f32],
        gradients: &mut Gradients,
    ) -> Vec<f32> {
        let linear = self.shape.linear(outputs, inputs);
        gradients[which] = linear.weight_gradient(dy, x);
        gradients[which + 1] = column_sums(dy, outputs);
        linear.input_gradient(dy, self.parameters[which])
    }

    /// Turns what a half block adds into its gradient, through its gate and its dropout.
    fn gate_backward(
        &self,
        dx: &[f32],
        modulation: Modulation<'_>,
        mut added: Vec<f32>,
        mask: Option<&[f32]>,
        d_modulation: &mut [f32],
    ) -> Vec<f32> {
        span(Kind::Pointwise, 0, || {
            rows::gate_backward(dx, self.shape.latent, modulation, &mut added, d_modulation);
            if let Some(mask) = mask {
                rows::multiply(mask, &mut added);
            }
        });
        added
    }

    /// Adds the gradient of the residual stream through both norms to `dx`, given that of their output.
    #[expect(
        clippy::too_many_arguments,
        reason = "what the norms kept, what modulated them, and where gradients go"
    )]
    fn norm_backward(
        &self,
        mut dy: Vec<f32>,
        which: usize,
        modulation: Modulation<'_>,
        state: &NormState,
        d_modulation: &mut [f32],
        dx: &mut [f32],
        gradients: &mut Gradients,
    ) {
        let d = self.shape.latent;
        span(Kind::Norm, 0, || {
            let (mut d_weight, mut d_bias) = (vec![0.0; d], vec![0.0; d]);
            norm::scale_shift_backward(&dy, &state.affine, &mut d_weight, &mut d_bias);
            let mut du = vec![0.0; dy.len()];
            norm::normalize_backward(
                &mut dy,
                &state.affine,
                &state.affine_rstd,
                self.parameters[which],
                &mut du,
            );
            rows::modulate_backward(&mut du, d, modulation, state, d_modulation, dx);
            (gradients[which], gradients[which + 1]) = (d_weight, d_bias);
        });
    }

    /// Takes the gradient of the MLP's output to that of its input.
    fn mlp_backward(
        &self,
        dy: Vec<f32>,
        after: &NormState,
        expanded: Vec<f32>,
        gradients: &mut Gradients,
    ) -> Vec<f32> {
        let (d, width) = (self.shape.latent, self.shape.mlp_width);
        let contract = self.shape.linear(d, width);
        let mut d_hidden = contract.input_gradient(&dy, self.parameters[CONTRACT]);
        let mut hidden = vec![0.0; expanded.len()];
        over_two(&mut d_hidden, &mut hidden, width, |first, d_hidden, hidden| {
            let part = first * width..first * width + hidden.len();
            span(Kind::Gelu, 0, || {
                let mask = self.masks.map(|masks| &masks.hidden[part.clone()]);
                if let Some(mask) = mask {
                    rows::multiply(mask, d_hidden);
                }
                gelu_backward(&expanded[part], hidden, d_hidden);
                if let Some(mask) = mask {
                    rows::multiply(mask, hidden);
                }
            });
        });
        gradients[CONTRACT] = contract.weight_gradient(&dy, &hidden);
        gradients[CONTRACT + 1] = column_sums(&dy, d);
        self.linear_backward(EXPAND, [width, d], &d_hidden, &self.affine(after, MLP_NORM), gradients)
    }

    fn attend_backward(&self, qkv: &[f32], weights: &[f32], d_attended: &[f32]) -> Vec<f32> {
        let PredictorShape { frames, heads, head_width, .. } = *self.shape;
        let (inner, table) = (self.shape.inner(), heads * frames * frames);
        let mut d_qkv = vec![0.0; qkv.len()];
        let inputs = qkv.par_chunks(3 * frames * inner).zip(weights.par_chunks(table));
        let clips =
            d_qkv.par_chunks_mut(3 * frames * inner).zip(inputs).zip(d_attended.par_chunks(frames * inner));
        let clips = clips.enumerate().with_min_len(self.min_clips());
        clips.for_each(|(clip, ((d_qkv, (qkv, weights)), d_output))| {
            let mask = self.masks.map_or(&[][..], |masks| &masks.probabilities[clip * table..][..table]);
            span(Kind::AttentionBackward, self.operations() * 5 / 2, || {
                rows::attend_backward(qkv, [heads, head_width], mask, weights, d_output, d_qkv);
            });
        });
        d_qkv
    }
}
