//! Stored bytes to standardised planes: `(x / 255 - mean) / std` per channel, in one pass.

use candle_core::{CpuStorage, DType, Device, Result, Storage, Tensor};
use rayon::prelude::*;

/// Pixels of an image that one thread works on at once.
const BLOCK: usize = 4096;

/// Standardises 8-bit frames with three channels: u8 [B, T, H, W, 3] to f32 [B, T, 3, H, W].
///
/// # Errors
///
/// - if `frames` is not a contiguous u8 tensor of that shape on the CPU.
pub fn standardize(frames: &Tensor, mean: [f32; 3], std: [f32; 3]) -> Result<Tensor> {
    let (b, t, h, w, c) = frames.dims5()?;
    if c != 3 {
        candle_core::bail!("frames: expected 3 channels last, got {:?}", frames.dims());
    }
    let table = tables(mean, std);
    let mut planes = vec![0f32; frames.elem_count()];
    let (storage, layout) = frames.storage_and_layout();
    let (Storage::Cpu(CpuStorage::U8(bytes)), Some((start, end))) = (&*storage, layout.contiguous_offsets())
    else {
        candle_core::bail!(
            "frames: expected contiguous bytes on the CPU, got {:?} {layout:?}",
            frames.dtype()
        );
    };
    let images = bytes[start..end].par_chunks_exact((h * w * 3).max(1));
    planes.par_chunks_exact_mut((h * w * 3).max(1)).zip(images).for_each(|(planes, bytes)| {
        let (red, rest) = planes.split_at_mut(h * w);
        let (green, blue) = rest.split_at_mut(h * w);
        let blocks = red.chunks_mut(BLOCK).zip(green.chunks_mut(BLOCK)).zip(blue.chunks_mut(BLOCK));
        for (((red, green), blue), bytes) in blocks.zip(bytes.chunks(3 * BLOCK)) {
            separate(bytes, [red, green, blue], &table);
        }
    });
    Tensor::from_vec(planes, (b, t, 3, h, w), &Device::Cpu)
}

/// Whether [`standardize`] takes frames.
pub fn takes(frames: &Tensor) -> bool {
    frames.device().is_cpu()
        && frames.dtype() == DType::U8
        && frames.is_contiguous()
        && frames.dims().len() == 5
        && frames.dims()[4] == 3
}

/// The standardised value of every byte, per channel: computed as the composed form does, so that both are equal to the
/// bit.
fn tables(mean: [f32; 3], std: [f32; 3]) -> [[f32; 256]; 3] {
    // The composed form multiplies by the reciprocal of 255 in f32.
    let scale = (1.0 / 255.0) as f32;
    std::array::from_fn(|channel| {
        std::array::from_fn(|byte| (byte as f32 * scale - mean[channel]) / std[channel])
    })
}

/// Separates interleaved pixels into three planes, through the tables.
fn separate(bytes: &[u8], [red, green, blue]: [&mut [f32]; 3], tables: &[[f32; 256]; 3]) {
    let planes = red.iter_mut().zip(green).zip(blue);
    for (((red, green), blue), pixel) in planes.zip(bytes.chunks_exact(3)) {
        *red = tables[0][usize::from(pixel[0])];
        *green = tables[1][usize::from(pixel[1])];
        *blue = tables[2][usize::from(pixel[2])];
    }
}
