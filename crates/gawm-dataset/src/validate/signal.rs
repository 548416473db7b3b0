//! One dim of one run, measured: range, steps, unsteadiness, rests, plateaus, wraps.

use std::f64::consts::TAU;

use super::{
    layout::DimKind,
    robust::{median5, quantile},
};

/// Most candidates for jumps kept per dim and run.
const MAX_JUMPS: usize = 12;
/// The roughest hundredth of an episode is at most this many times its roughest tenth, unless single rows make it.
const SPIKED: f64 = 10.0;
/// A jump is this many times longer than the steps beside it.
const ISOLATED: f64 = 2.5;
/// Rows of a window for noise.
pub(super) const NOISE_ROWS: usize = 24;

/// A stretch of rows.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub(super) struct Stretch {
    pub(super) start: usize,
    pub(super) n_rows: usize,
}

impl Stretch {
    pub(super) fn end(self) -> usize {
        self.start + self.n_rows
    }
}

/// One large unsteadiness.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Jump {
    /// The row after the step.
    pub(super) row: usize,
    /// How far the step is from the median of the steps around it.
    pub(super) size: f64,
}

/// What is measured of one dim in one run.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct Signal {
    pub(super) n_finite: usize,
    pub(super) n_bad: usize,
    pub(super) first_bad: Option<Stretch>,
    pub(super) min: f64,
    pub(super) max: f64,
    pub(super) mean: f64,
    pub(super) std: f64,
    pub(super) median: f64,
    /// 10th to 90th percentile.
    pub(super) spread: f64,
    /// Median size of the steps that are not zero.
    pub(super) step: f64,
    /// Mean size of all steps.
    pub(super) mean_step: f64,
    /// Share of steps that are exactly zero.
    pub(super) rest_share: f64,
    /// 99th percentile of the unsteadiness.
    pub(super) rough99: f64,
    /// Median unsteadiness.
    pub(super) rough50: f64,
    pub(super) jumps: Vec<Jump>,
    pub(super) n_jumps: usize,
    pub(super) longest_rest: Stretch,
    /// The value in the longest rest.
    pub(super) rest_level: f64,
    pub(super) second_rest: usize,
    pub(super) clipped: Option<Clipping>,
    pub(super) n_wraps: usize,
    pub(super) first_wrap: Option<usize>,
    pub(super) wrap_period: f64,
    pub(super) share_beyond_tau: f64,
    /// |net| over total travel.
    pub(super) one_way: f64,
    pub(super) zero_drops: Vec<usize>,
    pub(super) noisiest: Option<(Stretch, f64)>,
    /// 90th percentile of the noise of windows.
    pub(super) noise90: f64,
    pub(super) n_not_bool: usize,
}

/// Plateaus at an extremum, at least one of which the signal reaches and leaves at speed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Clipping {
    pub(super) level: f64,
    pub(super) n_rows: usize,
    pub(super) n_plateaus: usize,
    pub(super) first: Stretch,
}

impl Signal {
    pub(super) fn is_constant(&self) -> bool {
        self.n_finite > 0 && self.min == self.max
    }

    pub(super) fn range(&self) -> f64 {
        self.max - self.min
    }
}

/// Measures one dim.
pub(super) fn measure(values: &[f64], kind: DimKind) -> Signal {
    let mut signal = Signal::default();
    moments(values, &mut signal);
    if signal.n_finite < 4 || signal.is_constant() {
        signal.longest_rest = Stretch { start: 0, n_rows: values.len() };
        return signal;
    }
    let steps = unwrapped_steps(values, kind, &mut signal);
    step_measures(values, &steps, &mut signal);
    unsteadiness(&steps, &mut signal);
    rests(&steps, &mut signal);
    signal.rest_level = values[signal.longest_rest.start];
    signal.clipped = clipping(values, &steps, &signal);
    zero_drops(values, &mut signal);
    signal
}

