//! The loop without processes: batches in memory, real steps, real folders.
#![expect(clippy::unwrap_used, reason = "a test ends where its helper does")]

mod determinism;
mod learning;
mod memory;
mod refusals;
