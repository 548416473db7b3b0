//! The fused transformer against one composed of candle's differentiable operations: values and every gradient.

use candle_core::{D, DType, Device, IndexOp, Result, Tensor, Var};
use gawm_kernels::vit::{Products, VitShape};
use gawm_kernels::{GradientSink, VitEncoder};

use crate::reference::{assert_close, at_all_levels, noise};

fn parameter_shapes(shape: &VitShape) -> Vec<Vec<usize>> {
    let (w, f) = (shape.width, shape.mlp_width);
    let mut shapes = vec![vec![w, shape.patch_values()], vec![w], vec![w], vec![w], vec![w]];
    for _ in 0..shape.depth {
        shapes.extend([vec![w], vec![w]]);
        shapes.extend((0..4).flat_map(|_| [vec![w, w], vec![w]]));
        shapes.extend([vec![w], vec![w], vec![f, w], vec![f], vec![w, f], vec![w]]);
    }
    shapes
}

fn linear(x: &Tensor, weight: &Tensor, bias: &Tensor) -> Result<Tensor> {
    x.broadcast_matmul(&weight.t()?)?.broadcast_add(bias)
}

fn layer_norm(x: &Tensor, weight: &Tensor, bias: &Tensor, epsilon: f64) -> Result<Tensor> {
    let centred = x.broadcast_sub(&x.mean_keepdim(D::Minus1)?)?;
    let variance = centred.sqr()?.mean_keepdim(D::Minus1)?;
    centred.broadcast_div(&(variance + epsilon)?.sqrt()?)?.broadcast_mul(weight)?.broadcast_add(bias)
}

/// The class tokens of images [N, C, H, W], in composed operations.
fn composed(shape: &VitShape, images: &Tensor, positions: &Tensor, parameters: &[Tensor]) -> Result<Tensor> {
    let (n, c, _, _) = images.dims4()?;
    let (p, epsilon) = (shape.patch, f64::from(shape.epsilon));
    let images = images.i((.., .., ..shape.rows * p, ..shape.columns * p))?;
    let patches = images.reshape(&[n, c, shape.rows, p, shape.columns, p])?.permute([0, 2, 4, 1, 3, 5])?;
    let patches = patches.reshape((n, shape.rows * shape.columns, shape.patch_values()))?;
    let x = linear(&patches, &parameters[0], &parameters[1])?;
    let class = parameters[2].reshape((1, 1, shape.width))?.broadcast_as((n, 1, shape.width))?;
    let mut x = Tensor::cat(&[&class, &x], 1)?.broadcast_add(positions)?;
    for layer in parameters[5..].chunks(16) {
        let y = layer_norm(&x, &layer[0], &layer[1], epsilon)?;
        let heads = |which: usize| {
            let split = (n, shape.tokens(), shape.heads, shape.width / shape.heads);
            linear(&y, &layer[which], &layer[which + 1])?.reshape(split)?.transpose(1, 2)?.contiguous()
        };
        let (q, k, v) = (heads(2)?, heads(4)?, heads(6)?);
        let scores = (q.matmul(&k.t()?)? / ((shape.width / shape.heads) as f64).sqrt())?;
        let exponentials = scores.broadcast_sub(&scores.max_keepdim(D::Minus1)?.detach())?.exp()?;
        let weights = exponentials.broadcast_div(&exponentials.sum_keepdim(D::Minus1)?)?;
        let y = weights.matmul(&v)?.transpose(1, 2)?.reshape((n, shape.tokens(), shape.width))?;
        x = (x + linear(&y, &layer[8], &layer[9])?)?;
        let y = layer_norm(&x, &layer[10], &layer[11], epsilon)?;
        x = (&x + linear(&linear(&y, &layer[12], &layer[13])?.gelu_erf()?, &layer[14], &layer[15])?)?;
    }
    layer_norm(&x, &parameters[3], &parameters[4], epsilon)?.i((.., 0))
}

/// Gradients are sums of up to 3675 terms of order one, in f32.
const GRADIENT: f64 = 2e-4;

struct Case {
    shape: VitShape,
    images: Tensor,
    d_output: Tensor,
    positions: Var,
    parameters: Vec<Var>,
}

fn tensor(seed: u64, dims: &[usize], size: f64) -> Tensor {
    (Tensor::from_vec(noise(seed, dims.iter().product()), dims, &Device::Cpu).unwrap() * size).unwrap()
}

/// `extra` pixels lie beyond the last whole patch.
fn case(shape: VitShape, n: usize, extra: usize) -> Case {
    let (height, width) = (shape.rows * shape.patch + extra, shape.columns * shape.patch + extra);
    let parameters = parameter_shapes(&shape).into_iter().enumerate().map(|(index, dims)| {
        let value = tensor(100 + index as u64, &dims, 0.4);
        let is_norm = matches!(index, 3) || (index >= 5 && matches!((index - 5) % 16, 0 | 10));
        Var::from_tensor(&if is_norm { (value + 1.0).unwrap() } else { value }).unwrap()
    });
    Case {
        shape,
        images: tensor(1, &[n, shape.channels, height, width], 1.0),
        d_output: tensor(2, &[n, shape.width], 1.0),
        positions: Var::from_tensor(&tensor(3, &[1, shape.tokens(), shape.width], 0.5)).unwrap(),
        parameters: parameters.collect(),
    }
}

