//! A decoded image.

use crate::error::ImageError;

/// A decoded image: rows from top to bottom without padding.
#[derive(Clone, Debug, PartialEq)]
pub struct Image {
    width: u32,
    height: u32,
    pixels: Pixels,
}

/// The values of an image, row-major.
#[derive(Clone, Debug, PartialEq)]
#[non_exhaustive]
pub enum Pixels {
    /// Red, green, blue; shape [height, width, 3].
    Rgb8(Vec<u8>),
    /// Grey; shape [height, width].
    Gray8(Vec<u8>),
    /// Grey or depth, of 16 bits; shape [height, width].
    Gray16(Vec<u16>),
    /// Depth as a float, NaN where there is none; shape [height, width].
    GrayF32(Vec<f32>),
}

/// Caps on what is decoded.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Limits {
    /// Most pixels of one image. 100 million by default: above any camera, far below what exhausts memory.
    pub max_pixels: u64,
}

impl Default for Limits {
    fn default() -> Self {
        Self { max_pixels: 100_000_000 }
    }
}

impl Limits {
    /// Checks a size before memory is asked for.
    ///
    /// # Errors
    /// [`ImageError::Size`] if a side is 0 or the product above the cap.
    pub fn check(&self, width: u64, height: u64) -> Result<(), ImageError> {
        match width.checked_mul(height) {
            Some(pixels)
                if pixels > 0 && pixels <= self.max_pixels && width.max(height) <= u64::from(u32::MAX) =>
            {
                Ok(())
            }
            _ => Err(ImageError::Size { width, height, max_pixels: self.max_pixels }),
        }
    }
}

impl Image {
    /// Makes an image of its values.
    ///
    /// # Errors
    /// [`ImageError::Values`] if their number is not that of the size.
    pub fn try_new(width: u32, height: u32, pixels: Pixels) -> Result<Self, ImageError> {
        let expected = u64::from(width) * u64::from(height) * pixels.channels() as u64;
        let got = pixels.len();
        if got as u64 != expected {
            return Err(ImageError::Values { width, height, expected, got });
        }
        Ok(Self { width, height, pixels })
    }

    /// Returns the width in pixels.
    pub fn width(&self) -> u32 {
        self.width
    }

    /// Returns the height in pixels.
    pub fn height(&self) -> u32 {
        self.height
    }

    /// Returns the values.
    pub fn pixels(&self) -> &Pixels {
        &self.pixels
    }

    /// Takes the values out.
    pub fn into_pixels(self) -> Pixels {
        self.pixels
    }
}

impl Pixels {
    /// Returns the values per pixel.
    pub fn channels(&self) -> usize {
        match self {
            Self::Rgb8(_) => 3,
            Self::Gray8(_) | Self::Gray16(_) | Self::GrayF32(_) => 1,
        }
    }

    /// Returns the name of the kind of pixels, as ROS has it.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Rgb8(_) => "rgb8",
            Self::Gray8(_) => "mono8",
            Self::Gray16(_) => "16UC1",
            Self::GrayF32(_) => "32FC1",
        }
    }

    fn len(&self) -> usize {
        match self {
            Self::Rgb8(values) | Self::Gray8(values) => values.len(),
            Self::Gray16(values) => values.len(),
            Self::GrayF32(values) => values.len(),
        }
    }
}
