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
    /// A program would not take its section.
    #[error("{path} [{section}]: {detail}")]
    Section {
        /// The pipeline.
        path: PathBuf,
        /// The section, or those that are read together.
        section: &'static str,
        /// What the program would say.
        detail: String,
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

    /// Checks every section as its program will: a typo in `[eval]` shows before a model is trained, not after.
    ///
    /// # Errors
    ///
    /// [`PipelineError::Section`] with what the first program says that would refuse its section.
    pub fn check(&self) -> Result<(), PipelineError> {
        let refuse = |section| {
            let path = self.path.clone();
            move |detail: String| PipelineError::Section { path, section, detail }
        };
        if let Some(section) = self.document.get("sim") {
            let read: Result<gawm_sim::cli::SimConfig, _> = section.clone().try_into();
            read.map_err(|error: toml::de::Error| refuse("sim")(error.message().to_owned()))?;
        }
        if self.has("ingest") {
            gawm_ingest::contract::parse(&self.text_of(&["ingest"]), "ingest", &[])
                .map_err(|error| refuse("ingest")(error.to_string()))?;
        }
        gawm_loader::LoaderConfig::from_pipeline(&self.text_of(&["loader"]), &[])
            .map_err(|error| refuse("loader")(error.to_string()))?;
        let trained = self.text_of(&["loader", "model", "objectives", "train"]);
        gawm_train::config::Config::parse("trainer", &trained, &[])
            .map_err(|error| refuse("model, objectives or train")(error.to_string()))?;
        let eval = self.document.get("eval").and_then(toml::Value::as_table).cloned().unwrap_or_default();
        gawm_eval::config::from_table("eval", eval).map_err(|error| refuse("eval")(error.to_string()))?;
        Ok(())
    }

    /// Returns the pipeline for another folder: what its contract names relative to the file is named absolutely.
    fn moved(&self) -> std::io::Result<Pipeline> {
        let mut moved = self.clone();
        let base = self.path.parent().unwrap_or(Path::new(""));
        for name in contract_paths(&mut moved.document) {
            *name = std::path::absolute(base.join(&*name))?.to_string_lossy().into_owned();
        }
        Ok(moved)
    }

    /// Returns the files and folders that the contract names.
    fn contract_files(&self) -> Vec<PathBuf> {
        let base = self.path.parent().unwrap_or(Path::new(""));
        contract_paths(&mut self.document.clone()).into_iter().map(|name| base.join(&*name)).collect()
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

/// The paths in `[ingest]`, relative to the file that the section stands in.
fn contract_paths(document: &mut toml::Table) -> Vec<&mut String> {
    let Some(toml::Value::Table(ingest)) = document.get_mut("ingest") else { return Vec::new() };
    let mut names = Vec::new();
    for (key, value) in ingest.iter_mut() {
        let found = match key.as_str() {
            "schemas" => value,
            "task_schema" => match value.get_mut("file") {
                Some(file) => file,
                None => continue,
            },
            "labels" => match value.get_mut("side_file") {
                Some(file) => file,
                None => continue,
            },
            _ => continue,
        };
        match found {
            toml::Value::String(name) => names.push(name),
            toml::Value::Array(list) => names.extend(list.iter_mut().filter_map(|entry| match entry {
                toml::Value::String(name) => Some(name),
                _ => None,
            })),
            _ => {}
        }
    }
    names
}

#[cfg(test)]
mod tests;
