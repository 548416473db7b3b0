//! The summary section: what it says, and which of its index entries describe what really lies in the file.

use std::collections::{BTreeMap, BTreeSet};
use std::io;

use super::block::{BlockRef, Limits};
use super::channel::Definition;
use super::damage::{Damage, DamageKind};
use super::source::{Source, Window};
use super::step::{Item, chunk_header, classify};
use super::walk::chunk_block;
use super::wire::{
    AttachmentIndex, ChannelRecord, ChunkIndex, FOOTER_RECORD, Footer, MAGIC, MetadataIndex, Parse,
    RECORD_PREFIX, Records, SchemaRecord, Statistics, op, record_prefix,
};
use super::{AttachmentInfo, MetadataRecord};

/// The end of a file.
#[derive(Debug)]
pub(crate) struct Tail {
    /// Offset of the footer record.
    pub(crate) footer_at: u64,
    pub(crate) footer: Footer,
}

/// The records of a summary section.
#[derive(Debug, Default)]
pub(crate) struct Summary {
    pub(crate) start: u64,
    pub(crate) definitions: Vec<Definition>,
    /// Whether one id has two definitions.
    pub(crate) is_ambiguous: bool,
    pub(crate) chunks: Vec<ChunkIndex>,
    pub(crate) attachments: Vec<AttachmentIndex>,
    pub(crate) metadata: Vec<MetadataIndex>,
    pub(crate) statistics: Option<Statistics>,
}

/// Reads the footer at the end of the file; reports a damaged end magic.
pub(crate) fn read_tail(source: &Source, damage: &mut Vec<Damage>) -> io::Result<Option<Tail>> {
    let end_length = FOOTER_RECORD + MAGIC.len() as u64;
    let Some(footer_at) = source.len().checked_sub(end_length).filter(|&at| at >= MAGIC.len() as u64) else {
        return Ok(None);
    };
    let mut end = [0; (FOOTER_RECORD as usize) + MAGIC.len()];
    source.read_into(footer_at, &mut end)?;
    let (record, magic) = end.split_at(FOOTER_RECORD as usize);
    let is_footer = record_prefix(record) == Some((op::FOOTER, FOOTER_RECORD - RECORD_PREFIX));
    let footer = Footer::parse(&record[RECORD_PREFIX as usize..]).filter(|_| is_footer);
    let Some(footer) = footer else { return Ok(None) };
    if magic != MAGIC {
        let detail = format!("expected {MAGIC:02x?}, got {magic:02x?}; the footer before it is used");
        damage.push(Damage::new(DamageKind::BadEndMagic, source.len() - MAGIC.len() as u64, detail));
    }
    Ok(Some(Tail { footer_at, footer }))
}

/// Reads the summary section that the footer points to; `None` when there is none or it cannot be trusted.
pub(crate) fn read_summary(
    source: &Source,
    tail: &Tail,
    limits: Limits,
    damage: &mut Vec<Damage>,
) -> io::Result<Option<Summary>> {
    let start = if tail.footer.summary_start == 0 { tail.footer_at } else { tail.footer.summary_start };
    let unreadable = |detail: String| Damage::new(DamageKind::SummaryUnreadable, tail.footer_at, detail);
    let length = tail.footer_at.checked_sub(start).filter(|_| start >= MAGIC.len() as u64);
    let Some(length) = length.filter(|&length| length <= limits.record_bytes) else {
        let detail = format!(
            "the footer points to offset {start}, expected one in {}..={} and at most {} bytes before the footer; the file is scanned",
            MAGIC.len(),
            tail.footer_at,
            limits.record_bytes
        );
        damage.push(unreadable(detail));
        return Ok(None);
    };
    let n_checked = length + FOOTER_RECORD - 4;
    let bytes = source.read(start, usize::try_from(n_checked).map_err(io::Error::other)?)?;
    let crc = if tail.footer.summary_crc == 0 { 0 } else { crc32fast::hash(&bytes) };
    if crc != tail.footer.summary_crc {
        let detail = format!(
            "expected {:#010x}, got {crc:#010x}; the summary is not used, the file is scanned",
            tail.footer.summary_crc
        );
        damage.push(Damage::new(DamageKind::SummaryCrcMismatch, start, detail));
        return Ok(None);
    }
    if length == 0 {
        return Ok(None);
    }
    let mut records = Records::new(&bytes[..bytes.len() - (FOOTER_RECORD as usize - 4)]);
    let summary = parse_summary(&mut records, start);
    if !records.rest().is_empty() || summary.is_none() {
        let detail = format!(
            "its record at offset {} does not fit; the file is scanned",
            start + records.position() as u64
        );
        damage.push(unreadable(detail));
        return Ok(None);
    }
    Ok(summary)
}