fn moments(values: &[f64], signal: &mut Signal) {
    let (mut n, mut sum, mut min, mut max) = (0usize, 0.0, f64::INFINITY, f64::NEG_INFINITY);
    for v in values {
        if v.is_finite() {
            n += 1;
            sum += v;
            min = min.min(*v);
            max = max.max(*v);
        }
    }
    signal.n_finite = n;
    signal.n_bad = values.len() - n;
    if signal.n_bad > 0 {
        let start = values.iter().position(|v| !v.is_finite()).unwrap_or(0);
        let n_rows = values[start..].iter().take_while(|v| !v.is_finite()).count();
        signal.first_bad = Some(Stretch { start, n_rows });
    }
    if n == 0 {
        return;
    }
    let mean = sum / n as f64;
    let (mut squares, mut beyond, mut not_bool) = (0.0, 0usize, 0usize);
    for v in values.iter().filter(|v| v.is_finite()) {
        squares += (v - mean) * (v - mean);
        beyond += usize::from(v.abs() > TAU);
        not_bool += usize::from(*v != 0.0 && *v != 1.0);
    }
    (signal.min, signal.max, signal.mean, signal.std) = (min, max, mean, (squares / n as f64).sqrt());
    signal.share_beyond_tau = beyond as f64 / n as f64;
    signal.n_not_bool = not_bool;
    signal.median = quantile(values, 0.5);
    signal.spread = quantile(values, 0.9) - quantile(values, 0.1);
}

/// Returns the steps between rows, with those of about one turn taken as wraps.
fn unwrapped_steps(values: &[f64], kind: DimKind, signal: &mut Signal) -> Vec<f64> {
    let bound = signal.min.abs().max(signal.max.abs());
    // A wrap is possible only in an interval of one turn, [-pi, pi], [0, 2 pi] or the same in degrees.
    let interval = |turn: f64| {
        let slack = 0.02 * turn;
        let is_symmetric = bound <= turn / 2.0 + slack;
        let is_positive = signal.min >= -slack && signal.max <= turn + slack;
        is_symmetric || is_positive
    };
    let period = match kind {
        DimKind::Wrapped { period } => period,
        DimKind::Gripper | DimKind::Bool | DimKind::Rotation => 0.0,
        _ if signal.range() >= 0.9 * TAU && bound <= TAU * 1.02 && interval(TAU) => TAU,
        _ if signal.range() >= 0.9 * 360.0 && bound <= 360.0 * 1.02 && interval(360.0) => 360.0,
        DimKind::Angle => TAU,
        _ => 0.0,
    };
    signal.wrap_period = period;
    let mut steps = Vec::with_capacity(values.len() - 1);
    let is_wrap = |row: usize, step: f64| {
        // Without the turn, the step must continue the motion on one of its sides.
        let rest = step - period * step.signum();
        let beside = |other: Option<usize>| {
            let pair = other.and_then(|row| Some(values.get(row + 1)? - values.get(row)?));
            pair.is_some_and(|beside| (rest - beside).abs() < 0.02 * period)
        };
        beside(row.checked_sub(1)) || beside(Some(row + 1))
    };
    for (row, pair) in values.windows(2).enumerate() {
        let mut step = pair[1] - pair[0];
        if period > 0.0 && (step.abs() - period).abs() < 0.1 * period && is_wrap(row, step) {
            step -= period * step.signum();
            signal.n_wraps += 1;
            signal.first_wrap.get_or_insert(row + 1);
        }
        steps.push(step);
    }
    steps
}

fn step_measures(values: &[f64], steps: &[f64], signal: &mut Signal) {
    let (mut n_zero, mut n, mut total, mut net) = (0usize, 0usize, 0.0, 0.0);
    for step in steps.iter().filter(|s| s.is_finite()) {
        n += 1;
        n_zero += usize::from(*step == 0.0);
        total += step.abs();
        net += step;
    }
    signal.rest_share = if n == 0 { 1.0 } else { n_zero as f64 / n as f64 };
    signal.mean_step = total / n.max(1) as f64;
    signal.one_way = if total > 0.0 { (net / total).abs() } else { 0.0 };
    let stride = steps.len().div_ceil(4096).max(1);
    let sizes: Vec<f64> = steps.iter().step_by(stride).map(|s| s.abs()).filter(|s| *s > 0.0).collect();
    signal.step = if sizes.is_empty() { signal.range() / values.len() as f64 } else { quantile(&sizes, 0.5) };
}

