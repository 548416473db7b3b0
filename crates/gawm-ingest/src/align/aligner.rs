//! The aligner: from samples to rows.

mod act;

use std::collections::VecDeque;

use super::buffer::Buffer;
use super::{
    ActionTiming, AlignRule, EndReason, EpisodeStart, FeatureRule, GapAction, GapEvent, Late, Method,
    Reduction, Row, RowSink, SampleTime, Stop, StreamRule, Ticks, interpolate,
};

#[derive(Debug, Clone, Copy)]
struct Interval {
    id: u64,
    start_ns: i64,
    end_ns: Option<i64>,
}

#[derive(Debug, Clone, Copy)]
enum State {
    /// No interval is open.
    Idle,
    /// Looks for the first tick at or after a time.
    Seek { from_ns: i64 },
    /// Makes rows.
    Run { t0_ns: i64, k: u64, last_ns: i64 },
}

enum Step {
    Again,
    Wait,
}

/// Whether a stream has a value at a time.
enum Availability {
    Now,
    /// Not before this later time.
    From(i64),
    /// No sample is known yet.
    Unknown,
}

/// Turns samples into rows; see the [module](super).
#[derive(Debug)]
pub struct Aligner<I> {
    rule: AlignRule,
    buffers: Vec<Buffer<I>>,
    intervals: VecDeque<Interval>,
    next_interval: u64,
    part: u32,
    state: State,
    complete_ns: i64,
    lookahead_ns: i64,
    period_ns: i64,
    row: Row<I>,
    pending: Option<Row<I>>,
    /// Values of the last finished actions, in feature order; empty at the start of an episode.
    last_actions: Vec<f64>,
    open_gap: Option<GapEvent>,
    masked_since: Vec<Option<GapEvent>>,
    scratch: Vec<f64>,
}

impl<I: Clone> Aligner<I> {
    /// Makes an aligner without samples and intervals.
    pub fn new(rule: AlignRule) -> Self {
        let lookahead_ns = rule
            .streams
            .iter()
            .filter(|stream| stream.timing.is_none() && stream.method != Method::Asof)
            .filter_map(|stream| stream.tolerance_ns)
            .max()
            .unwrap_or(0);
        let period_ns = match rule.ticks {
            Ticks::Fixed { rate_hz } => (1e9 / rate_hz).ceil() as i64,
            Ticks::Reference { .. } => 0,
        };
        Self {
            buffers: rule.streams.iter().map(|stream| Buffer::new(stream.width)).collect(),
            masked_since: vec![None; rule.streams.len()],
            rule,
            intervals: VecDeque::new(),
            next_interval: 0,
            part: 0,
            state: State::Idle,
            complete_ns: i64::MIN,
            lookahead_ns,
            period_ns,
            row: Row::empty(),
            pending: None,
            last_actions: Vec::new(),
            open_gap: None,
            scratch: Vec::new(),
        }
    }

    /// Returns the rules.
    pub fn rule(&self) -> &AlignRule {
        &self.rule
    }

    /// Returns how many samples a stream has had.
    pub fn samples(&self, stream: usize) -> u64 {
        self.buffers[stream].total
    }

    /// Returns the images that may still be needed.
    pub fn images(&self) -> impl Iterator<Item = &I> {
        self.buffers.iter().flat_map(Buffer::images)
    }

    /// Opens an interval in which rows are made; returns its number.
    pub fn open_interval(&mut self, start_ns: i64) -> u64 {
        let id = self.next_interval;
        self.next_interval += 1;
        self.intervals.push_back(Interval { id, start_ns, end_ns: None });
        id
    }

    /// Closes the interval opened last; the end is included.
    pub fn close_interval(&mut self, end_ns: i64) {
        if let Some(interval) = self.intervals.back_mut() {
            interval.end_ns = Some(interval.end_ns.map_or(end_ns, |end| end.min(end_ns)));
        }
    }

    /// Adds a sample of numbers.
    ///
    /// # Errors
    /// [`Late`] when [`Aligner::advance`] has said that all samples of that time are in.
    pub fn push_values(&mut self, stream: usize, time: SampleTime, values: &[f64]) -> Result<(), Late> {
        self.check_late(time)?;
        self.buffers[stream].push_values(time, values);
        Ok(())
    }

