//! Tells what record starts at an offset, by its fields and not by its opcode alone; and finds the next one after damage.

use std::io;

use super::block::Limits;
use super::channel::Definition;
use super::decompress::Compression;
use super::source::Window;
use super::walk::Walk;
use super::wire::{
    AttachmentHeader, CHUNK_FIXED, ChannelRecord, ChunkHeader, Cursor, DataEnd, Footer, Header,
    MESSAGE_FIXED, MessageHeader, Metadata, Parse, RECORD_PREFIX, SchemaRecord, Statistics, op,
    record_prefix,
};

/// Longest compression name that is taken for one.
const COMPRESSION_NAME_MAX: u64 = 32;
/// Longest header of an attachment: its two strings are names, not data.
const ATTACHMENT_HEADER_MAX: u64 = 64 << 10;
/// Unknown fields after the data of a chunk that are still plausible.
pub(super) const CHUNK_PADDING_MAX: u64 = 64 << 10;
/// Records that must follow each other before a place is believed to be a record's start.
const RESYNC_CHAIN: usize = 3;
/// Bytes that a search for the next record looks at in one go.
const RESYNC_STEP: u64 = 64 << 10;

/// A record whose fields fit.
#[derive(Debug)]
pub(crate) struct Step {
    pub(crate) at: u64,
    pub(crate) next: u64,
    pub(crate) op: u8,
    pub(crate) item: Item,
}

/// What the record is.
#[derive(Debug)]
pub(crate) enum Item {
    Header(Header),
    Definition(Definition),
    Message(MessageHeader),
    Chunk(ChunkHeader),
    MessageIndex { channel_id: u16, n_entries: u64 },
    Attachment(AttachmentHeader),
    Metadata(Metadata),
    DataEnd { crc: u32 },
    Statistics(Statistics),
    Footer,
    Other,
}

/// A place where no record fits.
#[derive(Debug)]
pub(crate) struct Misfit {
    pub(crate) at: u64,
    /// The length that the place states, if it has nine bytes.
    pub(crate) length: u64,
    /// The chunk header there and the record length that it implies, when it reads like one.
    pub(crate) chunk: Option<(ChunkHeader, u64)>,
}

impl Step {
    /// Returns whether the specification does not know the opcode.
    pub(crate) fn is_private(&self) -> bool {
        self.op > op::DATA_END
    }

    /// Returns whether nothing but the length says where the record ends.
    pub(crate) fn is_weak(&self) -> bool {
        self.is_private() || matches!(self.item, Item::Message(_))
    }
}

/// Reads the record at `at`; it must end at or before `to`.
pub(crate) fn classify(
    window: &mut Window<'_>,
    at: u64,
    to: u64,
    limits: Limits,
) -> io::Result<Result<Step, Misfit>> {
    let prefix = record_prefix(window.peek(at, RECORD_PREFIX)?);
    let Some((opcode, length)) = prefix.filter(|_| at + RECORD_PREFIX <= to) else {
        return Ok(Err(Misfit { at, length: 0, chunk: None }));
    };
    let next = (at + RECORD_PREFIX).checked_add(length).filter(|&next| next <= to);
    if let (Some(next), true) = (next, opcode != 0) {
        let n_needed = bytes_needed(opcode).min(length);
        let reads_whole = n_needed == length;
        if n_needed <= limits.record_bytes {
            let body = &window.peek(at + RECORD_PREFIX, n_needed)?;
            if let Some(item) = item(opcode, body, length, reads_whole) {
                return Ok(Ok(Step { at, next, op: opcode, item }));
            }
        }
    }
    let chunk = if opcode == op::CHUNK { chunk_header(window, at, to)? } else { None };
    Ok(Err(Misfit { at, length, chunk }))
}

/// How much of a record's body must be read to know what it is.
fn bytes_needed(opcode: u8) -> u64 {
    match opcode {
        op::MESSAGE => MESSAGE_FIXED,
        op::CHUNK => CHUNK_FIXED + COMPRESSION_NAME_MAX,
        op::MESSAGE_INDEX => 2 + 4,
        op::ATTACHMENT => ATTACHMENT_HEADER_MAX,
        op::HEADER | op::SCHEMA | op::CHANNEL | op::METADATA | op::STATISTICS => u64::MAX,
        op::DATA_END => 4,
        op::FOOTER => 20,
        _ => 0,
    }
}

