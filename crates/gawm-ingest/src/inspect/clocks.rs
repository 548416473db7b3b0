//! Offsets between two clocks of one channel, and their drift.

use serde::Serialize;

/// Samples that are kept at most.
const MAX_SAMPLES: usize = 4096;
/// A drift needs at least this many samples.
const MIN_SAMPLES: usize = 16;
/// Stretches of time of which the smallest offset is taken.
const N_STRETCHES: usize = 32;
/// Scale from the median absolute deviation to a standard deviation.
const MAD_SCALE: f64 = 1.4826;

/// How far one clock is ahead of another, and how it moves.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ClockOffset {
    /// Median of the offset in milliseconds.
    pub median_ms: f64,
    /// 5th percentile in milliseconds.
    pub p05_ms: f64,
    /// 95th percentile in milliseconds.
    pub p95_ms: f64,
    /// Drift in parts per million: positive when the earlier clock loses against the later one. `None` when it cannot be told.
    pub drift_ppm: Option<f64>,
    /// Standard error of the drift in parts per million.
    pub drift_error_ppm: Option<f64>,
}

/// Every n-th pair of times, n growing so that the number kept is bounded.
#[derive(Debug, Clone)]
pub(super) struct Samples {
    /// Time by the earlier clock, and how much later the later clock reads.
    pairs: Vec<(i64, i64)>,
    every: u64,
    n_seen: u64,
}

impl Default for Samples {
    fn default() -> Self {
        Self { pairs: Vec::new(), every: 1, n_seen: 0 }
    }
}

impl Samples {
    pub(super) fn add(&mut self, earlier_ns: i64, later_ns: i64) {
        if self.n_seen.is_multiple_of(self.every) {
            if self.pairs.len() == MAX_SAMPLES {
                let mut n = 0;
                self.pairs.retain(|_| {
                    n += 1;
                    n % 2 == 1
                });
                self.every *= 2;
            }
            if self.n_seen.is_multiple_of(self.every) {
                self.pairs.push((earlier_ns, later_ns.saturating_sub(earlier_ns)));
            }
        }
        self.n_seen += 1;
    }

    /// Returns the offset of the later clock over the earlier one.
    pub(super) fn offset(&self) -> Option<ClockOffset> {
        let (first, base) = *self.pairs.first()?;
        let mut offsets: Vec<i64> = self.pairs.iter().map(|(_, offset)| *offset).collect();
        offsets.sort_unstable();
        let at = |q: f64| offsets[((offsets.len() - 1) as f64 * q).round() as usize] as f64 / 1e6;
        // Seconds from the first sample and nanoseconds from its offset: exact in f64 for centuries.
        let relative = |&(time, offset): &(i64, i64)| {
            (time.wrapping_sub(first) as f64 / 1e9, offset.wrapping_sub(base) as f64)
        };
        let points: Vec<(f64, f64)> = self.pairs.iter().map(relative).collect();
        let line = if points.len() < MIN_SAMPLES { None } else { best_line(&points) };
        Some(ClockOffset {
            median_ms: at(0.5),
            p05_ms: at(0.05),
            p95_ms: at(0.95),
            drift_ppm: line.map(|line| line.slope / 1e3),
            drift_error_ppm: line.map(|line| line.error / 1e3),
        })
    }
}

/// A fitted line: nanoseconds per second.
#[derive(Debug, Clone, Copy)]
struct Line {
    slope: f64,
    error: f64,
}

/// Fits all points and their lower envelope, and returns the line with the smaller error.
///
/// Delays are never negative and mostly small, so the envelope is much the sharper one for a busy channel.
fn best_line(points: &[(f64, f64)]) -> Option<Line> {
    let all = robust_line(points);
    let envelope = robust_line(&lower_envelope(points));
    match (all, envelope) {
        (Some(all), Some(envelope)) if envelope.error < all.error => Some(envelope),
        (Some(all), _) => Some(all),
        (None, envelope) => envelope,
    }
}

