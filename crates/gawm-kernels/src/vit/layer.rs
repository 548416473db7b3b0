//! One layer of the transformer over a chunk: `x + Attn(LN(x))`, then `x + MLP(LN(x))`.

use super::VitShape;
use super::chunk::{Scratch, sized};
use super::products::{Matrix, Operands};
use super::weights::{CONTRACT, EXPAND, KEY, Layout, NORM_AFTER, NORM_BEFORE, OUTPUT, Packs, QUERY, VALUE};
use crate::attention::{Attention, AttentionGradients, AttentionInputs};
use crate::gelu::{gelu, gelu_backward};
use crate::gemm::{ACCUMULATE, Epilogue, STORE};
use crate::norm;
use crate::profile::{Kind, span};

/// Values of a layer that its backward pass reads. Rows: all tokens (`k`, `v`, the first norm) or the queries.
#[derive(Debug, Default)]
pub(super) struct LayerState {
    xhat_before: Vec<f32>,
    rstd_before: Vec<f32>,
    q: Vec<f32>,
    k: Vec<f32>,
    v: Vec<f32>,
    attended: Vec<f32>,
    log_sums: Vec<f32>,
    xhat_after: Vec<f32>,
    rstd_after: Vec<f32>,
    /// Before the GELU.
    expanded: Vec<f32>,
}

/// A pass of one layer over the images of a chunk.
pub(super) struct LayerPass<'a> {
    pub(super) shape: &'a VitShape,
    pub(super) packs: &'a Packs,
    pub(super) index: usize,
    /// Position of the layer's first parameter among all.
    pub(super) first: usize,
    pub(super) parameters: &'a [&'a [f32]],
    pub(super) images: usize,
    /// Tokens of an image whose output is needed: all, or the class token in the last layer.
    pub(super) queries: usize,
}

