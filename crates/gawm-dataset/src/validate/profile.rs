//! One pass over the numbers of a dataset: everything that the rules compare later, per run.

use super::{
    Finding, Thresholds,
    group::{GroupMeasure, measure_groups},
    layout::{FeatureLayout, GroupKind, Purpose},
    motion::{MotionProfile, Place, motion_profile, places, share_of_range},
    relation,
    signal::{Signal, measure},
    time::{TimeProfile, time_profile},
    tracking::{Tracking, track},
};
use crate::read::{Dataset, EpisodeRows};

/// Points of a trajectory's fingerprint.
pub(super) const FINGERPRINT_POINTS: usize = 24;
/// Rows between the points of an aligned trajectory.
pub(super) const ALIGNED_ROWS: usize = 16;
/// Most runs of which aligned trajectories are kept.
const MAX_ALIGNED_RUNS: usize = 20_000;
/// One row hash in this many is kept.
const KEPT_ROW_HASHES: u64 = 8;

/// What is fixed for the pass.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) layouts: Vec<FeatureLayout>,
    /// Positions (feature, dim) of all state dims, then of all action dims.
    pub(super) states: Vec<(usize, usize)>,
    pub(super) actions: Vec<(usize, usize)>,
    /// Positions in `actions` and `states` of dims that belong together.
    pub(super) pairs: Vec<(usize, usize)>,
    /// Rows of a training window.
    pub(super) window_rows: usize,
    /// Whether the speed of each row is kept, for rules about images.
    pub(super) keeps_speed: bool,
    /// Whether trajectories are kept at a fixed distance of rows, for copies that were cut.
    pub(super) keeps_aligned: bool,
    /// Rows of each run that are kept for relations between dims.
    relation_rows: usize,
    /// Names of validity columns.
    pub(super) validity: Vec<String>,
}

impl Plan {
    pub(super) fn new(
        dataset: &Dataset,
        layouts: Vec<FeatureLayout>,
        window_rows: usize,
        keeps_speed: bool,
    ) -> Plan {
        let dims_of = |purpose: Purpose| -> Vec<(usize, usize)> {
            let features = layouts.iter().enumerate().filter(|(_, l)| l.purpose == purpose);
            features.flat_map(|(f, l)| (0..l.width()).map(move |d| (f, d))).collect()
        };
        let (states, actions) = (dims_of(Purpose::State), dims_of(Purpose::Action));
        let pairs = pair_dims(&layouts, &actions, &states);
        let validity =
            dataset.info.features.iter().filter(|f| f.name.starts_with("gawm.valid") && f.is_numeric());
        let validity = validity.map(|f| f.name.clone()).collect();
        let keeps_aligned = dataset.runs.len() <= MAX_ALIGNED_RUNS;
        let relation_rows = relation::rows_per_run(states.len(), actions.len(), dataset.runs.len());
        Plan {
            layouts,
            states,
            actions,
            pairs,
            window_rows,
            keeps_speed,
            keeps_aligned,
            relation_rows,
            validity,
        }
    }

    /// Returns the layout and name of a dim.
    pub(super) fn name(&self, (feature, dim): (usize, usize)) -> (&str, &str) {
        (&self.layouts[feature].name, &self.layouts[feature].names[dim])
    }
}

/// Pairs action and state dims by name, or by position where both have the same number and not both have names.
fn pair_dims(
    layouts: &[FeatureLayout],
    actions: &[(usize, usize)],
    states: &[(usize, usize)],
) -> Vec<(usize, usize)> {
    let stem = |&(f, d): &(usize, usize)| layouts[f].names[d].to_ascii_lowercase();
    let has_names = |dims: &[(usize, usize)]| dims.iter().all(|(f, _)| layouts[*f].has_names);
    if has_names(actions) && has_names(states) {
        let by_name = |a: usize| states.iter().position(|s| stem(s) == stem(&actions[a])).map(|s| (a, s));
        let named: Vec<(usize, usize)> = (0..actions.len()).filter_map(by_name).collect();
        if !named.is_empty() {
            return named;
        }
    }
    if actions.len() == states.len() { (0..actions.len()).map(|i| (i, i)).collect() } else { Vec::new() }
}

