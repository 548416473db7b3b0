//! Count, mean, variance, minimum and maximum.

use serde::{Deserialize, Serialize};

/// First two moments and extremes of finite values, in f64.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct Moments {
    count: u64,
    /// The first value; all means are relative to it, so that a large offset costs no digits of the spread.
    origin: f64,
    /// Mean relative to `origin`.
    mean: f64,
    /// Sum of squared deviations from the mean.
    m2: f64,
    min: f64,
    max: f64,
}

impl Moments {
    /// Takes one finite value (Welford).
    pub fn update(&mut self, value: f64) {
        if self.count == 0 {
            *self = Moments { count: 1, origin: value, mean: 0.0, m2: 0.0, min: value, max: value };
            return;
        }
        self.count += 1;
        let offset = value - self.origin;
        let delta = offset - self.mean;
        self.mean += delta / self.count as f64;
        self.m2 += delta * (offset - self.mean);
        self.min = self.min.min(value);
        self.max = self.max.max(value);
    }

    /// Takes what later values gave (Chan).
    pub fn merge(&mut self, later: &Moments) {
        if later.count == 0 {
            return;
        }
        if self.count == 0 {
            *self = *later;
            return;
        }
        let (n, m) = (self.count as f64, later.count as f64);
        let delta = (later.origin - self.origin) + (later.mean - self.mean);
        self.count += later.count;
        self.mean += delta * (m / (n + m));
        self.m2 += later.m2 + delta * delta * (n * m / (n + m));
        self.min = self.min.min(later.min);
        self.max = self.max.max(later.max);
    }

    /// Returns the number of values.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Returns the mean; 0 without values.
    pub fn mean(&self) -> f64 {
        self.origin + self.mean
    }

    /// Returns the smallest value.
    pub fn min(&self) -> Option<f64> {
        (self.count > 0).then_some(self.min)
    }

    /// Returns the largest value.
    pub fn max(&self) -> Option<f64> {
        (self.count > 0).then_some(self.max)
    }

    /// Returns the variance with ddof 0; 0 without values.
    pub fn variance(&self) -> f64 {
        if self.count == 0 { 0.0 } else { (self.m2 / self.count as f64).max(0.0) }
    }

    /// Returns the standard deviation with ddof 0; exactly 0 when all values are equal.
    pub fn std(&self) -> f64 {
        if self.is_constant() { 0.0 } else { self.variance().sqrt() }
    }

    /// Returns the standard deviation with ddof 1; 0 below two values.
    pub fn sample_std(&self) -> f64 {
        if self.count < 2 || self.is_constant() {
            0.0
        } else {
            (self.m2 / (self.count - 1) as f64).max(0.0).sqrt()
        }
    }

    /// Returns whether all values are equal; true without values.
    pub fn is_constant(&self) -> bool {
        self.min == self.max
    }
}