/// Parses the body of a record, of which `body` is the start; `None` when its fields do not fit its length.
fn item(opcode: u8, body: &[u8], length: u64, is_whole: bool) -> Option<Item> {
    match opcode {
        op::MESSAGE => MessageHeader::parse(body).map(Item::Message),
        op::CHUNK => {
            let header = ChunkHeader::parse(body)?;
            let implied = implied_length(&header)?;
            (implied <= length && length - implied <= CHUNK_PADDING_MAX).then_some(Item::Chunk(header))
        }
        op::MESSAGE_INDEX => {
            let mut cursor = Cursor::new(body);
            let channel_id = cursor.u16()?;
            let array = u64::from(cursor.u32()?);
            (array % 16 == 0 && array + 6 <= length)
                .then_some(Item::MessageIndex { channel_id, n_entries: array / 16 })
        }
        op::ATTACHMENT => {
            let header = AttachmentHeader::parse(body)?;
            (attachment_length(&header)? <= length).then_some(Item::Attachment(header))
        }
        op::SCHEMA if is_whole => {
            SchemaRecord::parse(body).map(|record| Item::Definition(Definition::schema(&record)))
        }
        op::CHANNEL if is_whole => {
            ChannelRecord::parse(body).map(|record| Item::Definition(Definition::Channel(record)))
        }
        op::METADATA if is_whole => Metadata::parse(body).map(Item::Metadata),
        op::STATISTICS if is_whole => Statistics::parse(body).map(Item::Statistics),
        op::HEADER if is_whole => Header::parse(body).map(Item::Header),
        op::DATA_END => DataEnd::parse(body).map(|end| Item::DataEnd { crc: end.data_section_crc }),
        op::FOOTER => Footer::parse(body).map(|_| Item::Footer),
        op::HEADER..=op::DATA_END => Some(Item::Other),
        _ => Some(Item::Other),
    }
}

fn implied_length(header: &ChunkHeader) -> Option<u64> {
    (CHUNK_FIXED + header.compression.len() as u64).checked_add(header.compressed_size)
}

/// Returns the bytes of an attachment record's body.
pub(crate) fn attachment_length(header: &AttachmentHeader) -> Option<u64> {
    let strings = header.name.len() as u64 + header.media_type.len() as u64;
    (8 + 8 + 4 + 4 + 8 + 4 + strings).checked_add(header.data_size)
}

/// Reads a chunk's header whatever the length of its record says; `None` when it does not read like one.
pub(crate) fn chunk_header(
    window: &mut Window<'_>,
    at: u64,
    to: u64,
) -> io::Result<Option<(ChunkHeader, u64)>> {
    let n_there = (CHUNK_FIXED + COMPRESSION_NAME_MAX).min(to.saturating_sub(at + RECORD_PREFIX));
    let header = ChunkHeader::parse(window.peek(at + RECORD_PREFIX, n_there)?);
    Ok(header
        .filter(is_plausible_chunk)
        .and_then(|header| implied_length(&header).map(|length| (header, length))))
}

fn is_plausible_chunk(header: &ChunkHeader) -> bool {
    let is_known = Compression::from_name(&header.compression);
    let has_fitting_sizes = match is_known {
        Some(Compression::None) => header.compressed_size == header.uncompressed_size,
        Some(_) => true,
        None => false,
    };
    header.start_time <= header.end_time && has_fitting_sizes
}

impl Walk<'_> {
    /// Returns the next offset in `from..to` where a record surely starts.
    pub(super) fn resync(&mut self, from: u64, to: u64) -> io::Result<Option<u64>> {
        let mut base = from;
        while base < to {
            let n_look = RESYNC_STEP.min(to - base);
            let opcodes = self.window.peek(base, n_look + RECORD_PREFIX)?.to_vec();
            let n_look = usize::try_from(n_look).unwrap_or(usize::MAX).min(opcodes.len());
            if n_look == 0 {
                break;
            }
            for at in 0..n_look {
                let is_candidate = matches!(opcodes[at], op::FOOTER..=op::DATA_END)
                    && record_prefix(&opcodes[at..]).is_some_and(|(_, length)| length <= to - base);
                if is_candidate && self.is_chain(base + at as u64, to)? {
                    return Ok(Some(base + at as u64));
                }
            }
            base += n_look as u64;
        }
        Ok(None)
    }

    /// Returns whether records follow each other from `at` on, enough of them to believe it.
    fn is_chain(&mut self, at: u64, to: u64) -> io::Result<bool> {
        let mut next = at;
        for n_before in 0..RESYNC_CHAIN {
            let step = match classify(&mut self.window, next, to, self.limits)? {
                Ok(step) if !step.is_private() => step,
                _ => return Ok(false),
            };
            match &step.item {
                Item::Chunk(header) if is_plausible_chunk(header) => return Ok(true),
                Item::Chunk(_) => return Ok(false),
                Item::Message(header) if !self.is_known_channel(header.channel_id) => return Ok(false),
                Item::MessageIndex { n_entries: 0, .. } | Item::Other if n_before == 0 => return Ok(false),
                Item::Footer => return Ok(true),
                _ if step.next == to => return Ok(true),
                _ => next = step.next,
            }
        }
        Ok(true)
    }

    fn is_known_channel(&self, id: u16) -> bool {
        self.known_ids.is_empty() || self.known_ids.contains(&id)
    }
}
