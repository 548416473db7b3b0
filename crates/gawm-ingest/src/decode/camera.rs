//! Camera calibrations: sensor_msgs CameraInfo and foxglove CameraCalibration, and how crop and resize change them.

use serde_json::Value;

use super::channel::{ChannelSchema, SchemaLibrary};
use super::error::DecodeError;
use super::to_json::decode_to_json;

/// A pinhole camera with distortion.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct CameraInfo {
    /// Coordinate frame; empty if not named.
    pub frame_id: String,
    /// Width in pixels of the image that the numbers are for.
    pub width: u32,
    /// Height in pixels of the image that the numbers are for.
    pub height: u32,
    /// Name of the distortion model: `plumb_bob`, `rational_polynomial`, `equidistant`.
    pub distortion_model: String,
    /// Distortion parameters; they hold for any crop and size.
    pub d: Vec<f64>,
    /// Intrinsics, row-major: `[fx 0 cx; 0 fy cy; 0 0 1]`, in pixels.
    pub k: [f64; 9],
    /// Rectification, row-major 3x3.
    pub r: [f64; 9],
    /// Projection, row-major 3x4, in pixels.
    pub p: [f64; 12],
}

/// A part of an image, in pixels of the original.
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

impl CameraInfo {
    /// Reads a calibration message in any encoding.
    ///
    /// # Errors
    /// [`DecodeError`] if the message cannot be decoded or is no calibration.
    pub fn decode(
        channel: &ChannelSchema<'_>,
        payload: &[u8],
        library: &SchemaLibrary,
    ) -> Result<Self, DecodeError> {
        let message = decode_to_json(channel, payload, library)?;
        let either = |a: &str, b: &str| message.get(a).or_else(|| message.get(b)).filter(|v| !v.is_null());
        let text = |value: Option<&Value>| value.and_then(Value::as_str).unwrap_or_default().to_owned();
        let size = |name: &'static str| {
            message.get(name).and_then(Value::as_u64).and_then(|v| u32::try_from(v).ok()).ok_or_else(|| {
                DecodeError::WrongType {
                    path: name.to_owned(),
                    expected: "a size in pixels",
                    got: "something else".to_owned(),
                }
            })
        };
        let frame = message.get("header").and_then(|h| h.get("frame_id")).or_else(|| message.get("frame_id"));
        Ok(Self {
            frame_id: text(frame),
            width: size("width")?,
            height: size("height")?,
            distortion_model: text(message.get("distortion_model")),
            d: numbers(either("d", "D"), "d")?,
            k: matrix(either("k", "K"), "k")?,
            r: matrix(either("r", "R"), "r")?,
            p: matrix(either("p", "P"), "p")?,
        })
    }

    /// Returns the calibration of the image after a crop and a resize to `width` x `height` pixels.
    ///
    /// Pixel centres lie at whole coordinates, as ROS has it: a point at u goes to `(u - crop.x + 0.5) * scale - 0.5`.
    #[must_use]
    pub fn crop_resize(&self, crop: Option<CropRect>, width: u32, height: u32) -> Self {
        let crop = crop.unwrap_or(CropRect { x: 0, y: 0, width: self.width, height: self.height });
        let (scale_x, scale_y) = (
            f64::from(width) / f64::from(crop.width.max(1)),
            f64::from(height) / f64::from(crop.height.max(1)),
        );
        let centre = |c: f64, start: u32, scale: f64| (c - f64::from(start) + 0.5) * scale - 0.5;
        let mut out = Self { width, height, ..self.clone() };
        // A zero matrix says that the camera is not calibrated, and stays zero.
        for (matrix, stride) in [(&mut out.k[..], 3), (&mut out.p[..], 4)] {
            if matrix[0] == 0.0 {
                continue;
            }
            matrix[0] *= scale_x;
            matrix[1] *= scale_x;
            matrix[2] = centre(matrix[2], crop.x, scale_x);
            matrix[stride] *= scale_y;
            matrix[stride + 1] *= scale_y;
            matrix[stride + 2] = centre(matrix[stride + 2], crop.y, scale_y);
            if stride == 4 {
                matrix[3] *= scale_x;
                matrix[7] *= scale_y;
            }
        }
        out
    }
}

fn numbers(value: Option<&Value>, path: &str) -> Result<Vec<f64>, DecodeError> {
    let Some(value) = value else { return Ok(Vec::new()) };
    let items = value.as_array().map(|items| items.iter().map(Value::as_f64).collect::<Option<Vec<f64>>>());
    items.flatten().ok_or_else(|| DecodeError::WrongType {
        path: path.to_owned(),
        expected: "an array of finite numbers",
        got: value.to_string().chars().take(60).collect(),
    })
}

/// Reads a matrix; one that is not there is zero.
fn matrix<const N: usize>(value: Option<&Value>, path: &str) -> Result<[f64; N], DecodeError> {
    let items = numbers(value, path)?;
    if items.is_empty() {
        return Ok([0.0; N]);
    }
    let got = items.len();
    <[f64; N]>::try_from(items).or_else(|_| {
        Err(DecodeError::WrongType {
            path: path.to_owned(),
            expected: "a 3x3 or 3x4 matrix",
            got: format!("{got} numbers"),
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn crop_and_resize_move_the_centre_and_scale_the_focal_length() {
        let info = CameraInfo {
            width: 320,
            height: 240,
            k: [288.0, 0.0, 159.5, 0.0, 288.5, 119.5, 0.0, 0.0, 1.0],
            p: [288.0, 0.0, 159.5, -10.0, 0.0, 288.5, 119.5, 0.0, 0.0, 0.0, 1.0, 0.0],
            ..CameraInfo::default()
        };
        let half = info.crop_resize(None, 160, 120);
        assert_eq!(half.k, [144.0, 0.0, 79.5, 0.0, 144.25, 59.5, 0.0, 0.0, 1.0]);
        assert_eq!(half.p, [144.0, 0.0, 79.5, -5.0, 0.0, 144.25, 59.5, 0.0, 0.0, 0.0, 1.0, 0.0]);
        let square = info.crop_resize(Some(CropRect { x: 40, y: 0, width: 240, height: 240 }), 240, 240);
        assert_eq!(square.k, [288.0, 0.0, 119.5, 0.0, 288.5, 119.5, 0.0, 0.0, 1.0]);
        assert_eq!((half.width, half.height), (160, 120));
        let uncalibrated = CameraInfo { width: 10, height: 10, ..CameraInfo::default() };
        assert_eq!(uncalibrated.crop_resize(None, 5, 5).k, [0.0; 9]);
    }
}
