//! One dataset: what its header says and how rows are read from it.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::OnceLock;

use hdf5_reader::error::{Error, Result};
use hdf5_reader::filters::FilterRegistry;
use hdf5_reader::io::Cursor;
use hdf5_reader::messages::filter_pipeline::FilterDescription;
use hdf5_reader::messages::layout::{ChunkIndexing, DataLayout};
use hdf5_reader::{Dataset, Hdf5File, Storage};

use super::blosc::{BloscError, Frame, FrameBytes};
use super::cache::ChunkCache;
use super::chunks::{Chunk, ChunkIndex, Grid};
use super::filters;
use crate::tabular::raw::RawType;

/// What reading needs of the file besides the dataset.
pub(crate) struct FileParts {
    pub(crate) file: Hdf5File,
    pub(crate) registry: FilterRegistry,
    pub(crate) cache: ChunkCache,
    pub(crate) max_chunk_bytes: u64,
    pub(crate) max_chunks: u64,
}

/// A dataset whose rows can be read.
pub(crate) struct RowSource {
    /// For resolving heap references.
    pub(crate) dataset: Dataset,
    /// Form of an element.
    pub(crate) raw: RawType,
    shape: Vec<u64>,
    layout: Layout,
    filters: Vec<FilterDescription>,
    fill: Vec<u8>,
    /// Key of this dataset in the chunk cache.
    cache_key: u64,
    index: OnceLock<std::result::Result<ChunkIndex, String>>,
}

enum Layout {
    Compact(Vec<u8>),
    /// `None` where nothing was ever written.
    Contiguous(Option<u64>),
    Chunked {
        address: u64,
        chunk_shape: Vec<u32>,
        indexing: Option<ChunkIndexing>,
    },
}

impl RowSource {
    /// Checks the parts of the header against each other.
    pub(crate) fn try_new(
        parts: &FileParts,
        dataset: Dataset,
        raw: RawType,
        layout: DataLayout,
        filters: Vec<FilterDescription>,
    ) -> Result<Self> {
        let shape = dataset.shape().to_vec();
        let total = shape.iter().try_fold(raw.item_bytes as u64, |n, &d| n.checked_mul(d));
        let total = total.ok_or_else(|| Error::InvalidData(format!("extent {shape:?} overflows")))?;
        let layout = checked_layout(parts, &shape, total, raw.item_bytes, layout)?;
        let fill = dataset.fill_value().and_then(|f| f.value.clone()).filter(|v| v.len() == raw.item_bytes);
        let fill = fill.unwrap_or_else(|| vec![0; raw.item_bytes]);
        let cache_key = dataset.address();
        Ok(Self { dataset, raw, shape, layout, filters, fill, cache_key, index: OnceLock::new() })
    }

    /// Returns the extent of a chunk, for chunked data.
    pub(crate) fn chunk_shape(&self) -> Option<Vec<u64>> {
        match &self.layout {
            Layout::Chunked { chunk_shape, .. } => Some(chunk_shape.iter().map(|&c| u64::from(c)).collect()),
            Layout::Compact(_) | Layout::Contiguous(_) => None,
        }
    }

    /// Returns the bytes of one row; 0 elements give 0.
    pub(crate) fn row_bytes(&self) -> u64 {
        self.shape.iter().skip(1).fold(self.raw.item_bytes as u64, |n, &d| n.saturating_mul(d))
    }

    /// Appends the stored bytes of `rows` to `out`; the caller has checked the range and its size.
    pub(crate) fn read_rows(&self, parts: &FileParts, rows: Range<u64>, out: &mut Vec<u8>) -> Result<()> {
        let row_bytes = self.row_bytes();
        if rows.is_empty() || row_bytes == 0 {
            return Ok(());
        }
        match &self.layout {
            Layout::Compact(data) => {
                let range = to_usize(rows.start * row_bytes)?..to_usize(rows.end * row_bytes)?;
                out.extend_from_slice(&data[range]);
                Ok(())
            }
            Layout::Contiguous(Some(address)) => {
                let at =
                    address.checked_add(rows.start * row_bytes).ok_or(Error::OffsetOutOfBounds(*address))?;
                let len = to_usize((rows.end - rows.start) * row_bytes)?;
                out.extend_from_slice(&parts.file.storage().read_range(at, len)?);
                Ok(())
            }
            Layout::Contiguous(None) => {
                self.push_fill((rows.end - rows.start) * row_bytes, out);
                Ok(())
            }
            Layout::Chunked { chunk_shape, .. } => self.read_chunked(parts, chunk_shape, rows, out),
        }
    }

