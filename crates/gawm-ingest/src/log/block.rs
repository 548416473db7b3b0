//! One block of a log, read and parsed on its own: a chunk, or a run of records outside chunks.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;

use super::channel::{Channel, ChannelTable, Schema, channel_of, schema_of};
use super::damage::{Damage, DamageKind};
use super::decompress::{Compression, decompress, salvage, size_refusal};
use super::source::Source;
use super::wire::{
    CHUNK_FIXED, ChannelRecord, ChunkHeader, Cursor, MESSAGE_FIXED, MessageHeader, Parse, RECORD_PREFIX,
    RawRecord, Records, SchemaRecord, op,
};

/// What a block is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BlockKind {
    /// A chunk record.
    Chunk,
    /// A run of records outside chunks.
    Loose,
}

/// The log times of one channel in one block.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct ChannelSpan {
    pub(crate) id: u16,
    pub(crate) first_ns: u64,
    pub(crate) last_ns: u64,
    /// Time of the message that lies last.
    pub(crate) final_ns: u64,
}

impl ChannelSpan {
    pub(crate) fn at(id: u16, time_ns: u64) -> Self {
        Self { id, first_ns: time_ns, last_ns: time_ns, final_ns: time_ns }
    }

    /// Takes the time of the next message in the file.
    pub(crate) fn extend(&mut self, time_ns: u64) {
        self.first_ns = time_ns.min(self.first_ns);
        self.last_ns = time_ns.max(self.last_ns);
        self.final_ns = time_ns;
    }
}

/// Where a block lies, and what is known of it without reading it.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BlockRef {
    /// Chunk or loose records.
    pub kind: BlockKind,
    /// File offset of the first record.
    pub offset: u64,
    /// Stored bytes, record prefixes included.
    pub length: u64,
    /// Name of the chunk's compression, empty for none.
    pub compression: String,
    /// Bytes that the block holds once read: what a memory budget should count.
    pub uncompressed_bytes: u64,
    /// Earliest log time, messages with log time 0 left out; `None` when the block has no messages.
    pub start_ns: Option<u64>,
    /// Latest log time.
    pub end_ns: Option<u64>,
    /// Channels with messages in the block, ascending; `None` when the file does not say.
    pub channel_ids: Option<Arc<[u16]>>,
    /// Log time span per channel where it is known, messages with log time 0 left out.
    pub(crate) spans: Option<Arc<[ChannelSpan]>>,
    /// Number of clock resets before the block: times are comparable only within one segment.
    pub clock_segment: u32,
    /// Whether the file ends inside the block.
    pub is_cut: bool,
    /// Which of its messages are read: a chunk whose channels lie far apart in time is read once for each group of them.
    pub(crate) part: BlockPart,
}

impl BlockRef {
    /// Makes the reference of a block of rows: its number stands for its offset.
    pub(crate) fn of_table(number: u64, bytes: u64, start_ns: Option<u64>, end_ns: Option<u64>) -> Self {
        Self {
            kind: BlockKind::Chunk,
            offset: number,
            length: 0,
            compression: String::new(),
            uncompressed_bytes: bytes,
            start_ns,
            end_ns,
            channel_ids: None,
            spans: None,
            clock_segment: 0,
            is_cut: false,
            part: BlockPart::Whole,
        }
    }
}

/// The messages of a block that are read.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) enum BlockPart {
    /// All of them.
    #[default]
    Whole,
    /// All but those of some channels; damage is reported here.
    Without(Arc<[u16]>),
    /// Those of some channels alone.
    Only(Arc<[u16]>),
}

impl BlockPart {
    fn has(&self, id: u16) -> bool {
        match self {
            Self::Whole => true,
            Self::Without(ids) => !ids.contains(&id),
            Self::Only(ids) => ids.contains(&id),
        }
    }

    /// Returns whether the block's other part reports its damage.
    pub(crate) fn is_repeat(&self) -> bool {
        matches!(self, Self::Only(_))
    }
}

