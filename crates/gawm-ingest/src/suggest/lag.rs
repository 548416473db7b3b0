//! Estimates how much later a state follows its command.

/// Step of the grid that both series are put on, in seconds.
const STEP_S: f64 = 0.004;
/// Largest delay that is looked for, in seconds.
const MAX_LAG_S: f64 = 0.6;
/// Longest stretch that is looked at, in seconds.
const MAX_SPAN_S: f64 = 60.0;
/// Half-width of the difference that stands for the derivative, in grid steps.
const DIFFERENCE: usize = 5;
/// A step this near to a turn is a wrapped angle.
const WRAP_SLACK_RAD: f64 = 1.0;

/// A series of one value: times in ns, ascending.
#[derive(Debug, Clone, Default)]
pub(crate) struct Series {
    pub(crate) times_ns: Vec<i64>,
    pub(crate) values: Vec<f64>,
}

/// How a state follows a command.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Following {
    /// Delay in seconds.
    pub(crate) lag_s: f64,
    /// Correlation at that delay, 0 to 1.
    pub(crate) correlation: f64,
    /// Whether the command is the velocity of the state; else it is its position.
    pub(crate) is_velocity: bool,
}

/// Finds the delay at which a state follows a command best, or `None` when there is too little to tell.
pub(crate) fn following(command: &Series, state: &Series) -> Option<Following> {
    let start = (*command.times_ns.first()?).max(*state.times_ns.first()?);
    let end = (*command.times_ns.last()?).min(*state.times_ns.last()?);
    let span_s = (end.saturating_sub(start) as f64 / 1e9).min(MAX_SPAN_S);
    if span_s < 0.5 {
        return None;
    }
    let n = (span_s / STEP_S) as usize;
    let command = on_grid(command, &unwrapped(&command.values), start, n);
    let state = on_grid(state, &unwrapped(&state.values), start, n);
    if command.iter().chain(&state).any(|value| !value.is_finite()) {
        return None;
    }
    let velocity = differences(&state);
    let position = best(&differences(&command), &velocity, false);
    let speed = best(&smoothed(&command), &velocity, true);
    match (position, speed) {
        (Some(a), Some(b)) => Some(if b.correlation > a.correlation { b } else { a }),
        (a, b) => a.or(b),
    }
}

/// Takes steps of nearly a turn out of angles, so that nothing is put between the two ends of such a step.
fn unwrapped(values: &[f64]) -> Vec<f64> {
    let turn = 2.0 * std::f64::consts::PI;
    let mut turns = 0.0;
    let mut last = values.first().copied().unwrap_or_default();
    values
        .iter()
        .map(|&value| {
            let step = value - last;
            if (step.abs() - turn).abs() < WRAP_SLACK_RAD {
                turns -= turn.copysign(step);
            }
            last = value;
            value + turns
        })
        .collect()
}

/// Linear between samples, whose values are given apart.
fn on_grid(series: &Series, values: &[f64], start_ns: i64, n: usize) -> Vec<f64> {
    let mut at = 0;
    (0..n)
        .map(|k| {
            let ns = start_ns + (k as f64 * STEP_S * 1e9) as i64;
            while at + 1 < series.times_ns.len() && series.times_ns[at + 1] <= ns {
                at += 1;
            }
            let (a, b) = (at, (at + 1).min(values.len() - 1));
            let width = (series.times_ns[b] - series.times_ns[a]) as f64;
            let share =
                if width > 0.0 { ((ns - series.times_ns[a]) as f64 / width).clamp(0.0, 1.0) } else { 0.0 };
            values[a] + (values[b] - values[a]) * share
        })
        .collect()
}

/// Central differences. The ends have none: zeros there would lie on each other at no delay, and speak for it.
fn differences(values: &[f64]) -> Vec<f64> {
    values.windows(2 * DIFFERENCE + 1).map(|stretch| stretch[2 * DIFFERENCE] - stretch[0]).collect()
}

/// The mean over the stretch that a central difference spans.
fn smoothed(values: &[f64]) -> Vec<f64> {
    let mean = |stretch: &[f64]| stretch.iter().sum::<f64>() / stretch.len() as f64;
    values.windows(2 * DIFFERENCE + 1).map(mean).collect()
}

