//! Planes of a decoded frame to 8-bit RGB.
//!
//! Limited or full range and the matrix (BT.601, BT.709, BT.2020) are those that the stream names; a stream that names none
//! is limited-range BT.601, as FFmpeg takes it. Chroma is repeated, not interpolated. All arithmetic is in integers with 16
//! fractional bits, rounded to nearest.

use super::VideoError;

/// How samples lie in planes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Sampling {
    /// Luma alone.
    Gray,
    /// Y, U, V in planes; chroma is this many powers of two smaller across and down.
    Planar {
        /// Powers of two across.
        across: u32,
        /// Powers of two down.
        down: u32,
    },
    /// Green, blue, red in planes.
    Gbr,
}

/// Weights of red and blue in luma.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Matrix {
    pub(super) red: f64,
    pub(super) blue: f64,
}

pub(super) const BT601: Matrix = Matrix { red: 0.299, blue: 0.114 };
pub(super) const BT709: Matrix = Matrix { red: 0.2126, blue: 0.0722 };
pub(super) const BT2020: Matrix = Matrix { red: 0.2627, blue: 0.0593 };

/// What the samples of a frame mean.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Meaning {
    pub(super) sampling: Sampling,
    /// Bits of a sample, 8 to 16; above 8 in two bytes, low byte first.
    pub(super) bits: u32,
    pub(super) is_full_range: bool,
    pub(super) matrix: Matrix,
}

/// One plane: bytes and how many of them a row has, padding included.
#[derive(Debug, Clone, Copy)]
pub(super) struct Plane<'a> {
    pub(super) data: &'a [u8],
    pub(super) stride: usize,
}

impl Plane<'_> {
    /// Returns the bytes of a row, which begins with `n` samples.
    fn row(&self, y: usize, n: usize, bits: u32) -> Option<&[u8]> {
        let start = y.checked_mul(self.stride)?;
        let bytes = n * if bits > 8 { 2 } else { 1 };
        self.data.get(start..start.checked_add(bytes)?)
    }
}

fn sample(row: &[u8], x: usize, bits: u32) -> i64 {
    if bits > 8 { i64::from(u16::from_le_bytes([row[2 * x], row[2 * x + 1]])) } else { i64::from(row[x]) }
}

/// Factors with 16 fractional bits, from samples to 0..=255.
struct Factors {
    black: i64,
    middle: i64,
    luma: i64,
    red_v: i64,
    green_u: i64,
    green_v: i64,
    blue_u: i64,
}

impl Factors {
    fn new(meaning: &Meaning) -> Factors {
        let Meaning { bits, is_full_range, matrix, .. } = meaning;
        let unit = f64::from(1_u32 << (bits - 8));
        let (black, white, chroma) = if *is_full_range {
            let top = f64::from((1_u32 << bits) - 1);
            (0.0, top, top)
        } else {
            (16.0 * unit, 219.0 * unit, 224.0 * unit)
        };
        let green = 1.0 - matrix.red - matrix.blue;
        let fixed = |value: f64| (value * 65536.0).round() as i64;
        let scale = 255.0 / chroma;
        Factors {
            black: black as i64,
            middle: i64::from(1_u32 << (bits - 1)),
            luma: fixed(255.0 / white),
            red_v: fixed(2.0 * (1.0 - matrix.red) * scale),
            green_u: fixed(2.0 * (1.0 - matrix.blue) * matrix.blue / green * scale),
            green_v: fixed(2.0 * (1.0 - matrix.red) * matrix.red / green * scale),
            blue_u: fixed(2.0 * (1.0 - matrix.blue) * scale),
        }
    }

    fn rgb(&self, y: i64, u: i64, v: i64) -> [u8; 3] {
        let (y, u, v) = ((y - self.black) * self.luma, u - self.middle, v - self.middle);
        let byte = |value: i64| ((value + 32768) >> 16).clamp(0, 255) as u8;
        [byte(y + self.red_v * v), byte(y - self.green_u * u - self.green_v * v), byte(y + self.blue_u * u)]
    }
}