/// One message; its payload is a range of its block's data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Message {
    /// Index into [`Block::channels`].
    pub channel: u32,
    /// The writer's sequence number, 0 when it keeps none.
    pub sequence: u32,
    /// Time of recording.
    pub log_time_ns: u64,
    /// Time of publishing, equal to the log time when the writer does not know it.
    pub publish_time_ns: u64,
    /// Where the payload lies in [`Block::data`].
    pub range: Range<usize>,
    /// File offset of the record, or of the chunk that holds it.
    pub offset: u64,
}

/// The messages of a block and what was lost of it.
#[derive(Debug, Default)]
pub struct Block {
    /// Messages in file order.
    pub messages: Vec<Message>,
    /// The bytes that payloads are ranges of.
    pub data: Bytes,
    /// Channels that the messages refer to, each with the definition in force in this block.
    pub channels: Vec<Arc<Channel>>,
    /// Definitions in this block that the log did not know when it was opened.
    pub new_channels: Vec<Arc<Channel>>,
    /// What was lost or odd.
    pub damage: Vec<Damage>,
}

impl Block {
    /// Returns the payload of one of this block's messages.
    pub fn payload(&self, message: &Message) -> &[u8] {
        &self.data[message.range.clone()]
    }

    /// Returns the channel of one of this block's messages.
    pub fn channel(&self, message: &Message) -> &Arc<Channel> {
        &self.channels[message.channel as usize]
    }
}

/// Largest sizes that are read or allocated.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Limits {
    pub(crate) record_bytes: u64,
    pub(crate) chunk_bytes: u64,
}

/// Reads and parses one block; what cannot be read is in the block's damage.
pub(crate) fn read_block(source: &Source, table: &ChannelTable, block: &BlockRef, limits: Limits) -> Block {
    let mut parser = BlockParser::new(table, block);
    let data = match block.kind {
        BlockKind::Loose => read_loose(source, block, limits),
        BlockKind::Chunk => read_chunk(source, block, limits, &mut parser.damage).map(|chunk| {
            parser.stated_span = Some((chunk.header.start_time, chunk.header.end_time));
            chunk.data
        }),
    };
    match data {
        Ok(data) => parser.parse(&data),
        Err(damage) => parser.damage.push(damage),
    }
    parser.finish()
}

fn read_failed(offset: u64, error: &std::io::Error) -> Damage {
    Damage::new(DamageKind::ReadFailed, offset, format!("{error}; the block is dropped"))
}

fn stored_length(block: &BlockRef, limit: u64) -> Result<usize, Damage> {
    let too_large = || {
        let detail =
            format!("the record has {} bytes, expected at most {limit}; it is dropped", block.length);
        Damage::new(DamageKind::SizeLimit, block.offset, detail)
    };
    if block.length > limit {
        Err(too_large())
    } else {
        usize::try_from(block.length).map_err(|_too_wide| too_large())
    }
}

fn read_loose(source: &Source, block: &BlockRef, limits: Limits) -> Result<Bytes, Damage> {
    let length = stored_length(block, limits.record_bytes.saturating_add(RECORD_PREFIX))?;
    source.read(block.offset, length).map_err(|error| read_failed(block.offset, &error))
}

/// A chunk after decompression, before its data is checked.
pub(crate) struct UnpackedChunk {
    pub(crate) header: ChunkHeader,
    pub(crate) data: Bytes,
    pub(crate) is_cut: bool,
}

/// Reads the records of a chunk; `Err` when the whole chunk is dropped.
fn read_chunk(
    source: &Source,
    block: &BlockRef,
    limits: Limits,
    damage: &mut Vec<Damage>,
) -> Result<UnpackedChunk, Damage> {
    let chunk = unpack_chunk(source, block, limits, damage)?;
    check_chunk(&chunk, block.offset, damage)?;
    Ok(chunk)
}

