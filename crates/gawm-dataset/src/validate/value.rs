//! Rules of group VALUE: each signal against itself in the other episodes.

use std::f64::consts::TAU;

use super::{
    Finding, Severity, Thresholds,
    group::GroupMeasure,
    layout::{DimKind, Group, GroupKind, Purpose},
    profile::{FeatureProfile, Plan, RunProfile},
    robust::{centre_and_scale, median},
    rotations, saturation,
    signal::{NOISE_ROWS, Signal},
};

/// Fewest runs whose comparison says something about one of them.
const MIN_RUNS: usize = 4;
/// Share of the largest range among dims of one unit below which a dim is at rest.
const IDLE_SHARE: f64 = 0.05;
/// Rows at the begin of an episode in which controllers settle: only large jumps count there.
const SETTLING_ROWS: usize = 8;
/// What at least this many episodes and this share of all show is their nature.
const USUAL_RUNS: usize = 6;
const USUAL_SHARE: f64 = 0.25;
/// Share of rows that repeat the value before, of a signal that hardly ever does elsewhere.
const COARSE_SHARE: f64 = 0.2;
/// Share of runs in which a group of dims must keep its constraint to be recognised.
const RECOGNISED_RUNS: f64 = 0.6;

/// Judges all numbers of all runs.
pub(super) fn judge(plan: &Plan, thresholds: &Thresholds, fps: f64, runs: &[RunProfile]) -> Vec<Finding> {
    let mut findings = Vec::new();
    for (feature, layout) in plan.layouts.iter().enumerate() {
        let profiles: Vec<(&RunProfile, &FeatureProfile)> =
            runs.iter().filter_map(|run| run.features[feature].as_ref().map(|p| (run, p))).collect();
        if profiles.is_empty() {
            continue;
        }
        let mut judge = Judge { plan, thresholds, fps, feature, profiles: &profiles, ranges: Vec::new() };
        judge.ranges = (0..layout.width()).map(|dim| judge.typical(dim, Signal::range)).collect();
        let groups = judge.groups(&mut findings);
        // Derived columns repeat what is said of the raw ones.
        if layout.purpose == Purpose::Encoded {
            continue;
        }
        for dim in 0..layout.width() {
            let kind = groups
                .iter()
                .find(|g| (g.start..g.start + g.kind.width()).contains(&dim))
                .map(|_| DimKind::Rotation);
            judge.dim(dim, kind.unwrap_or(layout.kinds[dim]), &mut findings);
        }
        judge.equal_dims(&mut findings);
        judge.scales(&mut findings);
    }
    findings
}

pub(super) struct Judge<'a> {
    pub(super) plan: &'a Plan,
    pub(super) thresholds: &'a Thresholds,
    pub(super) fps: f64,
    pub(super) feature: usize,
    pub(super) profiles: &'a [(&'a RunProfile, &'a FeatureProfile)],
    /// Typical range of each dim.
    ranges: Vec<f64>,
}

