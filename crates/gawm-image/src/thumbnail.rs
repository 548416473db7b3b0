//! Small RGB pictures of frames, for measures and contact sheets.

use turbojpeg::{PixelFormat, ScalingFactor};

use crate::codec::{decode, decompressor, jpeg_error};
use crate::error::ImageError;
use crate::format::{FileFormat, ImageHeader, read_header};
use crate::image::{Image, Limits, Pixels};
use crate::transform::to_rgb8;

/// A small RGB picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Thumbnail {
    /// Columns of pixels.
    pub width: usize,
    /// Rows of pixels.
    pub height: usize,
    /// Row-major, three bytes per pixel.
    pub rgb: Vec<u8>,
}

/// Decodes a frame; a JPEG at the smallest scale at which both sides have at least `min_side` pixels, which is much
/// faster than all of it.
///
/// # Errors
/// [`ImageError`] as [`decode`](crate::decode); [`ImageError::Unsuitable`] for depth in floats; of 16 bits the upper 8 are taken.
pub fn decode_thumbnail(
    bytes: &[u8],
    min_side: usize,
    limits: &Limits,
) -> Result<(ImageHeader, Thumbnail), ImageError> {
    let header = read_header(bytes)?;
    limits.check(u64::from(header.width), u64::from(header.height))?;
    let thumbnail = if header.format == FileFormat::Jpeg {
        decode_scaled(bytes, min_side, limits)?
    } else {
        Thumbnail::try_from(decode(bytes, limits)?)?
    };
    Ok((header, thumbnail))
}

fn decode_scaled(bytes: &[u8], min_side: usize, limits: &Limits) -> Result<Thumbnail, ImageError> {
    let mut decompressor = decompressor()?;
    let header = decompressor.read_header(bytes).map_err(|e| jpeg_error(&e))?;
    // The decoder goes by this header, not by ours.
    limits.check(header.width as u64, header.height as u64)?;
    let factors = [ScalingFactor::ONE_EIGHTH, ScalingFactor::ONE_QUARTER, ScalingFactor::ONE_HALF];
    let is_enough = |f: &ScalingFactor| f.scale(header.width).min(f.scale(header.height)) >= min_side;
    let factor = factors.into_iter().find(|f| !header.is_lossless && is_enough(f));
    let factor = factor.unwrap_or(ScalingFactor::ONE);
    decompressor.set_scaling_factor(factor).map_err(|e| jpeg_error(&e))?;
    let (width, height) = (factor.scale(header.width), factor.scale(header.height));
    let mut rgb = vec![0; width * height * 3];
    let image = turbojpeg::Image {
        pixels: rgb.as_mut_slice(),
        width,
        pitch: width * 3,
        height,
        format: PixelFormat::RGB,
    };
    decompressor.decompress(bytes, image).map_err(|e| jpeg_error(&e))?;
    Ok(Thumbnail { width, height, rgb })
}

impl TryFrom<Image> for Thumbnail {
    type Error = ImageError;

    fn try_from(image: Image) -> Result<Thumbnail, ImageError> {
        let (width, height) = (image.width() as usize, image.height() as usize);
        if let Pixels::Gray16(values) = image.pixels() {
            let rgb = values.iter().flat_map(|v| [(v >> 8) as u8; 3]).collect();
            return Ok(Thumbnail { width, height, rgb });
        }
        match to_rgb8(image)?.into_pixels() {
            Pixels::Rgb8(rgb) => Ok(Thumbnail { width, height, rgb }),
            other => Err(ImageError::Unsuitable { target: "rgb8", pixels: other.name() }),
        }
    }
}

impl Thumbnail {
    /// Returns the picture as an image that can be encoded.
    ///
    /// # Errors
    /// [`ImageError::Values`] if the pixels are not as many as the size says.
    pub fn to_image(&self) -> Result<Image, ImageError> {
        let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
        Image::try_new(side(self.width), side(self.height), Pixels::Rgb8(self.rgb.clone()))
    }

