//! Why an edit cannot be done.

use std::io;
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::condition::ConditionError;
use super::label::LabelError;
use crate::error::WriteError;
use crate::read::{OpenError, ScanError};

/// Why an edit stops. The inputs are unchanged and nothing is left at the output's place.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EditError {
    /// A source cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// A source cannot be scanned.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// A source is damaged in a way that an edit would hide or spread.
    #[error("{path:?} is damaged: {place}: expected {expected}, got {got}")]
    Damaged {
        /// The dataset folder.
        path: PathBuf,
        /// File, column or key.
        place: String,
        /// What a sound dataset has there.
        expected: String,
        /// What was found.
        got: String,
    },
    /// The condition of `--where` cannot be understood or evaluated.
    #[error(transparent)]
    Condition(#[from] ConditionError),
    /// The table of labels cannot be used.
    #[error(transparent)]
    Label(#[from] LabelError),
    /// No episode is left.
    #[error("{verb} leaves no episode, expected at least one")]
    NothingLeft {
        /// The verb.
        verb: String,
    },
    /// The output's place is taken.
    #[error("output folder is not empty, expected an absent or empty folder: {path:?}")]
    NotEmpty {
        /// The output.
        path: PathBuf,
    },
    /// The output would lie inside an input or around it.
    #[error("output {path:?} lies inside the input {input:?} or around it, expected a folder of its own")]
    InsideInput {
        /// The output.
        path: PathBuf,
        /// The input.
        input: PathBuf,
    },
    /// The output's path cannot be followed.
    #[error("output path {path:?} has \"..\" after a folder that does not exist, expected a plain path")]
    OutputPath {
        /// The output.
        path: PathBuf,
    },
    /// Datasets do not fit together.
    #[error("{place} of {second:?} differs from that of {first:?}: expected {expected}, got {got}")]
    Different {
        /// The dataset that came first.
        first: PathBuf,
        /// The other one.
        second: PathBuf,
        /// What differs.
        place: String,
        /// The first one's value.
        expected: String,
        /// The other one's value.
        got: String,
    },
    /// An id stands for two episodes of different content.
    #[error(
        "episode id {id:?} has different rows in two inputs ({first:?}, {second:?}), expected equal ones"
    )]
    Conflicting {
        /// The id.
        id: String,
        /// The dataset that came first.
        first: PathBuf,
        /// The other one.
        second: PathBuf,
    },
    /// A video that an episode needs is not there.
    #[error("video {video:?} of {path:?} that episode {episode} needs is missing or unusable: {reason}")]
    Video {
        /// The dataset folder.
        path: PathBuf,
        /// The video's path in it.
        video: String,
        /// The episode.
        episode: i64,
        /// Why it cannot be used.
        reason: String,
    },
    /// An argument does not fit the dataset.
    #[error("{what}: expected {expected}, got {got}")]
    Argument {
        /// Which part or argument.
        what: String,
        /// What would do.
        expected: String,
        /// What there is.
        got: String,
    },
    /// The output cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
}

impl EditError {
    /// Names the file that an input or output error is about.
    pub(crate) fn io(action: &'static str, path: &Path) -> impl FnOnce(io::Error) -> EditError {
        let error = WriteError::io(action, path);
        move |source| EditError::Write(error(source))
    }

    /// Says what the user can do.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            EditError::Open(_) => Some("give the folder that holds meta/ and data/"),
            EditError::Damaged { .. } => Some(
                "gawm-data validate says what is wrong; --skip-damaged leaves the episodes concerned out",
            ),
            EditError::Label(error) => Some(error.hint()),
            EditError::NothingLeft { .. } => Some("loosen the condition; --dry-run lists what it takes"),
            EditError::NotEmpty { .. } => Some("give another folder; nothing is ever overwritten"),
            EditError::InsideInput { .. } => Some("give a folder beside the dataset"),
            EditError::Different { .. } => Some(
                "datasets are merged only when features, rate and robot are equal; gawm-data diff lists what differs",
            ),
            EditError::Conflicting { .. } => {
                Some("one of the two was edited; leave it out of one input with gawm-data filter")
            }
            EditError::Video { .. } => {
                Some("copy the videos again, or leave cameras out: --without-camera NAME, --without-videos")
            }
            EditError::Write(WriteError::DiskFull { .. }) => {
                Some("free some space and run again; nothing was left at the output's place")
            }
            _ => None,
        }
    }

    /// Returns whether the arguments are to blame, not the data or the disk.
    pub fn is_usage(&self) -> bool {
        matches!(
            self,
            EditError::Condition(_)
                | EditError::Label(_)
                | EditError::NotEmpty { .. }
                | EditError::InsideInput { .. }
                | EditError::OutputPath { .. }
                | EditError::Argument { .. }
                | EditError::Different { .. }
        )
    }
}