/// What is measured of one feature in one run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct FeatureProfile {
    pub(super) dims: Vec<Signal>,
    /// For each dim's longest rest: how much the other dims move in it, relative to their usual motion.
    pub(super) rest_motion: Vec<f64>,
    pub(super) groups: Vec<GroupMeasure>,
    /// Pairs of dims that are equal in all rows.
    pub(super) equal_dims: Vec<(usize, usize)>,
}

/// Everything that is measured of one run.
#[derive(Debug)]
pub(super) struct RunProfile {
    pub(super) run_index: usize,
    pub(super) episode: i64,
    pub(super) n_rows: usize,
    pub(super) findings: Vec<Finding>,
    pub(super) features: Vec<Option<FeatureProfile>>,
    /// For each action dim's pair: range of the action in the state's longest rest, relative to its whole range.
    pub(super) rest_drive: Vec<f64>,
    pub(super) tracking: Option<Tracking>,
    pub(super) relations: relation::Sample,
    pub(super) time: TimeProfile,
    pub(super) motion: MotionProfile,
    pub(super) content_hash: [u8; 16],
    pub(super) row_hashes: Vec<u64>,
    pub(super) fingerprint: Vec<f32>,
    /// The same at a fixed distance of rows, from the begin and from the end.
    pub(super) aligned: [Vec<f32>; 2],
    pub(super) speed: Vec<f32>,
    /// Where the robot is in each row: sums of all state dims in units of their usual steps.
    pub(super) places: Vec<Place>,
    pub(super) n_windows: u64,
    pub(super) n_good_windows: u64,
    pub(super) task_indices: Vec<i64>,
}

/// Measures one run.
pub(super) fn profile_run(
    dataset: &Dataset,
    plan: &Plan,
    thresholds: &Thresholds,
    rows: &EpisodeRows,
) -> RunProfile {
    let n_rows = rows.n_rows();
    let features: Vec<Option<FeatureProfile>> =
        plan.layouts.iter().map(|layout| feature_profile(layout, thresholds, rows)).collect();
    let dim = |&(f, d): &(usize, usize)| rows.column(&plan.layouts[f].name).and_then(|c| c.dims().get(d));
    let states: Vec<&Vec<f64>> = plan.states.iter().filter_map(dim).collect();
    let actions: Vec<&Vec<f64>> = plan.actions.iter().filter_map(dim).collect();
    let is_whole = states.len() == plan.states.len() && actions.len() == plan.actions.len();
    let tracking =
        if is_whole && !plan.pairs.is_empty() { track(&actions, &states, &plan.pairs) } else { None };
    let relations =
        if is_whole { relation::sample(&states, &actions, plan.relation_rows) } else { Default::default() };
    let mut findings = super::row_checks::check_rows(dataset, rows);
    let (time, time_findings) = time_profile(dataset, thresholds, rows);
    findings.extend(time_findings);
    // What moves in bursts, as a gripper, has small usual steps: its mean counts.
    let scale = |s: &Signal| s.step.max(s.mean_step);
    let scales: Vec<f64> =
        plan.states.iter().map(|&(f, d)| features[f].as_ref().map_or(0.0, |p| scale(&p.dims[d]))).collect();
    let (motion, speed) = motion_profile(&states, &actions, &scales);
    let rest_drive = plan.pairs.iter().map(|&(a, s)| rest_drive(plan, &features, &actions, a, s)).collect();
    let (content_hash, row_hashes) = hash_rows(&states, &actions, n_rows);
    let bad = bad_rows(plan, rows, n_rows);
    let (n_windows, n_good_windows) = super::windows::count(&bad, plan.window_rows);
    let mut task_indices = rows.ints("task_index").map(<[i64]>::to_vec).unwrap_or_default();
    task_indices.dedup();
    task_indices.truncate(64);
    RunProfile {
        run_index: rows.run_index,
        episode: rows.run.episode_index,
        n_rows,
        findings,
        features,
        rest_drive,
        tracking,
        relations,
        time,
        motion,
        content_hash,
        row_hashes,
        fingerprint: fingerprint(states.iter().chain(&actions), n_rows),
        aligned: [false, true].map(|from_end| {
            let columns =
                if plan.keeps_aligned { states.iter().chain(&actions) } else { [].iter().chain(&[]) };
            aligned_points(columns, n_rows, from_end)
        }),
        speed: if plan.keeps_speed { speed } else { Vec::new() },
        places: if plan.keeps_speed { places(&states, &scales) } else { Vec::new() },
        n_windows,
        n_good_windows,
        task_indices,
    }
}

