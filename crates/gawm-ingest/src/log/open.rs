//! Opens a log, and reads its parts.

use std::io;
use std::path::Path;

use bytes::Bytes;
use rayon::prelude::*;

use super::block::{Limits, read_block};
use super::damage::{Damage, DamageKind};
use super::error::{OpenLogError, ReadError};
use super::refusal::Foreign;
use super::source::Source;
use super::step::{Item, attachment_length, classify};
use super::summary::{Indexed, Summary, Tail, read_summary, read_tail, verify_index};
use super::walk::Walk;
use super::wire::{AttachmentHeader, Cursor, Header, MAGIC, Parse, RECORD_PREFIX, Statistics};
use super::{Block, BlockRef, Log, OpenOptions, SummaryCounts, definitions, order};

/// Bytes that are read to tell what a file is.
const IDENTIFY_BYTES: u64 = 64;
/// Piece of a file that one thread hashes at once.
const HASH_PIECE: u64 = 4 << 20;

impl Log {
    /// Opens a file: reads its summary, scans what the summary does not cover, and lists its blocks.
    ///
    /// # Errors
    /// - [`OpenLogError::Io`]: the system cannot open or read the file at all.
    /// - [`OpenLogError::NotAFile`], [`OpenLogError::Empty`], [`OpenLogError::NotMcap`]: there is nothing to read.
    ///   All other damage is in [`Log::damage`].
    pub fn open(path: &Path, options: &OpenOptions) -> Result<Self, OpenLogError> {
        Self::from_source(path, Source::open(path)?, options)
    }

    /// Opens a log that lies in memory; `path` is only a name for it.
    ///
    /// # Errors
    /// As [`Log::open`].
    pub fn from_bytes(path: &Path, bytes: Bytes, options: &OpenOptions) -> Result<Self, OpenLogError> {
        Self::from_source(path, Source::Memory(bytes), options)
    }

    fn from_source(path: &Path, source: Source, options: &OpenOptions) -> Result<Self, OpenLogError> {
        let io_error = |source| OpenLogError::Io { path: path.to_owned(), source };
        let limits = limits(options);
        let mut damage = Vec::new();
        let tail = check_magic(path, &source, limits, &mut damage)?;
        let mut walk = Walk::new(&source, limits);
        let mut summary = None;
        if let Some(tail) = &tail {
            summary = read_summary(&source, tail, limits, &mut damage).map_err(io_error)?;
        }
        match (&summary, &tail) {
            (Some(summary), _) => walk_uncovered(&mut walk, summary).map_err(io_error)?,
            (None, Some(tail)) => walk.region(MAGIC.len() as u64, tail.footer_at),
            (None, None) => walk.region(MAGIC.len() as u64, source.len()),
        }
        // A log that ends before the file does, though the file ends like one, has another behind it.
        if tail.is_none() || walk.found.footer_end.is_some() {
            check_end(&source, walk.found.footer_end, &walk.found.damage, &mut damage);
        }
        let mut found = walk.found;
        damage.append(&mut found.damage);
        found.blocks.sort_by_key(|block| block.offset);
        found.attachments.sort_by_key(|attachment| attachment.offset);
        found.metadata.sort_by_key(|metadata| metadata.offset);
        let table = definitions::collect(
            &source,
            limits,
            &found.blocks,
            found.definitions,
            summary.as_ref(),
            found.summary_definitions,
            &mut damage,
        );
        order::reading_order(&source, &table, limits, options.disorder_window_ns, &mut found.blocks);
        damage.sort_by_key(|damage| (damage.offset, damage.kind));
        let statistics = summary.as_ref().and_then(|summary| summary.statistics.clone()).or(found.statistics);
        let has_summary = summary.is_some();
        Ok(Self {
            path: path.to_owned(),
            options: options.clone(),
            header: found.header.unwrap_or(Header { profile: String::new(), library: String::new() }),
            channels: table.first_definitions(),
            table,
            attachments: found.attachments,
            metadata: found.metadata,
            damage,
            blocks: found.blocks,
            counts: statistics.map(SummaryCounts::from),
            data_section: found.data_end,
            has_summary,
            source,
        })
    }