fn values(tensor: &Tensor) -> Vec<f32> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn exact_values(tensor: &Tensor) -> Vec<f64> {
    tensor.flatten_all().unwrap().to_vec1().unwrap()
}

fn check_case(case: &Case, keep: bool) {
    let Case { shape, images, d_output, positions, parameters } = case;
    let exact = |tensor: &Tensor| Var::from_tensor(&tensor.to_dtype(DType::F64).unwrap()).unwrap();
    let exact_positions = exact(positions);
    let exact_parameters: Vec<Var> = parameters.iter().map(|var| exact(var)).collect();
    let tensors: Vec<Tensor> = exact_parameters.iter().map(|var| var.as_tensor().clone()).collect();
    let expected = composed(shape, &exact(images), &exact_positions, &tensors).unwrap();
    let loss = (&expected * d_output.to_dtype(DType::F64).unwrap()).unwrap().sum_all().unwrap();
    let expected_gradients = loss.backward().unwrap();
    let expected_gradient = |var: &Var| exact_values(expected_gradients.get(var.as_tensor()).unwrap());
    let tensors: Vec<Tensor> = parameters.iter().map(|var| var.as_tensor().clone()).collect();

    let sink = GradientSink::default();
    let encoder = VitEncoder::new(tensors, sink.clone());
    // Twice, so that memory kept from a pass is used again.
    for _ in 0..2 {
        let got = encoder.forward(images, positions, *shape, keep).unwrap();
        let what = format!("{shape:?} on {:?}", images.dims());
        assert_close(&what, &values(&got), &exact_values(&expected), 2e-5);
        let loss = (&got * d_output).unwrap().sum_all().unwrap();
        let (mut own, mut fused) = sink.collect(|| loss.backward()).unwrap();
        let of_positions = own.remove(positions.as_tensor()).unwrap();
        let expected = expected_gradient(&exact_positions);
        assert_close(&format!("{what}: positions"), &values(&of_positions), &expected, GRADIENT);
        for (index, (parameter, exact)) in parameters.iter().zip(&exact_parameters).enumerate() {
            let gradient = fused.remove(&parameter.as_tensor().id()).unwrap();
            assert_eq!(gradient.dims(), parameter.dims());
            let what = format!("{what}: parameter {index}");
            assert_close(&what, &values(&gradient), &expected_gradient(exact), GRADIENT);
        }
        assert!(fused.is_empty());
    }
}

const SMALL: VitShape = VitShape {
    patch: 2,
    rows: 2,
    columns: 3,
    channels: 3,
    width: 6,
    depth: 2,
    heads: 2,
    mlp_width: 10,
    epsilon: 1e-5,
    products: Products::Single,
};

#[test]
fn fused_and_composed_encoders_agree() {
    at_all_levels(|| {
        check_case(&case(SMALL, 1, 0), true);
        check_case(&case(VitShape { depth: 1, channels: 1, ..SMALL }, 3, 1), true);
        let odd = VitShape { rows: 5, columns: 4, width: 33, heads: 3, mlp_width: 47, ..SMALL };
        check_case(&case(odd, 2, 1), true);
        let wide = VitShape { rows: 7, columns: 7, width: 32, heads: 2, mlp_width: 40, ..SMALL };
        // Thirteen chunks of six images or fewer, in seven groups.
        check_case(&case(wide, 75, 0), true);
    });
}

#[test]
fn values_that_were_not_kept_are_computed_again() {
    at_all_levels(|| check_case(&case(SMALL, 4, 0), false));
}

#[test]
fn strided_images_are_taken() {
    let Case { shape, images, positions, parameters, .. } = case(SMALL, 4, 0);
    let tensors = parameters.iter().map(|var| var.as_tensor().clone()).collect();
    let encoder = VitEncoder::new(tensors, GradientSink::default());
    let forward = |images: &Tensor| values(&encoder.forward(images, &positions, shape, false).unwrap());
    let strided = images.narrow(0, 1, 2).unwrap().transpose(2, 3).unwrap().contiguous().unwrap();
    let strided = strided.transpose(2, 3).unwrap();
    assert!(!strided.is_contiguous());
    at_all_levels(|| assert_eq!(forward(&strided), forward(&images)[shape.width..3 * shape.width]));
}

#[test]
fn what_does_not_fit_is_an_error() {
    let Case { shape, images, positions, parameters, .. } = case(SMALL, 1, 0);
    let tensors: Vec<Tensor> = parameters.iter().map(|var| var.as_tensor().clone()).collect();
    let encoder = VitEncoder::new(tensors, GradientSink::default());
    let error = |images: &Tensor, positions: &Tensor, shape| {
        encoder.forward(images, positions, shape, false).unwrap_err().to_string()
    };
    let taller = VitShape { rows: 3, ..shape };
    assert!(error(&images, &positions, taller).contains("expected images"));
    let short = positions.narrow(1, 0, 6).unwrap();
    assert!(error(&images, &short, shape).contains("expected 7 positions"));
    at_all_levels(|| lost_gradients_are_an_error(&encoder, &images, &positions, shape));
}

fn lost_gradients_are_an_error(encoder: &VitEncoder, images: &Tensor, positions: &Tensor, shape: VitShape) {
    // Without a collector the gradients of parameters would be lost.
    let output = encoder.forward(images, positions, shape, true).unwrap();
    let error = output.sum_all().unwrap().backward().err().unwrap().to_string();
    assert!(error.contains("Gradients::of"), "{error}");
}
