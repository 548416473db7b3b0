//! Arrays in HDF5 and npz files: columns, typed rows, and the episodes that their layout makes.
//!
//! A [`Table`] is an open file: [`open`] recognises it by content, lists its [`Column`]s, and says what is
//! wrong with it in [`Finding`]s. [`Table::read_rows`] and [`Table::read_image`] fetch only what rows need.
//! [`Table::episodes`] finds how episodes lie in the file (or takes a stated [`Layout`]). A contract's source
//! is then a column of an episode, where it would be a topic of a log.
//!
//! HDF5 is read without C: metadata by `hdf5-reader`, rows and Blosc by this module. Its data carry no
//! checksums, so that [`Table::content_hash`] is recorded at import and shows later damage.
//!
//! Invariant: a row is either exactly what the writer stored, or an error; what is left out is a finding.

mod column;
mod error;
mod finding;
mod hdf5;
mod layout;
mod npz;
mod raw;
mod recording;
mod report;
mod samples;

#[cfg(test)]
mod tests;

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::ops::Range;
use std::path::{Path, PathBuf};

pub use crate::rows::EPISODE_GAP_NS;
pub use column::{Attribute, AttributeValue, Column, Dtype, Filter, Rows, Values};
pub use error::{OpenTableError, ReadError};
pub use finding::{Finding, FindingKind};
pub use layout::{ColumnRows, Episode, EpisodeEnd, Episodes, Extent, Layout, LayoutError};
pub(crate) use raw::f32_from_f16;
use raw::{RawForm, RawType};
pub use recording::{RecordingError, TableRecording};
pub use report::{ColumnReport, TableReport, report};
pub use samples::{Batch, SampleError, SampleReader, Selection, StreamBatch, StreamRequest};

/// Caps that a hostile file meets before memory is taken.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Limits {
    /// Bytes that one read of rows may return. Default 256 MiB.
    pub max_read_bytes: u64,
    /// Bytes of one decoded HDF5 chunk. Default 256 MiB.
    pub max_chunk_bytes: u64,
    /// Bytes of one npz array, and of all npz arrays kept in memory. Default 2 GiB.
    pub max_array_bytes: u64,
    /// Bytes of decoded HDF5 chunks kept for the next row. Default 64 MiB.
    pub cache_bytes: u64,
    /// Chunks of one dataset. Default 4 Mi.
    pub max_chunks: u64,
    /// Datasets of one file. Default 200 000.
    pub max_columns: u64,
    /// Groups inside groups. Default 32.
    pub max_depth: u32,
}

impl Default for Limits {
    fn default() -> Self {
        Self {
            max_read_bytes: 256 << 20,
            max_chunk_bytes: 256 << 20,
            max_array_bytes: 2 << 30,
            cache_bytes: 64 << 20,
            max_chunks: 4 << 20,
            max_columns: 200_000,
            max_depth: 32,
        }
    }
}

/// What a text costs in memory besides its bytes, rounded up.
const TEXT_BYTES: u64 = 64;

/// File formats that hold tables.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// HDF5.
    Hdf5,
    /// A zip archive of numpy arrays.
    Npz,
}

/// What a format's opener returns.
pub(crate) struct Opened {
    columns: Vec<Column>,
    findings: Vec<Finding>,
    groups: BTreeMap<String, Vec<Attribute>>,
    is_unclean: bool,
    source: Source,
}

pub(crate) enum Source {
    Hdf5(Box<hdf5::Hdf5Source>),
    Npz(Box<npz::NpzSource>),
}

/// An open tabular file. Reads are positional and may come from many threads.
pub struct Table {
    path: PathBuf,
    format: Format,
    opened: Opened,
    limits: Limits,
}

/// Tells the format from the first bytes; `None` when it is no table.
pub fn sniff(path: &Path) -> std::io::Result<Option<Format>> {
    sniff_file(&mut File::open(path)?)
}

