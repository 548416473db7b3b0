//! Statistics of a camera's pixels on a sample of its frames.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::episode::FeatureStats;

/// Counts of pixel values per channel; merging is exact and order does not matter.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraStats {
    /// Frames that were counted.
    pub frames: u64,
    /// Per channel how often each pixel value occurs.
    pub channels: Vec<BTreeMap<u16, u64>>,
}

/// Returns whether the statistics look at the frame with this position in its episode: a fixed rule, so that pieces,
/// resumed and appended runs sample the same frames.
pub fn is_sampled(frame: u64) -> bool {
    frame.is_multiple_of(64) || matches!(frame, 8 | 16 | 32)
}

impl CameraStats {
    /// Takes what other frames gave.
    pub fn merge(&mut self, other: &CameraStats) {
        self.frames += other.frames;
        if self.channels.len() < other.channels.len() {
            self.channels.resize(other.channels.len(), BTreeMap::new());
        }
        for (own, other) in self.channels.iter_mut().zip(&other.channels) {
            for (&value, &count) in other {
                *own.entry(value).or_default() += count;
            }
        }
    }

    /// Returns LeRobot's statistics: three channels, values times `unit`; zeros when no frame was counted.
    pub(crate) fn feature_stats(&self, unit: f64) -> FeatureStats {
        let empty = BTreeMap::new();
        let mut stats = FeatureStats { count: self.frames, ..FeatureStats::default() };
        for channel in 0..3 {
            // LeRobot wants three channels of any camera; a grey one has three equal ones.
            let counts = self.channels.get(channel).or(self.channels.first()).unwrap_or(&empty);
            let pixels = PixelStats::of(counts);
            stats.min.push(pixels.quantile(0.0) * unit);
            stats.max.push(pixels.quantile(1.0) * unit);
            stats.mean.push(pixels.mean * unit);
            stats.std.push(pixels.std * unit);
            stats.q01.push(pixels.quantile(0.01) * unit);
            stats.q10.push(pixels.quantile(0.1) * unit);
            stats.q50.push(pixels.quantile(0.5) * unit);
            stats.q90.push(pixels.quantile(0.9) * unit);
            stats.q99.push(pixels.quantile(0.99) * unit);
        }
        stats
    }
}

struct PixelStats<'a> {
    counts: &'a BTreeMap<u16, u64>,
    total: u64,
    mean: f64,
    std: f64,
}

impl PixelStats<'_> {
    fn of(counts: &BTreeMap<u16, u64>) -> PixelStats<'_> {
        let total: u64 = counts.values().sum();
        let weighted = |power: u32| {
            let sum: u128 = counts.iter().map(|(&v, &n)| u128::from(v).pow(power) * u128::from(n)).sum();
            sum
        };
        let (sum, squares, n) = (weighted(1), weighted(2), u128::from(total));
        let mean = if total == 0 { 0.0 } else { sum as f64 / total as f64 };
        // Integers until the end: n * sum of squares - (sum)^2 loses nothing.
        let spread = (n * squares).saturating_sub(sum * sum);
        let std = if total == 0 { 0.0 } else { (spread as f64).sqrt() / total as f64 };
        PixelStats { counts, total, mean, std }
    }

    /// Returns the value at rank (n - 1) * fraction, rounded down.
    fn quantile(&self, fraction: f64) -> f64 {
        let rank = (self.total.saturating_sub(1) as f64 * fraction).floor() as u64;
        let mut end = 0;
        let found = self.counts.iter().find(|(_, count)| {
            end += **count;
            rank < end
        });
        found.map_or(0.0, |(value, _)| f64::from(*value))
    }
}

/// Returns what a pixel value is multiplied by: colours are given in 0..=1, depth as it is.
pub(crate) fn pixel_unit(spec: &gawm_schema::ImageSpec) -> f64 {
    if spec.depth { 1.0 } else { 1.0 / 255.0 }
}
