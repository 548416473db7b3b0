//! The section `[eval]` of a pipeline, and overrides of single fields.

use std::path::{Path, PathBuf};

use gawm_schema::pipeline::{Override, OverrideError, SECTIONS, unknown_section};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::diagnose::DiagnoseOptions;
use crate::planner::PlannerConfig;

/// Largest pipeline file.
const MAX_BYTES: u64 = 1 << 20;

/// The section `[eval]`.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct EvalConfig {
    /// Planning.
    pub plan: PlanConfig,
    /// Diagnostics and probes.
    pub diagnose: DiagnoseOptions,
}

/// Whose problems, goals and rules.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Protocol {
    /// Ours: unseen problems, none trivial, and those that need the door.
    #[default]
    Honest,
    /// As published: numpy's pairs over the dataset, goal at +24, trivial problems among them.
    Reference,
}

/// Where the problems of the honest protocol come from.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Source {
    /// Fresh episodes of the simulator's expert: as many as needed, none ever trained on.
    #[default]
    Simulator,
    /// Held-out episodes of the dataset, with its images as goals.
    Dataset,
}

/// Planning.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlanConfig {
    /// Whose problems, goals and rules. Default: honest.
    pub protocol: Protocol,
    /// Where problems come from. Default: simulator.
    pub source: Source,
    /// Name of the problem sets; sets of other names share no episode. `tuning` (default) while anything is still
    /// chosen, `final` once at the end.
    pub problems: String,
    /// Problems per set. Default 100; the published protocol has 50.
    pub count: usize,
    /// Rows from start to goal. Default 25; the published protocol has 24, whatever is said here.
    pub offset: usize,
    /// Steps that a solver has. Default 50, as published.
    pub budget_steps: usize,
    /// Seed of the choice of problems. Default 42, as published.
    pub seed: u64,
    /// Seed of the random floor and of untrained weights. Default 1.
    pub floor_seed: u64,
    /// Feature of the dataset that holds the state of the environment. Default: observation.state.
    pub system_feature: String,
    /// The search. Default: published size with our repairs; `compat = "reference"` with the published protocol.
    pub planner: Option<PlannerConfig>,
    /// Problems per set on the contact sheets. Default 8.
    pub sheet_rows: usize,
}

impl Default for PlanConfig {
    fn default() -> Self {
        PlanConfig {
            protocol: Protocol::Honest,
            source: Source::Simulator,
            problems: "tuning".to_owned(),
            count: 100,
            offset: 25,
            budget_steps: crate::evaluate::REFERENCE_BUDGET_STEPS,
            seed: 42,
            floor_seed: 1,
            system_feature: "observation.state".to_owned(),
            planner: None,
            sheet_rows: 8,
        }
    }
}

impl PlanConfig {
    /// Returns the search: what is configured, else what the protocol says.
    pub fn planner(&self) -> PlannerConfig {
        let default = match self.protocol {
            Protocol::Honest => PlannerConfig::default(),
            Protocol::Reference => PlannerConfig::reference(),
        };
        self.planner.clone().unwrap_or(default)
    }
}

/// Why a configuration cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read {path:?}: {cause}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// The file is no TOML, or a field is unknown or of the wrong type.
    #[error("{place}: {message}")]
    Syntax {
        /// The file, or the section.
        place: String,
        /// What the parser said.
        message: String,
    },
    /// A section that no program has.
    #[error("{path:?}: unknown section [{name}], expected one of {SECTIONS:?}")]
    Section {
        /// The file.
        path: PathBuf,
        /// The section.
        name: String,
    },
    /// An override does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// A number is out of range.
    #[error("{field}: expected {expected}, got {got}")]
    Range {
        /// The field.
        field: &'static str,
        /// What is allowed.
        expected: &'static str,
        /// The value.
        got: usize,
    },
}

