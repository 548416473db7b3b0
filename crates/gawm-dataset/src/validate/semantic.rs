//! Rules of group SEMANTIC, and those of TIME that motion shows: what the numbers mean together.

use super::{
    Finding, Severity, Thresholds,
    motion::Squeeze,
    profile::{Plan, RunProfile},
    robust::{Pair, centre_and_scale, median, quantile},
    tracking::{NO_SHIFT, PairProfile, SHIFTS, Tracking},
    value::known_factor,
};
use crate::read::Dataset;

/// Fewest runs whose comparison says something about one of them.
const MIN_RUNS: usize = 3;
/// Fewest runs whose response to actions is compared, and the least ratio that is reported.
const MIN_RESPONSES: usize = 5;
const RESPONSE_RATIO: f64 = 1.3;
/// A residual so small that the action is a copy of the state: ln(1e-3).
const COPIED: f64 = -6.9;

/// Steps of the state per action that a difference in the state's own unit brings about.
const DELTA_GAIN: std::ops::Range<f64> = 0.2..3.0;

/// Judges actions against states, motion, tasks and labels.
pub(super) fn judge(
    dataset: &Dataset,
    plan: &Plan,
    thresholds: &Thresholds,
    runs: &[RunProfile],
) -> Vec<Finding> {
    let mut findings = Vec::new();
    let tracked: Vec<(&RunProfile, &Tracking)> =
        runs.iter().filter_map(|r| r.tracking.as_ref().map(|t| (r, t))).collect();
    if !tracked.is_empty() {
        let judge = Judge { plan, thresholds, tracked: &tracked };
        judge.shifts(&mut findings);
        judge.permutations(&mut findings);
        judge.deltas(&mut findings);
        judge.signs_and_scales(&mut findings);
        judge.offsets(&mut findings);
        judge.responses(&mut findings);
    }
    motion(dataset, thresholds, runs, &mut findings);
    labels(dataset, plan, thresholds, runs, &mut findings);
    findings
}

/// Returns the shift of the action that explains the motion best, over all runs.
pub(super) fn action_lag(runs: &[RunProfile]) -> Option<super::ActionLag> {
    let profiles: Vec<&[f64; SHIFTS]> =
        runs.iter().filter_map(|r| r.tracking.as_ref().and_then(|t| t.profile.as_ref())).collect();
    if profiles.is_empty() {
        return None;
    }
    let mut typical = [0.0; SHIFTS];
    for (k, value) in typical.iter_mut().enumerate() {
        *value = median(&profiles.iter().map(|p| p[k]).collect::<Vec<_>>());
    }
    let k = best(&typical);
    Some(super::ActionLag { rows: NO_SHIFT as i64 - k as i64, explained: 1.0 - typical[k].exp() })
}

struct Judge<'a> {
    plan: &'a Plan,
    thresholds: &'a Thresholds,
    tracked: &'a [(&'a RunProfile, &'a Tracking)],
}

fn best(profile: &[f64; SHIFTS]) -> usize {
    // Among equals the smallest shift wins.
    let order = |k: &usize| k.abs_diff(NO_SHIFT);
    (0..SHIFTS)
        .min_by(|a, b| profile[*a].total_cmp(&profile[*b]).then(order(a).cmp(&order(b))))
        .unwrap_or(NO_SHIFT)
}

/// Returns by how many rows `profile` is the typical one moved, if that fits clearly better than not moved.
fn moved_by(profile: &[f64; SHIFTS], typical: &[f64; SHIFTS]) -> Option<i64> {
    const MOST: i64 = 4;
    let error = |by: i64| {
        let inside = |k: i64| {
            (0..SHIFTS as i64).contains(&(k + by)).then(|| profile[(k + by) as usize] - typical[k as usize])
        };
        let gaps: Vec<f64> = (0..SHIFTS as i64).filter_map(inside).collect();
        gaps.iter().map(|g| g * g).sum::<f64>() / gaps.len() as f64
    };
    let by = (-MOST..=MOST).min_by(|a, b| error(*a).total_cmp(&error(*b)).then(a.abs().cmp(&b.abs())))?;
    (by != 0 && error(0) > 4.0 * error(by) + 0.01).then_some(by)
}

