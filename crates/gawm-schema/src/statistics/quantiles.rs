//! A KLL quantile sketch with deterministic coin flips.

/// Quantiles of a stream in bounded memory (Karnin, Lang, Liberty: Optimal Quantile Approximation in Streams, 2016).
///
/// Exact up to [`QuantileSketch::EXACT`] values. Beyond that the rank error is below 0.13 % with 99 % confidence
/// (2.296 / k^0.9021 for k = 4096, the bound published with Apache DataSketches); at most about 100 kB per sketch.
/// The coin flips of the compactions come from a counter, so that the same updates and merges give the same sketch.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantileSketch {
    count: u64,
    /// `levels[h]` holds values of weight 2^h; level 0 in order of arrival.
    levels: Vec<Vec<f64>>,
    flips: u64,
    /// Capacity of level 0.
    room: usize,
}

impl Default for QuantileSketch {
    fn default() -> Self {
        QuantileSketch { count: 0, levels: vec![Vec::new()], flips: 0, room: Self::EXACT }
    }
}

impl QuantileSketch {
    /// Up to this many values quantiles are exact.
    pub const EXACT: usize = 4096;
    /// Levels below the top hold this share of what the level above holds, the paper's c.
    const SHRINK: f64 = 2.0 / 3.0;
    /// No level is smaller.
    const MIN_CAPACITY: usize = 8;

    /// Takes one value that is not NaN.
    pub fn update(&mut self, value: f64) {
        self.levels[0].push(value);
        self.count += 1;
        if self.levels[0].len() > self.room {
            self.compress();
        }
    }

    /// Takes what later values gave.
    pub fn merge(&mut self, later: &QuantileSketch) {
        if self.levels.len() < later.levels.len() {
            self.levels.resize(later.levels.len(), Vec::new());
        }
        for (own, other) in self.levels.iter_mut().zip(&later.levels) {
            own.extend_from_slice(other);
        }
        self.count += later.count;
        self.compress();
    }

    /// Returns the number of values.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the number of values that are kept.
    pub fn len(&self) -> usize {
        self.levels.iter().map(Vec::len).sum()
    }

    /// Returns whether there is no value.
    pub fn is_empty(&self) -> bool {
        self.count == 0
    }

    /// Returns whether quantiles are exact.
    pub fn is_exact(&self) -> bool {
        self.levels.len() == 1
    }

    /// Returns the values at the given fractions, `None` when there is no value.
    ///
    /// Fraction q is the value at rank (n - 1) q, interpolated linearly as `numpy.quantile` does by default.
    pub fn quantiles<const N: usize>(&self, fractions: [f64; N]) -> [Option<f64>; N] {
        if self.count == 0 {
            return [None; N];
        }
        let mut items: Vec<(f64, u64)> = self
            .levels
            .iter()
            .enumerate()
            .flat_map(|(height, values)| values.iter().map(move |&value| (value, 1u64 << height)))
            .collect();
        items.sort_unstable_by(|a, b| a.0.total_cmp(&b.0));
        let total: u64 = items.iter().map(|item| item.1).sum();
        fractions.map(|fraction| Some(interpolated(&items, total, fraction.clamp(0.0, 1.0))))
    }

    fn capacity(&self, height: usize) -> usize {
        let depth = self.levels.len() - 1 - height;
        let capacity = Self::EXACT as f64 * Self::SHRINK.powi(depth.min(64) as i32);
        (capacity.ceil() as usize).max(Self::MIN_CAPACITY)
    }

    /// Halves the lowest level that is too full until none is.
    fn compress(&mut self) {
        while let Some(height) = (0..self.levels.len()).find(|&h| self.levels[h].len() > self.capacity(h)) {
            if height + 1 == self.levels.len() {
                self.levels.push(Vec::new());
            }
            let mut values = std::mem::take(&mut self.levels[height]);
            sort(&mut values);
            // An odd one out stays, so that weights add up to the count.
            let kept = if values.len() % 2 == 1 { values.pop() } else { None };
            let offset = usize::from(self.flip());
            self.levels[height + 1].extend(values.iter().skip(offset).step_by(2));
            self.levels[height].extend(kept);
        }
        self.room = self.capacity(0);
    }

    /// Returns a fair coin: a bit of the SplitMix64 sequence.
    fn flip(&mut self) -> bool {
        self.flips = self.flips.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.flips;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ (z >> 31)) & 1 == 1
    }
}

/// Sorts as [`f64::total_cmp`] does, by integers, which compare faster.
fn sort(values: &mut [f64]) {
    // The order of the bits is that of the numbers once those of negative numbers are turned over, but for the sign;
    // the same operation turns them back.
    let turned = |bits: i64| bits ^ (((bits >> 63) as u64) >> 1) as i64;
    let mut keys: Vec<i64> = values.iter().map(|value| turned(value.to_bits() as i64)).collect();
    keys.sort_unstable();
    values.iter_mut().zip(keys).for_each(|(value, key)| *value = f64::from_bits(turned(key) as u64));
}

/// Returns the value at rank (total - 1) * fraction of sorted, weighted items.
fn interpolated(items: &[(f64, u64)], total: u64, fraction: f64) -> f64 {
    let rank = (total - 1) as f64 * fraction;
    let low = rank.floor();
    let at = |position: u64| {
        let mut end = 0;
        items.iter().find(|item| {
            end += item.1;
            position < end
        })
    };
    let first = at(low as u64).or(items.last()).map_or(0.0, |item| item.0);
    let second = at(low as u64 + 1).or(items.last()).map_or(0.0, |item| item.0);
    let t = rank - low;
    if t == 0.0 || first == second { first } else { first + (second - first) * t }
}

#[cfg(test)]
mod tests {
    #[test]
    fn sorts_as_total_cmp_does() {
        let mut values =
            vec![0.0, -0.0, 1.5, -1.5, f64::MAX, f64::MIN, 5e-324, -5e-324, 1e-300, -1e300, 7.0, 7.0];
        values.extend((0..200).map(|k| f64::from(k * 7919 % 211 - 100) * 0.37));
        let mut expected = values.clone();
        expected.sort_by(f64::total_cmp);
        super::sort(&mut values);
        let bits = |values: &[f64]| values.iter().map(|value| value.to_bits()).collect::<Vec<_>>();
        assert_eq!(bits(&values), bits(&expected));
    }
}
