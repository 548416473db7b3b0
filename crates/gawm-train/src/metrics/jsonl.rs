//! `metrics.jsonl`: one record per line, appended; a resumed run drops what it will write again.

use std::fs::File;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};

use thiserror::Error;

use super::Record;

/// Longest line that is read; a record of a few thousand dims stays far below.
const MAX_LINE_BYTES: u64 = 16 << 20;

/// Why metrics cannot be written or read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum MetricsError {
    /// The file system refuses.
    #[error("cannot {verb} metrics {path:?}: {cause}")]
    Io {
        /// `read` or `write`.
        verb: &'static str,
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// A line is no record.
    #[error("metrics {path:?}, line {line}: expected a record, got {message}")]
    Line {
        /// The file.
        path: PathBuf,
        /// The line, from 1.
        line: usize,
        /// What the parser says.
        message: String,
    },
}

/// The open file.
#[derive(Debug)]
pub struct MetricsLog {
    path: PathBuf,
    file: File,
}

impl MetricsLog {
    /// Opens the log of a run and keeps the records that `keep` says.
    ///
    /// A resumed run keeps none of what it will write again; half a line that a killed process left goes too.
    ///
    /// # Errors
    ///
    /// - [`MetricsError`] if the file cannot be read or replaced.
    pub fn open(path: &Path, keep: impl Fn(&Record) -> bool) -> Result<MetricsLog, MetricsError> {
        let io = |verb| move |cause| MetricsError::Io { verb, path: path.to_owned(), cause };
        let kept: Vec<Record> = match read(path) {
            Ok(records) => records.into_iter().filter(|record| keep(record)).collect(),
            Err(MetricsError::Io { cause, .. }) if cause.kind() == std::io::ErrorKind::NotFound => Vec::new(),
            Err(error) => return Err(error),
        };
        let temporary = path.with_extension("jsonl.tmp");
        let mut file = File::create(&temporary).map_err(io("write"))?;
        let text: String = kept.iter().map(line).collect();
        file.write_all(text.as_bytes()).and_then(|()| file.sync_all()).map_err(io("write"))?;
        std::fs::rename(&temporary, path).map_err(io("write"))?;
        Ok(MetricsLog { path: path.to_owned(), file })
    }

    /// Appends a record.
    ///
    /// # Errors
    ///
    /// - [`MetricsError::Io`].
    pub fn write(&mut self, record: &Record) -> Result<(), MetricsError> {
        let path = &self.path;
        let io = |cause| MetricsError::Io { verb: "write", path: path.clone(), cause };
        self.file.write_all(line(record).as_bytes()).map_err(io)
    }

    /// Makes what was written durable, before a checkpoint says that it happened.
    ///
    /// # Errors
    ///
    /// - [`MetricsError::Io`].
    pub fn sync(&self) -> Result<(), MetricsError> {
        let io = |cause| MetricsError::Io { verb: "write", path: self.path.clone(), cause };
        self.file.sync_data().map_err(io)
    }
}

/// Reads all records; a last line without an end is what a killed process left and is not read.
///
/// # Errors
///
/// - [`MetricsError`].
pub fn read(path: &Path) -> Result<Vec<Record>, MetricsError> {
    let io = |cause| MetricsError::Io { verb: "read", path: path.to_owned(), cause };
    let mut reader = BufReader::new(File::open(path).map_err(io)?);
    let mut records = Vec::new();
    let mut buffer = Vec::new();
    for number in 1.. {
        buffer.clear();
        let length = reader.by_ref().take(MAX_LINE_BYTES).read_until(b'\n', &mut buffer).map_err(io)?;
        if length == 0 || buffer.last() != Some(&b'\n') {
            break;
        }
        let record = serde_json::from_slice(&buffer).map_err(|error| MetricsError::Line {
            path: path.to_owned(),
            line: number,
            message: error.to_string(),
        })?;
        records.push(record);
    }
    Ok(records)
}

fn line(record: &Record) -> String {
    let mut text = serde_json::to_string(record).expect("a struct of numbers and names becomes JSON");
    text.push('\n');
    text
}