impl Judge<'_> {
    fn pair_finding(&self, code: &'static str, pair: usize, message: String) -> Finding {
        let (feature, dim) = self.plan.name(self.plan.actions[self.plan.pairs[pair].0]);
        Finding::new(code, message).feature(feature).dim(dim)
    }

    fn action_feature(&self) -> &str {
        self.plan.actions.first().map_or("action", |a| self.plan.name(*a).0)
    }

    fn shifts(&self, findings: &mut Vec<Finding>) {
        let profiles: Vec<(&RunProfile, &[f64; SHIFTS])> =
            self.tracked.iter().filter_map(|(run, t)| t.profile.as_ref().map(|p| (*run, p))).collect();
        if profiles.is_empty() {
            return;
        }
        let mut typical = [0.0; SHIFTS];
        for (k, value) in typical.iter_mut().enumerate() {
            *value = median(&profiles.iter().map(|(_, p)| p[k]).collect::<Vec<_>>());
        }
        let usual = best(&typical);
        let margin = -self.thresholds.semantic.shift_residual_ratio.ln();
        self.shift_of_all(&typical, usual, margin, findings);
        if profiles.len() < MIN_RUNS || typical[usual] > -0.1 {
            return;
        }
        for (run, profile) in profiles {
            let here = best(profile);
            if let Some(by) = moved_by(profile, &typical) {
                let message = format!("the action acts {by:+} rows from where it does in the other episodes");
                let finding =
                    Finding::new("SEMANTIC-001", message).episode(run.episode).feature(self.action_feature());
                findings.push(finding.rows(0, run.n_rows).measured(by as f64, 0.0));
            } else if here != usual
                && profile[usual] - profile[here] > 0.7
                && typical[here] - typical[usual] > 0.35
            {
                let message = format!(
                    "the motion is explained best by the action {} rows before it, in the other episodes {}",
                    NO_SHIFT as i64 - here as i64,
                    NO_SHIFT as i64 - usual as i64
                );
                let finding =
                    Finding::new("SEMANTIC-001", message).episode(run.episode).feature(self.action_feature());
                findings.push(finding.rows(0, run.n_rows).measured(here as f64 - usual as f64, 0.0));
            } else if profile[here] > 0.2 * typical[usual] && typical[usual] < -0.5 {
                let message = format!(
                    "the action explains {:.0} % of the state's unsteady motion, in the other episodes {:.0} %",
                    100.0 * (1.0 - profile[here].exp()),
                    100.0 * (1.0 - typical[usual].exp())
                );
                let finding =
                    Finding::new("SEMANTIC-005", message).episode(run.episode).feature(self.action_feature());
                let bound = 1.0 - (0.2 * typical[usual]).exp();
                findings.push(finding.rows(0, run.n_rows).measured(1.0 - profile[here].exp(), bound));
            }
        }
    }

    /// Judges the shift that all episodes share.
    fn shift_of_all(&self, typical: &[f64; SHIFTS], usual: usize, margin: f64, findings: &mut Vec<Finding>) {
        let is_better = typical[NO_SHIFT] - typical[usual] >= margin;
        // Smooth commands are known before they are given; only a sharp best shift is the one at which they act.
        let is_late = usual > NO_SHIFT && typical[usual - 1] - typical[usual] >= margin;
        if usual > NO_SHIFT && is_better && is_late {
            let by = usual - NO_SHIFT;
            let message = format!(
                "the motion from t to t+1 is explained best by the action of row t+{by}: actions are recorded {by} rows late"
            );
            findings.push(
                Finding::new("SEMANTIC-001", message).feature(self.action_feature()).measured(by as f64, 0.0),
            );
        } else if usual < NO_SHIFT && is_better && typical[usual] < COPIED {
            let by = NO_SHIFT - usual;
            let message = format!(
                "the action of row t-{by} equals the state of row t+1: actions are recorded {by} rows early"
            );
            findings.push(
                Finding::new("SEMANTIC-001", message)
                    .feature(self.action_feature())
                    .measured(-(by as f64), 0.0),
            );
        }
    }

    fn permutations(&self, findings: &mut Vec<Finding>) {
        let verdicts: Vec<Vec<(usize, usize)>> =
            self.tracked.iter().map(|(_, t)| self.misplaced(t)).collect();
        let n_wrong = verdicts.iter().filter(|v| !v.is_empty()).count();
        if n_wrong * 2 > verdicts.len() {
            let mut votes: std::collections::BTreeMap<&Vec<(usize, usize)>, usize> =
                std::collections::BTreeMap::new();
            verdicts.iter().filter(|v| !v.is_empty()).for_each(|v| *votes.entry(v).or_default() += 1);
            if let Some((swapped, n)) = votes.into_iter().max_by_key(|(_, n)| *n) {
                let message = format!("{} (in {n} of {} episodes)", self.describe(swapped), verdicts.len());
                findings.push(
                    Finding::new("SEMANTIC-002", message)
                        .feature(self.action_feature())
                        .measured(swapped.len() as f64, 0.0),
                );
            }
            return;
        }
        for ((run, _), swapped) in self.tracked.iter().zip(&verdicts).filter(|(_, v)| !v.is_empty()) {
            let finding = Finding::new("SEMANTIC-002", self.describe(swapped))
                .episode(run.episode)
                .feature(self.action_feature());
            findings.push(finding.rows(0, run.n_rows).measured(swapped.len() as f64, 0.0));
        }
    }

    fn describe(&self, swapped: &[(usize, usize)]) -> String {
        let name = |dims: &[(usize, usize)], i: usize| {
            let (feature, dim) = self.plan.name(dims[i]);
            format!("{feature}[{dim}]")
        };
        let each: Vec<String> = swapped
            .iter()
            .take(4)
            .map(|(a, s)| format!("{} drives {}", name(&self.plan.actions, *a), name(&self.plan.states, *s)))
            .collect();
        each.join(", ")
    }

    /// Returns pairs (action, state) that belong together although they are at different places, if they form a permutation.
    fn misplaced(&self, tracking: &Tracking) -> Vec<(usize, usize)> {
        let n_states = self.plan.states.len();
        let margin = self.thresholds.semantic.permuted_margin as f32;
        let mut moved: Vec<(usize, usize)> = Vec::new();
        for &(a, own) in &self.plan.pairs {
            let row = |matrix: &[f32], s: usize| matrix[a * n_states + s];
            let variance = tracking.action_variance[a] as f32;
            let candidates = self.plan.pairs.iter().map(|(_, s)| *s).filter(|s| *s != own);
            let by_steps = candidates.clone().max_by(|x, y| {
                row(&tracking.step_correlation, *x).total_cmp(&row(&tracking.step_correlation, *y))
            });
            let by_distance =
                candidates.min_by(|x, y| row(&tracking.distance, *x).total_cmp(&row(&tracking.distance, *y)));
            let (correlation, distance) = (&tracking.step_correlation, &tracking.distance);
            let better = by_steps.filter(|s| {
                row(correlation, *s) > 0.7 && row(correlation, *s) > row(correlation, own) + margin
            });
            // Closer than a fifth of its own variance to another state, and farther than half of it from its own.
            let closer = by_distance.filter(|s| {
                variance > 1e-9 && row(distance, *s) < 0.2 * variance && row(distance, own) > 0.5 * variance
            });
            if let Some(s) = closer.or(better) {
                moved.push((a, s));
            }
        }
        // Each action must take the place of another one.
        loop {
            let before = moved.len();
            let own_states: Vec<usize> = moved.iter().filter_map(|(a, _)| self.own_state(*a)).collect();
            moved.retain(|(_, s)| own_states.contains(s));
            let taken: Vec<usize> = moved.iter().map(|(_, s)| *s).collect();
            moved.retain(|(a, _)| self.own_state(*a).is_some_and(|own| taken.contains(&own)));
            if moved.len() == before {
                return moved;
            }
        }
    }

    fn own_state(&self, action: usize) -> Option<usize> {
        self.plan.pairs.iter().find(|(a, _)| *a == action).map(|(_, s)| *s)
    }

    /// Returns how many moving pairs of a run look like differences, and how many there are.
    fn delta_like(&self, tracking: &Tracking) -> (usize, usize) {
        let bound = self.thresholds.semantic.delta_correlation;
        let (mut deltas, mut moving) = (0, 0);
        for pair in tracking.pairs.iter().filter(|p| p.residuals.is_some()) {
            moving += 1;
            let delta = pair.delta.iter().map(Pair::correlation).fold(0.0, f64::max);
            let level = pair.level.correlation().abs().max(pair.steps.correlation());
            deltas += usize::from(delta >= bound && level < delta - 0.1);
        }
        (deltas, moving)
    }

    fn deltas(&self, findings: &mut Vec<Finding>) {
        let counts: Vec<(usize, usize)> = self.tracked.iter().map(|(_, t)| self.delta_like(t)).collect();
        let is_delta = |(deltas, moving): &(usize, usize)| *moving > 0 && *deltas * 2 > *moving;
        let n_delta = counts.iter().filter(|c| is_delta(c)).count();
        if n_delta * 2 > counts.len() {
            if !self.is_labelled_delta() {
                findings.push(self.delta_everywhere(n_delta));
            }
            return;
        }
        for ((run, _), count) in self.tracked.iter().zip(&counts).filter(|(_, c)| is_delta(c)) {
            let message = format!(
                "{} of {} actions follow the state's next step, not its value as in the other episodes",
                count.0, count.1
            );
            let finding =
                Finding::new("SEMANTIC-003", message).episode(run.episode).feature(self.action_feature());
            findings.push(finding.rows(0, run.n_rows).measured(count.0 as f64 / count.1 as f64, 0.5));
        }
        self.single_deltas(&counts, findings);
    }

    /// Returns the finding on actions that act like differences in most episodes.
    ///
    /// A difference of the state in its own unit brings about a step of its own size; a speed or a normalised command
    /// does not, and is none that was mislabelled, unless its label says that it has the state's unit.
    fn delta_everywhere(&self, n_delta: usize) -> Finding {
        let gain = |pair: &Pair| pair.correlation() * pair.scale().abs();
        let best = |p: &PairProfile| {
            p.delta.iter().max_by(|a, b| a.correlation().total_cmp(&b.correlation())).map_or(0.0, gain)
        };
        let moving =
            |t: &&Tracking| t.pairs.iter().filter(|p| p.residuals.is_some()).map(best).collect::<Vec<_>>();
        let gains: Vec<f64> = self.tracked.iter().flat_map(|(_, t)| moving(t)).collect();
        let gain = median(&gains);
        let unit = |(f, d): (usize, usize)| self.plan.layouts[f].units[d].trim().to_ascii_lowercase();
        let has_unit = self.plan.pairs.iter().all(|(a, s)| {
            let (action, state) = (unit(self.plan.actions[*a]), unit(self.plan.states[*s]));
            action == state && !matches!(action.as_str(), "" | "1" | "none")
        });
        let n = self.tracked.len();
        let text =
            format!("actions follow the state's next step, not its value, in {n_delta} of {n} episodes");
        let finding = if has_unit || DELTA_GAIN.contains(&gain) {
            Finding::new("SEMANTIC-003", text)
        } else {
            let message =
                format!("{text}: they act like speeds, an action of 1 moves the state by {gain:.3} a row");
            Finding::new("SEMANTIC-003", message).at(Severity::Info)
        };
        finding.feature(self.action_feature()).measured(n_delta as f64, 0.0)
    }

    /// Finds single dims that are differences in one episode only.
    fn single_deltas(&self, counts: &[(usize, usize)], findings: &mut Vec<Finding>) {
        if self.tracked.len() < MIN_RUNS || counts.iter().any(|(d, m)| d * 2 > *m) {
            return;
        }
        let bound = self.thresholds.semantic.delta_correlation;
        for pair in 0..self.plan.pairs.len() {
            let is_delta = |t: &Tracking| {
                let p = &t.pairs[pair];
                let delta = p.delta.iter().map(Pair::correlation).fold(0.0, f64::max);
                p.residuals.is_some()
                    && delta >= bound.max(0.9)
                    && p.level.correlation().abs().max(p.steps.correlation()) < 0.6
            };
            let hits: Vec<&RunProfile> =
                self.tracked.iter().filter(|(_, t)| is_delta(t)).map(|(r, _)| *r).collect();
            if !hits.is_empty() && hits.len() * 2 < self.tracked.len() {
                for run in hits {
                    let message =
                        "the action follows the state's next step, not its value as in the other episodes"
                            .to_owned();
                    findings.push(
                        self.pair_finding("SEMANTIC-003", pair, message)
                            .episode(run.episode)
                            .rows(0, run.n_rows),
                    );
                }
            }
        }
    }

    fn is_labelled_delta(&self) -> bool {
        self.plan.actions.iter().all(|&(feature, dim)| {
            let layout = &self.plan.layouts[feature];
            let text =
                format!("{} {} {}", layout.name, layout.names[dim], layout.units[dim]).to_ascii_lowercase();
            ["delta", "diff", "vel", "/s", "rel", "twist", "rate", "d_"]
                .iter()
                .any(|word| text.contains(word))
        })
    }

    fn signs_and_scales(&self, findings: &mut Vec<Finding>) {
        let sure = self.thresholds.semantic.sure_correlation;
        for pair in 0..self.plan.pairs.len() {
            let verdict = |t: &Tracking| -> Option<(bool, f64)> {
                let p = &t.pairs[pair];
                let (level, steps) = (p.level.correlation(), p.steps.correlation());
                p.residuals?;
                let is_negative = level < -sure && steps < -0.5 || steps < -sure && level < -0.5;
                // State over action: what an action of 1 brings about.
                let scale = if level.abs() >= sure {
                    p.level.scale().abs()
                } else if steps.abs() >= sure {
                    p.steps.scale().abs()
                } else {
                    return is_negative.then_some((true, 1.0));
                };
                Some((is_negative, if scale > 0.0 { 1.0 / scale } else { 1.0 }))
            };
            let verdicts: Vec<(&RunProfile, (bool, f64))> =
                self.tracked.iter().filter_map(|(run, t)| verdict(t).map(|v| (*run, v))).collect();
            if verdicts.is_empty() {
                continue;
            }
            self.sign(pair, &verdicts, findings);
            self.scale(pair, &verdicts, findings);
        }
    }

    fn sign(&self, pair: usize, verdicts: &[(&RunProfile, (bool, f64))], findings: &mut Vec<Finding>) {
        let negative: Vec<&RunProfile> = verdicts.iter().filter(|(_, v)| v.0).map(|(r, _)| *r).collect();
        if negative.len() * 2 > verdicts.len() && negative.len() * 2 > self.tracked.len() {
            let message = format!(
                "the action moves against its state in {} of {} episodes",
                negative.len(),
                self.tracked.len()
            );
            findings
                .push(self.pair_finding("SEMANTIC-007", pair, message).measured(negative.len() as f64, 0.0));
        } else if negative.len() * 2 < verdicts.len() {
            for run in negative {
                let message =
                    "the action moves against its state; it does not in the other episodes".to_owned();
                findings.push(
                    self.pair_finding("SEMANTIC-007", pair, message).episode(run.episode).rows(0, run.n_rows),
                );
            }
        }
    }

    fn scale(&self, pair: usize, verdicts: &[(&RunProfile, (bool, f64))], findings: &mut Vec<Finding>) {
        let ratios: Vec<f64> = verdicts.iter().map(|(_, v)| v.1).collect();
        let usual = median(&ratios);
        let unit_of = |(f, d): (usize, usize)| self.plan.layouts[f].units[d].clone();
        let (a, s) = self.plan.pairs[pair];
        let (action_unit, state_unit) = (unit_of(self.plan.actions[a]), unit_of(self.plan.states[s]));
        let is_same_unit = action_unit == state_unit;
        if !known_factor(usual).is_empty() && is_same_unit && ratios.len() * 2 > self.tracked.len() {
            let message = format!("the action is {usual:.3} times its state{}", known_factor(usual));
            findings.push(self.pair_finding("SEMANTIC-008", pair, message).measured(usual, 1.0));
        }
        for (run, (_, ratio)) in verdicts.iter().filter(|_| verdicts.len() >= MIN_RUNS) {
            let relative = ratio / usual;
            let agreeing = ratios.iter().filter(|r| (0.5..2.0).contains(&(**r / usual))).count();
            if !(0.2..=5.0).contains(&relative) && agreeing as f64 >= 0.6 * ratios.len() as f64 {
                let message = format!(
                    "the action is {ratio:.3} times its state, in the other episodes {usual:.3} times{}",
                    known_factor(relative)
                );
                let finding =
                    self.pair_finding("SEMANTIC-008", pair, message).episode(run.episode).rows(0, run.n_rows);
                findings.push(finding.measured(relative, 5.0));
            }
        }
    }

    /// Compares how fast states follow their actions: rows that are missing or repeated throughout change that.
    fn responses(&self, findings: &mut Vec<Finding>) {
        let known: Vec<(&RunProfile, f64)> = self
            .tracked
            .iter()
            .filter_map(|(run, t)| t.response.filter(|r| *r > 0.0).map(|r| (*run, r.ln())))
            .collect();
        if known.len() < MIN_RESPONSES {
            return;
        }
        let (centre, scale) = centre_and_scale(&known.iter().map(|k| k.1).collect::<Vec<_>>());
        let bound = (self.thresholds.semantic.offset_sigmas * scale).max(RESPONSE_RATIO.ln());
        for (run, response) in known.iter().filter(|(_, r)| (r - centre).abs() > bound) {
            let ratio = (response - centre).exp();
            let message = format!(
                "the state follows its action {ratio:.2} times as fast as in the other episodes: rows are missing or repeated throughout, or the rate is another"
            );
            let finding =
                Finding::new("SEMANTIC-015", message).episode(run.episode).feature(self.action_feature());
            findings.push(finding.rows(0, run.n_rows).measured(ratio, bound.exp()));
        }
    }

    fn offsets(&self, findings: &mut Vec<Finding>) {
        if self.tracked.len() < MIN_RUNS {
            return;
        }
        for (pair, (_, s)) in self.plan.pairs.iter().enumerate() {
            let (feature, dim) = self.plan.states[*s];
            let is_following =
                |t: &Tracking| t.pairs[pair].level.correlation() > 0.6 && t.pairs[pair].residuals.is_some();
            let followers = self.tracked.iter().filter(|(_, t)| is_following(t)).count();
            if followers * 2 < self.tracked.len() {
                continue;
            }
            let offsets: Vec<f64> = self.tracked.iter().map(|(_, t)| t.pairs[pair].offset).collect();
            let (centre, scale) = centre_and_scale(&offsets);
            let signal =
                |run: &RunProfile| run.features[feature].as_ref().map_or(0.0, |p| p.dims[dim].spread);
            let spread = median(&self.tracked.iter().map(|(run, _)| signal(run)).collect::<Vec<_>>());
            let bound = (self.thresholds.semantic.offset_sigmas * scale).max(0.15 * spread);
            for ((run, _), offset) in self.tracked.iter().zip(&offsets).filter(|((_, t), _)| is_following(t))
            {
                if (offset - centre).abs() > bound && bound > 0.0 {
                    let message = format!(
                        "the action lies {offset:+.4} from its state, in the other episodes {centre:+.4}"
                    );
                    let finding = self
                        .pair_finding("SEMANTIC-014", pair, message)
                        .episode(run.episode)
                        .rows(0, run.n_rows);
                    findings.push(finding.measured((offset - centre).abs(), bound));
                }
            }
        }
    }
}

