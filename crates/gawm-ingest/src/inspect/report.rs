//! What `inspect --format json` prints; `docs/formats/inspect.md` describes it.

use std::collections::BTreeMap;

use serde::Serialize;

use super::clocks::ClockOffset;
use super::statistics::Rate;
use crate::lerobot::DatasetReport;
use crate::log::{Damage, Severity};
use crate::tabular::TableReport;

/// All inspected files.
#[derive(Debug, Clone, Default, PartialEq, Serialize)]
pub struct InspectReport {
    /// One entry per file that is a log, in reading order.
    pub files: Vec<FileReport>,
    /// Recordings of more than one file.
    pub recordings: Vec<RecordingReport>,
    /// HDF5 and npz files.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub tables: Vec<TableReport>,
    /// LeRobot folders.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub datasets: Vec<DatasetReport>,
    /// Files and folders that are no logs.
    pub refused: Vec<Refusal>,
}

impl InspectReport {
    /// Returns whether anything is lost in any file, or any input was refused.
    pub fn has_loss(&self) -> bool {
        let is_loss = |damage: &Damage| damage.kind.severity() == Severity::Loss;
        !self.refused.is_empty()
            || self.files.iter().any(|file| file.damage.iter().any(is_loss))
            || self.datasets.iter().any(|dataset| dataset.damage.iter().any(is_loss))
            || self.tables.iter().flat_map(|table| &table.findings).any(|found| found.kind.is_loss())
    }
}

/// The parts of a split recording.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct RecordingReport {
    /// Name of the folder or of the files without their numbers.
    pub name: String,
    /// The parts in order.
    pub parts: Vec<String>,
    /// Messages that `metadata.yaml` counts, if it does.
    pub stated_messages: Option<u64>,
}

/// A file or folder that is no log.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Refusal {
    /// Path as named.
    pub path: String,
    /// Why.
    pub error: String,
    /// What helps.
    pub hint: Option<String>,
}

/// One file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FileReport {
    /// Path as named.
    pub path: String,
    /// Profile of the header.
    pub profile: String,
    /// Library of the header.
    pub library: String,
    /// Messages that can be read, salvaged ones included.
    pub messages: u64,
    /// Number of attachments.
    pub attachments: u64,
    /// Number of metadata records.
    pub metadata: u64,
    /// Earliest log time that is not 0; `None` without messages.
    pub start_ns: Option<u64>,
    /// Latest log time.
    pub end_ns: Option<u64>,
    /// Channels by topic, then id.
    pub channels: Vec<ChannelReport>,
    /// What is wrong with the bytes, by offset.
    pub damage: Vec<Damage>,
    /// What is odd about the contents.
    pub notices: Vec<Notice>,
    /// Size of the file in bytes.
    pub bytes: u64,
    /// Whether the file has a usable summary.
    pub has_summary: bool,
    /// Chunks.
    pub chunks: u64,
    /// Runs of records outside chunks that were read in one go.
    pub loose_blocks: u64,
    /// Chunk compression, such as `zstd`, with the number of chunks; `none` for uncompressed ones.
    pub compression: BTreeMap<String, u64>,
    /// Bytes of the records inside chunks, uncompressed.
    pub uncompressed_bytes: u64,
    /// Compression of message bodies (rosbag2 compression mode `MESSAGE`), if there is one.
    pub message_compression: Option<String>,
    /// The attachments.
    pub attachment_list: Vec<AttachmentReport>,
    /// The metadata records.
    pub metadata_list: Vec<MetadataReport>,
}

/// One attachment.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct AttachmentReport {
    /// Name.
    pub name: String,
    /// Media type.
    pub media_type: String,
    /// Size of the data in bytes.
    pub bytes: u64,
}

/// One metadata record.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct MetadataReport {
    /// Name.
    pub name: String,
    /// Key-value pairs.
    pub values: BTreeMap<String, String>,
}

/// One channel.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ChannelReport {
    /// Topic.
    pub topic: String,
    /// Name of the schema, empty without one.
    pub schema_name: String,
    /// Encoding of the schema, empty without one.
    pub schema_encoding: String,
    /// Encoding of the messages.
    pub message_encoding: String,
    /// Messages that can be read.
    pub messages: u64,
    /// Whether the messages can be decoded.
    pub decodable: bool,
    /// Why not.
    pub obstacle: Option<String>,
    /// Id within the file.
    pub id: u16,
    /// Payload bytes.
    pub bytes: u64,
    /// Earliest log time that is not 0.
    pub start_ns: Option<u64>,
    /// Latest log time.
    pub end_ns: Option<u64>,
    /// How often messages come by log time; `None` when there are too few.
    pub rate: Option<Rate>,
    /// How often messages come by publish time; `None` when there is no publish clock.
    pub publish_rate: Option<Rate>,
    /// Whether publish times differ from log times.
    pub has_publish_clock: bool,
    /// Log time minus publish time.
    pub publish_to_log: Option<ClockOffset>,
    /// Messages with a header stamp.
    pub stamps: u64,
    /// Log time minus header stamp.
    pub stamp_to_log: Option<ClockOffset>,
    /// Publish time minus header stamp.
    pub stamp_to_publish: Option<ClockOffset>,
    /// Messages that are missing by sequence number; `None` when the numbers do not only grow.
    pub missing_by_sequence: Option<u64>,
    /// Steps back of the log time, in the order of the file.
    pub backward_steps: u64,
    /// The largest of them in milliseconds.
    pub largest_backward_ms: f64,
    /// Messages that repeat an earlier one of the last 64 exactly.
    pub duplicates: u64,
    /// Messages with log time 0.
    pub log_time_zero: u64,
}

/// Something odd about the contents of a file whose bytes are sound.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Notice {
    /// What it is.
    pub kind: NoticeKind,
    /// Topic, `None` when it concerns the file.
    pub topic: Option<String>,
    /// Numbers and what they mean.
    pub detail: String,
}

/// The kinds of notices.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum NoticeKind {
    /// Publish times equal log times on every channel: nothing is known of delays on the way.
    NoPublishClock,
    /// Nothing came for more than three median periods.
    Gap,
    /// Log times stall and then bunch while publish times go on: the recorder stalled.
    Bunching,
    /// Log times step back.
    BackwardSteps,
    /// Messages are repeated exactly.
    Duplicates,
    /// Sequence numbers skip.
    MissingBySequence,
    /// A channel stops long before the file ends.
    EndsEarly,
    /// The header stamps' clock runs at another rate than the recorder's.
    ClockDrift,
    /// Message bodies are compressed one by one.
    CompressedMessages,
    /// One topic has several channels.
    SeveralChannels,
    /// A channel cannot be decoded.
    NotDecodable,
}
