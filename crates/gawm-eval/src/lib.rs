//! Planners, the evaluation harness, diagnostics and figures.

#![forbid(unsafe_code)]

pub mod agent;
pub mod evaluate;
pub mod numpy;
pub mod planner;
pub mod problem;
pub mod statistics;
pub mod world;
