//! Right operands of products, arranged in panels.

use crate::simd::{Level, level};

/// A right operand in panels of [`panel_width`] columns: `[panels][k][width]`, the last one filled up with zeros.
#[derive(Debug, Clone, Default)]
pub struct Packed {
    values: Vec<f32>,
    width: usize,
    k: usize,
    n: usize,
}

impl Packed {
    /// Packs `b(k, n) = values[k * k_stride + n * n_stride]`, reusing the memory of this panel.
    ///
    /// # Panics
    ///
    /// If `values` is too short.
    pub fn fill(&mut self, values: &[f32], [k, n]: [usize; 2], [k_stride, n_stride]: [usize; 2]) {
        let width = panel_width();
        assert!(
            k == 0 || n == 0 || (k - 1) * k_stride + (n - 1) * n_stride < values.len(),
            "pack: too few values"
        );
        (self.width, self.k, self.n) = (width, k, n);
        self.values.resize(n.div_ceil(width) * width * k, 0.0);
        if k == 0 {
            return;
        }
        for (panel, out) in self.values.chunks_exact_mut(width * k).enumerate() {
            let first = panel * width;
            let columns = width.min(n - first);
            if columns < width {
                out.fill(0.0);
            }
            if n_stride == 1 {
                for (row, out) in out.chunks_exact_mut(width).enumerate() {
                    let start = row * k_stride + first;
                    out[..columns].copy_from_slice(&values[start..start + columns]);
                }
            } else if k_stride == 1 {
                transpose(&values[first * n_stride..], n_stride, [columns, k], out, width);
            } else {
                for column in 0..columns {
                    let source = values[(first + column) * n_stride..].iter().step_by(k_stride);
                    for (out, value) in out[column..].iter_mut().step_by(width).zip(source) {
                        *out = *value;
                    }
                }
            }
        }
    }

    /// Packs the transpose of a weight `[n, k]`, as [`Packed::fill`] does.
    pub fn of_transposed(values: &[f32], [n, k]: [usize; 2]) -> Packed {
        let mut packed = Packed::default();
        packed.fill(values, [k, n], [1, k]);
        packed
    }

    /// Packs a matrix `[k, n]`, as [`Packed::fill`] does.
    pub fn of(values: &[f32], [k, n]: [usize; 2]) -> Packed {
        let mut packed = Packed::default();
        packed.fill(values, [k, n], [n, 1]);
        packed
    }

    /// Number of columns, without the zeros of the last panel.
    pub fn columns(&self) -> usize {
        self.n
    }

    /// All panels, one after another.
    pub(crate) fn values(&self) -> &[f32] {
        &self.values
    }

    /// Whether a product of `k` terms and `n` columns (zeros of the last panel included) can read this at the level in use.
    pub(crate) fn fits(&self, k: usize, n: usize) -> bool {
        (self.width, self.k) == (panel_width(), k) && n * k <= self.values.len()
    }
}

/// Number of columns of a register tile at the level in use.
pub fn panel_width() -> usize {
    match level() {
        Level::Avx512 => 32,
        Level::Avx2 => 16,
        Level::Portable => 8,
    }
}

/// Side of the squares that are transposed in registers.
const SQUARE: usize = 8;

/// Writes the transpose of `rows` x `k` values, whose rows are `stride` apart, to rows of `width` elements.
pub(crate) fn transpose(values: &[f32], stride: usize, [rows, k]: [usize; 2], out: &mut [f32], width: usize) {
    if rows == 0 || k == 0 {
        return;
    }
    assert!((rows - 1) * stride + k <= values.len(), "transpose: too few values");
    assert!(rows <= width && (k - 1) * width + rows <= out.len(), "transpose: output is too short");
    let (whole_rows, whole_k) = (rows - rows % SQUARE, k - k % SQUARE);
    for row in (0..whole_rows).step_by(SQUARE) {
        for kk in (0..whole_k).step_by(SQUARE) {
            let (from, to) = (&values[row * stride + kk..], &mut out[kk * width + row..]);
            match level() {
                Level::Portable => square(from, stride, to, width),
                // SAFETY: AVX is there at these levels; the assertions above say that eight rows of eight elements,
                // `stride` and `width` apart, follow in both.
                #[cfg(target_arch = "x86_64")]
                _ => unsafe { square_avx(from.as_ptr(), stride, to.as_mut_ptr(), width) },
                #[cfg(not(target_arch = "x86_64"))]
                _ => square(from, stride, to, width),
            }
        }
    }
    for row in 0..rows {
        let first = if row < whole_rows { whole_k } else { 0 };
        for kk in first..k {
            out[kk * width + row] = values[row * stride + kk];
        }
    }
}

/// Transposes eight by eight values.
fn square(from: &[f32], stride: usize, to: &mut [f32], width: usize) {
    for row in 0..SQUARE {
        for (kk, value) in from[row * stride..][..SQUARE].iter().enumerate() {
            to[kk * width + row] = *value;
        }
    }
}

/// Transposes eight by eight values in registers.
///
/// # Safety
///
/// - The processor has AVX.
/// - Eight rows of eight elements can be read at `from`, `stride` apart, and written at `to`, `width` apart.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx")]
unsafe fn square_avx(from: *const f32, stride: usize, to: *mut f32, width: usize) {
    use std::arch::x86_64::*;
    // SAFETY: reads and writes the elements of the promise above.
    unsafe {
        let row = |index: usize| _mm256_loadu_ps(from.add(index * stride));
        let rows: [__m256; 8] = std::array::from_fn(row);
        let mut pairs = [_mm256_setzero_ps(); 8];
        for index in 0..4 {
            pairs[2 * index] = _mm256_unpacklo_ps(rows[2 * index], rows[2 * index + 1]);
            pairs[2 * index + 1] = _mm256_unpackhi_ps(rows[2 * index], rows[2 * index + 1]);
        }
        let mut fours = [_mm256_setzero_ps(); 8];
        for half in 0..2 {
            let pair = |index: usize| pairs[4 * half + index];
            fours[4 * half] = _mm256_shuffle_ps::<0x44>(pair(0), pair(2));
            fours[4 * half + 1] = _mm256_shuffle_ps::<0xee>(pair(0), pair(2));
            fours[4 * half + 2] = _mm256_shuffle_ps::<0x44>(pair(1), pair(3));
            fours[4 * half + 3] = _mm256_shuffle_ps::<0xee>(pair(1), pair(3));
        }
        for index in 0..4 {
            let low = _mm256_permute2f128_ps::<0x20>(fours[index], fours[4 + index]);
            let high = _mm256_permute2f128_ps::<0x31>(fours[index], fours[4 + index]);
            _mm256_storeu_ps(to.add(index * width), low);
            _mm256_storeu_ps(to.add((index + 4) * width), high);
        }
    }
}
