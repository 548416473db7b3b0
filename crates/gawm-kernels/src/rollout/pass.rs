//! The roll-out of a group of sequences on one thread.

use super::RolloutShape;
use super::weights::{Block, Heads, Linear, Mlp, Norm, Packs};
use crate::gelu::gelu_in_place;
use crate::gemm::{Epilogue, Lhs, Rhs, gemm};
use crate::norm;
use crate::profile::{Kind, span};
use crate::simd::{dot, exp, mul_add, vectorized};

/// Memory of one thread.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// Latents of real frames and those rolled so far, [n, chunks + 1, latent].
    latents: Vec<f32>,
    /// SiLU of the embedded actions, [n, chunks, latent].
    embedded: Vec<f32>,
    /// Of each block, [n, chunks, 6 latent]: shift, scale, gate of attention, then of the MLP.
    modulations: Vec<Vec<f32>>,
    /// Of each block and group of heads, [n, history, columns of the group].
    keys: Vec<Vec<Vec<f32>>>,
    values: Vec<Vec<Vec<f32>>>,
    x: Vec<f32>,
    y: Vec<f32>,
    z: Vec<f32>,
    rstd: Vec<f32>,
    hidden: Vec<f32>,
    q: Vec<f32>,
    fresh: Vec<f32>,
    added: Vec<f32>,
}

/// Returns the first `count` elements, growing the vector where it is shorter.
fn sized(vector: &mut Vec<f32>, count: usize) -> &mut [f32] {
    if vector.len() < count {
        vector.resize(count, 0.0);
    }
    &mut vector[..count]
}

pub(super) struct Pass<'a> {
    pub(super) shape: &'a RolloutShape,
    pub(super) packs: &'a Packs,
    pub(super) n: usize,
    pub(super) frames: usize,
    pub(super) chunks: usize,
}

/// Tokens of a window that are computed: positions `first..first + count` of `start..`, for every sequence.
#[derive(Clone, Copy)]
struct Tokens {
    /// First latent of the window.
    start: usize,
    /// First position computed; those before it have keys and values.
    first: usize,
    count: usize,
}

