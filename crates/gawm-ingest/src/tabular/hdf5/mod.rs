//! HDF5 files, read without C.
//!
//! The library parses metadata and chunk indices; rows are read by our own path ([`dataset`]), which fetches
//! only the bytes a row needs, demands that a chunk decodes to exactly its size, and knows Blosc.

mod blosc;
mod blosclz;
mod cache;
mod chunks;
mod dataset;
mod filters;
mod links;
mod metadata;
mod storage;

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use hdf5_reader::error::Error;
use hdf5_reader::group::Group;
use hdf5_reader::messages::HdfMessage;
use hdf5_reader::{Dataset, Hdf5File, OpenOptions, Storage};

use self::cache::ChunkCache;
use self::dataset::{FileParts, RowSource};
use self::links::Link;
use super::column::{Attribute, Column, Dtype, Filter};
use super::error::{OpenTableError, ReadError};
use super::finding::{Finding, FindingKind};
use super::raw::{self, RawForm, RawType};
use super::{Limits, Opened, Source};

/// A stored extent may exceed the file this many times over (deflate reaches 1032, empty images more).
const MAX_EXPANSION: u64 = 16_384;
/// An element may have this many bytes; only texts of fixed length come near.
const MAX_ITEM_BYTES: usize = 1 << 20;
/// An extent below this is never refused for its expansion.
const FREE_EXPANSION_BYTES: u64 = 1 << 30;

/// An open HDF5 file; sources are in the order of the table's columns.
pub(crate) struct Hdf5Source {
    parts: FileParts,
    rows: Vec<Option<RowSource>>,
}

impl Hdf5Source {
    /// Returns the form of a column's elements.
    pub(crate) fn raw(&self, column: usize) -> Option<RawType> {
        self.rows.get(column)?.as_ref().map(|r| r.raw)
    }

    /// Returns the bytes of one row as stored.
    pub(crate) fn row_bytes(&self, column: usize) -> u64 {
        self.rows.get(column).and_then(Option::as_ref).map_or(0, RowSource::row_bytes)
    }

