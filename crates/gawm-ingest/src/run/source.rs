//! What a recording is read from: an MCAP file, or a table of rows in the form of one.

use std::io;
use std::path::Path;
use std::sync::Arc;

use super::open_options;
use crate::contract::{CheckedContract, TickRule};
use crate::log::{Block, BlockRef, Channel, Damage, Log, MetadataRecord, OpenLogError, SummaryCounts};
use crate::tabular::{Limits, OpenTableError, RecordingError, TableRecording, open, sniff};

/// One open file.
pub(crate) enum Source {
    /// An MCAP file.
    Log(Box<Log>),
    /// HDF5 or npz.
    Table(Box<TableRecording>),
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
    /// It is a table without episodes.
    #[error("{source}: {path:?}")]
    Recording {
        /// The file.
        path: std::path::PathBuf,
        /// What is wrong with it.
        source: RecordingError,
    },
    /// Rows have no times, and the contract does not say how many a second has.
    #[error("rows per second: expected ticks.fps or ticks.rate_hz in the contract, got neither: {path:?}")]
    NoRate {
        /// The file.
        path: std::path::PathBuf,
    },
}

impl OpenError {
    /// Returns what to do about it, where there is something to do.
    pub(crate) fn hint(&self) -> Option<String> {
        match self {
            OpenError::Log(error) => error.hint(),
            OpenError::Table(error) => error.hint().map(ToOwned::to_owned),
            OpenError::Recording { source: RecordingError::Layout(error), .. } => {
                error.hint().map(ToOwned::to_owned)
            }
            OpenError::Recording { .. } => None,
            OpenError::NoRate { .. } => Some(
                "HDF5 and npz files hold no times; write `[ticks]` with `mode = \"native\"` and `fps = ...`"
                    .to_owned(),
            ),
        }
    }
}

impl Source {
    /// Opens a file, told apart by content.
    pub(crate) fn open(path: &Path, contract: &CheckedContract) -> Result<Source, OpenError> {
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
            let recording = TableRecording::try_new(table, None, rate_hz)
                .map_err(|source| OpenError::Recording { path: path.to_owned(), source })?;
            return Ok(Source::Table(Box::new(recording)));
        }
        Ok(Source::Log(Box::new(Log::open(path, &open_options(contract))?)))
    }

    /// Returns the log, if it is one.
    pub(crate) fn log(&self) -> Option<&Log> {
        match self {
            Source::Log(log) => Some(log),
            Source::Table(_) => None,
        }
    }

    pub(crate) fn path(&self) -> &Path {
        match self {
            Source::Log(log) => log.path(),
            Source::Table(table) => table.table().path(),
        }
    }

    pub(crate) fn file_bytes(&self) -> u64 {
        match self {
            Source::Log(log) => log.file_bytes(),
            // A file that is gone since has been hashed before, and then the run has failed.
            Source::Table(table) => std::fs::metadata(table.table().path()).map_or(0, |m| m.len()),
        }
    }

    pub(crate) fn content_hash(&self) -> io::Result<[u8; 32]> {
        match self {
            Source::Log(log) => log.content_hash(),
            Source::Table(table) => table.content_hash(),
        }
    }

    /// Returns what the writer said of itself.
    pub(crate) fn notes(&self) -> [(&'static str, &str); 2] {
        match self {
            Source::Log(log) => [("library", log.library()), ("profile", log.profile())],
            Source::Table(table) => [("layout", table.episodes().layout.name()), ("profile", "")],
        }
    }

    pub(crate) fn channels(&self) -> Vec<Arc<Channel>> {
        match self {
            Source::Log(log) => log.channels().values().cloned().collect(),
            Source::Table(table) => table.channels().to_vec(),
        }
    }

    pub(crate) fn metadata(&self) -> &[MetadataRecord] {
        match self {
            Source::Log(log) => log.metadata(),
            Source::Table(table) => table.metadata(),
        }
    }

    pub(crate) fn damage(&self) -> &[Damage] {
        match self {
            Source::Log(log) => log.damage(),
            Source::Table(table) => table.damage(),
        }
    }

    pub(crate) fn summary_counts(&self) -> Option<&SummaryCounts> {
        match self {
            Source::Log(log) => log.summary_counts(),
            Source::Table(_) => None,
        }
    }

    pub(crate) fn blocks(&self) -> &[BlockRef] {
        match self {
            Source::Log(log) => log.blocks(),
            Source::Table(table) => table.blocks(),
        }
    }

    pub(crate) fn read_block(&self, block: &BlockRef) -> Block {
        match self {
            Source::Log(log) => log.read_block(block),
            Source::Table(table) => table.read_block(block),
        }
    }

    /// Reads only these topics from now on, where that saves work.
    pub(crate) fn select(&mut self, topics: &[String]) {
        if let Source::Table(table) = self {
            table.select(topics.iter().cloned());
        }
    }

    /// Returns whether the file lists its episodes itself.
    pub(crate) fn has_episodes(&self) -> bool {
        matches!(self, Source::Table(_))
    }
}