    /// Adds an image.
    ///
    /// # Errors
    /// [`Late`], as for [`Aligner::push_values`].
    pub fn push_image(&mut self, stream: usize, time: SampleTime, image: I) -> Result<(), Late> {
        self.check_late(time)?;
        self.buffers[stream].push_image(time, image);
        Ok(())
    }

    fn check_late(&self, time: SampleTime) -> Result<(), Late> {
        if time.key_ns < self.complete_ns {
            return Err(Late { key_ns: time.key_ns, complete_ns: self.complete_ns });
        }
        Ok(())
    }

    /// Makes all rows that no sample at or after `complete_ns` can change.
    ///
    /// # Errors
    /// [`Stop`] at a gap of a stream whose rule is `fail`.
    pub fn advance(&mut self, complete_ns: i64, sink: &mut impl RowSink<I>) -> Result<(), Stop> {
        self.complete_ns = self.complete_ns.max(complete_ns);
        while let Step::Again = self.step(sink)? {}
        Ok(())
    }

    /// Makes the remaining rows: no more samples come.
    ///
    /// # Errors
    /// As for [`Aligner::advance`].
    pub fn finish(&mut self, sink: &mut impl RowSink<I>) -> Result<(), Stop> {
        self.advance(i64::MAX, sink)?;
        if matches!(self.state, State::Run { .. }) {
            self.end_episode(EndReason::EndOfData, sink);
        }
        if let Some(event) = self.open_gap.take() {
            sink.gap(event);
        }
        for since in &mut self.masked_since {
            if let Some(event) = since.take() {
                sink.gap(event);
            }
        }
        Ok(())
    }

    fn is_final(&self) -> bool {
        self.complete_ns == i64::MAX
    }

    fn step(&mut self, sink: &mut impl RowSink<I>) -> Result<Step, Stop> {
        match self.state {
            State::Idle => match self.intervals.front() {
                Some(interval) => {
                    self.part = 0;
                    self.state = State::Seek { from_ns: interval.start_ns };
                    Ok(Step::Again)
                }
                None => {
                    self.forget(self.complete_ns.saturating_sub(self.lookahead_ns));
                    Ok(Step::Wait)
                }
            },
            State::Seek { from_ns } => Ok(self.seek(from_ns, sink)),
            State::Run { t0_ns, k, last_ns } => self.run(t0_ns, k, last_ns, sink),
        }
    }

    fn forget(&mut self, at_ns: i64) {
        for buffer in &mut self.buffers {
            buffer.forget_before(at_ns);
        }
    }

    fn interval_end(&self) -> Option<i64> {
        self.intervals.front().and_then(|interval| interval.end_ns)
    }

    fn leave_interval(&mut self) {
        self.intervals.pop_front();
        self.state = State::Idle;
    }

    fn seek(&mut self, from_ns: i64, sink: &mut impl RowSink<I>) -> Step {
        if self.interval_end().is_some_and(|end| from_ns > end) {
            self.leave_interval();
            return Step::Again;
        }
        if let Some(resumed_ns) = self.silence_around(from_ns) {
            let last_ns = self.newest_at(from_ns);
            for buffer in &mut self.buffers {
                buffer.barrier_ns = resumed_ns;
            }
            self.open_gap = None;
            sink.gap(GapEvent {
                stream: None,
                last_ns,
                resumed_ns: Some(resumed_ns),
                rule: GapAction::Split,
            });
            self.state = State::Seek { from_ns: resumed_ns.max(from_ns) };
            return Step::Again;
        }
        let Some(tick_ns) = self.first_tick(from_ns) else {
            if self.is_final() {
                self.leave_interval();
                return Step::Again;
            }
            // No tick can lie before what is not known yet, but for what a tick looks ahead.
            let known = self.complete_ns.saturating_sub(self.lookahead_ns.saturating_add(self.period_ns));
            let from_ns = from_ns.max(known);
            self.state = State::Seek { from_ns };
            self.forget(from_ns.min(known));
            return Step::Wait;
        };
        if self.interval_end().is_some_and(|end| tick_ns > end) {
            self.leave_interval();
            return Step::Again;
        }
        if !self.is_known_at(tick_ns, self.period_ns) {
            return Step::Wait;
        }
        if let Some(mut event) = self.open_gap.take() {
            event.resumed_ns = Some(tick_ns);
            sink.gap(event);
        }
        let interval = self.intervals.front().map_or(0, |interval| interval.id);
        sink.begin(EpisodeStart { interval, part: self.part, start_ns: tick_ns });
        self.part += 1;
        self.last_actions.clear();
        self.state = State::Run { t0_ns: tick_ns, k: 0, last_ns: tick_ns };
        Step::Again
    }