    /// Appends the stored bytes of rows of a column.
    pub(crate) fn read(
        &self,
        column: usize,
        path: &str,
        rows: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<(), ReadError> {
        match self.rows.get(column).and_then(Option::as_ref) {
            Some(source) => source.read_rows(&self.parts, rows, out).map_err(|e| read_error(path, &e)),
            None => Err(ReadError::Damaged {
                column: path.to_owned(),
                detail: "expected a readable dataset".to_owned(),
            }),
        }
    }

    /// Follows heap references to their texts; all of them may hold `max_bytes`.
    pub(crate) fn texts(
        &self,
        column: usize,
        path: &str,
        references: &[u8],
        max_bytes: u64,
    ) -> Result<Vec<String>, ReadError> {
        let damaged = |detail: String| ReadError::Damaged { column: path.to_owned(), detail };
        let Some(source) = self.rows.get(column).and_then(Option::as_ref) else {
            return Err(damaged("expected a readable dataset".to_owned()));
        };
        let mut total = 0u64;
        let mut texts = Vec::new();
        for (element, reference) in references.chunks_exact(source.raw.item_bytes).enumerate() {
            let bytes = source
                .dataset
                .resolve_vlen_reference_bytes(reference, 1)
                .map_err(|e| read_error(path, &e))?;
            total = total.saturating_add(bytes.len() as u64);
            if total > max_bytes {
                return Err(ReadError::TooLarge {
                    column: path.to_owned(),
                    what: "text",
                    limit: max_bytes,
                    got: total,
                });
            }
            texts.push(
                raw::utf8(&bytes, element)
                    .map_err(|e| damaged(format!("element {}: {}", e.element, e.detail)))?,
            );
        }
        Ok(texts)
    }

    /// Returns a row range that ends on a chunk, about `bytes` long, for reading a column in order.
    pub(crate) fn batch_rows(&self, column: usize, bytes: u64) -> u64 {
        let Some(source) = self.rows.get(column).and_then(Option::as_ref) else { return 1 };
        let wanted = (bytes / source.row_bytes().max(1)).max(1);
        match source.chunk_shape().and_then(|c| c.first().copied()) {
            Some(per_chunk) if per_chunk > 0 => wanted.div_ceil(per_chunk) * per_chunk,
            _ => wanted,
        }
    }
}

/// Opens an HDF5 file and lists what is in it.
pub(crate) fn open(path: &Path, file: File, limits: &Limits) -> Result<Opened, OpenTableError> {
    let failed = |detail: String| OpenTableError::Hdf5 { path: path.to_owned(), detail };
    let cap = limits.max_read_bytes.max(limits.max_chunk_bytes.saturating_add(limits.max_chunk_bytes / 8));
    let storage = storage::BoundedFile::try_new(file, cap)
        .map_err(|source| OpenTableError::Io { path: path.to_owned(), source })?;
    let file_bytes = storage.len();
    let chunk_cap = usize::try_from(limits.max_chunk_bytes).unwrap_or(usize::MAX);
    let options = OpenOptions::default()
        .with_chunk_cache_bytes(0)
        .with_filter_registry(filters::registry(chunk_cap))
        .with_max_chunk_bytes(chunk_cap)
        .with_max_read_bytes(usize::try_from(limits.max_read_bytes).unwrap_or(usize::MAX))
        .with_max_object_header_bytes(4 << 20);
    let file =
        Hdf5File::from_storage_with_options(Arc::new(storage), options).map_err(|e| failed(e.to_string()))?;
    let parts = FileParts {
        file,
        registry: filters::registry(chunk_cap),
        cache: ChunkCache::new(limits.cache_bytes),
        max_chunk_bytes: limits.max_chunk_bytes,
        max_chunks: limits.max_chunks,
    };
    let mut walk = Walk::new(&parts, limits, file_bytes);
    walk.check_superblock();
    walk.run(path)?;
    let Walk { mut columns, findings, groups, is_unclean, .. } = walk;
    columns.sort_by(|a, b| a.0.path.cmp(&b.0.path));
    let (columns, rows) = columns.into_iter().unzip();
    Ok(Opened {
        columns,
        findings,
        groups,
        is_unclean,
        source: Source::Hdf5(Box::new(Hdf5Source { parts, rows })),
    })
}

/// The walk through groups: what was found, and where it has been.
struct Walk<'a> {
    parts: &'a FileParts,
    limits: &'a Limits,
    file_bytes: u64,
    columns: Vec<(Column, Option<RowSource>)>,
    groups: BTreeMap<String, Vec<Attribute>>,
    findings: Vec<Finding>,
    /// Object headers of groups seen, against hard links that form a cycle.
    visited: BTreeSet<u64>,
    /// Object headers of datasets seen: only the first of several names carries the attributes.
    described: BTreeSet<u64>,
    is_unclean: bool,
    is_truncated: bool,
}

impl<'a> Walk<'a> {
    fn new(parts: &'a FileParts, limits: &'a Limits, file_bytes: u64) -> Self {
        Self {
            parts,
            limits,
            file_bytes,
            columns: Vec::new(),
            groups: BTreeMap::new(),
            findings: Vec::new(),
            visited: BTreeSet::new(),
            described: BTreeSet::new(),
            is_unclean: false,
            is_truncated: false,
        }
    }

    fn note(&mut self, kind: FindingKind, place: &str, detail: impl Into<String>) {
        self.findings.push(Finding::new(kind, place, detail));
    }

    fn check_superblock(&mut self) {
        let superblock = self.parts.file.superblock();
        let (version, flags) = (superblock.version, superblock.consistency_flags);
        // The field is the end of the file as seen from its start, user block included.
        let expected = superblock.eof_address;
        // Files of the first two formats have the flags too, but nobody sets them there.
        if version >= 2 && flags != 0 {
            self.is_unclean = true;
            let detail = format!(
                "the writer did not close the file (consistency flags {flags:#x}): only flushed rows are offered"
            );
            self.note(FindingKind::UncleanClose, "/", detail);
        }
        if expected != u64::MAX && expected > self.file_bytes {
            self.is_truncated = true;
            let detail = format!("the file is cut: expected {expected} bytes, got {}", self.file_bytes);
            self.note(FindingKind::Truncated, "/", detail);
        }
    }

