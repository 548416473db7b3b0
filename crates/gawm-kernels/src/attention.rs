//! Scaled dot-product attention of one image, forward and backward, without a table of all scores.
//!
//! ```text
//! P = softmax(scale Q K^T),  O = P V
//! dV = P^T dO,  dP = dO V^T,  dS = P (dP - rowsum(dO O)),  dQ = scale dS K,  dK = scale dS^T Q
//! ```
//!
//! Queries go through in blocks of `BLOCK` rows, whose scores stay in the cache. Forward keeps the logarithm of each
//! row's sum; backward computes the probabilities again from it.

use crate::gemm::{ACCUMULATE, Epilogue, Lhs, Packed, Rhs, STORE, gemm, panel_width};
use crate::simd::{LANES, dot, exp, fold, max_of, mul_add, vectorized};

/// Queries per block: a multiple of every register tile.
const BLOCK: usize = 72;

/// Sizes of one image's attention. Rows of queries, keys, values and outputs hold all heads, side by side.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Attention {
    /// Number of queries.
    pub queries: usize,
    /// Number of keys and values.
    pub keys: usize,
    /// Number of heads.
    pub heads: usize,
    /// Width of a head.
    pub head_width: usize,
}

/// What the passes need for a while; reused from image to image.
#[derive(Debug, Default)]
pub struct AttentionScratch {
    keys: Packed,
    values: Packed,
    scores: Vec<f32>,
    gradients: Vec<f32>,
    products: Vec<f32>,
}

/// Forward values that the backward pass reads; all rows have the width of all heads.
#[derive(Debug, Clone, Copy)]
pub struct AttentionInputs<'a> {
    /// `[queries, width]`.
    pub q: &'a [f32],
    /// `[keys, width]`.
    pub k: &'a [f32],
    /// `[keys, width]`.
    pub v: &'a [f32],
}

/// Where the backward pass writes; overwritten.
#[derive(Debug)]
pub struct AttentionGradients<'a> {
    /// `[queries, width]`.
    pub q: &'a mut [f32],
    /// `[keys, width]`.
    pub k: &'a mut [f32],
    /// `[keys, width]`.
    pub v: &'a mut [f32],
}

impl Attention {
    /// Width of a row: all heads.
    fn width(&self) -> usize {
        self.heads * self.head_width
    }

    /// Keys rounded up to half a register tile, so that scores are written in whole vectors.
    fn padded_keys(&self) -> usize {
        self.keys.next_multiple_of(panel_width() / 2)
    }

    fn scale(&self) -> f32 {
        1.0 / (self.head_width as f32).sqrt()
    }

    /// Floating-point operations of a forward pass.
    pub fn operations(&self) -> usize {
        4 * self.queries * self.keys * self.width()
    }

    /// Writes `softmax(Q K^T / sqrt(d)) V` to `output` [queries, width] and the logarithms of the softmax sums to
    /// `log_sums` [heads, queries].
    ///
    /// # Panics
    ///
    /// If a slice is too short.
    pub fn forward(
        &self,
        inputs: AttentionInputs<'_>,
        output: &mut [f32],
        log_sums: &mut [f32],
        scratch: &mut AttentionScratch,
    ) {
        let (width, d, padded) = (self.width(), self.head_width, self.padded_keys());
        scratch.scores.resize(BLOCK * padded, 0.0);
        scratch.products.resize(BLOCK, 0.0);
        for head in 0..self.heads {
            let first = head * d;
            scratch.keys.fill(&inputs.k[first..], [d, self.keys], [1, width]);
            for start in (0..self.queries).step_by(BLOCK) {
                let rows = BLOCK.min(self.queries - start);
                let q = Lhs { values: &inputs.q[start * width + first..], row_stride: width, k_stride: 1 };
                gemm([rows, padded, d], q, Rhs::Packed(&scratch.keys), &mut scratch.scores, padded, STORE);
                let sums = &mut log_sums[head * self.queries + start..][..rows];
                let weights = &mut scratch.scores[..rows * padded];
                let inverses = &mut scratch.products[..rows];
                softmax_rows(weights, [padded, self.keys], self.scale(), sums, inverses);
                let p = Lhs { values: &scratch.scores, row_stride: padded, k_stride: 1 };
                let v = Rhs::Rows { values: &inputs.v[first..], stride: width };
                let output = &mut output[start * width + first..];
                gemm([rows, d, self.keys], p, v, output, width, STORE);
                scale_rows(output, width, d, &scratch.products[..rows]);
            }
        }
    }

