//! The exponential of the published renderer, to the bit.
//!
//! The published TwoRoom draws its dot with a single-precision vector exponential that is not correctly rounded: one
//! result in a hundred differs in the last bit, and the truncation to 8 bits makes such a bit visible as a level of 254
//! instead of 255. Its results are those of the table-driven algorithm of P. T. P. Tang (ACM Transactions on
//! Mathematical Software 15, 1989) with 128 table entries and a polynomial of degree two, in plain single-precision
//! multiplications and additions. No fused operation may appear here.
//!
//! Measured against the published package: no difference in 8 million arguments in [-17.5, 0], the range that a dot
//! can show.

use std::sync::LazyLock;

/// Entries of the table: 2^(j/128).
const ENTRIES: usize = 128;
/// 128 / ln 2.
const PER_LN2: f32 = (ENTRIES as f64 / std::f64::consts::LN_2) as f32;
/// ln 2 / 128 rounded to 11 bits, so that its product with the index (12 bits down to -17.5) is exact.
const LN2_HIGH: f32 = 1420.0 / 262_144.0;
/// What `LN2_HIGH` leaves of ln 2 / 128.
const LN2_LOW: f32 = (std::f64::consts::LN_2 / ENTRIES as f64 - LN2_HIGH as f64) as f32;
/// Adding and subtracting this rounds a small number to the nearest integer, ties to even; the low bits hold it.
const ROUNDER: f32 = 12_582_912.0;

/// Most numbers that [`ExpTable::exp_row`] takes: the side of a frame.
const ROW: usize = 224;

/// Smallest argument that [`ExpTable::exp`] takes: below it results are not normal numbers.
pub(crate) const LOWEST_ARGUMENT: f32 = -87.0;

/// 2^(j/128) as the nearest single-precision number and what that leaves.
pub(crate) struct ExpTable([(f32, f32); ENTRIES]);

static TABLE: LazyLock<ExpTable> = LazyLock::new(|| {
    ExpTable(std::array::from_fn(|j| {
        let exact = (j as f64 / ENTRIES as f64).exp2();
        let high = exact as f32;
        (high, (exact - f64::from(high)) as f32)
    }))
});

impl ExpTable {
    /// Returns the table.
    pub(crate) fn get() -> &'static ExpTable {
        &TABLE
    }

    /// Returns e^x for `LOWEST_ARGUMENT <= x <= 0`, with the last bit of the published renderer.
    pub(crate) fn exp(&self, x: f32) -> f32 {
        let (index, p) = reduce(x);
        self.rebuild(index, p)
    }

    /// Replaces up to `ROW` arguments by their exponentials. In two passes, since the first has no table and can be
    /// done several numbers at a time.
    pub(crate) fn exp_row(&self, row: &mut [f32]) {
        let mut indices = [0_i32; ROW];
        let mut polynomials = [0.0_f32; ROW];
        for ((index, p), &x) in indices.iter_mut().zip(&mut polynomials).zip(&*row) {
            (*index, *p) = reduce(x);
        }
        for ((index, p), x) in indices.into_iter().zip(polynomials).zip(row) {
            *x = self.rebuild(index, p);
        }
    }

    #[inline]
    fn rebuild(&self, index: i32, p: f32) -> f32 {
        let (high, low) = self.0[(index & (ENTRIES as i32 - 1)) as usize];
        let y = high + (low + high * p);
        f32::from_bits(y.to_bits().wrapping_add_signed((index >> 7) << 23))
    }
}

/// Splits x = (128 m + j) ln2 / 128 + r into the index 128 m + j and r + r^2 / 2: e^x is 2^m 2^(j/128) (1 + r + r^2 / 2).
#[inline]
fn reduce(x: f32) -> (i32, f32) {
    let rounded = x * PER_LN2 + ROUNDER;
    let index = rounded.to_bits().wrapping_sub(ROUNDER.to_bits()) as i32;
    let n = rounded - ROUNDER;
    let r = (x - n * LN2_HIGH) - n * LN2_LOW;
    (index, r + 0.5 * r * r)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constants_are_those_that_were_measured() {
        assert_eq!(PER_LN2.to_bits(), 1_127_787_067);
        assert_eq!(LN2_LOW.to_bits(), 3_051_257_987);
    }

    #[test]
    fn error_is_that_of_the_published_renderer() {
        // The published renderer was measured at most 0.5583 units in the last place away from e^x.
        let mut largest = 0.0_f64;
        let mut x = -17.5_f32;
        while x <= 0.0 {
            let got = ExpTable::get().exp(x);
            let exact = f64::from(x).exp();
            let ulp = f64::from(f32::from_bits(got.to_bits() + 1) - got);
            largest = largest.max((f64::from(got) - exact).abs() / ulp);
            x += 1.3e-5;
        }
        assert!((0.55..0.57).contains(&largest), "largest error {largest} ulp");
    }

    #[test]
    fn ends_of_the_range() {
        assert_eq!(ExpTable::get().exp(0.0), 1.0);
        let lowest = ExpTable::get().exp(LOWEST_ARGUMENT);
        assert!(lowest.is_normal());
        assert!((f64::from(lowest) / f64::from(LOWEST_ARGUMENT).exp() - 1.0).abs() < 1e-6);
    }
}