/// Reads the section `[eval]` of a pipeline (all defaults without a file) and applies overrides `a.b=value`.
///
/// # Errors
/// - [`ConfigError`] names file or override and field.
pub fn read(path: Option<&Path>, overrides: &[String]) -> Result<EvalConfig, ConfigError> {
    let mut table = match path {
        Some(path) => section(path)?,
        None => toml::Table::new(),
    };
    for text in overrides {
        Override::of_section("eval", text)?.apply(&mut table)?;
    }
    from_table(&path.map_or_else(|| "[eval]".to_owned(), |path| format!("{} [eval]", path.display())), table)
}

/// Reads the section `[eval]`; `place` names it in errors.
///
/// # Errors
/// - [`ConfigError`] names the place and the field.
pub fn from_table(place: &str, table: toml::Table) -> Result<EvalConfig, ConfigError> {
    let place = place.to_owned();
    let config: EvalConfig = toml::Value::Table(table).try_into().map_err(|error: toml::de::Error| {
        ConfigError::Syntax { place, message: error.message().to_owned() }
    })?;
    let is_name = |c: char| c.is_ascii_alphanumeric() || "-_.".contains(c);
    let name = &config.plan.problems;
    if !(1..=64).contains(&name.len()) || !name.chars().all(is_name) || name.starts_with('.') {
        let message = format!(
            "plan.problems: expected a name of 1 to 64 letters, digits, '-', '_' and '.', got {name:?}"
        );
        return Err(ConfigError::Syntax { place: "[eval]".to_owned(), message });
    }
    for (field, got, high, expected) in [
        ("plan.count", config.plan.count, 100_000, "1 to 100000"),
        ("plan.offset", config.plan.offset, 10_000, "1 to 10000"),
        ("plan.budget_steps", config.plan.budget_steps, 100_000, "1 to 100000"),
    ] {
        if got == 0 || got > high {
            return Err(ConfigError::Range { field, expected, got });
        }
    }
    Ok(config)
}

fn section(path: &Path) -> Result<toml::Table, ConfigError> {
    let io = |cause| ConfigError::Io { path: path.to_owned(), cause };
    let syntax = |message| ConfigError::Syntax { place: path.display().to_string(), message };
    let size = std::fs::metadata(path).map_err(io)?.len();
    if size > MAX_BYTES {
        return Err(syntax(format!("expected at most {MAX_BYTES} bytes, got {size}")));
    }
    let text = std::fs::read_to_string(path).map_err(io)?;
    let mut file: toml::Table = text.parse().map_err(|error: toml::de::Error| syntax(error.to_string()))?;
    if let Some(name) = unknown_section(&file) {
        return Err(ConfigError::Section { path: path.to_owned(), name: name.to_owned() });
    }
    match file.remove("eval") {
        None => Ok(toml::Table::new()),
        Some(toml::Value::Table(table)) => Ok(table),
        Some(other) => Err(syntax(format!("eval: expected a table, got {}", other.type_str()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn overridden(texts: &[&str]) -> Result<EvalConfig, ConfigError> {
        let texts: Vec<String> = texts.iter().map(|text| (*text).to_owned()).collect();
        read(None, &texts)
    }

    #[test]
    fn overrides_reach_every_depth() {
        let config =
            overridden(&["plan.planner.samples=64", "plan.problems=final", "plan.planner.method=\"icem\""])
                .unwrap();
        let planner = config.plan.planner();
        assert_eq!((planner.samples, planner.iterations), (64, 30));
        assert_eq!(planner.method, crate::planner::Method::Icem);
        assert_eq!(config.plan.problems, "final");
    }

    #[test]
    fn wrong_fields_are_named() {
        for (text, names) in [
            ("plan.smaples=3", "smaples"),
            ("plan.count=0", "plan.count"),
            ("plan.planner.method=best", "best"),
            ("plan.count", "key=value"),
            ("plan.count=x", "plan.count=x"),
        ] {
            let error = overridden(&[text]).unwrap_err();
            let told = error.to_string();
            assert!(told.contains(names) || matches!(error, ConfigError::Syntax { .. }), "{text}: {told}");
        }
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.toml");
        std::fs::write(&path, "[evla]\n").unwrap();
        assert!(matches!(read(Some(&path), &[]), Err(ConfigError::Section { .. })));
    }
}
