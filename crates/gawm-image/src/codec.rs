//! Decoders of image files.

use std::io::Cursor;

use png::{BitDepth, ColorType, Transformations};
use tiff::decoder::DecodingResult;
use turbojpeg::{Decompressor, PixelFormat};

use crate::error::ImageError;
use crate::format::{FileFormat, damaged, expect_format, read_header};
use crate::image::{Image, Limits, Pixels};
use crate::transform::to_rgb8;

/// Most progressive scans of a JPEG; more only serve to burn time.
const MAX_SCANS: u32 = 200;

/// Decodes an image file by its content.
///
/// Alpha is dropped. 16-bit colour is reduced to 8 bits; 16-bit grey is kept.
///
/// # Errors
/// [`ImageError`] if the bytes are no JPEG, PNG or TIFF, the image is beyond the limits, or a part of it is missing.
pub fn decode(bytes: &[u8], limits: &Limits) -> Result<Image, ImageError> {
    match expect_format(bytes)? {
        FileFormat::Jpeg => decode_jpeg(bytes, limits),
        FileFormat::Png => decode_png(bytes, limits),
        FileFormat::Tiff => decode_tiff(bytes, limits),
        format => Err(ImageError::UnsupportedFormat { format }),
    }
}

/// Decodes an image file into `out`, shape [height, width, 3], as RGB; a JPEG without another buffer in between.
///
/// # Errors
/// [`ImageError::Mismatch`] if the image is not of this size; otherwise as [`decode`].
pub fn decode_rgb_into(bytes: &[u8], width: u32, height: u32, out: &mut [u8]) -> Result<(), ImageError> {
    let expected = u64::from(width) * u64::from(height) * 3;
    if out.len() as u64 != expected {
        return Err(ImageError::Values { width, height, expected, got: out.len() });
    }
    let limits = Limits { max_pixels: u64::from(width) * u64::from(height) };
    let mismatch = |w: u32, h: u32| ImageError::Mismatch {
        expected_width: width,
        expected_height: height,
        width: w,
        height: h,
    };
    let format = expect_format(bytes)?;
    if matches!(format, FileFormat::Jpeg | FileFormat::Png) {
        let header = read_header(bytes)?;
        if (header.width, header.height) != (width, height) {
            return Err(mismatch(header.width, header.height));
        }
    }
    if format == FileFormat::Jpeg {
        let mut decompressor = decompressor()?;
        return decompress(&mut decompressor, bytes, (width, height), PixelFormat::RGB, out);
    }
    let image = decode(bytes, &limits)?;
    if (image.width(), image.height()) != (width, height) {
        return Err(mismatch(image.width(), image.height()));
    }
    match to_rgb8(image)?.into_pixels() {
        Pixels::Rgb8(values) => out.copy_from_slice(&values),
        other => return Err(ImageError::Unsuitable { target: "rgb8", pixels: other.name() }),
    }
    Ok(())
}

pub(crate) fn jpeg_error(error: &turbojpeg::Error) -> ImageError {
    damaged(FileFormat::Jpeg, error.to_string())
}

pub(crate) fn decompressor() -> Result<Decompressor, ImageError> {
    let mut decompressor = Decompressor::new().map_err(|e| jpeg_error(&e))?;
    decompressor.set_scan_limit(MAX_SCANS).map_err(|e| jpeg_error(&e))?;
    Ok(decompressor)
}

fn decode_jpeg(bytes: &[u8], limits: &Limits) -> Result<Image, ImageError> {
    let mut decompressor = decompressor()?;
    let header = decompressor.read_header(bytes).map_err(|e| jpeg_error(&e))?;
    limits.check(header.width as u64, header.height as u64)?;
    let size =
        (u32::try_from(header.width).unwrap_or(u32::MAX), u32::try_from(header.height).unwrap_or(u32::MAX));
    let is_gray = header.colorspace == turbojpeg::Colorspace::Gray;
    let (format, channels) = if is_gray { (PixelFormat::GRAY, 1) } else { (PixelFormat::RGB, 3) };
    let mut values = vec![0; header.width * header.height * channels];
    decompress(&mut decompressor, bytes, size, format, &mut values)?;
    let pixels = if is_gray { Pixels::Gray8(values) } else { Pixels::Rgb8(values) };
    Image::try_new(size.0, size.1, pixels)
}

