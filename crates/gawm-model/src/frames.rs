//! From stored bytes to what the encoder sees.

use candle_core::{DType, Device, Tensor};

use gawm_kernels::pixels;

use crate::Result;

/// Channel means that frames are standardised by (ImageNet; red, green, blue).
pub const IMAGE_MEAN: [f32; 3] = [0.485, 0.456, 0.406];
/// Channel standard deviations that frames are standardised by (ImageNet).
pub const IMAGE_STD: [f32; 3] = [0.229, 0.224, 0.225];

/// Standardises 8-bit frames, `(x / 255 - mean) / std` per channel: u8 [B, T, H, W, 3] to f32 [B, T, 3, H, W].
pub fn standardize_frames(frames: &Tensor) -> Result<Tensor> {
    if pixels::takes(frames) {
        return pixels::standardize(frames, IMAGE_MEAN, IMAGE_STD);
    }
    standardize_composed(frames)
}

/// [`standardize_frames`] in composed operations.
fn standardize_composed(frames: &Tensor) -> Result<Tensor> {
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

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fused_and_composed_frames_are_equal() {
        for (b, t, h, w) in [(1, 1, 16, 16), (2, 3, 5, 7), (1, 2, 70, 90), (0, 1, 4, 4)] {
            let bytes: Vec<u8> = (0..b * t * h * w * 3).map(|index| (index * 37 % 256) as u8).collect();
            let frames = Tensor::from_vec(bytes, (b, t, h, w, 3), &Device::Cpu).unwrap();
            let values = |tensor: Tensor| tensor.flatten_all().unwrap().to_vec1::<f32>().unwrap();
            let fused = standardize_frames(&frames).unwrap();
            assert_eq!(fused.dims(), [b, t, 3, h, w]);
            assert_eq!(values(fused), values(standardize_composed(&frames).unwrap()));
        }
    }

    #[test]
    fn other_frames_are_refused() {
        let gray = Tensor::zeros((1, 1, 4, 4, 1), DType::U8, &Device::Cpu).unwrap();
        assert!(standardize_frames(&gray).is_err());
        assert!(standardize_frames(&gray.squeeze(0).unwrap()).is_err());
    }
}