impl Pass<'_> {
    pub(super) fn run(&self, z: &[f32], actions: &[f32], output: &mut [f32], scratch: &mut Scratch) {
        let (d, n) = (self.shape.latent, self.n);
        self.embed(actions, scratch);
        let latents = sized(&mut scratch.latents, n * (self.chunks + 1) * d);
        let of_frames = z.chunks_exact(self.frames * d);
        for (latents, z) in latents.chunks_exact_mut((self.chunks + 1) * d).zip(of_frames) {
            latents[..z.len()].copy_from_slice(z);
        }
        // Positions that have keys and values of the window that begins at `cached.0`.
        let mut cached = (usize::MAX, 0);
        for end in self.frames..=self.chunks {
            let start = end.saturating_sub(self.shape.history);
            let first = if cached.0 == start { cached.1 } else { 0 };
            let tokens = Tokens { start, first, count: end - start - first };
            self.step(tokens, scratch);
            cached = (start, end - start);
        }
        let steps = self.chunks - self.frames + 1;
        let latents = scratch.latents.chunks_exact((self.chunks + 1) * d);
        for (output, latents) in output.chunks_exact_mut(steps * d).zip(latents) {
            output.copy_from_slice(&latents[self.frames * d..]);
        }
    }

    /// Embeds the actions and computes the modulations of all blocks.
    fn embed(&self, actions: &[f32], scratch: &mut Scratch) {
        let rows = self.n * self.chunks;
        let [a, b, c] = &self.packs.embedder;
        let x = sized(&mut scratch.x, rows * a.outputs);
        linear(a, actions, [rows, a.inputs], x, false);
        let hidden = sized(&mut scratch.hidden, rows * b.outputs);
        linear(b, x, [rows, b.inputs], hidden, false);
        span(Kind::Gelu, 0, || silu(hidden));
        let embedded = sized(&mut scratch.embedded, rows * c.outputs);
        linear(c, hidden, [rows, c.inputs], embedded, false);
        silu(embedded);
        let n_blocks = self.packs.blocks.len();
        scratch.modulations.resize_with(n_blocks, Vec::new);
        for caches in [&mut scratch.keys, &mut scratch.values] {
            caches.resize_with(n_blocks, Vec::new);
        }
        for (index, block) in self.packs.blocks.iter().enumerate() {
            let modulation = sized(&mut scratch.modulations[index], rows * block.modulation.outputs);
            linear(&block.modulation, embedded, [rows, block.modulation.inputs], modulation, false);
            for caches in [&mut scratch.keys[index], &mut scratch.values[index]] {
                caches.resize_with(block.heads.len(), Vec::new);
                for (cache, heads) in caches.iter_mut().zip(&block.heads) {
                    sized(cache, self.n * self.shape.history * heads.k.outputs);
                }
            }
        }
    }

    /// Computes the latent that follows the window.
    fn step(&self, tokens: Tokens, scratch: &mut Scratch) {
        let (d, n) = (self.shape.latent, self.n);
        let x = sized(&mut scratch.x, n * tokens.count * d);
        let all = scratch.latents.chunks_exact((self.chunks + 1) * d);
        for (x, latents) in x.chunks_exact_mut(tokens.count * d).zip(all) {
            let from = (tokens.start + tokens.first) * d;
            x.copy_from_slice(&latents[from..from + x.len()]);
            norm::add(&self.packs.positions[tokens.first * d..][..x.len()], x);
        }
        for (index, block) in self.packs.blocks.iter().enumerate() {
            let is_last = index + 1 == self.packs.blocks.len();
            self.block(index, block, tokens, if is_last { 1 } else { tokens.count }, scratch);
        }
        self.project(tokens, scratch);
    }

    /// One block; of its output only the last `kept` tokens of each sequence, which is all of them or one.
    fn block(&self, index: usize, block: &Block, tokens: Tokens, kept: usize, scratch: &mut Scratch) {
        let (d, n, count) = (self.shape.latent, self.n, tokens.count);
        let y = sized(&mut scratch.y, n * count * d);
        self.modulated_norm(&scratch.x, &scratch.modulations[index], (tokens, count), 0, &block.attn_norm, y);
        sized(&mut scratch.added, n * kept * d);
        for (group, heads) in block.heads.iter().enumerate() {
            self.attend([index, group], heads, tokens, kept, scratch);
        }
        if kept < count {
            for sequence in 0..n {
                let from = (sequence * count + count - 1) * d;
                scratch.x.copy_within(from..from + d, sequence * d);
            }
        }
        let x = &mut scratch.x[..n * kept * d];
        let y = &mut scratch.y[..n * kept * d];
        self.add_gated(&scratch.added[..n * kept * d], &scratch.modulations[index], (tokens, kept), 2, x);
        self.modulated_norm(x, &scratch.modulations[index], (tokens, kept), 3, &block.mlp_norm, y);
        mlp(&block.mlp, y, n * kept, &mut scratch.hidden, &mut scratch.z);
        let y = &scratch.z[..n * kept * d];
        self.add_gated(y, &scratch.modulations[index], (tokens, kept), 5, x);
    }

    /// Adds what a group of heads reads for the last `kept` tokens of each sequence; the first group overwrites.
    fn attend(
        &self,
        [block, group]: [usize; 2],
        heads: &Heads,
        tokens: Tokens,
        kept: usize,
        scratch: &mut Scratch,
    ) {
        let RolloutShape { latent: d, head_width, history, .. } = *self.shape;
        let (n, count, inner) = (self.n, tokens.count, heads.q.outputs);
        let y = &scratch.y[..n * count * d];
        let (keys, values) = (&mut scratch.keys[block][group], &mut scratch.values[block][group]);
        for (layer, cache) in [(&heads.k, &mut *keys), (&heads.v, &mut *values)] {
            // Rows of equal distance go straight to their places.
            if count == 1 || count == history {
                let stride = if count == 1 { history * inner } else { inner };
                linear_to(layer, y, [n * count, d], &mut cache[tokens.first * inner..], stride, false);
                continue;
            }
            let fresh = sized(&mut scratch.fresh, n * count * inner);
            linear(layer, y, [n * count, d], fresh, false);
            let caches = cache.chunks_exact_mut(history * inner);
            for (cache, fresh) in caches.zip(fresh.chunks_exact(count * inner)) {
                cache[tokens.first * inner..][..fresh.len()].copy_from_slice(fresh);
            }
        }
        let q = sized(&mut scratch.q, n * kept * inner);
        linear(&heads.q, &y[(count - kept) * d..], [n * kept, d * (count / kept)], q, false);
        let attended = sized(&mut scratch.z, n * kept * inner);
        let scores = sized(&mut scratch.rstd, (history + 1) * inner / head_width);
        span(Kind::AttentionForward, 0, || {
            for row in 0..n * kept {
                let (sequence, seen) = (row / kept, tokens.first + count - kept + row % kept + 1);
                let cache = sequence * history * inner..(sequence * history + seen) * inner;
                let output = &mut attended[row * inner..][..inner];
                let q = &q[row * inner..][..inner];
                attend(q, &keys[cache.clone()], &values[cache], head_width, scores, output);
            }
        });
        let added = &mut scratch.added[..n * kept * d];
        linear(&heads.output, attended, [n * kept, inner], added, group > 0);
    }

    /// Maps the last token of each sequence to the next latent.
    fn project(&self, tokens: Tokens, scratch: &mut Scratch) {
        let (d, n) = (self.shape.latent, self.n);
        let (x, y) = (&scratch.x[..n * d], sized(&mut scratch.y, n * d));
        let (normal, rstd) = (sized(&mut scratch.z, n * d), sized(&mut scratch.rstd, n));
        norm::normalize(x, d, self.shape.affine_epsilon, normal, rstd);
        norm::scale_shift(normal, &self.packs.norm.weight, &self.packs.norm.bias, y);
        mlp(&self.packs.project, y, n, &mut scratch.hidden, &mut scratch.z);
        let y = &scratch.z[..n * self.packs.project.outputs];
        let next = (tokens.start + tokens.first + tokens.count) * d;
        for (latents, y) in scratch.latents.chunks_exact_mut((self.chunks + 1) * d).zip(y.chunks_exact(d)) {
            latents[next..next + d].copy_from_slice(y);
        }
    }

    /// The modulation of a row of `kept` tokens per sequence: its six parts, side by side.
    fn modulation<'m>(&self, modulations: &'m [f32], tokens: Tokens, kept: usize, row: usize) -> &'m [f32] {
        let position = tokens.start + tokens.first + tokens.count - kept + row % kept;
        let width = 6 * self.shape.latent;
        &modulations[((row / kept) * self.chunks + position) * width..][..width]
    }

    /// `LN(LN0(x) * (1 + scale) + shift)`; the shift is part `part` of the modulation and the scale the next.
    fn modulated_norm(
        &self,
        x: &[f32],
        modulations: &[f32],
        (tokens, kept): (Tokens, usize),
        part: usize,
        norm: &Norm,
        y: &mut [f32],
    ) {
        let d = self.shape.latent;
        span(Kind::Norm, 0, || {
            for (row, (y, x)) in y.chunks_exact_mut(d).zip(x.chunks_exact(d)).enumerate() {
                let modulation = &self.modulation(modulations, tokens, kept, row)[part * d..][..2 * d];
                let epsilons = [self.shape.plain_epsilon, self.shape.affine_epsilon];
                modulated_norm_row(x, modulation, epsilons, &norm.weight, &norm.bias, y);
            }
        });
    }

    /// `x += gate * y`, with the gate at part `part` of the modulation.
    fn add_gated(
        &self,
        y: &[f32],
        modulations: &[f32],
        (tokens, kept): (Tokens, usize),
        part: usize,
        x: &mut [f32],
    ) {
        let d = self.shape.latent;
        for (row, (x, y)) in x.chunks_exact_mut(d).zip(y.chunks_exact(d)).enumerate() {
            let gate = &self.modulation(modulations, tokens, kept, row)[part * d..][..d];
            add_gated_row(y, gate, x);
        }
    }
}

