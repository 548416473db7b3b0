//! Actions of finished rows.

use super::{Aligner, Row};
use crate::align::{ActionTiming, EndReason, FeatureRule, GapAction, Reduction, RowSink, action};

impl<I: Clone> Aligner<I> {
    /// Fills the actions of a row, knowing the next; returns a stream without a command that makes the row the last.
    pub(super) fn act(&mut self, row: &mut Row<I>, next: &Row<I>) -> Option<usize> {
        let features = std::mem::take(&mut self.rule.features);
        let mut gap = None;
        let mut values = Vec::with_capacity(row.values.len());
        let mut actions = Vec::new();
        let mut at = 0;
        'features: for (index, feature) in features.iter().enumerate() {
            match feature {
                FeatureRule::Image { .. } => {}
                FeatureRule::Derived { from, derivation, parts } => {
                    let range = self.observed_range(&features, *from);
                    let start = values.len();
                    let (now, then) = (&row.values[range.clone()], &next.values[range]);
                    action::derived(*derivation, parts, now, then, &mut values);
                    row.valid[index] = row.valid[*from] && next.valid[*from];
                    if !row.valid[index] {
                        // The next state may be one without this one being one; such an action is none.
                        values[start..].fill(f64::NAN);
                    }
                    actions.extend_from_slice(&values[start..]);
                }
                FeatureRule::Vector { streams } => {
                    let mut valid = true;
                    let mut is_action = false;
                    for &stream in streams {
                        let width = self.rule.streams[stream].width;
                        if self.rule.streams[stream].timing.is_none() {
                            values.extend_from_slice(&row.values[at..at + width]);
                            at += width;
                            continue;
                        }
                        is_action = true;
                        let start = values.len();
                        if let Err(at) = self.command(stream, row, next.time_ns, &mut values, &mut valid) {
                            gap = Some(at);
                            break 'features;
                        }
                        actions.extend_from_slice(&values[start..]);
                    }
                    if is_action {
                        row.valid[index] = valid;
                    }
                }
            }
        }
        self.rule.features = features;
        if gap.is_none() {
            row.values = values;
            // A command that is not finite is no command to repeat.
            if self.last_actions.is_empty() || actions.iter().all(|value| value.is_finite()) {
                self.last_actions = actions;
            }
        }
        gap
    }

    /// Returns where the values of an observed feature lie in a row whose actions are not filled in.
    fn observed_range(&self, features: &[FeatureRule], feature: usize) -> std::ops::Range<usize> {
        let width = |rule: &FeatureRule| match rule {
            FeatureRule::Vector { streams } => streams
                .iter()
                .map(|&stream| &self.rule.streams[stream])
                .filter(|stream| stream.timing.is_none())
                .map(|stream| stream.width)
                .sum(),
            _ => 0,
        };
        let start: usize = features[..feature].iter().map(width).sum();
        start..start + width(&features[feature])
    }

    fn command(
        &mut self,
        stream: usize,
        row: &mut Row<I>,
        next_ns: i64,
        out: &mut Vec<f64>,
        valid: &mut bool,
    ) -> Result<(), usize> {
        let rule = &self.rule.streams[stream];
        let Some(timing) = rule.timing else { return Ok(()) };
        let buffer = &self.buffers[stream];
        let t = row.time_ns;
        let held = self.last_within(stream, t);
        let first = buffer.first_after(t).filter(|&index| buffer.time(index).key_ns <= next_ns);
        let last = first.and_then(|_| buffer.last_at(next_ns));
        let width = rule.width * timing.commands();
        let used = match timing {
            ActionTiming::InForce => held,
            ActionTiming::Next => first,
            ActionTiming::Resample(_) => first.or(held),
            ActionTiming::Reduce(Reduction::Last | Reduction::Mean) => last.or(held),
            ActionTiming::Reduce(_) => last,
        };
        self.set_age(stream, t, used, row);
        let Some(used) = used else {
            if rule.gap != GapAction::Mask {
                return Err(stream);
            }
            out.extend(std::iter::repeat_n(f64::NAN, width));
            *valid = false;
            return Ok(());
        };
        match (timing, first, last) {
            (ActionTiming::Reduce(reduction), Some(first), Some(last)) if first < last => {
                *valid &= self.reduce(stream, reduction, first..=last, out);
            }
            (ActionTiming::Resample(n), ..) => {
                let exact = first.zip(last).filter(|(first, last)| last - first + 1 == n);
                for k in 0..n {
                    // With as many commands as asked for they are taken as they are; else those in force in the
                    // middle of each n-th of the interval.
                    let middle = t + (next_ns - t) / (2 * n as i64) * (2 * k as i64 + 1);
                    let index = match exact {
                        Some((first, _)) => first + k,
                        None => buffer.last_at(middle).unwrap_or(used),
                    };
                    *valid &= self.copy(stream, index, out);
                }
            }
            _ => *valid &= self.copy(stream, used, out),
        }
        Ok(())
    }

    fn reduce(
        &mut self,
        stream: usize,
        reduction: Reduction,
        range: std::ops::RangeInclusive<usize>,
        out: &mut Vec<f64>,
    ) -> bool {
        let mut commands = std::mem::take(&mut self.scratch);
        commands.clear();
        let mut is_finite = true;
        let mut n = 0;
        for index in range {
            is_finite &= self.copy(stream, index, &mut commands);
            n += 1;
        }
        action::reduced(reduction, &self.rule.streams[stream].parts, &commands, n, out);
        self.scratch = commands;
        is_finite
    }

    /// Finishes the pending row as the last one: it repeats the last action, not valid.
    pub(super) fn end_episode(&mut self, reason: EndReason, sink: &mut impl RowSink<I>) {
        if let Some(mut row) = self.pending.take() {
            let mut values = Vec::with_capacity(row.values.len());
            let mut repeated = self.last_actions.iter().copied();
            let (mut at, features) = (0, std::mem::take(&mut self.rule.features));
            for (index, feature) in features.iter().enumerate() {
                match feature {
                    FeatureRule::Image { .. } => {}
                    FeatureRule::Derived { derivation, parts, .. } => {
                        let width: usize = derivation.parts(parts).iter().map(|part| part.width).sum();
                        values.extend((0..width).map(|_| repeated.next().unwrap_or(f64::NAN)));
                        row.valid[index] = false;
                    }
                    FeatureRule::Vector { streams } => {
                        for &stream in streams {
                            let rule = &self.rule.streams[stream];
                            if let Some(timing) = rule.timing {
                                let width = rule.width * timing.commands();
                                values.extend((0..width).map(|_| repeated.next().unwrap_or(f64::NAN)));
                                let held = self.last_within(stream, row.time_ns);
                                self.set_age(stream, row.time_ns, held, &mut row);
                                row.valid[index] = false;
                            } else {
                                values.extend_from_slice(&row.values[at..at + rule.width]);
                                at += rule.width;
                            }
                        }
                    }
                }
            }
            self.rule.features = features;
            row.values = values;
            sink.row(&row);
        }
        self.last_actions.clear();
        sink.end(reason);
    }
}
