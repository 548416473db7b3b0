//! What kind of image file some bytes are, how large the image is, and whether all of it is there.

use std::fmt;

use crate::error::ImageError;

/// A format of image files.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[expect(missing_docs, reason = "the names are those of the formats")]
pub enum FileFormat {
    Jpeg,
    Png,
    Tiff,
    WebP,
    Bmp,
    Gif,
    Jpeg2000,
    JpegXl,
    Heif,
    Qoi,
}

/// What a file says of its image before it is decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ImageHeader {
    /// Format by content.
    pub format: FileFormat,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Channels that a decoder finds, alpha included: a palette gives colour, of 3.
    pub channels: u8,
    /// Bits per channel.
    pub bits: u8,
}

impl FileFormat {
    /// Returns the name that message labels and file names use: `jpeg`, `png`.
    pub fn label(self) -> &'static str {
        match self {
            Self::Jpeg => "jpeg",
            Self::Png => "png",
            Self::Tiff => "tiff",
            Self::WebP => "webp",
            Self::Bmp => "bmp",
            Self::Gif => "gif",
            Self::Jpeg2000 => "jp2",
            Self::JpegXl => "jxl",
            Self::Heif => "heif",
            Self::Qoi => "qoi",
        }
    }
}

impl fmt::Display for FileFormat {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Jpeg => "JPEG",
            Self::Png => "PNG",
            Self::Tiff => "TIFF",
            Self::WebP => "WebP",
            Self::Bmp => "BMP",
            Self::Gif => "GIF",
            Self::Jpeg2000 => "JPEG 2000",
            Self::JpegXl => "JPEG XL",
            Self::Heif => "HEIF/AVIF",
            Self::Qoi => "QOI",
        })
    }
}

pub(crate) const PNG_MAGIC: [u8; 8] = [0x89, b'P', b'N', b'G', b'\r', b'\n', 0x1a, b'\n'];

