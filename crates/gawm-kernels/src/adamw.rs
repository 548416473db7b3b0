//! AdamW over all parameters in one pass: each value is read and written once.

use std::sync::Mutex;

use candle_core::{CpuStorage, InplaceOp1, Layout, Result, Tensor};
use rayon::prelude::*;

use crate::adapter::{contiguous, with_values};
use crate::profile::{Kind, span};
use crate::simd::{mul_add, sum, vectorized};

/// Numbers of one step that hold for all parameters.
///
/// ```text
/// g = scale * gradient
/// m = b1 m + (1 - b1) g;  v = b2 v + (1 - b2) g^2
/// p = kept * p - size * m / (sqrt(v) * root + eps)
/// ```
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AdamWStep {
    /// Decay of the first moment.
    pub beta1: f32,
    /// Decay of the second moment.
    pub beta2: f32,
    /// Added to the root of the second moment.
    pub epsilon: f32,
    /// What clipping leaves of a gradient.
    pub scale: f32,
    /// Rate, corrected for the start of the first moment: `rate / (1 - b1^t)`.
    pub size: f32,
    /// Correction for the start of the second moment: `1 / sqrt(1 - b2^t)`.
    pub root: f32,
}

/// One parameter of a step.
#[derive(Debug)]
pub struct AdamWJob<'a> {
    /// The parameter, updated in place; contiguous f32 on the CPU.
    pub parameter: &'a Tensor,
    /// Its gradient, of the same shape; contiguous f32 on the CPU.
    pub gradient: &'a Tensor,
    /// First moment.
    pub first: &'a mut [f32],
    /// Second moment.
    pub second: &'a mut [f32],
    /// What weight decay leaves of the parameter: `1 - rate * decay`.
    pub kept: f32,
}

/// Elements that one thread works on at once.
const BLOCK: usize = 32 * 1024;

/// Updates all parameters and their moments. The result does not depend on the number of threads.
///
/// # Errors
///
/// - if a tensor is not as [`AdamWJob`] wants it, or lengths differ; others may have been updated then.
pub fn adamw(jobs: Vec<AdamWJob<'_>>, step: &AdamWStep) -> Result<()> {
    jobs.into_par_iter().try_for_each(|job| {
        let AdamWJob { parameter, gradient, first, second, kept } = job;
        with_values(std::slice::from_ref(gradient), |values| {
            let count = parameter.elem_count();
            if [values[0].len(), first.len(), second.len()] != [count; 3] {
                candle_core::bail!(
                    "adamw: expected {count} gradients and moments, got {}, {} and {}",
                    values[0].len(),
                    first.len(),
                    second.len()
                );
            }
            parameter.inplace_op1(&Update {
                gradient: values[0],
                moments: Mutex::new((first, second)),
                kept,
                step,
            })
        })
    })
}

struct Update<'a> {
    gradient: &'a [f32],
    moments: Mutex<(&'a mut [f32], &'a mut [f32])>,
    kept: f32,
    step: &'a AdamWStep,
}

impl InplaceOp1 for Update<'_> {
    fn name(&self) -> &'static str {
        "adamw"
    }

    fn cpu_fwd(&self, storage: &mut CpuStorage, layout: &Layout) -> Result<()> {
        let CpuStorage::F32(values) = storage else {
            candle_core::bail!("adamw: expected f32 parameters, got {:?}", layout.shape());
        };
        let Some((start, end)) = layout.contiguous_offsets() else {
            candle_core::bail!("adamw: expected a contiguous parameter, got {layout:?}");
        };
        let mut moments = self.moments.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let (first, second) = &mut *moments;
        let blocks = values[start..end].par_chunks_mut(BLOCK).zip(self.gradient.par_chunks(BLOCK));
        let moments = first.par_chunks_mut(BLOCK).zip(second.par_chunks_mut(BLOCK));
        blocks.zip(moments).for_each(|((parameter, gradient), (first, second))| {
            span(Kind::Optimizer, 0, || update(self.step, self.kept, parameter, gradient, first, second));
        });
        Ok(())
    }
}

vectorized! {
    /// Updates parameters and moments of equal length.
    pub fn update(
        step: &AdamWStep,
        kept: f32,
        parameter: &mut [f32],
        gradient: &[f32],
        first: &mut [f32],
        second: &mut [f32],
    ) {
        let (new1, new2) = (1.0 - step.beta1, 1.0 - step.beta2);
        let moments = first.iter_mut().zip(second.iter_mut());
        for ((p, g), (m, v)) in parameter.iter_mut().zip(gradient).zip(moments) {
            let g = g * step.scale;
            *m = mul_add::<FMA>(step.beta1, *m, new1 * g);
            *v = mul_add::<FMA>(step.beta2, *v, new2 * (g * g));
            let denominator = mul_add::<FMA>(v.sqrt(), step.root, step.epsilon);
            *p = mul_add::<FMA>(kept, *p, -(step.size * (*m / denominator)));
        }
    }

    /// Returns the sum of squares of at most [`BLOCK`] values.
    fn sum_of_squares(x: &[f32]) -> f32 {
        let mut total = 0.0;
        for x in x.chunks(1024) {
            let mut squares = [0f32; 1024];
            for (square, x) in squares.iter_mut().zip(x) {
                *square = x * x;
            }
            total += sum(&squares[..x.len()]);
        }
        total
    }
}

/// Returns the sum of squares of all values of contiguous f32 tensors on the CPU, added up in f64 in a fixed order.
///
/// # Errors
///
/// - if a tensor is not of that kind.
pub fn squared_norm(tensors: &[&Tensor]) -> Result<f64> {
    let sums: Result<Vec<f64>> = tensors
        .par_iter()
        .map(|tensor| {
            let (storage, layout) = tensor.storage_and_layout();
            let candle_core::Storage::Cpu(storage) = &*storage else {
                candle_core::bail!("norm: expected a tensor on the CPU");
            };
            let values = contiguous(storage.as_slice::<f32>()?, layout)?;
            let blocks: Vec<f32> =
                span(Kind::Optimizer, 0, || values.chunks(BLOCK).map(sum_of_squares).collect());
            Ok(blocks.into_iter().map(f64::from).sum())
        })
        .collect();
    Ok(sums?.into_iter().sum())
}
