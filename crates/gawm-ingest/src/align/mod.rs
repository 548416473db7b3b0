//! Alignment: samples of several streams become rows at ticks. No I/O, no clock, no knowledge of logs.
//!
//! An [`Aligner`] takes samples as they are read (out of order within the disorder window), is told up to which time
//! all samples are in ([`Aligner::advance`]), and hands finished rows to a [`RowSink`]. It holds no more than what
//! the window, the tolerance and one tick need.
//!
//! **Invariant**: an observation under `asof` or `hold` uses no sample later than its tick; an action uses commands
//! of its own interval only; nothing is ever filled with zeros.

mod action;
mod aligner;
mod buffer;
mod event;
mod interpolate;
mod spec;

#[cfg(test)]
mod tests;

pub use aligner::Aligner;
pub use buffer::SampleTime;
pub use event::{EndReason, EpisodeStart, GapEvent, Late, Row, RowSink, Stop};
pub use spec::{
    ActionTiming, AlignRule, Derivation, FeatureRule, GapAction, Method, PartKind, Reduction, StreamRule,
    Ticks,
};