/// Tells the format of a file by its first bytes.
pub fn sniff(bytes: &[u8]) -> Option<FileFormat> {
    let starts = |magic: &[u8]| bytes.starts_with(magic);
    let is_box = |brand: &[&[u8]]| {
        bytes.get(4..8) == Some(b"ftyp") && bytes.get(8..12).is_some_and(|b| brand.contains(&b))
    };
    Some(match bytes {
        _ if starts(&[0xff, 0xd8, 0xff]) => FileFormat::Jpeg,
        _ if starts(&PNG_MAGIC) => FileFormat::Png,
        _ if starts(b"II*\0") || starts(b"MM\0*") => FileFormat::Tiff,
        _ if starts(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") => FileFormat::WebP,
        _ if starts(b"BM") && bytes.len() > 26 && bytes[6..10] == [0; 4] => FileFormat::Bmp,
        _ if starts(b"GIF87a") || starts(b"GIF89a") => FileFormat::Gif,
        _ if starts(&[0, 0, 0, 12, b'j', b'P', b' ', b' ']) || starts(&[0xff, 0x4f, 0xff, 0x51]) => {
            FileFormat::Jpeg2000
        }
        _ if starts(&[0xff, 0x0a]) || starts(&[0, 0, 0, 12, b'J', b'X', b'L', b' ']) => FileFormat::JpegXl,
        _ if is_box(&[b"heic", b"heix", b"mif1", b"avif"]) => FileFormat::Heif,
        _ if starts(b"qoif") => FileFormat::Qoi,
        _ => return None,
    })
}

/// Tells the format, or refuses.
pub(crate) fn expect_format(bytes: &[u8]) -> Result<FileFormat, ImageError> {
    sniff(bytes).ok_or_else(|| ImageError::UnknownFormat { start: bytes.iter().copied().take(8).collect() })
}

/// Reads the size of an image without decoding it. JPEG, PNG and TIFF.
///
/// # Errors
/// [`ImageError`] if the bytes are no such file or the header is damaged.
pub fn read_header(bytes: &[u8]) -> Result<ImageHeader, ImageError> {
    match expect_format(bytes)? {
        FileFormat::Jpeg => jpeg_header(bytes).map(|(header, _)| header),
        FileFormat::Png => png_header(bytes),
        FileFormat::Tiff => tiff_header(bytes),
        format => Err(ImageError::UnsupportedFormat { format }),
    }
}

/// Reads the size of an image and checks, without decoding it, that the file is whole. JPEG and PNG.
///
/// Finds files that are cut off and PNG chunks with a wrong CRC. Damage within the coded data of a JPEG is only found by
/// decoding it.
///
/// # Errors
/// [`ImageError`] if the bytes are no such file, or a part of it is missing.
pub fn verify(bytes: &[u8]) -> Result<ImageHeader, ImageError> {
    match expect_format(bytes)? {
        FileFormat::Jpeg => {
            let (header, scan) = jpeg_header(bytes)?;
            let rest = bytes.get(scan..).unwrap_or(&[]);
            // In coded data 0xff is followed by 0 or a restart marker, so this pair can only be the end. Most files end
            // with it; a few have something behind it.
            if rest.ends_with(&[0xff, 0xd9]) || rest.windows(2).any(|pair| pair == [0xff, 0xd9]) {
                Ok(header)
            } else {
                Err(damaged(FileFormat::Jpeg, "it has no end: the file is cut off"))
            }
        }
        FileFormat::Png => {
            let header = png_header(bytes)?;
            check_png_chunks(bytes)?;
            Ok(header)
        }
        format => Err(ImageError::UnsupportedFormat { format }),
    }
}

pub(crate) fn damaged(format: FileFormat, detail: impl Into<String>) -> ImageError {
    ImageError::Damaged { format, detail: detail.into() }
}

/// Walks the segments of a JPEG to its frame header and on to its first scan; returns also where the scan begins.
fn jpeg_header(bytes: &[u8]) -> Result<(ImageHeader, usize), ImageError> {
    let short = || damaged(FileFormat::Jpeg, "the file ends within its header");
    let mut pos = 2;
    let mut header = None;
    loop {
        while bytes.get(pos) == Some(&0xff) && bytes.get(pos + 1) == Some(&0xff) {
            pos += 1; // Fill bytes.
        }
        let (Some(0xff), Some(&marker)) = (bytes.get(pos), bytes.get(pos + 1)) else {
            return Err(if pos + 1 >= bytes.len() {
                short()
            } else {
                damaged(FileFormat::Jpeg, format!("no marker at byte {pos}"))
            });
        };
        pos += 2;
        if matches!(marker, 0x01 | 0xd0..=0xd8) {
            continue;
        }
        let length = bytes.get(pos..pos + 2).ok_or_else(short)?;
        let length = usize::from(u16::from_be_bytes([length[0], length[1]]));
        let segment = bytes.get(pos + 2..pos + length.max(2)).ok_or_else(short)?;
        let is_frame = matches!(marker, 0xc0..=0xcf) && !matches!(marker, 0xc4 | 0xc8 | 0xcc);
        if is_frame && let [bits, h1, h0, w1, w0, channels, ..] = *segment {
            let (width, height) = (u16::from_be_bytes([w1, w0]), u16::from_be_bytes([h1, h0]));
            header = Some(ImageHeader {
                format: FileFormat::Jpeg,
                width: u32::from(width),
                height: u32::from(height),
                channels,
                bits,
            });
        }
        pos += length.max(2);
        if marker == 0xda {
            let header =
                header.ok_or_else(|| damaged(FileFormat::Jpeg, "no frame header before the scan"))?;
            return Ok((header, pos));
        }
        if marker == 0xd9 {
            return Err(damaged(FileFormat::Jpeg, "no scan before its end"));
        }
    }
}

fn png_header(bytes: &[u8]) -> Result<ImageHeader, ImageError> {
    let short = || damaged(FileFormat::Png, "the file ends within its header");
    let chunk = bytes.get(8..33).ok_or_else(short)?;
    if chunk[4..8] != *b"IHDR" {
        return Err(damaged(FileFormat::Png, "its first chunk is not IHDR"));
    }
    let word = |at: usize| u32::from_be_bytes([chunk[at], chunk[at + 1], chunk[at + 2], chunk[at + 3]]);
    let channels = match chunk[17] {
        0 => 1,
        2 | 3 => 3,
        4 => 2,
        6 => 4,
        other => return Err(damaged(FileFormat::Png, format!("unknown colour type {other}"))),
    };
    Ok(ImageHeader { format: FileFormat::Png, width: word(8), height: word(12), channels, bits: chunk[16] })
}

/// Reads the first directory of a TIFF.
fn tiff_header(bytes: &[u8]) -> Result<ImageHeader, ImageError> {
    let is_little = bytes.first() == Some(&b'I');
    let short =
        |at: usize| damaged(FileFormat::Tiff, format!("the file ends within its header, at byte {at}"));
    let word = |at: usize| -> Result<u16, ImageError> {
        let pair =
            bytes.get(at..at.saturating_add(2)).and_then(|b| b.try_into().ok()).ok_or_else(|| short(at))?;
        Ok(if is_little { u16::from_le_bytes(pair) } else { u16::from_be_bytes(pair) })
    };
    let long = |at: usize| -> Result<u32, ImageError> {
        let four =
            bytes.get(at..at.saturating_add(4)).and_then(|b| b.try_into().ok()).ok_or_else(|| short(at))?;
        Ok(if is_little { u32::from_le_bytes(four) } else { u32::from_be_bytes(four) })
    };
    let start = long(4)? as usize;
    let (mut width, mut height, mut channels, mut bits) = (None, None, 1, 1);
    for entry in 0..usize::from(word(start)?) {
        let at = start.saturating_add(2 + entry * 12);
        // A short value stands at the beginning of the field.
        let value = if word(at.saturating_add(2))? == 3 { u32::from(word(at + 8)?) } else { long(at + 8)? };
        match word(at)? {
            256 => width = Some(value),
            257 => height = Some(value),
            // Of several channels the field says where their depths stand.
            258 if long(at + 4)? == 1 => bits = value,
            277 => channels = value,
            _ => {}
        }
    }
    match (width, height, u8::try_from(channels)) {
        (Some(width), Some(height), Ok(channels)) => {
            let bits = u8::try_from(bits).unwrap_or(u8::MAX);
            Ok(ImageHeader { format: FileFormat::Tiff, width, height, channels, bits })
        }
        _ => Err(damaged(FileFormat::Tiff, "its first directory has no size")),
    }
}

fn check_png_chunks(bytes: &[u8]) -> Result<(), ImageError> {
    let short = || damaged(FileFormat::Png, "it has no end: the file is cut off");
    let mut pos = 8_usize;
    loop {
        let head = bytes.get(pos..pos + 8).ok_or_else(short)?;
        let length = u32::from_be_bytes([head[0], head[1], head[2], head[3]]) as usize;
        let end = (pos + 8).checked_add(length).ok_or_else(short)?;
        let body = bytes.get(pos + 4..end).ok_or_else(short)?;
        let stored = bytes.get(end..end.saturating_add(4)).ok_or_else(short)?;
        if crc32fast::hash(body).to_be_bytes() != *stored {
            return Err(damaged(FileFormat::Png, format!("wrong CRC of the chunk at byte {pos}")));
        }
        if &head[4..8] == b"IEND" {
            return Ok(());
        }
        pos = end + 4;
    }
}
