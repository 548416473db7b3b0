//! The front door: every program of gawm in one binary, pipelines, and a quickstart.
//!
//! `gawm <verb> ...` is `gawm-<verb> ...`: [`cli`] hands the rest of the line to the `cli` module of that crate. A
//! [`pipeline::Pipeline`] is one TOML file whose sections name the steps from logs to a report; [`pipeline::run`] runs
//! the steps that are not up to date, each as a process of this same binary. [`quickstart::quickstart`] is such a pipeline with a
//! report at its end.
//!
//! # Decision: steps are processes
//!
//! A step that is killed, out of memory or interrupted ends alone, its memory is given back before the next begins, and
//! what a pipeline does can be repeated by hand: the command lines are printed and kept in the ledger.
//!
//! **Invariant**: a step is up to date only if its ledger entry has the key of everything it reads and its output is there.
#![forbid(unsafe_code)]

pub mod cli;
pub mod pipeline;
pub mod quickstart;
pub mod schemas;