fn sniff_file(file: &mut File) -> std::io::Result<Option<Format>> {
    use std::io::{Seek, SeekFrom};
    const HDF5_MAGIC: &[u8; 8] = b"\x89HDF\r\n\x1a\n";
    let len = file.metadata()?.len();
    let mut head = [0; 8];
    // HDF5 may stand behind a user block of 512, 1024, ... bytes.
    let mut at = 0;
    while at + 8 <= len {
        file.seek(SeekFrom::Start(at))?;
        file.read_exact(&mut head)?;
        if &head == HDF5_MAGIC {
            return Ok(Some(Format::Hdf5));
        }
        if at == 0 && (head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06")) {
            return Ok(Some(Format::Npz));
        }
        at = if at == 0 { 512 } else { at * 2 };
    }
    Ok(None)
}

/// Opens an HDF5 or npz file, told apart by content.
///
/// # Errors
/// - the file cannot be read, is empty, or is neither format
/// - its superblock, root group or zip directory is damaged
/// - it holds more datasets or deeper groups than `limits` allow
///
/// Everything else that is wrong is a finding, or an error of the column it concerns.
pub fn open(path: &Path, limits: &Limits) -> Result<Table, OpenTableError> {
    let io = |source| OpenTableError::Io { path: path.to_owned(), source };
    let mut file = File::open(path).map_err(io)?;
    if file.metadata().map_err(io)?.is_dir() {
        return Err(OpenTableError::NotTabular { path: path.to_owned(), got: "a folder".to_owned() });
    }
    let (format, opened) = match sniff_file(&mut file).map_err(io)? {
        Some(Format::Hdf5) => (Format::Hdf5, hdf5::open(path, file, limits)?),
        Some(Format::Npz) => {
            std::io::Seek::rewind(&mut file).map_err(io)?;
            (Format::Npz, npz::open(path, file, limits)?)
        }
        None => return Err(not_tabular(path, &mut file)),
    };
    Ok(Table { path: path.to_owned(), format, opened, limits: limits.clone() })
}

fn not_tabular(path: &Path, file: &mut File) -> OpenTableError {
    let mut head = Vec::new();
    let read = std::io::Seek::rewind(file).and_then(|()| file.take(64).read_to_end(&mut head));
    if let Err(source) = read {
        return OpenTableError::Io { path: path.to_owned(), source };
    }
    let known: [(&[u8], &str); 7] = [
        (b"\x93NUMPY", "one npy array"),
        (b"\x89MCAP", "an MCAP log"),
        (b"SQLite format 3\0", "an SQLite database"),
        (b"PAR1", "a Parquet file"),
        (b"\x1f\x8b", "gzip data"),
        (b"version https://git-lfs", "a git LFS pointer"),
        (b"\x0e\x03\x13\x01", "an HDF4 file"),
    ];
    if head.is_empty() {
        return OpenTableError::Empty { path: path.to_owned() };
    }
    let name = known.iter().find(|(magic, _)| head.starts_with(magic)).map(|(_, name)| (*name).to_owned());
    let got = name.unwrap_or_else(|| format!("bytes {:02x?}", &head[..head.len().min(8)]));
    OpenTableError::NotTabular { path: path.to_owned(), got }
}

impl Table {
    /// Returns the path it was opened by.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the file's format.
    pub fn format(&self) -> Format {
        self.format
    }

    /// Returns the columns, sorted by path.
    pub fn columns(&self) -> &[Column] {
        &self.opened.columns
    }

    /// Returns what was noticed when the file was opened.
    pub fn findings(&self) -> &[Finding] {
        &self.opened.findings
    }

    /// Returns whether the writer was killed before it closed the file.
    pub fn is_unclean(&self) -> bool {
        self.opened.is_unclean
    }

    /// Returns the attributes of every group, by path; the root is the empty path.
    pub fn groups(&self) -> &BTreeMap<String, Vec<Attribute>> {
        &self.opened.groups
    }

    /// Returns a column by its path; a leading slash is allowed.
    pub fn column(&self, path: &str) -> Option<&Column> {
        self.position(path).map(|at| &self.opened.columns[at])
    }

    fn position(&self, path: &str) -> Option<usize> {
        let path = path.strip_prefix('/').unwrap_or(path);
        self.opened.columns.binary_search_by(|c| c.path.as_str().cmp(path)).ok()
    }

