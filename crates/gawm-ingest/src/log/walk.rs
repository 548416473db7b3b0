//! Walks over the records of a file region without reading chunk data, and goes on after damage.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::sync::Arc;

use super::block::{BlockKind, BlockPart, BlockRef, ChannelSpan, Limits};
use super::channel::Definition;
use super::damage::{Damage, DamageKind};
use super::source::{Source, Window};
use super::step::{CHUNK_PADDING_MAX, Item, Misfit, Step, classify};
use super::wire::{ChunkHeader, Header, MessageHeader, RECORD_PREFIX, Statistics, op};
use super::{AttachmentInfo, MetadataRecord};

/// A run of records outside chunks is one block up to this size.
const LOOSE_BLOCK_BYTES: u64 = 4 << 20;

/// What a walk found.
#[derive(Debug, Default)]
pub(crate) struct Found {
    pub(crate) header: Option<Header>,
    pub(crate) blocks: Vec<BlockRef>,
    /// Definitions outside chunks, in the data section.
    pub(crate) definitions: Vec<(u64, Definition)>,
    /// Definitions after the end of the data section.
    pub(crate) summary_definitions: Vec<Definition>,
    pub(crate) attachments: Vec<AttachmentInfo>,
    pub(crate) metadata: Vec<MetadataRecord>,
    pub(crate) statistics: Option<Statistics>,
    /// Offset of the end of the data section and the CRC stated there.
    pub(crate) data_end: Option<(u64, u32)>,
    /// Offset after the footer record.
    pub(crate) footer_end: Option<u64>,
    pub(crate) damage: Vec<Damage>,
}

/// The run of loose records in work.
#[derive(Debug)]
struct LooseRun {
    start: u64,
    end: u64,
    spans: BTreeMap<u16, Option<ChannelSpan>>,
}

/// A walk over regions of one file.
#[derive(Debug)]
pub(crate) struct Walk<'a> {
    pub(super) window: Window<'a>,
    pub(super) limits: Limits,
    file_length: u64,
    /// Channel ids that are defined, as far as is known.
    pub(super) known_ids: BTreeSet<u16>,
    loose: Option<LooseRun>,
    /// Whether the last block is a chunk whose message indexes may follow.
    after_chunk: bool,
    pub(crate) found: Found,
}

impl<'a> Walk<'a> {
    pub(crate) fn new(source: &'a Source, limits: Limits) -> Self {
        Self {
            window: Window::new(source),
            limits,
            file_length: source.len(),
            known_ids: BTreeSet::new(),
            loose: None,
            after_chunk: false,
            found: Found::default(),
        }
    }

    /// Walks over the records in `from..to`; records do not run past `to`.
    pub(crate) fn region(&mut self, from: u64, to: u64) {
        if let Err((offset, error)) = self.try_region(from, to) {
            let detail = format!("{error}; {} bytes from there on are not read", to - offset);
            self.found.damage.push(Damage::new(DamageKind::ReadFailed, offset, detail));
        }
        self.close_loose();
        self.after_chunk = false;
    }

    fn try_region(&mut self, from: u64, to: u64) -> Result<(), (u64, io::Error)> {
        let mut at = from;
        let mut weak = None;
        while at < to && self.found.footer_end.is_none() {
            let failed = |error| (at, error);
            let step = classify(&mut self.window, at, to, self.limits).map_err(failed)?;
            let trusted = match step {
                Ok(step) if step.is_private() => {
                    self.has_record_at(step.next, to).map_err(failed)?.then_some(step)
                }
                Ok(step) => Some(step),
                Err(misfit) => match self.mend(&misfit, to).map_err(failed)? {
                    Mended::Step(step) => Some(step),
                    Mended::Cut => return Ok(()),
                    Mended::No => None,
                },
            };
            match trusted {
                Some(step) => {
                    weak = step.is_weak().then_some(at);
                    at = step.next;
                    self.take(step);
                }
                None => match self.recover(at, weak.take(), to).map_err(failed)? {
                    Some(next) => at = next,
                    None => return Ok(()),
                },
            }
        }
        Ok(())
    }

