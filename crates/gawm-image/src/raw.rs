//! Raw pixel layouts of camera messages.

use crate::error::ImageError;
use crate::image::{Image, Limits, Pixels};

/// The layouts that are decoded, for errors.
pub(crate) const SUPPORTED: [&str; 19] = [
    "rgb8",
    "bgr8",
    "rgba8",
    "bgra8",
    "mono8",
    "8UC1",
    "8UC3",
    "8UC4",
    "mono16",
    "16UC1",
    "32FC1",
    "yuyv",
    "yuv422_yuy2",
    "uyvy",
    "yuv422",
    "nv12",
    "nv21",
    "rgb16",
    "bgr16",
];

/// How the pixels of a raw image lie in memory.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[non_exhaustive]
pub enum Layout {
    /// Red, green, blue.
    Rgb8,
    /// Blue, green, red; also OpenCV's `8UC3`.
    Bgr8,
    /// Red, green, blue, alpha.
    Rgba8,
    /// Blue, green, red, alpha; also OpenCV's `8UC4`.
    Bgra8,
    /// One byte of grey.
    Mono8,
    /// Two bytes of grey or depth.
    Mono16,
    /// A float of depth.
    Float32,
    /// Red, green, blue of 16 bits each; the upper 8 are kept.
    Rgb16,
    /// Blue, green, red of 16 bits each; the upper 8 are kept.
    Bgr16,
    /// Y U Y V for two pixels.
    Yuyv,
    /// U Y V Y for two pixels.
    Uyvy,
    /// A plane of Y, then one of U V at half resolution.
    Nv12,
    /// A plane of Y, then one of V U at half resolution.
    Nv21,
}

/// A raw image as a message has it.
#[derive(Clone, Copy, Debug)]
pub struct RawImage<'a> {
    /// Name of the layout: ROS's and foxglove's `encoding`.
    pub layout: &'a str,
    /// Width in pixels.
    pub width: u32,
    /// Height in pixels.
    pub height: u32,
    /// Bytes of a row, padding included; 0 = no padding.
    pub step: u32,
    /// Whether 16-bit and float values are big-endian.
    pub is_big_endian: bool,
    /// The rows.
    pub data: &'a [u8],
}

impl Layout {
    /// Finds a layout by ROS's or foxglove's name of it, whatever its case.
    ///
    /// # Errors
    /// [`ImageError::UnsupportedLayout`] for Bayer patterns and anything else that is not decoded.
    pub fn from_name(name: &str) -> Result<Self, ImageError> {
        Ok(match name.to_ascii_lowercase().as_str() {
            "rgb8" => Self::Rgb8,
            "bgr8" | "8uc3" => Self::Bgr8,
            "rgba8" => Self::Rgba8,
            "bgra8" | "8uc4" => Self::Bgra8,
            "mono8" | "8uc1" => Self::Mono8,
            "mono16" | "16uc1" => Self::Mono16,
            "32fc1" => Self::Float32,
            "rgb16" => Self::Rgb16,
            "bgr16" | "16uc3" => Self::Bgr16,
            "yuyv" | "yuv422_yuy2" | "yuy2" => Self::Yuyv,
            "uyvy" | "yuv422" => Self::Uyvy,
            "nv12" => Self::Nv12,
            "nv21" => Self::Nv21,
            _ => return Err(ImageError::UnsupportedLayout { layout: name.to_owned() }),
        })
    }

    /// Returns the bytes of a row without padding; of planar layouts, of a row of the first plane.
    fn row_bytes(self, width: u64) -> u64 {
        match self {
            Self::Mono8 => width,
            Self::Rgb8 | Self::Bgr8 => width * 3,
            Self::Rgba8 | Self::Bgra8 | Self::Float32 => width * 4,
            Self::Mono16 => width * 2,
            Self::Rgb16 | Self::Bgr16 => width * 6,
            Self::Yuyv | Self::Uyvy => width.div_ceil(2) * 4,
            Self::Nv12 | Self::Nv21 => width,
        }
    }

    fn is_planar(self) -> bool {
        matches!(self, Self::Nv12 | Self::Nv21)
    }
}

