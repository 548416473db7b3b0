//! Where the chunks of a dataset lie.

use hdf5_reader::chunk_index::{self, ChunkEntry};
use hdf5_reader::error::{Error, Result};
use hdf5_reader::io::Cursor;
use hdf5_reader::messages::layout::ChunkIndexing;
use hdf5_reader::{Hdf5File, btree_v1, extensible_array, fixed_array};

/// One stored chunk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Chunk {
    /// Offset in the file; `u64::MAX` where nothing was stored.
    pub(crate) address: u64,
    /// Stored bytes.
    pub(crate) bytes: u64,
    /// Filters that were skipped, by bit.
    pub(crate) filter_mask: u32,
}

impl Chunk {
    const ABSENT: Self = Self { address: u64::MAX, bytes: 0, filter_mask: 0 };

    /// Returns whether the chunk was ever stored; one that was not holds the fill value.
    pub(crate) fn is_present(&self) -> bool {
        self.address != u64::MAX
    }
}

/// What is asked of the index.
pub(crate) struct Grid<'a> {
    /// Extent of the dataset.
    pub(crate) shape: &'a [u64],
    /// Largest extent of the dataset, where it has one.
    pub(crate) max_shape: Option<&'a [u64]>,
    /// Extent of a chunk; as long as `shape`, no axis 0.
    pub(crate) chunk_shape: &'a [u32],
    /// Bytes of an element.
    pub(crate) item_bytes: usize,
    /// Chunks that an index may have.
    pub(crate) max_chunks: u64,
}

/// The chunks of one dataset, row-major over the grid of chunks.
#[derive(Debug)]
pub(crate) struct ChunkIndex {
    chunks: Vec<Chunk>,
    /// Chunks along every axis.
    pub(crate) counts: Vec<u64>,
}

impl ChunkIndex {
    /// Reads the index of a dataset.
    pub(crate) fn read(
        file: &Hdf5File,
        address: u64,
        indexing: Option<&ChunkIndexing>,
        grid: &Grid<'_>,
    ) -> Result<Self> {
        let counts: Vec<u64> =
            grid.shape.iter().zip(grid.chunk_shape).map(|(&n, &c)| n.div_ceil(u64::from(c.max(1)))).collect();
        let total = counts.iter().try_fold(1u64, |n, &c| n.checked_mul(c)).filter(|&n| n <= grid.max_chunks);
        let Some(total) = total.and_then(|n| usize::try_from(n).ok()) else {
            return Err(Error::ResourceLimit(format!(
                "grid of {counts:?} chunks, limit {}",
                grid.max_chunks
            )));
        };
        let mut index = Self { chunks: vec![Chunk::ABSENT; total], counts };
        let offset_size = file.superblock().offset_size;
        if total == 0 || Cursor::is_undefined_offset(address, offset_size) {
            return Ok(index);
        }
        for entry in entries(file, address, indexing, grid)? {
            index.insert(&entry, grid)?;
        }
        Ok(index)
    }

    fn insert(&mut self, entry: &ChunkEntry, grid: &Grid<'_>) -> Result<()> {
        let at = &entry.offsets;
        if at.len() != grid.shape.len()
            || at.iter().zip(grid.chunk_shape).any(|(&o, &c)| o % u64::from(c.max(1)) != 0)
        {
            return Err(Error::InvalidData(format!(
                "chunk at {at:?} is off the grid of {:?}",
                grid.chunk_shape
            )));
        }
        if at.iter().zip(grid.shape).any(|(o, n)| o >= n) {
            // A dataset that was shrunk keeps its old chunks beyond its end.
            return Ok(());
        }
        let place =
            at.iter().zip(grid.chunk_shape).zip(&self.counts).fold(0, |n: u64, ((&o, &c), &count)| {
                n.saturating_mul(count).saturating_add(o / u64::from(c.max(1)))
            });
        let slot = usize::try_from(place).ok().and_then(|p| self.chunks.get_mut(p));
        let Some(slot) = slot else {
            return Err(Error::InvalidData(format!("chunk at {at:?} is outside the dataset")));
        };
        if slot.is_present() {
            return Err(Error::InvalidData(format!(
                "two chunks at {at:?}: at {:#x} and at {:#x}",
                slot.address, entry.address
            )));
        }
        *slot = Chunk { address: entry.address, bytes: entry.size, filter_mask: entry.filter_mask };
        Ok(())
    }

    /// Returns the chunk at a place of the grid, row-major.
    pub(crate) fn get(&self, place: u64) -> Option<Chunk> {
        usize::try_from(place).ok().and_then(|p| self.chunks.get(p)).copied()
    }

    /// Returns how many chunks share one place along the first axis.
    pub(crate) fn per_row_group(&self) -> u64 {
        self.counts.iter().skip(1).product()
    }
}

/// Collects the index's entries with the library's walker of its kind.
fn entries(
    file: &Hdf5File,
    address: u64,
    indexing: Option<&ChunkIndexing>,
    grid: &Grid<'_>,
) -> Result<Vec<ChunkEntry>> {
    let (storage, superblock) = (file.storage(), file.superblock());
    let (offsets, lengths) = (superblock.offset_size, superblock.length_size);
    let (shape, chunk, n_dims) = (grid.shape, grid.chunk_shape, grid.shape.len() as u32);
    match indexing {
        None => {
            let leaves = btree_v1::collect_btree_v1_leaves_storage(
                storage,
                address,
                offsets,
                lengths,
                Some(n_dims),
                chunk,
                None,
            )?;
            leaves.into_iter().map(|(key, at)| btree_v1_entry(key, at, shape.len())).collect()
        }
        Some(ChunkIndexing::SingleChunk { filtered_size, filters }) => {
            Ok(vec![chunk_index::single_chunk_entry(address, *filtered_size, *filters, shape.len())])
        }
        Some(ChunkIndexing::BTreeV2) => chunk_index::collect_v2_chunk_entries_storage(
            storage, address, offsets, lengths, n_dims, chunk, None,
        ),
        Some(ChunkIndexing::Implicit) => chunk_index::collect_implicit_chunk_entries(
            address,
            shape,
            chunk,
            grid.item_bytes,
            None,
            storage.len(),
        ),
        Some(ChunkIndexing::FixedArray { .. }) => fixed_array::collect_fixed_array_chunk_entries_storage(
            storage, address, offsets, lengths, shape, chunk, None,
        ),
        Some(ChunkIndexing::ExtensibleArray { .. }) => {
            extensible_array::collect_extensible_array_chunk_entries_storage(
                storage,
                address,
                offsets,
                lengths,
                shape,
                grid.max_shape,
                chunk,
                None,
            )
        }
    }
}

fn btree_v1_entry(key: btree_v1::BTreeV1Key, address: u64, n_dims: usize) -> Result<ChunkEntry> {
    match key {
        btree_v1::BTreeV1Key::RawData { chunk_size, filter_mask, mut offsets } if offsets.len() >= n_dims => {
            offsets.truncate(n_dims);
            Ok(ChunkEntry { address, size: u64::from(chunk_size), filter_mask, offsets })
        }
        _ => Err(Error::InvalidData("expected the key of a chunk in the chunk B-tree".to_owned())),
    }
}
