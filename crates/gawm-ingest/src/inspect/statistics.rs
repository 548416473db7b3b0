//! Statistics of one channel, taken message by message in bounded memory.

use std::collections::VecDeque;

use serde::Serialize;

use super::clocks::{ClockOffset, Samples};
use super::histogram::Histogram;

/// Longest gaps that are kept.
const MAX_GAPS: usize = 8;
/// A gap is an interval longer than this many median periods.
const GAP_PERIODS: f64 = 3.0;
/// Messages of a channel among which an exact duplicate is looked for.
const DUPLICATE_WINDOW: usize = 64;

/// A step back of this size is a clock that was reset: what follows repeats times, not messages.
pub(super) const CLOCK_RESET_NS: u64 = 1_000_000_000;

/// What statistics need of one message.
#[derive(Debug, Clone, Copy)]
pub(super) struct Digest {
    pub(super) log_time_ns: u64,
    pub(super) publish_time_ns: u64,
    pub(super) stamp_ns: Option<i64>,
    pub(super) sequence: u32,
    pub(super) n_bytes: u64,
    pub(super) payload_crc: u32,
}

/// An interval without messages that is longer than three median periods.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Gap {
    /// Log time of the last message before the gap.
    pub start_ns: u64,
    /// Length of the gap in milliseconds.
    pub ms: f64,
}

/// How often messages come, by one clock.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Rate {
    /// Messages per second, from the median interval.
    pub median_hz: f64,
    /// Rate at the 99th percentile of the intervals: the slowest one percent.
    pub min_hz: f64,
    /// Rate at the 1st percentile of the intervals; `None` when messages come at the same instant.
    pub max_hz: Option<f64>,
    /// Half of the range from the 5th to the 95th percentile of the intervals, in milliseconds.
    pub jitter_ms: f64,
    /// Intervals longer than three median ones.
    pub gaps: u64,
    /// The longest of them, longest first.
    pub longest_gaps: Vec<Gap>,
}

/// Intervals of one clock.
#[derive(Debug, Clone, Default)]
struct Intervals {
    last_ns: Option<u64>,
    histogram: Histogram,
    /// Length and start, longest first.
    longest: Vec<(u64, u64)>,
    backward: u64,
    largest_backward_ns: u64,
}

impl Intervals {
    fn add(&mut self, time_ns: u64) {
        if time_ns == 0 {
            return;
        }
        if let Some(last) = self.last_ns.replace(time_ns) {
            match time_ns.checked_sub(last) {
                Some(length) => {
                    self.histogram.add(length);
                    let at = self.longest.partition_point(|(other, _)| *other >= length);
                    if at < MAX_GAPS {
                        self.longest.insert(at, (length, last));
                        self.longest.truncate(MAX_GAPS);
                    }
                }
                None => {
                    self.backward += 1;
                    self.largest_backward_ns = self.largest_backward_ns.max(last - time_ns);
                }
            }
        }
    }

    fn rate(&self) -> Option<Rate> {
        let at = |q| self.histogram.quantile(q);
        let hz = |ns: f64| round_to(1e9 / ns, 4);
        let median_ns = at(0.5).filter(|&ns| ns > 0.0)?;
        let limit_ns = GAP_PERIODS * median_ns;
        let gap = |&(length, start_ns): &(u64, u64)| Gap { start_ns, ms: length as f64 / 1e6 };
        Some(Rate {
            median_hz: hz(median_ns),
            min_hz: hz(at(0.99)?),
            max_hz: at(0.01).filter(|&ns| ns > 0.0).map(hz),
            jitter_ms: round_to((at(0.95)? - at(0.05)?) / 2e6, 4),
            gaps: self.histogram.count_above(limit_ns),
            longest_gaps: self
                .longest
                .iter()
                .filter(|(length, _)| *length as f64 > limit_ns)
                .map(gap)
                .collect(),
        })
    }
}

/// Rounds to a number of significant digits: a histogram knows no more.
fn round_to(value: f64, digits: i32) -> f64 {
    if value == 0.0 || !value.is_finite() {
        return value;
    }
    let scale = 10_f64.powi(digits - 1 - value.abs().log10().floor() as i32);
    (value * scale).round() / scale
}

