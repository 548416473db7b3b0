//! How states follow actions: lag, order, sign, scale, offset, and whether actions are positions or differences.

use super::robust::{Pair, median};

/// Shifts of the action that are compared, in rows: -5..=5.
pub(super) const SHIFTS: usize = 11;
/// The middle of them.
pub(super) const NO_SHIFT: usize = SHIFTS / 2;
/// Rows of a run that are looked at.
const SAMPLE_ROWS: usize = 768;
/// Rows of the matrices of all dims against all.
const MATRIX_ROWS: usize = 256;
/// Share of the largest spread below which a dim is at rest and says nothing of timing.
const IDLE_SHARE: f64 = 0.05;
/// Rows of a smoothed step.
const SMOOTH_ROWS: usize = 5;

/// How one state dim follows its action dim in one run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct PairProfile {
    /// Values: state against action.
    pub(super) level: Pair,
    /// Smoothed steps: state against action.
    pub(super) steps: Pair,
    /// The state's next step against the action's value, at delays of 0, 1 and 2 rows.
    pub(super) delta: [Pair; 3],
    /// The state's next step against its distance from the action.
    pub(super) pull: Pair,
    /// Median of action minus state.
    pub(super) offset: f64,
    /// Logarithm of the residual with the action shifted, relative to that without an action; `None` for a dim at rest.
    pub(super) residuals: Option<[f64; SHIFTS]>,
}

/// How states follow actions in one run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Tracking {
    pub(super) pairs: Vec<PairProfile>,
    /// Correlation of smoothed steps, [action, state] row-major.
    pub(super) step_correlation: Vec<f32>,
    /// Mean square distance of values, [action, state] row-major.
    pub(super) distance: Vec<f32>,
    /// Variance of the actions.
    pub(super) action_variance: Vec<f64>,
    /// Share of the distance to its action by which the state moves in a row: the median over dims that follow.
    pub(super) response: Option<f64>,
    /// Mean of the residuals over dims.
    pub(super) profile: Option<[f64; SHIFTS]>,
}

/// Measures one run; `pairs` are positions of (action, state).
pub(super) fn track(
    actions: &[&Vec<f64>],
    states: &[&Vec<f64>],
    pairs: &[(usize, usize)],
) -> Option<Tracking> {
    let n = actions.first()?.len();
    if n < 4 * SHIFTS {
        return None;
    }
    let profiles: Vec<PairProfile> =
        pairs.iter().map(|(a, s)| pair_profile(actions[*a], states[*s])).collect();
    let spreads: Vec<f64> = pairs.iter().map(|(_, s)| variance(states[*s]).sqrt()).collect();
    let idle = IDLE_SHARE * spreads.iter().copied().fold(0.0, f64::max);
    let moving: Vec<&[f64; SHIFTS]> = profiles
        .iter()
        .zip(&spreads)
        .filter(|(_, spread)| **spread > idle)
        .filter_map(|(p, _)| p.residuals.as_ref())
        .collect();
    let profile = (!moving.is_empty()).then(|| {
        let mut mean = [0.0; SHIFTS];
        for residuals in &moving {
            mean.iter_mut().zip(*residuals).for_each(|(m, r)| *m += r / moving.len() as f64);
        }
        mean
    });
    let (step_correlation, distance) = matrices(actions, states, n);
    let action_variance = actions.iter().map(|a| variance(a)).collect();
    let response = response(&profiles);
    Some(Tracking { response, pairs: profiles, step_correlation, distance, action_variance, profile })
}

/// Returns the usual pull of dims that follow their action.
fn response(profiles: &[PairProfile]) -> Option<f64> {
    let follows =
        |p: &&PairProfile| p.residuals.is_some() && p.level.correlation() > 0.6 && p.pull.correlation() > 0.7;
    let pulls: Vec<f64> =
        profiles.iter().filter(follows).map(|p| p.pull.correlation() * p.pull.scale().abs()).collect();
    (pulls.len() >= 2).then(|| median(&pulls))
}

fn variance(values: &[f64]) -> f64 {
    let finite: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
    let n = finite.len().max(1) as f64;
    let mean = finite.iter().sum::<f64>() / n;
    finite.iter().map(|v| (v - mean) * (v - mean)).sum::<f64>() / n
}

fn matrices(actions: &[&Vec<f64>], states: &[&Vec<f64>], n: usize) -> (Vec<f32>, Vec<f32>) {
    let last = n - SMOOTH_ROWS - 2;
    let stride = last.div_ceil(MATRIX_ROWS).max(1);
    let rows: Vec<usize> = (0..last).step_by(stride).collect();
    let (mut correlation, mut distance) = (Vec::new(), Vec::new());
    for action in actions {
        for state in states {
            let mut steps = Pair::default();
            let (mut sum, mut count) = (0.0, 0.0);
            for &t in &rows {
                steps.add(action[t + SMOOTH_ROWS] - action[t], state[t + SMOOTH_ROWS + 1] - state[t + 1]);
                let gap = action[t] - state[t + 1];
                if gap.is_finite() {
                    sum += gap * gap;
                    count += 1.0;
                }
            }
            correlation.push(steps.correlation() as f32);
            distance.push(if count > 0.0 { (sum / count) as f32 } else { f32::INFINITY });
        }
    }
    (correlation, distance)
}