    fn readable(&self, path: &str) -> Result<(usize, &Column, RawType), ReadError> {
        let at = self.position(path).ok_or_else(|| self.unknown(path))?;
        let column = &self.opened.columns[at];
        if let Some(problem) = &column.problem {
            return Err(problem.clone());
        }
        let raw = match &self.opened.source {
            Source::Hdf5(source) => source.raw(at),
            Source::Npz(source) => source.raw(at),
        };
        let detail = || "expected a readable column".to_owned();
        let raw = raw.ok_or_else(|| ReadError::Damaged { column: column.path.clone(), detail: detail() })?;
        Ok((at, column, raw))
    }

    fn unknown(&self, path: &str) -> ReadError {
        const SHOWN: usize = 12;
        let names: Vec<&str> = self.columns().iter().map(|c| c.path.as_str()).take(SHOWN).collect();
        let more = self.columns().len().saturating_sub(SHOWN);
        let known = if more > 0 { format!("{} and {more} more", names.join(", ")) } else { names.join(", ") };
        ReadError::UnknownColumn { column: path.to_owned(), known }
    }

    /// Reads `rows` of a column as typed values; a scalar is row 0.
    ///
    /// # Errors
    /// - there is no such column, it cannot be read at all, or the rows are out of range
    /// - the rows are larger than [`Limits::max_read_bytes`]
    /// - the file cannot be read, or its bytes contradict the format
    pub fn read_rows(&self, path: &str, rows: Range<u64>) -> Result<Rows, ReadError> {
        let (at, column, raw) = self.readable(path)?;
        let bytes = self.read_stored(at, column, rows.clone())?;
        let damaged = |detail: String| ReadError::Damaged { column: column.path.clone(), detail };
        let values = match (&self.opened.source, raw.form) {
            (Source::Hdf5(source), RawForm::HeapReference) => {
                Values::Text(source.texts(at, &column.path, &bytes, self.limits.max_read_bytes)?)
            }
            _ => raw::decode(&bytes, raw).map_err(|e| {
                damaged(format!("rows {}..{}, element {}: {}", rows.start, rows.end, e.element, e.detail))
            })?,
        };
        let to_usize = |n: u64| usize::try_from(n).map_err(|e| damaged(e.to_string()));
        let row_shape = column.shape.iter().skip(1).map(|&d| to_usize(d)).collect::<Result<_, _>>()?;
        Ok(Rows { values, rows: to_usize(rows.end - rows.start)?, row_shape })
    }

    /// Reads all rows of a column, or a scalar.
    ///
    /// # Errors
    /// As [`Table::read_rows`].
    pub fn read_all(&self, path: &str) -> Result<Rows, ReadError> {
        let rows = self.readable(path)?.1.readable_rows;
        self.read_rows(path, 0..rows)
    }

    /// Reads one row of an image column into `out`, H x W x C bytes; returns `[H, W, C]`.
    ///
    /// # Errors
    /// As [`Table::read_rows`], and when the column holds no images.
    pub fn read_image(&self, path: &str, row: u64, out: &mut Vec<u8>) -> Result<[u64; 3], ReadError> {
        let (at, column, _) = self.readable(path)?;
        let Some(shape) = column.image_shape() else {
            let got = format!("{} of extent {:?}", column.dtype.name(), column.shape);
            return Err(ReadError::WrongKind {
                column: column.path.clone(),
                wanted: "images (u8, H x W x C)",
                got,
            });
        };
        out.clear();
        self.read_stored_into(at, column, row..row.saturating_add(1), out)?;
        Ok(shape)
    }

    fn read_stored(&self, at: usize, column: &Column, rows: Range<u64>) -> Result<Vec<u8>, ReadError> {
        let mut bytes = Vec::new();
        self.read_stored_into(at, column, rows, &mut bytes)?;
        Ok(bytes)
    }