fn unsteadiness(steps: &[f64], signal: &mut Signal) {
    let n = steps.len();
    let mut rough = vec![0.0; n];
    for t in 0..n {
        let around = if t >= 2 && t + 2 < n {
            median5([steps[t - 2], steps[t - 1], steps[t], steps[t + 1], steps[t + 2]])
        } else if t < 2 && n >= 5 {
            median5([steps[0], steps[1], steps[2], steps[3], steps[4]])
        } else if n >= 5 {
            median5([steps[n - 5], steps[n - 4], steps[n - 3], steps[n - 2], steps[n - 1]])
        } else {
            0.0
        };
        let size = (steps[t] - around).abs();
        rough[t] = if size.is_finite() { size } else { 0.0 };
    }
    signal.rough99 = quantile(&rough, 0.99);
    signal.rough50 = quantile(&rough, 0.5);
    // Some spikes of a short episode are more than its roughest hundredth, and must not set their own bound.
    let own = signal.rough99.min(SPIKED * quantile(&rough, 0.9));
    let floor = (4.0 * own).max(0.01 * signal.range());
    for (t, size) in rough.iter().enumerate().filter(|(_, size)| **size > floor) {
        if !is_isolated(steps, t) {
            continue;
        }
        signal.n_jumps += 1;
        signal.jumps.push(Jump { row: t + 1, size: *size });
        if signal.jumps.len() > 4 * MAX_JUMPS {
            keep_largest(&mut signal.jumps);
        }
    }
    keep_largest(&mut signal.jumps);
    let noise: Vec<f64> =
        rough.chunks_exact(NOISE_ROWS).map(|w| w.iter().sum::<f64>() / NOISE_ROWS as f64).collect();
    signal.noise90 = quantile(&noise, 0.9);
    // A single jump is no noise: the median of the window must be high as well.
    let windows = rough.chunks_exact(NOISE_ROWS).map(|w| quantile(w, 0.5)).enumerate();
    signal.noisiest = windows
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(i, level)| (Stretch { start: i * NOISE_ROWS, n_rows: NOISE_ROWS }, level));
}

/// Returns whether step `t` stands alone: a fast motion has fast steps beside it, a jump has not.
fn is_isolated(steps: &[f64], t: usize) -> bool {
    let here = steps[t];
    let beside = |other: Option<usize>| {
        let step = other.and_then(|o| steps.get(o)).copied().unwrap_or(0.0);
        // The way back from a spike belongs to it.
        let is_return = step * here < 0.0 && step.abs() > 0.5 * here.abs();
        if is_return || !step.is_finite() { 0.0 } else { step.abs() }
    };
    here.abs() > ISOLATED * beside(t.checked_sub(1)).max(beside(Some(t + 1)))
}

fn keep_largest(jumps: &mut Vec<Jump>) {
    jumps.sort_by(|a, b| b.size.total_cmp(&a.size).then(a.row.cmp(&b.row)));
    jumps.truncate(MAX_JUMPS);
}

fn rests(steps: &[f64], signal: &mut Signal) {
    let mut current = Stretch { start: 0, n_rows: 1 };
    let end = |rest: Stretch, signal: &mut Signal| {
        if rest.n_rows > signal.longest_rest.n_rows {
            signal.second_rest = signal.longest_rest.n_rows;
            signal.longest_rest = rest;
        } else if rest.n_rows > signal.second_rest {
            signal.second_rest = rest.n_rows;
        }
    };
    for (t, step) in steps.iter().enumerate() {
        if *step == 0.0 {
            current.n_rows += 1;
        } else {
            end(current, signal);
            current = Stretch { start: t + 1, n_rows: 1 };
        }
    }
    end(current, signal);
}

