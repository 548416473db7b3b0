//! What the caller of the writer says about a dataset, its recordings and its episodes.

use std::collections::BTreeMap;

use gawm_schema::batch::Split;
use gawm_schema::{ContentHash, Schema};
use serde::{Deserialize, Serialize};

/// Everything that is fixed for a run of the writer.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetSpec {
    /// What a row holds.
    pub schema: Schema,
    /// The text of the contract (configuration) that made the rows; stored as it is, so that anyone can repeat the run.
    pub contract: String,
    /// Name and version of the program that writes, such as `gawm-ingest 0.1.0`.
    pub software: String,
    /// Share of the sessions that are training data, in 0..=1. Default 0.9.
    pub train_share: f64,
    /// A data file is closed at the first end of an episode at which it holds this many bytes. Default 100 MiB.
    pub max_file_bytes: u64,
}

impl DatasetSpec {
    /// Returns a specification with the defaults.
    pub fn new(schema: Schema, contract: impl Into<String>, software: impl Into<String>) -> DatasetSpec {
        DatasetSpec {
            schema,
            contract: contract.into(),
            software: software.into(),
            train_share: 0.9,
            max_file_bytes: 100 << 20,
        }
    }
}

/// What may be in the output folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WriteMode {
    /// Nothing: the folder is absent or empty.
    New,
    /// Nothing, an interrupted run with the same specification, or a finished dataset: what is done is kept.
    Resume,
    /// A finished dataset with the same schema, to which recordings are added.
    Append,
}

/// A recording: one log, or the ordered parts of a split log.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RecordingInfo {
    /// Hash of the recording's bytes; a recording whose hash the dataset has is not taken again.
    pub content_hash: ContentHash,
    /// The files in order, without the folders they lie in.
    pub files: Vec<SourceFile>,
    /// What else is worth keeping (profile, recorder, start of the log, ...).
    #[serde(default)]
    pub notes: BTreeMap<String, String>,
}

/// One file of a recording.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SourceFile {
    /// File name, or a path relative to what the user named; never absolute.
    pub name: String,
    /// Hash of its bytes.
    pub content_hash: ContentHash,
    /// Length in bytes.
    pub length_bytes: u64,
}

/// What the writer knows of a recording that is about to begin.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RecordingState {
    /// It is not in the dataset: write its episodes, then end it.
    New,
    /// The dataset has it: go to the next one, neither write nor end it.
    AlreadyThere,
}

/// An episode that is about to begin.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct EpisodeInfo {
    /// Unique name, stable across runs; empty for `<first 12 digits of the recording's hash>-<number in it>`.
    pub id: String,
    /// What is done, in words.
    pub task: String,
    /// Whether it was done; `None` when nobody said.
    pub success: Option<bool>,
    /// Who operated the robot; empty when unknown.
    pub operator: String,
    /// Which robot; empty when unknown.
    pub robot: String,
    /// Episodes of one session are never split between training and validation; empty: the episode is its own session.
    pub session: String,
    /// Whether it is training or validation data; `None`: the hash of the session, or of the id, says.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub split: Option<Split>,
    /// Start of the episode in the source, in nanoseconds.
    pub start_ns: i64,
    /// End of the episode in the source, in nanoseconds.
    pub end_ns: i64,
    /// Name of the source file that it begins in; empty for the recording's first file.
    pub source_file: String,
    /// What else is known about it.
    pub tags: BTreeMap<String, String>,
}

/// What a finished run of the writer leaves.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct DatasetSummary {
    /// Recordings in the dataset.
    pub recordings: u64,
    /// Episodes in the dataset.
    pub episodes: u64,
    /// Rows in the dataset.
    pub frames: u64,
    /// Recordings that this run added.
    pub new_recordings: u64,
    /// Episodes that this run added.
    pub new_episodes: u64,
    /// Rows that this run added.
    pub new_frames: u64,
    /// Bytes of all data files.
    pub data_bytes: u64,
}
