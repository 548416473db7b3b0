//! Planners, the evaluation harness, diagnostics and figures.
//!
//! A [`Run`](run::Run) is what a training left behind. [`program::plan`] draws [`Problem`](problem::Problem)s, lets the
//! model and every floor act on the same ones ([`suite`], [`evaluate`](evaluate::evaluate())) and gives a
//! [`PlanReport`](suite::PlanReport); [`diagnose`](diagnose::diagnose()) measures latents over fixed trajectories of a
//! [`Data`](data::Data)set; [`compare`](compare::compare()) makes one table of several runs. [`planner`] holds the
//! searches, [`figures`] draws. The command line ([`cli`]) is thin over these functions.
//!
//! ```
//! use gawm_eval::config::PlanConfig;
//! use gawm_eval::planner::PlannerConfig;
//! use gawm_eval::suite::Solver;
//!
//! // Without a run: floors and ceilings of TwoRoom, planning over its true dynamics among them.
//! let config = PlanConfig { count: 5, planner: Some(PlannerConfig::small()), ..PlanConfig::default() };
//! let result = gawm_eval::program::plan(None, None, None, &config, &|_, _, _| ())?;
//! let walls = &result.report.sets[1];
//! assert_eq!(walls.name, "wall");
//! assert_eq!(walls.solver(Solver::StraightLine).map(|line| line.any.rate), Some(0.0));
//! assert_eq!(walls.solver(Solver::Oracle).map(|oracle| oracle.any.rate), Some(1.0));
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Decision: planners live here, the published search in `gawm-model`
//!
//! A [`Planner`](planner::Planner) sees candidates and costs only, so that the search which is tested over a world model is
//! the one that makes the floors over known dynamics. `gawm-model` knows no environment; its `plan::cem`, which the golden
//! files test number by number, is wrapped and not copied.
//!
//! **Invariant**: an outcome is a function of problem, model, configuration and seeds; neither threads nor the other
//! problems of a batch change it, unless a deadline is set.
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
#[cfg(test)]
mod testing;
pub mod world;