    fn run(&mut self, path: &Path) -> Result<(), OpenTableError> {
        let root = self.parts.file.root_group();
        let root = root.map_err(|e| {
            let cut = self.findings.iter().find(|finding| finding.kind == FindingKind::Truncated);
            let detail = cut.map_or_else(|| e.to_string(), |cut| format!("{}; {e}", cut.detail));
            OpenTableError::Hdf5 { path: path.to_owned(), detail }
        })?;
        let links = links::list(&self.parts.file, root.address()).map_err(|e| OpenTableError::Hdf5 {
            path: path.to_owned(),
            detail: format!("root group: {e}"),
        })?;
        self.visited.insert(root.address());
        let mut pending = vec![(root, String::new(), links, 0u32)];
        while let Some((group, prefix, links, depth)) = pending.pop() {
            self.group_attributes(&group, &prefix);
            for (name, link) in links {
                let place = if prefix.is_empty() { name.clone() } else { format!("{prefix}/{name}") };
                let child = self.follow(&group, &name, &link, &place);
                if (self.columns.len() + self.findings.len() + self.visited.len()) as u64
                    > self.limits.max_columns
                {
                    return Err(too_many(path, "datasets", self.limits.max_columns));
                }
                let Some(child) = child else { continue };
                if depth >= self.limits.max_depth {
                    return Err(too_many(path, "levels of groups", u64::from(self.limits.max_depth)));
                }
                match links::list(&self.parts.file, child.address()) {
                    Ok(links) => pending.push((child, place, links, depth + 1)),
                    Err(e) => self.note(
                        FindingKind::BrokenObject,
                        &place,
                        format!("the group cannot be listed: {e}"),
                    ),
                }
            }
        }
        Ok(())
    }

    /// Follows one name: takes a dataset as a column, or returns a group that was not seen before.
    fn follow(&mut self, group: &Group, name: &str, link: &Link, place: &str) -> Option<Group> {
        if let Link::External { file, path } = link {
            self.note(
                FindingKind::ExternalLink,
                place,
                format!("leads to {path:?} in the file {file:?}; not followed"),
            );
            return None;
        }
        match group.dataset(name) {
            Ok(dataset) => {
                self.take_dataset(dataset, place);
                return None;
            }
            Err(e) => match metadata::innermost(&e) {
                Error::DatasetNotFound(_) => {}
                Error::UnsupportedLayoutClass(3) => {
                    self.take_problem(place, ReadError::Virtual { column: place.to_owned() });
                    return None;
                }
                e => {
                    self.note(FindingKind::BrokenObject, place, format!("its header cannot be read: {e}"));
                    return None;
                }
            },
        }
        match (group.group(name), link) {
            (Ok(child), _) if self.visited.insert(child.address()) => Some(child),
            (Ok(_), _) => {
                self.note(
                    FindingKind::GroupLinkedTwice,
                    place,
                    "is another name of a group seen before; not followed",
                );
                None
            }
            (Err(_), Link::Soft(target)) => {
                self.note(
                    FindingKind::UnreadableColumn,
                    place,
                    format!("is a soft link to {target:?}, which leads nowhere"),
                );
                None
            }
            // A committed datatype is neither a dataset nor a group, and no loss.
            (Err(_), _) => None,
        }
    }

    fn group_attributes(&mut self, group: &Group, place: &str) {
        match group.attributes() {
            Ok(attributes) => {
                self.groups.insert(place.to_owned(), metadata::attributes(&attributes));
            }
            Err(e) => {
                self.note(FindingKind::BrokenObject, place, format!("its attributes cannot be read: {e}"))
            }
        }
    }

    fn take_problem(&mut self, place: &str, problem: ReadError) {
        self.note(FindingKind::UnreadableColumn, place, problem.to_string());
        let column = Column {
            path: place.to_owned(),
            dtype: Dtype::Unsupported,
            shape: Vec::new(),
            chunk_shape: None,
            filters: Vec::new(),
            attributes: Vec::new(),
            readable_rows: 0,
            problem: Some(problem),
        };
        self.columns.push((column, None));
    }

