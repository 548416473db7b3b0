//! Encoded frames as small RGB pictures, for rules, reports and contact sheets.

use crate::image_header::{ImageFormat, ImageHeader, image_header};

/// Most pixels of a frame that is decoded.
const MAX_PIXELS: u64 = 1 << 26;

/// An RGB picture.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Picture {
    pub(crate) width: usize,
    pub(crate) height: usize,
    /// Row-major, three bytes per pixel.
    pub(crate) rgb: Vec<u8>,
}

/// Why a frame is no picture.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum PictureError {
    /// The bytes are damaged, or of an unknown format.
    #[error("{0}")]
    Damaged(String),
    /// The format is known but not shown: depth in TIFF.
    #[error("pictures of this format are not shown")]
    NotShown,
    /// The picture is larger than is permitted.
    #[error("expected at most {MAX_PIXELS} pixels, got {width} x {height}")]
    TooLarge {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
    },
}

/// Decodes a frame; with JPEG, at the smallest scale at which both sides have at least `min_side` pixels.
pub(crate) fn decode(bytes: &[u8], min_side: usize) -> Result<(ImageHeader, Picture), PictureError> {
    let header = image_header(bytes).map_err(|e| PictureError::Damaged(e.to_string()))?;
    if u64::from(header.width) * u64::from(header.height) > MAX_PIXELS {
        return Err(PictureError::TooLarge { width: header.width, height: header.height });
    }
    let picture = match header.format {
        ImageFormat::Jpeg => decode_jpeg(bytes, min_side)?,
        ImageFormat::Png => decode_png(bytes)?,
        ImageFormat::Tiff => return Err(PictureError::NotShown),
    };
    Ok((header, picture))
}

fn damaged(e: impl std::fmt::Display) -> PictureError {
    PictureError::Damaged(e.to_string())
}

fn decode_jpeg(bytes: &[u8], min_side: usize) -> Result<Picture, PictureError> {
    use turbojpeg::{Decompressor, Image, PixelFormat, ScalingFactor};
    let mut decompressor = Decompressor::new().map_err(damaged)?;
    let header = decompressor.read_header(bytes).map_err(damaged)?;
    let factors = [ScalingFactor::ONE_EIGHTH, ScalingFactor::ONE_QUARTER, ScalingFactor::ONE_HALF];
    let is_enough = |f: &ScalingFactor| f.scale(header.width).min(f.scale(header.height)) >= min_side;
    let factor = if header.is_lossless {
        ScalingFactor::ONE
    } else {
        factors.into_iter().find(is_enough).unwrap_or(ScalingFactor::ONE)
    };
    decompressor.set_scaling_factor(factor).map_err(damaged)?;
    let (width, height) = (factor.scale(header.width), factor.scale(header.height));
    let mut rgb = vec![0; width * height * 3];
    let image =
        Image { pixels: rgb.as_mut_slice(), width, pitch: width * 3, height, format: PixelFormat::RGB };
    decompressor.decompress(bytes, image).map_err(damaged)?;
    Ok(Picture { width, height, rgb })
}

fn decode_png(bytes: &[u8]) -> Result<Picture, PictureError> {
    use png::{ColorType, Decoder, Transformations};
    let mut decoder = Decoder::new(std::io::Cursor::new(bytes));
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(damaged)?;
    let size = reader.output_buffer_size().filter(|n| *n as u64 <= 4 * MAX_PIXELS);
    let mut pixels = vec![0; size.ok_or_else(|| damaged("a size that overflows"))?];
    let frame = reader.next_frame(&mut pixels).map_err(damaged)?;
    pixels.truncate(frame.buffer_size());
    let rgb = match frame.color_type {
        ColorType::Rgb => pixels,
        ColorType::Rgba => pixels.chunks_exact(4).flat_map(|p| [p[0], p[1], p[2]]).collect(),
        ColorType::Grayscale => pixels.iter().flat_map(|p| [*p; 3]).collect(),
        ColorType::GrayscaleAlpha => pixels.chunks_exact(2).flat_map(|p| [p[0]; 3]).collect(),
        ColorType::Indexed => return Err(damaged("a palette that was not expanded")),
    };
    Ok(Picture { width: frame.width as usize, height: frame.height as usize, rgb })
}

impl Picture {
    /// Returns the picture averaged over a grid of `columns` x `rows` cells.
    pub(crate) fn shrunk(&self, columns: usize, rows: usize) -> Picture {
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
        Picture { width: columns, height: rows, rgb }
    }

    /// Returns the brightness of each pixel, after Rec. 601.
    pub(crate) fn luma(&self) -> Vec<u8> {
        let weigh = |p: &[u8]| (299 * u32::from(p[0]) + 587 * u32::from(p[1]) + 114 * u32::from(p[2])) / 1000;
        self.rgb.chunks_exact(3).map(|p| weigh(p) as u8).collect()
    }

    /// Encodes the picture as JPEG of middling quality, for embedding.
    pub(crate) fn to_jpeg(&self) -> Result<Vec<u8>, turbojpeg::Error> {
        use turbojpeg::{Image, PixelFormat, Subsamp};
        let image = Image {
            pixels: self.rgb.as_slice(),
            width: self.width,
            pitch: self.width * 3,
            height: self.height,
            format: PixelFormat::RGB,
        };
        Ok(turbojpeg::compress(image, 75, Subsamp::Sub2x2)?.to_vec())
    }

    /// Encodes the picture as PNG.
    pub(crate) fn to_png(&self) -> Result<Vec<u8>, png::EncodingError> {
        let mut out = Vec::new();
        let mut encoder = png::Encoder::new(&mut out, self.width as u32, self.height as u32);
        encoder.set_color(png::ColorType::Rgb);
        encoder.set_depth(png::BitDepth::Eight);
        encoder.write_header()?.write_image_data(&self.rgb)?;
        Ok(out)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn png_round_trips_and_damage_is_an_error() {
        let rgb: Vec<u8> = (0..12 * 8 * 3).map(|i| (i * 7 % 251) as u8).collect();
        let picture = Picture { width: 12, height: 8, rgb };
        let bytes = picture.to_png().unwrap();
        let (header, back) = decode(&bytes, 1).unwrap();
        assert_eq!((header.width, header.height, back), (12, 8, picture));
        assert!(matches!(decode(&bytes[..bytes.len() - 20], 1), Err(PictureError::Damaged(_))));
        assert!(matches!(decode(b"no picture", 1), Err(PictureError::Damaged(_))));
    }

    #[test]
    fn shrinking_averages_cells() {
        let picture = Picture { width: 2, height: 2, rgb: [[0; 3], [100; 3], [200; 3], [100; 3]].concat() };
        assert_eq!(picture.shrunk(1, 1).rgb, [100; 3]);
        assert_eq!(picture.shrunk(4, 4).rgb.len(), 48);
    }
}
