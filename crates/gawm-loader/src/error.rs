//! What keeps batches from being made.

use std::path::{Path, PathBuf};

use gawm_image::ImageError;
use gawm_schema::batch::{BatchError, SequenceError};

/// Why an index cannot be built or a batch not be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LoadError {
    /// The dataset cannot be opened.
    #[error(transparent)]
    Open(#[from] gawm_dataset::read::OpenError),
    /// The dataset is not one that can be trained on.
    #[error("unusable dataset {}: expected {expected}, got {got}", path.display())]
    Dataset {
        /// The folder.
        path: PathBuf,
        /// What is needed.
        expected: String,
        /// What is there.
        got: String,
    },
    /// Two datasets of a mix do not fit together.
    #[error("datasets that do not fit together: expected {what} of {} ({expected}), got {got} in {}", first.display(), second.display())]
    Mix {
        /// What differs.
        what: &'static str,
        /// Value of the first.
        expected: String,
        /// Value of the other.
        got: String,
        /// The first dataset.
        first: PathBuf,
        /// The other.
        second: PathBuf,
    },
    /// There are not enough clips.
    #[error(
        "too few clips: expected at least {expected} training clips for a batch, got {got} ({excluded} excluded, {short} episodes too short)"
    )]
    TooFewClips {
        /// Clips of a batch over all ranks.
        expected: u64,
        /// Training clips.
        got: u64,
        /// Clips left out because of validity.
        excluded: u64,
        /// Episodes shorter than a clip.
        short: u64,
    },
    /// A frame cannot be decoded.
    #[error("frame of camera {camera:?}, row {row} of {}: {source}", path.display())]
    Frame {
        /// The data file.
        path: PathBuf,
        /// The camera.
        camera: String,
        /// Row of the dataset.
        row: u64,
        /// What is wrong with it.
        source: ImageError,
    },
    /// A page of a data file is not one frame.
    #[error("frame of camera {camera:?}, row {row} of {}: expected {expected}, got {got}", path.display())]
    Page {
        /// The data file.
        path: PathBuf,
        /// The camera.
        camera: String,
        /// Row of the dataset.
        row: u64,
        /// What a frame's page looks like.
        expected: &'static str,
        /// What was found.
        got: String,
    },
    /// The batch cannot be laid out.
    #[error(transparent)]
    Batch(#[from] BatchError),
    /// The run cannot be.
    #[error(transparent)]
    Sequence(#[from] SequenceError),
    /// The cache would be too large.
    #[error("cache too large: expected at most {budget} bytes (cache_budget_gib), got {needed}")]
    CacheBudget {
        /// Bytes that are allowed.
        budget: u64,
        /// Bytes that it needs.
        needed: u64,
    },
    /// The cache file is not what it should be.
    #[error("unusable cache {}: expected {expected}, got {got}", path.display())]
    Cache {
        /// The file.
        path: PathBuf,
        /// What it should be.
        expected: String,
        /// What it is.
        got: String,
    },
    /// Someone asked to stop.
    #[error("interrupted")]
    Interrupted,
    /// A file operation failed.
    #[error("cannot {operation} {}: {source}", path.display())]
    Io {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl LoadError {
    pub(crate) fn io(operation: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> LoadError {
        move |source| LoadError::Io { operation, path: path.to_owned(), source }
    }

    pub(crate) fn dataset(path: &Path, expected: impl Into<String>, got: impl Into<String>) -> LoadError {
        LoadError::Dataset { path: path.to_owned(), expected: expected.into(), got: got.into() }
    }

    /// Whether configuration and data do not fit together: the user must change one of them.
    pub(crate) fn is_misfit(&self) -> bool {
        matches!(
            self,
            LoadError::Dataset { .. }
                | LoadError::Mix { .. }
                | LoadError::TooFewClips { .. }
                | LoadError::Batch(_)
                | LoadError::Sequence(_)
                | LoadError::CacheBudget { .. }
        )
    }

    /// Returns what a user can do about it.
    pub fn hint(&self) -> Option<String> {
        let hint = match self {
            LoadError::Open(_) | LoadError::Dataset { .. } => {
                "`gawm-data validate DIR` says more; `gawm-ingest run` makes datasets of logs"
            }
            LoadError::TooFewClips { .. } => "lower [loader] batch, frameskip or history, or add episodes",
            LoadError::CacheBudget { .. } => {
                "raise [loader] cache_budget_gib, lower image_size, or set cache = false"
            }
            LoadError::Frame { .. } | LoadError::Page { .. } => {
                "`gawm-data validate DIR` finds all such frames"
            }
            LoadError::Cache { .. } => "remove the file; it is made again",
            _ => return None,
        };
        Some(hint.to_owned())
    }
}
