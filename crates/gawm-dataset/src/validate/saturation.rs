//! VALUE-004: signals that are cut off at a level.
//!
//! What it means depends on the signal. A command may stand at its limit: that is what limits are for, and worth a note. A
//! level that several episodes share is a wall, a joint's end or a sensor's range: one finding for all of them, a warning
//! where it holds much of the data. A level of a single episode, in a range that the others pass, is that episode's defect.

use super::{
    Finding, Severity,
    layout::{DimKind, Purpose},
    profile::RunProfile,
    signal::Clipping,
    value::Judge,
};

/// Fewest episodes that make a level common.
const COMMON_RUNS: usize = 3;
/// Share of the rows at a declared limit above which even a command says little.
const MOSTLY: f64 = 0.5;

/// One run that is cut off.
type Cut<'a> = (&'a RunProfile, Clipping);

/// Judges the plateaus of one dim in all runs.
pub(super) fn judge(judge: &Judge, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
    let least = judge.thresholds.value.saturated_share;
    if matches!(kind, DimKind::Bool | DimKind::Gripper | DimKind::Rotation) {
        return;
    }
    let is_cut = |run: &RunProfile, c: &Clipping| {
        c.n_rows as f64 >= least * run.n_rows as f64 && (c.n_plateaus >= 2 || c.n_rows >= 5)
    };
    let cuts: Vec<Cut> = judge
        .signals(dim)
        .filter_map(|(run, s)| s.clipped.filter(|c| is_cut(run, c)).map(|c| (run, c)))
        .collect();
    let (common, single): (Vec<Cut>, Vec<Cut>) = cuts
        .iter()
        .copied()
        .partition(|(_, c)| is_limit(judge, dim, c.level) || n_at(judge, dim, c.level) >= COMMON_RUNS);
    findings.extend(shared(judge, dim, &common));
    findings.extend(single.iter().map(|cut| alone(judge, dim, cut)));
}

/// Returns whether commands of this dim are driven to their limits in several episodes.
pub(super) fn is_bang_bang(judge: &Judge, dim: usize) -> bool {
    let is_action = judge.plan.layouts[judge.feature].purpose == Purpose::Action;
    let n_cut = judge.signals(dim).filter(|(_, s)| s.clipped.is_some()).count();
    is_action && n_cut >= COMMON_RUNS && 4 * n_cut >= judge.profiles.len()
}

fn is_action(judge: &Judge) -> bool {
    judge.plan.layouts[judge.feature].purpose == Purpose::Action
}

/// Returns whether `level` is a limit of commands: declared, or the end of the interval from -1 to 1.
fn is_limit(judge: &Judge, dim: usize, level: f64) -> bool {
    let ends = judge.plan.layouts[judge.feature].limits[dim].unwrap_or([-1.0, 1.0]);
    let slack = 1e-3 * (ends[1] - ends[0]).abs();
    is_action(judge) && ends.iter().any(|end| (level - end).abs() <= slack)
}

/// Returns how many episodes end at `level`.
fn n_at(judge: &Judge, dim: usize, level: f64) -> usize {
    let is_near = |end: f64| (end - level).abs() <= 1e-6 * level.abs().max(1e-6);
    judge.signals(dim).filter(|(_, s)| s.n_finite > 0 && (is_near(s.min) || is_near(s.max))).count()
}

/// Returns one finding for all runs that are cut off at common levels.
fn shared(judge: &Judge, dim: usize, cuts: &[Cut]) -> Option<Finding> {
    let bounds = &judge.thresholds.value;
    let worst = cuts.iter().max_by(|a, b| {
        let share = |(run, c): &Cut| c.n_rows as f64 / run.n_rows as f64;
        share(a).total_cmp(&share(b)).then(b.0.episode.cmp(&a.0.episode))
    })?;
    let mut levels: Vec<f64> = cuts.iter().map(|(_, c)| c.level).collect();
    levels.sort_by(f64::total_cmp);
    levels.dedup_by(|a, b| (*a - *b).abs() <= 1e-6 * b.abs().max(1e-6));
    let n_rows: usize = judge.profiles.iter().map(|(run, _)| run.n_rows).sum();
    let share = cuts.iter().map(|(_, c)| c.n_rows).sum::<usize>() as f64 / n_rows.max(1) as f64;
    let is_legal = cuts.iter().all(|(_, c)| is_limit(judge, dim, c.level));
    let (what, bound) = match (is_legal, is_action(judge)) {
        (true, _) => ("the command stands at its limit", MOSTLY),
        (_, true) => ("the command is cut off", bounds.saturated_action_share),
        _ => ("the value is cut off", bounds.saturated_share),
    };
    let shown: Vec<String> = levels.iter().take(4).map(|l| format!("{l:.6}")).collect();
    let message = format!(
        "{what} at {}{} in {:.1} % of all rows, in {} of {} episodes; most in episode {}",
        shown.join(" and "),
        if levels.len() > shown.len() { " and other levels" } else { "" },
        100.0 * share,
        cuts.len(),
        judge.profiles.len(),
        worst.0.episode
    );
    let finding = judge.finding("VALUE-004", dim, message).measured(share, bound);
    let finding = finding.episodes(cuts.iter().map(|(run, _)| run.episode).collect());
    Some(if share >= bound { finding } else { finding.at(Severity::Info) })
}

/// Returns the finding of a run that is cut off at a level of its own.
fn alone(judge: &Judge, dim: usize, (run, clipped): &Cut) -> Finding {
    let bounds = &judge.thresholds.value;
    let bound = if is_action(judge) { bounds.saturated_action_share } else { bounds.saturated_share };
    let share = clipped.n_rows as f64 / run.n_rows as f64;
    let message = format!(
        "the value is cut off at {:.6} in {} rows ({:.1} %), {} plateaus reached at speed",
        clipped.level,
        clipped.n_rows,
        100.0 * share,
        clipped.n_plateaus
    );
    let finding = judge.finding("VALUE-004", dim, message).episode(run.episode);
    let finding = finding.rows(clipped.first.start, clipped.first.end()).measured(share, bound);
    if share >= bound { finding } else { finding.at(Severity::Info) }
}
