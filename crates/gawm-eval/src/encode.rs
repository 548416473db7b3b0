//! Frames to latents, in blocks of a fixed size on all threads.

use gawm_image::{Image, ImageError, Pixels, resize};
use gawm_model::{Device, Pass, Tensor, WorldModel, standardize_frames};
use gawm_sim::Frame;
use rayon::prelude::*;

/// Frames that go through the encoder at once. The last block is filled up with black frames, so that a latent does not
/// depend on how many frames are encoded with it.
const FRAMES_PER_BLOCK: usize = 16;

/// Resizes a frame as the loader does: bilinear with antialiasing. Returns RGB [H, W, 3].
///
/// # Errors
/// The frame's bytes do not fit its size, or the target size cannot be.
pub fn fit_frame(frame: &Frame, (height, width): (usize, usize)) -> Result<Vec<u8>, ImageError> {
    if (frame.width, frame.height) == (width, height) {
        return Ok(frame.rgb.clone());
    }
    let image = Image::try_new(frame.width as u32, frame.height as u32, Pixels::Rgb8(frame.rgb.clone()))?;
    match resize(&image, width as u32, height as u32)?.into_pixels() {
        Pixels::Rgb8(values) => Ok(values),
        other => Err(ImageError::Unsuitable { target: "rgb8", pixels: other.name() }),
    }
}

/// Encodes frames, each [H, W, 3], to latents [N, D], row-major.
///
/// # Errors
/// candle failed.
pub fn encode_frames(
    model: &WorldModel,
    frames: &[Vec<u8>],
    (height, width): (usize, usize),
) -> candle_core::Result<Vec<f32>> {
    let device = device(model);
    let n_bytes = height * width * 3;
    let encode = |block: &[Vec<u8>]| {
        let mut bytes = Vec::with_capacity(FRAMES_PER_BLOCK * n_bytes);
        for frame in block {
            if frame.len() != n_bytes {
                candle_core::bail!(
                    "frame: expected {n_bytes} bytes ({height}x{width}x3), got {}",
                    frame.len()
                );
            }
            bytes.extend_from_slice(frame);
        }
        bytes.resize(FRAMES_PER_BLOCK * n_bytes, 0);
        let frames = Tensor::from_vec(bytes, (FRAMES_PER_BLOCK, 1, height, width, 3), &device)?;
        let z = model.encode(&standardize_frames(&frames)?, &Pass::eval())?; // [16, 1, D]
        let mut z = z.flatten_all()?.to_vec1::<f32>()?; // Sync: waits for the device.
        z.truncate(block.len() * model.architecture().config().latent_width);
        Ok(z)
    };
    let blocks: Vec<candle_core::Result<Vec<f32>>> =
        frames.par_chunks(FRAMES_PER_BLOCK).map(encode).collect();
    Ok(blocks.into_iter().collect::<candle_core::Result<Vec<_>>>()?.concat())
}

/// Returns where the tensors of a model are.
pub fn device(model: &WorldModel) -> Device {
    model.parameters().iter().next().map_or(Device::Cpu, |(_, tensor)| tensor.device().clone())
}