/// Reads and decompresses a chunk without a look at its CRC.
pub(crate) fn unpack_chunk(
    source: &Source,
    block: &BlockRef,
    limits: Limits,
    damage: &mut Vec<Damage>,
) -> Result<UnpackedChunk, Damage> {
    let length = stored_length(block, limits.record_bytes)?;
    let record = source.read(block.offset, length).map_err(|error| read_failed(block.offset, &error))?;
    let malformed = || {
        Damage::new(
            DamageKind::RecordMalformed,
            block.offset,
            "the chunk's header is damaged; the chunk is dropped",
        )
    };
    let body = record.get(RECORD_PREFIX as usize..).ok_or_else(malformed)?;
    let header = ChunkHeader::parse(body).ok_or_else(malformed)?;
    let data_at = record.len() - body.len() + CHUNK_FIXED as usize + header.compression.len();
    let available = record.slice(data_at.min(record.len())..);
    let n_stored =
        usize::try_from(header.compressed_size).map_or(available.len(), |size| size.min(available.len()));
    let is_cut = (n_stored as u64) < header.compressed_size;
    let Some(compression) = Compression::from_name(&header.compression) else {
        let detail =
            format!("expected \"\", \"lz4\" or \"zstd\", got {:?}; the chunk is dropped", header.compression);
        return Err(Damage::new(DamageKind::UnsupportedCompression, block.offset, detail));
    };
    if let Some(refusal) = size_refusal(header.compressed_size, header.uncompressed_size, limits.chunk_bytes)
    {
        return Err(Damage::new(
            DamageKind::SizeLimit,
            block.offset,
            format!("the chunk {refusal}; it is dropped"),
        ));
    }
    let uncompressed = usize::try_from(header.uncompressed_size).map_err(|_too_wide| malformed())?;
    let data = unpack(&available.slice(..n_stored), compression, uncompressed, is_cut, block.offset, damage);
    Ok(UnpackedChunk { header, data, is_cut })
}

/// Decompresses the stored bytes of a chunk as far as they go.
fn unpack(
    stored: &Bytes,
    compression: Compression,
    uncompressed: usize,
    is_cut: bool,
    offset: u64,
    damage: &mut Vec<Damage>,
) -> Bytes {
    if compression == Compression::None {
        return stored.clone();
    }
    let unpacked = if is_cut {
        salvage(compression, stored, uncompressed, "the file ends inside the chunk".to_owned())
    } else {
        decompress(compression, stored, uncompressed)
    };
    if let Some(failure) = unpacked.failure.filter(|_| !is_cut) {
        let detail =
            format!("{failure}; {} of {uncompressed} bytes could be decompressed", unpacked.data.len());
        damage.push(Damage::new(DamageKind::DecompressionFailed, offset, detail));
    }
    Bytes::from(unpacked.data)
}

/// Compares the data of a chunk with its header; `Err` when it must not be used.
pub(crate) fn check_chunk(
    chunk: &UnpackedChunk,
    offset: u64,
    damage: &mut Vec<Damage>,
) -> Result<(), Damage> {
    let UnpackedChunk { header, data, is_cut } = chunk;
    let expected = header.uncompressed_size;
    if *is_cut {
        let n_read = data.len();
        let detail = format!(
            "the file ends inside the chunk; the messages in its first {n_read} of {expected} bytes are kept"
        );
        damage.push(Damage::new(DamageKind::ChunkTruncated, offset, detail));
        return Ok(());
    }
    if damage.iter().any(|d| d.kind == DamageKind::DecompressionFailed) {
        return Ok(());
    }
    if data.len() as u64 != expected {
        let detail = format!("expected {expected} uncompressed bytes, got {}", data.len());
        damage.push(Damage::new(DamageKind::ChunkSizeMismatch, offset, detail));
    }
    let crc = if header.uncompressed_crc == 0 { 0 } else { crc32fast::hash(data) };
    if crc != header.uncompressed_crc {
        let detail =
            format!("expected {:#010x}, got {crc:#010x}; the chunk is dropped", header.uncompressed_crc);
        return Err(Damage::new(DamageKind::ChunkCrcMismatch, offset, detail));
    }
    Ok(())
}

/// Marks a channel id that the block has not used yet.
const UNUSED: u32 = u32::MAX;