    fn is_known_at(&self, tick_ns: i64, ahead_ns: i64) -> bool {
        tick_ns.saturating_add(self.lookahead_ns.max(ahead_ns)) < self.complete_ns || self.is_final()
    }

    /// Returns the newest sample at or before a time, of streams that spoke more than once.
    fn newest_at(&self, at_ns: i64) -> Option<i64> {
        let spoken = self.buffers.iter().filter(|buffer| buffer.total > 1);
        spoken.filter_map(|buffer| buffer.last_at(at_ns).map(|index| buffer.time(index).key_ns)).max()
    }

    /// Returns when samples resume, if all streams are silent for too long around a time.
    fn silence_around(&self, at_ns: i64) -> Option<i64> {
        let last = self.newest_at(at_ns)?;
        let next =
            self.buffers.iter().filter_map(|b| b.first_after(at_ns).map(|i| b.time(i).key_ns)).min()?;
        (next.saturating_sub(last) > self.rule.max_gap_ns).then_some(next)
    }

    /// Returns the first tick at or after a time at which every stream has what it needs.
    fn first_tick(&self, from_ns: i64) -> Option<i64> {
        let mut at_ns = from_ns;
        loop {
            if let Ticks::Reference { stream } = self.rule.ticks {
                let buffer = &self.buffers[stream];
                at_ns = buffer.time(buffer.first_after(at_ns.saturating_sub(1))?).key_ns;
            }
            let mut later = None::<i64>;
            for index in 0..self.rule.streams.len() {
                match self.availability(index, at_ns) {
                    Availability::Now => {}
                    Availability::From(ns) => later = Some(later.map_or(ns, |other| other.max(ns))),
                    Availability::Unknown => return None,
                }
            }
            match later {
                None if self.has_begun(at_ns) => return Some(at_ns),
                None => {
                    at_ns = self
                        .buffers
                        .iter()
                        .filter_map(|b| Some(b.time(b.first_after(at_ns)?).key_ns))
                        .min()?
                }
                Some(ns) => at_ns = ns.max(at_ns.saturating_add(1)),
            }
        }
    }

    /// Whether there is anything at a time: where all streams may be masked, none of them says when rows begin.
    fn has_begun(&self, at_ns: i64) -> bool {
        self.rule.streams.iter().any(StreamRule::is_required)
            || self.buffers.iter().any(|buffer| buffer.last_at(at_ns).is_some())
    }

    fn availability(&self, stream: usize, at_ns: i64) -> Availability {
        let (rule, buffer) = (&self.rule.streams[stream], &self.buffers[stream]);
        let next = buffer.first_after(at_ns).map(|index| buffer.time(index).key_ns);
        let from_next = |ahead_ns: i64| match next {
            Some(ns) => Availability::From(ns.saturating_sub(ahead_ns)),
            None => Availability::Unknown,
        };
        if rule.gap == GapAction::Mask && !rule.is_image() {
            return Availability::Now;
        }
        if let Some(timing) = rule.timing
            && timing != ActionTiming::InForce
        {
            let has_next =
                next.is_some_and(|ns| ns <= at_ns.saturating_add(self.period_ns) || self.period_ns == 0);
            let may_hold = matches!(timing, ActionTiming::Resample(_))
                || matches!(timing, ActionTiming::Reduce(Reduction::Last | Reduction::Mean));
            let held = may_hold && self.last_within(stream, at_ns).is_some();
            return if has_next || held { Availability::Now } else { from_next(self.period_ns) };
        }
        if rule.gap == GapAction::Mask {
            return if buffer.last_at(at_ns).is_some() { Availability::Now } else { from_next(0) };
        }
        if self.pick(stream, at_ns).is_some() {
            return Availability::Now;
        }
        match rule.method {
            Method::Nearest => from_next(rule.tolerance_ns.unwrap_or(0)),
            Method::Asof | Method::Interpolate => from_next(0),
        }
    }

