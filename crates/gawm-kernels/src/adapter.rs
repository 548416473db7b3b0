//! The transformer as a candle operation.
//!
//! A candle operation takes at most three tensors and keeps nothing for its backward pass. [`VitEncoder`] therefore takes
//! frames and position table as tensors, holds its parameters itself, keeps forward values in the operation, and puts the
//! gradients of its parameters into a [`GradientSink`] that the caller of the backward pass reads.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::ThreadId;

use candle_core::{CpuStorage, CustomOp2, DType, Device, Layout, Result, Shape, Storage, Tensor, TensorId};

use crate::vit::{Images, Vit, VitShape, VitState};

/// Where operations put the gradients of parameters that are not their inputs.
///
/// Shared by the operations of a model and whoever runs the backward pass: [`GradientSink::collect`].
#[derive(Debug, Clone, Default)]
pub struct GradientSink {
    /// Held while a backward pass runs.
    turn: Arc<Mutex<()>>,
    collection: Arc<Mutex<Option<Collection>>>,
}

/// Gradients of a backward pass that runs on one thread.
#[derive(Debug)]
struct Collection {
    thread: ThreadId,
    gradients: HashMap<TensorId, Tensor>,
}

impl GradientSink {
    /// Runs a backward pass and returns its result with the gradients that operations put here meanwhile.
    ///
    /// Backward passes over one sink take turns.
    pub fn collect<T>(&self, backward: impl FnOnce() -> Result<T>) -> Result<(T, HashMap<TensorId, Tensor>)> {
        let _turn = lock(&self.turn);
        let thread = std::thread::current().id();
        *lock(&self.collection) = Some(Collection { thread, gradients: HashMap::new() });
        let result = backward();
        let collection = lock(&self.collection).take();
        Ok((result?, collection.map(|collection| collection.gradients).unwrap_or_default()))
    }

    /// Whether the backward pass of this thread is collected.
    pub(crate) fn collects(&self) -> bool {
        let thread = std::thread::current().id();
        lock(&self.collection).as_ref().is_some_and(|collection| collection.thread == thread)
    }

    /// Adds a gradient. Shape as the parameter's.
    ///
    /// # Errors
    ///
    /// - if nobody collects: the gradient would be lost.
    pub(crate) fn put(&self, parameter: &Tensor, gradient: Tensor) -> Result<()> {
        let thread = std::thread::current().id();
        let mut collection = lock(&self.collection);
        let Some(Collection { gradients, .. }) = collection.as_mut().filter(|c| c.thread == thread) else {
            candle_core::bail!(
                "backward pass through the encoder: expected a collector of its gradients, got none (detach the latents, or use Gradients::of)"
            );
        };
        let sum = match gradients.remove(&parameter.id()) {
            Some(before) => (before + gradient)?,
            None => gradient,
        };
        gradients.insert(parameter.id(), sum);
        Ok(())
    }
}

/// A vision transformer on the CPU, from frames to class tokens.
#[derive(Debug, Clone)]
pub struct VitEncoder(Arc<Inner>);

#[derive(Debug)]
struct Inner {
    vit: Vit,
    parameters: Vec<Tensor>,
    sink: GradientSink,
}

impl VitEncoder {
    /// Makes an encoder of parameters in the order of [`crate::vit`], sharing their storage.
    pub fn new(parameters: Vec<Tensor>, sink: GradientSink) -> VitEncoder {
        VitEncoder(Arc::new(Inner { vit: Vit::new(), parameters, sink }))
    }

    /// Whether [`VitEncoder::forward`] computes this: f32 on the CPU, and no gradient of the frames is asked for.
    pub fn takes(images: &Tensor) -> bool {
        images.device().is_cpu() && images.dtype() == DType::F32 && !images.track_op()
    }

    /// Maps images [N, C, H, W] to normalised class tokens [N, W']. `positions` has shape [1, tokens, W'].
    ///
    /// `keep` keeps values for the backward pass; without it, a backward pass computes them again.
    ///
    /// # Errors
    ///
    /// - if shapes do not fit `shape`.
    pub fn forward(
        &self,
        images: &Tensor,
        positions: &Tensor,
        shape: VitShape,
        keep: bool,
    ) -> Result<Tensor> {
        let (_, c, h, w) = images.dims4()?;
        let fits = c == shape.channels && h >= shape.rows * shape.patch && w >= shape.columns * shape.patch;
        if !fits || shape.rows == 0 || shape.columns == 0 {
            candle_core::bail!(
                "encoder: expected images of {} channels that hold {} x {} patches of {}, got {:?}",
                shape.channels,
                shape.rows,
                shape.columns,
                shape.patch,
                images.dims()
            );
        }
        if positions.elem_count() != shape.tokens() * shape.width {
            candle_core::bail!(
                "encoder: expected {} positions of width {}, got {:?}",
                shape.tokens(),
                shape.width,
                positions.dims()
            );
        }
        let operation = Encode { encoder: self.clone(), shape, keep, state: Mutex::new(None) };
        images.contiguous()?.apply_op2(&positions.contiguous()?, operation)
    }
}