/// Decodes a raw image to RGB, grey, 16-bit grey or float. YUV is taken as BT.601 in limited range, as cameras send it.
///
/// # Errors
/// [`ImageError`] if the layout is not supported, the size beyond the limits, or bytes are missing.
pub fn decode_raw(raw: &RawImage<'_>, limits: &Limits) -> Result<Image, ImageError> {
    let layout = Layout::from_name(raw.layout)?;
    let (width, height) = (u64::from(raw.width), u64::from(raw.height));
    limits.check(width, height)?;
    let rows = Rows::try_new(raw, layout)?;
    let is_big = raw.is_big_endian;
    let pixels = match layout {
        Layout::Rgb8 => Pixels::Rgb8(rows.collect(|row, out| out.extend_from_slice(row))),
        Layout::Bgr8 => Pixels::Rgb8(rows.pick(3, [2, 1, 0])),
        Layout::Rgba8 => Pixels::Rgb8(rows.pick(4, [0, 1, 2])),
        Layout::Bgra8 => Pixels::Rgb8(rows.pick(4, [2, 1, 0])),
        Layout::Mono8 => Pixels::Gray8(rows.collect(|row, out| out.extend_from_slice(row))),
        Layout::Rgb16 | Layout::Bgr16 => {
            let high = usize::from(!is_big);
            let order =
                if layout == Layout::Rgb16 { [high, high + 2, high + 4] } else { [high + 4, high + 2, high] };
            Pixels::Rgb8(rows.pick(6, order))
        }
        Layout::Mono16 => Pixels::Gray16(rows.collect(|row, out| {
            out.extend(
                row.as_chunks::<2>()
                    .0
                    .iter()
                    .map(|b| if is_big { u16::from_be_bytes(*b) } else { u16::from_le_bytes(*b) }),
            );
        })),
        Layout::Float32 => Pixels::GrayF32(rows.collect(|row, out| {
            out.extend(
                row.as_chunks::<4>()
                    .0
                    .iter()
                    .map(|b| if is_big { f32::from_be_bytes(*b) } else { f32::from_le_bytes(*b) }),
            );
        })),
        Layout::Yuyv => Pixels::Rgb8(rows.yuv_422([0, 2], 1, 3)),
        Layout::Uyvy => Pixels::Rgb8(rows.yuv_422([1, 3], 0, 2)),
        Layout::Nv12 => Pixels::Rgb8(rows.yuv_420(0, 1)),
        Layout::Nv21 => Pixels::Rgb8(rows.yuv_420(1, 0)),
    };
    Image::try_new(raw.width, raw.height, pixels)
}

/// The rows of an image, checked to be there.
struct Rows<'a> {
    data: &'a [u8],
    width: usize,
    height: usize,
    step: usize,
    row_bytes: usize,
}

impl<'a> Rows<'a> {
    fn try_new(raw: &RawImage<'a>, layout: Layout) -> Result<Self, ImageError> {
        let (width, height) = (u64::from(raw.width), u64::from(raw.height));
        let row_bytes = layout.row_bytes(width);
        let step = if raw.step == 0 { row_bytes } else { u64::from(raw.step) };
        if step < row_bytes {
            return Err(ImageError::Step {
                layout: raw.layout.to_owned(),
                width: raw.width,
                expected: row_bytes,
                got: raw.step,
            });
        }
        // Rows of U and V, which take as many bytes as one of Y, rounded up to a pair.
        let n_rows = if layout.is_planar() { height + height.div_ceil(2) } else { height };
        let last_row = if layout.is_planar() { width.div_ceil(2) * 2 } else { row_bytes };
        let expected = (n_rows - 1).saturating_mul(step).saturating_add(last_row);
        if (raw.data.len() as u64) < expected {
            return Err(ImageError::Short {
                layout: raw.layout.to_owned(),
                width: raw.width,
                height: raw.height,
                step,
                expected,
                got: raw.data.len(),
            });
        }
        // All fit usize, since they are not beyond the length of a slice.
        let narrow = |v: u64| usize::try_from(v).unwrap_or(usize::MAX);
        Ok(Self {
            data: raw.data,
            width: narrow(width),
            height: narrow(height),
            step: narrow(step),
            row_bytes: narrow(row_bytes),
        })
    }

    fn row(&self, y: usize) -> &'a [u8] {
        &self.data[y * self.step..][..self.row_bytes]
    }

    fn collect<T>(&self, mut each: impl FnMut(&[u8], &mut Vec<T>)) -> Vec<T> {
        let mut out = Vec::with_capacity(self.row_bytes * self.height / std::mem::size_of::<T>());
        for y in 0..self.height {
            each(self.row(y), &mut out);
        }
        out
    }

    /// Takes three bytes of each pixel of `size` bytes.
    fn pick(&self, size: usize, order: [usize; 3]) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.width * self.height * 3);
        for y in 0..self.height {
            for pixel in self.row(y).chunks_exact(size) {
                out.extend(order.map(|i| pixel[i]));
            }
        }
        out
    }

    fn yuv_422(&self, y_at: [usize; 2], u_at: usize, v_at: usize) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.width * self.height * 3);
        for y in 0..self.height {
            let row = self.row(y);
            for x in 0..self.width {
                let pair = &row[x / 2 * 4..][..4];
                out.extend(rgb_of(pair[y_at[x % 2]], pair[u_at], pair[v_at]));
            }
        }
        out
    }

    fn yuv_420(&self, u_at: usize, v_at: usize) -> Vec<u8> {
        let mut out = Vec::with_capacity(self.width * self.height * 3);
        for y in 0..self.height {
            let row = self.row(y);
            let chroma = &self.data[(self.height + y / 2) * self.step..];
            for (x, luma) in row.iter().enumerate() {
                let pair = &chroma[x / 2 * 2..][..2];
                out.extend(rgb_of(*luma, pair[u_at], pair[v_at]));
            }
        }
        out
    }
}

/// BT.601, limited range, in 8-bit fixed point.
fn rgb_of(y: u8, u: u8, v: u8) -> [u8; 3] {
    let (y, u, v) = (298 * (i32::from(y) - 16) + 128, i32::from(u) - 128, i32::from(v) - 128);
    let channels = [y + 409 * v, y - 100 * u - 208 * v, y + 516 * u];
    channels.map(|c| (c >> 8).clamp(0, 255) as u8)
}