    /// Returns the last sample at or before a time, if it is within the tolerance.
    fn last_within(&self, stream: usize, at_ns: i64) -> Option<usize> {
        let (rule, buffer) = (&self.rule.streams[stream], &self.buffers[stream]);
        let index = buffer.last_at(at_ns)?;
        let age_ns = at_ns.saturating_sub(buffer.time(index).key_ns);
        let is_recent = rule.tolerance_ns.is_none_or(|tolerance| age_ns <= tolerance);
        (is_recent && (!rule.split_non_finite || buffer.is_finite(index))).then_some(index)
    }

    /// Returns which samples make the value at a tick: one, or two and the share of the second.
    fn pick(&self, stream: usize, at_ns: i64) -> Option<Pick> {
        let (rule, buffer) = (&self.rule.streams[stream], &self.buffers[stream]);
        let key = |index: usize| buffer.time(index).key_ns;
        match rule.method {
            Method::Asof => self.last_within(stream, at_ns).map(Pick::one),
            Method::Nearest => {
                let before = buffer.last_at(at_ns);
                let after = buffer.first_after(at_ns);
                let nearest = match (before, after) {
                    (Some(a), Some(b)) if key(b) - at_ns < at_ns - key(a) => b,
                    (Some(a), _) => a,
                    (None, Some(b)) => b,
                    (None, None) => return None,
                };
                let distance = (key(nearest).saturating_sub(at_ns)).abs();
                rule.tolerance_ns.is_none_or(|tolerance| distance <= tolerance).then_some(Pick::one(nearest))
            }
            Method::Interpolate => {
                let before = buffer.last_at(at_ns)?;
                if key(before) == at_ns {
                    return Some(Pick::one(before));
                }
                let after = buffer.first_after(at_ns)?;
                let width = key(after).saturating_sub(key(before));
                if rule.tolerance_ns.is_some_and(|tolerance| width > tolerance) {
                    return None;
                }
                let share = (at_ns - key(before)) as f64 / width as f64;
                Some(Pick { index: before, second: Some((after, share)) })
            }
        }
    }

    fn run(&mut self, t0_ns: i64, k: u64, last_ns: i64, sink: &mut impl RowSink<I>) -> Result<Step, Stop> {
        let Some(tick_ns) = self.tick(t0_ns, k, last_ns) else {
            if !self.is_final() {
                return Ok(Step::Wait);
            }
            self.end_episode(EndReason::EndOfData, sink);
            self.leave_interval();
            return Ok(Step::Again);
        };
        if self.interval_end().is_some_and(|end| tick_ns > end) {
            self.end_episode(EndReason::Interval, sink);
            self.leave_interval();
            return Ok(Step::Again);
        }
        if !self.is_known_at(tick_ns, 0) {
            return Ok(Step::Wait);
        }
        if self.is_final() && self.buffers.iter().all(|buffer| buffer.newest().is_none_or(|ns| ns < tick_ns))
        {
            self.end_episode(EndReason::EndOfData, sink);
            self.leave_interval();
            return Ok(Step::Again);
        }
        if self.newest_at(tick_ns).is_some_and(|ns| tick_ns.saturating_sub(ns) > self.rule.max_gap_ns) {
            self.end_episode(EndReason::Silence, sink);
            self.state = State::Seek { from_ns: tick_ns };
            return Ok(Step::Again);
        }
        if let Some(stream) = self.observe(tick_ns, k > 0, sink) {
            return self.at_gap(stream, tick_ns, sink);
        }
        let mut row = std::mem::replace(&mut self.row, Row::empty());
        if let Some(mut pending) = self.pending.take() {
            if let Some(stream) = self.act(&mut pending, &row) {
                self.pending = Some(pending);
                self.row = row;
                return self.at_gap(stream, tick_ns, sink);
            }
            sink.row(&pending);
            std::mem::swap(&mut self.row, &mut pending);
        }
        row.time_ns = tick_ns;
        self.pending = Some(row);
        self.forget(tick_ns);
        self.state = State::Run { t0_ns, k: k + 1, last_ns: tick_ns };
        Ok(Step::Again)
    }

