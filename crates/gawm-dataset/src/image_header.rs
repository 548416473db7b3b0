//! What the first bytes of an image file say about it.

use thiserror::Error;

/// Format and size of an encoded image.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ImageHeader {
    /// The file format.
    pub format: ImageFormat,
    /// Rows of pixels.
    pub height: u32,
    /// Columns of pixels.
    pub width: u32,
    /// Channels per pixel: 1 grey, 2 grey with alpha, 3 colour, 4 colour with alpha.
    pub channels: u32,
}

/// File formats that a dataset may hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum ImageFormat {
    /// JPEG.
    Jpeg,
    /// PNG.
    Png,
    /// TIFF, for 32-bit depth.
    Tiff,
}

/// Why bytes are not taken as an image.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
#[non_exhaustive]
pub enum ImageHeaderError {
    /// Neither JPEG nor PNG nor TIFF.
    #[error("unknown image format, expected JPEG, PNG or TIFF, got {length} bytes beginning {start:02x?}")]
    UnknownFormat {
        /// Up to eight first bytes.
        start: Vec<u8>,
        /// Number of bytes.
        length: usize,
    },
    /// The header ends early or contradicts itself.
    #[error("{format:?} header is damaged at byte {offset}")]
    Damaged {
        /// The format that the first bytes announce.
        format: ImageFormat,
        /// Where reading stopped.
        offset: usize,
    },
}

/// Reads format and size from the header of an encoded image without decoding it.
///
/// # Errors
/// - the bytes are neither JPEG nor PNG nor TIFF;
/// - the header is cut or damaged.
pub fn image_header(bytes: &[u8]) -> Result<ImageHeader, ImageHeaderError> {
    match bytes {
        [0xff, 0xd8, 0xff, ..] => jpeg(bytes),
        [0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, ..] => png(bytes),
        [b'I', b'I', 42, 0, ..] => tiff(bytes, u16::from_le_bytes, u32::from_le_bytes),
        [b'M', b'M', 0, 42, ..] => tiff(bytes, u16::from_be_bytes, u32::from_be_bytes),
        _ => {
            let start = bytes.iter().take(8).copied().collect();
            Err(ImageHeaderError::UnknownFormat { start, length: bytes.len() })
        }
    }
}

fn array<const N: usize>(
    bytes: &[u8],
    offset: usize,
    format: ImageFormat,
) -> Result<[u8; N], ImageHeaderError> {
    offset
        .checked_add(N)
        .and_then(|end| bytes.get(offset..end))
        .and_then(|slice| slice.try_into().ok())
        .ok_or(ImageHeaderError::Damaged { format, offset })
}

fn jpeg(bytes: &[u8]) -> Result<ImageHeader, ImageHeaderError> {
    let format = ImageFormat::Jpeg;
    let mut offset = 2;
    loop {
        let [mark, code] = array(bytes, offset, format)?;
        if mark != 0xff {
            return Err(ImageHeaderError::Damaged { format, offset });
        }
        match code {
            0xff => offset += 1, // fill byte
            0x01 | 0xd0..=0xd8 => offset += 2,
            // SOF0..15 without DHT (c4), JPG (c8) and DAC (cc)
            0xc0..=0xcf if !matches!(code, 0xc4 | 0xc8 | 0xcc) => {
                let height = u16::from_be_bytes(array(bytes, offset + 5, format)?);
                let width = u16::from_be_bytes(array(bytes, offset + 7, format)?);
                let [channels] = array(bytes, offset + 9, format)?;
                return Ok(ImageHeader {
                    format,
                    height: height.into(),
                    width: width.into(),
                    channels: channels.into(),
                });
            }
            0xd9 | 0xda => return Err(ImageHeaderError::Damaged { format, offset }),
            _ => {
                let length = u16::from_be_bytes(array(bytes, offset + 2, format)?);
                if length < 2 {
                    return Err(ImageHeaderError::Damaged { format, offset });
                }
                offset += 2 + usize::from(length);
            }
        }
    }
}

