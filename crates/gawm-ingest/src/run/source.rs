//! What a recording is read from: an MCAP file, or rows in the form of one.

use std::collections::BTreeMap;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::open_options;
use super::unpack::{UnpackError, is_packed, unpack};
use crate::contract::{CheckedContract, TickRule};
use crate::lerobot::{self, LerobotError, LerobotRecording};
use crate::log::{
    Block, BlockRef, Channel, Damage, Log, MetadataRecord, OpenLogError, OpenOptions, SummaryCounts,
};
use crate::rows::{RowRecording, Unavailable};
use crate::tabular::{Limits, OpenTableError, RecordingError, TableRecording, open, sniff};

/// One open file or folder.
pub(crate) enum Source {
    /// An MCAP file.
    Log(Box<Log>),
    /// An MCAP file that was compressed as a whole: the file itself, and what it was unpacked into.
    Packed {
        /// The file as named.
        path: PathBuf,
        /// What it holds.
        log: Box<Log>,
        /// Removed when it is dropped.
        _unpacked: tempfile::NamedTempFile,
    },
    /// HDF5, npz or a LeRobot folder.
    Rows(Box<dyn RowRecording>),
}

/// Why a file is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum OpenError {
    /// It is no readable log.
    #[error(transparent)]
    Log(#[from] OpenLogError),
    /// It is a table that cannot be read.
    #[error(transparent)]
    Table(#[from] OpenTableError),
    /// It is a compressed log that cannot be unpacked.
    #[error(transparent)]
    Unpack(#[from] UnpackError),
    /// What it was unpacked into is no readable log.
    #[error("{path:?}, unpacked: {source}")]
    Packed {
        /// The file.
        path: PathBuf,
        /// What is wrong with its content.
        source: OpenLogError,
    },
    /// It is a LeRobot folder that cannot be read.
    #[error(transparent)]
    Lerobot(#[from] LerobotError),
    /// It is a table without episodes.
    #[error("{source}: {path:?}")]
    Recording {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: RecordingError,
    },
    /// Rows have no times, and the contract does not say how many a second has.
    #[error("rows per second: expected ticks.fps or ticks.rate_hz in the contract, got neither: {path:?}")]
    NoRate {
        /// The file.
        path: PathBuf,
    },
}

impl OpenError {
    /// Returns what to do about it, where there is something to do.
    pub(crate) fn hint(&self) -> Option<String> {
        match self {
            OpenError::Log(error) => error.hint(),
            OpenError::Table(error) => error.hint().map(ToOwned::to_owned),
            OpenError::Lerobot(error) => error.hint().map(ToOwned::to_owned),
            OpenError::Recording { source: RecordingError::Layout(error), .. } => {
                error.hint().map(ToOwned::to_owned)
            }
            OpenError::Unpack(UnpackError::Read { .. }) => {
                Some("it was cut or damaged: copy it again from the robot".to_owned())
            }
            OpenError::Unpack(_) => {
                Some("unpack it yourself (zstd -d), or set TMPDIR to a folder with room".to_owned())
            }
            OpenError::Packed { source, .. } => source.hint(),
            OpenError::Recording { .. } => None,
            OpenError::NoRate { .. } => Some(
                "HDF5 and npz files hold no times; write `[ticks]` with `mode = \"native\"` and `fps = ...`"
                    .to_owned(),
            ),
        }
    }
}

impl Source {
    /// Opens a file or folder, told apart by content.
    pub(crate) fn open(path: &Path, contract: &CheckedContract) -> Result<Source, OpenError> {
        if lerobot::is_dataset(path) {
            return Ok(Source::Rows(Box::new(LerobotRecording::open(path)?)));
        }
        // What cannot be read at all is the log's to report.
        if path.is_file() && sniff(path).is_ok_and(|format| format.is_some()) {
            let rate_hz = match (contract.written.ticks.fps, &contract.ticks) {
                (_, TickRule::Fixed { rate_hz }) => *rate_hz,
                (Some(fps), TickRule::Reference { .. }) => f64::from(fps),
                (None, TickRule::Reference { .. }) => {
                    return Err(OpenError::NoRate { path: path.to_owned() });
                }
            };
            let table = open(path, &Limits::default())?;
            let recording = TableRecording::try_new(table, contract.written.layout.as_ref(), rate_hz)
                .map_err(|source| OpenError::Recording { path: path.to_owned(), source })?;
            return Ok(Source::Rows(Box::new(recording)));
        }
        Source::open_log(path, &open_options(contract))
    }

    /// Opens an MCAP file, compressed as a whole or not.
    pub(crate) fn open_log(path: &Path, options: &OpenOptions) -> Result<Source, OpenError> {
        if !is_packed(path) {
            return Ok(Source::Log(Box::new(Log::open(path, options)?)));
        }
        let unpacked = unpack(path)?;
        let log = Log::open(unpacked.path(), options)
            .map_err(|source| OpenError::Packed { path: path.to_owned(), source })?;
        Ok(Source::Packed { path: path.to_owned(), log: Box::new(log), _unpacked: unpacked })
    }

    /// Returns the MCAP file, if it is one.
    pub(crate) fn as_log(&self) -> Option<&Log> {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => Some(log),
            Source::Rows(_) => None,
        }
    }

    pub(crate) fn path(&self) -> &Path {
        match self {
            Source::Log(log) => log.path(),
            Source::Packed { path, .. } => path,
            Source::Rows(rows) => rows.path(),
        }
    }

    pub(crate) fn file_bytes(&self) -> u64 {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.file_bytes(),
            Source::Rows(rows) => rows.file_bytes(),
        }
    }

    pub(crate) fn content_hash(&self) -> io::Result<[u8; 32]> {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.content_hash(),
            Source::Rows(rows) => rows.content_hash(),
        }
    }

    /// Returns what the writer said of itself, and what is worth keeping of columns.
    pub(crate) fn notes(&self) -> BTreeMap<String, String> {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => {
                [("library", log.library()), ("profile", log.profile())]
                    .into_iter()
                    .filter(|(_, value)| !value.is_empty())
                    .map(|(key, value)| (key.to_owned(), value.to_owned()))
                    .collect()
            }
            Source::Rows(rows) => rows.notes(),
        }
    }

    pub(crate) fn channels(&self) -> Vec<Arc<Channel>> {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.channels().values().cloned().collect(),
            Source::Rows(rows) => rows.channels().to_vec(),
        }
    }

    pub(crate) fn metadata(&self) -> &[MetadataRecord] {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.metadata(),
            Source::Rows(rows) => rows.metadata(),
        }
    }

    pub(crate) fn damage(&self) -> &[Damage] {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.damage(),
            Source::Rows(rows) => rows.damage(),
        }
    }

    pub(crate) fn summary_counts(&self) -> Option<&SummaryCounts> {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.summary_counts(),
            Source::Rows(_) => None,
        }
    }

    pub(crate) fn blocks(&self) -> &[BlockRef] {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.blocks(),
            Source::Rows(rows) => rows.blocks(),
        }
    }

    pub(crate) fn read_block(&self, block: &BlockRef) -> Block {
        match self {
            Source::Log(log) | Source::Packed { log, .. } => log.read_block(block),
            Source::Rows(rows) => rows.read_block(block),
        }
    }

    /// Reads only these topics from now on, where that saves work.
    pub(crate) fn select(&mut self, topics: &[String]) {
        if let Source::Rows(rows) = self {
            rows.select(topics);
        }
    }

    /// Returns whether the file lists its episodes itself.
    pub(crate) fn has_episodes(&self) -> bool {
        matches!(self, Source::Rows(_))
    }

    /// Says why what is in the file under the name of a topic is not offered as one, and what to do.
    pub(crate) fn why_not_offered(&self, topic: &str) -> Option<(String, Option<&'static str>)> {
        match self {
            Source::Log(_) | Source::Packed { .. } => None,
            Source::Rows(rows) => rows.why_not_offered(topic),
        }
    }

    /// Returns the topics that are declared and have no values.
    pub(crate) fn unavailable(&self) -> &[Unavailable] {
        match self {
            Source::Log(_) | Source::Packed { .. } => &[],
            Source::Rows(rows) => rows.unavailable(),
        }
    }
}
