//! The motion of all state dims together: speed, rests, rows that repeat, steps that are several.

use super::{
    robust::{median, quantile},
    signal::Stretch,
};

/// Fewer dims turn, stop and collide: of them only what nothing else explains counts.
const FEW_DIMS: usize = 5;
/// Fewest dims whose common direction shows that a single row is missing.
const SURE_DIMS: usize = 6;
/// Fewest steps within one that count when they are sure.
const SURE_STEPS: f64 = 1.7;
/// Rows that tell how steady the motion is.
const STEADY_ROWS: usize = 256;

/// A step as long as several.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Squeeze {
    /// The row after the step.
    pub(super) row: usize,
    /// How many steps fit into it.
    pub(super) steps: f64,
    /// Whether it is far longer than the steps around it.
    pub(super) is_long: bool,
    /// Whether the motion is so steady that even one missing row shows.
    pub(super) is_sure: bool,
}

impl Squeeze {
    /// Returns whether rows are missing before it; `bound` is the number of steps of which one is enough to say so.
    pub(super) fn is_event(&self, bound: f64) -> bool {
        self.is_sure || (self.is_long && self.steps > bound)
    }
}

/// Motion of all state dims together.
#[derive(Debug, Clone, Default, PartialEq)]
pub(super) struct MotionProfile {
    /// Steps that look like several.
    pub(super) squeezed: Vec<Squeeze>,
    /// Rows in motion that equal the row before in all state dims.
    pub(super) repeated: Vec<usize>,
    pub(super) n_repeated: usize,
    /// Longest stretch of equal rows, and the second longest.
    pub(super) longest_rest: Stretch,
    pub(super) second_rest: usize,
    /// Share of the action's range that it moves in the longest rest.
    pub(super) rest_drive: f64,
    /// Share of rows that are idle.
    pub(super) idle_share: f64,
    /// Share of steps without any change.
    pub(super) rest_share: f64,
}

/// A state as four sums of its dims with different signs: states that differ, differ in these.
pub(super) type Place = [f32; 4];

/// Returns how much of their range values cover in a stretch.
pub(super) fn share_of_range(values: &[f64], stretch: Stretch) -> f64 {
    let range = |values: &[f64]| {
        let (min, max) =
            values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
        max - min
    };
    let whole = range(values);
    // The first rows may still carry the motion that led to the rest.
    let begin = (stretch.start + stretch.n_rows / 4).min(values.len());
    let here = range(&values[begin..stretch.end().min(values.len())]);
    if whole > 0.0 && here.is_finite() { here / whole } else { 0.0 }
}

/// Returns the place of each row, in units of usual steps from the first row.
pub(super) fn places(states: &[&Vec<f64>], scales: &[f64]) -> Vec<Place> {
    let n = states.first().map_or(0, |s| s.len());
    let used: Vec<usize> = (0..states.len()).filter(|d| scales[*d] > 0.0).collect();
    let mut places = vec![[0.0; 4]; n];
    for (k, &d) in used.iter().enumerate() {
        let unit = scales[d] * (used.len() as f64).sqrt();
        // The bits of a fixed multiple of the dim's number are its signs.
        let signs = (k as u32 + 1).wrapping_mul(0x9e37_79b9) >> 13;
        for (place, value) in places.iter_mut().zip(states[d]) {
            let offset = ((value - states[d][0]) / unit) as f32;
            for (bit, sum) in place.iter_mut().enumerate() {
                *sum += if signs >> bit & 1 == 0 { offset } else { -offset };
            }
        }
    }
    places
}

/// Returns the distance of two places in usual steps.
pub(super) fn place_distance(a: &Place, b: &Place) -> f64 {
    let squares = a.iter().zip(b).map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>();
    (squares / a.len() as f64).sqrt()
}

/// Measures the motion of one run; `scales` are the usual steps of the states.
pub(super) fn motion_profile(
    states: &[&Vec<f64>],
    actions: &[&Vec<f64>],
    scales: &[f64],
) -> (MotionProfile, Vec<f32>) {
    let mut profile = MotionProfile::default();
    let n = states.first().map_or(0, |s| s.len());
    if n < 8 {
        return (profile, vec![0.0; n]);
    }
    let used: Vec<usize> = (0..states.len()).filter(|d| scales[*d] > 0.0).collect();
    let step = |d: usize, t: usize| (states[d][t + 1] - states[d][t]) / scales[d];
    let mut speed = vec![0.0f32; n];
    let mut is_equal = vec![true; n - 1];
    for &d in &used {
        for t in 0..n - 1 {
            let s = step(d, t);
            is_equal[t] &= s == 0.0;
            // One dim must not carry the whole: it is bounded at ten usual steps.
            speed[t + 1] += (s.abs().min(10.0) / used.len() as f64) as f32;
        }
    }
    let speeds: Vec<f64> = speed.iter().skip(1).map(|v| f64::from(*v)).collect();
    let usual = median(&speeds);
    let fast = quantile(&speeds, 0.9);
    profile.idle_share = speeds.iter().filter(|v| **v < 0.02 * fast).count() as f64 / speeds.len() as f64;
    profile.rest_share = is_equal.iter().filter(|e| **e).count() as f64 / is_equal.len() as f64;
    if used.is_empty() {
        return (profile, speed);
    }
    let is_few = used.len() < FEW_DIMS;
    let is_driven = |t: usize| actions.iter().any(|a| a[t + 1] != a[t]);
    for t in 2..n - 3 {
        let around = 0.25 * (speeds[t - 2] + speeds[t - 1] + speeds[t + 1] + speeds[t + 2]);
        if around < 0.5 * usual {
            continue;
        }
        if is_equal[t] && !is_equal[t - 1] && !is_equal[t + 1] {
            if is_few && is_driven(t) {
                continue;
            }
            profile.n_repeated += 1;
            if profile.repeated.len() < 64 {
                profile.repeated.push(t + 1);
            }
        } else if speeds[t] > 1.5 * around {
            let steps = squeezed_steps(&used, &step, t);
            let is_long = steps > 2.0 && speeds[t] > 2.0 * around;
            if steps > SURE_STEPS {
                profile.squeezed.push(Squeeze { row: t + 1, steps, is_long, is_sure: false });
            }
        }
    }
    mark_sure(&used, &step, n, &mut profile);
    row_rests(&is_equal, &mut profile);
    let drives = actions.iter().map(|a| share_of_range(a, profile.longest_rest));
    profile.rest_drive = drives.fold(0.0, f64::max);
    (profile, speed)
}