fn png(bytes: &[u8]) -> Result<ImageHeader, ImageHeaderError> {
    let format = ImageFormat::Png;
    if array::<4>(bytes, 12, format)? != *b"IHDR" {
        return Err(ImageHeaderError::Damaged { format, offset: 12 });
    }
    let width = u32::from_be_bytes(array(bytes, 16, format)?);
    let height = u32::from_be_bytes(array(bytes, 20, format)?);
    let [_depth, colour] = array(bytes, 24, format)?;
    let channels = match colour {
        0 => 1,
        2 | 3 => 3,
        4 => 2,
        6 => 4,
        _ => return Err(ImageHeaderError::Damaged { format, offset: 25 }),
    };
    Ok(ImageHeader { format, height, width, channels })
}

fn tiff(
    bytes: &[u8],
    u16_of: fn([u8; 2]) -> u16,
    u32_of: fn([u8; 4]) -> u32,
) -> Result<ImageHeader, ImageHeaderError> {
    let format = ImageFormat::Tiff;
    let start = u32_of(array(bytes, 4, format)?) as usize;
    let count = u16_of(array(bytes, start, format)?);
    let (mut width, mut height, mut channels) = (None, None, 1);
    for entry in 0..usize::from(count) {
        let offset = start.saturating_add(2 + entry * 12);
        let tag = u16_of(array(bytes, offset, format)?);
        let kind = u16_of(array(bytes, offset + 2, format)?);
        let value = match kind {
            3 => u32::from(u16_of(array(bytes, offset + 8, format)?)),
            _ => u32_of(array(bytes, offset + 8, format)?),
        };
        match tag {
            256 => width = Some(value),
            257 => height = Some(value),
            277 => channels = value,
            _ => {}
        }
    }
    match (width, height) {
        (Some(width), Some(height)) => Ok(ImageHeader { format, height, width, channels }),
        _ => Err(ImageHeaderError::Damaged { format, offset: start }),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A PNG header of 3x2 RGB.
    const PNG: [u8; 29] = [
        0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a, 0, 0, 0, 13, b'I', b'H', b'D', b'R', 0, 0, 0, 3, 0,
        0, 0, 2, 8, 2, 0, 0, 0,
    ];
    /// A JPEG with an APP0 segment, a fill byte and a SOF2 of 5 rows, 4 columns, 1 channel.
    const JPEG: [u8; 21] =
        [0xff, 0xd8, 0xff, 0xe0, 0, 4, 1, 2, 0xff, 0xff, 0xc2, 0, 11, 8, 0, 5, 0, 4, 1, 0, 0];
    /// A TIFF with width 7 (short) and height 6 (long), little-endian.
    const TIFF: [u8; 34] = [
        b'I', b'I', 42, 0, 8, 0, 0, 0, 2, 0, 0, 1, 3, 0, 1, 0, 0, 0, 7, 0, 0, 0, 1, 1, 4, 0, 1, 0, 0, 0, 6,
        0, 0, 0,
    ];

    fn check_header(bytes: &[u8], format: ImageFormat, height: u32, width: u32, channels: u32) {
        assert_eq!(image_header(bytes), Ok(ImageHeader { format, height, width, channels }));
    }

    #[test]
    fn reads_size_and_channels() {
        check_header(&PNG, ImageFormat::Png, 2, 3, 3);
        check_header(&JPEG, ImageFormat::Jpeg, 5, 4, 1);
        check_header(&TIFF, ImageFormat::Tiff, 6, 7, 1);
    }

    #[test]
    fn a_cut_header_is_an_error_at_every_length() {
        for (bytes, needed) in [(&PNG[..], 26), (&JPEG[..], 19), (&TIFF[..], 34)] {
            for length in 0..needed {
                assert!(image_header(&bytes[..length]).is_err(), "{length} of {needed} bytes");
            }
        }
    }

    #[test]
    fn hostile_lengths_are_errors() {
        let mut jpeg = JPEG;
        jpeg[5] = 1; // a segment shorter than its own length field
        assert!(matches!(image_header(&jpeg), Err(ImageHeaderError::Damaged { offset: 2, .. })));
        let mut tiff = TIFF;
        tiff[4..8].copy_from_slice(&[0xff; 4]);
        assert!(image_header(&tiff).is_err());
    }

    #[test]
    fn other_bytes_are_named() {
        let error = image_header(b"GIF89a").unwrap_err();
        assert_eq!(error, ImageHeaderError::UnknownFormat { start: b"GIF89a".to_vec(), length: 6 });
    }
}
