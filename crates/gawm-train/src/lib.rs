//! The training loop and its loader processes.
//!
//! A [`Trainer`](trainer::Trainer) takes batches from a [`BatchSource`](source::BatchSource), copies each to the device
//! ([`batch`]), takes a [`step`] or adds it to a [`validation`], and writes what happened into a
//! [`RunFolder`](run_folder::RunFolder). The product's source is [`Loaders`](loaders::Loaders): processes that write
//! batches into shared memory.
//!
//! ```text
//! slot ──view──> device ──> losses ──> gradients ──> clip ──> AdamW ──> metrics
//!   └─ released here
//! ```
//!
//! # Decision: the position in the sequence is the state
//!
//! The order of batches, validations included, is a pure function of a position (`gawm_schema::batch::Sequence`), and
//! all random numbers are functions of seed and step. So a checkpoint needs weights, moments, running statistics, one
//! position and the best score, and a run that was killed anywhere goes on to the bit.
//!
//! **Invariant**: nothing that a run writes into `metrics.jsonl` or a checkpoint depends on time, threads, the number of
//! loaders, or how often it was interrupted.
#![forbid(unsafe_code)]

pub mod config;

pub mod interrupt;
pub mod loaders;
pub mod source;

pub mod batch;
pub mod step;
pub mod validation;

pub mod state;

pub mod run_folder;

pub mod metrics;
pub mod output;

pub mod trainer;

pub mod cli;
