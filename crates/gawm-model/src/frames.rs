//! From stored bytes to what the encoder sees.

use candle_core::{DType, Device, Tensor};

use crate::Result;

/// Channel means that frames are standardised by (ImageNet; red, green, blue).
pub const IMAGE_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Channel standard deviations that frames are standardised by (ImageNet).
pub const IMAGE_STD: [f32; 3] = [0.229, 0.224, 0.225];

/// Standardises 8-bit frames, `(x / 255 - mean) / std` per channel: u8 [B, T, H, W, 3] to f32 [B, T, 3, H, W].
pub fn standardize_frames(frames: &Tensor) -> Result<Tensor> {
    let (b, t, h, w, c) = frames.dims5()?;
    let device = frames.device();
    let frames = (frames.to_dtype(DType::F32)? / 255.0)?;
    let frames = frames.broadcast_sub(&channels(IMAGE_MEAN, device)?)?;
    let frames = frames.broadcast_div(&channels(IMAGE_STD, device)?)?;
    let frames = frames.reshape((b * t, h * w, c))?.transpose(1, 2)?; // [B*T, C, H*W]
    frames.reshape((b, t, c, h, w)) // [B, T, C, H, W]
}

/// Shape [3], to be broadcast over the last axis.
fn channels(values: [f32; 3], device: &Device) -> Result<Tensor> {
    Tensor::from_slice(&values, 3, device)
}
