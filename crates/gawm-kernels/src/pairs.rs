//! Operands of products in bf16: two values that lie side by side in a sum, rounded and packed into 32 bits.
//!
//! `vdpbf16ps` multiplies such pairs and adds both products to a sum in f32, 32 terms per instruction where a fused
//! multiply-add has 16. A product of `k` terms becomes one of `k / 2` pairs over the same tiles and panels as in f32; a
//! pair takes the place of an f32, so that [`Packed`](crate::gemm::Packed) and strides serve both.

use crate::simd::{Level, level, vectorized};

/// Whether this processor multiplies pairs, at the level in use.
pub fn available() -> bool {
    #[cfg(target_arch = "x86_64")]
    return level() == Level::Avx512 && is_x86_feature_detected!("avx512bf16");
    #[cfg(not(target_arch = "x86_64"))]
    return false;
}

/// Rounds to bf16, to the nearest and to even between two; what is not a number stays so.
#[inline(always)]
fn rounded(x: f32) -> u32 {
    let bits = x.to_bits();
    let nearest = bits.wrapping_add(0x7fff + ((bits >> 16) & 1)) >> 16;
    if x.is_nan() { (bits >> 16) | 0x40 } else { nearest }
}

/// Packs two values, the first into the low half.
#[inline(always)]
fn pair(first: f32, second: f32) -> f32 {
    f32::from_bits(rounded(first) | (rounded(second) << 16))
}

vectorized! {
    /// Pairs neighbours in a row: `x` [rows, k] in rows of `stride` values to [rows, k / 2 rounded up]. An odd last value
    /// is paired with zero.
    ///
    /// # Panics
    ///
    /// If `x` or `out` is too short.
    pub fn pair_columns(x: &[f32], stride: usize, sizes: [usize; 2], out: &mut [f32]) {
        let [rows, k] = sizes;
        let width = k.div_ceil(2);
        for (row, out) in out[..rows * width].chunks_exact_mut(width.max(1)).enumerate() {
            let (pairs, rest) = x[row * stride..][..k].as_chunks::<2>();
            for (out, [first, second]) in out.iter_mut().zip(pairs) {
                *out = pair(*first, *second);
            }
            if let ([first], Some(out)) = (rest, out.last_mut()) {
                *out = pair(*first, 0.0);
            }
        }
    }

    /// Pairs each row with the next: `x` [k, width] in rows of `stride` values to [k / 2 rounded up, width]. An odd last row
    /// is paired with zeros.
    ///
    /// # Panics
    ///
    /// If `x` or `out` is too short.
    pub fn pair_rows(x: &[f32], stride: usize, sizes: [usize; 2], out: &mut [f32]) {
        let [k, width] = sizes;
        for (index, out) in out[..k.div_ceil(2) * width].chunks_exact_mut(width.max(1)).enumerate() {
            let first = &x[2 * index * stride..][..width];
            if 2 * index + 1 == k {
                for (out, first) in out.iter_mut().zip(first) {
                    *out = pair(*first, 0.0);
                }
                continue;
            }
            let second = &x[(2 * index + 1) * stride..][..width];
            for ((out, first), second) in out.iter_mut().zip(first).zip(second) {
                *out = pair(*first, *second);
            }
        }
    }
}