/// Returns how many steps at the speed before and after fit into the step at `t`, 0 if that is no explanation.
///
/// Either the step points where the robot was going, or most dims make a long step at once.
fn squeezed_steps(used: &[usize], step: &impl Fn(usize, usize) -> f64, t: usize) -> f64 {
    let (mut dv, mut vv, mut dd, mut top) = (0.0, 0.0, 0.0, 0.0f64);
    let mut ratios = Vec::with_capacity(used.len());
    for &d in used {
        let (before, after) =
            (0.5 * (step(d, t - 2) + step(d, t - 1)), 0.5 * (step(d, t + 1) + step(d, t + 2)));
        let (here, v) = (step(d, t), 0.5 * (before + after));
        dv += here * v;
        vv += v * v;
        dd += here * here;
        top = top.max(here * here);
        // Steps are in units of the dim's usual step: a dim at rest is measured by that.
        ratios.push(here.abs() / before.abs().max(after.abs()).max(0.5));
    }
    // A jump of one dim alone is another matter.
    if used.len() >= 2 && top > 0.9 * dd {
        return 0.0;
    }
    // Two or three dims turn, stop and collide: only a step that is long in all of them counts.
    if used.len() < FEW_DIMS && ratios.iter().any(|r| *r <= 2.0) {
        return 0.0;
    }
    let long = ratios.iter().filter(|r| **r > 2.0).count();
    let ratio = median(&ratios);
    if vv > 0.0 && dv > 0.9 * (dd * vv).sqrt() {
        dv / vv
    } else if used.len() >= 3 && long as f64 >= 0.6 * used.len() as f64 {
        ratio
    } else {
        0.0
    }
}

/// Marks steps along the motion before and after that are far longer than the steadiness of the motion permits.
fn mark_sure(used: &[usize], step: &impl Fn(usize, usize) -> f64, n: usize, profile: &mut MotionProfile) {
    if used.len() < SURE_DIMS || profile.squeezed.is_empty() || n < 64 {
        return;
    }
    let along = |t: usize| -> Option<(f64, f64)> {
        let (mut dv, mut vv, mut dd) = (0.0, 0.0, 0.0);
        for &d in used {
            let v = 0.25 * (step(d, t - 2) + step(d, t - 1) + step(d, t + 1) + step(d, t + 2));
            let here = step(d, t);
            dv += here * v;
            vv += v * v;
            dd += here * here;
        }
        (vv > 0.25 * used.len() as f64).then(|| (dv / vv, dv / (dd * vv).sqrt()))
    };
    let stride = n.div_ceil(STEADY_ROWS).max(1);
    let errors: Vec<f64> =
        (2..n - 3).step_by(stride).filter_map(along).map(|(ratio, _)| (ratio - 1.0).abs()).collect();
    let usual = quantile(&errors, 0.95);
    if errors.len() < 32 {
        return;
    }
    for squeeze in &mut profile.squeezed {
        let Some((ratio, cosine)) = along(squeeze.row - 1) else { continue };
        // A whole number of steps, in the direction of the motion.
        let is_whole = (ratio - ratio.round()).abs() < 0.1;
        squeeze.is_sure = cosine > 0.9965 && ratio > SURE_STEPS && is_whole && ratio - 1.0 > 3.0 * usual;
    }
}

fn row_rests(is_equal: &[bool], profile: &mut MotionProfile) {
    let mut current = Stretch { start: 0, n_rows: 1 };
    let mut end = |rest: Stretch| {
        if rest.n_rows > profile.longest_rest.n_rows {
            profile.second_rest = profile.longest_rest.n_rows;
            profile.longest_rest = rest;
        } else {
            profile.second_rest = profile.second_rest.max(rest.n_rows);
        }
    };
    for (t, equal) in is_equal.iter().enumerate() {
        if *equal {
            current.n_rows += 1;
        } else {
            end(current);
            current = Stretch { start: t + 1, n_rows: 1 };
        }
    }
    end(current);
}
