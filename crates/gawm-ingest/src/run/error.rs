//! Why a run, or one recording of it, cannot go on.

use std::path::PathBuf;

use thiserror::Error;

use crate::contract::ContractError;
use crate::decode::{CompileError, PathError};
use crate::log::OpenLogError;

/// Why the run stops.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// The contract cannot be used, or does not fit the logs.
    #[error(transparent)]
    Contract(#[from] ContractError),
    /// A field of the contract is not in the log.
    #[error("{file}: stream {stream:?} cannot be decoded from {log:?}: {source}")]
    Field {
        /// The contract.
        file: String,
        /// Name of the stream.
        stream: String,
        /// The log.
        log: String,
        /// Why.
        source: CompileError,
    },
    /// A path of the contract does not parse.
    #[error("{file}: stream {stream:?}: {source}")]
    Path {
        /// The contract.
        file: String,
        /// Name of the stream.
        stream: String,
        /// Why.
        source: PathError,
    },
    /// A pattern matches no topic.
    #[error("{file}: stream[{index}]: no topic of {log:?} matches {pattern:?}; it has {}", list(.topics))]
    NoMatch {
        /// The contract.
        file: String,
        /// Number of the stream in the contract.
        index: usize,
        /// The log.
        log: String,
        /// The pattern.
        pattern: String,
        /// Topics of the log.
        topics: Vec<String>,
    },
    /// Streams of one feature do not fit together.
    #[error("{file}: feature {feature:?}: {detail}")]
    Feature {
        /// The contract.
        file: String,
        /// The feature.
        feature: String,
        /// What does not fit.
        detail: String,
    },
    /// A crop lies outside of the images.
    #[error(
        "stream {stream:?}: image.crop: expected one within the images of {topic}, {width}x{height}, got {crop:?} (x, y, width, height)"
    )]
    Crop {
        /// The stream.
        stream: String,
        /// Its topic.
        topic: String,
        /// Width of the recorded images.
        width: u32,
        /// Height of the recorded images.
        height: u32,
        /// What the contract asks for.
        crop: [u32; 4],
    },
    /// The schemas folder cannot be used.
    #[error("{file}: schemas: {detail}")]
    Schemas {
        /// The contract.
        file: String,
        /// Why.
        detail: String,
    },
    /// Labels cannot be read.
    #[error("{file}: {source}")]
    Labels {
        /// The contract.
        file: String,
        /// Why.
        source: crate::episodes::LabelError,
    },
    /// The dataset cannot be written.
    #[error("cannot write the dataset {dir:?}: {source}")]
    Write {
        /// The folder.
        dir: PathBuf,
        /// Why.
        source: gawm_dataset::WriteError,
    },
    /// Rows that do not fit the data contract: a bug, or a log that changes its nature half-way.
    #[error("{log:?}: rows at {time_ns} ns do not fit the schema: {source}")]
    Rows {
        /// The log.
        log: String,
        /// First tick of the rows.
        time_ns: i64,
        /// Why.
        source: gawm_dataset::TrajectoryError,
    },
    /// A stream whose gap rule is `fail` has a gap.
    #[error(
        "{log:?}: stream {stream:?} ({topic}) has a gap: no usable sample at {tick_ns} ns, the last one {age_ms:.1} ms before"
    )]
    Gap {
        /// The log.
        log: String,
        /// The stream.
        stream: String,
        /// Its topic.
        topic: String,
        /// The tick.
        tick_ns: i64,
        /// Age of the last sample.
        age_ms: f64,
    },
    /// Nothing usable came of any input.
    #[error("nothing was written:{}", gathered(.reasons))]
    Nothing {
        /// Why each input gave nothing.
        reasons: Vec<String>,
    },
    /// The report cannot be written.
    #[error("cannot write the report {path:?}: {source}")]
    Report {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// A log file cannot be read again.
    #[error("cannot read {path:?}: {source}")]
    Read {
        /// The file.
        path: PathBuf,
        /// Why.
        source: std::io::Error,
    },
    /// Threads cannot be started.
    #[error("cannot start threads: {detail}")]
    Threads {
        /// Why.
        detail: String,
    },
    /// The user interrupted.
    #[error("interrupted")]
    Interrupted,
}

/// Why one recording is refused; the run goes on with the others.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum Refusal {
    /// The file cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenLogError),
    /// A required topic is not there.
    #[error("no topic {topic:?}, which stream {stream:?} requires; the log has {}", list(.topics))]
    MissingTopic {
        /// Name of the stream.
        stream: String,
        /// The topic.
        topic: String,
        /// Topics of the log.
        topics: Vec<String>,
    },
    /// A required column is in the file and cannot be used.
    #[error("column {topic:?}, which stream {stream:?} requires, cannot be used: {why}")]
    UnusableColumn {
        /// Name of the stream.
        stream: String,
        /// The column.
        topic: String,
        /// Why.
        why: String,
        /// What to do about it.
        hint: Option<&'static str>,
    },
    /// The schema of a required topic cannot be used: the log's fault, not the contract's.
    #[error("stream {stream:?} cannot be decoded: {source}")]
    Undecodable {
        /// Name of the stream.
        stream: String,
        /// Why.
        source: CompileError,
    },
    /// No message of a required stream could be used.
    #[error("stream {stream:?} has no usable sample: {topic} has {read} messages, {detail}")]
    EmptyStream {
        /// Name of the stream.
        stream: String,
        /// The topic.
        topic: String,
        /// Messages read.
        read: u64,
        /// What became of them.
        detail: String,
    },
    /// A stream has other values than in the recordings before.
    #[error("{detail}")]
    OtherSchema {
        /// The first difference.
        detail: String,
    },
    /// There was not a single episode.
    #[error("no episode: {detail}")]
    NoEpisode {
        /// Why.
        detail: String,
    },
}

