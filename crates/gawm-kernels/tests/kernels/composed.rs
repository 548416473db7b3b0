//! Fused operations against composed ones in f64: values, every gradient, and differences along random directions.

use candle_core::{DType, Device, Result, Tensor, Var};
use gawm_kernels::GradientSink;

use crate::reference::{assert_close, noise};

/// `count` values of [-size, size) in a shape.
pub(crate) fn tensor(seed: u64, dims: &[usize], size: f64) -> Tensor {
    (Tensor::from_vec(noise(seed, dims.iter().product()), dims, &Device::Cpu).unwrap() * size).unwrap()
}

pub(crate) fn variable(seed: u64, dims: &[usize], size: f64) -> Var {
    Var::from_tensor(&tensor(seed, dims, size)).unwrap()
}

pub(crate) fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn exact_values(tensor: &Tensor) -> Vec<f64> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

/// `composed` in f64 and `fused` in f32 of the same inputs, of which the first ones get their gradients by candle and the
/// others through the sink. Both are weighed with the same random gradient of the output.
pub(crate) fn check_fused(
    what: &str,
    variables: &[Var],
    n_inputs: usize,
    sink: &GradientSink,
    (value_slack, gradient_slack): (f64, f64),
    composed: impl Fn(&[Tensor]) -> Result<Tensor>,
    fused: impl Fn(&[Tensor]) -> Result<Tensor>,
) {
    let exact: Vec<Var> = (variables.iter())
        .map(|var| Var::from_tensor(&var.as_detached_tensor().to_dtype(DType::F64).unwrap()).unwrap())
        .collect();
    let tensors = |vars: &[Var]| vars.iter().map(|var| var.as_tensor().clone()).collect::<Vec<_>>();
    let expected = composed(&tensors(&exact)).unwrap();
    let d_output = tensor(99, expected.dims(), 1.0);
    let weigh = |output: &Tensor| (output * d_output.to_dtype(output.dtype())?)?.sum_all();
    let gradients = weigh(&expected).unwrap().backward().unwrap();

    let got = fused(&tensors(variables)).unwrap();
    assert_eq!(got.dims(), expected.dims(), "{what}");
    assert_close(what, &values(&got), &exact_values(&expected), value_slack);
    let loss = weigh(&got).unwrap();
    let (mut own, mut collected) = sink.collect(|| loss.backward()).unwrap();
    for (index, (var, exact_var)) in variables.iter().zip(&exact).enumerate() {
        let got = match index < n_inputs {
            true => own.remove(var.as_tensor()),
            false => collected.remove(&var.as_tensor().id()),
        };
        let got = got.unwrap_or_else(|| panic!("{what}: no gradient of {index}"));
        assert_eq!(got.dims(), var.dims(), "{what}: gradient {index}");
        let of_candle = exact_values(gradients.get(exact_var.as_tensor()).unwrap());
        // Relative to the largest element, so that elements that cancel are not held to their own size.
        let largest = of_candle.iter().fold(1.0f64, |largest, x| largest.max(x.abs()));
        let scaled: Vec<f32> = values(&got).iter().map(|x| (f64::from(*x) / largest) as f32).collect();
        let expected: Vec<f64> = of_candle.iter().map(|x| x / largest).collect();
        assert_close(&format!("{what}: gradient {index}"), &scaled, &expected, gradient_slack);

        let direction = tensor(1000 + index as u64, var.dims(), 1.0).to_dtype(DType::F64).unwrap();
        let step = 1e-5;
        let moved = |sign: f64| {
            let mut tensors = tensors(&exact);
            tensors[index] = (&tensors[index] + (&direction * (sign * step)).unwrap()).unwrap();
            weigh(&composed(&tensors).unwrap()).unwrap().to_scalar::<f64>().unwrap()
        };
        let difference = (moved(1.0) - moved(-1.0)) / (2.0 * step);
        let along: f64 =
            values(&got).iter().zip(exact_values(&direction)).map(|(g, d)| f64::from(*g) * d).sum();
        let allowed = gradient_slack * largest * (var.elem_count() as f64).sqrt() + 1e-4 * difference.abs();
        assert!(
            (along - difference).abs() <= allowed + 1e-6,
            "{what}: gradient {index} along a direction: expected {difference}, got {along} (+-{allowed:e})"
        );
    }
    assert!(collected.is_empty(), "{what}: gradients of other tensors");
}

/// `x W^T + b` over the last axis.
pub(crate) fn linear(x: &Tensor, weight: &Tensor, bias: Option<&Tensor>) -> Result<Tensor> {
    let y = x.broadcast_matmul(&weight.t()?)?;
    bias.map_or(Ok(y.clone()), |bias| y.broadcast_add(bias))
}

/// Normalises along an axis, with the biased variance.
pub(crate) fn normalize(x: &Tensor, axis: usize, epsilon: f64) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(axis)?)?;
    let variance = centred.sqr()?.mean_keepdim(axis)?;
    centred.broadcast_div(&(variance + epsilon)?.sqrt()?)
}
