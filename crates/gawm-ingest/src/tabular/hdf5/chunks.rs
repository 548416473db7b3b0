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

/// The chunks of one dataset, by their place in the grid of chunks, row-major.
#[derive(Debug)]
pub(crate) struct ChunkIndex {
    /// The chunks that are stored, in order; a damaged extent cannot make this large.
    chunks: Vec<(u64, Chunk)>,
    /// Chunks along every axis.
    pub(crate) counts: Vec<u64>,
    /// Chunks of the whole grid.
    total: u64,
}

impl ChunkIndex {
    /// Reads the index of a dataset.
    pub(crate) fn read(
        file: &Hdf5File,
        address: u64,
        indexing: Option<&ChunkIndexing>,
        grid: &Grid<'_>,
    ) -> Result<Self> {
        let count = |(&n, &c): (&u64, &u32)| n.div_ceil(u64::from(c.max(1)));
        let counts: Vec<u64> = grid.shape.iter().zip(grid.chunk_shape).map(count).collect();
        let total = counts.iter().try_fold(1u64, |n, &c| n.checked_mul(c)).filter(|&n| n <= grid.max_chunks);
        let Some(total) = total else {
            return Err(Error::ResourceLimit(format!(
                "grid of {counts:?} chunks, limit {}",
                grid.max_chunks
            )));
        };
        let mut index = Self { chunks: Vec::new(), counts, total };
        if total == 0 || Cursor::is_undefined_offset(address, file.superblock().offset_size) {
            return Ok(index);
        }
        for entry in entries(file, address, indexing, grid)? {
            if let Some(place) = index.place(&entry, grid)? {
                let chunk =
                    Chunk { address: entry.address, bytes: entry.size, filter_mask: entry.filter_mask };
                index.chunks.push((place, chunk));
            }
        }
        index.chunks.sort_unstable_by_key(|(place, chunk)| (*place, chunk.address));
        if let Some(twice) = index.chunks.windows(2).find(|w| w[0].0 == w[1].0) {
            let (a, b) = (twice[0].1.address, twice[1].1.address);
            return Err(Error::InvalidData(format!(
                "two chunks at place {}: at {a:#x} and at {b:#x}",
                twice[0].0
            )));
        }
        Ok(index)
    }

    /// Returns where a chunk belongs; nowhere when it lies beyond the end of a dataset that was shrunk.
    fn place(&self, entry: &ChunkEntry, grid: &Grid<'_>) -> Result<Option<u64>> {
        let at = &entry.offsets;
        let is_off_grid = at.iter().zip(grid.chunk_shape).any(|(&o, &c)| o % u64::from(c.max(1)) != 0);
        if at.len() != grid.shape.len() || is_off_grid {
            return Err(Error::InvalidData(format!(
                "chunk at {at:?} is off the grid of {:?}",
                grid.chunk_shape
            )));
        }
        if at.iter().zip(grid.shape).any(|(o, n)| o >= n) {
            return Ok(None);
        }
        // Cannot overflow: every factor is below its count, and the counts' product was checked.
        let places = at.iter().zip(grid.chunk_shape).map(|(&o, &c)| o / u64::from(c.max(1)));
        Ok(Some(places.zip(&self.counts).fold(0, |n, (place, &count)| n * count + place)))
    }

    /// Returns the chunk at a place of the grid, row-major; `None` outside of the grid.
    pub(crate) fn get(&self, place: u64) -> Option<Chunk> {
        let found = self.chunks.binary_search_by_key(&place, |(p, _)| *p);
        (place < self.total).then(|| found.map_or(Chunk::ABSENT, |at| self.chunks[at].1))
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