    /// Reads one block; what was lost of it is in its damage.
    pub fn read_block(&self, block: &BlockRef) -> Block {
        read_block(&self.source, &self.table, block, limits(&self.options))
    }

    /// Reads the data of an attachment and checks its CRC.
    ///
    /// # Errors
    /// - [`ReadError::NoSuchAttachment`]: `index` is not one of [`Log::attachments`].
    /// - [`ReadError::TooLarge`]: it is larger than [`OpenOptions::max_record_bytes`].
    /// - [`ReadError::Io`]: the system cannot read it.
    /// - [`ReadError::AttachmentCrc`]: its CRC is stated and differs.
    pub fn read_attachment(&self, index: usize) -> Result<Vec<u8>, ReadError> {
        let count = self.attachments.len();
        let about = self.attachments.get(index).ok_or(ReadError::NoSuchAttachment { index, count })?;
        let (offset, limit, what) = (about.offset, self.options.max_record_bytes, "attachment");
        let length = Some(about.length)
            .filter(|&length| length <= limit)
            .and_then(|length| usize::try_from(length).ok());
        let length = length.ok_or(ReadError::TooLarge { what, size: about.length, limit })?;
        let record =
            self.source.read(offset, length).map_err(|source| ReadError::Io { what, offset, source })?;
        let changed = || ReadError::Io { what, offset, source: io::ErrorKind::InvalidData.into() };
        let body = record.get(RECORD_PREFIX as usize..).ok_or_else(changed)?;
        let header = AttachmentHeader::parse(body).ok_or_else(changed)?;
        let end = attachment_length(&header)
            .and_then(|end| usize::try_from(end).ok())
            .filter(|&end| end <= body.len());
        let (checked, crc) = end.and_then(|end| body[..end].split_at_checked(end - 4)).ok_or_else(changed)?;
        let expected = Cursor::new(crc).u32().unwrap_or(0);
        let got = if expected == 0 { 0 } else { crc32fast::hash(checked) };
        if got != expected {
            return Err(ReadError::AttachmentCrc { offset, expected, got });
        }
        let n_data = usize::try_from(about.data_size).map_or(0, |n| n.min(checked.len()));
        Ok(checked[checked.len() - n_data..].to_vec())
    }

    /// Compares the CRC of the whole data section, in parallel; `None` when it is right or not stated.
    ///
    /// # Errors
    /// The system's, when it cannot read the file.
    pub fn verify_data_section(&self) -> io::Result<Option<Damage>> {
        let Some((end, expected)) = self.data_section.filter(|(_, crc)| *crc != 0) else { return Ok(None) };
        let hasher = self
            .pieces(end)
            .into_par_iter()
            .map(|(offset, length)| {
                let mut hasher = crc32fast::Hasher::new();
                hasher.update(&self.source.read(offset, length)?);
                Ok(hasher)
            })
            .try_reduce(crc32fast::Hasher::new, |mut a, b| {
                a.combine(&b);
                io::Result::Ok(a)
            })?;
        let got = hasher.finalize();
        let detail = format!(
            "expected {expected:#010x}, got {got:#010x}; whatever no other check has dropped is kept"
        );
        Ok((got != expected).then(|| Damage::new(DamageKind::DataSectionCrcMismatch, end, detail)))
    }

    /// Returns the BLAKE3 hash of the file.
    ///
    /// # Errors
    /// The system's, when it cannot read the file.
    pub fn content_hash(&self) -> io::Result<[u8; 32]> {
        let mut hasher = blake3::Hasher::new();
        for (offset, length) in self.pieces(self.source.len()) {
            hasher.update(&self.source.read(offset, length)?);
        }
        Ok(*hasher.finalize().as_bytes())
    }

    /// Cuts the file's first `end` bytes into pieces.
    fn pieces(&self, end: u64) -> Vec<(u64, usize)> {
        let n_pieces = end.div_ceil(HASH_PIECE);
        (0..n_pieces).map(|i| (i * HASH_PIECE, HASH_PIECE.min(end - i * HASH_PIECE) as usize)).collect()
    }
}

pub(super) fn limits(options: &OpenOptions) -> Limits {
    Limits { record_bytes: options.max_record_bytes, chunk_bytes: options.max_chunk_bytes }
}

