//! Signals that do not move: constant in the dataset (VALUE-002), in an episode (SEMANTIC-004), stuck (VALUE-003).

use super::{
    Finding, Severity,
    layout::{DimKind, Purpose},
    profile::RunProfile,
    robust::quantile,
    value::Judge,
};

impl Judge<'_> {
    /// Names a dim that never changes in the whole dataset.
    pub(super) fn constant_everywhere(&self, dim: usize, findings: &mut Vec<Finding>) {
        let levels: Vec<f64> =
            self.signals(dim).filter(|(_, s)| s.n_finite > 0).map(|(_, s)| s.min).collect();
        let Some(first) = levels.first() else { return };
        if levels.iter().all(|l| l == first) {
            let is_target = self.plan.layouts[self.feature].purpose == Purpose::Action;
            let what = if is_target { "the action" } else { "the value" };
            let mut message = format!("{what} is {first} in every row of the dataset");
            // A command may be held for good; a sensor that stays while it is commanded to move is broken.
            let is_moving = !is_target && self.has_moving_partner(dim);
            if is_moving {
                message += ", while its action moves: was it connected?";
            }
            let finding = self.finding("VALUE-002", dim, message);
            findings.push(if is_moving { finding.at(Severity::Warning) } else { finding });
        }
    }

    /// Returns whether the action of a state moves in most episodes.
    fn has_moving_partner(&self, dim: usize) -> bool {
        let here = (self.feature, dim);
        let own = self.plan.pairs.iter().filter(|(_, s)| self.plan.states[*s] == here);
        let mut partners = own.map(|(a, _)| self.plan.actions[*a]);
        partners.any(|(feature, other)| {
            let moves = |run: &RunProfile| {
                let signal = run.features[feature].as_ref().map(|p| &p.dims[other]);
                signal.is_some_and(|s| s.n_finite > 1 && !s.is_constant())
            };
            2 * self.profiles.iter().filter(|(run, _)| moves(run)).count() > self.profiles.len()
        })
    }

    /// Finds episodes in which a dim that moves elsewhere stays.
    pub(super) fn constant_here(&self, dim: usize, moving: usize, findings: &mut Vec<Finding>) {
        let n_runs = self.profiles.len();
        if n_runs < 3 || (moving as f64) < 0.65 * n_runs as f64 {
            return;
        }
        // A joint that hardly moves elsewhere may rest for one episode.
        let rest = self.typical(dim, |s| s.rest_share);
        if rest > 0.5 {
            return;
        }
        for (run, signal) in self.signals(dim).filter(|(run, s)| s.is_constant() && run.n_rows >= 10) {
            let message = format!(
                "the value is {} in all {} rows; it moves in {moving} of {n_runs} episodes",
                signal.min, run.n_rows
            );
            let finding = self.finding("SEMANTIC-004", dim, message).episode(run.episode).rows(0, run.n_rows);
            let is_at_zero =
                signal.min == 0.0 && self.rests_at_zero(dim) || self.is_end_elsewhere(dim, signal.min);
            findings.push(if is_at_zero { finding.at(Severity::Info) } else { finding });
        }
    }

    /// Returns whether two other episodes or more end exactly at `level`: a wall, or where the robot starts.
    fn is_end_elsewhere(&self, dim: usize, level: f64) -> bool {
        let moving = self.signals(dim).filter(|(_, s)| !s.is_constant());
        moving.filter(|(_, s)| s.min == level || s.max == level).count() >= 2
    }

    /// Returns whether the dim is never negative and comes near zero in most episodes, as a force without contact does.
    fn rests_at_zero(&self, dim: usize) -> bool {
        let moving = || self.signals(dim).filter(|(_, s)| !s.is_constant());
        let highest = moving().map(|(_, s)| s.max).fold(0.0, f64::max);
        let n_zero = moving().filter(|(_, s)| s.min <= 0.01 * highest).count();
        2 * n_zero > moving().count() && self.signals(dim).all(|(_, s)| s.n_finite == 0 || s.min >= 0.0)
    }

    /// Finds exactly constant stretches while the robot moves.
    pub(super) fn stuck(&self, dim: usize, kind: DimKind) -> Vec<Finding> {
        let mut findings = Vec::new();
        let bounds = &self.thresholds.value;
        if matches!(kind, DimKind::Bool | DimKind::Gripper) {
            return findings;
        }
        // A policy may hold a command; a sensor that holds a value is broken.
        let is_action = self.plan.layouts[self.feature].purpose == Purpose::Action;
        let ratio = if is_action { 2.0 * bounds.stuck_ratio } else { bounds.stuck_ratio };
        let shortest = (bounds.stuck_secs * self.fps).max(bounds.stuck_rows);
        let rests: Vec<f64> = self
            .signals(dim)
            .filter(|(_, s)| !s.is_constant())
            .map(|(_, s)| s.longest_rest.n_rows as f64)
            .collect();
        let pair = self.plan.pairs.iter().position(|(_, s)| self.plan.states[*s] == (self.feature, dim));
        for (run, profile) in self.profiles {
            let signal = &profile.dims[dim];
            let rest = signal.longest_rest;
            if signal.is_constant() || (rest.n_rows as f64) < shortest {
                continue;
            }
            let elsewhere = match rests.as_slice() {
                [] | [_] => 0.0,
                [a, b] => a.min(*b),
                all => quantile(all, 0.5),
            };
            let usual = elsewhere.max(signal.second_rest as f64);
            let others_move = profile.rest_motion[dim] > 0.3;
            let is_driven = pair.is_some_and(|p| run.rest_drive[p] > 0.1);
            let outside =
                1.0 - (1.0 - signal.rest_share) * run.n_rows as f64 / (run.n_rows - rest.n_rows + 1) as f64;
            let is_unusual = rest.n_rows as f64 > ratio * usual && outside < 0.5;
            let is_single = self.plan.layouts[self.feature].width() == 1;
            // What rests until it is first touched is no sensor that stops.
            let is_waiting = rest.start == 0 && !is_driven;
            if is_unusual && !is_waiting && (others_move || is_driven || is_single) {
                let mut message = format!(
                    "the value stays exactly {:.6} for {} rows; it usually rests for {usual:.0}",
                    signal.rest_level, rest.n_rows
                );
                message += if is_driven {
                    ", and its action moves meanwhile"
                } else {
                    ", and the other dims move meanwhile"
                };
                let finding =
                    self.finding("VALUE-003", dim, message).episode(run.episode).rows(rest.start, rest.end());
                let finding = finding.measured(rest.n_rows as f64, ratio * usual);
                let is_at_rest = signal.rest_level == 0.0 && self.rests_at_zero(dim)
                    || self.is_end_elsewhere(dim, signal.rest_level);
                findings.push(if is_at_rest { finding.at(Severity::Info) } else { finding });
            }
        }
        findings
    }
}