fn pair_profile(action: &[f64], state: &[f64]) -> PairProfile {
    let n = action.len();
    let stride = n.div_ceil(SAMPLE_ROWS).max(1);
    let mut profile = PairProfile {
        level: Pair::default(),
        steps: Pair::default(),
        delta: [Pair::default(); 3],
        pull: Pair::default(),
        offset: f64::NAN,
        residuals: residuals(action, state, stride),
    };
    let mut offsets = Vec::with_capacity(n / stride + 1);
    for t in (0..n - SMOOTH_ROWS - 4).step_by(stride) {
        profile.level.add(action[t], state[t + 1]);
        profile.steps.add(action[t + SMOOTH_ROWS] - action[t], state[t + SMOOTH_ROWS + 1] - state[t + 1]);
        for (delay, pair) in profile.delta.iter_mut().enumerate() {
            pair.add(action[t], state[t + delay + 1] - state[t + delay]);
        }
        profile.pull.add(action[t] - state[t], state[t + 1] - state[t]);
        offsets.push(action[t] - state[t + 1]);
    }
    profile.offset = median(&offsets);
    profile
}

/// Fits the state's next step by its last step, its value and the action shifted by -5..=5 rows.
///
/// The shift with the smallest residual is the one at which the action acts.
fn residuals(action: &[f64], state: &[f64], stride: usize) -> Option<[f64; SHIFTS]> {
    let n = action.len();
    let rows = || (SHIFTS..n - SHIFTS).step_by(stride);
    let without =
        fit::<3>(rows().map(|t| ([1.0, state[t] - state[t - 1], state[t]], state[t + 1] - state[t])))?;
    let spread: f64 = {
        let steps: Vec<f64> = rows().map(|t| state[t + 1] - state[t]).filter(|v| v.is_finite()).collect();
        let count = steps.len() as f64;
        let mean = steps.iter().sum::<f64>() / count.max(1.0);
        steps.iter().map(|s| (s - mean) * (s - mean)).sum()
    };
    let scale = rows().map(|t| state[t] * state[t]).filter(|v| v.is_finite()).fold(0.0, f64::max);
    // A dim at rest, or one whose motion is rounding, says nothing.
    if spread <= 1e-12 * scale.max(1e-12) || without <= 1e-13 * scale.max(1e-12) {
        return None;
    }
    let mut out = [0.0; SHIFTS];
    for (k, value) in out.iter_mut().enumerate() {
        let at = |t: usize| action[(t + k) - NO_SHIFT];
        let with = fit::<4>(
            rows().map(|t| ([1.0, state[t] - state[t - 1], state[t], at(t)], state[t + 1] - state[t])),
        )?;
        *value = (with / without).clamp(1e-6, 1.0).ln();
    }
    Some(out)
}

/// Returns the residual sum of squares of a linear fit.
fn fit<const N: usize>(rows: impl Iterator<Item = ([f64; N], f64)>) -> Option<f64> {
    let mut normal = [[0.0; N]; N];
    let (mut right, mut yy, mut count) = ([0.0; N], 0.0, 0usize);
    for (x, y) in rows {
        if !y.is_finite() || x.iter().any(|v| !v.is_finite()) {
            continue;
        }
        count += 1;
        yy += y * y;
        for i in 0..N {
            right[i] += x[i] * y;
            for j in 0..N {
                normal[i][j] += x[i] * x[j];
            }
        }
    }
    if count < 4 * N {
        return None;
    }
    for (i, row) in normal.iter_mut().enumerate() {
        // A little of the diagonal keeps collinear columns solvable.
        row[i] += 1e-10 * row[i] + 1e-300;
    }
    let solution = solve(normal, right)?;
    let explained: f64 = solution.iter().zip(&right).map(|(b, r)| b * r).sum();
    Some((yy - explained).max(1e-12 * yy))
}

fn solve<const N: usize>(mut a: [[f64; N]; N], mut b: [f64; N]) -> Option<[f64; N]> {
    for i in 0..N {
        let pivot = (i..N).max_by(|p, q| a[*p][i].abs().total_cmp(&a[*q][i].abs()))?;
        if a[pivot][i].abs() < 1e-280 {
            return None;
        }
        a.swap(i, pivot);
        b.swap(i, pivot);
        for k in i + 1..N {
            let factor = a[k][i] / a[i][i];
            let pivot_row = a[i];
            a[k].iter_mut().zip(pivot_row).skip(i).for_each(|(v, p)| *v -= factor * p);
            b[k] -= factor * b[i];
        }
    }
    for i in (0..N).rev() {
        let known: f64 = (i + 1..N).map(|j| a[i][j] * b[j]).sum();
        b[i] = (b[i] - known) / a[i][i];
    }
    Some(b)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn follower(n: usize, shift: isize) -> (Vec<f64>, Vec<f64>) {
        let target = |t: isize| (t as f64 * 0.11).sin() + 0.5 * (t as f64 * 0.37).sin();
        let mut state = vec![0.0];
        for t in 0..n - 1 {
            let last = state[t];
            state.push(last + 0.4 * (target(t as isize) - last));
        }
        let action = (0..n).map(|t| target(t as isize + shift)).collect();
        (action, state)
    }

    #[test]
    fn the_shift_at_which_the_action_acts_is_found() {
        for shift in [-2isize, -1, 0, 1, 3] {
            let (action, state) = follower(300, shift);
            let residuals = residuals(&action, &state, 1).unwrap();
            let best = (0..SHIFTS).min_by(|a, b| residuals[*a].total_cmp(&residuals[*b])).unwrap();
            assert_eq!(best as isize - NO_SHIFT as isize, -shift, "{residuals:?}");
        }
    }
}
