//! Statistics of one dimension that can be merged in episode order.
//!
//! Counts, minimum, maximum and histogram are exact and do not depend on the order; moments are merged after Chan,
//! Golub and LeVeque (1979) in f64; quantiles come from a KLL sketch (Karnin, Lang and Liberty 2016), exact up to
//! [`QuantileSketch::EXACT`] values. The same sequence of updates and merges gives the same bits.

mod histogram;
mod moments;
mod quantiles;

use serde::{Deserialize, Serialize};

pub use histogram::Histogram;
pub use moments::Moments;
pub use quantiles::QuantileSketch;

/// Everything that is known of one dimension.
#[derive(Debug, Clone, PartialEq)]
pub struct DimStats {
    /// Number of values that are NaN or infinite; they are in nothing else.
    pub n_missing: u64,
    /// Count, mean, variance, minimum and maximum of the finite values.
    pub moments: Moments,
    /// Quantiles of the finite values.
    pub sketch: QuantileSketch,
    /// Histogram of the finite values.
    pub histogram: Histogram,
    /// Direction statistics; only of angles.
    pub circular: Option<Circular>,
}

/// Sums of sines and cosines of an angle.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Circular {
    /// Number of angles.
    pub count: u64,
    /// Sum of their sines.
    pub sin_sum: f64,
    /// Sum of their cosines.
    pub cos_sum: f64,
}

/// The numbers of a [`DimStats`] that reports and files show. All finite; zeros when `count` is 0.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DimSummary {
    /// Number of finite values.
    pub count: u64,
    /// Number of NaN or infinite values.
    pub n_missing: u64,
    /// Smallest value.
    pub min: f64,
    /// Largest value.
    pub max: f64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation, ddof 0.
    pub std: f64,
    /// Quantile 0.01.
    pub q01: f64,
    /// Quantile 0.10.
    pub q10: f64,
    /// Median.
    pub q50: f64,
    /// Quantile 0.90.
    pub q90: f64,
    /// Quantile 0.99.
    pub q99: f64,
}

impl DimStats {
    /// Returns empty statistics, with direction statistics when the dimension is an angle.
    pub fn new(is_angle: bool) -> DimStats {
        DimStats {
            n_missing: 0,
            moments: Moments::default(),
            sketch: QuantileSketch::default(),
            histogram: Histogram::default(),
            circular: is_angle.then(Circular::default),
        }
    }

    /// Takes one value.
    pub fn update(&mut self, value: f64) {
        if !value.is_finite() {
            self.n_missing += 1;
            return;
        }
        self.moments.update(value);
        self.sketch.update(value);
        self.histogram.update(value);
        if let Some(circular) = &mut self.circular {
            circular.update(value);
        }
    }

    /// Takes what later values gave.
    pub fn merge(&mut self, later: &DimStats) {
        self.n_missing += later.n_missing;
        self.moments.merge(&later.moments);
        self.sketch.merge(&later.sketch);
        self.histogram.merge(&later.histogram);
        match (&mut self.circular, &later.circular) {
            (Some(circular), Some(later)) => circular.merge(later),
            (own @ None, Some(later)) => *own = Some(*later),
            (_, None) => {}
        }
    }

    /// Returns the numbers to show.
    pub fn summary(&self) -> DimSummary {
        let moments = &self.moments;
        let [q01, q10, q50, q90, q99] =
            self.sketch.quantiles([0.01, 0.1, 0.5, 0.9, 0.99]).map(|q| q.unwrap_or(0.0));
        DimSummary {
            count: moments.count(),
            n_missing: self.n_missing,
            min: moments.min().unwrap_or(0.0),
            max: moments.max().unwrap_or(0.0),
            mean: finite(moments.mean()),
            std: finite(moments.std()),
            q01: finite(q01),
            q10: finite(q10),
            q50: finite(q50),
            q90: finite(q90),
            q99: finite(q99),
        }
    }
}

/// Keeps what overflowed, since JSON knows neither infinity nor NaN: values near the end of f64 have no spread in f64.
fn finite(value: f64) -> f64 {
    if value.is_nan() { f64::MAX } else { value.clamp(f64::MIN, f64::MAX) }
}

impl Circular {
    /// Takes one angle in rad.
    pub fn update(&mut self, angle: f64) {
        let (sin, cos) = angle.sin_cos();
        self.count += 1;
        self.sin_sum += sin;
        self.cos_sum += cos;
    }

    /// Takes what later angles gave.
    pub fn merge(&mut self, later: &Circular) {
        self.count += later.count;
        self.sin_sum += later.sin_sum;
        self.cos_sum += later.cos_sum;
    }

    /// Returns the mean direction in (-pi, pi], or `None` when the directions cancel or there is none.
    pub fn mean_direction(&self) -> Option<f64> {
        (self.resultant_length() > 1e-9).then(|| self.sin_sum.atan2(self.cos_sum))
    }

    /// Returns the length of the mean direction vector: 1 all angles equal, 0 no direction preferred.
    pub fn resultant_length(&self) -> f64 {
        if self.count == 0 { 0.0 } else { self.sin_sum.hypot(self.cos_sum) / self.count as f64 }
    }
}

#[cfg(test)]
mod tests;