impl From<Statistics> for SummaryCounts {
    fn from(statistics: Statistics) -> Self {
        Self {
            messages: statistics.message_count,
            messages_by_channel: statistics.channel_message_counts,
            chunks: statistics.chunk_count,
            attachments: statistics.attachment_count,
            metadata: statistics.metadata_count,
            start_ns: statistics.message_start_time,
            end_ns: statistics.message_end_time,
        }
    }
}

/// Refuses what is no MCAP file; returns the footer of one that has it.
pub(super) fn check_magic(
    path: &Path,
    source: &Source,
    limits: Limits,
    damage: &mut Vec<Damage>,
) -> Result<Option<Tail>, OpenLogError> {
    let io_error = |source| OpenLogError::Io { path: path.to_owned(), source };
    if source.len() == 0 {
        return Err(OpenLogError::Empty { path: path.to_owned() });
    }
    let n_start = source.len().min(IDENTIFY_BYTES);
    let start = source.read(0, n_start as usize).map_err(io_error)?;
    let tail = read_tail(source, damage).map_err(io_error)?;
    if start.starts_with(&MAGIC) {
        return Ok(tail);
    }
    let found = Foreign::identify(&start);
    let is_unknown = matches!(found, Foreign::Unknown { .. } | Foreign::Zeros);
    let mut window = super::source::Window::new(source);
    let first = classify(&mut window, MAGIC.len() as u64, source.len(), limits).map_err(io_error)?;
    let has_header = first.is_ok_and(|step| matches!(step.item, Item::Header(_)));
    if is_unknown && has_header {
        let detail = format!(
            "expected {MAGIC:02x?}, got {:02x?}; the records after it are read",
            &start[..MAGIC.len()]
        );
        damage.push(Damage::new(DamageKind::BadStartMagic, 0, detail));
        return Ok(tail);
    }
    Err(OpenLogError::NotMcap { path: path.to_owned(), found })
}

/// Takes what the index names, and walks over everything else in the data section.
fn walk_uncovered(walk: &mut Walk<'_>, summary: &Summary) -> io::Result<()> {
    let limits = walk.limits;
    walk.known_ids = summary.channel_ids();
    let mut damage = Vec::new();
    let covered = verify_index(&mut walk.window, summary, limits, &mut damage)?;
    let mut at = MAGIC.len() as u64;
    let mut indexed = Vec::new();
    for entry in covered {
        walk.region(at, entry.from);
        at = entry.to;
        match entry.item {
            Indexed::Chunk(block) => indexed.push(block),
            Indexed::Attachment(attachment) => walk.found.attachments.push(attachment),
            Indexed::Metadata(metadata) => walk.found.metadata.push(metadata),
        }
    }
    walk.region(at, summary.start);
    if !summary.chunks.is_empty()
        && let Some(first) = walk.found.blocks.first()
    {
        let n_blocks = walk.found.blocks.len();
        let detail = format!(
            "{n_blocks} chunks or runs of messages are not in the summary's index; they were found by a scan and are read"
        );
        damage.push(Damage::new(DamageKind::IndexIncomplete, first.offset, detail));
    }
    walk.found.blocks.append(&mut indexed);
    walk.found.damage.append(&mut damage);
    Ok(())
}

/// Reports how a file ends whose footer is not in its place.
fn check_end(source: &Source, footer_end: Option<u64>, found: &[Damage], damage: &mut Vec<Damage>) {
    let length = source.len();
    match footer_end {
        Some(end) if end.saturating_add(MAGIC.len() as u64) < length => {
            let n_after = length - end - MAGIC.len() as u64;
            let detail = format!(
                "{n_after} bytes follow the end of the log; they are not read (logs that were joined into one file are to be taken apart)"
            );
            damage.push(Damage::new(DamageKind::TrailingBytes, end + MAGIC.len() as u64, detail));
        }
        Some(end) => {
            let detail = format!("the end magic is cut to {} bytes", length - end);
            damage.push(Damage::new(DamageKind::BadEndMagic, end, detail));
        }
        None if found.iter().any(|damage| damage.kind == DamageKind::Truncated) => {}
        None => {
            let detail = "the file ends without a footer: the recorder was killed, or the file was cut between two records";
            damage.push(Damage::new(DamageKind::MissingFooter, length, detail));
        }
    }
}