fn parse_summary(records: &mut Records<'_>, start: u64) -> Option<Summary> {
    let mut summary = Summary { start, ..Summary::default() };
    let mut schemas = BTreeMap::new();
    let mut channels = BTreeMap::new();
    for record in records {
        match record.op {
            op::SCHEMA => {
                let schema = SchemaRecord::parse(record.body)?;
                summary.is_ambiguous |=
                    schemas.insert(schema.id, record.body).is_some_and(|other| other != record.body);
                summary.definitions.push(Definition::schema(&schema));
            }
            op::CHANNEL => {
                let channel = ChannelRecord::parse(record.body)?;
                summary.is_ambiguous |=
                    channels.insert(channel.id, record.body).is_some_and(|other| other != record.body);
                summary.definitions.push(Definition::Channel(channel));
            }
            op::CHUNK_INDEX => summary.chunks.push(ChunkIndex::parse(record.body)?),
            op::ATTACHMENT_INDEX => summary.attachments.push(AttachmentIndex::parse(record.body)?),
            op::METADATA_INDEX => summary.metadata.push(MetadataIndex::parse(record.body)?),
            op::STATISTICS => summary.statistics = Some(Statistics::parse(record.body)?),
            // Chunks and messages do not belong here: this is no summary.
            op::MESSAGE | op::CHUNK | op::DATA_END | op::HEADER => return None,
            _ => {}
        }
    }
    Some(summary)
}

impl Summary {
    /// Ids of the channels that the summary defines.
    pub(crate) fn channel_ids(&self) -> BTreeSet<u16> {
        let id = |definition: &Definition| match definition {
            Definition::Channel(record) => Some(record.id),
            Definition::Schema(_) => None,
        };
        self.definitions.iter().filter_map(id).collect()
    }

    /// Whether the summary defines as many channels as the writer counted.
    pub(crate) fn has_all_channels(&self) -> bool {
        let n_defined = self.channel_ids().len() as u64;
        n_defined > 0
            && self
                .statistics
                .as_ref()
                .is_some_and(|statistics| u64::from(statistics.channel_count) == n_defined)
    }
}

/// An indexed record that was found where the index says.
#[derive(Debug)]
pub(crate) enum Indexed {
    Chunk(BlockRef),
    Attachment(AttachmentInfo),
    Metadata(MetadataRecord),
}

/// Where an indexed record lies, message indexes after a chunk included.
#[derive(Debug)]
pub(crate) struct Covered {
    pub(crate) from: u64,
    pub(crate) to: u64,
    pub(crate) item: Indexed,
}

/// Looks up every index entry in the file; returns those that hold, in file order and without overlap.
pub(crate) fn verify_index(
    window: &mut Window<'_>,
    summary: &Summary,
    limits: Limits,
    damage: &mut Vec<Damage>,
) -> io::Result<Vec<Covered>> {
    let mut covered = Vec::with_capacity(summary.chunks.len());
    let to = summary.start;
    for entry in &summary.chunks {
        match verify_chunk(window, entry, to, damage)? {
            Some(found) => covered.push(found),
            None => damage.push(mismatch("chunk", entry.chunk_start_offset)),
        }
    }
    for (what, offset, length) in summary
        .attachments
        .iter()
        .map(|entry| ("attachment", entry.offset, entry.length))
        .chain(summary.metadata.iter().map(|entry| ("metadata", entry.offset, entry.length)))
    {
        let end = offset.checked_add(length).filter(|&end| end <= to && length > RECORD_PREFIX);
        let step = end.map(|end| classify(window, offset, end, limits)).transpose()?.and_then(Result::ok);
        let item = step.filter(|step| Some(step.next) == end).and_then(|step| match step.item {
            Item::Attachment(header) => {
                Some(Indexed::Attachment(AttachmentInfo::new(&header, offset, length)))
            }
            Item::Metadata(metadata) => Some(Indexed::Metadata(MetadataRecord::new(metadata, offset))),
            _ => None,
        });
        match item {
            Some(item) => covered.push(Covered { from: offset, to: offset + length, item }),
            None => damage.push(mismatch(what, offset)),
        }
    }
    Ok(without_overlap(covered, damage))
}

