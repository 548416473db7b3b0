//! Pixels of an encoded image, whatever its format.

use std::io::Cursor;

use thiserror::Error;
use tiff::decoder::DecodingResult;

/// A decoded image, row-major with interleaved channels.
#[derive(Debug, Clone, PartialEq)]
pub struct Pixels {
    /// Rows.
    pub height: usize,
    /// Columns.
    pub width: usize,
    /// Channels per pixel.
    pub channels: usize,
    /// `height * width * channels` values.
    pub values: PixelValues,
}

/// The values of a decoded image.
#[derive(Debug, Clone, PartialEq)]
pub enum PixelValues {
    /// 8 bits.
    U8(Vec<u8>),
    /// 16 bits.
    U16(Vec<u16>),
    /// 32-bit floats.
    F32(Vec<f32>),
}

/// Why an image cannot be decoded.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DecodePixelsError {
    /// Neither JPEG nor PNG nor TIFF.
    #[error("unknown image format, expected JPEG, PNG or TIFF")]
    UnknownFormat,
    /// The decoder refuses the bytes.
    #[error("{format} cannot be decoded: {reason}")]
    Damaged {
        /// The format that the first bytes announce.
        format: &'static str,
        /// What the decoder says.
        reason: String,
    },
    /// The image is larger than allowed, or of a sample type that robots do not record.
    #[error("{format} has {what}, which is not supported")]
    Unsupported {
        /// The format.
        format: &'static str,
        /// What is not supported.
        what: String,
    },
}

/// Most bytes that a decoded image may take: a declared size is no reason to allocate it.
const MAX_DECODED_BYTES: usize = 1 << 29;

/// Decodes a JPEG, PNG or TIFF file; colour JPEG gives RGB, a palette is expanded, 16-bit samples stay 16-bit.
///
/// # Errors
/// - the bytes are of no known format, cut or damaged;
/// - the image would take more than 512 MiB or has another sample type than u8, u16 or f32.
pub fn decode_pixels(bytes: &[u8]) -> Result<Pixels, DecodePixelsError> {
    match bytes {
        [0xff, 0xd8, 0xff, ..] => decode_jpeg(bytes),
        [0x89, b'P', b'N', b'G', ..] => decode_png(bytes),
        [b'I', b'I', 42, 0, ..] | [b'M', b'M', 0, 42, ..] => decode_tiff(bytes),
        _ => Err(DecodePixelsError::UnknownFormat),
    }
}

fn damaged(format: &'static str, reason: impl std::fmt::Display) -> DecodePixelsError {
    DecodePixelsError::Damaged { format, reason: reason.to_string() }
}

fn check_size(format: &'static str, sides: [usize; 3]) -> Result<(), DecodePixelsError> {
    let size = sides.iter().try_fold(1usize, |size, &side| size.checked_mul(side));
    if size.is_some_and(|size| size <= MAX_DECODED_BYTES) {
        return Ok(());
    }
    let [height, width, bytes] = sides;
    Err(DecodePixelsError::Unsupported { format, what: format!("{height}x{width} pixels of {bytes} bytes") })
}

fn decode_jpeg(bytes: &[u8]) -> Result<Pixels, DecodePixelsError> {
    let format = "JPEG";
    let header = turbojpeg::read_header(bytes).map_err(|error| damaged(format, error))?;
    check_size(format, [header.height, header.width, 3])?;
    let is_grey = header.colorspace == turbojpeg::Colorspace::Gray;
    let (pixel_format, channels) =
        if is_grey { (turbojpeg::PixelFormat::GRAY, 1) } else { (turbojpeg::PixelFormat::RGB, 3) };
    let image = turbojpeg::decompress(bytes, pixel_format).map_err(|error| damaged(format, error))?;
    // turbojpeg pads no row: the pitch is width times channels.
    Ok(Pixels { height: image.height, width: image.width, channels, values: PixelValues::U8(image.pixels) })
}

fn decode_png(bytes: &[u8]) -> Result<Pixels, DecodePixelsError> {
    let format = "PNG";
    let mut decoder =
        png::Decoder::new_with_limits(Cursor::new(bytes), png::Limits { bytes: MAX_DECODED_BYTES });
    decoder.set_transformations(png::Transformations::EXPAND);
    let mut reader = decoder.read_info().map_err(|error| damaged(format, error))?;
    let size = reader.output_buffer_size().filter(|&size| size <= MAX_DECODED_BYTES);
    let size =
        size.ok_or_else(|| DecodePixelsError::Unsupported { format, what: "too many pixels".to_owned() })?;
    let mut buffer = vec![0; size];
    let info = reader.next_frame(&mut buffer).map_err(|error| damaged(format, error))?;
    buffer.truncate(info.buffer_size());
    let values = match info.bit_depth {
        png::BitDepth::Sixteen => PixelValues::U16(
            buffer.chunks_exact(2).map(|pair| u16::from_be_bytes([pair[0], pair[1]])).collect(),
        ),
        _ => PixelValues::U8(buffer),
    };
    let channels = info.color_type.samples();
    Ok(Pixels { height: info.height as usize, width: info.width as usize, channels, values })
}

fn decode_tiff(bytes: &[u8]) -> Result<Pixels, DecodePixelsError> {
    let format = "TIFF";
    let mut limits = tiff::decoder::Limits::default();
    limits.decoding_buffer_size = MAX_DECODED_BYTES;
    let mut decoder = tiff::decoder::Decoder::new(Cursor::new(bytes))
        .map_err(|error| damaged(format, error))?
        .with_limits(limits);
    let (width, height) = decoder.dimensions().map_err(|error| damaged(format, error))?;
    let (width, height) = (width as usize, height as usize);
    let values = match decoder.read_image().map_err(|error| damaged(format, error))? {
        DecodingResult::U8(values) => PixelValues::U8(values),
        DecodingResult::U16(values) => PixelValues::U16(values),
        DecodingResult::F32(values) => PixelValues::F32(values),
        _ => return Err(DecodePixelsError::Unsupported { format, what: "another sample type".to_owned() }),
    };
    let length = match &values {
        PixelValues::U8(values) => values.len(),
        PixelValues::U16(values) => values.len(),
        PixelValues::F32(values) => values.len(),
    };
    let n_pixels = height.saturating_mul(width);
    if n_pixels == 0 || !length.is_multiple_of(n_pixels) {
        return Err(damaged(format, format!("{length} samples for {height}x{width} pixels")));
    }
    Ok(Pixels { height, width, channels: length / n_pixels, values })
}
