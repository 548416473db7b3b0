//! The order in which blocks are read: by time where that is safe, by place where a clock was reset.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::block::{BlockKind, BlockPart, BlockRef, ChannelSpan, Limits, read_block};
use super::channel::ChannelTable;
use super::source::Source;
use super::wire::{MessageIndex, Parse, RECORD_PREFIX, op, record_prefix};

/// A chunk that starts at 0 and spans more than this holds a message with log time 0, which says nothing of its place.
const LOG_TIME_ZERO_SPAN_NS: u64 = 365 * 24 * 3600 * 1_000_000_000;

/// Sorts blocks, which come in file order, into reading order.
///
/// Where start times only grow, or run back by no more than `window_ns`, sorting by start time is all there is to do.
/// Where they run back by more, the log is either a channel's clock that was reset (its own times run back: the file order is
/// kept across that place) or topics written one after the other (no channel's own times do: sorted).
pub(crate) fn reading_order(
    source: &Source,
    table: &ChannelTable,
    limits: Limits,
    window_ns: u64,
    blocks: &mut Vec<BlockRef>,
) {
    for block in blocks.iter_mut().filter(|block| needs_real_start(block)) {
        let spans = channel_spans(source, table, limits, block);
        block.start_ns = spans.iter().map(|span| span.first_ns).min();
        block.end_ns = spans.iter().map(|span| span.last_ns).max();
        block.spans = Some(spans);
    }
    // The ends and not the starts are compared, so that a chunk inside which the clock was reset is noticed.
    if runs_back(blocks, window_ns) {
        find_segments(source, table, limits, window_ns, blocks);
        split_straddling(window_ns, blocks);
    }
    // A block without messages has no time; it goes with the block before it.
    let mut time = 0;
    let mut keyed: Vec<((u32, u64, u64), BlockRef)> = Vec::with_capacity(blocks.len());
    for block in blocks.iter() {
        time = block.start_ns.unwrap_or(time);
        keyed.push(((block.clock_segment, time, block.offset), block.clone()));
    }
    keyed.sort_by_key(|(key, _)| *key);
    for (slot, (_, block)) in blocks.iter_mut().zip(keyed) {
        *slot = block;
    }
}

fn needs_real_start(block: &BlockRef) -> bool {
    block.spans.is_none()
        && block.start_ns == Some(0)
        && block.end_ns.is_some_and(|end| end > LOG_TIME_ZERO_SPAN_NS)
}

/// Returns whether a block starts before the end of an earlier one by more than the window.
fn runs_back(blocks: &[BlockRef], window_ns: u64) -> bool {
    let mut latest_end = 0;
    blocks.iter().any(|block| {
        let is_back = block.start_ns.is_some_and(|start| start.saturating_add(window_ns) < latest_end);
        latest_end = latest_end.max(block.end_ns.unwrap_or(0));
        is_back
    })
}

/// Numbers the clock segments of the blocks.
fn find_segments(
    source: &Source,
    table: &ChannelTable,
    limits: Limits,
    window_ns: u64,
    blocks: &mut [BlockRef],
) {
    let mut segment = 0;
    let mut latest: BTreeMap<u16, u64> = BTreeMap::new();
    for block in blocks {
        let spans = channel_spans(source, table, limits, block);
        let runs_back = |from: u64, to: u64| to.saturating_add(window_ns) < from;
        let has_reset =
            |span: &ChannelSpan| latest.get(&span.id).is_some_and(|&last| runs_back(last, span.first_ns));
        if spans.iter().any(has_reset) {
            segment += 1;
            latest.clear();
        }
        for span in spans.iter() {
            // A clock that was reset inside the block goes on from the block's final time.
            let reached = if runs_back(span.last_ns, span.final_ns) { span.final_ns } else { span.last_ns };
            let last = latest.entry(span.id).or_default();
            *last = if reached == span.last_ns { reached.max(*last) } else { reached };
        }
        block.clock_segment = segment;
        block.spans = Some(spans);
    }
}

