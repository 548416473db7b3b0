//! npz files: a zip archive with one `.npy` array per entry.
//!
//! Arrays are inflated whole (the format has no index inside an array), checked against the archive's CRC-32,
//! turned to row-major order, and the last ones are kept.

mod npy;

use std::collections::VecDeque;
use std::fs::File;
use std::io::{BufReader, Read};
use std::ops::Range;
use std::path::Path;
use std::sync::{Arc, Mutex, PoisonError};

use zip::ZipArchive;

use self::npy::{NpyHeader, Unsupported};
use super::column::{Column, Dtype};
use super::error::{OpenTableError, ReadError};
use super::finding::{Finding, FindingKind};
use super::raw::RawType;
use super::{Limits, Opened, Source};

/// An open npz file; arrays are in the order of the table's columns.
pub(crate) struct NpzSource {
    archive: Mutex<ZipArchive<BufReader<File>>>,
    arrays: Vec<Option<Array>>,
    /// Arrays inflated last, newest last.
    kept: Mutex<VecDeque<(usize, Arc<Vec<u8>>)>>,
    max_array_bytes: u64,
}

/// One array of the archive.
struct Array {
    entry: usize,
    header: NpyHeader,
    raw: RawType,
    bytes: u64,
}

impl NpzSource {
    /// Returns the form of a column's elements.
    pub(crate) fn raw(&self, column: usize) -> Option<RawType> {
        self.arrays.get(column)?.as_ref().map(|a| a.raw)
    }

    /// Returns the bytes of one row as stored.
    pub(crate) fn row_bytes(&self, column: usize) -> u64 {
        self.arrays.get(column).and_then(Option::as_ref).map_or(0, |a| {
            a.header.shape.iter().skip(1).fold(a.raw.item_bytes as u64, |n, &d| n.saturating_mul(d))
        })
    }

    /// Appends the stored bytes of rows of a column.
    pub(crate) fn read(
        &self,
        column: usize,
        path: &str,
        rows: Range<u64>,
        out: &mut Vec<u8>,
    ) -> Result<(), ReadError> {
        let damaged =
            |detail: &str| ReadError::Damaged { column: path.to_owned(), detail: detail.to_owned() };
        let row_bytes = self.row_bytes(column);
        let range = rows.start.checked_mul(row_bytes).zip(rows.end.checked_mul(row_bytes));
        let range = range.and_then(|(a, b)| Some(usize::try_from(a).ok()?..usize::try_from(b).ok()?));
        let range = range.ok_or_else(|| damaged("row offset overflows"))?;
        if range.is_empty() {
            return Ok(());
        }
        let data = self.load(column, path)?;
        out.extend_from_slice(data.get(range).ok_or_else(|| damaged("the array ends before the row"))?);
        Ok(())
    }

    fn load(&self, column: usize, path: &str) -> Result<Arc<Vec<u8>>, ReadError> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(found) = kept.iter().position(|(c, _)| *c == column).and_then(|at| kept.remove(at)) {
            let data = Arc::clone(&found.1);
            kept.push_back(found);
            return Ok(data);
        }
        let data = Arc::new(self.inflate(column, path)?);
        kept.push_back((column, Arc::clone(&data)));
        let mut bytes: u64 = kept.iter().map(|(_, d)| d.len() as u64).sum();
        while bytes > self.max_array_bytes {
            let Some((_, oldest)) = kept.pop_front() else { break };
            bytes -= oldest.len() as u64;
        }
        Ok(data)
    }

    fn inflate(&self, column: usize, path: &str) -> Result<Vec<u8>, ReadError> {
        let damaged = |detail: String| ReadError::Damaged { column: path.to_owned(), detail };
        let Some(array) = self.arrays.get(column).and_then(Option::as_ref) else {
            return Err(damaged("expected a readable array".to_owned()));
        };
        let mut archive = self.archive.lock().unwrap_or_else(PoisonError::into_inner);
        let mut entry = archive.by_index(array.entry).map_err(|e| damaged(e.to_string()))?;
        npy::read_header(&mut entry).map_err(damaged)?;
        let mut data = Vec::new();
        // One byte more shows an array that is too long; the end is reached, so that the CRC is checked.
        entry
            .by_ref()
            .take(array.bytes.saturating_add(1))
            .read_to_end(&mut data)
            .map_err(|e| damaged(e.to_string()))?;
        if data.len() as u64 != array.bytes {
            return Err(damaged(format!(
                "expected {} bytes of data, got {} or more",
                array.bytes,
                data.len()
            )));
        }
        if array.header.is_fortran && array.header.shape.len() > 1 {
            data = row_major(&data, &array.header.shape, array.raw.item_bytes);
        }
        Ok(data)
    }
}

/// Turns an array whose first axis varies fastest into one whose last axis does.
fn row_major(data: &[u8], shape: &[u64], item: usize) -> Vec<u8> {
    // The data are in memory, so every extent of a non-empty array fits.
    let dims: Vec<usize> = shape.iter().map(|&d| d as usize).collect();
    let strides: Vec<usize> = dims.iter().scan(item, |n, &d| Some(std::mem::replace(n, *n * d))).collect();
    let mut out = Vec::with_capacity(data.len());
    let mut at = vec![0usize; dims.len()];
    while out.len() < data.len() {
        let from: usize = at.iter().zip(&strides).map(|(a, s)| a * s).sum();
        out.extend_from_slice(&data[from..from + item]);
        for axis in (0..dims.len()).rev() {
            at[axis] += 1;
            if at[axis] < dims[axis] {
                break;
            }
            at[axis] = 0;
        }
    }
    out
}

