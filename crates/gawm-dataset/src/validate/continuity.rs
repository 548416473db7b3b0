//! Pictures that do not go on as the robot does: frozen under noise (IMAGE-006), jumps between two frames (IMAGE-017).

use super::{
    Finding, Thresholds,
    image::{CameraRun, distance},
    motion::place_distance,
    profile::RunProfile,
    robust::median,
    signal::Stretch,
};

/// Least change of thumbnails over the shortest still stretch, in levels, that motion must make to be seen at all.
const VISIBLE: f64 = 1.0;
/// A still picture changes by less than this share of the usual change.
const STILL_SHARE: f64 = 0.12;
/// The robot must get this many usual steps away per row of a still stretch.
const LEAST_WAY: f64 = 0.3;
/// A jump is this many times longer than the changes around it, and at least this many levels.
const JUMP_RATIO: f64 = 4.5;
const JUMP_LEVELS: f64 = 2.0;
/// Rows before and after a jump that are looked at.
const AROUND: usize = 4;

/// Judges the frames of one camera in all runs.
pub(super) fn judge(
    thresholds: &Thresholds,
    fps: f64,
    name: &str,
    runs: &[(&RunProfile, &CameraRun)],
) -> Vec<Finding> {
    let mut findings = Vec::new();
    // Twice as long as for frames that are equal to the bit.
    let shortest = (2.0 * thresholds.image.frozen_secs * fps).max(15.0);
    let mut jumps: Vec<(&RunProfile, Vec<(usize, f64)>)> = Vec::new();
    for (run, camera) in runs {
        let Some(changes) = changes(camera) else { continue };
        if let Some((still, usual)) = longest_still(run, camera, shortest as usize)
            && still.n_rows as f64 >= shortest
        {
            let message = format!(
                "the picture hardly changes for {} rows while the robot moves; usually by {usual:.1} levels in {} rows",
                still.n_rows, shortest as usize
            );
            let finding = Finding::new("IMAGE-006", message).episode(run.episode).feature(name);
            findings.push(finding.rows(still.start, still.end()).measured(still.n_rows as f64, shortest));
        }
        jumps.push((run, jumps_of(run, &changes)));
    }
    let n_rows: usize = runs.iter().map(|(run, _)| run.n_rows).sum();
    let n_jumping = jumps.iter().filter(|(_, j)| !j.is_empty()).count();
    let n_jumps: usize = jumps.iter().map(|(_, j)| j.len()).sum();
    // Scenes that change at once by nature do so again and again.
    if n_jumps as f64 > 0.005 * n_rows as f64 || (n_jumping > 3 && n_jumping * 4 > runs.len()) {
        return findings;
    }
    for (run, jumps) in jumps {
        let Some((row, _)) = jumps.first() else { continue };
        let worst = jumps.iter().map(|j| j.1).fold(0.0, f64::max);
        let message = format!(
            "the picture jumps {} times although the state does not, {worst:.0} times as far as around it",
            jumps.len()
        );
        let finding = Finding::new("IMAGE-017", message).episode(run.episode).feature(name);
        findings.push(finding.rows(*row, row + 1).measured(worst, JUMP_RATIO));
    }
    findings
}

/// Returns by how many levels each frame differs from the one before, if all are pictures.
fn changes(camera: &CameraRun) -> Option<Vec<f64>> {
    let frames = &camera.frames;
    if frames.len() < 4 * AROUND || frames.iter().any(|f| !f.is_picture) {
        return None;
    }
    Some(std::iter::once(0.0).chain(frames.windows(2).map(|w| distance(&w[0], &w[1]))).collect())
}

fn relative_speed(run: &RunProfile) -> Option<Vec<f64>> {
    let speed: Vec<f64> = run.speed.iter().map(|v| f64::from(*v)).collect();
    let usual = median(&speed);
    (usual > 0.0).then(|| speed.iter().map(|s| s / usual).collect())
}

/// Returns the longest stretch in which frames differ but hardly change while the robot moves, and the change that
/// motion usually makes in `reach` rows.
fn longest_still(run: &RunProfile, camera: &CameraRun, reach: usize) -> Option<(Stretch, f64)> {
    let frames = &camera.frames;
    let speed = relative_speed(run).filter(|s| s.len() == frames.len())?;
    let moving = (reach..frames.len()).filter(|t| speed[*t] > 0.5);
    let usual = median(&moving.map(|t| distance(&frames[t - reach], &frames[t])).collect::<Vec<_>>());
    if frames.len() < reach.saturating_mul(3) || usual.is_nan() || usual < VISIBLE {
        return None;
    }
    let (mut longest, mut start) = (Stretch::default(), 0);
    for t in 1..frames.len() {
        if distance(&frames[start], &frames[t]) > STILL_SHARE * usual {
            start = t;
        } else if t + 1 - start > longest.n_rows {
            longest = Stretch { start, n_rows: t + 1 - start };
        }
    }
    let rows = longest.start..longest.end();
    // Frames that are equal to the bit are counted elsewhere.
    let n_equal = frames[rows.clone()].windows(2).filter(|w| w[0].hash == w[1].hash).count();
    let motion = speed[rows].iter().skip(1).sum::<f64>() / longest.n_rows.saturating_sub(1).max(1) as f64;
    let ends = run.places.get(longest.start).zip(run.places.get(longest.end().saturating_sub(1)));
    let way = ends.map_or(0.0, |(a, b)| place_distance(a, b));
    let is_moving = motion > 0.5 && way > LEAST_WAY * longest.n_rows as f64;
    (is_moving && 2 * n_equal < longest.n_rows).then_some((longest, usual))
}

/// Returns rows at which the picture changes far more than around them although the robot moves as before.
fn jumps_of(run: &RunProfile, changes: &[f64]) -> Vec<(usize, f64)> {
    let Some(speed) = relative_speed(run).filter(|s| s.len() == changes.len()) else { return Vec::new() };
    let n = changes.len();
    let mut jumps = Vec::new();
    for t in 1 + AROUND..n.saturating_sub(AROUND) {
        let here = changes[t];
        if here < JUMP_LEVELS {
            continue;
        }
        let beside = || (t - AROUND..t).chain(t + 1..=t + AROUND);
        let around = beside().map(|k| changes[k]).fold(0.0, f64::max);
        let fastest = beside().map(|k| speed[k]).fold(0.0, f64::max);
        if here > JUMP_RATIO * around.max(0.25) && speed[t] < 2.0 * fastest.max(0.5) {
            jumps.push((t, here / around.max(0.25)));
        }
    }
    jumps
}