/// Returns the frame as rows of RGB.
///
/// # Errors
/// A plane is smaller than the frame.
pub(super) fn rgb_of(
    width: usize,
    height: usize,
    planes: &[Plane<'_>],
    meaning: &Meaning,
) -> Result<Vec<u8>, VideoError> {
    let short = || VideoError::Frame {
        what: "decoded frame",
        expected: "planes as large as the frame",
        got: format!("less than {width}x{height}"),
    };
    let (factors, bits) = (Factors::new(meaning), meaning.bits);
    let mut out = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        let row = |plane: usize, y: usize, n: usize| {
            planes.get(plane).and_then(|plane| plane.row(y, n, bits)).ok_or_else(short)
        };
        let first = row(0, y, width)?;
        match meaning.sampling {
            Sampling::Gray => {
                let middle = factors.middle;
                out.extend((0..width).flat_map(|x| factors.rgb(sample(first, x, bits), middle, middle)));
            }
            Sampling::Planar { across, down } => {
                let n = width.div_ceil(1 << across);
                let (u, v) = (row(1, y >> down, n)?, row(2, y >> down, n)?);
                out.extend((0..width).flat_map(|x| {
                    let chroma = x >> across;
                    factors.rgb(sample(first, x, bits), sample(u, chroma, bits), sample(v, chroma, bits))
                }));
            }
            Sampling::Gbr => {
                let (blue, red) = (row(1, y, width)?, row(2, y, width)?);
                let (middle, gray) = (factors.middle, |row: &[u8], x| sample(row, x, bits));
                out.extend((0..width).flat_map(|x| {
                    [red, first, blue].map(|row| factors.rgb(gray(row, x), middle, middle)[0])
                }));
            }
        }
    }
    Ok(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pixel(meaning: &Meaning, samples: [u16; 3]) -> [u8; 3] {
        let bytes = samples.map(|s| if meaning.bits > 8 { s.to_le_bytes().to_vec() } else { vec![s as u8] });
        let planes: Vec<Plane<'_>> = bytes.iter().map(|data| Plane { data, stride: data.len() }).collect();
        rgb_of(1, 1, &planes, meaning).unwrap().try_into().unwrap()
    }

    fn meaning(bits: u32, is_full_range: bool, matrix: Matrix) -> Meaning {
        Meaning { sampling: Sampling::Planar { across: 1, down: 1 }, bits, is_full_range, matrix }
    }

    #[test]
    fn known_colours_come_out() {
        let limited = meaning(8, false, BT601);
        assert_eq!(pixel(&limited, [16, 128, 128]), [0, 0, 0]);
        assert_eq!(pixel(&limited, [235, 128, 128]), [255, 255, 255]);
        // Pure red in BT.601 and BT.709, limited range.
        assert_eq!(pixel(&limited, [81, 90, 240]), [254, 0, 0]);
        assert_eq!(pixel(&meaning(8, false, BT709), [63, 102, 240]), [255, 1, 0]);
        assert_eq!(pixel(&meaning(8, true, BT601), [0, 128, 128]), [0, 0, 0]);
        assert_eq!(pixel(&meaning(8, true, BT601), [255, 128, 128]), [255, 255, 255]);
        assert_eq!(pixel(&meaning(10, false, BT2020), [940, 512, 512]), [255, 255, 255]);
        assert_eq!(pixel(&meaning(10, false, BT601), [324, 360, 960]), [254, 0, 0]);
        let gbr = Meaning { sampling: Sampling::Gbr, ..meaning(8, true, BT601) };
        assert_eq!(pixel(&gbr, [10, 20, 30]), [30, 10, 20]);
        let gray = Meaning { sampling: Sampling::Gray, ..meaning(8, true, BT601) };
        assert_eq!(pixel(&gray, [77, 0, 0]), [77, 77, 77]);
    }

    #[test]
    fn short_planes_are_no_frame() {
        let data = [16; 4];
        let planes = [Plane { data: &data, stride: 2 }; 3];
        assert!(rgb_of(2, 2, &planes, &meaning(8, false, BT601)).is_ok());
        assert!(rgb_of(2, 3, &planes, &meaning(8, false, BT601)).is_err());
        assert!(rgb_of(3, 2, &planes, &meaning(8, false, BT601)).is_err());
        assert!(rgb_of(2, 2, &planes[..2], &meaning(8, false, BT601)).is_err());
    }
}