    /// Returns tick number `k`, or `None` when it is not known yet.
    fn tick(&self, t0_ns: i64, k: u64, last_ns: i64) -> Option<i64> {
        match self.rule.ticks {
            Ticks::Fixed { rate_hz } => {
                let offset = (k as f64 * 1e9 / rate_hz).round() as i64;
                Some(t0_ns.saturating_add(offset))
            }
            Ticks::Reference { .. } if k == 0 => Some(t0_ns),
            Ticks::Reference { stream } => {
                let buffer = &self.buffers[stream];
                buffer.first_after(last_ns).map(|index| buffer.time(index).key_ns)
            }
        }
    }

    fn at_gap(&mut self, stream: usize, tick_ns: i64, sink: &mut impl RowSink<I>) -> Result<Step, Stop> {
        let buffer = &self.buffers[stream];
        let last_ns = match (&self.pending, self.rule.ticks) {
            // A pause of the stream that gives the ticks lies before this tick, which is a sample of it.
            (Some(pending), Ticks::Reference { stream: reference }) if reference == stream => {
                Some(pending.time_ns)
            }
            _ => buffer.last_at(tick_ns).map(|index| buffer.time(index).key_ns),
        };
        let rule = self.rule.streams[stream].gap;
        if self.is_last_breath(stream, tick_ns) {
            self.end_episode(EndReason::EndOfData, sink);
            self.leave_interval();
            return Ok(Step::Again);
        }
        let event = GapEvent { stream: Some(stream), last_ns, resumed_ns: None, rule };
        match rule {
            GapAction::Fail => Err(Stop { stream, tick_ns, last_ns }),
            GapAction::DropEpisode => {
                let interval = self.intervals.front().map_or(0, |interval| interval.id);
                self.pending = None;
                sink.end(EndReason::Gap { stream });
                sink.discard(interval);
                sink.gap(event);
                self.leave_interval();
                Ok(Step::Again)
            }
            GapAction::Split | GapAction::Mask => {
                self.end_episode(EndReason::Gap { stream }, sink);
                self.open_gap = Some(event);
                self.state = State::Seek { from_ns: tick_ns };
                Ok(Step::Again)
            }
        }
    }

    /// Whether the stream ended when, within its tolerance, all others did: that is no gap.
    fn is_last_breath(&self, stream: usize, tick_ns: i64) -> bool {
        let buffer = &self.buffers[stream];
        if !self.is_final() || buffer.first_after(tick_ns).is_some() {
            return false;
        }
        let end = self.buffers.iter().filter_map(Buffer::newest).max();
        let tolerance = self.rule.streams[stream].tolerance_ns.unwrap_or(0).max(self.period_ns);
        end.zip(buffer.newest()).is_some_and(|(end, last)| end.saturating_sub(last) <= tolerance)
    }

