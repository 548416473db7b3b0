//! Depth as the ROS transport `compressedDepth` packs it: a header of 12 bytes, then a 16-bit PNG.

use crate::codec::decode;
use crate::error::ImageError;
use crate::format::{FileFormat, PNG_MAGIC, damaged};
use crate::image::{Image, Limits, Pixels};

/// Bytes before the PNG: a format number and two quantisation parameters.
const HEADER: usize = 12;

/// Tells by content whether bytes are a PNG behind the header of `compressedDepth`.
pub fn is_compressed_depth(bytes: &[u8]) -> bool {
    bytes.get(HEADER..).is_some_and(|rest| rest.starts_with(&PNG_MAGIC)) && crate::sniff(bytes).is_none()
}

/// Decodes a `compressedDepth` message: 16-bit depth as it is, float depth (`32FC1; compressedDepth`) back to its unit.
///
/// # Errors
/// [`ImageError`] if the PNG is damaged, beyond the limits or not of 16 bits, or the data is packed by RVL.
pub fn decode_compressed_depth(format: &str, bytes: &[u8], limits: &Limits) -> Result<Image, ImageError> {
    if !is_compressed_depth(bytes) {
        let detail = if format.contains("rvl") {
            "RVL depth is not supported"
        } else {
            "expected a PNG behind 12 bytes of header"
        };
        return Err(damaged(FileFormat::Png, detail));
    }
    let image = decode(&bytes[HEADER..], limits)?;
    if !format.trim_start().to_ascii_uppercase().starts_with("32FC1") {
        return Ok(image);
    }
    let Pixels::Gray16(values) = image.pixels() else {
        return Err(damaged(FileFormat::Png, "expected a 16-bit PNG in compressed float depth"));
    };
    let parameter = |at: usize| f32::from_le_bytes([bytes[at], bytes[at + 1], bytes[at + 2], bytes[at + 3]]);
    let (a, b) = (parameter(4), parameter(8));
    // The transport stores a / depth + b; 0 stands for no measurement.
    let depth = values.iter().map(|v| if *v == 0 { f32::NAN } else { a / (f32::from(*v) - b) }).collect();
    Image::try_new(image.width(), image.height(), Pixels::GrayF32(depth))
}
