//! Pipelines: one TOML file from logs to a report.

mod ledger;
mod run;
mod steps;

use std::path::{Path, PathBuf};

use gawm_schema::pipeline::{Override, OverrideError, SECTIONS, unknown_section};
pub use ledger::{Ledger, LedgerEntry, LedgerError};
pub(crate) use run::pass_interrupts_on;
pub use run::{Outcome, RunError, RunOptions, StepReport, run};
pub(crate) use steps::Layout;
pub use steps::{Step, StepName, plan_steps};

/// A pipeline file, read and checked as far as the front door reads it.
///
/// What is inside a section is the business of the program that the section is for.
#[derive(Debug, Clone)]
pub struct Pipeline {
    /// Where it was read, for errors.
    pub path: PathBuf,
    /// The whole document, overrides applied.
    pub document: toml::Table,
}

/// Why a pipeline cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PipelineError {
    /// The file cannot be read.
    #[error("cannot read {path}")]
    Read {
        /// The pipeline.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not TOML.
    #[error("{path}: {detail}")]
    Syntax {
        /// The pipeline.
        path: PathBuf,
        /// What the parser says, with line and column.
        detail: String,
    },
    /// A top-level name that no program reads.
    #[error("{path}: unknown section `{name}`, expected one of {}", SECTIONS.join(", "))]
    UnknownSection {
        /// The pipeline.
        path: PathBuf,
        /// The name.
        name: String,
    },
    /// An override does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// There is neither `[sim]` nor a log.
    #[error("{path}: no logs: the pipeline has no [sim] section and no log was given")]
    NoLogs {
        /// The pipeline.
        path: PathBuf,
    },
    /// A section that every pipeline needs is absent.
    #[error("{path}: section [{name}] is missing")]
    MissingSection {
        /// The pipeline.
        path: PathBuf,
        /// The section.
        name: &'static str,
    },
}

impl Pipeline {
    /// Reads a pipeline file and applies overrides such as `train.steps=100`.
    ///
    /// # Errors
    ///
    /// The file cannot be read, is no TOML, has a section that no program reads, or an override does not fit.
    pub fn load(path: &Path, overrides: &[String]) -> Result<Pipeline, PipelineError> {
        let text = std::fs::read_to_string(path)
            .map_err(|source| PipelineError::Read { path: path.to_owned(), source })?;
        Pipeline::parse(path, &text, overrides)
    }

    /// Reads a pipeline from its text; `path` names it in errors.
    ///
    /// # Errors
    ///
    /// As [`Pipeline::load`].
    pub fn parse(path: &Path, text: &str, overrides: &[String]) -> Result<Pipeline, PipelineError> {
        let syntax = |detail: String| PipelineError::Syntax { path: path.to_owned(), detail };
        let mut document: toml::Table = toml::from_str(text).map_err(|error| syntax(error.to_string()))?;
        for text in overrides {
            Override::of_pipeline(text)?.apply(&mut document)?;
        }
        if let Some(name) = unknown_section(&document) {
            return Err(PipelineError::UnknownSection { path: path.to_owned(), name: name.to_owned() });
        }
        Ok(Pipeline { path: path.to_owned(), document })
    }

    /// Whether the file has this section.
    pub fn has(&self, section: &str) -> bool {
        self.document.contains_key(section)
    }

    /// Returns the text of these sections with overrides applied, for keys and for the resolved file.
    pub fn text_of(&self, sections: &[&str]) -> String {
        let part: toml::Table = self
            .document
            .iter()
            .filter(|(name, _)| sections.contains(&name.as_str()))
            .map(|(name, value)| (name.clone(), value.clone()))
            .collect();
        toml::to_string(&part).expect("a table that was parsed from TOML can be written as TOML")
    }
}

#[cfg(test)]
mod tests;
