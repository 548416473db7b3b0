//! Collects the channels of a log before its blocks are read, from as few chunks as will do.

use std::collections::BTreeSet;

use rayon::prelude::*;

use super::block::{BlockKind, BlockRef, Limits, check_chunk, unpack_chunk};
use super::channel::{ChannelTable, Definition};
use super::damage::{Damage, DamageKind};
use super::source::Source;
use super::summary::Summary;
use super::wire::{ChannelRecord, Parse, Records, SchemaRecord, op};

/// The definitions in one chunk.
struct ChunkDefinitions {
    offset: u64,
    definitions: Vec<Definition>,
    /// Whether the chunk's data passed its checks.
    is_sound: bool,
}

/// Builds the table of channels from what lies outside chunks, from chunks where needed, and from the summary.
pub(crate) fn collect(
    source: &Source,
    limits: Limits,
    blocks: &[BlockRef],
    loose: Vec<(u64, Definition)>,
    summary: Option<&Summary>,
    after_data: Vec<Definition>,
    damage: &mut Vec<Damage>,
) -> ChannelTable {
    let summary_definitions = summary.map_or(&[][..], |summary| &summary.definitions);
    let mut known: BTreeSet<u16> = loose
        .iter()
        .map(|(_, d)| d)
        .chain(&after_data)
        .chain(summary_definitions)
        .filter_map(channel_id)
        .collect();
    let chunks = read_needed(source, limits, blocks, summary, &mut known);
    let mut in_order = loose;
    let mut doubtful = Vec::new();
    for chunk in chunks {
        // What a chunk defines is in force after it for others; inside it, reading it tells from where on.
        let found = chunk.definitions.into_iter().map(|definition| (chunk.offset + 1, definition));
        if chunk.is_sound { in_order.extend(found) } else { doubtful.extend(found) }
    }
    in_order.sort_by_key(|(offset, _)| *offset);
    let mut table = ChannelTable::default();
    for (offset, definition) in in_order {
        table.define(offset, definition, damage);
    }
    for definition in summary_definitions.iter().cloned().chain(after_data) {
        table.define_if_new(definition);
    }
    for (offset, definition) in doubtful {
        let id = channel_id(&definition);
        if table.define_if_new(definition)
            && let Some(id) = id
        {
            let detail = format!(
                "channel {id} is known only from this damaged chunk; its messages elsewhere are kept"
            );
            damage.push(Damage::new(DamageKind::DefinitionFromDamagedChunk, offset - 1, detail));
        }
    }
    table.bind(damage);
    table
}

fn channel_id(definition: &Definition) -> Option<u16> {
    match definition {
        Definition::Channel(record) => Some(record.id),
        Definition::Schema(_) => None,
    }
}

/// Reads the chunks without which the channels would not be known.
fn read_needed(
    source: &Source,
    limits: Limits,
    blocks: &[BlockRef],
    summary: Option<&Summary>,
    known: &mut BTreeSet<u16>,
) -> Vec<ChunkDefinitions> {
    let is_ambiguous = summary.is_some_and(|summary| summary.is_ambiguous);
    let is_complete = summary.is_some_and(Summary::has_all_channels);
    let chunks = || blocks.iter().filter(|block| block.kind == BlockKind::Chunk);
    let is_needed =
        |block: &&BlockRef| is_ambiguous || (block.channel_ids.is_none() && !is_complete && !is_empty(block));
    let unlisted: Vec<&BlockRef> = chunks().filter(is_needed).collect();
    let mut read: Vec<ChunkDefinitions> =
        unlisted.par_iter().map(|block| definitions_in(source, limits, block)).collect();
    known.extend(read.iter().flat_map(|chunk| &chunk.definitions).filter_map(channel_id));
    if is_ambiguous {
        return read;
    }
    for block in chunks() {
        let is_missing = |ids: &[u16]| ids.iter().any(|id| !known.contains(id));
        if block.channel_ids.as_deref().is_some_and(is_missing) {
            let chunk = definitions_in(source, limits, block);
            known.extend(chunk.definitions.iter().filter_map(channel_id));
            read.push(chunk);
        }
    }
    read
}

fn is_empty(block: &BlockRef) -> bool {
    block.uncompressed_bytes == 0
}

fn definitions_in(source: &Source, limits: Limits, block: &BlockRef) -> ChunkDefinitions {
    let mut damage = Vec::new();
    let mut definitions = Vec::new();
    let mut is_sound = false;
    if let Ok(chunk) = unpack_chunk(source, block, limits, &mut damage) {
        is_sound = check_chunk(&chunk, block.offset, &mut damage).is_ok();
        for record in Records::new(&chunk.data) {
            let definition = match record.op {
                op::SCHEMA => SchemaRecord::parse(record.body).map(|schema| Definition::schema(&schema)),
                op::CHANNEL => ChannelRecord::parse(record.body).map(Definition::Channel),
                _ => None,
            };
            definitions.extend(definition);
        }
    }
    ChunkDefinitions { offset: block.offset, definitions, is_sound }
}
