//! A histogram whose bins adapt by doubling, so that merging is exact.

use serde::{Deserialize, Serialize};

/// Counts in at most 128 bins of equal width 2^`exponent`; bin i covers [(first + i) * width, (first + i + 1) * width).
///
/// The width is the smallest power of two that fits all values into 128 bins (and resolves 2^-40 of the largest
/// magnitude), hence independent of the order of values and merges.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Histogram {
    exponent: i32,
    first: i64,
    counts: Vec<u64>,
}

impl Histogram {
    /// Most bins that a histogram has.
    pub const MAX_BINS: usize = 128;
    /// Bins are never narrower than 2^-40 of the magnitude of a value, so that bin numbers stay exact.
    const PRECISION: i32 = 40;
    /// Bins are never narrower than this power of two.
    const MIN_EXPONENT: i32 = -1000;

    /// Takes one finite value.
    pub fn update(&mut self, value: f64) {
        let finest = finest_exponent(value);
        if self.counts.is_empty() {
            self.exponent = finest;
            self.first = bin_of(value, finest);
            self.counts.push(1);
            return;
        }
        if finest > self.exponent {
            self.widen(finest);
        } else if let Some(count) = self.count_mut(bin_of(value, self.exponent)) {
            *count += 1;
            return;
        }
        let mut bin = bin_of(value, self.exponent);
        while self.span_with(bin, bin) > Self::MAX_BINS as i128 {
            self.widen(self.exponent + 1);
            bin = bin_of(value, self.exponent);
        }
        self.add(bin, 1);
    }

    /// Takes what later values gave.
    pub fn merge(&mut self, later: &Histogram) {
        if later.counts.is_empty() {
            return;
        }
        if self.counts.is_empty() {
            self.clone_from(later);
            return;
        }
        let mut later = later.clone();
        let exponent = self.exponent.max(later.exponent);
        self.widen(exponent);
        later.widen(exponent);
        while self.span_with(later.first, later.last()) > Self::MAX_BINS as i128 {
            self.widen(self.exponent + 1);
            later.widen(self.exponent);
        }
        for (i, &count) in later.counts.iter().enumerate() {
            if count > 0 {
                self.add(later.first + i as i64, count);
            }
        }
    }

    /// Returns the width of a bin.
    pub fn bin_width(&self) -> f64 {
        2f64.powi(self.exponent)
    }

    /// Returns the lower edge of the first bin.
    pub fn start(&self) -> f64 {
        self.first as f64 * self.bin_width()
    }

    /// Returns the counts; the first and the last bin are not empty.
    pub fn counts(&self) -> &[u64] {
        &self.counts
    }

    /// Returns the count of a bin between the first and the last.
    fn count_mut(&mut self, bin: i64) -> Option<&mut u64> {
        usize::try_from(bin - self.first).ok().and_then(|position| self.counts.get_mut(position))
    }

    fn last(&self) -> i64 {
        self.first + self.counts.len() as i64 - 1
    }

    fn span_with(&self, low: i64, high: i64) -> i128 {
        i128::from(self.last().max(high)) - i128::from(self.first.min(low)) + 1
    }

    /// Adds to a bin that is at most `MAX_BINS` away.
    fn add(&mut self, bin: i64, count: u64) {
        if bin < self.first {
            let missing = (self.first - bin) as usize;
            self.counts.splice(0..0, std::iter::repeat_n(0, missing));
            self.first = bin;
        }
        let position = (bin - self.first) as usize;
        if position >= self.counts.len() {
            self.counts.resize(position + 1, 0);
        }
        self.counts[position] += count;
    }

    fn widen(&mut self, exponent: i32) {
        let shift = exponent - self.exponent;
        if shift <= 0 {
            return;
        }
        let first = shifted(self.first, shift);
        let mut counts = vec![0; (shifted(self.last(), shift) - first) as usize + 1];
        for (i, count) in self.counts.iter().enumerate() {
            counts[(shifted(self.first + i as i64, shift) - first) as usize] += count;
        }
        *self = Histogram { exponent, first, counts };
    }
}

/// Floor division by 2^shift.
fn shifted(bin: i64, shift: i32) -> i64 {
    bin >> shift.min(63)
}

fn finest_exponent(value: f64) -> i32 {
    if value == 0.0 {
        return Histogram::MIN_EXPONENT;
    }
    // The exponent of the number's leading bit; subnormal numbers share the lowest one.
    let exponent = ((value.to_bits() >> 52 & 0x7ff) as i32) - 1023;
    (exponent - Histogram::PRECISION).max(Histogram::MIN_EXPONENT)
}

fn bin_of(value: f64, exponent: i32) -> i64 {
    // 2^-exponent, built from its bits: exponents lie in -1000..=984, so that it is a normal number.
    let inverse_width = f64::from_bits(((1023 - i64::from(exponent)) as u64) << 52);
    let bin = (value * inverse_width).floor() as i64;
    // A negative value so small that the product vanishes still lies left of 0.
    if bin == 0 && value < 0.0 { -1 } else { bin }
}