/// Finds plateaus at the largest or the smallest value that the signal enters and leaves at speed.
///
/// A signal that only stops there comes to rest: an object that was put down, a motion that begins.
fn clipping(values: &[f64], steps: &[f64], signal: &Signal) -> Option<Clipping> {
    let sizes: Vec<f64> = steps.iter().take(4096).map(|s| s.abs()).filter(|s| *s > 0.0).collect();
    let quantum = sizes.iter().copied().fold(f64::INFINITY, f64::min);
    // A coarse signal reaches every value abruptly; nothing can be said of it.
    if sizes.len() < 16 || signal.step < 3.0 * quantum || signal.rest_share > 0.9 {
        return None;
    }
    let fast = 0.3 * signal.step;
    let mut worst: Option<Clipping> = None;
    for level in [signal.max, signal.min] {
        let (mut found, mut is_cut): (Option<Clipping>, bool) = (None, false);
        let mut t = 0;
        while t < values.len() {
            if values[t] != level {
                t += 1;
                continue;
            }
            let n_rows = values[t..].iter().take_while(|v| **v == level).count();
            // The step onto a plateau and the step off it are cut off themselves.
            let enters = t >= 2 && steps[t - 2].abs() > fast;
            let end = t + n_rows;
            let leaves = end + 1 < values.len() && steps[end].abs() > fast;
            is_cut |= n_rows >= 3 && enters && leaves;
            if n_rows >= 3 && (enters || leaves) {
                let clipping = found.get_or_insert(Clipping {
                    level,
                    n_rows: 0,
                    n_plateaus: 0,
                    first: Stretch { start: t, n_rows },
                });
                clipping.n_rows += n_rows;
                clipping.n_plateaus += 1;
            }
            t = end;
        }
        if let Some(found) = found.filter(|_| is_cut)
            && worst.is_none_or(|w| found.n_rows > w.n_rows)
        {
            worst = Some(found);
        }
    }
    worst
}

/// Finds up to three rows of exact zero between equal values far from zero.
fn zero_drops(values: &[f64], signal: &mut Signal) {
    let far = 0.2 * signal.spread.max(1e-9);
    let mut t = 1;
    while t + 1 < values.len() {
        if values[t] != 0.0 || values[t - 1] == 0.0 {
            t += 1;
            continue;
        }
        let n_rows = values[t..].iter().take_while(|v| **v == 0.0).count();
        if let (1..=3, Some(after)) = (n_rows, values.get(t + n_rows)) {
            let before = values[t - 1];
            if before.abs() > far
                && before.abs() > 8.0 * signal.step
                && (before - after).abs() < 0.3 * before.abs()
            {
                signal.zero_drops.push(t);
            }
        }
        t += n_rows;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn wrapped(value: f64) -> f64 {
        (value + TAU / 2.0).rem_euclid(TAU) - TAU / 2.0
    }

    fn smooth(n: usize) -> Vec<f64> {
        (0..n).map(|t| (t as f64 * 0.05).sin() + 0.3 * (t as f64 * 0.023).cos()).collect()
    }

    #[test]
    fn a_smooth_signal_has_nothing_odd() {
        let signal = measure(&smooth(400), DimKind::Unknown);
        assert!(signal.jumps.iter().all(|j| j.size < 8.0 * signal.rough99));
        assert_eq!(signal.clipped, None);
        assert_eq!(signal.n_wraps, 0);
        assert!(signal.longest_rest.n_rows <= 2);
    }

    #[test]
    fn clipping_is_seen_and_rest_is_not() {
        let clipped: Vec<f64> = smooth(400).iter().map(|v| v.min(0.7)).collect();
        assert!(measure(&clipped, DimKind::Unknown).clipped.is_some_and(|c| c.n_rows > 30));
        let resting: Vec<f64> =
            (0..400).map(|t| if t < 200 { 1.0 - ((t as f64 / 200.0 - 1.0).powi(2)) } else { 1.0 }).collect();
        assert_eq!(measure(&resting, DimKind::Unknown).clipped, None);
    }

    #[test]
    fn a_wrap_is_no_jump() {
        let values: Vec<f64> = (0..400).map(|t| wrapped(t as f64 * 0.05)).collect();
        let signal = measure(&values, DimKind::Linear);
        assert_eq!((signal.n_wraps, signal.first_wrap), (3, Some(63)));
        assert!(signal.jumps.iter().all(|j| j.size < 1e-6));
    }

    #[test]
    fn a_spike_and_a_dropout_are_seen() {
        let mut values = smooth(400);
        values[100] += 1.0;
        values[35] = 0.0;
        let signal = measure(&values, DimKind::Unknown);
        assert!(signal.jumps.iter().any(|j| j.row == 100));
        assert_eq!(signal.zero_drops, [35]);
    }

    #[test]
    fn spikes_of_a_short_episode_do_not_hide_themselves() {
        let mut values = smooth(70);
        values[20] = -999.0;
        values[50] = -999.0;
        let signal = measure(&values, DimKind::Unknown);
        assert!([20, 50].iter().all(|row| signal.jumps.iter().any(|j| j.row == *row)), "{:?}", signal.jumps);
    }
}
