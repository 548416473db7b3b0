//! Products of a layer's linear maps, in f32 or in pairs of bf16.

use super::Products;
use super::chunk::sized;
use crate::gemm::{ACCUMULATE, Epilogue, Lhs, Packed, Rhs, gemm, gemm_pairs};
use crate::pairs::{pair_columns, pair_rows};

/// Rows of values, `stride` apart.
#[derive(Debug, Clone, Copy)]
pub(super) struct Matrix<'a> {
    pub(super) values: &'a [f32],
    pub(super) stride: usize,
}

/// Memory for operands in pairs.
#[derive(Debug, Default)]
pub(super) struct Operands {
    left: Vec<f32>,
    right: Vec<f32>,
}

impl Operands {
    /// `out = x B` with `x` [rows, k] and a packed `B` [k, columns]; sizes are [rows, columns, k], and rows of `out` as far
    /// apart as is said with it.
    pub(super) fn by_weight(
        &mut self,
        products: Products,
        [rows, columns, k]: [usize; 3],
        x: Matrix<'_>,
        weight: &Packed,
        (out, stride): (&mut [f32], usize),
        epilogue: Epilogue<'_>,
    ) {
        match products {
            Products::Single => {
                let a = Lhs { values: x.values, row_stride: x.stride, k_stride: 1 };
                gemm([rows, columns, k], a, Rhs::Packed(weight), out, stride, epilogue);
            }
            Products::Pairs => {
                let pairs = k.div_ceil(2);
                let left = sized(&mut self.left, rows * pairs);
                pair_columns(x.values, x.stride, [rows, k], left);
                let a = Lhs { values: left, row_stride: pairs, k_stride: 1 };
                gemm_pairs([rows, columns, pairs], a, Rhs::Packed(weight), out, stride, epilogue);
            }
        }
    }

    /// Adds `dy^T x` to `sums` [outputs, inputs], with `dy` [rows, outputs] and `x` [rows, inputs]; sizes are
    /// [rows, outputs, inputs].
    pub(super) fn of_weight(
        &mut self,
        products: Products,
        [rows, outputs, inputs]: [usize; 3],
        dy: Matrix<'_>,
        x: Matrix<'_>,
        sums: &mut [f32],
    ) {
        match products {
            Products::Single => {
                let a = Lhs { values: dy.values, row_stride: 1, k_stride: dy.stride };
                let b = Rhs::Rows { values: x.values, stride: x.stride };
                gemm([outputs, inputs, rows], a, b, sums, inputs, ACCUMULATE);
            }
            Products::Pairs => {
                let pairs = rows.div_ceil(2);
                let left = sized(&mut self.left, pairs * outputs);
                pair_rows(dy.values, dy.stride, [rows, outputs], left);
                let right = sized(&mut self.right, pairs * inputs);
                pair_rows(x.values, x.stride, [rows, inputs], right);
                let a = Lhs { values: left, row_stride: 1, k_stride: outputs };
                let b = Rhs::Rows { values: right, stride: inputs };
                gemm_pairs([outputs, inputs, pairs], a, b, sums, inputs, ACCUMULATE);
            }
        }
    }
}
