//! What is wrong with a table of labels.

use std::path::PathBuf;

use thiserror::Error;

/// Why a table of labels cannot be used. Nothing is written then.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LabelError {
    /// It cannot be read.
    #[error("cannot read the labels: {source}: {path:?}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// It is larger than any table of labels.
    #[error("labels too large: expected at most {limit} bytes: {path:?}")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Most bytes.
        limit: u64,
    },
    /// It says nothing.
    #[error("labels are empty: expected {expected}: {path:?}")]
    Empty {
        /// The file.
        path: PathBuf,
        /// What is missing.
        expected: &'static str,
    },
    /// It is neither CSV nor JSON.
    #[error("line {line}: {detail}: {path:?}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is wrong.
        detail: String,
    },
    /// A column or key is none of the known ones.
    #[error("line {line}: unknown column {column:?}, expected {expected}: {path:?}")]
    UnknownColumn {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column.
        column: String,
        /// What there is.
        expected: String,
    },
    /// A column or key is there twice.
    #[error("line {line}: column {column:?} is there twice, expected once: {path:?}")]
    RepeatedColumn {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column.
        column: String,
    },
    /// Nothing names the episode, or nothing is said of it.
    #[error("line {line}: expected {expected}, got none: {path:?}")]
    Missing {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What is missing.
        expected: &'static str,
    },
    /// A value is not one of its column.
    #[error("line {line}: {column}: expected {expected}, got {got}: {path:?}")]
    Value {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// The column.
        column: String,
        /// What would do.
        expected: String,
        /// What is there.
        got: String,
    },
    /// The dataset has no such episode.
    #[error("line {line}: unknown episode: expected {expected}, got {got}: {path:?}")]
    UnknownEpisode {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// What there is.
        expected: String,
        /// What was asked for.
        got: String,
    },
    /// The names in a row belong to different episodes.
    #[error("line {line}: {first} and {second} are not the same episode: {path:?}")]
    Names {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: u64,
        /// One name.
        first: String,
        /// The other one.
        second: String,
    },
    /// Two rows disagree.
    #[error(
        "lines {other} and {line} disagree on {column} of episode {episode}: {first} and {second}: {path:?}"
    )]
    Conflict {
        /// The file.
        path: PathBuf,
        /// The line of the later row, from 1.
        line: u64,
        /// The line of the row before.
        other: u64,
        /// The episode.
        episode: i64,
        /// The label.
        column: String,
        /// What the row before says.
        first: String,
        /// What the later row says.
        second: String,
    },
}

impl LabelError {
    /// Says what the user can do.
    pub fn hint(&self) -> &'static str {
        match self {
            LabelError::Read { .. } => "--labels takes a CSV or JSON file",
            LabelError::Conflict { .. } => "keep one of the two rows; nothing was written",
            LabelError::UnknownEpisode { .. } | LabelError::Names { .. } => {
                "gawm-data label DIR --template prints the episodes with their present labels"
            }
            _ => "gawm-data label DIR --template prints a table to fill in",
        }
    }
}
