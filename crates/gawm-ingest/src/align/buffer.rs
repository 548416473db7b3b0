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
        self.finite.insert(at, values.iter().all(|value| value.is_finite()));
        self.values.extend(values);
        // Moves the new values from the end to their place; at the end already, unless out of order.
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
        let at = self.times.partition_point(|other| (other.key_ns, other.ordinal) <= order);
        self.times.insert(at, time);
        self.total += 1;
        at
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

    /// Appends the values of a sample.
    pub(crate) fn copy_values(&self, index: usize, out: &mut Vec<f64>) {
        out.extend(self.values.range(index * self.width..(index + 1) * self.width));
    }

    /// Returns the last usable sample at or before a time.
    pub(crate) fn last_at(&self, at_ns: i64) -> Option<usize> {
        let end = self.times.partition_point(|time| time.key_ns <= at_ns);
        let index = end.checked_sub(1)?;
        self.is_usable(index).then_some(index)
    }

    /// Returns the first usable sample after a time.
    pub(crate) fn first_after(&self, at_ns: i64) -> Option<usize> {
        let index = self.times.partition_point(|time| time.key_ns <= at_ns.max(self.low()));
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
        let end = self.times.partition_point(|time| time.key_ns <= at_ns);
        let Some(keep) = end.checked_sub(1) else { return };
        self.times.drain(..keep);
        self.finite.drain(..keep);
        if self.width > 0 {
            self.values.drain(..keep * self.width);
        } else {
            self.images.drain(..keep);
        }
    }
}