    /// Returns the picture averaged over a grid of `columns` x `rows` cells.
    #[must_use]
    pub fn shrunk(&self, columns: usize, rows: usize) -> Thumbnail {
        let mut rgb = Vec::with_capacity(columns * rows * 3);
        let edge = |i: usize, n: usize, size: usize| i * size / n;
        for row in 0..rows {
            let (y0, y1) = (edge(row, rows, self.height), edge(row + 1, rows, self.height));
            for column in 0..columns {
                let (x0, x1) = (edge(column, columns, self.width), edge(column + 1, columns, self.width));
                // A grid finer than the picture repeats pixels.
                let (y1, x1) = (y1.max(y0 + 1).min(self.height), x1.max(x0 + 1).min(self.width));
                let mut sum = [0u32; 3];
                for y in y0..y1 {
                    for x in x0..x1 {
                        let at = (y * self.width + x) * 3;
                        (0..3).for_each(|c| sum[c] += u32::from(self.rgb[at + c]));
                    }
                }
                let n = ((y1 - y0) * (x1 - x0)).max(1) as u32;
                rgb.extend(sum.map(|s| (s / n) as u8));
            }
        }
        Thumbnail { width: columns, height: rows, rgb }
    }

    /// Returns the brightness of each pixel, after Rec. 601.
    pub fn luma(&self) -> Vec<u8> {
        let weigh = |p: &[u8]| (299 * u32::from(p[0]) + 587 * u32::from(p[1]) + 114 * u32::from(p[2])) / 1000;
        self.rgb.chunks_exact(3).map(|p| weigh(p) as u8).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::encode::{encode_jpeg, encode_png, encode_tiff};

    fn picture(width: usize, height: usize) -> Thumbnail {
        let rgb = (0..width * height * 3).map(|i| (i * 7 % 251) as u8).collect();
        Thumbnail { width, height, rgb }
    }

    #[test]
    fn png_round_trips_and_damage_is_an_error() {
        let picture = picture(12, 8);
        let bytes = encode_png(&picture.to_image().unwrap()).unwrap();
        let limits = Limits::default();
        let (header, back) = decode_thumbnail(&bytes, 1, &limits).unwrap();
        assert_eq!((header.width, header.height, back), (12, 8, picture));
        assert!(decode_thumbnail(&bytes[..bytes.len() - 20], 1, &limits).is_err());
        assert!(decode_thumbnail(b"no picture", 1, &limits).is_err());
        assert!(decode_thumbnail(&bytes, 1, &Limits { max_pixels: 95 }).is_err());
    }

    #[test]
    fn jpegs_are_decoded_small() {
        let bytes = encode_jpeg(&picture(64, 48).to_image().unwrap(), 90).unwrap();
        let size = |min_side: usize| {
            let (header, small) = decode_thumbnail(&bytes, min_side, &Limits::default()).unwrap();
            assert_eq!((header.width, header.height), (64, 48));
            (small.width, small.height)
        };
        assert_eq!([size(6), size(7), size(24), size(25)], [(8, 6), (16, 12), (32, 24), (64, 48)]);
    }

    #[test]
    fn depth_has_a_header_and_no_thumbnail() {
        let image = Image::try_new(3, 2, Pixels::GrayF32(vec![0.5; 6])).unwrap();
        let bytes = encode_tiff(&image).unwrap();
        let header = read_header(&bytes).unwrap();
        assert_eq!((header.format, header.width, header.height), (FileFormat::Tiff, 3, 2));
        assert_eq!((header.channels, header.bits), (1, 32));
        let error = decode_thumbnail(&bytes, 1, &Limits::default()).unwrap_err();
        assert!(matches!(error, ImageError::Unsuitable { .. }), "{error}");
    }

    #[test]
    fn shrinking_averages_cells() {
        let rgb = [[0; 3], [100; 3], [200; 3], [100; 3]].concat();
        let picture = Thumbnail { width: 2, height: 2, rgb };
        assert_eq!(picture.shrunk(1, 1).rgb, [100; 3]);
        assert_eq!(picture.shrunk(4, 4).rgb.len(), 48);
    }
}
