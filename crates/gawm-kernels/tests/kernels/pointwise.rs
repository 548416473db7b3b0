//! Norm, GELU and AdamW against f64, over odd widths and extreme values, and their gradients against differences.

use candle_core::{Device, Tensor};
use gawm_kernels::adamw::{AdamWJob, AdamWStep, adamw, squared_norm};
use gawm_kernels::gelu::{gelu, gelu_backward};
use gawm_kernels::norm;

use crate::reference::{assert_close, at_all_levels, noise, wide};

/// erf in f64: its Taylor series near zero, the continued fraction of erfc beyond.
fn erf(x: f64) -> f64 {
    if x.abs() > 2.0 {
        let fraction = (1..=80).rev().fold(0.0, |rest, n| f64::from(n) / 2.0 / (x.abs() + rest));
        let complement = (-x * x).exp() / std::f64::consts::PI.sqrt() / (x.abs() + fraction);
        return (1.0 - complement).copysign(x);
    }
    let (mut term, mut sum) = (x, x);
    for n in 1..300 {
        term *= -x * x / f64::from(n);
        sum += term / f64::from(2 * n + 1);
    }
    sum * 2.0 / std::f64::consts::PI.sqrt()
}

fn gelu_f64(x: f64) -> f64 {
    0.5 * x * (1.0 + erf(x / 2f64.sqrt()))
}

#[test]
fn gelu_and_its_derivative_are_exact() {
    at_all_levels(|| {
        for count in [1, 15, 16, 17, 1000] {
            let mut x: Vec<f32> = noise(7, count).iter().map(|x| 7.0 * x).collect();
            x[0] = [-1e30, 1e30, 0.0, -0.0, -5.8][count % 5];
            let (mut y, mut again, mut dy) = (vec![0.0; count], vec![0.0; count], vec![2.0; count]);
            gelu(&x, &mut y);
            gelu_backward(&x, &mut again, &mut dy);
            assert_eq!(y, again);
            assert_close("gelu", &y, &wide(&x).into_iter().map(gelu_f64).collect::<Vec<_>>(), 1e-6);
            let step = 1e-5;
            let slope = |x: f64| (gelu_f64(x + step) - gelu_f64(x - step)) / step; // twice the derivative, as dy is 2
            let slopes: Vec<f64> = wide(&x)
                .into_iter()
                .map(|x| if x.abs() > 1e3 { 2.0 * f64::from(x > 0.0) } else { slope(x) })
                .collect();
            assert_close("derivative of gelu", &dy, &slopes, 2e-6);
        }
    });
}

#[test]
fn gelu_keeps_what_is_not_a_number() {
    at_all_levels(|| {
        let mut y = [0.0; 3];
        gelu(&[f32::NAN, 1.0, f32::INFINITY], &mut y);
        assert!(y[0].is_nan() && (y[1] - 0.841_344_7).abs() < 1e-6 && y[2] == f32::INFINITY);
    });
}

/// `(x - mean) / sqrt(var + epsilon) * weight + bias` of one row.
fn layer_norm_f64(x: &[f64], weight: &[f64], bias: &[f64], epsilon: f64) -> Vec<f64> {
    let n = x.len() as f64;
    let mean = x.iter().sum::<f64>() / n;
    let variance = x.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / n;
    let normal = x.iter().map(|x| (x - mean) / (variance + epsilon).sqrt());
    normal.zip(weight).zip(bias).map(|((x, w), b)| x * w + b).collect()
}

fn check_norm(rows: usize, width: usize, size: f32, offset: f32, epsilon: f32) {
    let x: Vec<f32> = noise(1, rows * width).iter().map(|x| size * x + offset).collect();
    let (weight, bias, dy) = (noise(2, width), noise(3, width), noise(4, rows * width));
    let (mut xhat, mut rstd, mut y) = (vec![0.0; x.len()], vec![0.0; rows], vec![0.0; x.len()]);
    norm::normalize(&x, width, epsilon, &mut xhat, &mut rstd);
    norm::scale_shift(&xhat, &weight, &bias, &mut y);
    let forward = |x: &[f64], weight: &[f64], bias: &[f64]| -> Vec<f64> {
        x.chunks_exact(width).flat_map(|x| layer_norm_f64(x, weight, bias, f64::from(epsilon))).collect()
    };
    let what = format!("norm {rows}x{width} of {offset} +- {size}");
    // Subtracting the mean leaves the rounding of the inputs, relative to their spread.
    let slack = 1.0 + f64::from(offset / size).abs();
    let (x, weight_f64, bias_f64) = (wide(&x), wide(&weight), wide(&bias));
    assert_close(&what, &y, &forward(&x, &weight_f64, &bias_f64), 2e-6 * slack);

    let start: Vec<f32> = noise(5, x.len()).iter().map(|start| start / size).collect();
    let (mut dx, mut d_weight, mut d_bias) = (start.clone(), noise(6, width), vec![0.5; width]);
    let weight_start = d_weight.clone();
    norm::scale_shift_backward(&dy, &xhat, &mut d_weight, &mut d_bias);
    norm::normalize_backward(&mut dy.clone(), &xhat, &rstd, &weight, &mut dx);
    let loss = |x: &[f64], weight: &[f64], bias: &[f64]| -> f64 {
        forward(x, weight, bias).iter().zip(&dy).map(|(y, dy)| y * f64::from(*dy)).sum()
    };
    let difference = |which: usize, index: usize, step: f64| {
        let moved = |sign: f64| {
            let mut inputs = [x.clone(), weight_f64.clone(), bias_f64.clone()];
            inputs[which][index] += sign * step;
            loss(&inputs[0], &inputs[1], &inputs[2])
        };
        (moved(1.0) - moved(-1.0)) / (2.0 * step)
    };
    let step = 1e-4 * f64::from(size);
    let of_x: Vec<f64> =
        (0..x.len()).map(|i| (difference(0, i, step) + f64::from(start[i])) * f64::from(size)).collect();
    // Compared per spread of the input, so that one tolerance serves all sizes.
    let dx: Vec<f32> = dx.iter().map(|dx| dx * size).collect();
    assert_close(&format!("{what}: dx"), &dx, &of_x, 2e-5 * slack);
    let of_weight: Vec<f64> =
        (0..width).map(|i| difference(1, i, 1e-4) + f64::from(weight_start[i])).collect();
    let of_bias: Vec<f64> = (0..width).map(|i| difference(2, i, 1e-4) + 0.5).collect();
    assert_close(&format!("{what}: dweight"), &d_weight, &of_weight, 1e-5 * slack);
    assert_close(&format!("{what}: dbias"), &d_bias, &of_bias, 1e-5);
}