/// Opens an npz file and lists its arrays.
pub(crate) fn open(path: &Path, file: File, limits: &Limits) -> Result<Opened, OpenTableError> {
    let failed = |detail: String| OpenTableError::Npz { path: path.to_owned(), detail };
    let mut archive = ZipArchive::new(BufReader::new(file)).map_err(|e| failed(e.to_string()))?;
    if archive.len() as u64 > limits.max_columns {
        return Err(OpenTableError::TooMany {
            path: path.to_owned(),
            what: "arrays",
            limit: limits.max_columns,
        });
    }
    let mut opened: Vec<(Column, Option<Array>)> = Vec::new();
    let mut findings = Vec::new();
    let mut foreign = None;
    for entry in 0..archive.len() {
        let (name, array) = list_entry(&mut archive, entry);
        let Some(name) = name.strip_suffix(".npy") else {
            findings.push(Finding::new(
                FindingKind::UnreadableColumn,
                &name,
                "expected an .npy entry, got another file",
            ));
            foreign.get_or_insert(name);
            continue;
        };
        let listed = array.map_err(|detail| ReadError::Damaged { column: name.to_owned(), detail });
        let (column, array) = column(name, entry, listed, limits);
        if let Some(problem) = &column.problem {
            findings.push(Finding::new(FindingKind::UnreadableColumn, name, problem.to_string()));
        }
        opened.push((column, array));
    }
    if let (true, Some(got)) = (opened.is_empty(), foreign) {
        return Err(OpenTableError::NotArrays { path: path.to_owned(), got });
    }
    opened.sort_by(|a, b| a.0.path.cmp(&b.0.path));
    opened.dedup_by(|b, a| {
        let is_double = a.0.path == b.0.path;
        if is_double {
            let detail = "two entries of this name; the first is taken";
            findings.push(Finding::new(FindingKind::BrokenObject, &a.0.path, detail));
        }
        is_double
    });
    let (columns, arrays) = opened.into_iter().unzip();
    let source = NpzSource {
        archive: Mutex::new(archive),
        arrays,
        kept: Mutex::new(VecDeque::new()),
        max_array_bytes: limits.max_array_bytes,
    };
    let groups = std::collections::BTreeMap::new();
    Ok(Opened { columns, findings, groups, is_unclean: false, source: Source::Npz(Box::new(source)) })
}

fn list_entry(
    archive: &mut ZipArchive<BufReader<File>>,
    index: usize,
) -> (String, Result<(NpyHeader, u64), String>) {
    let mut entry = match archive.by_index(index) {
        Ok(entry) => entry,
        Err(e) => return (format!("entry {index}.npy"), Err(e.to_string())),
    };
    let name = entry.name().map_or_else(|_e| format!("entry {index}.npy"), |n| n.into_owned());
    if !name.ends_with(".npy") {
        return (name, Err("no array".to_owned()));
    }
    let size = entry.size();
    let header = npy::read_header(&mut entry).map(|h| (h, size));
    (name, header)
}

fn column(
    name: &str,
    entry: usize,
    listed: Result<(NpyHeader, u64), ReadError>,
    limits: &Limits,
) -> (Column, Option<Array>) {
    let mut column = Column {
        path: name.to_owned(),
        dtype: Dtype::Unsupported,
        shape: Vec::new(),
        chunk_shape: None,
        filters: Vec::new(),
        attributes: Vec::new(),
        readable_rows: 0,
        problem: None,
    };
    let array = listed.and_then(|(header, size)| {
        column.shape.clone_from(&header.shape);
        let raw = header.raw.clone().map_err(|e| match e {
            Unsupported::Pickled => ReadError::Pickled { column: name.to_owned() },
            Unsupported::Type(got) => ReadError::UnsupportedType { column: name.to_owned(), got },
        })?;
        column.dtype = raw.dtype;
        let bytes = header.shape.iter().try_fold(raw.item_bytes as u64, |n, &d| n.checked_mul(d));
        let got = bytes.unwrap_or(u64::MAX);
        if got > limits.max_array_bytes {
            let limit = limits.max_array_bytes;
            return Err(ReadError::TooLarge { column: name.to_owned(), what: "array", limit, got });
        }
        if size != got.saturating_add(header.data_offset) {
            let detail = format!(
                "shape {:?} needs {got} bytes after the header of {}: the entry has {size}",
                header.shape, header.data_offset
            );
            return Err(ReadError::Damaged { column: name.to_owned(), detail });
        }
        Ok(Array { entry, raw, bytes: got, header })
    });
    match array {
        Ok(array) => {
            column.readable_rows = column.shape.first().copied().unwrap_or(1);
            (column, Some(array))
        }
        Err(problem) => {
            column.problem = Some(problem);
            (column, None)
        }
    }
}