impl LayerPass<'_> {
    fn tokens(&self) -> usize {
        self.images * self.shape.tokens()
    }

    fn query_rows(&self) -> usize {
        self.images * self.queries
    }

    /// Distance between the rows of queries in a matrix of all tokens.
    fn query_stride(&self) -> usize {
        self.shape.width * (self.shape.tokens() / self.queries)
    }

    fn attention(&self) -> Attention {
        let VitShape { width, heads, .. } = *self.shape;
        Attention { queries: self.queries, keys: self.shape.tokens(), heads, head_width: width / heads }
    }

    /// Turns the residual stream of all tokens into that of the queries.
    pub(super) fn forward(&self, state: &mut LayerState, scratch: &mut Scratch) {
        let (w, f) = (self.shape.width, self.shape.mlp_width);
        let (tokens, rows) = (self.tokens(), self.query_rows());
        let x = sized(&mut scratch.x, tokens * w);
        let y = sized(&mut scratch.y, tokens * w);
        self.norm(NORM_BEFORE, x, &mut state.xhat_before, &mut state.rstd_before, y);
        self.linear(
            QUERY,
            [rows, w, w],
            Matrix { values: y, stride: self.query_stride() },
            sized(&mut state.q, rows * w),
            false,
            &mut scratch.operands,
        );
        for (layer, output) in [(KEY, &mut state.k), (VALUE, &mut state.v)] {
            let output = sized(output, tokens * w);
            let input = Matrix { values: y, stride: w };
            self.linear(layer, [tokens, w, w], input, output, false, &mut scratch.operands);
        }
        self.attend(state, scratch);

        let x = &mut scratch.x[..tokens * w];
        if self.queries == 1 {
            for image in 0..self.images {
                let start = image * self.query_stride();
                x.copy_within(start..start + w, image * w);
            }
        }
        let x = &mut x[..rows * w];
        self.linear(
            OUTPUT,
            [rows, w, w],
            Matrix { values: &state.attended, stride: w },
            x,
            true,
            &mut scratch.operands,
        );
        let y = &mut scratch.y[..rows * w];
        self.norm(NORM_AFTER, x, &mut state.xhat_after, &mut state.rstd_after, y);
        let expanded = sized(&mut state.expanded, rows * f);
        self.linear(
            EXPAND,
            [rows, f, w],
            Matrix { values: y, stride: w },
            expanded,
            false,
            &mut scratch.operands,
        );
        let hidden = sized(&mut scratch.hidden, rows * f);
        span(Kind::Gelu, 0, || gelu(expanded, hidden));
        self.linear(
            CONTRACT,
            [rows, w, f],
            Matrix { values: hidden, stride: f },
            x,
            true,
            &mut scratch.operands,
        );
    }

    fn attend(&self, state: &mut LayerState, scratch: &mut Scratch) {
        let (w, attention) = (self.shape.width, self.attention());
        let (queries, keys) = (self.queries * w, self.shape.tokens() * w);
        let sums = self.shape.heads * self.queries;
        let output = sized(&mut state.attended, self.images * queries).chunks_exact_mut(queries);
        let log_sums = sized(&mut state.log_sums, self.images * sums).chunks_exact_mut(sums);
        span(Kind::AttentionForward, self.images * attention.operations(), || {
            for (image, (output, log_sums)) in output.zip(log_sums).enumerate() {
                let (q, k) = (image * queries, image * keys);
                let inputs = AttentionInputs {
                    q: &state.q[q..q + queries],
                    k: &state.k[k..k + keys],
                    v: &state.v[k..k + keys],
                };
                attention.forward(inputs, output, log_sums, &mut scratch.attention);
            }
        });
    }

    /// Turns the gradient of the queries' residual stream into that of all tokens, and adds the layer's to `sums`.
    pub(super) fn backward(
        &self,
        state: &mut LayerState,
        layout: &Layout,
        sums: &mut [f32],
        scratch: &mut Scratch,
    ) {
        self.mlp_backward(state, layout, sums, scratch);
        self.attend_backward(state, layout, sums, scratch);
        let (w, tokens, rows) = (self.shape.width, self.tokens(), self.query_rows());
        let y = sized(&mut scratch.y, tokens * w);
        let xhat = &state.xhat_before[..tokens * w];
        span(Kind::Norm, 0, || {
            norm::scale_shift(xhat, self.parameters[NORM_BEFORE], self.parameters[NORM_BEFORE + 1], y)
        });
        self.weight_gradient(
            QUERY,
            [rows, w, w],
            &scratch.q,
            Matrix { values: y, stride: self.query_stride() },
            layout,
            sums,
            &mut scratch.operands,
        );
        self.weight_gradient(
            KEY,
            [tokens, w, w],
            &scratch.k,
            Matrix { values: y, stride: w },
            layout,
            sums,
            &mut scratch.operands,
        );
        self.weight_gradient(
            VALUE,
            [tokens, w, w],
            &scratch.v,
            Matrix { values: y, stride: w },
            layout,
            sums,
            &mut scratch.operands,
        );
        self.input_gradient(KEY, [tokens, w, w], &scratch.k, (y, w), STORE, &mut scratch.operands);
        self.input_gradient(VALUE, [tokens, w, w], &scratch.v, (y, w), ACCUMULATE, &mut scratch.operands);
        self.input_gradient(
            QUERY,
            [rows, w, w],
            &scratch.q,
            (y, self.query_stride()),
            ACCUMULATE,
            &mut scratch.operands,
        );

        let dx = sized(&mut scratch.x, tokens * w);
        if self.queries == 1 {
            self.spread(dx);
        }
        self.norm_backward(
            NORM_BEFORE,
            &mut scratch.y[..tokens * w],
            xhat,
            &state.rstd_before,
            dx,
            layout,
            sums,
        );
    }

    /// Moves rows of class tokens to their places among all tokens; the others are zero.
    fn spread(&self, dx: &mut [f32]) {
        let (w, stride) = (self.shape.width, self.query_stride());
        for image in (0..self.images).rev() {
            dx.copy_within(image * w..(image + 1) * w, image * stride);
            dx[image * stride + w..(image + 1) * stride].fill(0.0);
        }
    }

    fn mlp_backward(&self, state: &LayerState, layout: &Layout, sums: &mut [f32], scratch: &mut Scratch) {
        let (w, f, rows) = (self.shape.width, self.shape.mlp_width, self.query_rows());
        let dx = &mut scratch.x[..rows * w];
        let hidden = sized(&mut scratch.hidden, rows * f);
        let d_hidden = sized(&mut scratch.d_hidden, rows * f);
        self.input_gradient(CONTRACT, [rows, w, f], dx, (d_hidden, f), STORE, &mut scratch.operands);
        span(Kind::Gelu, 0, || gelu_backward(&state.expanded[..rows * f], hidden, d_hidden));
        self.weight_gradient(
            CONTRACT,
            [rows, w, f],
            dx,
            Matrix { values: hidden, stride: f },
            layout,
            sums,
            &mut scratch.operands,
        );
        let y = sized(&mut scratch.y, rows * w);
        let xhat = &state.xhat_after[..rows * w];
        span(Kind::Norm, 0, || {
            norm::scale_shift(xhat, self.parameters[NORM_AFTER], self.parameters[NORM_AFTER + 1], y)
        });
        self.weight_gradient(
            EXPAND,
            [rows, f, w],
            d_hidden,
            Matrix { values: y, stride: w },
            layout,
            sums,
            &mut scratch.operands,
        );
        self.input_gradient(EXPAND, [rows, f, w], d_hidden, (y, w), STORE, &mut scratch.operands);
        self.norm_backward(NORM_AFTER, y, xhat, &state.rstd_after, dx, layout, sums);
    }

    fn attend_backward(&self, state: &LayerState, layout: &Layout, sums: &mut [f32], scratch: &mut Scratch) {
        let (w, attention) = (self.shape.width, self.attention());
        let (tokens, rows) = (self.tokens(), self.query_rows());
        let (queries, keys) = (self.queries * w, self.shape.tokens() * w);
        let n_sums = self.shape.heads * self.queries;
        let dx = &scratch.x[..rows * w];
        let d_attended = sized(&mut scratch.attended, rows * w);
        self.weight_gradient(
            OUTPUT,
            [rows, w, w],
            dx,
            Matrix { values: &state.attended, stride: w },
            layout,
            sums,
            &mut scratch.operands,
        );
        self.input_gradient(OUTPUT, [rows, w, w], dx, (d_attended, w), STORE, &mut scratch.operands);
        let (dq, dk, dv) = (
            sized(&mut scratch.q, rows * w),
            sized(&mut scratch.k, tokens * w),
            sized(&mut scratch.v, tokens * w),
        );
        // Five products where forward has two.
        span(Kind::AttentionBackward, self.images * attention.operations() * 5 / 2, || {
            for image in 0..self.images {
                let (q, k, s) = (image * queries, image * keys, image * n_sums);
                let inputs = AttentionInputs {
                    q: &state.q[q..q + queries],
                    k: &state.k[k..k + keys],
                    v: &state.v[k..k + keys],
                };
                let outputs = (&state.attended[q..q + queries], &state.log_sums[s..s + n_sums]);
                let mut gradients = AttentionGradients {
                    q: &mut dq[q..q + queries],
                    k: &mut dk[k..k + keys],
                    v: &mut dv[k..k + keys],
                };
                let d_output = &d_attended[q..q + queries];
                attention.backward(inputs, outputs, d_output, &mut gradients, &mut scratch.attention);
            }
        });
    }

    /// Normalises, scales and shifts; keeps what the backward pass needs.
    fn norm(&self, which: usize, x: &[f32], xhat: &mut Vec<f32>, rstd: &mut Vec<f32>, y: &mut [f32]) {
        let w = self.shape.width;
        let xhat = sized(xhat, x.len());
        span(Kind::Norm, 0, || {
            norm::normalize(x, w, self.shape.epsilon, xhat, sized(rstd, x.len() / w));
            norm::scale_shift(xhat, self.parameters[which], self.parameters[which + 1], y);
        });
    }

    /// Adds the gradient of a norm's input to `dx`, overwriting `dy`.
    #[expect(
        clippy::too_many_arguments,
        reason = "the three buffers of a norm, its place, and where gradients go"
    )]
    fn norm_backward(
        &self,
        which: usize,
        dy: &mut [f32],
        xhat: &[f32],
        rstd: &[f32],
        dx: &mut [f32],
        layout: &Layout,
        sums: &mut [f32],
    ) {
        span(Kind::Norm, 0, || {
            let (d_weight, d_bias) = layout.pair(sums, self.first + which);
            norm::scale_shift_backward(dy, xhat, d_weight, d_bias);
            norm::normalize_backward(dy, xhat, rstd, self.parameters[which], dx);
        });
    }

    /// `out = x W^T + b`, or added to `out`; sizes are [rows, outputs, inputs].
    fn linear(
        &self,
        which: usize,
        sizes: [usize; 3],
        x: Matrix<'_>,
        out: &mut [f32],
        add: bool,
        operands: &mut Operands,
    ) {
        let [rows, outputs, inputs] = sizes;
        let epilogue = Epilogue { accumulate: add, bias: Some(self.parameters[which + 1]) };
        span(Kind::LinearForward, 2 * rows * outputs * inputs, || {
            let weight = self.packs.linear(self.index, which);
            operands.by_weight(self.shape.products, sizes, x, weight, (out, outputs), epilogue);
        });
    }

    /// `dx = dy W`, or added to `dx`, whose rows are `stride` apart; sizes are [rows, outputs, inputs].
    fn input_gradient(
        &self,
        which: usize,
        [rows, outputs, inputs]: [usize; 3],
        dy: &[f32],
        dx: (&mut [f32], usize),
        epilogue: Epilogue<'_>,
        operands: &mut Operands,
    ) {
        let dy = Matrix { values: dy, stride: outputs };
        span(Kind::LinearInputGradient, 2 * rows * outputs * inputs, || {
            let weight = self.packs.linear(self.index, which);
            operands.by_weight(self.shape.products, [rows, inputs, outputs], dy, weight, dx, epilogue);
        });
    }

    /// Adds `dy^T x` and the columns of `dy` to the sums; sizes as above.
    #[expect(clippy::too_many_arguments, reason = "both factors, their sizes, and where gradients go")]
    fn weight_gradient(
        &self,
        which: usize,
        [rows, outputs, inputs]: [usize; 3],
        dy: &[f32],
        x: Matrix<'_>,
        layout: &Layout,
        sums: &mut [f32],
        operands: &mut Operands,
    ) {
        let (d_weight, d_bias) = layout.pair(sums, self.first + which);
        span(Kind::LinearWeightGradient, 2 * rows * outputs * inputs, || {
            let dy = Matrix { values: dy, stride: outputs };
            operands.of_weight(self.shape.products, [rows, outputs, inputs], dy, x, d_weight);
        });
        span(Kind::ColumnSums, 0, || norm::add_columns(&dy[..rows * outputs], d_bias));
    }
}