/// Judges the motion of all state dims together: squeezed time, repeated rows, whole rows stuck, idle episodes.
fn motion(dataset: &Dataset, thresholds: &Thresholds, runs: &[RunProfile], findings: &mut Vec<Finding>) {
    let bounds = &thresholds.time;
    let n_rows: usize = runs.iter().map(|r| r.n_rows).sum::<usize>().max(1);
    let squeezed = |run: &RunProfile| {
        let is_event = |s: &&Squeeze| s.is_event(bounds.squeezed_steps);
        run.motion.squeezed.iter().filter(is_event).copied().collect::<Vec<_>>()
    };
    let n_squeezed: usize = runs.iter().map(|r| squeezed(r).len()).sum();
    let n_repeated: usize = runs.iter().map(|r| r.motion.n_repeated).sum();
    // A stream that holds its samples for several rows steps and repeats by nature.
    let is_stepping =
        runs.iter().filter(|r| r.motion.n_repeated as f64 > bounds.repeated_share * r.n_rows as f64).count()
            * 2
            > runs.len();
    let shortest = (thresholds.value.stuck_secs * dataset.info.fps).max(thresholds.value.stuck_rows);
    let rests: Vec<f64> = runs.iter().map(|r| r.motion.longest_rest.n_rows as f64).collect();
    let usual_rest = if runs.len() >= MIN_RUNS { quantile(&rests, 0.5) } else { 0.0 };
    for run in runs {
        let events = squeezed(run);
        if let Some(Squeeze { row, .. }) = events.first()
            && !is_stepping
            && (n_squeezed as f64) < 0.005 * n_rows as f64
        {
            let worst = events.iter().map(|e| e.steps).fold(0.0, f64::max);
            let message = format!(
                "the robot moves as far as in {worst:.1} rows within one, {} times: rows are missing",
                events.len()
            );
            findings.push(
                Finding::new("TIME-008", message)
                    .episode(run.episode)
                    .rows(*row, row + 1)
                    .measured(worst, bounds.squeezed_steps),
            );
        }
        if let Some(row) = run.motion.repeated.first()
            && !is_stepping
            && (n_repeated as f64) < bounds.repeated_share * n_rows as f64
        {
            let message = format!("{} rows in motion equal the row before", run.motion.n_repeated);
            findings.push(
                Finding::new("TIME-009", message)
                    .episode(run.episode)
                    .rows(*row, row + 1)
                    .measured(run.motion.n_repeated as f64, 0.0),
            );
        }
        let rest = run.motion.longest_rest;
        let usual = usual_rest.max(run.motion.second_rest as f64);
        let is_inside = rest.start > 0 && rest.end() < run.n_rows;
        if rest.n_rows as f64 >= shortest
            && rest.n_rows as f64 > thresholds.value.stuck_ratio * usual
            && run.motion.rest_share < 0.5
            && (is_inside || run.motion.rest_drive > 0.1)
        {
            let message = format!("no state changes at all for {} rows; usually for {usual:.0}", rest.n_rows);
            let finding =
                Finding::new("VALUE-003", message).episode(run.episode).rows(rest.start, rest.end());
            findings.push(finding.measured(rest.n_rows as f64, thresholds.value.stuck_ratio * usual));
        }
        if run.motion.idle_share > thresholds.semantic.idle_share {
            let message = format!("the robot is idle in {:.0} % of the rows", 100.0 * run.motion.idle_share);
            let finding = Finding::new("SEMANTIC-011", message).episode(run.episode);
            findings.push(finding.measured(run.motion.idle_share, thresholds.semantic.idle_share));
        }
    }
}

