//! Roll-outs of candle tensors, with the weights arranged once for as long as they do not change.

use std::sync::{Arc, Mutex, PoisonError};

use candle_core::{DType, Device, Result, Tensor};
use rayon::prelude::*;

use super::{Rollout, RolloutParameters, RolloutShape};
use crate::adapter::with_values;
use crate::simd::vectorized;

/// The tensors that [`RolloutParameters`] views, in its order.
#[derive(Debug, Clone)]
pub struct RolloutTensors {
    /// Action embedder.
    pub embedder: [Tensor; 6],
    /// Position table.
    pub positions: Tensor,
    /// Blocks.
    pub blocks: Vec<[Tensor; 13]>,
    /// Last norm.
    pub norm: [Tensor; 2],
    /// Projector.
    pub projector: [Tensor; 8],
}

/// A predictor on the CPU that rolls latents forward without gradients.
///
/// Its tensors may change between calls: a fingerprint of their values decides whether the arranged weights still hold.
#[derive(Debug, Clone)]
pub struct Roller {
    shape: RolloutShape,
    tensors: Arc<Vec<Tensor>>,
    n_blocks: usize,
    ready: Arc<Mutex<Option<Ready>>>,
}

/// Arranged weights, and the fingerprint of the values that they were made of.
#[derive(Debug)]
struct Ready {
    fingerprint: u64,
    rollout: Arc<Rollout>,
}

impl Roller {
    /// Makes a roller of tensors, sharing their storage.
    pub fn new(shape: RolloutShape, tensors: RolloutTensors) -> Roller {
        let n_blocks = tensors.blocks.len();
        let mut all: Vec<Tensor> = tensors.embedder.to_vec();
        all.push(tensors.positions);
        all.extend(tensors.norm);
        all.extend(tensors.projector);
        all.extend(tensors.blocks.into_iter().flatten());
        Roller { shape, tensors: Arc::new(all), n_blocks, ready: Arc::default() }
    }

    /// Whether [`Roller::run`] takes tensors: all f32 on the CPU.
    pub fn takes(&self, z: &Tensor, actions: &Tensor) -> bool {
        let plain = |tensor: &Tensor| tensor.device().is_cpu() && tensor.dtype() == DType::F32;
        self.n_blocks > 0
            && plain(z)
            && plain(actions)
            && self.tensors.iter().all(|t| plain(t) && t.is_contiguous())
    }

    /// Rolls latents forward: `z` [N, frames, D] and `actions` [N, C, A] to [N, C - frames + 1, D] (see [`Rollout::run`]).
    /// No gradient follows.
    ///
    /// # Errors
    ///
    /// - if the shapes do not fit each other or the predictor.
    pub fn run(&self, z: &Tensor, actions: &Tensor) -> Result<Tensor> {
        let ((n, frames, d), (rows, chunks, a)) = (z.dims3()?, actions.dims3()?);
        if n != rows || d != self.shape.latent || a != self.shape.action || frames == 0 || chunks < frames {
            candle_core::bail!(
                "rollout: expected latents [N, frames, {}] and actions [N, at least frames, {}], got {:?} and {:?}",
                self.shape.latent,
                self.shape.action,
                z.dims(),
                actions.dims()
            );
        }
        let rollout = self.ready()?;
        let mut output = vec![0.0; n * (chunks - frames + 1) * d];
        with_values(&[z.contiguous()?, actions.contiguous()?], |values| {
            rollout.run(values[0], values[1], [n, frames, chunks], &mut output);
            Ok(())
        })?;
        Tensor::from_vec(output, (n, chunks - frames + 1, d), &Device::Cpu)
    }

    /// Returns arranged weights that hold for the present values.
    fn ready(&self) -> Result<Arc<Rollout>> {
        with_values(&self.tensors, |values| {
            let present = fingerprint(values);
            let mut ready = self.ready.lock().unwrap_or_else(PoisonError::into_inner);
            if let Some(ready) = ready.as_ref().filter(|ready| ready.fingerprint == present) {
                return Ok(Arc::clone(&ready.rollout));
            }
            let rollout = Arc::new(Rollout::new(self.shape, &parameters(values)));
            *ready = Some(Ready { fingerprint: present, rollout: Arc::clone(&rollout) });
            Ok(rollout)
        })
    }
}

/// Views values in the order of [`Roller::new`].
fn parameters<'a>(values: &[&'a [f32]]) -> RolloutParameters<'a> {
    RolloutParameters {
        embedder: std::array::from_fn(|index| values[index]),
        positions: values[6],
        norm: std::array::from_fn(|index| values[7 + index]),
        projector: std::array::from_fn(|index| values[9 + index]),
        blocks: values[17..]
            .chunks_exact(13)
            .map(|block| std::array::from_fn(|index| block[index]))
            .collect(),
    }
}

/// Values that one thread hashes at once.
const BLOCK: usize = 64 * 1024;

/// Returns a hash of all bits, and of the level that panels are made for; far cheaper than arranging the weights.
fn fingerprint(values: &[&[f32]]) -> u64 {
    let tensors = values.par_iter().map(|values| {
        let blocks: Vec<u64> = values.par_chunks(BLOCK).map(hash_block).collect();
        blocks.into_iter().fold(values.len() as u64, mix)
    });
    let hashes: Vec<u64> = tensors.collect();
    hashes.into_iter().fold(crate::simd::level() as u64, mix)
}

fn mix(hash: u64, word: u64) -> u64 {
    (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29)
}

vectorized! {
    /// Sixteen interleaved multiplicative hashes of 32 bits, mixed: every step is a bijection of the state, so that a
    /// single changed value always changes the result of its lane.
    fn hash_block(values: &[f32]) -> u64 {
        let mut lanes: [u32; 16] = std::array::from_fn(|lane| lane as u32);
        let mut others = lanes;
        let mut chunks = values.chunks_exact(16);
        for chunk in &mut chunks {
            for ((lane, other), value) in lanes.iter_mut().zip(&mut others).zip(chunk) {
                *lane = (*lane ^ value.to_bits()).wrapping_mul(0x9e37_79b1);
                *other = other.wrapping_add(*lane ^ (*lane >> 15));
            }
        }
        for (lane, value) in lanes.iter_mut().zip(chunks.remainder()) {
            *lane = (*lane ^ value.to_bits()).wrapping_mul(0x9e37_79b1);
        }
        let words = lanes.iter().zip(&others).map(|(a, b)| u64::from(*a) << 32 | u64::from(*b));
        words.fold(0, mix)
    }
}
