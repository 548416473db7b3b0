//! Images on their way from a message to the dataset.

use bytes::Bytes;
use gawm_image::{
    CropRect, FileFormat, Image, ImageError, Layout, Limits, Pixels, RawImage, crop, decode,
    decode_compressed_depth, decode_raw, encode_jpeg, encode_png, encode_tiff, is_compressed_depth, resize,
    to_rgb8, verify,
};
use gawm_schema::ImageSpec;

use crate::contract::{self, ImageFormat};
use crate::decode::{ImageKind, ImageMessage};
use gawm_video::RgbFrame;

/// JPEG quality where the contract names none.
const DEFAULT_QUALITY: u8 = 90;

/// The image of one message: bytes that outlive their block, checked as far as that is cheap.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Picture {
    data: Bytes,
    form: Form,
    width: u32,
    height: u32,
    is_depth: bool,
}

#[derive(Debug, Clone, PartialEq)]
enum Form {
    /// A JPEG or PNG file.
    File {
        format: FileFormat,
        /// Whether its pixels are 8-bit colour, as datasets have it.
        is_rgb8: bool,
    },
    /// PNG behind a header, as `compressedDepth` has it.
    CompressedDepth { format: String },
    /// A packet of a video, which only means something after those before it.
    Packet { format: String },
    /// Rows of pixels.
    Raw { layout: String, step: u32, is_big_endian: bool },
}

/// Returns the reason for counting a message whose image cannot be used.
pub(crate) fn loss_reason(error: &ImageError) -> &'static str {
    match error {
        ImageError::UnsupportedFormat { .. } | ImageError::UnsupportedLayout { .. } => "unsupported_image",
        ImageError::Size { .. } => "image_too_large",
        _ => "corrupt_image",
    }
}

impl Picture {
    /// Takes the image of a message; `keep` makes its bytes outlive the block.
    ///
    /// # Errors
    /// The bytes are no image of a known kind, or a part of it is missing.
    pub(crate) fn new(
        message: &ImageMessage<'_>,
        keep: impl FnOnce(&[u8]) -> Bytes,
    ) -> Result<Picture, ImageError> {
        let data: &[u8] = &message.data;
        if message.kind == ImageKind::Video {
            let form = Form::Packet { format: message.format.clone().into_owned() };
            return Ok(Picture { data: keep(data), form, width: 0, height: 0, is_depth: false });
        }
        if message.kind == ImageKind::Raw {
            return raw(message, keep);
        }
        if is_compressed_depth(data) || message.format.contains("compressedDepth") {
            let image = decode_compressed_depth(&message.format, data, &Limits::default())?;
            return Ok(Picture {
                data: keep(data),
                form: Form::CompressedDepth { format: message.format.clone().into_owned() },
                width: image.width(),
                height: image.height(),
                is_depth: true,
            });
        }
        let header = verify(data)?;
        Ok(Picture {
            data: keep(data),
            form: Form::File { format: header.format, is_rgb8: header.channels == 3 && header.bits == 8 },
            width: header.width,
            height: header.height,
            is_depth: header.bits == 16 && header.channels == 1,
        })
    }

    /// Returns the picture of a decoded video frame.
    pub(crate) fn of_frame(frame: RgbFrame) -> Picture {
        let form = Form::Raw {
            layout: "rgb8".to_owned(),
            step: frame.width.saturating_mul(3),
            is_big_endian: false,
        };
        Picture { data: frame.data, form, width: frame.width, height: frame.height, is_depth: false }
    }

    /// Returns format and bytes of a video packet, if it is one.
    pub(crate) fn packet(&self) -> Option<(&str, &Bytes)> {
        match &self.form {
            Form::Packet { format } => Some((format, &self.data)),
            _ => None,
        }
    }

    /// Returns how many bytes the image holds.
    pub(crate) fn held_bytes(&self) -> usize {
        self.data.len()
    }

    /// Returns width and height as recorded.
    pub(crate) fn recorded_size(&self) -> (u32, u32) {
        (self.width, self.height)
    }

