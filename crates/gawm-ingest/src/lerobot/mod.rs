//! LeRobot dataset folders (v2.0, v2.1, v3.0) in the form of a log, so that a contract takes them as they are.
//!
//! Every column is a topic under its own name; each row of an episode is a message:
//!
//! | column | message | field |
//! |---|---|---|
//! | one number per row | `float64 data` (or the type it has) | `data` |
//! | several numbers, nested ones row-major | `float32[] data` | `data[3]`, `data[0:7]` |
//! | text | `string data` | `data` |
//! | image (bytes, or a path inside the folder) | `sensor_msgs/msg/CompressedImage` | |
//!
//! Each episode of the data has a metadata record `episode`: `task`, `index`, `length` and what the episode table says.
//! The data decide: where metadata disagree with them, that is said and the rows are taken as they are.

mod cells;
mod damage;
mod recording;
mod report;

#[cfg(test)]
pub(crate) mod tests;

use std::path::{Path, PathBuf};

pub use recording::LerobotRecording;
pub use report::{DatasetReport, FeatureReport};

/// Returns whether a folder is a LeRobot dataset: it has `meta/info.json`, sound or not.
pub fn is_dataset(path: &Path) -> bool {
    path.join("meta/info.json").is_file()
}

/// Why a folder cannot be taken as a log.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LerobotError {
    /// It cannot be opened.
    #[error(transparent)]
    Open(#[from] gawm_dataset::read::OpenError),
    /// Rows cannot be read.
    #[error("cannot read the rows of {path:?}: {source}")]
    Scan {
        /// The folder.
        path: PathBuf,
        /// Why.
        source: gawm_dataset::read::ScanError,
    },
    /// No episode has rows.
    #[error("no episode with rows: expected `episode_index` in the data files: {path:?}")]
    NoEpisode {
        /// The folder.
        path: PathBuf,
    },
    /// The rate is not usable.
    #[error("fps of meta/info.json: expected a number from 0.001 to 1e6, got {fps}: {path:?}")]
    Rate {
        /// The folder.
        path: PathBuf,
        /// What it says.
        fps: f64,
    },
    /// More columns or longer times than a log can have.
    #[error("too many {what}: expected at most {limit}: {path:?}")]
    TooMany {
        /// The folder.
        path: PathBuf,
        /// What there is too much of.
        what: &'static str,
        /// The limit.
        limit: u64,
    },
}

impl LerobotError {
    /// Returns what to do about it, where there is something to do.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::Open(_) => Some(
                "meta/info.json and the files under data/ are needed; copy the dataset again (git lfs pull, or huggingface-cli download)",
            ),
            Self::Rate { .. } => Some("correct `fps` in meta/info.json"),
            Self::Scan { .. } | Self::NoEpisode { .. } | Self::TooMany { .. } => None,
        }
    }
}
