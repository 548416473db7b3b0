//! Encoders of image files. The same image gives the same bytes.

use std::io::Cursor;

use png::{BitDepth, ColorType, Compression};
use tiff::encoder::{Compression as TiffCompression, DeflateLevel, TiffEncoder, colortype};
use turbojpeg::{Compressor, PixelFormat, Subsamp};

use crate::error::ImageError;
use crate::format::FileFormat;
use crate::image::{Image, Pixels};

/// Encodes a lossless PNG: 8-bit RGB or grey, or 16-bit grey.
///
/// # Errors
/// [`ImageError::Unsuitable`] for floats, which PNG cannot hold; [`ImageError::Encode`] if the encoder fails.
pub fn encode_png(image: &Image) -> Result<Vec<u8>, ImageError> {
    let wrap = |e: png::EncodingError| ImageError::Encode { format: FileFormat::Png, detail: e.to_string() };
    let swapped: Vec<u8>;
    let (color, depth, values): (_, _, &[u8]) = match image.pixels() {
        Pixels::Rgb8(values) => (ColorType::Rgb, BitDepth::Eight, values),
        Pixels::Gray8(values) => (ColorType::Grayscale, BitDepth::Eight, values),
        Pixels::Gray16(values) => {
            swapped = values.iter().flat_map(|v| v.to_be_bytes()).collect();
            (ColorType::Grayscale, BitDepth::Sixteen, &swapped)
        }
        Pixels::GrayF32(_) => {
            return Err(ImageError::Unsuitable { target: "PNG", pixels: image.pixels().name() });
        }
    };
    let mut out = Vec::new();
    let mut encoder = png::Encoder::new(&mut out, image.width(), image.height());
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(Compression::Fast);
    let mut writer = encoder.write_header().map_err(wrap)?;
    writer.write_image_data(values).map_err(wrap)?;
    writer.finish().map_err(wrap)?;
    Ok(out)
}

/// Encodes a JPEG of `quality` 1 to 100, colour at half resolution (4:2:0).
///
/// # Errors
/// [`ImageError::Unsuitable`] for 16-bit and float pixels; [`ImageError::Encode`] if the encoder fails.
pub fn encode_jpeg(image: &Image, quality: u8) -> Result<Vec<u8>, ImageError> {
    let wrap = |e: turbojpeg::Error| ImageError::Encode { format: FileFormat::Jpeg, detail: e.to_string() };
    let (values, format, subsamp) = match image.pixels() {
        Pixels::Rgb8(values) => (values, PixelFormat::RGB, Subsamp::Sub2x2),
        Pixels::Gray8(values) => (values, PixelFormat::GRAY, Subsamp::Gray),
        other => return Err(ImageError::Unsuitable { target: "JPEG", pixels: other.name() }),
    };
    let mut compressor = Compressor::new().map_err(wrap)?;
    compressor.set_quality(i32::from(quality.clamp(1, 100))).map_err(wrap)?;
    compressor.set_subsamp(subsamp).map_err(wrap)?;
    let (width, height) = (image.width() as usize, image.height() as usize);
    let view = turbojpeg::Image { pixels: &values[..], width, pitch: width * format.size(), height, format };
    compressor.compress_to_vec(view).map_err(wrap)
}

/// Encodes a lossless TIFF (deflate): the file for float depth, which others open too.
///
/// # Errors
/// [`ImageError::Encode`] if the encoder fails.
pub fn encode_tiff(image: &Image) -> Result<Vec<u8>, ImageError> {
    let wrap = |e: tiff::TiffError| ImageError::Encode { format: FileFormat::Tiff, detail: e.to_string() };
    let mut out = Cursor::new(Vec::new());
    let mut encoder = TiffEncoder::new(&mut out)
        .map_err(wrap)?
        .with_compression(TiffCompression::Deflate(DeflateLevel::Fast));
    let (width, height) = (image.width(), image.height());
    match image.pixels() {
        Pixels::Rgb8(values) => encoder.write_image::<colortype::RGB8>(width, height, values),
        Pixels::Gray8(values) => encoder.write_image::<colortype::Gray8>(width, height, values),
        Pixels::Gray16(values) => encoder.write_image::<colortype::Gray16>(width, height, values),
        Pixels::GrayF32(values) => encoder.write_image::<colortype::Gray32Float>(width, height, values),
    }
    .map_err(wrap)?;
    Ok(out.into_inner())
}