    /// Fills the observations of `self.row`; returns the first stream with a gap that makes no row.
    fn observe(&mut self, tick_ns: i64, is_inside: bool, sink: &mut impl RowSink<I>) -> Option<usize> {
        if let (Ticks::Reference { stream }, true) = (self.rule.ticks, is_inside)
            && self.reference_gap(stream, tick_ns)
        {
            return Some(stream);
        }
        let mut row = std::mem::replace(&mut self.row, Row::empty());
        row.clear(tick_ns, self.rule.streams.len());
        let mut gap = None;
        let features = std::mem::take(&mut self.rule.features);
        'features: for feature in &features {
            let mut valid = true;
            match feature {
                FeatureRule::Derived { .. } => valid = false,
                FeatureRule::Vector { streams } => {
                    for &stream in streams {
                        if self.rule.streams[stream].timing.is_some() {
                            valid = false;
                        } else if let Err(at) =
                            self.observe_values(stream, tick_ns, &mut row, &mut valid, sink)
                        {
                            gap = Some(at);
                            break 'features;
                        }
                    }
                }
                FeatureRule::Image { stream } => match self.observe_image(*stream, tick_ns, &mut row, sink) {
                    Some(is_valid) => valid = is_valid,
                    None => {
                        gap = Some(*stream);
                        break 'features;
                    }
                },
            }
            row.valid.push(valid);
        }
        self.rule.features = features;
        self.row = row;
        gap
    }

    /// Whether the reference stream itself paused for longer than its tolerance before this tick.
    fn reference_gap(&self, stream: usize, tick_ns: i64) -> bool {
        let (Some(pending), Some(tolerance)) = (&self.pending, self.rule.streams[stream].tolerance_ns) else {
            return false;
        };
        tick_ns.saturating_sub(pending.time_ns) > tolerance
    }

    fn observe_values(
        &mut self,
        stream: usize,
        tick_ns: i64,
        row: &mut Row<I>,
        valid: &mut bool,
        sink: &mut impl RowSink<I>,
    ) -> Result<(), usize> {
        let picked = self.pick(stream, tick_ns);
        let rule = &self.rule.streams[stream];
        let Some(pick) = picked else {
            if rule.gap != GapAction::Mask {
                return Err(stream);
            }
            row.values.extend(std::iter::repeat_n(f64::NAN, rule.width));
            *valid = false;
            self.set_age(stream, tick_ns, self.buffers[stream].last_at(tick_ns), row);
            self.mask(stream, tick_ns);
            return Ok(());
        };
        self.unmask(stream, tick_ns, sink);
        let rule = &self.rule.streams[stream];
        let buffer = &self.buffers[stream];
        self.set_age(stream, tick_ns, Some(pick.index), row);
        match pick.second {
            Some((after, share)) => {
                let mut ends = std::mem::take(&mut self.scratch);
                ends.clear();
                buffer.copy_values(pick.index, &mut ends);
                buffer.copy_values(after, &mut ends);
                let (a, b) = ends.split_at(rule.width);
                let start = row.values.len();
                interpolate::between(&rule.parts, a, b, share, &mut row.values);
                *valid &= row.values[start..].iter().all(|value| value.is_finite());
                self.scratch = ends;
            }
            None => *valid &= self.copy(stream, pick.index, &mut row.values),
        }
        Ok(())
    }

    /// Appends a sample; returns whether it is finite.
    fn copy(&self, stream: usize, index: usize, out: &mut Vec<f64>) -> bool {
        let buffer = &self.buffers[stream];
        buffer.copy_values(index, out);
        buffer.is_finite(index)
    }

    /// Returns the validity of the image, or `None` where there is to be no row.
    fn observe_image(
        &mut self,
        stream: usize,
        tick_ns: i64,
        row: &mut Row<I>,
        sink: &mut impl RowSink<I>,
    ) -> Option<bool> {
        if let Some(pick) = self.pick(stream, tick_ns) {
            self.unmask(stream, tick_ns, sink);
            row.images.push(self.buffers[stream].image(pick.index).clone());
            self.set_age(stream, tick_ns, Some(pick.index), row);
            return Some(true);
        }
        if self.rule.streams[stream].gap != GapAction::Mask {
            return None;
        }
        let held = self.buffers[stream].last_at(tick_ns)?;
        row.images.push(self.buffers[stream].image(held).clone());
        self.set_age(stream, tick_ns, Some(held), row);
        self.mask(stream, tick_ns);
        Some(false)
    }

    fn mask(&mut self, stream: usize, tick_ns: i64) {
        if self.masked_since[stream].is_none() {
            let buffer = &self.buffers[stream];
            let last_ns = buffer.last_at(tick_ns).map(|index| buffer.time(index).key_ns);
            let event = GapEvent { stream: Some(stream), last_ns, resumed_ns: None, rule: GapAction::Mask };
            self.masked_since[stream] = Some(event);
        }
    }

    fn unmask(&mut self, stream: usize, tick_ns: i64, sink: &mut impl RowSink<I>) {
        if let Some(mut event) = self.masked_since[stream].take() {
            event.resumed_ns = Some(tick_ns);
            sink.gap(event);
        }
    }

    fn set_age(&self, stream: usize, tick_ns: i64, index: Option<usize>, row: &mut Row<I>) {
        let Some(index) = index else { return };
        let time = self.buffers[stream].time(index);
        row.age_ms[stream] = age_ms(tick_ns, time.clock_ns);
        row.arrival_age_ms[stream] = age_ms(tick_ns, time.log_ns);
    }
}

struct Pick {
    index: usize,
    second: Option<(usize, f64)>,
}

impl Pick {
    fn one(index: usize) -> Self {
        Self { index, second: None }
    }
}

fn age_ms(tick_ns: i64, sample_ns: i64) -> f32 {
    (tick_ns.saturating_sub(sample_ns) as f64 / 1e6) as f32
}

impl StreamRule {
    /// Returns whether rows wait for the stream.
    pub fn is_required(&self) -> bool {
        self.gap != GapAction::Mask || self.is_image()
    }
}
