//! Crop, resize, and change between colour and grey.

use fast_image_resize::images::{Image as FirImage, ImageRef};
use fast_image_resize::{FilterType, PixelType, ResizeAlg, ResizeOptions, Resizer};

use crate::error::ImageError;
use crate::image::{Image, Limits, Pixels};

/// A part of an image, in pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct CropRect {
    /// Left edge.
    pub x: u32,
    /// Upper edge.
    pub y: u32,
    /// Width.
    pub width: u32,
    /// Height.
    pub height: u32,
}

/// Cuts a part out of an image.
///
/// # Errors
/// [`ImageError::Crop`] if the part is empty or reaches beyond the image.
pub fn crop(image: &Image, rect: CropRect) -> Result<Image, ImageError> {
    let fits = |start: u32, length: u32, size: u32| {
        length > 0 && u64::from(start) + u64::from(length) <= u64::from(size)
    };
    if !fits(rect.x, rect.width, image.width()) || !fits(rect.y, rect.height, image.height()) {
        return Err(ImageError::Crop {
            x: rect.x,
            y: rect.y,
            crop_width: rect.width,
            crop_height: rect.height,
            width: image.width(),
            height: image.height(),
        });
    }
    let width = image.width() as usize;
    let pixels = match image.pixels() {
        Pixels::Rgb8(values) => Pixels::Rgb8(cut(values, width, 3, rect)),
        Pixels::Gray8(values) => Pixels::Gray8(cut(values, width, 1, rect)),
        Pixels::Gray16(values) => Pixels::Gray16(cut(values, width, 1, rect)),
        Pixels::GrayF32(values) => Pixels::GrayF32(cut(values, width, 1, rect)),
    };
    Image::try_new(rect.width, rect.height, pixels)
}

fn cut<T: Copy>(values: &[T], width: usize, channels: usize, rect: CropRect) -> Vec<T> {
    let start = rect.x as usize * channels;
    let length = rect.width as usize * channels;
    let rows = values.chunks_exact(width * channels).skip(rect.y as usize).take(rect.height as usize);
    rows.flat_map(|row| row[start..start + length].iter().copied()).collect()
}

/// Resizes an image: 8-bit pixels bilinearly with antialiasing, 16-bit and float ones to the nearest.
///
/// Depth is never blended: the mean of a near and a far value is a surface that is not there.
///
/// # Errors
/// [`ImageError::Size`] if a side is 0 or the target too large.
pub fn resize(image: &Image, width: u32, height: u32) -> Result<Image, ImageError> {
    Limits::default().check(u64::from(width), u64::from(height))?;
    if (image.width(), image.height()) == (width, height) {
        return Ok(image.clone());
    }
    let from = (image.width() as usize, image.height() as usize);
    let to = (width as usize, height as usize);
    let pixels = match image.pixels() {
        Pixels::Rgb8(values) => Pixels::Rgb8(bilinear(image, values, PixelType::U8x3, (width, height))?),
        Pixels::Gray8(values) => Pixels::Gray8(bilinear(image, values, PixelType::U8, (width, height))?),
        Pixels::Gray16(values) => Pixels::Gray16(nearest(values, from, to)),
        Pixels::GrayF32(values) => Pixels::GrayF32(nearest(values, from, to)),
    };
    Image::try_new(width, height, pixels)
}

fn bilinear(
    image: &Image,
    values: &[u8],
    pixel_type: PixelType,
    (width, height): (u32, u32),
) -> Result<Vec<u8>, ImageError> {
    let fail = |detail: String| ImageError::Resize { width, height, detail };
    let source =
        ImageRef::new(image.width(), image.height(), values, pixel_type).map_err(|e| fail(e.to_string()))?;
    let mut target = FirImage::new(width, height, pixel_type);
    let options =
        ResizeOptions::new().resize_alg(ResizeAlg::Convolution(FilterType::Bilinear)).use_alpha(false);
    Resizer::new().resize(&source, &mut target, &options).map_err(|e| fail(e.to_string()))?;
    Ok(target.into_vec())
}

/// Takes the source pixel whose area holds the centre of the target pixel.
fn nearest<T: Copy>(values: &[T], from: (usize, usize), to: (usize, usize)) -> Vec<T> {
    let pick = |i: usize, from: usize, to: usize| (2 * i + 1) * from / (2 * to);
    let mut out = Vec::with_capacity(to.0 * to.1);
    for y in 0..to.1 {
        let row = &values[pick(y, from.1, to.1) * from.0..][..from.0];
        out.extend((0..to.0).map(|x| row[pick(x, from.0, to.0)]));
    }
    out
}

/// Makes an image RGB; grey becomes three equal channels.
///
/// # Errors
/// [`ImageError::Unsuitable`] for 16-bit and float pixels, which have no place in 8 bits without a scale.
pub fn to_rgb8(image: Image) -> Result<Image, ImageError> {
    let (width, height) = (image.width(), image.height());
    match image.into_pixels() {
        Pixels::Gray8(values) => {
            Image::try_new(width, height, Pixels::Rgb8(values.iter().flat_map(|v| [*v; 3]).collect()))
        }
        pixels @ Pixels::Rgb8(_) => Image::try_new(width, height, pixels),
        other => Err(ImageError::Unsuitable { target: "rgb8", pixels: other.name() }),
    }
}

/// Makes an image grey by the luma of BT.601, as Pillow and OpenCV do.
///
/// # Errors
/// [`ImageError::Unsuitable`] for 16-bit and float pixels.
pub fn to_gray8(image: Image) -> Result<Image, ImageError> {
    let (width, height) = (image.width(), image.height());
    match image.into_pixels() {
        Pixels::Rgb8(values) => {
            let luma = |p: &[u8; 3]| {
                let sum = 19_595 * u32::from(p[0]) + 38_470 * u32::from(p[1]) + 7_471 * u32::from(p[2]);
                ((sum + 0x8000) >> 16) as u8
            };
            Image::try_new(width, height, Pixels::Gray8(values.as_chunks::<3>().0.iter().map(luma).collect()))
        }
        pixels @ Pixels::Gray8(_) => Image::try_new(width, height, pixels),
        other => Err(ImageError::Unsuitable { target: "mono8", pixels: other.name() }),
    }
}