    /// Appends stored bytes; the one place where range and size are checked.
    fn read_stored_into(
        &self,
        at: usize,
        column: &Column,
        rows: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<(), ReadError> {
        let n_rows = column.readable_rows;
        if rows.start > rows.end || rows.end > n_rows {
            let column = column.path.clone();
            return Err(ReadError::RowsOutOfRange { column, start: rows.start, end: rows.end, rows: n_rows });
        }
        let row_bytes = match &self.opened.source {
            Source::Hdf5(source) => source.row_bytes(at),
            Source::Npz(source) => source.row_bytes(at),
        };
        let mut got = (rows.end - rows.start).saturating_mul(row_bytes);
        if column.dtype == Dtype::Text {
            // Every text costs an allocation, however short it is.
            got = got.max(
                (rows.end - rows.start).saturating_mul(column.row_elements()).saturating_mul(TEXT_BYTES),
            );
        }
        if got > self.limits.max_read_bytes {
            let limit = self.limits.max_read_bytes;
            return Err(ReadError::TooLarge { column: column.path.clone(), what: "read", limit, got });
        }
        let (start, got) = (out.len(), (rows.end - rows.start) * row_bytes);
        match &self.opened.source {
            Source::Hdf5(source) => source.read(at, &column.path, rows, out)?,
            Source::Npz(source) => source.read(at, &column.path, rows, out)?,
        }
        if (out.len() - start) as u64 != got {
            let detail = format!("expected {got} bytes, got {}", out.len() - start);
            return Err(ReadError::Damaged { column: column.path.clone(), detail });
        }
        Ok(())
    }

    /// Passes all values of a column in order as little-endian, row-major bytes, a few MiB at a time.
    ///
    /// Texts are passed as `u64` length and UTF-8 bytes.
    ///
    /// # Errors
    /// As [`Table::read_rows`].
    pub fn visit_bytes(&self, path: &str, visit: &mut dyn FnMut(&[u8])) -> Result<(), ReadError> {
        const BATCH_BYTES: u64 = 4 << 20;
        let (at, column, raw) = self.readable(path)?;
        let (row_bytes, batch) = match &self.opened.source {
            Source::Hdf5(source) => (source.row_bytes(at), source.batch_rows(at, BATCH_BYTES)),
            Source::Npz(source) => (source.row_bytes(at), BATCH_BYTES / source.row_bytes(at).max(1)),
        };
        if row_bytes == 0 {
            return Ok(());
        }
        let cost =
            if raw.dtype == Dtype::Text { column.row_elements().saturating_mul(TEXT_BYTES) } else { 0 };
        let batch = batch.min(self.limits.max_read_bytes / row_bytes.max(cost)).max(1);
        let mut start = 0;
        while start < column.readable_rows {
            let end = start.saturating_add(batch).min(column.readable_rows);
            if raw.dtype == Dtype::Text {
                if let Values::Text(texts) = self.read_rows(path, start..end)?.values {
                    for text in texts {
                        visit(&(text.len() as u64).to_le_bytes());
                        visit(text.as_bytes());
                    }
                }
            } else {
                let mut bytes = self.read_stored(at, column, start..end)?;
                raw::to_little_endian(&mut bytes, raw);
                visit(&bytes);
            }
            start = end;
        }
        Ok(())
    }

    /// Hashes type, extent and values of a column with BLAKE3; equal in any file that holds the same array.
    ///
    /// # Errors
    /// As [`Table::read_rows`].
    pub fn content_hash(&self, path: &str) -> Result<[u8; 32], ReadError> {
        let (_, column, _) = self.readable(path)?;
        let mut hasher = blake3::Hasher::new();
        hasher.update(b"gawm.column.v1\0");
        hasher.update(column.dtype.name().as_bytes());
        hasher.update(&[0]);
        hasher.update(&(column.shape.len() as u64).to_le_bytes());
        // The rows that can be read, since those are what is hashed.
        for (axis, &extent) in column.shape.iter().enumerate() {
            let extent = if axis == 0 { column.readable_rows } else { extent };
            hasher.update(&extent.to_le_bytes());
        }
        self.visit_bytes(path, &mut |bytes| {
            hasher.update(bytes);
        })?;
        Ok(*hasher.finalize().as_bytes())
    }

    /// Finds the episodes: by `layout` if one is stated, else by the layout that fits.
    ///
    /// # Errors
    /// - no column can be read, no layout fits, or the stated one does not
    /// - the columns that say where episodes begin cannot be read
    pub fn episodes(&self, layout: Option<&Layout>) -> Result<Episodes, LayoutError> {
        layout::episodes(self, layout)
    }
}
