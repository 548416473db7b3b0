//! How a signal moves: speed, jerk, rest and memory.

use std::f64::consts::TAU;

use gawm_schema::Moments;
use serde::Serialize;

/// Lags at which the autocorrelation is measured, in rows.
const LAGS: [usize; 14] = [1, 2, 3, 4, 6, 8, 12, 16, 24, 32, 48, 64, 96, 128];
/// A step is idle below this share of the mean step.
const IDLE_SHARE: f64 = 0.02;

/// Mergeable measures of motion; angles are unwrapped first.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MotionStats {
    step: Moments,
    jerk: Moments,
    n_idle: u64,
    lagged: [f64; LAGS.len()],
    square: [f64; LAGS.len()],
}

/// The numbers of a [`MotionStats`] that are shown.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct MotionSummary {
    /// Mean absolute speed in units per second.
    pub mean_speed: f64,
    /// Largest absolute speed in units per second.
    pub max_speed: f64,
    /// Mean absolute jerk in units per second cubed.
    pub mean_jerk: f64,
    /// Share of steps below 2 % of the mean step of their episode.
    pub idle_share: f64,
    /// Time after which the autocorrelation falls below 1/e, in seconds; absent if it does not within 128 rows.
    pub autocorrelation_secs: Option<f64>,
}

impl MotionStats {
    /// Measures one episode.
    pub fn of(values: &[f64], is_angle: bool) -> MotionStats {
        let mut stats = MotionStats::default();
        let turn = |step: f64| if is_angle { step - TAU * (step / TAU).round() } else { step };
        let steps: Vec<f64> = values.windows(2).map(|w| turn(w[1] - w[0])).collect();
        let finite = || steps.iter().map(|s| s.abs()).filter(|s| s.is_finite());
        finite().for_each(|s| stats.step.update(s));
        let bound = IDLE_SHARE * stats.step.mean();
        stats.n_idle = finite().filter(|s| *s <= bound).count() as u64;
        steps
            .windows(3)
            .map(|w| (w[2] - 2.0 * w[1] + w[0]).abs())
            .filter(|j| j.is_finite())
            .for_each(|j| stats.jerk.update(j));
        let unwrapped = if is_angle { unwrap(values) } else { Vec::new() };
        let values = if is_angle { &unwrapped } else { values };
        let n_finite = values.iter().filter(|v| v.is_finite()).count();
        let mean = values.iter().filter(|v| v.is_finite()).sum::<f64>() / n_finite.max(1) as f64;
        for (k, lag) in LAGS.into_iter().enumerate().filter(|(_, lag)| *lag < values.len()) {
            for (a, b) in values.iter().zip(&values[lag..]) {
                let (a, b) = (a - mean, b - mean);
                if a.is_finite() && b.is_finite() {
                    stats.lagged[k] += a * b;
                    stats.square[k] += 0.5 * (a * a + b * b);
                }
            }
        }
        stats
    }

    /// Takes what a later episode gave.
    pub fn merge(&mut self, later: &MotionStats) {
        self.step.merge(&later.step);
        self.jerk.merge(&later.jerk);
        self.n_idle += later.n_idle;
        self.lagged.iter_mut().zip(&later.lagged).for_each(|(a, b)| *a += b);
        self.square.iter_mut().zip(&later.square).for_each(|(a, b)| *a += b);
    }

    /// Returns the numbers to show, for `fps` rows per second.
    pub fn summary(&self, fps: f64) -> MotionSummary {
        MotionSummary {
            mean_speed: self.step.mean() * fps,
            max_speed: self.step.max().unwrap_or(0.0) * fps,
            mean_jerk: self.jerk.mean() * fps.powi(3),
            idle_share: if self.step.count() == 0 {
                0.0
            } else {
                self.n_idle as f64 / self.step.count() as f64
            },
            autocorrelation_secs: self.autocorrelation_rows().map(|rows| rows / fps),
        }
    }

    fn autocorrelation_rows(&self) -> Option<f64> {
        let bound = (-1.0f64).exp();
        let (mut lag, mut rho) = (0.0, 1.0);
        for (k, next) in LAGS.into_iter().enumerate() {
            if self.square[k] <= 0.0 {
                return None;
            }
            let here = self.lagged[k] / self.square[k];
            if here < bound {
                return Some(lag + (next as f64 - lag) * (rho - bound) / (rho - here));
            }
            (lag, rho) = (next as f64, here);
        }
        None
    }
}

/// Returns an angle as it turned, without the steps of a turn at its wrap; what is not finite stays so.
fn unwrap(values: &[f64]) -> Vec<f64> {
    let mut last: Option<(f64, f64)> = None;
    let continued = values.iter().map(|&value| {
        if !value.is_finite() {
            return value;
        }
        let here = last.map_or(value, |(before, turned)| {
            let step = value - before;
            turned + step - TAU * (step / TAU).round()
        });
        last = Some((value, here));
        here
    });
    continued.collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_ramp_has_one_speed_and_no_jerk() {
        let values: Vec<f64> = (0..200).map(|t| 0.01 * f64::from(t)).collect();
        let summary = MotionStats::of(&values, false).summary(10.0);
        assert!((summary.mean_speed - 0.1).abs() < 1e-9 && (summary.max_speed - 0.1).abs() < 1e-9);
        assert!(summary.mean_jerk < 1e-9 && summary.idle_share == 0.0);
    }

    #[test]
    fn a_wave_forgets_itself_after_its_part_of_a_period() {
        let values: Vec<f64> = (0..2000).map(|t| (TAU * f64::from(t) / 40.0).sin()).collect();
        // cos(2 pi lag / 40) = 1/e at lag 7.6.
        let secs = MotionStats::of(&values, false).summary(10.0).autocorrelation_secs.unwrap();
        assert!((secs - 0.76).abs() < 0.03, "{secs}");
    }

    #[test]
    fn a_wrapped_angle_remembers_as_the_turning_does() {
        let turned: Vec<f64> = (0..400).map(|t| 9.0 * (f64::from(t) * 0.02).sin()).collect();
        let wrapped: Vec<f64> = turned.iter().map(|a| a - TAU * (a / TAU).round()).collect();
        let secs =
            |values: &[f64], is_angle| MotionStats::of(values, is_angle).summary(10.0).autocorrelation_secs;
        let (expected, got) = (secs(&turned, false).unwrap(), secs(&wrapped, true).unwrap());
        assert!((expected - got).abs() < 1e-9, "{expected} {got}");
    }

    #[test]
    fn missing_values_do_not_move_the_mean() {
        let mut values: Vec<f64> = (0..2000).map(|t| 5.0 + (TAU * f64::from(t) / 40.0).sin()).collect();
        values[100..400].fill(f64::NAN);
        let secs = MotionStats::of(&values, false).summary(10.0).autocorrelation_secs.unwrap();
        assert!((secs - 0.76).abs() < 0.03, "{secs}");
    }

    #[test]
    fn merging_episodes_keeps_counts() {
        let values: Vec<f64> = (0..100).map(|t| f64::from(t * t % 17)).collect();
        let mut merged = MotionStats::of(&values[..50], false);
        merged.merge(&MotionStats::of(&values[50..], false));
        assert_eq!(merged.step.count(), 98);
    }
}
