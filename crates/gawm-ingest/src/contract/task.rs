//! Task schemas: what a task records, shared by the contracts that ingest it.
//!
//! A schema lists the streams of a task once: those of every variant, and the state target as published (`reference`) and
//! repaired. A contract that names one has these streams before its own; the resolved contract holds them written out.

use std::path::Path;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::{Contract, ContractError, StreamSpec};

/// Which schema a contract takes, and which of its state targets.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TaskSchemaSpec {
    /// Name of a built-in schema: `tworoom`, `reacher`, `pusht`, `cube`, `pingpong`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub name: Option<String>,
    /// File of a schema, relative to the contract, in place of a name.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub file: Option<std::path::PathBuf>,
    /// The state target.
    #[serde(default)]
    pub target: TargetName,
}

/// The built-in schemas: the files of the folder `schemas/`.
const BUILT_IN: [(&str, &str); 5] = [
    ("cube", include_str!("../../../../schemas/cube.toml")),
    ("pingpong", include_str!("../../../../schemas/pingpong.toml")),
    ("pusht", include_str!("../../../../schemas/pusht.toml")),
    ("reacher", include_str!("../../../../schemas/reacher.toml")),
    ("tworoom", include_str!("../../../../schemas/tworoom.toml")),
];

/// A state target of a task schema.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum TargetName {
    /// As published: the same values in the same order, for `compat = "reference"`.
    Reference,
    /// What the published one gets wrong put right.
    #[default]
    Repaired,
}

/// What a task records.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct TaskSchema {
    /// Version of this format; only 1 exists.
    pub version: u32,
    /// Name of the task.
    pub task: String,
    /// Kind of robot, for contracts that name none.
    pub robot_type: String,
    /// Control steps per second, for contracts that state no ticks.
    pub fps: u32,
    /// Action and cameras: the same for both targets.
    #[serde(default)]
    pub stream: Vec<StreamSpec>,
    /// The state target as published.
    pub reference: StateTarget,
    /// The repaired one.
    pub repaired: StateTarget,
}

/// A state target: the streams of `observation.state` and what is known of the encoded columns.
#[derive(Debug, Clone, PartialEq, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct StateTarget {
    /// The streams, in the order of the columns.
    pub stream: Vec<StreamSpec>,
    /// Number of encoded columns (`gawm.state`).
    pub width: usize,
    /// Encoded columns that are velocities: nothing can be said of them from the first frame alone.
    #[serde(default)]
    pub velocity: Vec<usize>,
    /// Encoded columns that are supervised; absent: all.
    #[serde(default)]
    pub supervised: Option<Vec<usize>>,
}

impl TaskSchema {
    /// Reads a schema from a file.
    ///
    /// # Errors
    /// The file cannot be read, is not TOML, has other keys, or its columns do not fit its width.
    pub fn load(path: &Path) -> Result<TaskSchema, ContractError> {
        let shown = path.display().to_string();
        let text = std::fs::read_to_string(path).map_err(|source| ContractError::TaskSchema {
            schema: shown.clone(),
            detail: source.to_string(),
        })?;
        TaskSchema::parse(&text, &shown)
    }

    /// Returns a built-in schema.
    ///
    /// # Errors
    /// There is none of this name.
    pub fn built_in(name: &str) -> Result<TaskSchema, ContractError> {
        match BUILT_IN.iter().find(|(known, _)| *known == name) {
            Some((_, text)) => TaskSchema::parse(text, name),
            None => {
                let known: Vec<&str> = BUILT_IN.iter().map(|(known, _)| *known).collect();
                let detail = format!("expected one of {}, got {name:?}", known.join(", "));
                Err(ContractError::TaskSchema { schema: name.to_owned(), detail })
            }
        }
    }

    fn parse(text: &str, shown: &str) -> Result<TaskSchema, ContractError> {
        let bad = |detail: String| ContractError::TaskSchema { schema: shown.to_owned(), detail };
        let schema: TaskSchema =
            toml::from_str(text).map_err(|error| bad(error.to_string().trim_end().to_owned()))?;
        if schema.version != 1 {
            return Err(bad(format!("version: expected 1, got {}", schema.version)));
        }
        for (name, target) in [("reference", &schema.reference), ("repaired", &schema.repaired)] {
            let columns = target.velocity.iter().chain(target.supervised.iter().flatten());
            if let Some(column) = columns.into_iter().find(|column| **column >= target.width) {
                return Err(bad(format!("{name}: expected columns below {}, got {column}", target.width)));
            }
        }
        Ok(schema)
    }

    /// Returns a target.
    pub fn target(&self, name: TargetName) -> &StateTarget {
        match name {
            TargetName::Reference => &self.reference,
            TargetName::Repaired => &self.repaired,
        }
    }
}

/// Writes the streams of the task schema out, if the contract names one; `folder` is that of the contract.
pub(super) fn expand(contract: &mut Contract, folder: &Path) -> Result<(), ContractError> {
    let Some(spec) = contract.task_schema.take() else { return Ok(()) };
    let schema = match (&spec.name, &spec.file) {
        (Some(name), None) => TaskSchema::built_in(name)?,
        (None, Some(file)) => TaskSchema::load(&folder.join(file))?,
        _ => {
            let detail = "expected either a name or a file".to_owned();
            return Err(ContractError::TaskSchema { schema: "task_schema".to_owned(), detail });
        }
    };
    let mut streams = schema.target(spec.target).stream.clone();
    streams.extend(schema.stream.iter().cloned());
    streams.append(&mut contract.stream);
    contract.stream = streams;
    contract.robot_type.get_or_insert_with(|| schema.robot_type.clone());
    if contract.ticks == super::TicksSpec::default() {
        contract.ticks.mode = super::TickMode::Native;
        contract.ticks.fps = Some(schema.fps);
    }
    Ok(())
}
