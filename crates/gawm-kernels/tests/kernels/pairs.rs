//! Pairs of bf16: their rounding, their products, and an encoder made of them.

use candle_core::Tensor;
use gawm_kernels::gemm::{Epilogue, Lhs, Packed, Rhs, gemm_pairs};
use gawm_kernels::pairs::{available, pair_columns, pair_rows};
use gawm_kernels::vit::{Products, VitShape};
use gawm_kernels::{GradientSink, VitEncoder};

use crate::composed::{tensor, values, variable};
use crate::reference::{assert_close, at_all_levels, noise};

/// The two values of a pair.
fn parts(pair: f32) -> [f32; 2] {
    let bits = pair.to_bits();
    [f32::from_bits(bits << 16), f32::from_bits(bits & 0xffff_0000)]
}

/// The nearest bf16 by comparing both neighbours, to even where they are equally near.
fn nearest(x: f32) -> f32 {
    let below = f32::from_bits(x.to_bits() & 0xffff_0000);
    let above = f32::from_bits((x.to_bits() & 0xffff_0000).wrapping_add(0x1_0000));
    let distance = |y: f32| (f64::from(y) - f64::from(x)).abs();
    let even = |y: f32| (y.to_bits() >> 16) & 1 == 0;
    match distance(below).total_cmp(&distance(above)) {
        std::cmp::Ordering::Less => below,
        std::cmp::Ordering::Greater => above,
        std::cmp::Ordering::Equal => {
            if even(below) {
                below
            } else {
                above
            }
        }
    }
}

#[test]
fn values_are_rounded_to_the_nearest() {
    at_all_levels(|| {
        let mut x = noise(1, 4001);
        // The last three lie halfway between two.
        x.extend([0.0, -0.0, 1e-40, -1e-40, 3e38, 1.0 + 1.0 / 256.0, 1.0 + 3.0 / 256.0, -1.0 - 1.0 / 256.0]);
        x.extend([f32::INFINITY, f32::NEG_INFINITY, f32::NAN, f32::from_bits(0x7f80_0001), f32::MAX]);
        let mut out = vec![0.0; x.len()];
        pair_rows(&x, x.len(), [1, x.len()], &mut out);
        for (x, pair) in x.iter().zip(out) {
            let [got, zero] = parts(pair);
            assert_eq!(zero.to_bits(), 0);
            match *x {
                x if x.is_nan() => assert!(got.is_nan()),
                x if x.is_infinite() => assert_eq!(got, x),
                f32::MAX => assert_eq!(got, f32::INFINITY),
                x => assert_eq!(got.to_bits(), nearest(x).to_bits(), "{x:e}"),
            }
        }
    });
}

#[test]
fn pairs_lie_where_sums_want_them() {
    at_all_levels(|| {
        for (rows, columns, stride) in [(1, 1, 1), (3, 5, 5), (4, 17, 20), (5, 64, 70)] {
            let x = noise(2, rows * stride);
            let at = |row: usize, column: usize| match row < rows && column < columns {
                true => nearest(x[row * stride + column]),
                false => 0.0,
            };
            let mut out = vec![f32::NAN; rows * columns.div_ceil(2)];
            pair_columns(&x, stride, [rows, columns], &mut out);
            for (index, pair) in out.iter().enumerate() {
                let (row, column) = (index / columns.div_ceil(2), 2 * (index % columns.div_ceil(2)));
                assert_eq!(parts(*pair), [at(row, column), at(row, column + 1)]);
            }
            let mut out = vec![f32::NAN; rows.div_ceil(2) * columns];
            pair_rows(&x, stride, [rows, columns], &mut out);
            for (index, pair) in out.iter().enumerate() {
                let (row, column) = (2 * (index / columns), index % columns);
                assert_eq!(parts(*pair), [at(row, column), at(row + 1, column)]);
            }
        }
    });
}