    /// Writes the gradients of queries, keys and values, given `d_output` [queries, width], that of the output.
    ///
    /// `output` and `log_sums` are what [`Attention::forward`] wrote.
    ///
    /// # Panics
    ///
    /// If a slice is too short.
    pub fn backward(
        &self,
        inputs: AttentionInputs<'_>,
        (output, log_sums): (&[f32], &[f32]),
        d_output: &[f32],
        gradients: &mut AttentionGradients<'_>,
        scratch: &mut AttentionScratch,
    ) {
        let (width, d, padded) = (self.width(), self.head_width, self.padded_keys());
        scratch.scores.resize(BLOCK * padded, 0.0);
        scratch.gradients.resize(BLOCK * padded, 0.0);
        scratch.products.resize(BLOCK, 0.0);
        for head in 0..self.heads {
            let first = head * d;
            scratch.keys.fill(&inputs.k[first..], [d, self.keys], [1, width]);
            scratch.values.fill(&inputs.v[first..], [d, self.keys], [1, width]);
            for start in (0..self.queries).step_by(BLOCK) {
                let rows = BLOCK.min(self.queries - start);
                let at = start * width + first;
                let block = |values| Lhs { values, row_stride: width, k_stride: 1 };
                gemm(
                    [rows, padded, d],
                    block(&inputs.q[at..]),
                    Rhs::Packed(&scratch.keys),
                    &mut scratch.scores,
                    padded,
                    STORE,
                );
                gemm(
                    [rows, padded, d],
                    block(&d_output[at..]),
                    Rhs::Packed(&scratch.values),
                    &mut scratch.gradients,
                    padded,
                    STORE,
                );
                row_products(&output[at..], &d_output[at..], width, d, &mut scratch.products[..rows]);
                let log_sums = &log_sums[head * self.queries + start..][..rows];
                let (p, ds) = (&mut scratch.scores[..rows * padded], &mut scratch.gradients[..rows * padded]);
                softmax_backward_rows(p, ds, padded, self.scale(), log_sums, &scratch.products);

                let then = if start == 0 { STORE } else { ACCUMULATE };
                let (p, ds) = (&scratch.scores, &scratch.gradients);
                let transposed = |values| Lhs { values, row_stride: 1, k_stride: padded };
                let rows_of = |values| Rhs::Rows { values, stride: width };
                gemm(
                    [self.keys, d, rows],
                    transposed(p),
                    rows_of(&d_output[at..]),
                    &mut gradients.v[first..],
                    width,
                    then,
                );
                gemm(
                    [self.keys, d, rows],
                    transposed(ds),
                    rows_of(&inputs.q[at..]),
                    &mut gradients.k[first..],
                    width,
                    then,
                );
                let ds = Lhs { values: ds, row_stride: padded, k_stride: 1 };
                gemm(
                    [rows, d, self.keys],
                    ds,
                    rows_of(&inputs.k[first..]),
                    &mut gradients.q[at..],
                    width,
                    Epilogue::default(),
                );
            }
        }
    }
}

vectorized! {
    /// Turns rows of scores into `exp(scale * (x - largest))` over the first `count` columns of each row of `stride`
    /// elements, and zeros beyond; writes `ln(sum(exp(scale * x)))` of each row, and what its weights are to be multiplied
    /// by to add up to 1.
    fn softmax_rows(
        scores: &mut [f32],
        sizes: [usize; 2],
        scale: f32,
        log_sums: &mut [f32],
        inverses: &mut [f32],
    ) {
        let [stride, count] = sizes;
        // Row after row in each pass, so that the end of one row's reduction overlaps with the next row.
        for (row, largest) in scores.chunks_exact_mut(stride).zip(inverses.iter_mut()) {
            // Beyond the last key too, so that whole vectors are left.
            row[count..].fill(f32::NEG_INFINITY);
            *largest = max_of(row);
        }
        let rows = scores.chunks_exact_mut(stride).zip(inverses.iter_mut()).zip(log_sums.iter_mut());
        for ((row, inverse), log_sum) in rows {
            let largest = *inverse;
            let one = |x: &mut f32, lane: &mut f32| {
                *x = exp::<FMA>((*x - largest) * scale);
                *lane += *x;
            };
            let mut lanes = [0f32; LANES];
            let (vectors, rest) = row.as_chunks_mut::<LANES>();
            for vector in vectors {
                vector.iter_mut().zip(&mut lanes).for_each(|(x, lane)| one(x, lane));
            }
            rest.iter_mut().zip(&mut lanes).for_each(|(x, lane)| one(x, lane));
            *inverse = fold(lanes, |a, b| a + b);
            *log_sum = largest * scale;
        }
        for (log_sum, inverse) in log_sums.iter_mut().zip(inverses.iter_mut()) {
            *log_sum += inverse.ln();
            *inverse = 1.0 / *inverse;
        }
    }

    /// Multiplies the first `count` elements of each row of `stride` elements by the row's factor.
    fn scale_rows(values: &mut [f32], stride: usize, count: usize, factors: &[f32]) {
        for (row, factor) in factors.iter().enumerate() {
            for x in &mut values[row * stride..][..count] {
                *x *= factor;
            }
        }
    }

    /// Turns rows of scores into probabilities again, and rows of `dP` into `scale * P * (dP - product)`. Columns beyond
    /// the last key hold numbers that nobody reads.
    fn softmax_backward_rows(
        scores: &mut [f32],
        gradients: &mut [f32],
        stride: usize,
        scale: f32,
        log_sums: &[f32],
        products: &[f32],
    ) {
        let rows = scores.chunks_exact_mut(stride).zip(gradients.chunks_exact_mut(stride));
        for (((p, ds), log_sum), product) in rows.zip(log_sums).zip(products) {
            let one = |p: &mut f32, ds: &mut f32| {
                *p = exp::<FMA>(mul_add::<FMA>(*p, scale, -log_sum));
                *ds = *p * (*ds - product) * scale;
            };
            let ((p, p_rest), (ds, ds_rest)) = (p.as_chunks_mut::<LANES>(), ds.as_chunks_mut::<LANES>());
            for (p, ds) in p.iter_mut().zip(ds) {
                p.iter_mut().zip(ds).for_each(|(p, ds)| one(p, ds));
            }
            p_rest.iter_mut().zip(ds_rest).for_each(|(p, ds)| one(p, ds));
        }
    }

    /// Writes the product of each pair of rows of `count` elements, `stride` apart.
    fn row_products(a: &[f32], b: &[f32], stride: usize, count: usize, products: &mut [f32]) {
        for (row, product) in products.iter_mut().enumerate() {
            let (a, b) = (&a[row * stride..][..count], &b[row * stride..][..count]);
            *product = dot::<FMA>(a, b);
        }
    }
}
