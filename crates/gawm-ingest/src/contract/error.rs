//! What can be wrong with a contract.

use std::path::PathBuf;

use gawm_schema::pipeline::OverrideError;
use thiserror::Error;

/// Why a contract cannot be used. All of these are exit code 2.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ContractError {
    /// The file cannot be read.
    #[error("cannot read the contract {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is not TOML, or a key is unknown or of the wrong type.
    #[error("{path}: {detail}")]
    Syntax {
        /// The file, with `--set` where one was given.
        path: String,
        /// Place, what was expected, what was there.
        detail: String,
    },
    /// An override does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// The task schema that it names cannot be used.
    #[error("task schema {schema:?}: {detail}")]
    TaskSchema {
        /// Its name or file.
        schema: String,
        /// Why.
        detail: String,
    },
    /// A value cannot be used.
    #[error("{file}: {key}: expected {expected}, got {got}")]
    Value {
        /// The file.
        file: String,
        /// The key, such as `stream[2] (left_arm).tolerance_ms`.
        key: String,
        /// What would be right.
        expected: String,
        /// What was there.
        got: String,
        /// What to do.
        hint: String,
    },
}

impl ContractError {
    /// Returns what the reader can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            ContractError::Read { .. } => {
                Some("write a first contract with `gawm-ingest suggest LOG > contract.toml`".to_owned())
            }
            ContractError::Syntax { .. } | ContractError::Override(_) => Some(
                "docs/contract.md lists every key; `run --print-config` shows the resolved contract"
                    .to_owned(),
            ),
            ContractError::TaskSchema { .. } => {
                Some("task_schema = { name = \"reacher\" } takes a built-in one, { file = ... } one of yours, relative to the contract".to_owned())
            }
            ContractError::Value { hint, .. } => (!hint.is_empty()).then(|| hint.clone()),
        }
    }
}