#[test]
fn products_of_pairs_equal_naive_sums() {
    at_all_levels(|| {
        if !available() {
            return;
        }
        for (m, n, k) in [(1, 1, 1), (12, 32, 8), (13, 33, 5), (25, 16, 64), (7, 70, 31)] {
            let (a, b, bias) = (noise(1, m * k), noise(2, k * n), noise(3, n));
            let pairs = k.div_ceil(2);
            let (mut left, mut right) = (vec![0.0; m * pairs], vec![0.0; pairs * n]);
            pair_columns(&a, k, [m, k], &mut left);
            pair_rows(&b, n, [k, n], &mut right);
            let packed = Packed::of(&right, [pairs, n]);
            for rhs in [Rhs::Rows { values: &right, stride: n }, Rhs::Packed(&packed)] {
                let mut c = vec![1.0; m * n];
                let lhs = Lhs { values: &left, row_stride: pairs, k_stride: 1 };
                gemm_pairs(
                    [m, n, pairs],
                    lhs,
                    rhs,
                    &mut c,
                    n,
                    Epilogue { accumulate: true, bias: Some(&bias) },
                );
                let term = |i: usize, j: usize, kk: usize| {
                    f64::from(nearest(a[i * k + kk])) * f64::from(nearest(b[kk * n + j]))
                };
                let sum = |i: usize, j: usize| (0..k).map(|kk| term(i, j, kk)).sum::<f64>();
                let expected: Vec<f64> =
                    (0..m * n).map(|at| 1.0 + sum(at / n, at % n) + f64::from(bias[at % n])).collect();
                assert_close(&format!("{m}x{n}x{k}"), &c, &expected, 2e-6);
            }
        }
    });
}

/// Values and gradients of an encoder in pairs against the same in f32: their distance is that of the rounding.
#[test]
fn an_encoder_of_pairs_stays_close() {
    at_all_levels(|| {
        if !available() {
            return;
        }
        let single = VitShape {
            patch: 3,
            rows: 3,
            columns: 2,
            channels: 1,
            width: 22,
            depth: 2,
            heads: 2,
            mlp_width: 35,
            epsilon: 1e-5,
            products: Products::Single,
        };
        let (w, f) = (22, 35);
        let mut shapes = vec![vec![w, 9], vec![w], vec![w], vec![w], vec![w]];
        for _ in 0..2 {
            shapes.extend([vec![w], vec![w]]);
            shapes.extend((0..4).flat_map(|_| [vec![w, w], vec![w]]));
            shapes.extend([vec![w], vec![w], vec![f, w], vec![f], vec![w, f], vec![w]]);
        }
        let parameters: Vec<_> =
            shapes.iter().enumerate().map(|(index, dims)| variable(10 + index as u64, dims, 0.4)).collect();
        let images = tensor(1, &[5, 1, 9, 6], 1.0);
        let positions = variable(2, &[1, 7, w], 0.5);
        let run = |products: Products| {
            let sink = GradientSink::default();
            let tensors = parameters.iter().map(|var| var.as_tensor().clone()).collect();
            let encoder = VitEncoder::new(tensors, sink.clone());
            let shape = VitShape { products, ..single };
            let output = encoder.forward(&images, &positions, shape, true).unwrap();
            let loss = (&output * tensor(3, &[5, w], 1.0)).unwrap().sum_all().unwrap();
            let (own, mut fused) = sink.collect(|| loss.backward()).unwrap();
            let mut all: Vec<Tensor> = vec![output.detach(), own.get(positions.as_tensor()).unwrap().clone()];
            all.extend(parameters.iter().map(|var| fused.remove(&var.as_tensor().id()).unwrap()));
            all.iter().map(values).collect::<Vec<_>>()
        };
        for (index, (pairs, single)) in run(Products::Pairs).iter().zip(run(Products::Single)).enumerate() {
            let norm = |values: &mut dyn Iterator<Item = f32>| {
                values.map(|x| f64::from(x).powi(2)).sum::<f64>().sqrt()
            };
            let distance = norm(&mut pairs.iter().zip(&single).map(|(a, b)| a - b));
            let size = norm(&mut single.iter().copied()).max(0.1);
            assert!(distance < 0.03 * size, "{index}: {distance} of {size}");
            assert!(index > 0 || distance > 0.0, "expected rounding");
        }
    });
}
