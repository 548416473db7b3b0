//! The predictor as a candle operation of latents and embedded actions.

use std::sync::{Arc, Mutex};

use candle_core::{CpuStorage, CustomOp2, Device, Layout, Result, Shape, Tensor};

use super::block::{CONTRACT, EXPAND, MLP_NORM, MODULATION, OUTPUT};
use super::{BLOCK_PARAMETERS, BlockMasks, OUTER_PARAMETERS, PredictorShape, PredictorState};
use crate::adapter::{GradientSink, contiguous, in_pool, is_parameter, is_plain, lock, with_values};

/// A predictor whose parameters are tensors of a model.
#[derive(Debug, Clone)]
pub struct Predictor(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    parameters: Vec<Tensor>,
    sink: GradientSink,
}

impl Predictor {
    /// Makes a predictor of parameters in the order of [`OUTER_PARAMETERS`] and [`BLOCK_PARAMETERS`], sharing their
    /// storage.
    pub fn new(parameters: Vec<Tensor>, sink: GradientSink) -> Predictor {
        Predictor(Arc::new(Inner { parameters, sink }))
    }

    /// Whether [`Predictor::forward`] computes this: f32 on the CPU, and parameters that are variables there.
    pub fn takes(&self, z: &Tensor, c: &Tensor) -> bool {
        is_plain(z) && is_plain(c) && z.elem_count() > 0 && self.0.parameters.iter().all(is_parameter)
    }

    /// Maps latents `z` under embedded actions `c`, both of the shape's size, to an output of the shape of `z`.
    ///
    /// Gradients of the parameters go to the sink. `masks` holds one element per block, or none for a pass without dropout.
    ///
    /// # Errors
    ///
    /// - if sizes do not fit.
    pub fn forward(
        &self,
        z: &Tensor,
        c: &Tensor,
        shape: PredictorShape,
        masks: Vec<BlockMasks>,
    ) -> Result<Tensor> {
        self.check(z, c, &shape)?;
        check_masks(&masks, &shape, self.blocks())?;
        let operation = Operation { predictor: self.clone(), shape, masks, state: Mutex::new(None) };
        z.contiguous()?.apply_op2(&c.contiguous()?, operation)
    }

    fn blocks(&self) -> usize {
        self.0.parameters.len().saturating_sub(OUTER_PARAMETERS) / BLOCK_PARAMETERS
    }

    fn check(&self, z: &Tensor, c: &Tensor, shape: &PredictorShape) -> Result<()> {
        let (d, f, inner) = (shape.latent, shape.mlp_width, shape.inner());
        let counts: Vec<usize> = self.0.parameters.iter().map(Tensor::elem_count).collect();
        let complete = counts.len() == OUTER_PARAMETERS + self.blocks() * BLOCK_PARAMETERS;
        let fit = |counts: &[usize]| {
            let weights = [(MODULATION, 6 * d, d), (OUTPUT, d, inner), (EXPAND, f, d), (CONTRACT, d, f)];
            let norms = [2, MLP_NORM].iter().all(|&norm| counts[norm..norm + 2] == [d, d]);
            let linear = |&(which, outputs, inputs): &(usize, usize, usize)| {
                counts[which..which + 2] == [outputs * inputs, outputs]
            };
            norms && weights.iter().all(linear) && counts[4] == 3 * inner * d
        };
        let size = shape.rows() * d;
        let fits = complete
            && size > 0
            && inner > 0
            && [z.elem_count(), c.elem_count()] == [size; 2]
            && counts[0] >= shape.frames * d
            && counts[1..3] == [d, d]
            && counts[OUTER_PARAMETERS..].chunks_exact(BLOCK_PARAMETERS).all(fit);
        if !fits {
            candle_core::bail!(
                "predictor: expected latents, actions and parameters of {shape:?}, got {:?}, {:?} and sizes {counts:?}",
                z.dims(),
                c.dims()
            );
        }
        Ok(())
    }
}

fn check_masks(masks: &[BlockMasks], shape: &PredictorShape, blocks: usize) -> Result<()> {
    let rows = shape.rows();
    let expected =
        [rows * shape.heads * shape.frames, rows * shape.latent, rows * shape.mlp_width, rows * shape.latent];
    let sizes = |masks: &BlockMasks| {
        [masks.probabilities.len(), masks.attention.len(), masks.hidden.len(), masks.mlp.len()]
    };
    if !(masks.is_empty() || masks.len() == blocks) || masks.iter().any(|masks| sizes(masks) != expected) {
        candle_core::bail!(
            "predictor: expected masks of sizes {expected:?} for each of {blocks} blocks, got {:?}",
            masks.iter().map(sizes).collect::<Vec<_>>()
        );
    }
    Ok(())
}

/// One pass, and what its backward pass needs.
struct Operation {
    predictor: Predictor,
    shape: PredictorShape,
    masks: Vec<BlockMasks>,
    state: Mutex<Option<PredictorState>>,
}

impl Operation {
    fn run(&self, z: &[f32], c: &[f32]) -> Result<(Vec<f32>, PredictorState)> {
        with_values(&self.predictor.0.parameters, |parameters| {
            in_pool(|| Ok(self.shape.forward(z, c, parameters, &self.masks)))
        })
    }
}

impl CustomOp2 for Operation {
    fn name(&self) -> &'static str {
        "predictor"
    }

    fn cpu_fwd(
        &self,
        z: &CpuStorage,
        l1: &Layout,
        c: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let (y, state) = self.run(contiguous(z.as_slice()?, l1)?, contiguous(c.as_slice()?, l2)?)?;
        *lock(&self.state) = Some(state);
        Ok((CpuStorage::F32(y), l1.shape().clone()))
    }

    fn bwd(
        &self,
        z: &Tensor,
        c: &Tensor,
        _: &Tensor,
        dy: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let Inner { parameters, sink } = &*self.predictor.0;
        let kept = lock(&self.state).take();
        let gradients = with_values(&[z.clone(), c.clone(), dy.contiguous()?], |values| {
            let state = match kept {
                Some(state) => state,
                None => self.run(values[0], values[1])?.1,
            };
            with_values(parameters, |parameters| {
                in_pool(|| Ok(self.shape.backward(values[1], parameters, &self.masks, state, values[2])))
            })
        })?;
        for (parameter, gradient) in parameters.iter().zip(gradients.parameters) {
            sink.put(parameter, Tensor::from_vec(gradient, parameter.shape(), &Device::Cpu)?)?;
        }
        let of = |values: Vec<f32>, like: &Tensor| Tensor::from_vec(values, like.shape(), &Device::Cpu);
        Ok((Some(of(gradients.z, z)?), Some(of(gradients.c, c)?)))
    }
}