/// `out = x W^T + b`, or added to `out`; `x` has rows of `stride` elements, of which the layer reads its inputs.
fn linear(layer: &Linear, x: &[f32], sizes: [usize; 2], out: &mut [f32], accumulate: bool) {
    linear_to(layer, x, sizes, out, layer.outputs, accumulate);
}

/// [`linear`] to rows that are `out_stride` apart.
fn linear_to(
    layer: &Linear,
    x: &[f32],
    [rows, stride]: [usize; 2],
    out: &mut [f32],
    out_stride: usize,
    accumulate: bool,
) {
    let a = Lhs { values: x, row_stride: stride, k_stride: 1 };
    let epilogue = Epilogue { accumulate, bias: layer.bias.as_deref() };
    let sizes = [rows, layer.outputs, layer.inputs];
    span(Kind::LinearForward, 2 * rows * layer.outputs * layer.inputs, || {
        gemm(sizes, a, Rhs::Packed(&layer.weight), out, out_stride, epilogue);
    });
}

/// `out = mlp(x)`, block by block of hidden columns; `x` [rows, inputs], `hidden` and `out` grow as needed.
fn mlp(mlp: &Mlp, x: &[f32], rows: usize, hidden: &mut Vec<f32>, out: &mut Vec<f32>) {
    let out = sized(out, rows * mlp.outputs);
    for (index, [up, down]) in mlp.blocks.iter().enumerate() {
        let hidden = sized(hidden, rows * up.outputs);
        linear(up, x, [rows, up.inputs], hidden, false);
        span(Kind::Gelu, 0, || gelu_in_place(hidden));
        linear(down, hidden, [rows, down.inputs], out, index > 0);
    }
}

