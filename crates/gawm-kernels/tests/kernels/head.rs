//! Heads: values, gradients, statistics, and that threads do not change a bit.

use candle_core::{Result, Tensor, Var};
use gawm_kernels::GradientSink;
use gawm_kernels::head::{Head, HeadNorm, HeadShape};

use crate::composed::{check_fused, linear, normalize, tensor, values, variable};
use crate::reference::{assert_close, at_all_levels, noise};

const EPSILON: f64 = 1e-5;

fn composed(norm: HeadNorm, tensors: &[Tensor]) -> Result<Tensor> {
    let [x, first, first_bias, weight, bias, last, last_bias] = tensors else {
        candle_core::bail!("expected seven tensors")
    };
    let hidden = linear(x, first, Some(first_bias))?;
    let axis = if norm == HeadNorm::Layer { 1 } else { 0 };
    let y = normalize(&hidden, axis, EPSILON)?.broadcast_mul(weight)?.broadcast_add(bias)?;
    linear(&y.gelu_erf()?, last, Some(last_bias))
}

/// `x` and the parameters of a head, of sizes [rows, inputs, hidden, outputs].
fn variables([rows, inputs, hidden, outputs]: [usize; 4], size: f64) -> Vec<Var> {
    let shapes: [&[usize]; 6] =
        [&[hidden, inputs], &[hidden], &[hidden], &[hidden], &[outputs, hidden], &[outputs]];
    let mut variables = vec![variable(1, &[rows, inputs], size)];
    variables.extend(shapes.iter().enumerate().map(|(index, shape)| variable(2 + index as u64, shape, 0.8)));
    variables
}

fn head(norm: HeadNorm, tensors: &[Tensor], sink: &GradientSink) -> Head {
    let parameters = std::array::from_fn(|index| tensors[1 + index].clone());
    Head::new(parameters, sink.clone(), norm, EPSILON)
}

fn check_head(norm: HeadNorm, sizes: [usize; 4], size: f64) {
    let (variables, sink) = (variables(sizes, size), GradientSink::default());
    let what = format!("{norm:?} {sizes:?} of {size}");
    // With few rows a batch norm divides by small spreads; with large inputs rounding is relative to them.
    let slack = (1e-5 * (1.0 + size), 2e-4 * (1.0 + size));
    check_fused(
        &what,
        &variables,
        1,
        &sink,
        slack,
        |tensors| composed(norm, tensors),
        |tensors| {
            let head = head(norm, tensors, &sink);
            assert!(head.takes(&tensors[0]));
            Ok(head.forward(&tensors[0])?.0)
        },
    );
}

#[test]
fn fused_and_composed_heads_agree() {
    at_all_levels(|| {
        for sizes in [[2, 1, 2, 1], [3, 5, 7, 2], [12, 16, 33, 10], [70, 9, 20, 3], [5, 17, 64, 31]] {
            for norm in [HeadNorm::Layer, HeadNorm::Batch] {
                check_head(norm, sizes, 1.0);
                check_head(norm, sizes, 20.0);
            }
        }
        // More than one block of rows.
        check_head(HeadNorm::Batch, [600, 3, 40, 2], 1.0);
        check_head(HeadNorm::Layer, [600, 3, 40, 2], 1.0);
        // A single row, which only a layer norm takes.
        check_head(HeadNorm::Layer, [1, 4, 6, 2], 1.0);
    });
}

#[test]
fn strided_rows_are_taken() {
    let variables = variables([4, 6, 5, 2], 1.0);
    let tensors: Vec<Tensor> = variables.iter().map(|var| var.as_tensor().clone()).collect();
    let head = head(HeadNorm::Layer, &tensors, &GradientSink::default());
    let wide = tensor(1, &[6, 4], 1.0);
    let strided = wide.t().unwrap();
    assert!(!strided.is_contiguous());
    let forward = |x: &Tensor| values(&head.forward(x).unwrap().0);
    at_all_levels(|| assert_eq!(forward(&strided), forward(&strided.contiguous().unwrap())));
}

