//! How a forward pass runs: training or not, which random numbers, which precision.

use candle_core::{DType, Tensor};

use crate::Result;
use crate::random::Stream;

/// How a forward pass runs. All randomness of a pass is a function of `seed` and `step`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pass {
    /// Batch statistics in batch norm and dropout on; off means running statistics and no dropout.
    pub training: bool,
    /// Seed of dropout masks, SIGReg projections and permutations.
    pub seed: u64,
    /// Index of the optimiser step; another step draws other numbers.
    pub step: u64,
    /// Type of the operands of matrix products.
    pub precision: Precision,
}

/// Type of the operands of matrix products; everything else is f32.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Precision {
    /// 32-bit throughout.
    #[default]
    F32,
    /// Operands rounded to bf16, results widened to f32; parameters, statistics, norms, softmax and losses stay f32.
    ///
    /// In training on a CPU only the encoder's linear layers are worth rounding: its attention, the predictor and the heads
    /// keep f32 operands there.
    Bf16,
}

impl Pass {
    /// An evaluation pass in f32.
    pub fn eval() -> Pass {
        Pass { training: false, seed: 0, step: 0, precision: Precision::F32 }
    }

    /// A training pass in f32 for the optimiser step `step`.
    pub fn train(seed: u64, step: u64) -> Pass {
        Pass { training: true, seed, step, precision: Precision::F32 }
    }

    /// Opens the random stream of `name` for this step.
    pub fn stream(&self, name: &str) -> Stream {
        Stream::new(self.seed, name, self.step)
    }

    /// Multiplies matrices in the precision of the pass. Shapes [.., M, K] and [.., K, N], f32; returns [.., M, N], f32.
    pub fn matmul(&self, a: &Tensor, b: &Tensor) -> Result<Tensor> {
        match self.precision {
            Precision::F32 => a.matmul(b),
            Precision::Bf16 => {
                a.to_dtype(DType::BF16)?.matmul(&b.to_dtype(DType::BF16)?)?.to_dtype(DType::F32)
            }
        }
    }

    /// Zeroes elements with probability `rate` and scales the others by 1 / (1 - rate), in training only.
    ///
    /// The mask is a function of seed, step, `site` and the position of the element (row-major): word n of the stream
    /// decides element n, so it does not depend on threads, devices or what else ran.
    pub fn dropout(&self, x: &Tensor, rate: f64, site: &str) -> Result<Tensor> {
        if !self.drops(rate) {
            return Ok(x.clone());
        }
        x * Tensor::from_vec(self.dropout_mask(x.elem_count(), rate, site), x.shape(), x.device())?
    }

    /// Whether fused operations in f32 may compute a training pass over `x`: they are for CPUs, where they are faster than
    /// composed ones in any precision.
    pub(crate) fn trains_fused(&self, x: &Tensor) -> bool {
        self.training && x.device().is_cpu()
    }

    /// Whether [`Pass::dropout`] does anything.
    pub(crate) fn drops(&self, rate: f64) -> bool {
        self.training && rate != 0.0
    }

    /// The factors of [`Pass::dropout`] for `count` elements: 0 or 1 / (1 - rate).
    pub(crate) fn dropout_mask(&self, count: usize, rate: f64, site: &str) -> Vec<f32> {
        let threshold = (rate * 4_294_967_296.0) as u32;
        let scale = (1.0 / (1.0 - rate)) as f32;
        let mut stream = self.stream(&format!("dropout/{site}"));
        (0..count).map(|_| if stream.next_u32() < threshold { 0.0 } else { scale }).collect()
    }
}