vectorized! {
    /// `x += gate * y`.
    fn add_gated_row(y: &[f32], gate: &[f32], x: &mut [f32]) {
        for ((x, y), gate) in x.iter_mut().zip(y).zip(gate) {
            *x = mul_add::<FMA>(*gate, *y, *x);
        }
    }

    /// `x / (1 + exp(-x))`, in place.
    fn silu(x: &mut [f32]) {
        for x in x.iter_mut() {
            *x /= 1.0 + exp::<FMA>(-*x);
        }
    }

    /// One row of [`Pass::modulated_norm`]: `modulation` holds shift and scale.
    fn modulated_norm_row(x: &[f32], modulation: &[f32], epsilons: [f32; 2], weight: &[f32], bias: &[f32], y: &mut [f32]) {
        let (shift, scale) = modulation.split_at(x.len());
        let inverse = 1.0 / x.len() as f32;
        let mean = crate::simd::sum(x) * inverse;
        for (y, x) in y.iter_mut().zip(x) {
            *y = x - mean;
        }
        let rstd = 1.0 / (dot::<FMA>(y, y) * inverse + epsilons[0]).sqrt();
        for ((y, scale), shift) in y.iter_mut().zip(scale).zip(shift) {
            *y = mul_add::<FMA>(*y * rstd, 1.0 + scale, *shift);
        }
        let mean = crate::simd::sum(y) * inverse;
        for y in y.iter_mut() {
            *y -= mean;
        }
        let rstd = 1.0 / (dot::<FMA>(y, y) * inverse + epsilons[1]).sqrt();
        for ((y, weight), bias) in y.iter_mut().zip(weight).zip(bias) {
            *y = mul_add::<FMA>(*y * rstd, *weight, *bias);
        }
    }

    /// Attention of one query over the keys and values seen, [seen, heads x width]. `scores` [at least seen + 1, heads] is
    /// memory: heads lie side by side in it, so that exponentials are taken of many at once.
    fn attend(q: &[f32], keys: &[f32], values: &[f32], width: usize, scores: &mut [f32], output: &mut [f32]) {
        let inner = q.len();
        let (seen, heads) = (keys.len() / inner, inner / width);
        let scale = 1.0 / (width as f32).sqrt();
        let (largest, scores) = scores.split_at_mut(heads);
        let scores = &mut scores[..seen * heads];
        largest.fill(f32::NEG_INFINITY);
        for (scores, keys) in scores.chunks_exact_mut(heads).zip(keys.chunks_exact(inner)) {
            let products = q.chunks_exact(width).zip(keys.chunks_exact(width));
            for (score, (q, key)) in scores.iter_mut().zip(products) {
                *score = dot::<FMA>(q, key) * scale;
            }
            for (largest, score) in largest.iter_mut().zip(scores.iter()) {
                *largest = if *score > *largest { *score } else { *largest };
            }
        }
        for scores in scores.chunks_exact_mut(heads) {
            for (score, largest) in scores.iter_mut().zip(largest.iter()) {
                *score = exp::<FMA>(*score - largest);
            }
        }
        let totals = largest;
        totals.fill(0.0);
        for scores in scores.chunks_exact(heads) {
            for (total, score) in totals.iter_mut().zip(scores) {
                *total += score;
            }
        }
        output.fill(0.0);
        for (scores, values) in scores.chunks_exact(heads).zip(values.chunks_exact(inner)) {
            let heads = output.chunks_exact_mut(width).zip(values.chunks_exact(width));
            for ((output, values), (score, total)) in heads.zip(scores.iter().zip(totals.iter())) {
                let weight = score / total;
                for (output, value) in output.iter_mut().zip(values) {
                    *output = mul_add::<FMA>(weight, *value, *output);
                }
            }
        }
    }
}
