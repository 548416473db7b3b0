//! The fused predictor against one composed of candle's differentiable operations.

use candle_core::{D, Device, Result, Tensor, Var};
use gawm_kernels::GradientSink;
use gawm_kernels::predictor::{BlockMasks, Predictor, PredictorShape};

use crate::composed::{check_fused, linear, normalize, tensor, values, variable};
use crate::reference::{at_all_levels, noise};

const SMALL: PredictorShape = PredictorShape {
    clips: 2,
    frames: 3,
    latent: 6,
    heads: 2,
    head_width: 5,
    mlp_width: 11,
    plain_epsilon: 1e-6,
    affine_epsilon: 1e-5,
};

/// Positions of the table, more than there are frames.
const POSITIONS: usize = 5;

fn parameter_shapes(shape: &PredictorShape, depth: usize) -> Vec<Vec<usize>> {
    let (d, f, inner) = (shape.latent, shape.mlp_width, shape.heads * shape.head_width);
    let mut shapes = vec![vec![1, POSITIONS, d], vec![d], vec![d]];
    for _ in 0..depth {
        shapes.extend([vec![6 * d, d], vec![6 * d], vec![d], vec![d], vec![3 * inner, d]]);
        shapes.extend([vec![d, inner], vec![d], vec![d], vec![d], vec![f, d], vec![f], vec![d, f], vec![d]]);
    }
    shapes
}

/// Latents, actions, and parameters.
fn variables(shape: &PredictorShape, depth: usize, size: f64) -> Vec<Var> {
    let tokens = [shape.clips, shape.frames, shape.latent];
    let mut variables = vec![variable(1, &tokens, size), variable(2, &tokens, size)];
    let shapes = parameter_shapes(shape, depth);
    variables.extend(shapes.iter().enumerate().map(|(index, dims)| variable(10 + index as u64, dims, 0.6)));
    variables
}

/// Masks that drop a third.
fn masks(shape: &PredictorShape, depth: usize) -> Vec<BlockMasks> {
    let rows = shape.clips * shape.frames;
    let mask = |seed: usize, count: usize| -> Vec<f32> {
        noise(500 + seed as u64, count).iter().map(|x| if *x < -0.33 { 0.0 } else { 1.5 }).collect()
    };
    let block = |block: usize| BlockMasks {
        probabilities: mask(4 * block, rows * shape.heads * shape.frames),
        attention: mask(4 * block + 1, rows * shape.latent),
        hidden: mask(4 * block + 2, rows * shape.mlp_width),
        mlp: mask(4 * block + 3, rows * shape.latent),
    };
    (0..depth).map(block).collect()
}

fn masked(x: &Tensor, mask: Option<&Vec<f32>>) -> Result<Tensor> {
    match mask {
        Some(mask) => x * Tensor::from_slice(mask, x.shape(), &Device::Cpu)?.to_dtype(x.dtype())?,
        None => Ok(x.clone()),
    }
}

fn composed(shape: &PredictorShape, masks: &[BlockMasks], tensors: &[Tensor]) -> Result<Tensor> {
    let PredictorShape { clips, frames, latent, heads, head_width, .. } = *shape;
    let (outer, blocks) = tensors[2..].split_at(3);
    let affine = |x: &Tensor, weight: &Tensor, bias: &Tensor| {
        normalize(x, 2, f64::from(shape.affine_epsilon))?.broadcast_mul(weight)?.broadcast_add(bias)
    };
    let mut x = tensors[0].broadcast_add(&outer[0].narrow(1, 0, frames)?)?;
    let action = tensors[1].silu()?;
    let unseen: Vec<f64> = (0..frames * frames)
        .map(|index| if index % frames <= index / frames { 0.0 } else { f64::NEG_INFINITY })
        .collect();
    let unseen = Tensor::from_vec(unseen, (frames, frames), &Device::Cpu)?;
    for (index, block) in blocks.chunks(13).enumerate() {
        let mask = masks.get(index);
        let parts = linear(&action, &block[0], Some(&block[1]))?.chunk(6, D::Minus1)?;
        let modulated = |x: &Tensor, shift: &Tensor, scale: &Tensor| {
            (normalize(x, 2, f64::from(shape.plain_epsilon))? * (scale + 1.0)?)? + shift
        };
        let y = affine(&modulated(&x, &parts[0], &parts[1])?, &block[2], &block[3])?;
        let qkv = linear(&y, &block[4], None)?.reshape((clips, frames, 3, heads, head_width))?;
        let part = |which: usize| qkv.narrow(2, which, 1)?.squeeze(2)?.transpose(1, 2)?.contiguous();
        let scores =
            (part(0)?.matmul(&part(1)?.t()?)? / (head_width as f64).sqrt())?.broadcast_add(&unseen)?;
        let weights = scores.broadcast_sub(&scores.max_keepdim(3)?.detach())?.exp()?;
        let weights = weights.broadcast_div(&weights.sum_keepdim(3)?)?;
        let read = masked(&weights, mask.map(|mask| &mask.probabilities))?.matmul(&part(2)?)?;
        let read = read.transpose(1, 2)?.reshape((clips, frames, heads * head_width))?;
        let y = masked(&linear(&read, &block[5], Some(&block[6]))?, mask.map(|mask| &mask.attention))?;
        x = (&x + (&parts[2] * y)?)?;
        let y = affine(&modulated(&x, &parts[3], &parts[4])?, &block[7], &block[8])?;
        let hidden = linear(&y, &block[9], Some(&block[10]))?.gelu_erf()?;
        let y = linear(&masked(&hidden, mask.map(|mask| &mask.hidden))?, &block[11], Some(&block[12]))?;
        x = (&x + (&parts[5] * masked(&y, mask.map(|mask| &mask.mlp))?)?)?;
    }
    affine(&x, &outer[1], &outer[2])?.reshape((clips, frames, latent))
}

