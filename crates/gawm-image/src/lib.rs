//! Image codecs in one place: JPEG, PNG, TIFF and raw pixel layouts; crop and resize.
//!
//! [`decode`] takes the bytes of a file and goes by their content, whatever a label says; [`decode_raw`] takes rows of pixels in a
//! named layout. Both give an [`Image`], which the `encode_*` functions turn into a file again.
//!
//! ```
//! use gawm_image::{Image, Limits, Pixels, decode, encode_png};
//!
//! let image = Image::try_new(2, 1, Pixels::Rgb8(vec![255, 0, 0, 0, 0, 255]))?;
//! let file = encode_png(&image)?;
//! assert_eq!(decode(&file, &Limits::default())?, image);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! Invariant: sizes are checked against [`Limits`] before memory is asked for, and an image that lacks a part of its data is an
//! error: no function returns a half-grey picture.

#![forbid(unsafe_code)]

mod codec;
mod depth;
mod encode;
mod error;
mod format;
mod image;
mod raw;
mod resample;
mod thumbnail;
mod transform;

#[cfg(test)]
mod tests;

pub use codec::{decode, decode_rgb_into};
pub use depth::{decode_compressed_depth, is_compressed_depth};
pub use encode::{encode_jpeg, encode_png, encode_tiff};
pub use error::ImageError;
pub use format::{FileFormat, ImageHeader, read_header, sniff, verify};
pub use image::{Image, Limits, Pixels};
pub use raw::{Layout, RawImage, decode_raw};
pub use thumbnail::{Thumbnail, decode_thumbnail};
pub use transform::{CropRect, crop, resize, to_gray8, to_rgb8};