    fn push_fill(&self, bytes: u64, out: &mut Vec<u8>) {
        for _ in 0..bytes / self.fill.len() as u64 {
            out.extend_from_slice(&self.fill);
        }
    }

    /// Returns the chunk index, read once.
    pub(crate) fn index(&self, parts: &FileParts) -> Result<Option<&ChunkIndex>> {
        let Layout::Chunked { address, chunk_shape, indexing } = &self.layout else { return Ok(None) };
        let read = self.index.get_or_init(|| {
            let grid = Grid {
                shape: &self.shape,
                max_shape: self.dataset.max_dims(),
                chunk_shape,
                item_bytes: self.raw.item_bytes,
                max_chunks: parts.max_chunks,
            };
            ChunkIndex::read(&parts.file, *address, indexing.as_ref(), &grid).map_err(|e| e.to_string())
        });
        read.as_ref().map(Some).map_err(|e| Error::InvalidData(format!("chunk index: {e}")))
    }

    /// Counts the rows from the first on whose bytes are in the file.
    ///
    /// After a kill (`unflushed_is_lost`) a chunk that is not there was lost; else it holds the fill value.
    pub(crate) fn readable_rows(&self, parts: &FileParts, unflushed_is_lost: bool) -> Result<u64> {
        let rows = self.shape.first().copied().unwrap_or(0);
        let file_bytes = parts.file.storage().len();
        let Some(index) = self.index(parts)? else {
            return Ok(match self.layout {
                Layout::Contiguous(Some(address)) if self.row_bytes() > 0 => {
                    rows.min(file_bytes.saturating_sub(address) / self.row_bytes())
                }
                Layout::Contiguous(None) if unflushed_is_lost => 0,
                _ => rows,
            });
        };
        let rows_per_chunk = self.chunk_shape().and_then(|c| c.first().copied()).unwrap_or(1).max(1);
        let per_group = index.per_row_group();
        if per_group == 0 {
            return Ok(rows);
        }
        for group in 0..index.counts.first().copied().unwrap_or(0) {
            for place in group * per_group..(group + 1) * per_group {
                let chunk = index.get(place);
                let is_lost = chunk.is_none_or(|c| {
                    if c.is_present() {
                        c.address.checked_add(c.bytes).is_none_or(|end| end > file_bytes)
                    } else {
                        unflushed_is_lost
                    }
                });
                if is_lost {
                    return Ok((group * rows_per_chunk).min(rows));
                }
            }
        }
        Ok(rows)
    }

