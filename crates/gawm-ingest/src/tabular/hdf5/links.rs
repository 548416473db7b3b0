//! The names in a group, listed without opening what they point to.
//!
//! The library's own listing opens every child, so that one broken object header hides the whole group.

use std::collections::BTreeMap;

use hdf5_reader::Hdf5File;
use hdf5_reader::btree_v1;
use hdf5_reader::btree_v2::{self, BTreeV2Record};
use hdf5_reader::error::Result;
use hdf5_reader::fractal_heap::{FractalHeap, FractalHeapDirectBlockCache};
use hdf5_reader::io::Cursor;
use hdf5_reader::local_heap::LocalHeap;
use hdf5_reader::messages::HdfMessage;
use hdf5_reader::messages::link::{self, LinkTarget};
use hdf5_reader::messages::link_info::LinkInfoMessage;
use hdf5_reader::messages::symbol_table_msg::SymbolTableMessage;
use hdf5_reader::symbol_table::SymbolTableNode;

/// Where a name in a group leads.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Link {
    /// An object header of this file.
    Hard(u64),
    /// A path in this file.
    Soft(String),
    /// A path in another file.
    External { file: String, path: String },
}

/// Lists the links of the group whose object header is at `address`, sorted by name.
pub(crate) fn list(file: &Hdf5File, address: u64) -> Result<BTreeMap<String, Link>> {
    let header = file.get_or_parse_header(address)?;
    let mut links = BTreeMap::new();
    for message in &header.messages {
        match message {
            HdfMessage::Link(link) => {
                links.insert(link.name.clone(), target(&link.target));
            }
            HdfMessage::LinkInfo(info) => dense(file, info, &mut links)?,
            HdfMessage::SymbolTable(table) => old_style(file, table, &mut links)?,
            _ => {}
        }
    }
    Ok(links)
}

fn target(target: &LinkTarget) -> Link {
    match target {
        LinkTarget::Hard { address } => Link::Hard(*address),
        LinkTarget::Soft { path } => Link::Soft(path.clone()),
        LinkTarget::External { filename, path } => {
            Link::External { file: filename.clone(), path: path.clone() }
        }
    }
}

/// Links of a large group: messages in a fractal heap, found by a B-tree over their names.
fn dense(file: &Hdf5File, info: &LinkInfoMessage, links: &mut BTreeMap<String, Link>) -> Result<()> {
    let (storage, offset_size, length_size) = parts(file);
    if Cursor::is_undefined_offset(info.fractal_heap_address, offset_size) {
        return Ok(());
    }
    let heap = FractalHeap::parse_at_storage(storage, info.fractal_heap_address, offset_size, length_size)?;
    let tree = btree_v2::BTreeV2Header::parse_at_storage(
        storage,
        info.btree_name_index_address,
        offset_size,
        length_size,
    )?;
    let records = btree_v2::collect_btree_v2_records_storage(
        storage,
        &tree,
        offset_size,
        length_size,
        None,
        &[],
        None,
    )?;
    let mut blocks = FractalHeapDirectBlockCache::default();
    for record in &records {
        let BTreeV2Record::LinkNameHash { heap_id, .. } = record else { continue };
        let bytes =
            heap.get_object_storage_cached(heap_id, storage, offset_size, length_size, &mut blocks)?;
        let message = link::parse(&mut Cursor::new(&bytes), offset_size, length_size, bytes.len())?;
        links.insert(message.name.clone(), target(&message.target));
    }
    Ok(())
}

/// Links of a group of the first file format: symbol table nodes under a B-tree, names in a local heap.
fn old_style(file: &Hdf5File, table: &SymbolTableMessage, links: &mut BTreeMap<String, Link>) -> Result<()> {
    let (storage, offset_size, length_size) = parts(file);
    let heap = LocalHeap::parse_at_storage(storage, table.heap_address, offset_size, length_size)?;
    let leaves = btree_v1::collect_btree_v1_leaves_storage(
        storage,
        table.btree_address,
        offset_size,
        length_size,
        None,
        &[],
        None,
    )?;
    let entry_bytes = 2 * usize::from(offset_size) + 24;
    for (_, node_address) in &leaves {
        let head = storage.read_range(*node_address, 8)?;
        let n_symbols = usize::from(u16::from_le_bytes([head[6], head[7]]));
        let bytes = storage.read_range(*node_address, 8 + n_symbols * entry_bytes)?;
        let node = SymbolTableNode::parse(&mut Cursor::new(&bytes), offset_size, length_size)?;
        for entry in &node.entries {
            let name = heap.get_string_storage(entry.link_name_offset, storage)?;
            let s = entry.scratch;
            let link = if entry.cache_type == 2 {
                let offset = u32::from_le_bytes([s[0], s[1], s[2], s[3]]);
                Link::Soft(heap.get_string_storage(u64::from(offset), storage)?)
            } else {
                Link::Hard(entry.object_header_address)
            };
            links.insert(name, link);
        }
    }
    Ok(())
}

fn parts(file: &Hdf5File) -> (&dyn hdf5_reader::Storage, u8, u8) {
    let superblock = file.superblock();
    (file.storage(), superblock.offset_size, superblock.length_size)
}
