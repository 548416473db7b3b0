//! Environments and log collection: native TwoRoom.
//!
//! An [`Environment`] is reset or put into a state, stepped and rendered; [`TwoRoom`] is one. [`collect`] lets an expert
//! act in an environment and writes what happens as MCAP logs, as a robot's recorder would. The same seed gives the same
//! logs, to the byte, whatever the number of jobs: exact data for every later test, without any download.
//!
//! Randomness comes from seeds alone. A policy's noise is a stream of its own, so that a change of policy leaves the
//! starts and goals of a seed as they are.
//!
//! **Invariant**: this crate knows neither datasets nor tensors; what it writes is read by `gawm-ingest`.
#![forbid(unsafe_code)]

pub mod cli;
pub mod collect;
mod environment;
mod exp;
mod rng;
pub mod two_room;

pub use environment::{Axis, Environment, EnvironmentError, EnvironmentSpec, Frame, State, Step};
pub use two_room::{TwoRoom, TwoRoomConfig, TwoRoomExpert};