fn feature_profile(
    layout: &FeatureLayout,
    thresholds: &Thresholds,
    rows: &EpisodeRows,
) -> Option<FeatureProfile> {
    let dims = rows.column(&layout.name)?.dims();
    if dims.len() != layout.width() {
        return None;
    }
    let mut signals: Vec<Signal> =
        dims.iter().zip(&layout.kinds).map(|(values, kind)| measure(values, *kind)).collect();
    if layout.purpose != Purpose::Action {
        drop_common_rests(dims, &mut signals);
    }
    let tolerance = |kind: GroupKind| match kind {
        GroupKind::Quaternion => thresholds.value.quaternion_norm,
        GroupKind::SinCos => thresholds.value.circle,
        _ => thresholds.value.orthonormal,
    };
    let rest_motion = (0..dims.len()).map(|d| rest_motion(dims, &signals, d)).collect();
    let mut equal_dims = Vec::new();
    for a in 0..dims.len() {
        for b in a + 1..dims.len() {
            let is_candidate = !signals[a].is_constant()
                && signals[a].min == signals[b].min
                && signals[a].max == signals[b].max;
            if is_candidate && dims[a] == dims[b] {
                equal_dims.push((a, b));
            }
        }
    }
    Some(FeatureProfile {
        groups: measure_groups(layout, dims, tolerance),
        dims: signals,
        rest_motion,
        equal_dims,
    })
}

/// Takes back plateaus in which another dim that moves elsewhere rests as well: a thing that was put down.
fn drop_common_rests(dims: &[Vec<f64>], signals: &mut [Signal]) {
    for d in 0..dims.len() {
        let Some(clipped) = signals[d].clipped else { continue };
        let rows = clipped.first.start..clipped.first.end();
        let rests = |other: usize| {
            other != d
                && !signals[other].is_constant()
                && signals[other].rest_share < 0.9
                && dims[other][rows.clone()].windows(2).all(|w| w[0] == w[1])
        };
        if (0..dims.len()).any(rests) {
            signals[d].clipped = None;
        }
    }
}

/// Returns how much the other dims move in the longest rest of dim `d`, relative to their usual motion.
fn rest_motion(dims: &[Vec<f64>], signals: &[Signal], d: usize) -> f64 {
    let rest = signals[d].longest_rest;
    if rest.n_rows < 4 || signals[d].is_constant() {
        return 0.0;
    }
    let path = |values: &[f64]| {
        values.windows(2).map(|w| (w[1] - w[0]).abs()).filter(|v| v.is_finite()).sum::<f64>()
    };
    let mut ratios = Vec::new();
    for (other, values) in dims.iter().enumerate() {
        if other == d || signals[other].is_constant() || signals[other].n_finite < 4 {
            continue;
        }
        let usual = path(values) / (values.len() - 1) as f64;
        let here = path(&values[rest.start..rest.end()]) / (rest.n_rows - 1) as f64;
        if usual > 0.0 {
            ratios.push(here / usual);
        }
    }
    super::robust::median(&ratios).max(0.0)
}