fn decompress(
    decompressor: &mut Decompressor,
    bytes: &[u8],
    (width, height): (u32, u32),
    format: PixelFormat,
    out: &mut [u8],
) -> Result<(), ImageError> {
    // The header is read again, since this one is what the decoder goes by.
    let header = decompressor.read_header(bytes).map_err(|e| jpeg_error(&e))?;
    let (w, h) = (width as usize, height as usize);
    if (header.width, header.height) != (w, h) {
        return Err(damaged(FileFormat::Jpeg, "it has frame headers of different sizes"));
    }
    let image = turbojpeg::Image { pixels: out, width: w, pitch: w * format.size(), height: h, format };
    match decompressor.decompress(bytes, image) {
        Ok(()) => Ok(()),
        // Some cameras pad between segments. The decoder steps over it; the picture is whole.
        Err(turbojpeg::Error::TurboJpegError(text)) if text.contains("extraneous bytes before marker") => {
            Ok(())
        }
        Err(error) => Err(jpeg_error(&error)),
    }
}

fn decode_png(bytes: &[u8], limits: &Limits) -> Result<Image, ImageError> {
    let wrap = |e: png::DecodingError| damaged(FileFormat::Png, e.to_string());
    let header = read_header(bytes)?;
    limits.check(u64::from(header.width), u64::from(header.height))?;
    // Rows of 16-bit RGBA, twice, and what chunks such as colour profiles may take.
    let bytes_cap =
        usize::try_from(limits.max_pixels.saturating_mul(8)).unwrap_or(usize::MAX).saturating_add(1 << 22);
    let mut decoder = png::Decoder::new_with_limits(Cursor::new(bytes), png::Limits { bytes: bytes_cap });
    decoder.set_transformations(Transformations::EXPAND);
    decoder.set_ignore_text_chunk(true);
    decoder.set_ignore_iccp_chunk(true);
    let mut reader = decoder.read_info().map_err(wrap)?;
    let size = reader.output_buffer_size().ok_or_else(|| damaged(FileFormat::Png, "its size overflows"))?;
    let mut values = vec![0; size];
    let info = reader.next_frame(&mut values).map_err(wrap)?;
    reader.finish().map_err(wrap)?;
    values.truncate(info.buffer_size());
    let channels = info.color_type.samples();
    let is_gray = matches!(info.color_type, ColorType::Grayscale | ColorType::GrayscaleAlpha);
    let pixels = match (info.bit_depth, is_gray) {
        (BitDepth::Sixteen, true) => Pixels::Gray16(
            values.chunks_exact(2 * channels).map(|p| u16::from_be_bytes([p[0], p[1]])).collect(),
        ),
        (BitDepth::Sixteen, false) => {
            Pixels::Rgb8(values.chunks_exact(2 * channels).flat_map(|p| [p[0], p[2], p[4]]).collect())
        }
        (_, true) if channels == 1 => Pixels::Gray8(values),
        (_, true) => Pixels::Gray8(values.chunks_exact(channels).map(|p| p[0]).collect()),
        (_, false) if channels == 3 => Pixels::Rgb8(values),
        (_, false) => Pixels::Rgb8(values.chunks_exact(channels).flat_map(|p| [p[0], p[1], p[2]]).collect()),
    };
    Image::try_new(info.width, info.height, pixels)
}

fn decode_tiff(bytes: &[u8], limits: &Limits) -> Result<Image, ImageError> {
    let wrap = |e: tiff::TiffError| damaged(FileFormat::Tiff, e.to_string());
    let cap = usize::try_from(limits.max_pixels.saturating_mul(4)).unwrap_or(usize::MAX);
    let mut decoder_limits = tiff::decoder::Limits::default();
    decoder_limits.decoding_buffer_size =
        decoder_limits.decoding_buffer_size.min(cap.saturating_add(1 << 16));
    let mut decoder =
        tiff::decoder::Decoder::new(Cursor::new(bytes)).map_err(wrap)?.with_limits(decoder_limits);
    let (width, height) = decoder.dimensions().map_err(wrap)?;
    limits.check(u64::from(width), u64::from(height))?;
    let color = decoder.colortype().map_err(wrap)?;
    let pixels = match (color, decoder.read_image().map_err(wrap)?) {
        (tiff::ColorType::Gray(8), DecodingResult::U8(values)) => Pixels::Gray8(values),
        (tiff::ColorType::Gray(16), DecodingResult::U16(values)) => Pixels::Gray16(values),
        (tiff::ColorType::Gray(32), DecodingResult::F32(values)) => Pixels::GrayF32(values),
        (tiff::ColorType::RGB(8), DecodingResult::U8(values)) => Pixels::Rgb8(values),
        (color, _) => {
            return Err(damaged(FileFormat::Tiff, format!("pixels of type {color:?} are not supported")));
        }
    };
    Image::try_new(width, height, pixels)
}