impl Judge<'_> {
    pub(super) fn finding(&self, code: &'static str, dim: usize, message: String) -> Finding {
        let layout = &self.plan.layouts[self.feature];
        Finding::new(code, message).feature(&layout.name).dim(&layout.names[dim])
    }

    pub(super) fn signals(&self, dim: usize) -> impl Iterator<Item = (&RunProfile, &Signal)> {
        self.profiles.iter().map(move |(run, profile)| (*run, &profile.dims[dim]))
    }

    /// Returns a robust typical value of a measure over the runs in which the dim moves.
    pub(super) fn typical(&self, dim: usize, measure: impl Fn(&Signal) -> f64) -> f64 {
        let values: Vec<f64> =
            self.signals(dim).filter(|(_, s)| !s.is_constant()).map(|(_, s)| measure(s)).collect();
        median(&values)
    }

    /// Returns whether the dim hardly moves beside others of its unit: what it shows is the noise of a joint at rest.
    fn is_idle(&self, dim: usize) -> bool {
        let layout = &self.plan.layouts[self.feature];
        let peers = (0..layout.width()).filter(|d| layout.units[*d] == layout.units[dim]);
        let largest = peers.map(|d| self.ranges[d]).filter(|r| r.is_finite()).fold(0.0, f64::max);
        self.ranges[dim] < IDLE_SHARE * largest
    }

    fn dim(&self, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
        let moving = self.signals(dim).filter(|(_, s)| s.n_finite > 1 && !s.is_constant()).count();
        if moving == 0 {
            self.constant_everywhere(dim, findings);
        } else {
            self.constant_here(dim, moving, findings);
            findings.extend(self.unless_usual(self.stuck(dim, kind)));
            saturation::judge(self, dim, kind, findings);
            if !self.is_idle(dim) {
                findings.extend(self.unless_usual(self.jumps(dim, kind)));
                self.zero_drops(dim, kind, findings);
                self.noisy(dim, kind, findings);
                findings.extend(self.unless_usual(self.coarse(dim, kind)));
            }
            self.wraps(dim, kind, findings);
            self.offset(dim, kind, findings);
        }
        self.degrees(dim, findings);
        self.limits(dim, findings);
        if kind == DimKind::Bool {
            for (run, signal) in self.signals(dim).filter(|(_, s)| s.n_not_bool > 0) {
                let message = format!(
                    "{} values are neither 0 nor 1, between {} and {}",
                    signal.n_not_bool, signal.min, signal.max
                );
                findings.push(
                    self.finding("VALUE-014", dim, message)
                        .episode(run.episode)
                        .measured(signal.n_not_bool as f64, 0.0),
                );
            }
        }
    }

    /// Makes one note of findings that many episodes share: what is usual is the nature of the data.
    fn unless_usual(&self, found: Vec<Finding>) -> Vec<Finding> {
        let is_usual =
            found.len() >= USUAL_RUNS && found.len() as f64 >= USUAL_SHARE * self.profiles.len() as f64;
        if is_usual { self.as_note(found) } else { found }
    }

    fn as_note(&self, mut found: Vec<Finding>) -> Vec<Finding> {
        let n_runs = self.profiles.len();
        let size = |f: &Finding| f.measured.unwrap_or(0.0);
        let Some(worst) = found.iter().max_by(|a, b| size(a).total_cmp(&size(b))).cloned() else {
            return found;
        };
        let episodes = found.drain(..).filter_map(|f| f.episode).collect::<Vec<_>>();
        let message = format!(
            "in {} of {n_runs} episodes, so by nature; most in episode {}: {}",
            episodes.len(),
            worst.episode.unwrap_or(-1),
            worst.message
        );
        let note = Finding { episode: None, rows: None, message, ..worst };
        vec![note.at(Severity::Info).episodes(episodes)]
    }

    fn jumps(&self, dim: usize, kind: DimKind) -> Vec<Finding> {
        let mut findings = Vec::new();
        let bounds = &self.thresholds.value;
        let is_stepped =
            matches!(kind, DimKind::Bool | DimKind::Gripper) || saturation::is_bang_bang(self, dim);
        if is_stepped || self.typical(dim, |s| s.rest_share) > 0.9 {
            return findings;
        }
        let usual = self.typical(dim, |s| s.rough99);
        let range = self.ranges[dim];
        let floor = (bounds.jump_ratio * usual).max(bounds.jump_range_share * range);
        if usual <= 0.0 || floor <= 0.0 {
            return findings;
        }
        let n_rows: usize = self.profiles.iter().map(|(run, _)| run.n_rows).sum();
        let counts: Vec<usize> =
            self.signals(dim).map(|(_, s)| s.jumps.iter().filter(|j| j.size > floor).count()).collect();
        let n_jumping = counts.iter().filter(|c| **c > 0).count();
        // A signal that jumps everywhere is made of steps: set points, not measurements.
        let is_stepping = counts.iter().sum::<usize>() as f64 > 0.005 * n_rows as f64
            || (counts.len() >= MIN_RUNS
                && n_jumping * 2 > counts.len()
                && counts.iter().sum::<usize>() > 3 * counts.len());
        if is_stepping {
            return findings;
        }
        for (run, signal) in self.signals(dim) {
            if kind == DimKind::Rotation && self.has_flips(run, dim) {
                continue;
            }
            // All dims jump where rows are missing: that is said once.
            let most = self.thresholds.time.squeezed_steps;
            let is_squeezed =
                |row: usize| run.motion.squeezed.iter().any(|s| s.row == row && s.is_event(most));
            let mut jumps: Vec<_> = signal
                .jumps
                .iter()
                .filter(|j| j.size > floor && !signal.zero_drops.contains(&j.row))
                .filter(|j| !is_squeezed(j.row))
                // Of the last step nothing tells whether it goes on.
                .filter(|j| (j.row > SETTLING_ROWS && j.row + 1 < run.n_rows) || j.size > 0.5 * range)
                .collect();
            jumps.sort_by_key(|j| j.row);
            let Some(first) = jumps.first() else { continue };
            let worst = jumps.iter().map(|j| j.size).fold(0.0, f64::max);
            let message = format!(
                "{} jumps of up to {worst:.6}, {:.0} times the usual unsteadiness",
                jumps.len(),
                worst / usual
            );
            let finding =
                self.finding("VALUE-005", dim, message).episode(run.episode).rows(first.row, first.row + 1);
            findings.push(finding.measured(worst / usual, floor / usual));
        }
        findings
    }

    fn zero_drops(&self, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
        if matches!(kind, DimKind::Bool | DimKind::Gripper) || self.typical(dim, |s| s.rest_share) > 0.9 {
            return;
        }
        for (run, signal) in self.signals(dim) {
            if let Some(first) = signal.zero_drops.first() {
                let message = format!(
                    "the value is exactly 0 in {} single places between values near {:.4}",
                    signal.zero_drops.len(),
                    signal.median
                );
                let finding =
                    self.finding("VALUE-018", dim, message).episode(run.episode).rows(*first, first + 1);
                findings.push(finding.measured(signal.zero_drops.len() as f64, 0.0));
            }
        }
    }

    fn has_flips(&self, run: &RunProfile, dim: usize) -> bool {
        let profile = run.features[self.feature].as_ref();
        let holds = |g: &&GroupMeasure| (g.group.start..g.group.start + g.group.kind.width()).contains(&dim);
        profile.is_some_and(|p| p.groups.iter().filter(holds).any(|g| g.n_flips > 0))
    }

    fn noisy(&self, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
        // Controllers settle at the begin of episodes: that several do so is one thing to say.
        let at_start = |f: &Finding| f.rows.is_some_and(|r| r[0] == 0);
        let (start, rest): (Vec<Finding>, Vec<Finding>) =
            self.noise(dim, kind).into_iter().partition(at_start);
        let usual_start = start.len() >= USUAL_RUNS;
        let start = if usual_start { self.as_note(start) } else { start };
        if usual_start {
            findings.extend(start);
            findings.extend(self.unless_usual(rest));
        } else {
            findings.extend(self.unless_usual(start.into_iter().chain(rest).collect()));
        }
    }

    fn noise(&self, dim: usize, kind: DimKind) -> Vec<Finding> {
        let mut findings = Vec::new();
        let bounds = &self.thresholds.value;
        if matches!(kind, DimKind::Bool | DimKind::Gripper) || self.typical(dim, |s| s.rest_share) > 0.5 {
            return findings;
        }
        let usual = self.typical(dim, |s| s.noise90);
        let step = self.typical(dim, |s| s.step);
        let others = self.typical(dim, |s| s.rough50);
        for (run, signal) in self.signals(dim).filter(|(_, s)| !s.is_constant()) {
            let Some((window, level)) = signal.noisiest else { continue };
            let whole = signal.rough50;
            if self.profiles.len() >= MIN_RUNS
                && whole > 1.4 * bounds.noise_ratio * others
                && whole > 0.1 * step
                && others > 0.0
            {
                let message =
                    format!("the signal is {:.0} times as unsteady as in the other episodes", whole / others);
                let finding =
                    self.finding("VALUE-015", dim, message).episode(run.episode).rows(0, run.n_rows);
                findings.push(finding.measured(whole / others, bounds.noise_ratio));
                continue;
            }
            if level > bounds.noise_ratio * usual && level > 0.3 * step && usual > 0.0 {
                let message = format!(
                    "{NOISE_ROWS} rows are {:.0} times noisier than the noisiest tenth elsewhere",
                    level / usual
                );
                let finding = self
                    .finding("VALUE-015", dim, message)
                    .episode(run.episode)
                    .rows(window.start, window.end());
                findings.push(finding.measured(level / usual, bounds.noise_ratio));
            }
        }
        findings
    }

    /// Finds episodes in which a signal that always moves stays for several rows again and again.
    fn coarse(&self, dim: usize, kind: DimKind) -> Vec<Finding> {
        let mut findings = Vec::new();
        let usual = self.typical(dim, |s| s.rest_share);
        if self.profiles.len() < MIN_RUNS || usual > 0.03 || matches!(kind, DimKind::Bool | DimKind::Gripper)
        {
            return findings;
        }
        let spread = self.typical(dim, |s| s.spread);
        for (run, signal) in self.signals(dim) {
            // What is cut off at a level is said elsewhere.
            if signal.is_constant() || signal.clipped.is_some() || signal.spread <= 0.3 * spread {
                continue;
            }
            let rest = signal.longest_rest.n_rows as f64;
            let n = run.n_rows as f64;
            // A single long rest is another matter.
            let share = (signal.rest_share * (n - 1.0) - (rest - 1.0)) / (n - rest).max(1.0);
            if share > COARSE_SHARE && run.n_rows >= 20 {
                let message = format!(
                    "{:.0} % of the rows repeat the value before, in the other episodes {:.0} %: a coarse or slow sensor",
                    100.0 * share,
                    100.0 * usual
                );
                let finding =
                    self.finding("VALUE-019", dim, message).episode(run.episode).rows(0, run.n_rows);
                findings.push(finding.measured(share, COARSE_SHARE));
            }
        }
        findings
    }

    fn wraps(&self, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
        if matches!(kind, DimKind::Wrapped { .. } | DimKind::Rotation | DimKind::Bool | DimKind::Gripper)
            || self.typical(dim, |s| s.rest_share) > 0.9
        {
            return;
        }
        for (run, signal) in self.signals(dim) {
            let Some(first) = signal.first_wrap else { continue };
            let message = format!("the value wraps by {:.4} in {} rows", signal.wrap_period, signal.n_wraps);
            let finding = self.finding("VALUE-007", dim, message).episode(run.episode).rows(first, first + 1);
            findings.push(finding.measured(signal.n_wraps as f64, 0.0));
        }
    }

    fn degrees(&self, dim: usize, findings: &mut Vec<Finding>) {
        let layout = &self.plan.layouts[self.feature];
        if !layout.is_radian(dim) {
            return;
        }
        for (run, signal) in self.signals(dim) {
            // A wheel turns one way without end; a joint in degrees goes back and forth.
            let is_wheel = signal.one_way > 0.8 && signal.range() > 2.0 * TAU && signal.step < 0.5;
            if signal.share_beyond_tau >= self.thresholds.value.degrees_share && !is_wheel {
                let share = 100.0 * signal.share_beyond_tau;
                let message = format!(
                    "{share:.0} % of the values lie beyond 2 pi, up to {:.2}, under the label radian",
                    signal.max.abs().max(signal.min.abs())
                );
                let finding =
                    self.finding("VALUE-006", dim, message).episode(run.episode).rows(0, run.n_rows);
                findings.push(finding.measured(signal.share_beyond_tau, self.thresholds.value.degrees_share));
            }
        }
    }

    fn limits(&self, dim: usize, findings: &mut Vec<Finding>) {
        let Some([low, high]) = self.plan.layouts[self.feature].limits[dim] else { return };
        let slack = self.thresholds.value.limit_slack * (high - low);
        for (run, signal) in self.signals(dim).filter(|(_, s)| s.n_finite > 0) {
            let beyond = (low - signal.min).max(signal.max - high);
            if beyond > slack {
                let message = format!(
                    "values between {:.4} and {:.4}, limits are {low:.4} and {high:.4}",
                    signal.min, signal.max
                );
                findings.push(
                    self.finding("VALUE-012", dim, message).episode(run.episode).measured(beyond, slack),
                );
            }
        }
    }

    fn offset(&self, dim: usize, kind: DimKind, findings: &mut Vec<Finding>) {
        let bounds = &self.thresholds.value;
        // A gripper is open in one episode and closed in another.
        if matches!(kind, DimKind::Rotation | DimKind::Bool | DimKind::Gripper) || self.profiles.len() < 6 {
            return;
        }
        let centres: Vec<f64> = self.signals(dim).map(|(_, s)| s.median).collect();
        let (centre, scale) = centre_and_scale(&centres);
        let range = self.ranges[dim];
        for (run, signal) in self.signals(dim).filter(|(_, s)| s.n_finite > 0) {
            let distance = (signal.median - centre).abs();
            if distance > bounds.offset_sigmas * scale
                && distance > 1.5 * range
                && signal.range() > 0.2 * range
            {
                let message =
                    format!("the median is {:.4}, in the other episodes about {centre:.4}", signal.median);
                let finding = self.finding("VALUE-016", dim, message).episode(run.episode);
                findings.push(finding.measured(distance / scale.max(1e-12), bounds.offset_sigmas));
            }
        }
    }

    fn equal_dims(&self, findings: &mut Vec<Finding>) {
        let Some((_, first)) = self.profiles.first() else { return };
        for (a, b) in &first.equal_dims {
            let is_always = self.profiles.iter().all(|(_, p)| {
                p.equal_dims.contains(&(*a, *b))
                    || (p.dims[*a].is_constant()
                        && p.dims[*a].min == p.dims[*b].min
                        && p.dims[*b].is_constant())
            });
            if is_always {
                let layout = &self.plan.layouts[self.feature];
                let message =
                    format!("dims {:?} and {:?} are equal in every row", layout.names[*a], layout.names[*b]);
                findings.push(self.finding("VALUE-017", *b, message));
            }
        }
        // Equal in one episode only: a channel was written twice.
        for (run, profile) in self.profiles {
            for (a, b) in profile.equal_dims.iter().filter(|pair| {
                self.profiles.len() >= MIN_RUNS && self.equal_runs(**pair) * 4 < self.profiles.len()
            }) {
                let layout = &self.plan.layouts[self.feature];
                let message = format!(
                    "dims {:?} and {:?} are equal in every row of this episode only",
                    layout.names[*a], layout.names[*b]
                );
                findings
                    .push(self.finding("VALUE-017", *b, message).episode(run.episode).at(Severity::Warning));
            }
        }
    }

    fn equal_runs(&self, pair: (usize, usize)) -> usize {
        self.profiles.iter().filter(|(_, p)| p.equal_dims.contains(&pair)).count()
    }

    /// Compares the scale of each run with the others: all dims together, or one dim by a known factor.
    fn scales(&self, findings: &mut Vec<Finding>) {
        let layout = &self.plan.layouts[self.feature];
        if self.profiles.len() < MIN_RUNS || layout.purpose == Purpose::Other && layout.width() == 1 {
            return;
        }
        let usual: Vec<(f64, f64)> = (0..layout.width())
            .map(|d| (self.typical(d, |s| s.step), self.typical(d, |s| s.min.abs().max(s.max.abs()))))
            .collect();
        for (run, profile) in self.profiles {
            let ratio_of = |d: usize| {
                let signal = &profile.dims[d];
                let (step, level) = usual[d];
                let is_usable =
                    !signal.is_constant() && step > 0.0 && level > 0.0 && layout.kinds[d] != DimKind::Bool;
                is_usable.then(|| (signal.step / step, signal.min.abs().max(signal.max.abs()) / level))
            };
            let ratios: Vec<(usize, f64, f64)> =
                (0..layout.width()).filter_map(|d| ratio_of(d).map(|(s, l)| (d, s, l))).collect();
            let both: Vec<f64> = ratios.iter().map(|(_, s, l)| s.min(*l)).collect();
            let small: Vec<f64> = ratios.iter().map(|(_, s, l)| s.max(*l)).collect();
            let bound = self.thresholds.value.scale_ratio;
            let (large, small) = (median(&both), median(&small));
            // An episode of small motion is no episode in another unit.
            let is_small = small < 1.0 / bound && !known_factor(small).is_empty();
            if large > bound || is_small {
                let ratio = if large > bound { large } else { small };
                let message = format!(
                    "values and steps are {ratio:.3} times those of the other episodes{}",
                    known_factor(ratio)
                );
                findings.push(
                    Finding::new("VALUE-013", message)
                        .feature(&layout.name)
                        .episode(run.episode)
                        .measured(ratio, bound),
                );
                continue;
            }
            for (d, step, level) in ratios {
                let ratio = (step * level).abs().sqrt();
                if ratio > 1.0 && !known_factor(ratio).is_empty() && (step / level).ln().abs() < 0.9 {
                    let message = format!(
                        "values and steps are {ratio:.3} times those of the other episodes{}",
                        known_factor(ratio)
                    );
                    findings.push(
                        self.finding("VALUE-013", d, message).episode(run.episode).measured(ratio, bound),
                    );
                }
            }
        }
    }

    /// Judges rotations and circle points; returns the groups, declared or recognised.
    fn groups(&self, findings: &mut Vec<Finding>) -> Vec<Group> {
        let layout = &self.plan.layouts[self.feature];
        let mut groups: Vec<Group> = layout.groups.clone();
        let mut candidates: Vec<(Group, f64)> = Vec::new();
        for measure in self.profiles.iter().flat_map(|(_, p)| &p.groups) {
            if !groups.contains(&measure.group) && !candidates.iter().any(|(g, _)| *g == measure.group) {
                candidates.push((measure.group, self.kept_runs(measure.group)));
            }
        }
        candidates.retain(|(_, share)| *share >= RECOGNISED_RUNS);
        // Wider groups first: a quaternion about one axis contains a point on the circle.
        candidates.sort_by(|a, b| {
            b.0.kind.width().cmp(&a.0.kind.width()).then(b.1.total_cmp(&a.1)).then(a.0.start.cmp(&b.0.start))
        });
        for (group, _) in candidates {
            if groups.iter().all(|g| {
                g.start + g.kind.width() <= group.start || group.start + group.kind.width() <= g.start
            }) {
                groups.push(group);
            }
        }
        for group in &groups {
            rotations::judge_order(self, *group, findings);
            self.judge_group(*group, layout.groups.contains(group), findings);
        }
        groups
    }

    /// Returns the share of runs in which nearly all rows keep the constraint of `group` while it moves.
    fn kept_runs(&self, group: Group) -> f64 {
        let kept = self.measures(group).filter(|(_, m)| m.kept_share > 0.9 && m.is_moving).count();
        kept as f64 / self.profiles.len() as f64
    }

    fn measures(&self, group: Group) -> impl Iterator<Item = (&RunProfile, &GroupMeasure)> {
        self.profiles
            .iter()
            .filter_map(move |(run, p)| p.groups.iter().find(|m| m.group == group).map(|m| (*run, m)))
    }

    fn judge_group(&self, group: Group, is_declared: bool, findings: &mut Vec<Finding>) {
        let (code, what, mut tolerance) = match group.kind {
            GroupKind::Quaternion => {
                ("VALUE-008", "the norm of the quaternion", self.thresholds.value.quaternion_norm)
            }
            GroupKind::SinCos => ("VALUE-010", "sin^2 + cos^2", self.thresholds.value.circle),
            GroupKind::SixD => ("VALUE-011", "the 6-D rotation", self.thresholds.value.orthonormal),
            GroupKind::Matrix => ("VALUE-011", "the rotation matrix", self.thresholds.value.orthonormal),
        };
        if !is_declared {
            // A recognised group is judged by how well it is kept elsewhere.
            let usual: Vec<f64> = self.measures(group).map(|(_, m)| m.high).collect();
            tolerance = tolerance.max(5.0 * median(&usual));
        }
        for (run, measure) in self.measures(group) {
            let worst = if is_declared || measure.kept_share >= 0.3 { measure.worst } else { measure.median };
            if worst > tolerance {
                let message = format!(
                    "{what} in dims {} to {} is off by up to {worst:.4}",
                    group.start,
                    group.start + group.kind.width() - 1
                );
                let finding = self.finding(code, group.start, message).episode(run.episode);
                let finding = finding.rows(measure.stretch.start, measure.stretch.end());
                findings.push(finding.measured(worst, tolerance));
            }
            if measure.n_flips > 0 {
                let message = format!(
                    "the quaternion in dims {} to {} flips its sign {} times",
                    group.start,
                    group.start + 3,
                    measure.n_flips
                );
                let finding = self.finding("VALUE-009", group.start, message).episode(run.episode);
                findings.push(
                    finding
                        .rows(measure.first_flip, measure.first_flip + 1)
                        .measured(measure.n_flips as f64, 0.0),
                );
            }
        }
    }
}

/// Names a factor between units that are often confused.
pub(super) fn known_factor(ratio: f64) -> &'static str {
    let near = |factor: f64| (ratio / factor).ln().abs() < 0.25;
    match () {
        () if near(360.0 / TAU) => " (degrees for radians)",
        () if near(TAU / 360.0) => " (radians for degrees)",
        () if near(1000.0) => " (mm for m)",
        () if near(0.001) => " (m for mm)",
        () => "",
    }
}