    fn take_dataset(&mut self, dataset: Dataset, place: &str) {
        let mut column = Column {
            path: place.to_owned(),
            dtype: Dtype::Unsupported,
            shape: metadata::shape(&dataset),
            chunk_shape: dataset.chunks().map(|c| c.iter().map(|&c| u64::from(c)).collect()),
            filters: Vec::new(),
            attributes: if self.described.insert(dataset.address()) {
                metadata::attributes(&dataset.attributes())
            } else {
                Vec::new()
            },
            readable_rows: 0,
            problem: None,
        };
        let rows = self.row_source(dataset, &mut column).and_then(|source| {
            let rows = column.shape.first().copied().unwrap_or(1);
            let is_suspect = self.is_unclean || self.is_truncated;
            column.readable_rows = if is_suspect && !column.shape.is_empty() {
                source.readable_rows(self.parts, self.is_unclean).map_err(|e| read_error(place, &e))?
            } else {
                rows
            };
            if column.readable_rows < rows {
                let detail = format!("{} of {rows} rows are in the file", column.readable_rows);
                self.note(FindingKind::UnflushedRows, place, detail);
            }
            Ok(source)
        });
        let source = match rows {
            Ok(source) => Some(source),
            Err(problem) => {
                self.note(FindingKind::UnreadableColumn, place, problem.to_string());
                column.problem = Some(problem);
                None
            }
        };
        self.columns.push((column, source));
    }

    fn row_source(&self, dataset: Dataset, column: &mut Column) -> Result<RowSource, ReadError> {
        let path = column.path.clone();
        let header =
            self.parts.file.get_or_parse_header(dataset.address()).map_err(|e| read_error(&path, &e))?;
        let mut layout = None;
        let mut pipeline = Vec::new();
        for message in &header.messages {
            match message {
                HdfMessage::DataLayout(message) => layout = Some(message.layout.clone()),
                HdfMessage::FilterPipeline(message) => pipeline = message.filters.clone(),
                HdfMessage::ExternalFiles(_) => return Err(ReadError::External { column: path }),
                _ => {}
            }
        }
        column.filters = pipeline
            .iter()
            .map(|f| Filter { id: f.id, name: filters::name(f.id, f.name.as_deref()) })
            .collect();
        let raw = metadata::raw_type(dataset.dtype(), dataset.vlen_reference_size())
            .map_err(|got| ReadError::UnsupportedType { column: path.clone(), got })?;
        column.dtype = raw.dtype;
        if let Some(f) = column.filters.iter().find(|f| !filters::is_known(f.id)) {
            return Err(ReadError::UnsupportedFilter { column: path, id: f.id, name: f.name.clone() });
        }
        let Some(layout) = layout else {
            return Err(ReadError::Damaged {
                column: path,
                detail: "expected a data layout in its header".to_owned(),
            });
        };
        self.check_extent(column, raw)?;
        let source = RowSource::try_new(self.parts, dataset, raw, layout, pipeline)
            .map_err(|e| read_error(&path, &e))?;
        column.chunk_shape = source.chunk_shape();
        Ok(source)
    }

    /// Refuses an extent that so small a file cannot hold, so that reading it all ends.
    fn check_extent(&self, column: &Column, raw: RawType) -> Result<(), ReadError> {
        if raw.item_bytes > MAX_ITEM_BYTES {
            let (limit, got) = (MAX_ITEM_BYTES as u64, raw.item_bytes as u64);
            return Err(ReadError::TooLarge { column: column.path.clone(), what: "element", limit, got });
        }
        let got = column.shape.iter().fold(raw.item_bytes as u64, |n, &d| n.saturating_mul(d));
        let limit = self.file_bytes.saturating_mul(MAX_EXPANSION).saturating_add(FREE_EXPANSION_BYTES);
        if got > limit {
            return Err(ReadError::TooLarge { column: column.path.clone(), what: "extent", limit, got });
        }
        if raw.form == RawForm::HeapReference
            && column.shape.iter().product::<u64>() > self.limits.max_read_bytes
        {
            return Err(ReadError::TooLarge { column: column.path.clone(), what: "text", limit, got });
        }
        Ok(())
    }
}

fn too_many(path: &Path, what: &'static str, limit: u64) -> OpenTableError {
    OpenTableError::TooMany { path: path.to_owned(), what, limit }
}

/// Says what the library said, with the column.
fn read_error(path: &str, error: &Error) -> ReadError {
    let column = path.to_owned();
    match metadata::innermost(error) {
        Error::Io(e) => ReadError::Io { column, detail: e.to_string() },
        e => ReadError::Damaged { column, detail: e.to_string() },
    }
}