/// Turns the records of one block into messages.
struct BlockParser<'a> {
    table: &'a ChannelTable,
    block: &'a BlockRef,
    /// Index into `channels` for each channel id, or [`UNUSED`].
    slots: Vec<u32>,
    channels: Vec<Arc<Channel>>,
    local_schemas: BTreeMap<u16, Arc<Schema>>,
    new_channels: Vec<Arc<Channel>>,
    messages: Vec<Message>,
    /// Messages and first offset per channel id that is defined nowhere.
    unknown: BTreeMap<u16, (u64, u64)>,
    damage: Vec<Damage>,
    data: Bytes,
    /// The log times between which the chunk's header puts its messages.
    stated_span: Option<(u64, u64)>,
}

impl<'a> BlockParser<'a> {
    fn new(table: &'a ChannelTable, block: &'a BlockRef) -> Self {
        Self {
            table,
            block,
            slots: vec![UNUSED; table.id_limit()],
            channels: Vec::new(),
            local_schemas: BTreeMap::new(),
            new_channels: Vec::new(),
            messages: Vec::new(),
            unknown: BTreeMap::new(),
            damage: Vec::new(),
            data: Bytes::new(),
            stated_span: None,
        }
    }

    fn parse(&mut self, data: &Bytes) {
        self.data = data.clone();
        let mut records = Records::new(data);
        for record in records.by_ref() {
            self.record(record);
        }
        let rest = records.rest();
        let is_known_short =
            self.block.is_cut || self.damage.iter().any(|d| d.kind == DamageKind::DecompressionFailed);
        if !rest.is_empty() && !is_known_short {
            let length = Cursor::new(rest.get(1..).unwrap_or_default()).u64();
            let detail = format!(
                "a record at byte {} of the chunk states {} bytes, expected at most {}; the {} bytes from there on are lost",
                records.position(),
                length.map_or_else(|| "no".to_owned(), |n| n.to_string()),
                rest.len().saturating_sub(RECORD_PREFIX as usize),
                rest.len()
            );
            self.damage.push(Damage::new(DamageKind::RecordOverrun, self.block.offset, detail));
        }
    }

    /// File offset to report for a record of this block.
    fn offset_of(&self, record: &RawRecord<'_>) -> u64 {
        match self.block.kind {
            BlockKind::Chunk => self.block.offset,
            BlockKind::Loose => self.block.offset + record.at as u64,
        }
    }

    fn record(&mut self, record: RawRecord<'_>) {
        let is_good = match record.op {
            op::MESSAGE => self.message(&record).is_some(),
            op::SCHEMA => self.schema(&record).is_some(),
            op::CHANNEL => self.channel(&record).is_some(),
            op::HEADER..=op::DATA_END if self.block.kind == BlockKind::Chunk => {
                let detail = format!("record of opcode {:#04x} inside a chunk; it is skipped", record.op);
                self.damage.push(Damage::new(DamageKind::UnexpectedRecord, self.block.offset, detail));
                true
            }
            _ => true,
        };
        if !is_good {
            let detail = format!(
                "record of opcode {:#04x} with {} bytes; it is dropped",
                record.op,
                record.body.len()
            );
            self.damage.push(Damage::new(DamageKind::RecordMalformed, self.offset_of(&record), detail));
        }
    }

    fn message(&mut self, record: &RawRecord<'_>) -> Option<()> {
        let header = MessageHeader::parse(record.body)?;
        if !self.block.part.has(header.channel_id) {
            return Some(());
        }
        let offset = self.offset_of(record);
        let Some(channel) = self.slot(header.channel_id) else {
            self.unknown.entry(header.channel_id).or_insert((0, offset)).0 += 1;
            return Some(());
        };
        let body_at = record.at + RECORD_PREFIX as usize;
        self.messages.push(Message {
            channel,
            sequence: header.sequence,
            log_time_ns: header.log_time,
            publish_time_ns: header.publish_time,
            range: body_at + MESSAGE_FIXED as usize..body_at + record.body.len(),
            offset,
        });
        Some(())
    }

