//! Why a dataset cannot be written.

use std::io;
use std::path::{Path, PathBuf};

use gawm_schema::{EncodeError, SchemaError};
use parquet::errors::ParquetError;
use thiserror::Error;

use crate::durable::is_disk_full;

/// Why the writer stops. What was written before stays; a later run with [`WriteMode::Resume`](crate::WriteMode) goes on.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum WriteError {
    /// No space is left.
    #[error("disk full while writing {path:?}")]
    DiskFull {
        /// The file.
        path: PathBuf,
    },
    /// A file cannot be read, written or renamed.
    #[error("cannot {action} {path:?}: {source}")]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        source: io::Error,
    },
    /// A Parquet file cannot be written or read.
    #[error("parquet file {path:?}: {source}")]
    Parquet {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        source: ParquetError,
    },
    /// A new dataset is to be written where something lies.
    #[error("output folder is not empty, expected an absent or empty folder: {dir:?}")]
    NotEmpty {
        /// The folder.
        dir: PathBuf,
    },
    /// There is no finished dataset to append to.
    #[error("no finished gawm dataset, expected meta/info.json and meta/gawm.json: {dir:?}")]
    NoDataset {
        /// The folder.
        dir: PathBuf,
    },
    /// An earlier run did not finish.
    #[error("an earlier run did not finish, expected a finished dataset: {dir:?}")]
    Unfinished {
        /// The folder.
        dir: PathBuf,
    },
    /// A run goes on with other settings than it began with, or a dataset is extended with another schema.
    #[error("{place} differs from what the dataset was made with: expected {expected}, got {got}")]
    SpecChanged {
        /// The place in the specification.
        place: String,
        /// The value in the dataset, as JSON.
        expected: String,
        /// The value now, as JSON.
        got: String,
    },
    /// The schema is not possible.
    #[error(transparent)]
    Schema(#[from] SchemaError),
    /// The share of training data is no share.
    #[error("train_share is {got}, expected a number in 0..=1")]
    TrainShare {
        /// The number.
        got: f64,
    },
    /// A file of the dataset's meta folder is damaged or does not fit the others.
    #[error("{path:?} is damaged: {reason}")]
    Damaged {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// A call came at the wrong moment.
    #[error("{call} was called {when}")]
    Order {
        /// The call.
        call: &'static str,
        /// What was wrong about the moment.
        when: &'static str,
    },
    /// An episode was ended without rows.
    #[error("episode {id:?} has no row, expected at least one; discard it instead")]
    EmptyEpisode {
        /// The episode.
        id: String,
    },
    /// An id occurs twice.
    #[error("episode id {id:?} occurs twice, expected unique ids")]
    DuplicateEpisode {
        /// The id.
        id: String,
    },
    /// A piece of an episode does not continue the one before.
    #[error(
        "time does not increase in episode {id:?} at frame {frame}: expected more than {previous_ns} ns, got {time_ns} ns"
    )]
    Time {
        /// The episode.
        id: String,
        /// The row in the episode.
        frame: u64,
        /// Time of the row before.
        previous_ns: i64,
        /// Time of the row.
        time_ns: i64,
    },
    /// Numbers in an action that is not valid, before the last row.
    #[error(
        "{feature:?} holds numbers at frame {frame} of episode {id:?} though it is not valid, expected NaN before the last row"
    )]
    HeldActionInside {
        /// The episode.
        id: String,
        /// The feature.
        feature: String,
        /// The row in the episode.
        frame: u64,
    },
    /// A trajectory was checked against another schema.
    #[error("trajectory does not fit the schema of the dataset: {reason}")]
    OtherSchema {
        /// What differs.
        reason: String,
    },
    /// A rotation has no encoding.
    #[error("episode {id:?}: {source}")]
    Encode {
        /// The episode.
        id: String,
        /// What is wrong.
        source: EncodeError,
    },
    /// A file name of an attachment cannot be used.
    #[error("attachment name {name:?} has no usable character, expected a file name")]
    AttachmentName {
        /// The name.
        name: String,
    },
}

impl WriteError {
    /// Names the file that an input or output error is about; a full disk is told apart.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> WriteError {
        let path = path.to_owned();
        move |source| {
            if is_disk_full(&source) {
                WriteError::DiskFull { path }
            } else {
                WriteError::Io { action, path, source }
            }
        }
    }

    /// Names the file that a Parquet error is about; a full disk is told apart.
    pub(crate) fn parquet(path: &Path) -> impl FnOnce(ParquetError) -> WriteError {
        let path = path.to_owned();
        move |source| {
            if is_disk_full(&source) {
                WriteError::DiskFull { path }
            } else {
                WriteError::Parquet { path, source }
            }
        }
    }

    /// Says what the user can do.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            WriteError::DiskFull { .. } => Some("free some space, then run again with --resume"),
            WriteError::NotEmpty { .. } => Some(
                "--resume goes on with an interrupted run, --append adds to a finished dataset; or give another folder",
            ),
            WriteError::NoDataset { .. } => Some("run without --append to make a new dataset"),
            WriteError::Unfinished { .. } => Some("run again with --resume to finish it first"),
            WriteError::SpecChanged { .. } => Some(
                "use the configuration that the dataset was made with (it is in meta/gawm.json), or another folder",
            ),
            _ => None,
        }
    }
}