    fn read_chunked(
        &self,
        parts: &FileParts,
        chunk_shape: &[u32],
        rows: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<()> {
        let Some(index) = self.index(parts)? else { return Ok(()) };
        let per_chunk = u64::from(chunk_shape[0]);
        let is_row_contiguous =
            self.shape[1..].iter().zip(&chunk_shape[1..]).all(|(&n, &c)| n == u64::from(c));
        for group in rows.start / per_chunk..rows.end.div_ceil(per_chunk) {
            let first = group * per_chunk;
            let wanted = rows.start.max(first)..rows.end.min(first + per_chunk);
            if is_row_contiguous {
                let chunk = index.get(group).ok_or_else(|| outside(group))?;
                let local = wanted.start - first..wanted.end - first;
                self.read_whole_rows(parts, group, chunk, local, out)?;
            } else {
                self.read_pieces(parts, index, chunk_shape, group, wanted, out)?;
            }
        }
        Ok(())
    }

    fn chunk_bytes(&self) -> Result<usize> {
        let Layout::Chunked { chunk_shape, .. } = &self.layout else { return Ok(0) };
        // Checked against the limit when the dataset was opened.
        to_usize(chunk_shape.iter().fold(self.raw.item_bytes as u64, |n, &c| n.saturating_mul(u64::from(c))))
    }

    /// Reads rows `local` of a chunk that holds whole rows, only the bytes they need where the filters allow.
    fn read_whole_rows(
        &self,
        parts: &FileParts,
        place: u64,
        chunk: Chunk,
        local: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<()> {
        let row_bytes = self.row_bytes();
        let range = to_usize(local.start * row_bytes)?..to_usize(local.end * row_bytes)?;
        if !chunk.is_present() {
            self.push_fill(range.len() as u64, out);
            return Ok(());
        }
        let expected = self.chunk_bytes()?;
        match self.active_filters(chunk.filter_mask)[..] {
            [] => {
                self.check_stored(chunk, expected)?;
                let at = chunk
                    .address
                    .checked_add(range.start as u64)
                    .ok_or(Error::OffsetOutOfBounds(chunk.address))?;
                out.extend_from_slice(&parts.file.storage().read_range(at, range.len())?);
            }
            [filters::BLOSC] => {
                let bytes = StoredFrame {
                    storage: parts.file.storage(),
                    chunk: self.stored(parts, chunk, expected)?,
                };
                let whole = (range.len() * 2 >= expected).then(|| bytes.read(0, bytes.len())).transpose();
                let decoded = whole.and_then(|whole| match whole {
                    Some(whole) => {
                        let frame = Frame::parse(&whole.as_ref(), Some(expected), expected)?;
                        frame.decode_range(&whole.as_ref(), range, out)
                    }
                    None => {
                        let frame = Frame::parse(&bytes, Some(expected), expected)?;
                        frame.decode_range(&bytes, range, out)
                    }
                });
                decoded.map_err(|e| Error::DecompressionError(format!("chunk {place}: {e}")))?;
            }
            _ => out.extend_from_slice(&self.decoded_chunk(parts, place, chunk)?[range]),
        }
        Ok(())
    }

    fn active_filters(&self, mask: u32) -> Vec<u16> {
        let is_active = |i: usize| mask & 1u32.checked_shl(i as u32).unwrap_or(0) == 0;
        self.filters.iter().enumerate().filter(|(i, _)| is_active(*i)).map(|(_, f)| f.id).collect()
    }

    /// Returns where a filtered chunk lies, its size checked.
    fn stored(&self, parts: &FileParts, chunk: Chunk, expected: usize) -> Result<Chunk> {
        let bytes = if chunk.bytes == 0 { expected as u64 } else { chunk.bytes };
        if bytes > parts.max_chunk_bytes.saturating_add(parts.max_chunk_bytes / 8) {
            return Err(Error::ResourceLimit(format!(
                "stored chunk of {bytes} bytes, limit {}",
                parts.max_chunk_bytes
            )));
        }
        Ok(Chunk { bytes, ..chunk })
    }

    fn check_stored(&self, chunk: Chunk, expected: usize) -> Result<()> {
        if chunk.bytes != 0 && chunk.bytes != expected as u64 {
            return Err(Error::InvalidData(format!(
                "unfiltered chunk at {:#x}: expected {expected} bytes, got {}",
                chunk.address, chunk.bytes
            )));
        }
        Ok(())
    }

    /// Returns a whole chunk, decoded; kept for the next row.
    fn decoded_chunk(&self, parts: &FileParts, place: u64, chunk: Chunk) -> Result<std::sync::Arc<Vec<u8>>> {
        if let Some(data) = parts.cache.get(self.cache_key, place) {
            return Ok(data);
        }
        let expected = self.chunk_bytes()?;
        let chunk = self.stored(parts, chunk, expected)?;
        let stored = parts.file.storage().read_range(chunk.address, to_usize(chunk.bytes)?)?;
        let data = filters::undo(
            &stored,
            &self.filters,
            chunk.filter_mask,
            self.raw.item_bytes,
            expected,
            &parts.registry,
        )
        .map_err(|e| Error::DecompressionError(format!("chunk {place} at {:#x}: {e}", chunk.address)))?;
        Ok(parts.cache.insert(self.cache_key, place, data))
    }

    /// Copies rows `wanted` out of all chunks of one place along the first axis.
    fn read_pieces(
        &self,
        parts: &FileParts,
        index: &ChunkIndex,
        chunk_shape: &[u32],
        group: u64,
        wanted: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<()> {
        let row_bytes = to_usize(self.row_bytes())?;
        let base = out.len();
        self.push_fill((wanted.end - wanted.start) * self.row_bytes(), out);
        let first_row = group * u64::from(chunk_shape[0]);
        let per_group = index.per_row_group();
        let mut corner = vec![0u64; self.shape.len()];
        for place in group * per_group..(group + 1) * per_group {
            let chunk = index.get(place).ok_or_else(|| outside(place))?;
            if chunk.is_present() {
                let data = self.decoded_chunk(parts, place, chunk)?;
                for row in wanted.clone() {
                    let row_start = base + to_usize(row - wanted.start)? * row_bytes;
                    let target = &mut out[row_start..row_start + row_bytes];
                    copy_row(
                        &data,
                        to_usize(row - first_row)?,
                        &corner,
                        chunk_shape,
                        &self.shape,
                        self.raw.item_bytes,
                        target,
                    );
                }
            }
            advance(&mut corner, &index.counts, chunk_shape);
        }
        Ok(())
    }
}

/// Moves to the next chunk of the same place along the first axis, row-major.
fn advance(corner: &mut [u64], counts: &[u64], chunk_shape: &[u32]) {
    for axis in (1..corner.len()).rev() {
        corner[axis] += u64::from(chunk_shape[axis]);
        if corner[axis] < counts[axis] * u64::from(chunk_shape[axis]) {
            return;
        }
        corner[axis] = 0;
    }
}

/// Copies the part of one row that a chunk holds: runs along the last axis.
fn copy_row(
    chunk: &[u8],
    chunk_row: usize,
    corner: &[u64],
    chunk_shape: &[u32],
    shape: &[u64],
    item: usize,
    target: &mut [u8],
) {
    let n = shape.len();
    // Extents that fit usize: the chunk and the row are in memory.
    let chunk_dims: Vec<usize> = chunk_shape.iter().map(|&c| c as usize).collect();
    let dims: Vec<usize> = shape.iter().map(|&d| d as usize).collect();
    let lens: Vec<usize> = (1..n).map(|a| chunk_dims[a].min(dims[a] - corner[a] as usize)).collect();
    let Some(&run) = lens.last() else {
        target.copy_from_slice(&chunk[chunk_row * item..(chunk_row + 1) * item]);
        return;
    };
    let mut at = vec![0usize; n - 1];
    loop {
        let (mut from, mut to) = (chunk_row, 0);
        for axis in 1..n {
            from = from * chunk_dims[axis] + at[axis - 1];
            to = to * dims[axis] + corner[axis] as usize + at[axis - 1];
        }
        target[to * item..(to + run) * item].copy_from_slice(&chunk[from * item..(from + run) * item]);
        let mut axis = n - 1;
        loop {
            if axis == 1 {
                return;
            }
            axis -= 1;
            at[axis - 1] += 1;
            if at[axis - 1] < lens[axis - 1] {
                break;
            }
            at[axis - 1] = 0;
        }
    }
}

/// A frame in the file, of which only the blocks asked for are read.
struct StoredFrame<'a> {
    storage: &'a dyn Storage,
    chunk: Chunk,
}

impl FrameBytes for StoredFrame<'_> {
    fn read(&self, at: usize, len: usize) -> std::result::Result<Cow<'_, [u8]>, BloscError> {
        let end = (at as u64).saturating_add(len as u64);
        if end > self.chunk.bytes {
            return Err(BloscError::Short { expected: end, got: self.chunk.bytes });
        }
        let offset = self.chunk.address.saturating_add(at as u64);
        let bytes = self.storage.read_range(offset, len).map_err(|e| BloscError::Read(e.to_string()))?;
        Ok(Cow::Owned(bytes.to_vec()))
    }