    /// Returns the index of a channel id's current definition.
    fn slot(&mut self, id: u16) -> Option<u32> {
        match self.slots.get(usize::from(id)) {
            Some(&slot) if slot != UNUSED => Some(slot),
            _ => {
                let channel = Arc::clone(self.table.channel_at(id, self.block.offset)?);
                Some(self.bind(channel))
            }
        }
    }

    fn bind(&mut self, channel: Arc<Channel>) -> u32 {
        let id = usize::from(channel.id);
        if self.slots.len() <= id {
            self.slots.resize(id + 1, UNUSED);
        }
        // A block has less than 2^32 definitions: each takes more than one byte of it, and blocks are capped.
        let slot = u32::try_from(self.channels.len()).unwrap_or(UNUSED);
        self.channels.push(channel);
        self.slots[id] = slot;
        slot
    }

    fn schema(&mut self, record: &RawRecord<'_>) -> Option<()> {
        let schema = schema_of(&SchemaRecord::parse(record.body)?);
        let offset = self.offset_of(record);
        let known =
            self.local_schemas.get(&schema.id).or_else(|| self.table.schema_at(schema.id, self.block.offset));
        if known.is_some_and(|known| **known == schema) || schema.id == 0 {
            return Some(());
        }
        if known.is_some() && !self.table.has_schema(&schema) {
            let detail = format!(
                "schema {} is {:?} with other content from here on in this block",
                schema.id, schema.name
            );
            self.damage.push(Damage::new(DamageKind::SchemaRedefined, offset, detail));
        }
        self.local_schemas.insert(schema.id, Arc::new(schema));
        Some(())
    }

    fn channel(&mut self, record: &RawRecord<'_>) -> Option<()> {
        let definition = ChannelRecord::parse(record.body)?;
        let offset = self.offset_of(record);
        let id = definition.id;
        let local_schema = self.local_schemas.get(&definition.schema_id);
        let schema = local_schema.or_else(|| self.table.schema_at(definition.schema_id, self.block.offset));
        let channel = channel_of(&definition, schema.cloned());
        let bound = self.slots.get(usize::from(id)).and_then(|&slot| self.channels.get(slot as usize));
        let in_force = bound.or_else(|| self.table.channel_at(id, self.block.offset));
        if in_force.is_some_and(|known| **known == channel) {
            return Some(());
        }
        if let Some(known) = self.table.find(&channel) {
            let known = Arc::clone(known);
            self.bind(known);
            return Some(());
        }
        if in_force.is_some() {
            let detail =
                format!("channel {id} is {:?} with other content from here on in this block", channel.topic);
            self.damage.push(Damage::new(DamageKind::ChannelRedefined, offset, detail));
        }
        let channel = Arc::new(channel);
        self.new_channels.push(Arc::clone(&channel));
        self.bind(channel);
        Some(())
    }

    fn finish(mut self) -> Block {
        for (id, (n_messages, offset)) in std::mem::take(&mut self.unknown) {
            let detail = format!("channel {id} is defined nowhere; {n_messages} messages are dropped");
            self.damage.push(Damage::new(DamageKind::UnknownChannel, offset, detail));
        }
        self.check_times();
        if self.block.part.is_repeat() {
            self.damage.clear();
            self.new_channels.clear();
        }
        Block {
            messages: self.messages,
            data: self.data,
            channels: self.channels,
            new_channels: self.new_channels,
            damage: self.damage,
        }
    }

    fn check_times(&mut self) {
        let Some((start, end)) = self.stated_span else { return };
        let times = self.messages.iter().map(|message| message.log_time_ns).filter(|&time| time != 0);
        let n_outside = times.filter(|time| !(start..=end).contains(time)).count();
        if n_outside > 0 {
            let detail =
                format!("{n_outside} messages lie outside the stated span {start}..={end} ns; they are kept");
            self.damage.push(Damage::new(DamageKind::ChunkTimeMismatch, self.block.offset, detail));
        }
    }
}