/// Statistics of one channel.
#[derive(Debug, Clone, Default)]
pub(super) struct ChannelStatistics {
    pub(super) messages: u64,
    pub(super) bytes: u64,
    pub(super) first_ns: Option<u64>,
    pub(super) last_ns: Option<u64>,
    pub(super) log_time_zero: u64,
    pub(super) duplicates: u64,
    /// Whether every sequence number is larger than the one before; wrapping ends it.
    is_sequence_broken: bool,
    last_sequence: Option<u32>,
    missing_by_sequence: u64,
    has_publish_clock: bool,
    log: Intervals,
    publish: Intervals,
    publish_to_log: Samples,
    stamp_to_log: Samples,
    stamp_to_publish: Samples,
    pub(super) stamps: u64,
    recent: VecDeque<(u64, u64, u32, u32)>,
}

impl ChannelStatistics {
    pub(super) fn add(&mut self, message: &Digest) {
        self.messages += 1;
        self.bytes += message.n_bytes;
        if self.log.last_ns.is_some_and(|last| message.log_time_ns.saturating_add(CLOCK_RESET_NS) <= last) {
            self.recent.clear();
        }
        self.count_duplicate(message);
        self.count_sequence(message.sequence);
        let log_ns = message.log_time_ns;
        self.log.add(log_ns);
        self.publish.add(message.publish_time_ns);
        self.has_publish_clock |= message.publish_time_ns != log_ns && message.publish_time_ns != 0;
        if log_ns == 0 {
            self.log_time_zero += 1;
        } else {
            self.first_ns = Some(self.first_ns.map_or(log_ns, |first| first.min(log_ns)));
            self.last_ns = Some(self.last_ns.map_or(log_ns, |last| last.max(log_ns)));
        }
        self.add_clocks(message);
    }

    fn add_clocks(&mut self, message: &Digest) {
        let signed = |time: u64| i64::try_from(time).ok().filter(|&time| time != 0);
        let (log, publish) = (signed(message.log_time_ns), signed(message.publish_time_ns));
        if let (Some(log), Some(publish)) = (log, publish) {
            self.publish_to_log.add(publish, log);
        }
        if let Some(stamp) = message.stamp_ns.filter(|&stamp| stamp != 0) {
            self.stamps += 1;
            log.into_iter().for_each(|log| self.stamp_to_log.add(stamp, log));
            publish.into_iter().for_each(|publish| self.stamp_to_publish.add(stamp, publish));
        }
    }

    fn count_duplicate(&mut self, message: &Digest) {
        let key = (message.log_time_ns, message.publish_time_ns, message.sequence, message.payload_crc);
        // Most recent first: a duplicate mostly follows at once, and a time that differs is cheap to see.
        if self.recent.iter().rev().any(|other| *other == key) {
            self.duplicates += 1;
        }
        if self.recent.len() == DUPLICATE_WINDOW {
            self.recent.pop_front();
        }
        self.recent.push_back(key);
    }

    fn count_sequence(&mut self, sequence: u32) {
        if let Some(last) = self.last_sequence.replace(sequence) {
            match sequence.checked_sub(last) {
                Some(0) | None => self.is_sequence_broken = true,
                Some(step) => self.missing_by_sequence += u64::from(step) - 1,
            }
        }
    }

    /// Messages that are missing by sequence number; `None` when the numbers do not only grow.
    pub(super) fn missing(&self) -> Option<u64> {
        (!self.is_sequence_broken && self.messages > 1).then_some(self.missing_by_sequence)
    }

    /// Backward steps of the log time in file order, and the largest in milliseconds.
    pub(super) fn backward_steps(&self) -> (u64, f64) {
        (self.log.backward, self.log.largest_backward_ns as f64 / 1e6)
    }

    pub(super) fn rate(&self) -> Option<Rate> {
        self.log.rate()
    }

    /// Rate by publish time; `None` when the writer has no publish clock.
    pub(super) fn publish_rate(&self) -> Option<Rate> {
        self.publish.rate().filter(|_| self.has_publish_clock)
    }

    pub(super) fn has_publish_clock(&self) -> bool {
        self.has_publish_clock
    }

    pub(super) fn publish_to_log(&self) -> Option<ClockOffset> {
        self.publish_to_log.offset().filter(|_| self.has_publish_clock)
    }

    pub(super) fn stamp_to_log(&self) -> Option<ClockOffset> {
        self.stamp_to_log.offset()
    }

    pub(super) fn stamp_to_publish(&self) -> Option<ClockOffset> {
        self.stamp_to_publish.offset().filter(|_| self.has_publish_clock)
    }
}