    fn len(&self) -> usize {
        usize::try_from(self.chunk.bytes).unwrap_or(usize::MAX)
    }
}

fn checked_layout(
    parts: &FileParts,
    shape: &[u64],
    total: u64,
    item_bytes: usize,
    layout: DataLayout,
) -> Result<Layout> {
    match layout {
        DataLayout::Compact { data } => {
            if (data.len() as u64) < total {
                return Err(Error::InvalidData(format!(
                    "compact data: expected {total} bytes, got {}",
                    data.len()
                )));
            }
            Ok(Layout::Compact(data))
        }
        DataLayout::Contiguous { address, size } => {
            if Cursor::is_undefined_offset(address, parts.file.superblock().offset_size) {
                return Ok(Layout::Contiguous(None));
            }
            if size != 0 && size < total {
                return Err(Error::InvalidData(format!(
                    "contiguous data: expected {total} bytes, got {size}"
                )));
            }
            Ok(Layout::Contiguous(Some(address)))
        }
        DataLayout::Chunked { address, mut dims, chunk_indexing, .. } => {
            // Old layouts list the element size as one more axis.
            dims.truncate(shape.len());
            if dims.len() != shape.len() || dims.is_empty() || dims.contains(&0) {
                return Err(Error::InvalidData(format!(
                    "chunks of {dims:?} do not fit the extent {shape:?}"
                )));
            }
            let bytes = dims.iter().try_fold(item_bytes as u64, |n, &c| n.checked_mul(u64::from(c)));
            match bytes.filter(|&b| b <= parts.max_chunk_bytes) {
                Some(_) => Ok(Layout::Chunked { address, chunk_shape: dims, indexing: chunk_indexing }),
                None => Err(Error::ResourceLimit(format!(
                    "chunk of {dims:?}, limit {} bytes",
                    parts.max_chunk_bytes
                ))),
            }
        }
    }
}

fn outside(place: u64) -> Error {
    Error::InvalidData(format!("chunk {place} is outside the grid"))
}

fn to_usize(n: u64) -> Result<usize> {
    usize::try_from(n).map_err(|e| Error::ResourceLimit(format!("{n} bytes: {e}")))
}
