//! Antialiased bilinear resizing of 8-bit pixels: the arithmetic of Pillow and torchvision, to the bit.
//!
//! Each target pixel is the mean of the source pixels under a triangle, which is as wide as the target's pixel distance when the
//! image shrinks. Rows first, then columns; weights in fixed point, the values between the two passes rounded to 8 bits.

/// Bits after the point of a weight: 8 bits of value and 2 of headroom are left of 32.
const PRECISION: u32 = 32 - 8 - 2;

/// The source pixels behind one target pixel.
struct Window {
    start: usize,
    /// Weights in fixed point, from `start` on.
    weights: Vec<i32>,
}

/// Resizes rows of `C`-channel pixels from one size (width, height) to another; no side is 0.
pub(crate) fn bilinear<const C: usize>(values: &[u8], from: (usize, usize), to: (usize, usize)) -> Vec<u8> {
    let across = if from.0 == to.0 { None } else { Some(horizontal::<C>(values, from, to.0)) };
    let values = across.as_deref().unwrap_or(values);
    if from.1 == to.1 { values.to_vec() } else { vertical(values, to.0 * C, (from.1, to.1)) }
}

/// Computes the windows of all target pixels along one side.
fn windows(from: usize, to: usize) -> Vec<Window> {
    let scale = from as f64 / to as f64;
    let support = scale.max(1.0);
    let triangle = |x: f64| (1.0 - x.abs()).max(0.0);
    (0..to)
        .map(|i| {
            let centre = (i as f64 + 0.5) * scale;
            let start = (centre - support + 0.5).max(0.0) as usize;
            let end = ((centre + support + 0.5) as usize).min(from);
            let raw: Vec<f64> =
                (start..end).map(|x| triangle((x as f64 - centre + 0.5) * (1.0 / support))).collect();
            let sum: f64 = raw.iter().sum();
            let weights = raw.iter().map(|w| (0.5 + w / sum * f64::from(1 << PRECISION)) as i32).collect();
            Window { start, weights }
        })
        .collect()
}

fn round(sum: i32) -> u8 {
    (sum >> PRECISION).clamp(0, 255) as u8
}

fn horizontal<const C: usize>(values: &[u8], (from, height): (usize, usize), to: usize) -> Vec<u8> {
    let windows = windows(from, to);
    let mut out = Vec::with_capacity(to * height * C);
    for row in values.chunks_exact(from * C) {
        for window in &windows {
            let mut sums = [1_i32 << (PRECISION - 1); C];
            let pixels = row[window.start * C..].as_chunks::<C>().0;
            for (pixel, weight) in pixels.iter().zip(&window.weights) {
                for (sum, value) in sums.iter_mut().zip(pixel) {
                    *sum += i32::from(*value) * weight;
                }
            }
            out.extend(sums.map(round));
        }
    }
    out
}

fn vertical(values: &[u8], row_bytes: usize, (from, to): (usize, usize)) -> Vec<u8> {
    let mut out = Vec::with_capacity(to * row_bytes);
    let mut sums = vec![0_i32; row_bytes];
    for window in windows(from, to) {
        sums.fill(1 << (PRECISION - 1));
        let rows = values.chunks_exact(row_bytes).skip(window.start);
        for (row, weight) in rows.zip(&window.weights) {
            for (sum, value) in sums.iter_mut().zip(row) {
                *sum += i32::from(*value) * weight;
            }
        }
        out.extend(sums.iter().map(|sum| round(*sum)));
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A row of values as Pillow 13 resizes them with `Image.BILINEAR`.
    fn check_row(from: &[u8], expected: &[u8]) {
        assert_eq!(bilinear::<1>(from, (from.len(), 1), (expected.len(), 1)), expected);
        assert_eq!(bilinear::<1>(from, (1, from.len()), (1, expected.len())), expected);
    }

    #[test]
    fn rows_equal_pillow() {
        check_row(&[121, 66, 189, 242, 33, 6, 240, 132], &[125, 125, 137]);
        check_row(&[119, 98, 240, 243, 203, 77, 118, 77], &[110, 204, 218, 111, 94]);
        check_row(&[199, 7, 32, 81], &[199, 167, 82, 8, 20, 31, 51, 73, 81]);
        check_row(&[21, 154, 15, 137, 242, 198, 218], &[94, 191]);
        check_row(&[202, 227], &[202, 202, 207, 215, 222, 227, 227]);
        check_row(&[68, 187, 49, 18, 69, 253, 111, 132, 223, 154], &[125]);
        check_row(
            &[215, 197, 179, 208, 118, 172, 14, 143, 83, 167, 53, 108, 136],
            &[213, 194, 186, 179, 139, 99, 83, 107, 140, 82, 98, 133],
        );
    }
}
