//! What lies between the products of a block, row by row.

use crate::simd::{dot, exp, mul_add, sum, vectorized};

/// What [`modulated_norm`] keeps of a row: its values normalised once and twice.
#[derive(Debug, Clone, Default)]
pub(super) struct NormState {
    pub(super) plain: Vec<f32>,
    pub(super) plain_rstd: Vec<f32>,
    pub(super) affine: Vec<f32>,
    pub(super) affine_rstd: Vec<f32>,
}

impl NormState {
    pub(super) fn new(rows: usize, width: usize) -> NormState {
        let (values, factors) = (vec![0.0; rows * width], vec![0.0; rows]);
        NormState { plain: values.clone(), plain_rstd: factors.clone(), affine: values, affine_rstd: factors }
    }
}

/// Rows of modulations: shift, scale and gate of a half block lie side by side from `first` on.
#[derive(Debug, Clone, Copy)]
pub(super) struct Modulation<'a> {
    pub(super) values: &'a [f32],
    /// Width of a row.
    pub(super) stride: usize,
    /// Where the shift begins.
    pub(super) first: usize,
}

vectorized! {
    /// `x / (1 + exp(-x))`, in place.
    pub(super) fn silu(x: &mut [f32]) {
        for x in x.iter_mut() {
            *x /= 1.0 + exp::<FMA>(-*x);
        }
    }

    /// Multiplies `dy` by the derivative of SiLU at `x`: `s (1 + x (1 - s))`, where `s` is the sigmoid.
    pub(super) fn silu_backward(x: &[f32], dy: &mut [f32]) {
        for (dy, x) in dy.iter_mut().zip(x) {
            let sigmoid = 1.0 / (1.0 + exp::<FMA>(-x));
            *dy *= sigmoid * mul_add::<FMA>(*x, 1.0 - sigmoid, 1.0);
        }
    }

    /// Multiplies by a mask.
    pub(super) fn multiply(mask: &[f32], x: &mut [f32]) {
        for (x, mask) in x.iter_mut().zip(mask) {
            *x *= mask;
        }
    }

    /// Normalises rows of `x` without, then with scale and shift of the action: `LN0(x) * (1 + scale) + shift`, normalised
    /// again.
    pub(super) fn modulated_norm(x: &[f32], width: usize, modulation: Modulation<'_>, epsilons: [f32; 2], state: &mut NormState) {
        let inverse = 1.0 / width as f32;
        let rows = modulation.values.chunks_exact(modulation.stride).zip(x.chunks_exact(width));
        let plain = state.plain.chunks_exact_mut(width).zip(&mut state.plain_rstd);
        let affine = state.affine.chunks_exact_mut(width).zip(&mut state.affine_rstd);
        for (((modulation_row, x), (plain, plain_rstd)), (affine, affine_rstd)) in rows.zip(plain).zip(affine) {
            let (shift, scale) = modulation_row[modulation.first..][..2 * width].split_at(width);
            let mean = sum(x) * inverse;
            for (y, x) in plain.iter_mut().zip(x) {
                *y = x - mean;
            }
            *plain_rstd = 1.0 / (dot::<FMA>(plain, plain) * inverse + epsilons[0]).sqrt();
            for (((u, y), scale), shift) in affine.iter_mut().zip(plain.iter_mut()).zip(scale).zip(shift) {
                *y *= *plain_rstd;
                *u = mul_add::<FMA>(*y, 1.0 + scale, *shift);
            }
            let mean = sum(affine) * inverse;
            for u in affine.iter_mut() {
                *u -= mean;
            }
            *affine_rstd = 1.0 / (dot::<FMA>(affine, affine) * inverse + epsilons[1]).sqrt();
            for u in affine.iter_mut() {
                *u *= *affine_rstd;
            }
        }
    }

    /// Given `du`, the gradient of `LN0(x) * (1 + scale) + shift`, writes those of shift and scale to their places in
    /// `d_modulation` and adds that of `x` to `dx`. Overwrites `du`.
    pub(super) fn modulate_backward(
        du: &mut [f32],
        width: usize,
        modulation: Modulation<'_>,
        state: &NormState,
        d_modulation: &mut [f32],
        dx: &mut [f32],
    ) {
        let inverse = 1.0 / width as f32;
        let modulations =
            modulation.values.chunks_exact(modulation.stride).zip(d_modulation.chunks_exact_mut(modulation.stride));
        let rows = du.chunks_exact_mut(width).zip(dx.chunks_exact_mut(width));
        let normal = state.plain.chunks_exact(width).zip(&state.plain_rstd);
        for (((du, dx), (modulation_row, d_modulation)), (normal, rstd)) in rows.zip(modulations).zip(normal) {
            let scale = &modulation_row[modulation.first + width..][..width];
            let (d_shift, d_scale) = d_modulation[modulation.first..][..2 * width].split_at_mut(width);
            d_shift.copy_from_slice(du);
            for (((du, d_scale), normal), scale) in du.iter_mut().zip(d_scale).zip(normal).zip(scale) {
                *d_scale = *du * normal;
                *du *= 1.0 + scale;
            }
            let mean = sum(du) * inverse;
            let along = dot::<FMA>(du, normal) * inverse;
            for ((dx, du), normal) in dx.iter_mut().zip(du.iter()).zip(normal) {
                *dx = mul_add::<FMA>(*rstd, mul_add::<FMA>(-along, *normal, du - mean), *dx);
            }
        }
    }

    /// `x += gate * y`, with the gate after shift and scale.
    pub(super) fn add_gated(y: &[f32], width: usize, modulation: Modulation<'_>, x: &mut [f32]) {
        let rows = y.chunks_exact(width).zip(x.chunks_exact_mut(width));
        for ((y, x), modulation_row) in rows.zip(modulation.values.chunks_exact(modulation.stride)) {
            let gate = &modulation_row[modulation.first + 2 * width..][..width];
            for ((x, y), gate) in x.iter_mut().zip(y).zip(gate) {
                *x = mul_add::<FMA>(*gate, *y, *x);
            }
        }
    }

    /// Given `dx`, the gradient of `x + gate * y`, turns `y` into its own and writes that of the gate to its place.
    pub(super) fn gate_backward(dx: &[f32], width: usize, modulation: Modulation<'_>, y: &mut [f32], d_modulation: &mut [f32]) {
        let modulations =
            modulation.values.chunks_exact(modulation.stride).zip(d_modulation.chunks_exact_mut(modulation.stride));
        let rows = dx.chunks_exact(width).zip(y.chunks_exact_mut(width));
        for ((dx, y), (modulation_row, d_modulation)) in rows.zip(modulations) {
            let first = modulation.first + 2 * width;
            let (gate, d_gate) = (&modulation_row[first..][..width], &mut d_modulation[first..][..width]);
            for (((y, dx), gate), d_gate) in y.iter_mut().zip(dx).zip(gate).zip(d_gate) {
                *d_gate = dx * *y;
                *y = dx * gate;
            }
        }
    }

    /// Causal attention of one clip, of sizes [heads, head width]: `qkv` [frames, 3 inner] to `output` [frames, inner]. Probabilities before dropout go
    /// to `weights` [heads, frames, frames]; `mask`, of the same shape or empty, multiplies them.
    pub(super) fn attend(qkv: &[f32], sizes: [usize; 2], mask: &[f32], weights: &mut [f32], output: &mut [f32]) {
        let [heads, width] = sizes;
        let inner = heads * width;
        let frames = output.len() / inner;
        let scale = 1.0 / (width as f32).sqrt();
        output.fill(0.0);
        for (head, weights) in weights.chunks_exact_mut(frames * frames).enumerate() {
            let at = |part: usize, frame: usize| &qkv[frame * 3 * inner + part * inner + head * width..][..width];
            for (i, weights) in weights.chunks_exact_mut(frames).enumerate() {
                let (seen, unseen) = weights.split_at_mut(i + 1);
                unseen.fill(0.0);
                let mut largest = f32::NEG_INFINITY;
                for (j, weight) in seen.iter_mut().enumerate() {
                    *weight = dot::<FMA>(at(0, i), at(1, j)) * scale;
                    largest = if *weight > largest { *weight } else { largest };
                }
                let mut total = 0.0;
                for weight in seen.iter_mut() {
                    *weight = exp::<FMA>(*weight - largest);
                    total += *weight;
                }
                let output = &mut output[i * inner + head * width..][..width];
                for (j, weight) in seen.iter_mut().enumerate() {
                    *weight /= total;
                    let kept = mask.get((head * frames + i) * frames + j).map_or(*weight, |mask| *weight * mask);
                    for (output, value) in output.iter_mut().zip(at(2, j)) {
                        *output = mul_add::<FMA>(kept, *value, *output);
                    }
                }
            }
        }
    }

    /// Writes the gradient of `qkv` of one clip, given `d_output` [frames, inner] and what [`attend`] wrote to `weights`.
    pub(super) fn attend_backward(
        qkv: &[f32],
        sizes: [usize; 2],
        mask: &[f32],
        weights: &[f32],
        d_output: &[f32],
        d_qkv: &mut [f32],
    ) {
        let [heads, width] = sizes;
        let inner = heads * width;
        let frames = d_output.len() / inner;
        let scale = 1.0 / (width as f32).sqrt();
        d_qkv.fill(0.0);
        for (head, weights) in weights.chunks_exact(frames * frames).enumerate() {
            let place = |part: usize, frame: usize| frame * 3 * inner + part * inner + head * width;
            for (i, weights) in weights.chunks_exact(frames).enumerate() {
                let d_output = &d_output[i * inner + head * width..][..width];
                let mask_of = |j: usize| mask.get((head * frames + i) * frames + j).copied().unwrap_or(1.0);
                // The gradient of a weight, twice: keeping it would need memory for a row.
                let d_weight = |j: usize| mask_of(j) * dot::<FMA>(d_output, &qkv[place(2, j)..][..width]);
                let product: f32 = (0..=i).map(|j| weights[j] * d_weight(j)).sum();
                for j in 0..=i {
                    let d_score = weights[j] * (d_weight(j) - product) * scale;
                    let kept = weights[j] * mask_of(j);
                    let mut add = |place: usize, factor: f32, values: &[f32]| {
                        for (sum, value) in d_qkv[place..][..width].iter_mut().zip(&values[..width]) {
                            *sum = mul_add::<FMA>(factor, *value, *sum);
                        }
                    };
                    add(place(2, j), kept, d_output);
                    add(place(0, i), d_score, &qkv[place(1, j)..]);
                    add(place(1, j), d_score, &qkv[place(0, i)..]);
                }
            }
        }
    }
}
