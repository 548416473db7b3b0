//! The samples of one stream that may still be needed, sorted by time.

use std::collections::VecDeque;

/// The times of one sample.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SampleTime {
    /// What ticks are compared with, offset included.
    pub key_ns: i64,
    /// By the clock of the contract, offset included.
    pub clock_ns: i64,
    /// When it was logged.
    pub log_ns: i64,
    /// Number of the message within the recording; breaks ties.
    pub ordinal: u64,
}

/// Sorted samples of one stream: numbers (row-major) or images.
#[derive(Debug)]
pub(crate) struct Buffer<I> {
    width: usize,
    times: VecDeque<SampleTime>,
    /// Whether each sample is finite.
    finite: VecDeque<bool>,
    values: VecDeque<f64>,
    images: VecDeque<I>,
    /// Number of samples ever pushed.
    pub(crate) total: u64,
    /// Samples before this are not used: they lie before a jump of the clocks.
    pub(crate) barrier_ns: i64,
}

impl<I: Clone> Buffer<I> {
    pub(crate) fn new(width: usize) -> Self {
        Self {
            width,
            times: VecDeque::new(),
            finite: VecDeque::new(),
            values: VecDeque::new(),
            images: VecDeque::new(),
            total: 0,
            barrier_ns: i64::MIN,
        }
    }

    /// Adds a sample of numbers, in order of (key, ordinal).
    pub(crate) fn push_values(&mut self, time: SampleTime, values: &[f64]) {
        debug_assert_eq!(values.len(), self.width);
        let at = self.place(time);
        let is_finite = values.iter().all(|value| value.is_finite());
        self.values.extend(values);
        if at + 1 == self.times.len() {
            return self.finite.push_back(is_finite);
        }
        self.finite.insert(at, is_finite);
        // Moves the new values from the end to their place.
        for index in (at..self.times.len() - 1).rev() {
            for column in 0..self.width {
                self.values.swap(index * self.width + column, (index + 1) * self.width + column);
            }
        }
    }

    /// Adds an image.
    pub(crate) fn push_image(&mut self, time: SampleTime, image: I) {
        let at = self.place(time);
        self.finite.insert(at, true);
        self.images.insert(at, image);
    }

    fn place(&mut self, time: SampleTime) -> usize {
        let order = (time.key_ns, time.ordinal);
        self.total += 1;
        if self.times.back().is_none_or(|last| (last.key_ns, last.ordinal) <= order) {
            self.times.push_back(time);
            return self.times.len() - 1;
        }
        let at = self.times.partition_point(|other| (other.key_ns, other.ordinal) <= order);
        self.times.insert(at, time);
        at
    }

    /// Returns the number of samples at or before a time.
    ///
    /// What is asked for is near the oldest sample, since those before the last tick are forgotten: looked for from there
    /// in steps that double.
    fn count_at(&self, at_ns: i64) -> usize {
        let is_before = |index: usize| self.times.get(index).is_some_and(|time| time.key_ns <= at_ns);
        if !is_before(0) {
            return 0;
        }
        let (mut low, mut step) = (0, 1);
        while is_before(low + step) {
            low += step;
            step *= 2;
        }
        // Sample `low` is at or before the time, `high` is not.
        let mut high = (low + step).min(self.times.len());
        while high - low > 1 {
            let middle = low + (high - low) / 2;
            if is_before(middle) {
                low = middle;
            } else {
                high = middle;
            }
        }
        high
    }

    pub(crate) fn time(&self, index: usize) -> SampleTime {
        self.times[index]
    }

    pub(crate) fn is_finite(&self, index: usize) -> bool {
        self.finite[index]
    }

    pub(crate) fn image(&self, index: usize) -> &I {
        &self.images[index]
    }

    pub(crate) fn images(&self) -> impl Iterator<Item = &I> {
        self.images.iter()
    }

    /// Appends the values of a sample.
    pub(crate) fn copy_values(&self, index: usize, out: &mut Vec<f64>) {
        let (start, end) = (index * self.width, (index + 1) * self.width);
        let (front, back) = self.values.as_slices();
        if let Some(whole) = front.get(start..end) {
            return out.extend_from_slice(whole);
        }
        out.extend_from_slice(front.get(start..).unwrap_or_default());
        out.extend_from_slice(&back[start.saturating_sub(front.len())..end - front.len()]);
    }

    /// Returns the last usable sample at or before a time.
    pub(crate) fn last_at(&self, at_ns: i64) -> Option<usize> {
        let index = self.count_at(at_ns).checked_sub(1)?;
        self.is_usable(index).then_some(index)
    }

    /// Returns the first usable sample after a time.
    pub(crate) fn first_after(&self, at_ns: i64) -> Option<usize> {
        let index = self.count_at(at_ns.max(self.low()));
        (index < self.times.len()).then_some(index)
    }

    fn low(&self) -> i64 {
        self.barrier_ns.saturating_sub(1)
    }

    /// A stream that spoke once only is a latched one: it holds across jumps of the clocks.
    fn is_usable(&self, index: usize) -> bool {
        self.times[index].key_ns >= self.barrier_ns || self.total == 1
    }

    /// Returns the time of the newest sample.
    pub(crate) fn newest(&self) -> Option<i64> {
        self.times.back().map(|time| time.key_ns)
    }

    /// Forgets all samples before the last one at or before a time.
    pub(crate) fn forget_before(&mut self, at_ns: i64) {
        let keep = self.count_at(at_ns).saturating_sub(1);
        if keep == 0 {
            return;
        }
        self.times.drain(..keep);
        self.finite.drain(..keep);
        if self.width > 0 {
            self.values.drain(..keep * self.width);
        } else {
            self.images.drain(..keep);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn finds_what_a_search_through_all_finds() {
        let mut buffer: Buffer<()> = Buffer::new(1);
        let mut state = 7_u64;
        for ordinal in 0..400 {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
            // Mostly forward, sometimes back, often equal.
            let key_ns = ordinal as i64 * 3 - ((state >> 60) as i64);
            let time = SampleTime { key_ns, clock_ns: key_ns, log_ns: key_ns, ordinal };
            buffer.push_values(time, &[ordinal as f64]);
            let at_ns = (state >> 40) as i64 % 1300;
            let expected = buffer.times.iter().filter(|time| time.key_ns <= at_ns).count();
            assert_eq!(buffer.count_at(at_ns), expected);
            assert_eq!(buffer.last_at(at_ns), expected.checked_sub(1));
            if ordinal % 50 == 49 {
                buffer.forget_before(ordinal as i64 * 2);
            }
        }
        for index in 0..buffer.times.len() {
            let mut value = Vec::new();
            buffer.copy_values(index, &mut value);
            assert_eq!(value, [buffer.time(index).ordinal as f64], "values stay with their times");
        }
    }
}
