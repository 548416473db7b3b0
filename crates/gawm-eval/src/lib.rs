//! Planners, the evaluation harness, diagnostics and figures.

#![forbid(unsafe_code)]

pub mod agent;
pub mod cli;
pub mod compare;
pub mod config;
pub mod data;
pub mod diagnose;
pub mod encode;
pub mod evaluate;
pub mod figures;
pub mod latent;
pub mod numpy;
pub mod output;
pub mod planner;
pub mod probe;
pub mod problem;
pub mod program;
pub mod run;
pub mod sheet;
pub mod statistics;
pub mod suite;
pub mod world;