    /// Returns the size that the image has in the dataset: depth has one channel, everything else three.
    pub(crate) fn size(&self, rule: &contract::ImageSpec) -> ImageSpec {
        let [width, height] = match (rule.resize, rule.crop) {
            (Some(size), _) => size,
            (None, Some([_, _, width, height])) => [width, height],
            (None, None) => [self.width, self.height],
        };
        let depth = rule.depth.unwrap_or(self.is_depth);
        ImageSpec { height, width, channels: if depth { 1 } else { 3 }, depth }
    }

    /// Returns the bytes for the dataset.
    ///
    /// # Errors
    /// The image turns out to be damaged when it is decoded, or the crop does not fit it.
    pub(crate) fn encoded(&self, rule: &contract::ImageSpec) -> Result<Bytes, ImageError> {
        let wants_depth = rule.depth.unwrap_or(self.is_depth);
        if let Form::File { format, is_rgb8 } = self.form
            && rule.crop.is_none()
            && rule.resize.is_none_or(|size| size == [self.width, self.height])
        {
            let is_kept = match (rule.format, format) {
                (ImageFormat::Passthrough, FileFormat::Jpeg | FileFormat::Png) => true,
                (ImageFormat::Png, FileFormat::Png) => true,
                (ImageFormat::Jpeg, FileFormat::Jpeg) => rule.quality.is_none(),
                _ => false,
            };
            if is_kept && (is_rgb8 || (wants_depth && self.is_depth)) {
                return Ok(self.data.clone());
            }
        }
        let mut image = self.decoded()?;
        if let Some([x, y, width, height]) = rule.crop {
            image = crop(&image, CropRect { x, y, width, height })?;
        }
        if let Some([width, height]) = rule.resize {
            image = resize(&image, width, height)?;
        }
        if !wants_depth {
            image = to_rgb8(image)?;
        }
        let bytes = match (rule.format, image.pixels()) {
            (_, Pixels::GrayF32(_)) => encode_tiff(&image)?,
            (ImageFormat::Jpeg, Pixels::Rgb8(_)) => {
                encode_jpeg(&image, rule.quality.unwrap_or(DEFAULT_QUALITY))?
            }
            _ => encode_png(&image)?,
        };
        Ok(Bytes::from(bytes))
    }

    /// Returns a black image, as it is stored.
    pub(crate) fn black(spec: &ImageSpec) -> Bytes {
        let n = spec.width as usize * spec.height as usize;
        let pixels = if spec.depth { Pixels::Gray16(vec![0; n]) } else { Pixels::Rgb8(vec![0; 3 * n]) };
        let image = Image::try_new(spec.width, spec.height, pixels);
        image.and_then(|image| encode_png(&image)).map(Bytes::from).unwrap_or_default()
    }

    fn decoded(&self) -> Result<Image, ImageError> {
        let limits = Limits::default();
        match &self.form {
            Form::File { .. } | Form::Packet { .. } => decode(&self.data, &limits),
            Form::CompressedDepth { format } => decode_compressed_depth(format, &self.data, &limits),
            Form::Raw { layout, step, is_big_endian } => {
                let raw = RawImage {
                    layout,
                    width: self.width,
                    height: self.height,
                    step: *step,
                    is_big_endian: *is_big_endian,
                    data: &self.data,
                };
                decode_raw(&raw, &limits)
            }
        }
    }
}

fn raw(message: &ImageMessage<'_>, keep: impl FnOnce(&[u8]) -> Bytes) -> Result<Picture, ImageError> {
    let layout = Layout::from_name(&message.format)?;
    Limits::default().check(u64::from(message.width), u64::from(message.height))?;
    let needed = u64::from(message.step) * u64::from(message.height);
    if (message.data.len() as u64) < needed || message.data.is_empty() {
        return Err(ImageError::Values {
            width: message.width,
            height: message.height,
            expected: needed.max(1),
            got: message.data.len(),
        });
    }
    Ok(Picture {
        data: keep(&message.data),
        form: Form::Raw {
            layout: message.format.clone().into_owned(),
            step: message.step,
            is_big_endian: message.is_big_endian,
        },
        width: message.width,
        height: message.height,
        is_depth: matches!(layout, Layout::Mono16 | Layout::Float32),
    })
}
