//! Reads any MCAP file: positional, in parallel, and past damage.
//!
//! [`Log::open`] learns what a file holds from its summary, from a scan over its record headers, or from both: every part
//! of the data section that the index does not cover is scanned, so that messages outside chunks, unlisted chunks and damage
//! are found whatever the summary says. [`Log::blocks`] lists what there is to read, in reading order;
//! [`Log::read_block`] reads, checks, decompresses and parses one block and may be called from many threads at once.
//!
//! Damage never ends a log as long as more of it can be read: what is wrong is in [`Log::damage`] and [`Block::damage`].
//!
//! ```no_run
//! # fn main() -> Result<(), gawm_ingest::log::OpenLogError> {
//! use gawm_ingest::log::{Log, OpenOptions};
//!
//! let log = Log::open("run.mcap".as_ref(), &OpenOptions::default())?;
//! for block in log.blocks() {
//!     let block = log.read_block(block);
//!     for message in &block.messages {
//!         println!("{} {}", block.channel(message).topic, block.payload(message).len());
//!     }
//! }
//! # Ok(())
//! # }
//! ```
//!
//! **Invariant**: no length or size of a file is believed before it is compared with what is there or with a limit.

mod block;
mod channel;
mod damage;
mod decompress;
mod definitions;
mod error;
mod listing;
mod open;
mod order;
mod recording;
mod refusal;
mod rosbag2;
mod source;
mod step;
mod summary;
mod walk;
pub(crate) mod wire;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use channel::ChannelTable;
use source::Source;
use wire::{AttachmentHeader, Header};

pub(crate) use listing::RecordSource;

pub use block::{Block, BlockKind, BlockRef, Message};
pub use channel::{Channel, Schema};
pub use damage::{Damage, DamageKind, Severity};
pub use decompress::{decompress_message, looks_like_zstd};
pub use error::{OpenLogError, ReadError};
pub use recording::{Discovery, Recording, discover};
pub use refusal::Foreign;
pub use rosbag2::Rosbag2Metadata;

/// Limits and tolerances of opening and reading a log.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct OpenOptions {
    /// Largest stored record that is read, in bytes.
    pub max_record_bytes: u64,
    /// Largest chunk that is decompressed, in uncompressed bytes.
    pub max_chunk_bytes: u64,
    /// How far a channel's log times may run back before it counts as a clock reset, in nanoseconds.
    pub disorder_window_ns: u64,
}

impl Default for OpenOptions {
    fn default() -> Self {
        Self { max_record_bytes: 1 << 30, max_chunk_bytes: 1 << 30, disorder_window_ns: 1_000_000_000 }
    }
}

/// One MCAP file, opened.
#[derive(Debug)]
pub struct Log {
    path: PathBuf,
    source: Source,
    options: OpenOptions,
    header: Header,
    table: ChannelTable,
    channels: BTreeMap<u16, Arc<Channel>>,
    attachments: Vec<AttachmentInfo>,
    metadata: Vec<MetadataRecord>,
    damage: Vec<Damage>,
    blocks: Vec<BlockRef>,
    counts: Option<SummaryCounts>,
    /// First byte after the magic up to the end of the data section, and the CRC stated there.
    data_section: Option<(u64, u32)>,
    has_summary: bool,
}

/// An attachment without its data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct AttachmentInfo {
    /// Name, often a file name.
    pub name: String,
    /// Media type; may be empty.
    pub media_type: String,
    /// Time of recording.
    pub log_time_ns: u64,
    /// Time of creation, 0 when unknown.
    pub create_time_ns: u64,
    /// Size of the data in bytes.
    pub data_size: u64,
    /// File offset of the record.
    pub offset: u64,
    /// Bytes of the record with its prefix.
    pub length: u64,
}

impl AttachmentInfo {
    pub(crate) fn new(header: &AttachmentHeader, offset: u64, length: u64) -> Self {
        Self {
            name: header.name.clone(),
            media_type: header.media_type.clone(),
            log_time_ns: header.log_time,
            create_time_ns: header.create_time,
            data_size: header.data_size,
            offset,
            length,
        }
    }
}

/// A metadata record.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MetadataRecord {
    /// Name; several records may share one.
    pub name: String,
    /// Key-value pairs.
    pub values: BTreeMap<String, String>,
    /// File offset of the record.
    pub offset: u64,
}

impl MetadataRecord {
    pub(crate) fn new(record: wire::Metadata, offset: u64) -> Self {
        Self { name: record.name, values: record.metadata, offset }
    }
}

/// What the writer says it wrote; nothing here is checked.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SummaryCounts {
    /// Messages in the file.
    pub messages: u64,
    /// Messages per channel id.
    pub messages_by_channel: BTreeMap<u16, u64>,
    /// Chunks.
    pub chunks: u32,
    /// Attachments.
    pub attachments: u32,
    /// Metadata records.
    pub metadata: u32,
    /// Earliest log time.
    pub start_ns: u64,
    /// Latest log time.
    pub end_ns: u64,
}

impl Log {
    /// Returns the path that the log was opened from.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the bytes of the file.
    pub fn file_bytes(&self) -> u64 {
        self.source.len()
    }

    /// Returns the profile of the header, such as `ros2`; often empty.
    pub fn profile(&self) -> &str {
        &self.header.profile
    }

    /// Returns the library that wrote the file.
    pub fn library(&self) -> &str {
        &self.header.library
    }

    /// Returns the first definition of every channel that was known when the log was opened.
    pub fn channels(&self) -> &BTreeMap<u16, Arc<Channel>> {
        &self.channels
    }

    /// Returns the attachments in file order.
    pub fn attachments(&self) -> &[AttachmentInfo] {
        &self.attachments
    }

    /// Returns the metadata records in file order.
    pub fn metadata(&self) -> &[MetadataRecord] {
        &self.metadata
    }

    /// Returns what opening found wrong, by offset; blocks have their own.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    /// Returns the blocks in reading order.
    pub fn blocks(&self) -> &[BlockRef] {
        &self.blocks
    }

    /// Returns each block once and whole, in the order of the file.
    pub fn blocks_in_file_order(&self) -> Vec<BlockRef> {
        let mut blocks: Vec<BlockRef> =
            self.blocks.iter().filter(|block| !block.part.is_repeat()).cloned().collect();
        blocks.iter_mut().for_each(|block| block.part = block::BlockPart::Whole);
        blocks.sort_by_key(|block| block.offset);
        blocks
    }

    /// Returns the number of chunks per compression; `none` stands for uncompressed ones.
    pub fn compressions(&self) -> BTreeMap<String, u64> {
        let mut counts = BTreeMap::new();
        for block in
            self.blocks.iter().filter(|block| block.kind == BlockKind::Chunk && !block.part.is_repeat())
        {
            let name = if block.compression.is_empty() { "none" } else { &block.compression };
            *counts.entry(name.to_owned()).or_default() += 1;
        }
        counts
    }

    /// Returns what the writer counted, if it wrote that down.
    pub fn summary_counts(&self) -> Option<&SummaryCounts> {
        self.counts.as_ref()
    }

    /// Returns whether the file has a summary that could be used.
    pub fn has_summary(&self) -> bool {
        self.has_summary
    }
}
