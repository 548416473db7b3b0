//! Rotations and points on the circle: groups of dims with a constraint, declared or recognised by it.

use super::{
    layout::{FeatureLayout, Group, GroupKind},
    robust::quantile,
    signal::Stretch,
};

/// How close to its constraint a row must be to speak for a group.
const RECOGNISED: f64 = 0.02;
/// Rows looked at to recognise groups.
const SAMPLE_ROWS: usize = 256;

/// A possible group in one run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct GroupMeasure {
    pub(super) group: Group,
    /// Share of sampled rows that keep the constraint.
    pub(super) kept_share: f64,
    /// Median violation.
    pub(super) median: f64,
    /// Largest violation, and where.
    pub(super) worst: f64,
    pub(super) worst_row: usize,
    /// 99th percentile of the violation.
    pub(super) high: f64,
    /// Sign flips of a quaternion, and the row of the first.
    pub(super) n_flips: usize,
    pub(super) first_flip: usize,
    /// Whether at least two components move.
    pub(super) is_moving: bool,
    /// First stretch of rows that violate the constraint clearly.
    pub(super) stretch: Stretch,
}

/// Measures all declared groups, and windows of dims that look like one.
pub(super) fn measure_groups(
    layout: &FeatureLayout,
    dims: &[Vec<f64>],
    tolerance: impl Fn(GroupKind) -> f64,
) -> Vec<GroupMeasure> {
    let mut found = Vec::new();
    let kinds = [GroupKind::Quaternion, GroupKind::SinCos, GroupKind::SixD];
    for kind in kinds {
        for start in 0..(layout.width() + 1).saturating_sub(kind.width()) {
            let group = Group { kind, start };
            let is_declared = layout.groups.contains(&group);
            let is_taken = layout
                .groups
                .iter()
                .any(|g| g.start < start + kind.width() && start < g.start + g.kind.width());
            if is_declared || !is_taken {
                found.extend(measure_group(group, dims, is_declared, tolerance(kind)));
            }
        }
    }
    for group in layout.groups.iter().filter(|g| g.kind == GroupKind::Matrix) {
        found.extend(measure_group(*group, dims, true, tolerance(GroupKind::Matrix)));
    }
    found
}

fn measure_group(group: Group, dims: &[Vec<f64>], is_declared: bool, tolerance: f64) -> Option<GroupMeasure> {
    let parts = &dims[group.start..group.start + group.kind.width()];
    let n = parts[0].len();
    if n == 0 {
        return None;
    }
    let stride = n.div_ceil(SAMPLE_ROWS).max(1);
    let sample: Vec<f64> = (0..n).step_by(stride).map(|t| violation(group.kind, parts, t)).collect();
    let kept = sample.iter().filter(|v| **v <= RECOGNISED).count();
    let kept_share = kept as f64 / sample.len() as f64;
    // Far from any constraint: still kept, since other runs may say that it is a group.
    let mut measure = GroupMeasure {
        group,
        kept_share,
        median: quantile(&sample, 0.5),
        worst: sample.iter().copied().fold(0.0, f64::max),
        worst_row: 0,
        high: quantile(&sample, 0.99),
        n_flips: 0,
        first_flip: 0,
        is_moving: parts.iter().filter(|p| varies(p)).count() >= 2,
        stretch: Stretch { start: 0, n_rows: n },
    };
    if !is_declared && kept_share < 0.3 {
        return Some(measure);
    }
    measure.worst = 0.0;
    let mut stretch: Option<Stretch> = None;
    for t in 0..n {
        let v = violation(group.kind, parts, t);
        if v > measure.worst {
            (measure.worst, measure.worst_row) = (v, t);
        }
        if v > tolerance {
            match &mut stretch {
                None => stretch = Some(Stretch { start: t, n_rows: 1 }),
                Some(s) if s.end() == t => s.n_rows += 1,
                Some(_) => {}
            }
        }
    }
    measure.stretch = stretch.unwrap_or_default();
    if group.kind == GroupKind::Quaternion {
        for t in 1..n {
            let dot: f64 = parts.iter().map(|p| p[t] * p[t - 1]).sum();
            if dot < -0.5 {
                measure.n_flips += 1;
                if measure.n_flips == 1 {
                    measure.first_flip = t;
                }
            }
        }
    }
    Some(measure)
}

fn varies(values: &[f64]) -> bool {
    let (min, max) =
        values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(*v), b.max(*v)));
    max - min > 1e-3
}

/// Returns how far row `t` is from the group's constraint; infinite for values that are not finite.
fn violation(kind: GroupKind, parts: &[Vec<f64>], t: usize) -> f64 {
    let dot =
        |a: usize, b: usize, n: usize| -> f64 { (0..n).map(|k| parts[a + k][t] * parts[b + k][t]).sum() };
    let value = match kind {
        GroupKind::Quaternion => dot(0, 0, 4).sqrt() - 1.0,
        GroupKind::SinCos => dot(0, 0, 2) - 1.0,
        GroupKind::SixD => {
            let worst = (dot(0, 0, 3) - 1.0).abs().max((dot(3, 3, 3) - 1.0).abs());
            worst.max(dot(0, 3, 3).abs())
        }
        GroupKind::Matrix => {
            let mut worst: f64 = 0.0;
            for (a, b) in [(0, 0), (3, 3), (6, 6), (0, 3), (0, 6), (3, 6)] {
                worst = worst.max((dot(a, b, 3) - f64::from(u8::from(a == b))).abs());
            }
            worst
        }
    };
    if value.is_finite() { value.abs() } else { 0.0 }
}
