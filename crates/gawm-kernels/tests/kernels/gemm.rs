//! Products of odd shapes and strides.

use gawm_kernels::gemm::{Epilogue, Lhs, Packed, Rhs, gemm};

use crate::reference::{assert_close, at_all_levels, noise};

/// Compares plain, transposed, strided and packed operands, with and without bias and accumulation.
fn check_product(m: usize, n: usize, k: usize, gap: usize) {
    let (a_width, b_width, c_width) = (k.max(m) + gap, n.max(k) + gap, n + gap);
    let a = noise(1, k.max(m) * a_width);
    let b = noise(2, n.max(k) * b_width);
    let (start, bias) = (noise(3, m * c_width), noise(4, n));
    for transposed in [false, true] {
        let (row_stride, k_stride) = if transposed { (1, a_width) } else { (a_width, 1) };
        let lhs = Lhs { values: &a, row_stride, k_stride };
        for (accumulate, bias) in [(false, None), (true, None), (false, Some(&*bias)), (true, Some(&*bias))] {
            for operand in ["rows", "packed", "packed transposed"] {
                let (b_k, b_n) = if operand == "packed transposed" { (1, b_width) } else { (b_width, 1) };
                let mut packed = Packed::default();
                packed.fill(&noise(5, 999), [3, 37], [40, 1]); // what a reused panel held before
                packed.fill(&b, [k, n], [b_k, b_n]);
                let rhs = match operand {
                    "rows" => Rhs::Rows { values: &b, stride: b_width },
                    _ => Rhs::Packed(&packed),
                };
                let mut expected: Vec<f64> = start.iter().copied().map(f64::from).collect();
                for (i, row) in expected.chunks_exact_mut(c_width).enumerate() {
                    for (j, c) in row[..n].iter_mut().enumerate() {
                        let term = |kk: usize| {
                            f64::from(a[i * row_stride + kk * k_stride]) * f64::from(b[kk * b_k + j * b_n])
                        };
                        let kept = if accumulate { *c } else { 0.0 };
                        *c = kept
                            + (0..k).map(term).sum::<f64>()
                            + bias.map_or(0.0, |bias| f64::from(bias[j]));
                    }
                }
                let mut c = start.clone();
                gemm([m, n, k], lhs, rhs, &mut c, c_width, Epilogue { accumulate, bias });
                let what = format!("{m}x{n}x{k} gap {gap} {operand} transposed {transposed} {accumulate}");
                assert_close(&what, &c, &expected, 2e-6);
            }
        }
    }
}

#[test]
fn products_equal_naive_sums() {
    at_all_levels(|| {
        for (m, n, k) in
            [(1, 1, 1), (12, 32, 7), (13, 33, 5), (25, 16, 64), (5, 47, 12), (7, 6, 3), (26, 65, 31)]
        {
            check_product(m, n, k, 0);
            check_product(m, n, k, 3);
        }
    });
}

#[test]
fn empty_sums_are_the_bias() {
    for accumulate in [false, true] {
        let mut c = [1.0, 2.0, 9.0, 3.0, 4.0, 9.0];
        let lhs = Lhs { values: &[], row_stride: 1, k_stride: 1 };
        let epilogue = Epilogue { accumulate, bias: Some(&[0.5, 0.25]) };
        gemm([2, 2, 0], lhs, Rhs::Rows { values: &[], stride: 2 }, &mut c, 3, epilogue);
        let expected =
            if accumulate { [1.5, 2.25, 9.0, 3.5, 4.25, 9.0] } else { [0.5, 0.25, 9.0, 0.5, 0.25, 9.0] };
        assert_eq!(c, expected);
    }
}

#[test]
fn not_a_number_stays_where_it_belongs() {
    at_all_levels(|| {
        let (mut a, b) = (vec![1.0; 14 * 3], vec![2.0; 3 * 40]);
        a[13 * 3 + 1] = f32::NAN;
        let mut c = vec![0.0; 14 * 40];
        let lhs = Lhs { values: &a, row_stride: 3, k_stride: 1 };
        gemm([14, 40, 3], lhs, Rhs::Rows { values: &b, stride: 40 }, &mut c, 40, Epilogue::default());
        assert!(c[..13 * 40].iter().all(|c| *c == 6.0) && c[13 * 40..].iter().all(|c| c.is_nan()));
    });
}

#[test]
fn short_operands_are_refused_before_they_are_read() {
    let refused = |a: usize, b: usize, c: usize| {
        let lhs = Lhs { values: &vec![0.0; a], row_stride: 4, k_stride: 1 };
        let (b, mut c) = (vec![0.0; b], vec![0.0; c]);
        let work = std::panic::AssertUnwindSafe(|| {
            gemm([2, 3, 4], lhs, Rhs::Rows { values: &b, stride: 3 }, &mut c, 3, Epilogue::default());
        });
        std::panic::catch_unwind(work).is_err()
    };
    at_all_levels(|| {
        assert!(!refused(8, 12, 6));
        assert!(refused(7, 12, 6) && refused(8, 11, 6) && refused(8, 12, 5));
    });
}