/// Judges names, task texts and labels.
fn labels(
    dataset: &Dataset,
    plan: &Plan,
    thresholds: &Thresholds,
    runs: &[RunProfile],
    findings: &mut Vec<Finding>,
) {
    let shortest = thresholds.semantic.task_chars;
    let mut used: Vec<i64> = runs.iter().flat_map(|r| r.task_indices.iter().copied()).collect();
    used.sort_unstable();
    used.dedup();
    for (index, text) in dataset.tasks.iter().enumerate() {
        let n_chars = text.trim().chars().count();
        if (n_chars as f64) < shortest && (used.is_empty() || used.contains(&(index as i64))) {
            let message = format!("task {index} is {text:?}");
            findings.push(Finding::new("SEMANTIC-006", message).measured(n_chars as f64, shortest));
        }
    }
    for entry in dataset.episodes.iter().filter(|e| e.tasks.is_empty() && !dataset.tasks.is_empty()).take(20)
    {
        findings.push(Finding::new("SEMANTIC-006", "the episode names no task").episode(entry.episode_index));
    }
    let has_label =
        |name: &str| name.contains("success") || name.contains("reward") || name.contains("outcome");
    let is_labelled =
        dataset.episodes.iter().any(|e| e.extras.iter().any(|(k, v)| has_label(k) && !v.is_null()))
            || dataset.info.features.iter().any(|f| has_label(&f.name));
    if !is_labelled && !dataset.episodes.is_empty() {
        findings.push(Finding::new(
            "SEMANTIC-009",
            "neither meta/episodes nor a column says which episodes succeeded",
        ));
    }
    let names = |dims: &[(usize, usize)]| {
        dims.iter().map(|d| plan.name(*d).1.to_ascii_lowercase()).collect::<Vec<_>>()
    };
    let (actions, states) = (names(&plan.actions), names(&plan.states));
    let has_names =
        |dims: &[(usize, usize)]| !dims.is_empty() && dims.iter().all(|(f, _)| plan.layouts[*f].has_names);
    if has_names(&plan.actions)
        && has_names(&plan.states)
        && actions.len() == states.len()
        && actions != states
    {
        let mut sorted = (actions.clone(), states.clone());
        sorted.0.sort();
        sorted.1.sort();
        let is_reordered = sorted.0 == sorted.1;
        let first = actions.iter().zip(&states).position(|(a, s)| a != s).unwrap_or(0);
        let message =
            format!("dim {first} is {:?} in the action and {:?} in the state", actions[first], states[first]);
        let severity = if is_reordered { Severity::Warning } else { Severity::Info };
        findings.push(Finding::new("SEMANTIC-010", message).at(severity));
    }
}
