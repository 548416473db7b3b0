//! `gawm quickstart`: from nothing to a planned, examined world model and one page about it.
//!
//! It is a pipeline that is part of the program (`pipelines/quickstart.toml`), and a report of what came out.

mod report;
mod summary;

use std::path::{Path, PathBuf};

use gawm_eval::suite::PlanReport;

use crate::pipeline::{Layout, Outcome, Pipeline, RunError, RunOptions, run};

pub use summary::Summary;

/// The pipeline that is run.
pub const PIPELINE: &str = include_str!("../../../pipelines/quickstart.toml");

/// Why there is no report.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum QuickstartError {
    /// A step failed.
    #[error(transparent)]
    Run(#[from] RunError),
    /// What a step wrote cannot be read, or a result cannot be written.
    #[error("{path}")]
    Io {
        /// Which file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// What a step wrote is not what it should be.
    #[error("{path}: {detail}")]
    Content {
        /// Which file.
        path: PathBuf,
        /// What is wrong.
        detail: String,
    },
}

/// What a quickstart makes.
#[derive(Debug, Clone)]
pub struct Quickstart {
    /// What became of the steps.
    pub outcome: Outcome,
    /// The numbers of `summary.json`.
    pub summary: Summary,
    /// The page.
    pub report: PathBuf,
}

/// Runs the quickstart into a folder; steps that are up to date are not run again.
///
/// `overrides` change the pipeline, such as `train.seed=2`; `say` gets a line as each step begins and ends.
///
/// # Errors
///
/// A step fails, or what it made cannot be read.
pub fn quickstart(
    out: &Path,
    overrides: &[String],
    program: &Path,
    say: &mut dyn FnMut(&str),
) -> Result<Quickstart, QuickstartError> {
    let pipeline =
        Pipeline::parse(Path::new("quickstart"), PIPELINE, overrides).map_err(RunError::Pipeline)?;
    let options = RunOptions { out, logs: &[], until: None, from: None, is_dry: false, program };
    let outcome = run(&pipeline, &options, say)?;
    let layout = Layout::of(out);
    let plan: PlanReport = read_json(&layout.plan.join("plan.json"))?;
    let summary = Summary::of(&plan, &outcome)
        .map_err(|detail| QuickstartError::Content { path: layout.plan.join("plan.json"), detail })?;
    let page = report::page(&layout, &plan, &summary, &outcome)?;
    let report = out.join("report.html");
    write(&report, page.as_bytes())?;
    let json = serde_json::to_string_pretty(&summary).expect("a struct of numbers becomes JSON");
    write(&out.join("summary.json"), (json + "\n").as_bytes())?;
    Ok(Quickstart { outcome, summary, report })
}

fn read(path: &Path) -> Result<Vec<u8>, QuickstartError> {
    std::fs::read(path).map_err(|source| QuickstartError::Io { path: path.to_owned(), source })
}

fn read_json<T: serde::de::DeserializeOwned>(path: &Path) -> Result<T, QuickstartError> {
    serde_json::from_slice(&read(path)?)
        .map_err(|error| QuickstartError::Content { path: path.to_owned(), detail: error.to_string() })
}

fn write(path: &Path, bytes: &[u8]) -> Result<(), QuickstartError> {
    let part = path.with_extension("part");
    let io = |source| QuickstartError::Io { path: path.to_owned(), source };
    std::fs::write(&part, bytes).map_err(io)?;
    std::fs::rename(&part, path).map_err(io)
}
