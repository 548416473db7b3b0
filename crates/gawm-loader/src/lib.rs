//! Samples clips from datasets and decodes them straight into shared-memory slots.
//!
//! An [`Index`] is built from datasets and a [`LoaderConfig`]: it knows every clip, their order, the standardisation and
//! where each frame lies. A [`BatchMaker`] fills the bytes of a slot with any batch of the run; [`serve::serve`] does so for
//! a trainer, batch after batch.
//!
//! ```text
//! dataset ── rows (numbers, validity) ──┐
//!         └─ frames (positions) ────────┤
//! configuration ── clips, split ────────┼─> Index ──> BatchMaker::fill(n) ──> slot ──> trainer
//!                └─ order(seed, epoch) ─┘
//! ```
//!
//! Design decision: the n-th batch is a pure function of datasets, configuration and n. Loaders share no state but the
//! hello message, so any number of them, started anywhere in a run, makes the same stream.
//!
//! Positions of frames come from the offset index of the Parquet files when an index is built (a few tens of
//! nanoseconds per frame), not from a file of our own that could be stale; one positional read then fetches a frame.
//!
//! **Invariant**: pixels are decoded into the slot, or copied there from a cache, and nowhere else.
#![forbid(unsafe_code)]

mod bench;
mod cache;
pub mod cli;
mod clips;
mod config;
mod error;
mod frames;
mod index;
mod maker;
mod mt19937;
mod order;
mod rows;
pub mod serve;
mod source;
mod standard;

pub use cache::{Cache, CachePlan};
pub use config::{Compat, ConfigError, LoaderConfig, MixEntry, SplitRule};
pub use error::LoadError;
pub use index::{Index, RunLength};
pub use maker::BatchMaker;
pub use mt19937::Mt19937;

#[cfg(test)]
mod tests;
