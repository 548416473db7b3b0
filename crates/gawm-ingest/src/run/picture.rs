//! Images on their way from a message to the dataset.

use std::borrow::Cow;

use bytes::Bytes;
use gawm_dataset::{ImageFormat, ImageHeader, ImageHeaderError, image_header};
use gawm_schema::ImageSpec;
use thiserror::Error;

use crate::contract;
use crate::decode::{ImageKind, ImageMessage};

/// The image of one message: bytes that outlive their block, checked as far as that is cheap.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Picture {
    data: Bytes,
    header: ImageHeader,
}

/// Why an image cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub(crate) enum PictureError {
    /// The bytes are no image, or only a part of one.
    #[error("image cannot be read: {0}")]
    Header(#[from] ImageHeaderError),
    /// The file ends early.
    #[error("image is cut: expected the end mark of a {format}, got {got} bytes without it")]
    Cut {
        /// Format by content.
        format: &'static str,
        /// Bytes that are there.
        got: usize,
    },
    /// Pixels in a layout that is not converted.
    #[error("raw image layout {encoding:?} is not supported")]
    Layout {
        /// As the message says.
        encoding: String,
    },
}

impl PictureError {
    /// Returns the reason for counting.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            PictureError::Header(_) | PictureError::Cut { .. } => "corrupt_image",
            PictureError::Layout { .. } => "unsupported_image",
        }
    }
}

impl Picture {
    /// Takes the image of a message; `keep` makes its bytes outlive the block.
    pub(crate) fn new(
        message: &ImageMessage<'_>,
        kind: ImageKind,
        keep: impl FnOnce(&[u8]) -> Bytes,
    ) -> Result<Picture, PictureError> {
        if kind == ImageKind::Raw {
            return Err(PictureError::Layout { encoding: Cow::clone(&message.format).into_owned() });
        }
        let header = image_header(&message.data)?;
        let end: Option<(&'static str, &[u8])> = match header.format {
            ImageFormat::Jpeg => Some(("JPEG", &[0xFF, 0xD9])),
            ImageFormat::Png => Some(("PNG", b"IEND")),
            _ => None,
        };
        // Writers may pad a file; a cut one has no end mark anywhere near its end.
        let tail = &message.data[message.data.len().saturating_sub(4096)..];
        if let Some((format, mark)) = end
            && !tail.windows(mark.len()).any(|bytes| bytes == mark)
        {
            return Err(PictureError::Cut { format, got: message.data.len() });
        }
        Ok(Picture { data: keep(&message.data), header })
    }

    /// Returns width and height as recorded.
    pub(crate) fn recorded_size(&self) -> (u32, u32) {
        (self.header.width, self.header.height)
    }

    /// Returns the size that the image has in the dataset.
    pub(crate) fn size(&self, rule: &contract::ImageSpec) -> ImageSpec {
        let [width, height] = match (rule.resize, rule.crop) {
            (Some(size), _) => size,
            (None, Some([_, _, width, height])) => [width, height],
            (None, None) => [self.header.width, self.header.height],
        };
        ImageSpec { height, width, channels: self.header.channels, depth: rule.depth.unwrap_or(false) }
    }

    /// Returns the bytes for the dataset.
    pub(crate) fn encoded(&self, _rule: &contract::ImageSpec) -> Result<Bytes, PictureError> {
        Ok(self.data.clone())
    }
}
