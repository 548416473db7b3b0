//! Linear layers of few and of many rows, and where their gradients go.

use candle_core::{Device, Tensor, Var};
use gawm_kernels::GradientSink;
use gawm_kernels::linear::{LinearShape, linear, takes};

use crate::reference::{assert_close, at_all_levels, noise, wide};

/// `sum over k of a(i, k) b(k, j)`, [m, n], in f64.
fn product(
    [m, n, k]: [usize; 3],
    a: impl Fn(usize, usize) -> f32,
    b: impl Fn(usize, usize) -> f32,
) -> Vec<f64> {
    let sum = |i, j| (0..k).map(|kk| f64::from(a(i, kk)) * f64::from(b(kk, j))).sum();
    (0..m).flat_map(|i| (0..n).map(move |j| (i, j))).map(|(i, j)| sum(i, j)).collect()
}

fn check_shape(rows: usize, outputs: usize, inputs: usize) {
    let shape = LinearShape { rows, outputs, inputs };
    let (x, weight, bias) = (noise(1, rows * inputs), noise(2, outputs * inputs), noise(3, outputs));
    let dy = noise(4, rows * outputs);
    let what = |part: &str| format!("{part} of {shape:?}");
    let plain = product([rows, outputs, inputs], |i, k| x[i * inputs + k], |k, j| weight[j * inputs + k]);
    assert_close(&what("y"), &shape.forward(&x, &weight, None), &plain, 5e-6);
    let biased: Vec<f64> = plain.iter().enumerate().map(|(i, y)| y + f64::from(bias[i % outputs])).collect();
    assert_close(&what("y"), &shape.forward(&x, &weight, Some(&bias)), &biased, 5e-6);
    let dx = product([rows, inputs, outputs], |i, k| dy[i * outputs + k], |k, j| weight[k * inputs + j]);
    assert_close(&what("dx"), &shape.input_gradient(&dy, &weight), &dx, 5e-6);
    let dw = product([outputs, inputs, rows], |i, k| dy[k * outputs + i], |k, j| x[k * inputs + j]);
    assert_close(&what("dw"), &shape.weight_gradient(&dy, &x), &dw, 5e-6);
}

#[test]
fn linear_layers_equal_naive_sums() {
    at_all_levels(|| {
        for (rows, outputs, inputs) in
            [(1, 1, 1), (3, 7, 5), (24, 200, 33), (64, 97, 16), (65, 33, 40), (193, 20, 97)]
        {
            check_shape(rows, outputs, inputs);
        }
    });
}

#[test]
fn gradients_go_to_the_collector_or_candles_way() {
    at_all_levels(|| {
        let var = |seed, dims: &[usize]| {
            let values = noise(seed, dims.iter().product());
            Var::from_tensor(&Tensor::from_vec(values, dims, &Device::Cpu).unwrap()).unwrap()
        };
        let (x, weight, bias) = (var(1, &[4, 6]), var(2, &[5, 6]), var(3, &[5]));
        let sink = GradientSink::default();
        for bias in [None, Some(bias.as_tensor())] {
            let composed = x.matmul(&weight.t().unwrap()).unwrap();
            let composed = bias.map_or(composed.clone(), |bias| composed.broadcast_add(bias).unwrap());
            let expected = composed.sqr().unwrap().sum_all().unwrap().backward().unwrap();
            assert!(takes(&x, &weight, bias));
            let loss = || linear(&x, &weight, bias, &sink).unwrap().sqr().unwrap().sum_all().unwrap();
            let own = loss().backward().unwrap();
            let (collected, fused) = sink.collect(|| loss().backward()).unwrap();
            for parameter in [Some(weight.as_tensor()), bias].into_iter().flatten() {
                let values = |t: &Tensor| t.flatten_all().unwrap().to_vec1::<f32>().unwrap();
                let expected = wide(&values(expected.get(parameter).unwrap()));
                assert_close("own", &values(own.get(parameter).unwrap()), &expected, 1e-5);
                assert_close("fused", &values(&fused[&parameter.id()]), &expected, 1e-5);
                assert!(collected.get(parameter).is_none());
            }
            let dx = |grads: &candle_core::backprop::GradStore| {
                grads.get(x.as_tensor()).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap()
            };
            assert_close("dx", &dx(&own), &wide(&dx(&expected)), 1e-5);
            assert_eq!(dx(&own), dx(&collected));
        }
    });
}

#[test]
fn what_does_not_fit_is_an_error() {
    let var = |dims: &[usize]| {
        Var::from_tensor(&Tensor::zeros(dims, candle_core::DType::F32, &Device::Cpu).unwrap()).unwrap()
    };
    let sink = GradientSink::default();
    assert!(linear(&var(&[2, 3]), &var(&[4, 5]), None, &sink).is_err());
    assert!(linear(&var(&[2, 3]), &var(&[4, 3]), Some(&var(&[3])), &sink).is_err());
}