/// Splits blocks in which one topic's messages end and another's begin at a much earlier time.
///
/// Such a block lies in a log whose topics were written one after the other; read as one, it would be out of order wherever it is put.
fn split_straddling(window_ns: u64, blocks: &mut Vec<BlockRef>) {
    let mut split = Vec::new();
    let mut latest_end = 0;
    let mut segment = 0;
    for block in blocks.iter_mut() {
        if block.clock_segment != segment {
            (segment, latest_end) = (block.clock_segment, 0);
        }
        let runs_back = block.start_ns.is_some_and(|start| start.saturating_add(window_ns) < latest_end);
        latest_end = latest_end.max(block.end_ns.unwrap_or(0));
        if runs_back {
            split.extend(split_off_later(window_ns, block));
        }
    }
    blocks.append(&mut split);
}

/// Takes the channels out of a block that begin later than the others by more than the window; returns them as blocks.
fn split_off_later(window_ns: u64, block: &mut BlockRef) -> Vec<BlockRef> {
    let mut spans = block.spans.as_deref().unwrap_or_default().to_vec();
    spans.sort_by_key(|span| (span.first_ns, span.id));
    let is_border = |a: &ChannelSpan, b: &ChannelSpan| b.first_ns.saturating_sub(a.first_ns) <= window_ns;
    let mut groups = spans.chunk_by(is_border);
    let first = groups.next().unwrap_or_default().to_vec();
    let part = |group: &[ChannelSpan], part: BlockPart, whole: &BlockRef| BlockRef {
        start_ns: group.iter().map(|span| span.first_ns).min(),
        end_ns: group.iter().map(|span| span.last_ns).max(),
        channel_ids: Some(group.iter().map(|span| span.id).collect()),
        spans: Some(group.into()),
        part,
        ..whole.clone()
    };
    let ids = |group: &[ChannelSpan]| group.iter().map(|span| span.id).collect::<Arc<[u16]>>();
    let later: Vec<BlockRef> = groups.map(|group| part(group, BlockPart::Only(ids(group)), block)).collect();
    if !later.is_empty() {
        let taken: Arc<[u16]> = later
            .iter()
            .flat_map(|block| block.channel_ids.iter().flat_map(|ids| ids.iter().copied()))
            .collect();
        *block = part(&first, BlockPart::Without(taken), block);
    }
    later
}

/// Returns the log times of each channel in a block: from message indexes if they follow the chunk, else by reading it.
fn channel_spans(
    source: &Source,
    table: &ChannelTable,
    limits: Limits,
    block: &BlockRef,
) -> Arc<[ChannelSpan]> {
    if let Some(spans) = &block.spans {
        return Arc::clone(spans);
    }
    if block.kind == BlockKind::Chunk
        && let Some(ids) = &block.channel_ids
        && let Some(spans) = spans_by_index(source, limits, block)
        && ids.iter().all(|id| spans.iter().any(|span| span.id == *id))
    {
        return spans;
    }
    let read = read_block(source, table, block, limits);
    let mut spans: BTreeMap<u16, ChannelSpan> = BTreeMap::new();
    for message in read.messages.iter().filter(|message| message.log_time_ns != 0) {
        let id = read.channel(message).id;
        spans.entry(id).or_insert(ChannelSpan::at(id, message.log_time_ns)).extend(message.log_time_ns);
    }
    spans.into_values().collect()
}

/// Reads the message indexes that follow a chunk; `None` when they are damaged.
fn spans_by_index(source: &Source, limits: Limits, block: &BlockRef) -> Option<Arc<[ChannelSpan]>> {
    let mut at = block.offset.checked_add(block.length)?;
    let mut spans = Vec::new();
    while at.checked_add(RECORD_PREFIX)? <= source.len() {
        let prefix = source.read(at, RECORD_PREFIX as usize).ok()?;
        let (opcode, length) = record_prefix(&prefix)?;
        if opcode != op::MESSAGE_INDEX {
            break;
        }
        let end = at.checked_add(RECORD_PREFIX)?.checked_add(length)?;
        if length > limits.record_bytes || end > source.len() {
            return None;
        }
        let body = source.read(at + RECORD_PREFIX, usize::try_from(length).ok()?).ok()?;
        let index = MessageIndex::parse(&body)?;
        let mut by_place = index.entries;
        by_place.retain(|(time, _)| *time != 0);
        by_place.sort_by_key(|(_, place)| *place);
        if let Some((first, _)) = by_place.first() {
            let mut span = ChannelSpan::at(index.channel_id, *first);
            by_place.iter().for_each(|(time, _)| span.extend(*time));
            spans.push(span);
        }
        at = end;
    }
    (!spans.is_empty()).then(|| spans.into())
}
