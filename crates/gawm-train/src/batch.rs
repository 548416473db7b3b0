//! From a view of a slot to tensors on the device: the one copy.

use gawm_model::objective::{ClipsError, StateRule};
use gawm_model::{Clips, Device, Tensor, standardize_frames};
use gawm_schema::batch::{BatchShape, BatchView, Hello};
use rayon::prelude::*;
use thiserror::Error;

/// A batch on the device; the slot that it came from is not needed any more.
#[derive(Debug, Clone)]
pub struct Batch {
    /// What the objectives see.
    pub clips: Clips,
    /// Which clips these are.
    pub clip_ids: Vec<u64>,
}

/// Why a view cannot become tensors.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum UploadError {
    /// A rule for states names a dim that the data does not have.
    #[error("train.{field}: expected names of state dims, one of {known:?}, got {name:?}")]
    Dim {
        /// `supervised` or `velocity`.
        field: &'static str,
        /// The name given.
        name: String,
        /// What the data has.
        known: Vec<String>,
    },
    /// The tensors do not fit each other.
    #[error(transparent)]
    Clips(#[from] ClipsError),
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

/// Puts batches on a device.
#[derive(Debug)]
pub struct Uploader {
    device: Device,
    rule: StateRule,
    /// Standardised value of each byte, per channel; the same numbers that [`standardize_frames`] gives.
    table: [[f32; 256]; 3],
}

impl Uploader {
    /// Prepares the upload of batches of the run that `hello` describes.
    ///
    /// # Errors
    ///
    /// - [`UploadError::Dim`] if a name in `supervised` or `velocity` is no dim of the state.
    pub fn new(
        device: &Device,
        hello: &Hello,
        supervised: Option<&[String]>,
        velocity: &[String],
    ) -> Result<Uploader, UploadError> {
        let dims = |field: &'static str, names: &[String]| -> Result<Vec<usize>, UploadError> {
            let find = |name: &String| {
                let found = hello.state.dims.iter().position(|dim| dim.name == *name);
                found.ok_or_else(|| UploadError::Dim {
                    field,
                    name: name.clone(),
                    known: hello.state.dims.iter().map(|dim| dim.name.clone()).collect(),
                })
            };
            names.iter().map(find).collect()
        };
        let rule = StateRule {
            supervised: supervised.map(|names| dims("supervised", names)).transpose()?,
            velocity: dims("velocity", velocity)?,
        };
        Ok(Uploader { device: device.clone(), rule, table: standardised_bytes()? })
    }

    /// Copies a batch to the device: frames standardised on the way, states and actions as they are.
    ///
    /// Several views are put side by side into one wide frame; a single channel stands for all three.
    /// Chunks that are not whole (the one that leaves the clip) become zero, the mean action.
    ///
    /// # Errors
    ///
    /// - [`UploadError`] if the device or the shapes refuse.
    pub fn upload(&self, view: &BatchView<'_>) -> Result<Batch, UploadError> {
        let BatchShape { clips: b, frames: t, action_width, state_width, .. } = *view.shape();
        let device = &self.device;
        let frames = self.frames(view)?; // [B, T, 3, H, V*W]

        let chunks = view.actions().chunks_exact(action_width).zip(view.action_mask());
        let zero = vec![0.0; action_width];
        let actions: Vec<f32> =
            chunks.flat_map(|(chunk, valid)| if *valid == 0 { &zero[..] } else { chunk }).copied().collect();
        let actions = Tensor::from_vec(actions, (b, t, action_width), device)?; // [B, T, A]

        let clips = if state_width == 0 {
            // A tensor without elements is of no use to candle; no term looks at this one.
            let states = Tensor::zeros((b, t, 1), gawm_model::DType::F32, device)?;
            Clips::try_new(frames, actions, states, None, &StateRule::default())?
        } else {
            let shape = (b, t, state_width);
            let states = Tensor::from_slice(view.states(), shape, device)?; // [B, T, S]
            let valid: Vec<u8> = view.state_mask().iter().map(|valid| u8::from(*valid != 0)).collect();
            let valid = Tensor::from_vec(valid, shape, device)?; // [B, T, S]
            Clips::try_new(frames, actions, states, Some(&valid), &self.rule)?
        };
        Ok(Batch { clips, clip_ids: view.clip_ids().to_vec() })
    }

    /// Standardises frames: u8 [B, T, V, H, W, C] to f32 [B, T, 3, H, V*W].
    fn frames(&self, view: &BatchView<'_>) -> Result<Tensor, UploadError> {
        let BatchShape { clips: b, frames: t, views, height, width, channels, .. } = *view.shape();
        if self.device.is_cpu() {
            // In one pass from the slot; candle would make four copies.
            let (image, pixels) = (views * height * width * channels, views * height * width);
            let mut frames = vec![0f32; b * t * 3 * pixels];
            frames
                .par_chunks_exact_mut(3 * pixels)
                .zip(view.frames().par_chunks_exact(image))
                .for_each(|(frame, image)| self.standardize(frame, image, [views, height, width, channels]));
            return Ok(Tensor::from_vec(frames, (b, t, 3, height, views * width), &self.device)?);
        }
        let shape = (b * t, views, height, width, channels);
        let frames = Tensor::from_slice(view.frames(), shape, &self.device)?;
        let frames = frames.transpose(1, 2)?.reshape((b, t, height, views * width, channels))?;
        let frames = frames.broadcast_as((b, t, height, views * width, 3))?.contiguous()?;
        Ok(standardize_frames(&frames)?) // [B, T, 3, H, V*W]
    }

    /// One image, [V, H, W, C] to [3, H, V*W].
    fn standardize(&self, frame: &mut [f32], image: &[u8], [views, height, width, channels]: [usize; 4]) {
        let plane = height * views * width;
        for (index, row) in image.chunks_exact(width * channels).enumerate() {
            let (view, y) = (index / height, index % height);
            let start = (y * views + view) * width;
            for (channel, table) in self.table.iter().enumerate() {
                let source = row.iter().skip(channel.min(channels - 1)).step_by(channels);
                let target = &mut frame[channel * plane + start..][..width];
                for (value, byte) in target.iter_mut().zip(source) {
                    *value = table[usize::from(*byte)];
                }
            }
        }
    }
}

/// Asks the model for the standardised value of every byte, so that both ways give the same bits.
fn standardised_bytes() -> Result<[[f32; 256]; 3], UploadError> {
    let bytes: Vec<u8> = (0..=255u8).flat_map(|byte| [byte; 3]).collect();
    let bytes = Tensor::from_vec(bytes, (1, 1, 1, 256, 3), &Device::Cpu)?;
    let values = standardize_frames(&bytes)?.flatten_all()?.to_vec1::<f32>()?; // [3 * 256]
    let mut table = [[0.0; 256]; 3];
    for (channel, values) in table.iter_mut().zip(values.chunks_exact(256)) {
        channel.copy_from_slice(values);
    }
    Ok(table)
}
