//! Frames as PNG or JPEG, in the size that is asked for.

use gawm_image::{Image, ImageError, Pixels, encode_jpeg, encode_png, resize};

use crate::environment::Frame;

/// How frames are stored.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImageFormat {
    /// Lossless.
    Png,
    /// JPEG with 4:2:0 chroma, as most cameras record, at a quality from 1 to 100.
    Jpeg {
        /// Quality, 1 to 100.
        quality: u8,
    },
}

impl ImageFormat {
    /// The `format` field of a compressed image message.
    pub fn name(self) -> &'static str {
        match self {
            ImageFormat::Png => "png",
            ImageFormat::Jpeg { .. } => "jpeg",
        }
    }
}

/// Encodes frames of any size as files of one size.
pub(super) struct FrameEncoder {
    format: ImageFormat,
    /// Side of the encoded image in pixels.
    size: u32,
}

impl FrameEncoder {
    pub(super) fn new(format: ImageFormat, size: u32) -> Self {
        FrameEncoder { format, size }
    }

    /// Returns the encoded frame, resized with an antialiased bilinear filter where its size is another one.
    pub(super) fn encode(&self, frame: &Frame) -> Result<Vec<u8>, ImageError> {
        let side = |pixels: usize| u32::try_from(pixels).unwrap_or(u32::MAX);
        let image = Image::try_new(side(frame.width), side(frame.height), Pixels::Rgb8(frame.rgb.clone()))?;
        let is_resized = (image.width(), image.height()) != (self.size, self.size);
        let image = if is_resized { resize(&image, self.size, self.size)? } else { image };
        match self.format {
            ImageFormat::Png => encode_png(&image),
            ImageFormat::Jpeg { quality } => encode_jpeg(&image, quality),
        }
    }
}
