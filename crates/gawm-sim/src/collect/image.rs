//! Frames as PNG or JPEG, in the size that is asked for.

use fast_image_resize::images::{Image, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};
use thiserror::Error;

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

/// Why a frame could not be encoded.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EncodeFrameError {
    /// The PNG encoder failed.
    #[error("PNG encoder failed")]
    Png(#[from] png::EncodingError),
    /// The JPEG encoder failed.
    #[error("JPEG encoder failed")]
    Jpeg(#[from] turbojpeg::Error),
    /// The frame's size and its bytes disagree.
    #[error("frame buffer does not fit its size: expected {width}x{height}x3 bytes, got {got}")]
    Buffer {
        /// Width in pixels.
        width: usize,
        /// Height in pixels.
        height: usize,
        /// Length of the buffer.
        got: usize,
    },
}

/// Encodes frames, one after another, into a buffer that it keeps.
pub(super) struct FrameEncoder {
    format: ImageFormat,
    /// Side of the encoded image in pixels.
    size: usize,
    resizer: Resizer,
    resized: Vec<u8>,
    jpeg: turbojpeg::Compressor,
    encoded: Vec<u8>,
}

impl FrameEncoder {
    pub(super) fn new(format: ImageFormat, size: usize) -> Result<Self, EncodeFrameError> {
        let mut jpeg = turbojpeg::Compressor::new()?;
        if let ImageFormat::Jpeg { quality } = format {
            jpeg.set_quality(quality.into())?;
            jpeg.set_subsamp(turbojpeg::Subsamp::Sub2x2)?;
        }
        Ok(FrameEncoder {
            format,
            size,
            resizer: Resizer::new(),
            resized: Vec::new(),
            jpeg,
            encoded: Vec::new(),
        })
    }

    /// Returns the encoded frame, resized with an antialiased bilinear filter where its size is another one.
    pub(super) fn encode(&mut self, frame: &Frame) -> Result<&[u8], EncodeFrameError> {
        let buffer_error =
            || EncodeFrameError::Buffer { width: frame.width, height: frame.height, got: frame.rgb.len() };
        let rgb = if frame.width == self.size && frame.height == self.size {
            &frame.rgb
        } else {
            resize(&mut self.resizer, frame, self.size, &mut self.resized).ok_or_else(buffer_error)?;
            &self.resized
        };
        self.encoded.clear();
        match self.format {
            ImageFormat::Png => encode_png(rgb, self.size, &mut self.encoded)?,
            ImageFormat::Jpeg { .. } => {
                let image = turbojpeg::Image {
                    pixels: rgb.as_slice(),
                    width: self.size,
                    pitch: self.size * 3,
                    height: self.size,
                    format: turbojpeg::PixelFormat::RGB,
                };
                self.encoded = self.jpeg.compress_to_vec(image)?;
            }
        }
        Ok(&self.encoded)
    }
}

/// Resizes into `out`; `None` when the frame's buffer does not fit its size.
fn resize(resizer: &mut Resizer, frame: &Frame, size: usize, out: &mut Vec<u8>) -> Option<()> {
    let source = ImageRef::new(frame.width as u32, frame.height as u32, &frame.rgb, PixelType::U8x3).ok()?;
    let mut target = Image::new(size as u32, size as u32, PixelType::U8x3);
    let options = ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear));
    resizer.resize(&source, &mut target, &options).ok()?;
    *out = target.into_vec();
    Some(())
}

fn encode_png(rgb: &[u8], size: usize, out: &mut Vec<u8>) -> Result<(), png::EncodingError> {
    let mut encoder = png::Encoder::new(out, size as u32, size as u32);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_depth(png::BitDepth::Eight);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(rgb)?;
    writer.finish()
}
