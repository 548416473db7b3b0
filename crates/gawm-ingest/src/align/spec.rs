//! What an aligner is told about its streams and features.

use gawm_schema::Kind;

/// Everything an [`Aligner`](super::Aligner) needs to know.
#[derive(Debug, Clone, PartialEq)]
pub struct AlignRule {
    /// The streams.
    pub streams: Vec<StreamRule>,
    /// The features, in column order.
    pub features: Vec<FeatureRule>,
    /// When rows are made.
    pub ticks: Ticks,
    /// Silence of all streams that splits whatever the rules say.
    pub max_gap_ns: i64,
}

/// One stream.
#[derive(Debug, Clone, PartialEq)]
pub struct StreamRule {
    /// Name, for reports.
    pub name: String,
    /// Values per sample; 0 for images.
    pub width: usize,
    /// Runs of one kind, in order; their widths add up to `width`.
    pub parts: Vec<PartKind>,
    /// How values at a tick are made.
    pub method: Method,
    /// Oldest usable sample, or widest bridged gap.
    pub tolerance_ns: Option<i64>,
    /// What happens where there is none.
    pub gap: GapAction,
    /// How commands become actions; none for observations.
    pub timing: Option<ActionTiming>,
    /// Whether a sample with a value that is not finite is a gap; otherwise its row is not valid.
    pub split_non_finite: bool,
}

impl StreamRule {
    /// Returns whether the stream carries images.
    pub fn is_image(&self) -> bool {
        self.width == 0
    }
}

/// A run of values of one kind within a sample.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PartKind {
    /// The kind.
    pub kind: Kind,
    /// Number of values.
    pub width: usize,
}

/// One feature.
#[derive(Debug, Clone, PartialEq)]
pub enum FeatureRule {
    /// Numbers of streams, joined in order.
    Vector {
        /// Indices of streams.
        streams: Vec<usize>,
    },
    /// Images of a stream.
    Image {
        /// Index of the stream.
        stream: usize,
    },
    /// An action made from another vector feature.
    Derived {
        /// Index of the feature.
        from: usize,
        /// How.
        derivation: Derivation,
        /// The kinds of the feature it is made from.
        parts: Vec<PartKind>,
    },
}

/// When rows are made.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ticks {
    /// A fixed rate.
    Fixed {
        /// Ticks per second.
        rate_hz: f64,
    },
    /// The samples of a stream.
    Reference {
        /// Index of the stream.
        stream: usize,
    },
}

/// How a value at a tick is made of samples.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Method {
    /// The last sample at or before the tick.
    Asof,
    /// The nearest sample.
    Nearest,
    /// Between the samples before and after; angles and rotations go the short way.
    Interpolate,
}

/// What happens where no sample is usable.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum GapAction {
    /// The episode ends and another begins after the gap.
    Split,
    /// The row is kept, its value is not valid.
    Mask,
    /// The episode is left out.
    DropEpisode,
    /// The run fails.
    Fail,
}

/// How commands become the action of row t.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ActionTiming {
    /// The last command at or before t.
    InForce,
    /// The first in (t, next tick].
    Next,
    /// The commands in (t, next tick], resampled to this many.
    Resample(usize),
    /// The commands in (t, next tick], as one.
    Reduce(Reduction),
}

impl ActionTiming {
    /// Returns the number of commands in a row.
    pub fn commands(self) -> usize {
        match self {
            ActionTiming::Resample(n) => n,
            _ => 1,
        }
    }
}

/// How the commands of a window become one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Reduction {
    /// The last one.
    Last,
    /// The mean; of angles on the circle.
    Mean,
    /// The sum.
    Sum,
    /// Linear parts added, rotations multiplied.
    Compose {
        /// Whether the later rotation is applied on the right.
        in_body_frame: bool,
    },
}

/// How an action is made from the state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Derivation {
    /// The next row's state.
    Next,
    /// The next row's state minus this row's; rotation vectors for rotations.
    Difference,
}

impl Derivation {
    /// Returns the kinds of the action made from a state of these kinds.
    pub fn parts(self, state: &[PartKind]) -> Vec<PartKind> {
        match self {
            Derivation::Next => state.to_vec(),
            Derivation::Difference => state
                .iter()
                .map(|part| {
                    let raw = part.kind.raw_width();
                    if raw > 1 {
                        PartKind { kind: Kind::Rotvec, width: part.width / raw * 3 }
                    } else {
                        PartKind { kind: Kind::Linear, width: part.width }
                    }
                })
                .collect(),
        }
    }
}