#[test]
fn norms_equal_f64_and_differences() {
    at_all_levels(|| {
        for (rows, width) in [(1, 2), (3, 5), (2, 16), (5, 17), (4, 33)] {
            check_norm(rows, width, 1.0, 0.3, 1e-5);
            check_norm(rows, width, 1e4, -20.0, 1e-12);
            check_norm(rows, width, 1.0, 40.0, 1e-12);
        }
    });
}

#[test]
fn a_constant_row_is_normalised_to_zero() {
    at_all_levels(|| {
        let (mut xhat, mut rstd) = ([1.0; 20], [0.0; 1]);
        norm::normalize(&[3.0; 20], 20, 1e-12, &mut xhat, &mut rstd);
        assert_eq!((xhat, rstd), ([0.0; 20], [1e6]));
    });
}

fn tensor(values: &[f32]) -> Tensor {
    Tensor::from_slice(values, values.len(), &Device::Cpu).unwrap()
}

#[test]
fn adamw_equals_f64_over_steps() {
    at_all_levels(|| {
        // More than a block, and one that ends inside a vector.
        for count in [1, 37, 70_001] {
            let parameter = tensor(&noise(1, count));
            let (mut first, mut second) = (vec![0.0; count], vec![0.0; count]);
            let mut expected = wide(&noise(1, count));
            let (mut m, mut v) = (vec![0.0; count], vec![0.0; count]);
            for t in 1..=3 {
                let gradient = noise(10 + t, count);
                let (b1, b2) = (f64::from(0.9f32), f64::from(0.999f32));
                let (size, root) = (1e-2 / (1.0 - b1.powi(t as i32)), 1.0 / (1.0 - b2.powi(t as i32)).sqrt());
                let step = AdamWStep {
                    beta1: 0.9,
                    beta2: 0.999,
                    epsilon: 1e-8,
                    scale: 0.5,
                    size: size as f32,
                    root: root as f32,
                };
                for index in 0..count {
                    let g = 0.5 * f64::from(gradient[index]);
                    m[index] = b1 * m[index] + (1.0 - b1) * g;
                    v[index] = b2 * v[index] + (1.0 - b2) * g * g;
                    let moved = size * m[index] / (v[index].sqrt() * root + 1e-8);
                    expected[index] = 0.999 * expected[index] - moved;
                }
                let gradient = tensor(&gradient);
                let job = AdamWJob {
                    parameter: &parameter,
                    gradient: &gradient,
                    first: &mut first,
                    second: &mut second,
                    kept: 0.999,
                };
                adamw(vec![job], &step).unwrap();
            }
            assert_close("parameters", &parameter.to_vec1::<f32>().unwrap(), &expected, 1e-6);
            assert_close("first moments", &first, &m, 1e-6);
            assert_close("second moments", &second, &v, 1e-6);
        }
    });
}

#[test]
fn adamw_refuses_what_does_not_fit() {
    let (parameter, gradient) = (tensor(&[1.0, 2.0]), tensor(&[1.0]));
    let (mut first, mut second) = (vec![0.0; 2], vec![0.0; 2]);
    let job = AdamWJob {
        parameter: &parameter,
        gradient: &gradient,
        first: &mut first,
        second: &mut second,
        kept: 1.0,
    };
    let step = AdamWStep { beta1: 0.9, beta2: 0.9, epsilon: 1e-8, scale: 1.0, size: 1.0, root: 1.0 };
    assert!(adamw(vec![job], &step).unwrap_err().to_string().contains("expected 2 gradients"));
    assert_eq!(parameter.to_vec1::<f32>().unwrap(), [1.0, 2.0]);
}

#[test]
fn norms_of_gradients_are_added_up_exactly() {
    at_all_levels(|| {
        let values = noise(1, 100_003);
        let exact: f64 = values.iter().map(|x| f64::from(*x).powi(2)).sum();
        let got = squared_norm(&[&tensor(&values), &tensor(&[2.0])]).unwrap();
        assert!((got / (exact + 4.0) - 1.0).abs() < 1e-6, "{got} {exact}");
        assert!(squared_norm(&[&tensor(&[1.0, f32::NAN])]).unwrap().is_nan());
        assert_eq!(squared_norm(&[&tensor(&[1e30])]).unwrap(), f64::INFINITY);
    });
}