/// The point with the smallest offset in each stretch of time.
fn lower_envelope(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    let smallest = |stretch: &[(f64, f64)]| stretch.iter().copied().min_by(|a, b| a.1.total_cmp(&b.1));
    points.chunks(points.len().div_ceil(N_STRETCHES).max(1)).filter_map(smallest).collect()
}

/// Fits a line by least squares without the points that a first, robust line calls outliers.
fn robust_line(points: &[(f64, f64)]) -> Option<Line> {
    let half = points.len() / 2;
    let slope_of = |(a, b): (&(f64, f64), &(f64, f64))| (b.0 > a.0).then(|| (b.1 - a.1) / (b.0 - a.0));
    let slope = median(points.iter().zip(&points[half..]).filter_map(slope_of).collect())?;
    let level = median(points.iter().map(|(t, y)| y - slope * t).collect())?;
    let residual = |&(t, y): &(f64, f64)| y - slope * t - level;
    let spread = MAD_SCALE * median(points.iter().map(|point| residual(point).abs()).collect())?;
    let inliers: Vec<(f64, f64)> =
        points.iter().filter(|point| residual(point).abs() <= 3.0 * spread).copied().collect();
    least_squares(&inliers)
}

fn median(mut values: Vec<f64>) -> Option<f64> {
    let middle = values.len() / 2;
    if values.is_empty() {
        return None;
    }
    Some(*values.select_nth_unstable_by(middle, f64::total_cmp).1)
}

fn least_squares(points: &[(f64, f64)]) -> Option<Line> {
    let n = points.len() as f64;
    let mean_t = points.iter().map(|(t, _)| t).sum::<f64>() / n;
    let mean_y = points.iter().map(|(_, y)| y).sum::<f64>() / n;
    let sum_tt: f64 = points.iter().map(|(t, _)| (t - mean_t).powi(2)).sum();
    if points.len() < 3 || sum_tt <= 0.0 {
        return None;
    }
    let slope = points.iter().map(|(t, y)| (t - mean_t) * (y - mean_y)).sum::<f64>() / sum_tt;
    let sum_rr: f64 = points.iter().map(|(t, y)| (y - mean_y - slope * (t - mean_t)).powi(2)).sum();
    let error = (sum_rr / (n - 2.0).max(1.0) / sum_tt).sqrt();
    slope.is_finite().then_some(Line { slope, error })
}

#[cfg(test)]
mod tests {
    use super::Samples;

    /// Delays that no generator is needed for: uniform in 0..range, from a multiplicative sequence.
    fn delay(i: i64, range: i64) -> i64 {
        (i.wrapping_mul(2_654_435_761)).rem_euclid(range)
    }

    fn drift_of(n: i64, period_ns: i64, drift_ppm: i64, range: i64) -> f64 {
        let mut samples = Samples::default();
        for i in 0..n {
            let stamp = 1_760_000_000_000_000_000 + i * period_ns;
            let outlier = if i % 97 == 5 { 80_000_000 } else { 0 };
            samples.add(
                stamp,
                stamp + 2_000_000 + i * period_ns / 1_000_000 * drift_ppm + delay(i, range) + outlier,
            );
        }
        samples.offset().unwrap().drift_ppm.unwrap()
    }

    #[test]
    fn drift_is_found_under_delays_and_outliers() {
        let drift = drift_of(6000, 2_000_000, 50, 1_000_000);
        assert!((drift - 50.0).abs() < 1.0, "got {drift}");
        let drift = drift_of(20_000, 2_000_000, -50, 1_000_000);
        assert!((drift + 50.0).abs() < 1.0, "got {drift}");
    }

    #[test]
    fn few_samples_have_an_offset_but_no_drift() {
        let mut samples = Samples::default();
        assert!(samples.offset().is_none());
        samples.add(1_000_000, 4_000_000);
        let offset = samples.offset().unwrap();
        assert_eq!((offset.median_ms, offset.drift_ppm), (3.0, None));
    }
}
