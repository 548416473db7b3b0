//! What an aligner makes, and what it tells on the way.

use super::GapAction;

/// One aligned row.
#[derive(Debug, Clone, PartialEq)]
pub struct Row<I> {
    /// The tick.
    pub time_ns: i64,
    /// Values of all vector features, one feature after the other.
    pub values: Vec<f64>,
    /// Validity per feature, images included.
    pub valid: Vec<bool>,
    /// Images of all image features, in order.
    pub images: Vec<I>,
    /// Tick minus sample time per stream, in ms; NaN where there is no sample.
    pub age_ms: Vec<f32>,
    /// Tick minus log time per stream, in ms; NaN where there is no sample.
    pub arrival_age_ms: Vec<f32>,
}

/// The begin of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeStart {
    /// Number of the interval (marked episode) it belongs to.
    pub interval: u64,
    /// Number of the part within the interval; above 0 after a split.
    pub part: u32,
    /// Its first tick.
    pub start_ns: i64,
}

/// Why an episode ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum EndReason {
    /// Its interval ended.
    Interval,
    /// The samples ended.
    EndOfData,
    /// A stream had a gap.
    Gap {
        /// Index of the stream.
        stream: usize,
    },
    /// All streams were silent.
    Silence,
}

/// A time without usable samples of a stream, or of all.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GapEvent {
    /// Index of the stream; none when all were silent.
    pub stream: Option<usize>,
    /// The last sample before, if any.
    pub last_ns: Option<i64>,
    /// The next usable time, if any.
    pub resumed_ns: Option<i64>,
    /// What was done.
    pub rule: GapAction,
}

/// A sample that came after its time had been dealt with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Late {
    /// The time of the sample.
    pub key_ns: i64,
    /// All samples before this were taken to be in.
    pub complete_ns: i64,
}

/// A gap where the contract says `fail`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Stop {
    /// Index of the stream.
    pub stream: usize,
    /// The tick without a usable sample.
    pub tick_ns: i64,
    /// The last sample before.
    pub last_ns: Option<i64>,
}

/// Takes what an aligner makes.
pub trait RowSink<I> {
    /// An episode begins.
    fn begin(&mut self, start: EpisodeStart);
    /// A row of the episode is finished.
    fn row(&mut self, row: &Row<I>);
    /// The episode ends.
    fn end(&mut self, reason: EndReason);
    /// The interval is to be left out, whatever rows it gave.
    fn discard(&mut self, interval: u64);
    /// A gap is over, or the data is.
    fn gap(&mut self, event: GapEvent);
}

impl<I> Row<I> {
    pub(super) fn empty() -> Self {
        Self {
            time_ns: 0,
            values: Vec::new(),
            valid: Vec::new(),
            images: Vec::new(),
            age_ms: Vec::new(),
            arrival_age_ms: Vec::new(),
        }
    }

    pub(super) fn clear(&mut self, time_ns: i64, n_streams: usize) {
        self.time_ns = time_ns;
        self.values.clear();
        self.valid.clear();
        self.images.clear();
        self.age_ms.clear();
        self.age_ms.resize(n_streams, f32::NAN);
        self.arrival_age_ms.clear();
        self.arrival_age_ms.resize(n_streams, f32::NAN);
    }
}
