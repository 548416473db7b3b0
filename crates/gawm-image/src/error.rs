//! What can go wrong with an image.

use crate::format::FileFormat;

/// Why an image cannot be decoded, changed or encoded.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum ImageError {
    /// The bytes are no image file that is known.
    #[error("not an image file: it begins with {start:02x?}")]
    UnknownFormat {
        /// The first bytes.
        start: Vec<u8>,
    },
    /// The file's format is known but not decoded.
    #[error("{format} images are not supported (supported: JPEG, PNG, TIFF)")]
    UnsupportedFormat {
        /// The format.
        format: FileFormat,
    },
    /// The pixel layout of a raw image is not decoded.
    #[error("pixel layout {layout:?} is not supported (supported: {})", crate::raw::SUPPORTED.join(", "))]
    UnsupportedLayout {
        /// Its name, as the message has it.
        layout: String,
    },
    /// The file is damaged or cut off.
    #[error("damaged {format}: {detail}")]
    Damaged {
        /// The format.
        format: FileFormat,
        /// What the decoder says.
        detail: String,
    },
    /// The image has no pixels, or more than the cap.
    #[error("image of {width}x{height} pixels: expected at least 1 and at most {max_pixels} pixels")]
    Size {
        /// Width in pixels.
        width: u64,
        /// Height in pixels.
        height: u64,
        /// The cap.
        max_pixels: u64,
    },
    /// A raw image has fewer bytes than its size and layout need.
    #[error(
        "{layout} image of {width}x{height} with rows of {step} bytes: expected {expected} bytes, got {got}"
    )]
    Short {
        /// The layout.
        layout: String,
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Bytes of a row.
        step: u64,
        /// Bytes needed.
        expected: u64,
        /// Bytes there are.
        got: usize,
    },
    /// A raw image's rows are shorter than its width needs.
    #[error("{layout} image {width} pixels wide: expected rows of at least {expected} bytes, got {got}")]
    Step {
        /// The layout.
        layout: String,
        /// Width in pixels.
        width: u32,
        /// Bytes that a row needs.
        expected: u64,
        /// Bytes of a row as the message has it.
        got: u32,
    },
    /// A decoded image is not of the size that the caller has room for.
    #[error("image size mismatch: expected {expected_width}x{expected_height}, got {width}x{height}")]
    Mismatch {
        /// Width wanted.
        expected_width: u32,
        /// Height wanted.
        expected_height: u32,
        /// Width of the image.
        width: u32,
        /// Height of the image.
        height: u32,
    },
    /// A crop reaches beyond the image, or is empty.
    #[error("crop of {crop_width}x{crop_height} at ({x}, {y}) does not fit an image of {width}x{height}")]
    Crop {
        /// Left edge.
        x: u32,
        /// Upper edge.
        y: u32,
        /// Width of the crop.
        crop_width: u32,
        /// Height of the crop.
        crop_height: u32,
        /// Width of the image.
        width: u32,
        /// Height of the image.
        height: u32,
    },
    /// The pixels are of a kind that the target cannot hold.
    #[error("cannot make {target} of {pixels} pixels")]
    Unsuitable {
        /// What was to be made.
        target: &'static str,
        /// The pixels there are.
        pixels: &'static str,
    },
    /// The number of values is not that of the image's size.
    #[error("image of {width}x{height}: expected {expected} values, got {got}")]
    Values {
        /// Width in pixels.
        width: u32,
        /// Height in pixels.
        height: u32,
        /// Values needed.
        expected: u64,
        /// Values there are.
        got: usize,
    },
    /// The resizer failed.
    #[error("cannot resize to {width}x{height}: {detail}")]
    Resize {
        /// Target width in pixels.
        width: u32,
        /// Target height in pixels.
        height: u32,
        /// What the resizer says.
        detail: String,
    },
    /// An encoder failed.
    #[error("cannot encode {format}: {detail}")]
    Encode {
        /// The format.
        format: FileFormat,
        /// What the encoder says.
        detail: String,
    },
}
