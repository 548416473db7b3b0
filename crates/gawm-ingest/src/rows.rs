//! Rows in the form of a log: what HDF5, npz and LeRobot folders share.
//!
//! Row t of an episode has the time `start + t / rate`; episodes lie [`EPISODE_GAP_NS`] apart, longer than any gap that a
//! contract allows. Every column is a topic, every value a CDR message of a type made for it.

use std::collections::BTreeMap;
use std::io;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;

use crate::log::{Block, BlockRef, Channel, Damage, MetadataRecord, Schema};

/// Time between two episodes: above the largest `max_gap_s` of a contract, an hour.
pub const EPISODE_GAP_NS: i64 = 2 * 3_600 * 1_000_000_000;

/// A block holds rows of about this many bytes, or one row.
pub(crate) const BLOCK_BYTES: u64 = 8 << 20;

/// Bytes before the values of a CDR message: little-endian, no options.
pub(crate) const CDR_HEADER: [u8; 4] = [0, 1, 0, 0];

/// A source of rows in the form of a log. Blocks may be read from many threads.
pub(crate) trait RowRecording: Send + Sync {
    /// The file or folder.
    fn path(&self) -> &Path;
    /// Bytes of all its files.
    fn file_bytes(&self) -> u64;
    /// A hash of all its bytes.
    fn content_hash(&self) -> io::Result<[u8; 32]>;
    /// What is worth keeping: layout, version, hashes of the columns that are used.
    fn notes(&self) -> BTreeMap<String, String>;
    /// One channel per column.
    fn channels(&self) -> &[Arc<Channel>];
    /// One record named `episode` per episode.
    fn metadata(&self) -> &[MetadataRecord];
    /// What was noticed, in the terms of logs.
    fn damage(&self) -> &[Damage];
    /// The blocks in order of time.
    fn blocks(&self) -> &[BlockRef];
    /// Reads a block: never fails; what was lost is in its damage.
    fn read_block(&self, block: &BlockRef) -> Block;
    /// Reads only these topics from now on.
    fn select(&mut self, topics: &[String]);
    /// Says why what is in the file under the name of a topic is not offered as one, and what to do.
    fn why_not_offered(&self, topic: &str) -> Option<(String, Option<&'static str>)> {
        let _ = topic;
        None
    }
    /// Topics that are declared but have no values here, and why.
    fn unavailable(&self) -> &[Unavailable] {
        &[]
    }
}

/// A declared topic without values.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct Unavailable {
    /// The topic.
    pub(crate) topic: String,
    /// For counting: `video_not_decoded`, `file_missing`.
    pub(crate) reason: &'static str,
    /// What is missing, for people.
    pub(crate) detail: String,
    /// What can be done.
    pub(crate) hint: &'static str,
    /// Rows that should have a value.
    pub(crate) rows: u64,
}

/// Makes a channel of CDR messages.
pub(crate) fn channel(topic: &str, type_name: &str, text: String, id: u16) -> Channel {
    let schema =
        Schema { id, name: type_name.to_owned(), encoding: "ros2msg".to_owned(), data: Bytes::from(text) };
    Channel {
        id,
        topic: topic.to_owned(),
        message_encoding: "cdr".to_owned(),
        metadata: BTreeMap::new(),
        schema_id: id,
        schema: Some(Arc::new(schema)),
    }
}

/// What follows the fields of a type with a header.
pub(crate) const HEADER_TEXT: &str = "================================================================================\nMSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
    ================================================================================\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// Begins a message that starts with a header; returns where it starts.
pub(crate) fn push_header(time_ns: i64, data: &mut Vec<u8>) -> usize {
    let start = data.len();
    data.extend_from_slice(&CDR_HEADER);
    let seconds = i32::try_from(time_ns / 1_000_000_000).unwrap_or(i32::MAX);
    data.extend_from_slice(&seconds.to_le_bytes());
    data.extend_from_slice(&((time_ns % 1_000_000_000) as u32).to_le_bytes());
    push_text("", start, data);
    start
}

/// Appends a CDR string: length with its NUL, bytes, NUL.
pub(crate) fn push_text(text: &str, start: usize, data: &mut Vec<u8>) {
    align(start, 4, data);
    data.extend_from_slice(&(text.len() as u32).saturating_add(1).to_le_bytes());
    data.extend_from_slice(text.as_bytes());
    data.push(0);
}

/// Appends a CDR sequence of bytes.
pub(crate) fn push_bytes(bytes: &[u8], start: usize, data: &mut Vec<u8>) {
    align(start, 4, data);
    data.extend_from_slice(&u32::try_from(bytes.len()).unwrap_or(u32::MAX).to_le_bytes());
    data.extend_from_slice(bytes);
}

/// Pads to a multiple of `unit` after the header.
pub(crate) fn align(start: usize, unit: usize, data: &mut Vec<u8>) {
    let at = data.len() - start - CDR_HEADER.len();
    data.resize(data.len() + at.next_multiple_of(unit) - at, 0);
}
