//! Statistics of a camera's pixels on a sample of its frames.

use std::collections::BTreeMap;

use bytes::Bytes;
use gawm_image::{Image, Limits, Pixels, decode};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::block::RowBlock;
use crate::columns::Columns;
use crate::episode::FeatureStats;

/// Counts of pixel values per channel; merging is exact and order does not matter.
#[derive(Debug, Clone, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraStats {
    /// Frames that were counted.
    pub frames: u64,
    /// Whether the pixels are floats, counted as whole thousandths (metres as millimetres).
    #[serde(default)]
    pub has_thousandths: bool,
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
        self.has_thousandths |= other.has_thousandths;
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
        let unit = if self.has_thousandths { 1e-3 } else { unit };
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

/// Counts the sampled frames of a block whose first row has position `first_frame` in its episode.
///
/// Frames that do not belong to their row or cannot be decoded are left out.
pub(crate) fn count_frames(
    columns: &Columns,
    block: &RowBlock,
    first_frame: u64,
    cameras: &mut BTreeMap<String, CameraStats>,
) {
    let n_vectors = columns.vectors.len();
    for (position, image) in columns.images.iter().enumerate() {
        let (frames, valid) = (&block.images[position], &block.valid[n_vectors + position]);
        let sampled: Vec<&Bytes> = (0..block.len())
            .filter(|&row| valid[row] && is_sampled(first_frame + row as u64))
            .map(|row| &frames[row])
            .collect();
        let counted: Vec<CameraStats> = sampled
            .par_iter()
            .filter_map(|frame| decode(frame, &Limits::default()).ok())
            .map(|image| count_pixels(&image))
            .collect();
        let stats = cameras.entry(image.name.clone()).or_default();
        counted.iter().for_each(|one| stats.merge(one));
    }
}

/// Counts every n-th pixel of every n-th row, so that at most about 256 x 256 pixels are looked at.
fn count_pixels(image: &Image) -> CameraStats {
    let (height, width, channels) =
        (image.height() as usize, image.width() as usize, image.pixels().channels());
    let step = (height.max(width) / 256).max(1);
    let has_thousandths = matches!(image.pixels(), Pixels::GrayF32(_));
    let mut dense = vec![vec![0u64; 1 << 16]; channels.min(3)];
    for y in (0..height).step_by(step) {
        for x in (0..width).step_by(step) {
            let start = (y * width + x) * channels;
            for (channel, counts) in dense.iter_mut().enumerate() {
                let value = match image.pixels() {
                    Pixels::Rgb8(values) | Pixels::Gray8(values) => u16::from(values[start + channel]),
                    Pixels::Gray16(values) => values[start + channel],
                    // Metres as millimetres; NaN and negative values are 0: no measurement.
                    Pixels::GrayF32(values) => (values[start + channel] * 1000.0).round() as u16,
                    _ => continue,
                };
                counts[usize::from(value)] += 1;
            }
        }
    }
    let sparse = |counts: Vec<u64>| {
        let filled = counts.into_iter().enumerate().filter(|(_, count)| *count > 0);
        filled.map(|(value, count)| (value as u16, count)).collect()
    };
    CameraStats { frames: 1, has_thousandths, channels: dense.into_iter().map(sparse).collect() }
}
