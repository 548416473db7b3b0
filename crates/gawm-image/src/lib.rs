//! Image codecs in one place: JPEG, PNG, TIFF and raw pixel layouts; crop and resize.
#![forbid(unsafe_code)]

mod pixels;

pub use pixels::{DecodePixelsError, PixelValues, Pixels, decode_pixels};