/// Returns the range of action `a` in the longest rest of its state `s`, relative to its range in the run.
fn rest_drive(
    plan: &Plan,
    features: &[Option<FeatureProfile>],
    actions: &[&Vec<f64>],
    a: usize,
    s: usize,
) -> f64 {
    let (feature, dim) = plan.states[s];
    let (Some(profile), Some(action)) = (&features[feature], actions.get(a)) else { return 0.0 };
    share_of_range(action, profile.dims[dim].longest_rest)
}

/// Hashes states and actions: all rows together, and a fixed share of the single rows.
fn hash_rows(states: &[&Vec<f64>], actions: &[&Vec<f64>], n_rows: usize) -> ([u8; 16], Vec<u64>) {
    let columns: Vec<&[f64]> = states.iter().chain(actions).map(|c| c.as_slice()).collect();
    let mut whole = blake3::Hasher::new();
    let mut kept = Vec::new();
    let mut hashes = vec![0x9e37_79b9_7f4a_7c15u64; n_rows];
    for column in &columns {
        for (hash, value) in hashes.iter_mut().zip(*column) {
            *hash = (hash.rotate_left(23) ^ value.to_bits()).wrapping_mul(0x9fb2_1c65_1e98_df25);
        }
    }
    let mut last = 0;
    for hash in hashes {
        let mixed = hash ^ (hash >> 29);
        whole.update(&mixed.to_le_bytes());
        if mixed != last && mixed % KEPT_ROW_HASHES == 0 {
            kept.push(mixed);
        }
        last = mixed;
    }
    kept.sort_unstable();
    kept.dedup();
    let mut short = [0; 16];
    short.copy_from_slice(&whole.finalize().as_bytes()[..16]);
    (short, if columns.is_empty() { Vec::new() } else { kept })
}

/// Returns the trajectory at evenly spaced rows, [dim, point].
fn fingerprint<'a>(columns: impl Iterator<Item = &'a &'a Vec<f64>>, n_rows: usize) -> Vec<f32> {
    if n_rows == 0 {
        return Vec::new();
    }
    let row = |point: usize| point * (n_rows - 1) / (FINGERPRINT_POINTS - 1);
    columns.flat_map(|c| (0..FINGERPRINT_POINTS).map(|p| c[row(p)] as f32)).collect()
}

/// Returns the trajectory at every sixteenth row from the begin or the end, [dim, point]; NaN beyond the episode.
fn aligned_points<'a>(
    columns: impl Iterator<Item = &'a &'a Vec<f64>>,
    n_rows: usize,
    from_end: bool,
) -> Vec<f32> {
    let at = |column: &[f64], point: usize| {
        let row = point * ALIGNED_ROWS;
        let row = if from_end { (n_rows).checked_sub(row + 1) } else { Some(row) };
        row.and_then(|r| column.get(r)).map_or(f32::NAN, |v| *v as f32)
    };
    columns.flat_map(|c| (0..FINGERPRINT_POINTS).map(move |p| at(c, p))).collect()
}

/// Returns which rows no training window may touch.
fn bad_rows(plan: &Plan, rows: &EpisodeRows, n_rows: usize) -> Vec<bool> {
    let mut bad = vec![false; n_rows];
    let used = plan.layouts.iter().filter(|l| matches!(l.purpose, Purpose::State | Purpose::Action));
    for column in used.filter_map(|l| rows.column(&l.name)) {
        for values in column.dims() {
            for (flag, value) in bad.iter_mut().zip(values) {
                *flag |= !value.is_finite();
            }
        }
    }
    for column in plan.validity.iter().filter_map(|name| rows.column(name)) {
        // The action of the last row of an episode is invalid by design; the row still ends a window.
        let n = if column.name.contains("action") { n_rows.saturating_sub(1) } else { n_rows };
        for values in column.dims() {
            for (flag, value) in bad.iter_mut().zip(&values[..n]) {
                *flag |= *value == 0.0;
            }
        }
    }
    bad
}
