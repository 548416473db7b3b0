//! `meta/gawm.json`: what a dataset is, where it comes from and how it was made.

use std::collections::BTreeMap;

use gawm_schema::{ContentHash, EncodedDim, Schema, Standardisation};
use serde::{Deserialize, Serialize};

use crate::spec::{DatasetSpec, RecordingInfo};

/// The content of `meta/gawm.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GawmMeta {
    /// Version of the format, [`FORMAT_VERSION`](crate::layout::FORMAT_VERSION).
    pub format_version: u32,
    /// Program that wrote the dataset last.
    pub software: String,
    /// Hash of the schema in canonical JSON.
    pub schema_hash: ContentHash,
    /// What a row holds.
    pub schema: Schema,
    /// Ticks per second as measured or asked for; info.json holds the nearest whole number.
    pub rate_hz: f64,
    /// Share of the sessions that are training data.
    pub train_share: f64,
    /// A data file is closed at the first end of an episode at which it holds this many bytes.
    pub max_file_bytes: u64,
    /// The contracts that recordings were made with, each once.
    pub contracts: Vec<Contract>,
    /// The recordings in order.
    pub recordings: Vec<RecordingRecord>,
    /// Dims of the continuous columns `gawm.state` and `gawm.action`.
    pub encodings: BTreeMap<String, Vec<EncodedDim>>,
    /// Standardisation of each continuous column.
    pub standardisation: Vec<Standardisation>,
}

/// The text of a contract.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Contract {
    /// Hash of the text.
    pub hash: ContentHash,
    /// The text as it was given.
    pub text: String,
}

/// Where a recording of the dataset comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RecordingRecord {
    /// The source.
    pub source: RecordingInfo,
    /// Hash of the contract it was made with.
    pub contract: ContentHash,
    /// Number of its first episode.
    pub first_episode: u64,
    /// Number of its episodes.
    pub episodes: u64,
    /// Number of its rows.
    pub frames: u64,
    /// Data files that hold it, in order; none holds anything else.
    pub files: Vec<FileRecord>,
    /// Attachments and calibrations that came with it.
    #[serde(default)]
    pub attachments: Vec<AttachmentRecord>,
}

/// A data file.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FileRecord {
    /// Number of the file: chunk times 1000 plus file index.
    pub number: u64,
    /// Number of rows.
    pub frames: u64,
    /// Length in bytes.
    pub length_bytes: u64,
}

/// A file beside `meta/gawm.json` that came with a recording.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AttachmentRecord {
    /// Path in the dataset.
    pub path: String,
    /// Name in the source.
    pub name: String,
    /// Hash of the bytes.
    pub content_hash: ContentHash,
    /// Length in bytes.
    pub length_bytes: u64,
}

impl Contract {
    /// Returns a contract with its hash.
    pub fn new(text: &str) -> Contract {
        Contract { hash: ContentHash::of(text.as_bytes()), text: text.to_owned() }
    }
}

impl GawmMeta {
    /// Returns the description of a dataset without recordings.
    pub(crate) fn new(spec: &DatasetSpec) -> GawmMeta {
        GawmMeta {
            format_version: crate::layout::FORMAT_VERSION,
            software: spec.software.clone(),
            schema_hash: spec.schema.hash(),
            schema: spec.schema.clone(),
            rate_hz: spec.schema.rate_hz,
            train_share: spec.train_share,
            max_file_bytes: spec.max_file_bytes,
            contracts: Vec::new(),
            recordings: Vec::new(),
            encodings: BTreeMap::new(),
            standardisation: Vec::new(),
        }
    }
}