fn best(command: &[f64], state: &[f64], is_velocity: bool) -> Option<Following> {
    let max_lag = ((MAX_LAG_S / STEP_S) as usize).min(command.len() / 3);
    let scores: Vec<f64> = (0..=max_lag).map(|lag| correlation(command, state, lag)).collect();
    let (at, score) = scores.iter().copied().enumerate().max_by(|a, b| a.1.total_cmp(&b.1))?;
    if score <= 0.0 {
        return None;
    }
    // The peak of the parabola through the best score and its neighbours.
    let refined = match (at.checked_sub(1).map(|before| scores[before]), scores.get(at + 1)) {
        (Some(before), Some(&after)) => {
            let bend = before - 2.0 * score + after;
            if bend < 0.0 { at as f64 + 0.5 * (before - after) / bend } else { at as f64 }
        }
        _ => at as f64,
    };
    Some(Following { lag_s: refined * STEP_S, correlation: score, is_velocity })
}

/// Correlation of `command[k]` with `state[k + lag]`; 0 where one of them does not move.
fn correlation(command: &[f64], state: &[f64], lag: usize) -> f64 {
    let n = command.len() - lag;
    let (a, b) = (&command[..n], &state[lag..]);
    let mean = |values: &[f64]| values.iter().sum::<f64>() / n as f64;
    let (ma, mb) = (mean(a), mean(b));
    let (mut ab, mut aa, mut bb) = (0.0, 0.0, 0.0);
    for (x, y) in a.iter().zip(b) {
        ab += (x - ma) * (y - mb);
        aa += (x - ma) * (x - ma);
        bb += (y - mb) * (y - mb);
    }
    if aa <= 1e-18 || bb <= 1e-18 { 0.0 } else { ab / (aa * bb).sqrt() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn series(step_ms: f64, n: usize, value: impl Fn(f64) -> f64) -> Series {
        let times_ns: Vec<i64> = (0..n).map(|k| (k as f64 * step_ms * 1e6) as i64).collect();
        let values = times_ns.iter().map(|&ns| value(ns as f64 / 1e9)).collect();
        Series { times_ns, values }
    }

    fn motion(t: f64) -> f64 {
        (2.0 * t).sin() + 0.4 * (5.3 * t + 1.0).sin() + 0.1 * (11.0 * t).cos()
    }

    fn check_following(command: &Series, state: &Series, lag_s: f64, is_velocity: bool) {
        let got = following(command, state).unwrap();
        assert_eq!(got.is_velocity, is_velocity, "{got:?}");
        assert!((got.lag_s - lag_s).abs() < 0.002, "{got:?}, expected {lag_s}");
        assert!(got.correlation > 0.9, "{got:?}");
    }

    #[test]
    fn finds_the_delay_of_positions_and_velocities() {
        let state = series(10.0, 1000, |t| motion(t - 0.04));
        check_following(&series(20.0, 500, motion), &state, 0.04, false);
        let speed =
            |t: f64| 2.0 * (2.0 * t).cos() + 0.4 * 5.3 * (5.3 * t + 1.0).cos() - 1.1 * (11.0 * t).sin();
        check_following(&series(4.0, 2500, speed), &state, 0.04, true);
    }

    #[test]
    fn slow_motion_has_a_delay_too() {
        let slow = |t: f64| 0.8 * (t + 1.0).sin();
        check_following(&series(40.0, 250, slow), &series(4.0, 2500, |t| slow(t - 0.02)), 0.02, false);
    }

    #[test]
    fn wrapped_angles_are_followed_through_the_turn() {
        let wrapped =
            |x: f64| (x + std::f64::consts::PI).rem_euclid(std::f64::consts::TAU) - std::f64::consts::PI;
        let command = series(20.0, 500, |t| wrapped(3.0 + motion(t)));
        let state = series(10.0, 1000, |t| wrapped(3.0 + motion(t - 0.04)));
        check_following(&command, &state, 0.04, false);
    }

    #[test]
    fn says_nothing_without_motion_or_data() {
        let still = series(10.0, 500, |_| 1.0);
        assert_eq!(following(&still, &still), None);
        assert_eq!(following(&Series::default(), &still), None);
    }
}