impl RunError {
    /// Returns what the reader can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            RunError::Contract(error) => error.hint(),
            RunError::Field { .. } | RunError::Path { .. } | RunError::NoMatch { .. } => Some(
                "`gawm-ingest inspect LOG` lists topics and fields; `gawm-ingest suggest LOG` writes a contract that fits"
                    .to_owned(),
            ),
            RunError::Write { source: gawm_dataset::WriteError::DiskFull { .. }, .. } => {
                Some("make room and run the same command with --resume".to_owned())
            }
            RunError::Write { source: gawm_dataset::WriteError::Io { source, .. }, .. }
                if source.kind() == std::io::ErrorKind::NotADirectory =>
            {
                Some("a file is in the way: choose another --out".to_owned())
            }
            RunError::Write {
                source: gawm_dataset::WriteError::Io { .. } | gawm_dataset::WriteError::Parquet { .. },
                ..
            } => Some("when the cause is gone, run the same command with --resume: finished recordings are not done again".to_owned()),
            RunError::Gap { .. } => {
                Some("gap = \"split\" or \"mask\" goes on, a larger tolerance_ms bridges it".to_owned())
            }
            RunError::Interrupted => Some("run the same command with --resume (in place of --append) to go on".to_owned()),
            // The reasons bring their own.
            RunError::Nothing { reasons } if reasons.iter().any(|reason| reason.contains("\nhint: ")) => None,
            RunError::Nothing { .. } => {
                Some("`gawm-ingest inspect LOG` shows what the logs hold and what is damaged".to_owned())
            }
            _ => None,
        }
    }

    /// Returns the exit code of the program.
    pub fn exit_code(&self) -> u8 {
        match self {
            RunError::Contract(_)
            | RunError::Field { .. }
            | RunError::Path { .. }
            | RunError::NoMatch { .. }
            | RunError::Feature { .. }
            | RunError::Crop { .. }
            | RunError::Schemas { .. }
            | RunError::Labels { .. } => 2,
            RunError::Interrupted => 130,
            _ => 1,
        }
    }
}

impl Refusal {
    /// Returns what the reader can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            Refusal::Open(error) => error.hint(),
            Refusal::MissingTopic { .. } => {
                Some("correct the topic, or remove the stream from the contract if this log cannot have it".to_owned())
            }
            Refusal::UnusableColumn { hint, .. } => {
                Some(hint.unwrap_or("remove the stream from the contract if this file cannot have it").to_owned())
            }
            Refusal::EmptyStream { .. } => {
                Some("gap = \"mask\" makes a stream of numbers optional; `gawm-ingest inspect LOG` shows the topic".to_owned())
            }
            Refusal::Undecodable { source: CompileError::NoSchema { .. }, .. } => {
                Some("schemas = [folder] gives types that the log lacks".to_owned())
            }
            Refusal::Undecodable { .. } => {
                Some("remove the stream from the contract if this log cannot have it; `gawm-ingest inspect LOG` shows which topics can be decoded".to_owned())
            }
            Refusal::NoEpisode { .. } => {
                Some("larger tolerance_ms, other clocks or episodes.from may fit; `gawm-ingest inspect LOG` shows rates and gaps".to_owned())
            }
            Refusal::OtherSchema { .. } => Some("ingest it with its own contract into a dataset of its own".to_owned()),
        }
    }
}

/// Puts reasons on lines of their own, and each of their hints behind them once.
fn gathered(reasons: &[String]) -> String {
    const SHOWN: usize = 20;
    let mut text = String::new();
    let mut hints: Vec<&str> = Vec::new();
    for (at, reason) in reasons.iter().enumerate() {
        let (what, hint) =
            reason.split_once("\nhint: ").map_or((reason.as_str(), None), |(what, hint)| (what, Some(hint)));
        if at < SHOWN {
            text.push_str(if reasons.len() > 1 { "\n  " } else { " " });
            text.push_str(what);
        }
        hints.extend(hint.filter(|hint| !hints.contains(hint)));
    }
    if reasons.is_empty() {
        text.push_str(" none");
    }
    if reasons.len() > SHOWN {
        text.push_str(&format!("\n  and {} more", reasons.len() - SHOWN));
    }
    for hint in hints.iter().take(SHOWN) {
        text.push_str("\nhint: ");
        text.push_str(hint);
    }
    text
}

fn list(items: &[String]) -> String {
    const SHOWN: usize = 40;
    let mut text = items.iter().take(SHOWN).map(String::as_str).collect::<Vec<_>>().join(", ");
    if items.is_empty() {
        text.push_str("none");
    }
    if items.len() > SHOWN {
        text.push_str(&format!(" and {} more", items.len() - SHOWN));
    }
    text
}