fn mismatch(what: &str, offset: u64) -> Damage {
    let detail =
        format!("the index names a {what} here, which is not what lies here; the index entry is not used");
    Damage::new(DamageKind::IndexMismatch, offset, detail)
}

fn verify_chunk(
    window: &mut Window<'_>,
    entry: &ChunkIndex,
    to: u64,
    damage: &mut Vec<Damage>,
) -> io::Result<Option<Covered>> {
    let from = entry.chunk_start_offset;
    let end =
        from.checked_add(entry.chunk_length).filter(|&end| end <= to && entry.chunk_length > RECORD_PREFIX);
    let Some(end) = end else { return Ok(None) };
    let prefix = record_prefix(window.peek(from, RECORD_PREFIX)?);
    let whole_length = entry.chunk_length - RECORD_PREFIX;
    let header = match chunk_header(window, from, end)? {
        Some((header, inner)) if inner <= whole_length && describes(entry, &header) => Some(header),
        _ => None,
    };
    let is_framed = prefix == Some((op::CHUNK, whole_length));
    let mut block = match header {
        Some(header) => chunk_block(&header, from, entry.chunk_length),
        // An unknown compression, or a damaged header within good framing: reading the chunk will say which.
        None if is_framed => BlockRef { uncompressed_bytes: entry.uncompressed_size, ..indexed_block(entry) },
        None => return Ok(None),
    };
    if !is_framed {
        let (opcode, length) = prefix.unwrap_or_default();
        let detail = format!(
            "the chunk's record has opcode {opcode:#04x} and states {length} bytes, expected 0x06 and {whole_length} \
            by the index, with which its header agrees; the index is believed"
        );
        damage.push(Damage::new(DamageKind::RecordLengthImplausible, from, detail));
    }
    let ids: Vec<u16> = entry.message_index_offsets.keys().copied().collect();
    block.channel_ids = (!ids.is_empty()).then(|| ids.into());
    let to = end.saturating_add(entry.message_index_length).min(to);
    Ok(Some(Covered { from, to, item: Indexed::Chunk(block) }))
}

fn indexed_block(entry: &ChunkIndex) -> BlockRef {
    let header = super::wire::ChunkHeader {
        start_time: entry.start_time,
        end_time: entry.end_time,
        uncompressed_size: entry.uncompressed_size,
        uncompressed_crc: 0,
        compression: entry.compression.clone(),
        compressed_size: entry.compressed_size,
    };
    chunk_block(&header, entry.chunk_start_offset, entry.chunk_length)
}

fn describes(entry: &ChunkIndex, header: &super::wire::ChunkHeader) -> bool {
    entry.compression == header.compression
        && entry.compressed_size == header.compressed_size
        && entry.uncompressed_size == header.uncompressed_size
}

/// Sorts by offset; drops entries that overlap an earlier one, and cuts message indexes that do.
fn without_overlap(mut covered: Vec<Covered>, damage: &mut Vec<Damage>) -> Vec<Covered> {
    covered.sort_by_key(|entry| (entry.from, entry.to));
    let mut kept: Vec<Covered> = Vec::with_capacity(covered.len());
    for entry in covered {
        if let Some(last) = kept.last_mut() {
            let own_end = match &last.item {
                Indexed::Chunk(block) => block.offset + block.length,
                _ => last.to,
            };
            if entry.from < own_end {
                damage.push(mismatch("second record", entry.from));
                continue;
            }
            last.to = last.to.min(entry.from);
        }
        kept.push(entry);
    }
    kept
}