    /// Returns whether a record starts at `at`, or the region ends there.
    fn has_record_at(&mut self, at: u64, to: u64) -> io::Result<bool> {
        Ok(at == to || classify(&mut self.window, at, to, self.limits)?.is_ok())
    }

    /// Tries to make sense of a chunk record whose length is damaged or that the file's end cuts.
    fn mend(&mut self, misfit: &Misfit, to: u64) -> io::Result<Mended> {
        let Some((header, inner_length)) = &misfit.chunk else { return Ok(Mended::No) };
        let inner_next = misfit.at.checked_add(RECORD_PREFIX).and_then(|at| at.checked_add(*inner_length));
        if let Some(next) = inner_next.filter(|&next| next <= to) {
            if self.has_record_at(next, to)? {
                let detail = format!(
                    "the chunk's record states {} bytes, its header {inner_length}, and a record follows there; \
                    the header is believed",
                    misfit.length
                );
                self.found.damage.push(Damage::new(DamageKind::RecordLengthImplausible, misfit.at, detail));
                return Ok(Mended::Step(Step {
                    at: misfit.at,
                    next,
                    op: op::CHUNK,
                    item: Item::Chunk(header.clone()),
                }));
            }
            return Ok(Mended::No);
        }
        let is_stated_so =
            misfit.length.checked_sub(*inner_length).is_some_and(|padding| padding <= CHUNK_PADDING_MAX);
        if to < self.file_length || !is_stated_so {
            return Ok(Mended::No);
        }
        self.truncated(misfit.at, to, "a chunk");
        let mut block = chunk_block(header, misfit.at, to - misfit.at);
        block.is_cut = true;
        self.close_loose();
        self.found.blocks.push(block);
        Ok(Mended::Cut)
    }

    fn truncated(&mut self, at: u64, to: u64, what: &str) {
        let detail = format!("the file ends {} bytes into {what}", to - at);
        self.found.damage.push(Damage::new(DamageKind::Truncated, at, detail));
    }

    /// Searches for the next record after damage at `at`; `weak` is the start of a record before it that may be to blame.
    fn recover(&mut self, at: u64, weak: Option<u64>, to: u64) -> io::Result<Option<u64>> {
        if let Some(start) = weak
            && let Some(next) = self.resync(start + 1, at)?
        {
            self.drop_last_message(start);
            self.skipped(start, next, "the record's length is damaged");
            return Ok(Some(next));
        }
        let next = self.resync(at + 1, to)?;
        match next {
            Some(next) => self.skipped(at, next, "no record starts here"),
            None if to == self.file_length && self.ends_in_record(at)? => self.truncated(at, to, "a record"),
            None => self.skipped(at, to, "no record starts here, nor up to the end of this region"),
        }
        Ok(next)
    }

    fn skipped(&mut self, from: u64, to: u64, why: &str) {
        self.close_loose();
        let detail = format!("{why}; {} bytes are skipped", to - from);
        self.found.damage.push(Damage::new(DamageKind::UnreadableBytes, from, detail));
    }

    /// Returns whether the bytes up to the file's end can be the start of a record.
    fn ends_in_record(&mut self, at: u64) -> io::Result<bool> {
        let start = self.window.peek(at, RECORD_PREFIX)?;
        Ok(match start {
            [opcode, ..] if start.len() < RECORD_PREFIX as usize => *opcode != 0,
            [opcode, length @ ..] => {
                let length = <[u8; 8]>::try_from(length).map_or(u64::MAX, u64::from_le_bytes);
                *opcode != 0 && length <= self.limits.record_bytes
            }
            [] => false,
        })
    }