fn check_predictor(shape: PredictorShape, depth: usize, size: f64, dropped: bool) {
    let (variables, sink) = (variables(&shape, depth, size), GradientSink::default());
    let masks = if dropped { masks(&shape, depth) } else { Vec::new() };
    let what = format!("{shape:?} of {size}, {depth} blocks, dropout {dropped}");
    check_fused(
        &what,
        &variables,
        2,
        &sink,
        (5e-5, 2e-4),
        |t| composed(&shape, &masks, t),
        |t| {
            let predictor = Predictor::new(t[2..].to_vec(), sink.clone());
            assert!(predictor.takes(&t[0], &t[1]));
            predictor.forward(&t[0], &t[1], shape, masks.clone())
        },
    );
}

#[test]
fn fused_and_composed_predictors_agree() {
    at_all_levels(|| {
        for dropped in [false, true] {
            check_predictor(SMALL, 2, 1.0, dropped);
            check_predictor(PredictorShape { clips: 1, frames: 1, ..SMALL }, 1, 1.0, dropped);
            let odd =
                PredictorShape { frames: 5, latent: 17, heads: 3, head_width: 16, mlp_width: 33, ..SMALL };
            check_predictor(odd, 1, 1.0, dropped);
        }
        check_predictor(SMALL, 1, 30.0, true);
        // Many rows, so that clips and rows are split over threads.
        check_predictor(PredictorShape { clips: 90, mlp_width: 100, ..SMALL }, 1, 1.0, true);
    });
}

#[test]
fn strided_latents_are_taken() {
    let tensors: Vec<Tensor> = variables(&SMALL, 1, 1.0).iter().map(|var| var.as_tensor().clone()).collect();
    let predictor = Predictor::new(tensors[2..].to_vec(), GradientSink::default());
    let longer = tensor(5, &[2, 4, 6], 1.0);
    let strided = longer.narrow(1, 1, 3).unwrap();
    assert!(!strided.is_contiguous());
    let forward = |z: &Tensor| values(&predictor.forward(z, &strided, SMALL, Vec::new()).unwrap());
    at_all_levels(|| assert_eq!(forward(&strided), forward(&strided.contiguous().unwrap())));
}

#[test]
fn threads_do_not_change_a_bit() {
    let shape = PredictorShape { clips: 200, mlp_width: 120, ..SMALL };
    let variables = variables(&shape, 2, 1.0);
    let parameters: Vec<Vec<f32>> = variables.iter().map(|var| values(var.as_tensor())).collect();
    let masks = masks(&shape, 2);
    let dy = noise(7, 200 * 3 * 6);
    let with_threads = |threads| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| {
            let slices: Vec<&[f32]> = parameters.iter().map(|values| &values[..]).collect();
            let (y, state) = shape.forward(slices[0], slices[1], &slices[2..], &masks);
            let gradients = shape.backward(slices[1], &slices[2..], &masks, state, &dy);
            (y, gradients.z, gradients.c, gradients.parameters)
        })
    };
    at_all_levels(|| {
        let one = with_threads(1);
        assert!(one == with_threads(2) && one == with_threads(5));
    });
}

#[test]
fn what_does_not_fit_is_an_error() {
    let tensors: Vec<Tensor> = variables(&SMALL, 2, 1.0).iter().map(|var| var.as_tensor().clone()).collect();
    let predictor = Predictor::new(tensors[2..].to_vec(), GradientSink::default());
    let (z, c) = (&tensors[0], &tensors[1]);
    for shape in [
        PredictorShape { clips: 3, ..SMALL },
        PredictorShape { frames: 6, clips: 1, ..SMALL },
        PredictorShape { heads: 3, ..SMALL },
        PredictorShape { mlp_width: 12, ..SMALL },
        PredictorShape { clips: 0, ..SMALL },
    ] {
        let error = predictor.forward(z, c, shape, Vec::new()).unwrap_err().to_string();
        assert!(error.contains("predictor: expected latents"), "{shape:?}: {error}");
    }
    let error = predictor.forward(z, c, SMALL, masks(&SMALL, 1)).unwrap_err().to_string();
    assert!(error.contains("each of 2 blocks"), "{error}");
    let mut short = masks(&SMALL, 2);
    short[1].hidden.pop();
    assert!(predictor.forward(z, c, SMALL, short).is_err());
    assert!(!predictor.takes(&tensor(1, &[0, 3, 6], 1.0), c));
    let lost = predictor.forward(z, c, SMALL, Vec::new()).unwrap().sum_all().unwrap().backward();
    assert!(lost.err().unwrap().to_string().contains("Gradients::of"));
}