/// One forward pass, and what its backward pass needs.
struct Encode {
    encoder: VitEncoder,
    shape: VitShape,
    keep: bool,
    state: Mutex<Option<VitState>>,
}

impl Drop for Encode {
    fn drop(&mut self) {
        if let Some(state) = lock(&self.state).take() {
            self.encoder.0.vit.discard(state);
        }
    }
}

impl Encode {
    /// Views a contiguous [N, C, H, W] as images.
    fn images<'a>(values: &'a [f32], dims: &[usize]) -> Images<'a> {
        Images::new(values, dims[1], dims[2], dims[3])
    }

    fn run(
        &self,
        images: Images<'_>,
        positions: &[f32],
        keep: bool,
        output: &mut [f32],
    ) -> Result<Option<VitState>> {
        let Inner { vit, parameters, .. } = &*self.encoder.0;
        with_values(parameters, |parameters| {
            Ok(vit.forward(&self.shape, images, parameters, positions, keep, output))
        })
    }
}

impl CustomOp2 for Encode {
    fn name(&self) -> &'static str {
        "vit-encode"
    }

    fn cpu_fwd(
        &self,
        images: &CpuStorage,
        l1: &Layout,
        positions: &CpuStorage,
        l2: &Layout,
    ) -> Result<(CpuStorage, Shape)> {
        let images = Encode::images(contiguous(images.as_slice()?, l1)?, l1.dims());
        let mut output = vec![0.0; images.count() * self.shape.width];
        let positions = contiguous(positions.as_slice()?, l2)?;
        *lock(&self.state) = self.run(images, positions, self.keep, &mut output)?;
        Ok((CpuStorage::F32(output), (images.count(), self.shape.width).into()))
    }

    fn bwd(
        &self,
        images: &Tensor,
        positions: &Tensor,
        _: &Tensor,
        d_output: &Tensor,
    ) -> Result<(Option<Tensor>, Option<Tensor>)> {
        let Inner { vit, parameters, sink } = &*self.encoder.0;
        let kept = lock(&self.state).take();
        let gradients =
            with_values(&[images.clone(), positions.clone(), d_output.contiguous()?], |values| {
                let view = Encode::images(values[0], images.dims());
                let state = match kept {
                    Some(state) => Some(state),
                    None => {
                        let mut output = vec![0.0; view.count() * self.shape.width];
                        self.run(view, values[1], true, &mut output)?
                    }
                };
                let Some(state) = state else {
                    candle_core::bail!("vit-encode: a pass that keeps its values returned none")
                };
                with_values(parameters, |parameters| {
                    Ok(vit.backward(&self.shape, view, parameters, state, values[2]))
                })
            })?;
        for (parameter, gradient) in parameters.iter().zip(gradients.parameters) {
            sink.put(parameter, Tensor::from_vec(gradient, parameter.shape(), &Device::Cpu)?)?;
        }
        Ok((None, Some(Tensor::from_vec(gradients.positions, positions.shape(), &Device::Cpu)?)))
    }
}

/// Calls `work` with the values of contiguous f32 tensors on the CPU.
pub(crate) fn with_values<T>(tensors: &[Tensor], work: impl FnOnce(&[&[f32]]) -> Result<T>) -> Result<T> {
    let guards: Vec<_> = tensors.iter().map(Tensor::storage_and_layout).collect();
    let values = guards.iter().map(|(storage, layout)| match &**storage {
        Storage::Cpu(storage) => contiguous(storage.as_slice()?, layout),
        _ => candle_core::bail!("kernels: expected a tensor on the CPU"),
    });
    work(&values.collect::<Result<Vec<_>>>()?)
}

/// The elements of a contiguous layout.
pub(crate) fn contiguous<'a>(values: &'a [f32], layout: &Layout) -> Result<&'a [f32]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&values[start..end]),
        None => candle_core::bail!("kernels: expected a contiguous tensor, got {layout:?}"),
    }
}

/// Runs `work` on a thread of the pool, so that the parallel loops inside do not each hand over to one and wait.
pub(crate) fn in_pool<T: Send>(work: impl FnOnce() -> T + Send) -> T {
    rayon::scope(|_| work())
}

/// Whether a tensor is f32 on the CPU.
pub(crate) fn is_plain(tensor: &Tensor) -> bool {
    tensor.device().is_cpu() && tensor.dtype() == DType::F32
}

/// Whether a tensor is a variable whose values lie in a row: its gradient can go to a [`GradientSink`].
pub(crate) fn is_parameter(tensor: &Tensor) -> bool {
    is_plain(tensor) && tensor.is_variable() && tensor.is_contiguous()
}

/// Locks a value that is whole between any two statements, so that a panic elsewhere does not spoil it.
pub(crate) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}