    fn take(&mut self, step: Step) {
        let in_summary = self.found.data_end.is_some();
        let is_index = matches!(step.item, Item::MessageIndex { .. });
        self.after_chunk &= is_index;
        match step.item {
            Item::Message(header) => self.message(&header, step.at, step.next),
            Item::Chunk(header) => {
                self.close_loose();
                self.found.blocks.push(chunk_block(&header, step.at, step.next - step.at));
                self.after_chunk = true;
            }
            Item::MessageIndex { channel_id, n_entries } => {
                if let Some(block) =
                    self.found.blocks.last_mut().filter(|_| self.after_chunk && n_entries > 0)
                {
                    add_channel_id(block, channel_id);
                }
            }
            Item::Definition(definition) if in_summary => self.found.summary_definitions.push(definition),
            Item::Definition(definition) => {
                if let Definition::Channel(record) = &definition {
                    self.known_ids.insert(record.id);
                }
                self.found.definitions.push((step.at, definition));
            }
            Item::Attachment(header) => {
                self.found.attachments.push(AttachmentInfo::new(&header, step.at, step.next - step.at));
            }
            Item::Metadata(metadata) => self.found.metadata.push(MetadataRecord::new(metadata, step.at)),
            Item::DataEnd { crc } => {
                self.close_loose();
                self.found.data_end.get_or_insert((step.at, crc));
            }
            Item::Footer => self.found.footer_end = Some(step.next),
            Item::Statistics(statistics) => self.found.statistics = Some(statistics),
            Item::Header(header) if self.found.header.is_none() => self.found.header = Some(header),
            Item::Header(_) => {
                let detail = "a second header record; it is skipped";
                self.found.damage.push(Damage::new(DamageKind::UnexpectedRecord, step.at, detail));
            }
            Item::Other => {}
        }
    }

    fn message(&mut self, header: &MessageHeader, at: u64, next: u64) {
        let is_oversized = next - at > self.limits.record_bytes;
        if is_oversized || self.loose.as_ref().is_some_and(|run| next - run.start > LOOSE_BLOCK_BYTES) {
            self.close_loose();
        }
        let run = self.loose.get_or_insert_with(|| LooseRun { start: at, end: at, spans: BTreeMap::new() });
        run.end = next;
        let span = run.spans.entry(header.channel_id).or_default();
        if header.log_time != 0 {
            span.get_or_insert(ChannelSpan::at(header.channel_id, header.log_time)).extend(header.log_time);
        }
        if is_oversized {
            self.close_loose();
        }
    }

    /// Takes back the message that starts at `start`: its length is damaged.
    fn drop_last_message(&mut self, start: u64) {
        if let Some(run) = &mut self.loose {
            run.end = run.end.min(start);
        }
        self.close_loose();
        let was_alone = |block: &BlockRef| block.kind == BlockKind::Loose && block.offset == start;
        if self.found.blocks.last().is_some_and(was_alone) {
            self.found.blocks.pop();
        }
    }

    fn close_loose(&mut self) {
        let Some(run) = self.loose.take().filter(|run| run.end > run.start) else { return };
        let spans: Arc<[ChannelSpan]> = run.spans.values().filter_map(|span| *span).collect();
        self.found.blocks.push(BlockRef {
            kind: BlockKind::Loose,
            offset: run.start,
            length: run.end - run.start,
            compression: String::new(),
            uncompressed_bytes: run.end - run.start,
            start_ns: spans.iter().map(|span| span.first_ns).min(),
            end_ns: spans.iter().map(|span| span.last_ns).max(),
            channel_ids: Some(run.spans.keys().copied().collect()),
            spans: Some(spans),
            clock_segment: 0,
            is_cut: false,
            part: BlockPart::Whole,
        });
    }
}

/// What became of a record that did not fit.
enum Mended {
    Step(Step),
    Cut,
    No,
}

/// Returns the block of a chunk record.
pub(crate) fn chunk_block(header: &ChunkHeader, offset: u64, length: u64) -> BlockRef {
    let has_times = header.start_time != 0 || header.end_time != 0;
    BlockRef {
        kind: BlockKind::Chunk,
        offset,
        length,
        compression: header.compression.clone(),
        uncompressed_bytes: header.uncompressed_size,
        start_ns: has_times.then_some(header.start_time),
        end_ns: has_times.then_some(header.end_time),
        channel_ids: None,
        spans: None,
        clock_segment: 0,
        is_cut: false,
        part: BlockPart::Whole,
    }
}

fn add_channel_id(block: &mut BlockRef, id: u16) {
    let mut ids: Vec<u16> = block.channel_ids.take().map_or_else(Vec::new, |ids| ids.to_vec());
    if let Err(at) = ids.binary_search(&id) {
        ids.insert(at, id);
    }
    block.channel_ids = Some(ids.into());
}