#[test]
fn batch_statistics_are_those_of_the_hidden_columns() {
    at_all_levels(|| {
        let variables = variables([5, 3, 4, 2], 1.0);
        let tensors: Vec<Tensor> = variables.iter().map(|var| var.as_tensor().detach()).collect();
        let hidden = linear(&tensors[0], &tensors[1], Some(&tensors[2])).unwrap();
        let mean = hidden.mean(0).unwrap();
        let variance = hidden.broadcast_sub(&mean).unwrap().sqr().unwrap().mean(0).unwrap();
        let sink = GradientSink::default();
        let of = |norm| head(norm, &tensors, &sink).forward(&tensors[0]).unwrap().1;
        let [got_mean, got_variance] = of(HeadNorm::Batch).unwrap();
        let wide = |tensor: &Tensor| values(tensor).into_iter().map(f64::from).collect::<Vec<_>>();
        assert_close("mean", &values(&got_mean), &wide(&mean), 1e-6);
        assert_close("variance", &values(&got_variance), &wide(&variance), 1e-6);
        assert!(of(HeadNorm::Layer).is_none());
    });
}

/// Hidden columns that are equal in all rows are normalised to zero, and huge ones do not overflow.
#[test]
fn constant_and_huge_values_stay_finite() {
    at_all_levels(|| {
        let shape =
            HeadShape { rows: 3, inputs: 2, hidden: 17, outputs: 2, norm: HeadNorm::Batch, epsilon: 1e-5 };
        let (weight, ones, zeros) = (noise(1, 34), vec![1.0; 17], vec![0.0; 17]);
        let parameters = [&*weight, &*zeros, &*ones, &*zeros, &*weight, &[0.5, -0.5]];
        for (x, equal) in [([3.0; 6], true), ([1e15, -1e15, 2e15, 0.0, 1.0, -1.0], false)] {
            for norm in [HeadNorm::Batch, HeadNorm::Layer] {
                let (y, state) = HeadShape { norm, ..shape }.forward(&x, parameters);
                let gradients = HeadShape { norm, ..shape }.backward(&x, parameters, state, &[1.0; 6]);
                let finite = |values: &[f32]| values.iter().all(|value| value.is_finite());
                assert!(finite(&y) && finite(&gradients.x) && gradients.parameters.iter().all(|g| finite(g)));
                if equal && norm == HeadNorm::Batch {
                    // The mean of equal numbers is rounded, and a spread of nothing divides by the root of epsilon.
                    let expected = [0.5, -0.5, 0.5, -0.5, 0.5, -0.5];
                    assert_close("equal rows", &y, &expected, 1e-3);
                }
            }
        }
    });
}

#[test]
fn threads_do_not_change_a_bit() {
    let shape =
        HeadShape { rows: 1000, inputs: 24, hidden: 70, outputs: 9, norm: HeadNorm::Batch, epsilon: 1e-5 };
    let sizes = [70 * 24, 70, 70, 70, 9 * 70, 9];
    let parameters: Vec<Vec<f32>> =
        sizes.iter().enumerate().map(|(index, size)| noise(index as u64, *size)).collect();
    let (x, dy) = (noise(10, 24_000), noise(11, 9000));
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let parameters = std::array::from_fn(|index| &*parameters[index]);
            let (y, state) = shape.forward(&x, parameters);
            let gradients = shape.backward(&x, parameters, state, &dy);
            (y, gradients.x, gradients.parameters)
        })
    };
    at_all_levels(|| {
        let one = with_threads(1);
        assert!(one == with_threads(2) && one == with_threads(5));
    });
}

#[test]
fn what_does_not_fit_is_an_error_and_lost_gradients_too() {
    let tensors: Vec<Tensor> =
        variables([4, 6, 5, 2], 1.0).iter().map(|var| var.as_tensor().clone()).collect();
    let head = head(HeadNorm::Layer, &tensors, &GradientSink::default());
    let error = head.forward(&tensor(1, &[4, 5], 1.0)).unwrap_err().to_string();
    assert!(error.contains("expected rows of 6"), "{error}");
    assert!(
        !head.takes(&tensor(1, &[0, 6], 1.0))
            && !head.takes(&tensors[0].to_dtype(candle_core::DType::F64).unwrap())
    );
    let loss = head.forward(&tensors[0]).unwrap().0.sum_all().unwrap();
    let error = loss.backward().err().unwrap().to_string();
    assert!(error.contains("Gradients::of"), "{error}");
}
