//! What a Parquet file declares of itself, checked before its reader allocates memory by it.
//!
//! The reader takes the sizes in a footer and in page headers as they are: a file of some kilobytes makes it ask for
//! gigabytes, and a process that does not get them ends. These are the same structures, in Thrift's compact protocol,
//! read with bounds and nothing else.

use std::{
    fs::File,
    io::{Read, Seek, SeekFrom},
    path::Path,
};

use parquet::{
    arrow::{ProjectionMask, arrow_reader::ParquetRecordBatchReaderBuilder},
    basic::Type,
    errors::ParquetError,
    file::metadata::{ColumnChunkMetaData, ParquetMetaData},
};

/// Groups within groups of a schema.
const MAX_SCHEMA_DEPTH: usize = 64;
/// Structs within structs.
const MAX_DEPTH: usize = 32;
/// Bytes of one page header, which holds a minimum and a maximum.
const MAX_HEADER_BYTES: usize = 16 << 20;
/// Bytes of the footer up to the end of its schema.
const MAX_SCHEMA_BYTES: usize = 256 << 20;
/// A page larger than this must be stored in at least a 16th of its size: no camera's picture shrinks further.
const LARGE_PAGE_BYTES: i64 = 64 << 20;
const MAX_PAGE_RATIO: i64 = 16;
/// A file of more rows than this must have a byte for each thousand of them.
const MANY_ROWS: i64 = 1_000_000;
const MAX_ROWS_PER_BYTE: u64 = 1_000;
/// Bytes that the texts of one batch may take.
const BATCH_TEXT_BYTES: i64 = 256 << 20;

const BINARY: u8 = 8;
const LIST: u8 = 9;
const SET: u8 = 10;
const MAP: u8 = 11;
const STRUCT: u8 = 12;

/// Why bytes cannot be read.
enum Bad {
    /// They end too early.
    Cut,
    /// They say something that cannot be.
    Wrong(String),
}

/// Bytes in Thrift's compact protocol.
struct Compact<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl Compact<'_> {
    fn byte(&mut self) -> Result<u8, Bad> {
        let byte = *self.bytes.get(self.at).ok_or(Bad::Cut)?;
        self.at += 1;
        Ok(byte)
    }

    fn varint(&mut self) -> Result<u64, Bad> {
        let mut value = 0u64;
        for shift in (0..64).step_by(7) {
            let byte = self.byte()?;
            value |= u64::from(byte & 127) << shift;
            if byte < 128 {
                return Ok(value);
            }
        }
        Err(Bad::Wrong("a number of more than 64 bits".to_owned()))
    }

    fn signed(&mut self) -> Result<i64, Bad> {
        let n = self.varint()?;
        Ok((n >> 1) as i64 ^ -((n & 1) as i64))
    }

    fn skip_bytes(&mut self, n: u64) -> Result<(), Bad> {
        let end = usize::try_from(n).ok().and_then(|n| self.at.checked_add(n)).ok_or(Bad::Cut)?;
        if end > self.bytes.len() {
            return Err(Bad::Cut);
        }
        self.at = end;
        Ok(())
    }

    /// Returns the type of a list's elements and their number.
    fn list(&mut self) -> Result<(u8, u64), Bad> {
        let head = self.byte()?;
        let n = if head >> 4 == 15 { self.varint()? } else { u64::from(head >> 4) };
        Ok((head & 15, n))
    }

    /// Calls `take` for each field of a struct with its id and type; what it does not take is skipped.
    fn fields(
        &mut self,
        depth: usize,
        take: &mut dyn FnMut(&mut Self, i64, u8) -> Result<bool, Bad>,
    ) -> Result<(), Bad> {
        let mut id = 0i64;
        loop {
            let head = self.byte()?;
            if head == 0 {
                return Ok(());
            }
            id = match head >> 4 {
                0 => self.signed()?,
                step => id.saturating_add(i64::from(step)),
            };
            if !take(self, id, head & 15)? {
                self.skip(head & 15, depth)?;
            }
        }
    }

    fn skip(&mut self, kind: u8, depth: usize) -> Result<(), Bad> {
        if depth > MAX_DEPTH {
            return Err(Bad::Wrong(format!("more than {MAX_DEPTH} structs within each other")));
        }
        match kind {
            1 | 2 => Ok(()),
            3 => self.skip_bytes(1),
            4..=6 => self.varint().map(drop),
            7 => self.skip_bytes(8),
            BINARY => {
                let n = self.varint()?;
                self.skip_bytes(n)
            }
            LIST | SET => {
                let (element, n) = self.list()?;
                (0..n).try_for_each(|_| self.skip_element(element, depth + 1))
            }
            MAP => {
                let n = self.varint()?;
                let kinds = if n == 0 { 0 } else { self.byte()? };
                (0..n).try_for_each(|_| {
                    self.skip_element(kinds >> 4, depth + 1)?;
                    self.skip_element(kinds & 15, depth + 1)
                })
            }
            STRUCT => self.fields(depth + 1, &mut |_, _, _| Ok(false)),
            other => Err(Bad::Wrong(format!("the unknown type {other}"))),
        }
    }

    /// Skips an element of a list: there a truth value has a byte.
    fn skip_element(&mut self, kind: u8, depth: usize) -> Result<(), Bad> {
        if matches!(kind, 1 | 2) { self.skip_bytes(1) } else { self.skip(kind, depth) }
    }
}

/// Reads something at a place of unknown length: with more and more bytes until it is whole.
fn read_at<T>(
    file: &File,
    start: u64,
    n_bytes: u64,
    cap: usize,
    parse: impl Fn(&mut Compact<'_>) -> Result<T, Bad>,
) -> Result<(T, usize), String> {
    let most = n_bytes.min(cap as u64) as usize;
    let mut wanted = most.min(512);
    loop {
        let mut bytes = vec![0; wanted];
        let mut source = file;
        source
            .seek(SeekFrom::Start(start))
            .and_then(|_| source.read_exact(&mut bytes))
            .map_err(|e| e.to_string())?;
        let mut reader = Compact { bytes: &bytes, at: 0 };
        match parse(&mut reader) {
            Ok(value) => return Ok((value, reader.at)),
            Err(Bad::Wrong(what)) => return Err(what),
            Err(Bad::Cut) if wanted == most => return Err("structures that end too early".to_owned()),
            Err(Bad::Cut) => wanted = wanted.saturating_mul(16).min(most),
        }
    }
}

/// How the file begins that git keeps in place of a large one.
const GIT_LFS: [u8; 23] = *b"version https://git-lfs";

/// Checks the schema in the footer of a file of `size` bytes: how many elements it declares, and how deep they are.
pub(super) fn check_schema(file: &File, size: u64) -> Result<(), String> {
    let mut tail = [0; 8];
    let mut source = file;
    let start = size.checked_sub(8).ok_or("too few bytes for a Parquet file")?;
    source
        .seek(SeekFrom::Start(start))
        .and_then(|_| source.read_exact(&mut tail))
        .map_err(|e| e.to_string())?;
    if &tail[4..] != b"PAR1" {
        let mut head = [0; GIT_LFS.len()];
        let read = source.seek(SeekFrom::Start(0)).and_then(|_| source.read_exact(&mut head));
        return Err(match read {
            Ok(()) if head == GIT_LFS => {
                "a git LFS pointer in its place: `git lfs pull` fetches it".to_owned()
            }
            _ => "no Parquet footer at its end: it was cut, or is another format".to_owned(),
        });
    }
    let length = u64::from(u32::from_le_bytes([tail[0], tail[1], tail[2], tail[3]]));
    let Some(footer) = start.checked_sub(length) else {
        return Err(format!("a footer of {length} bytes in a file of {size}"));
    };
    read_at(file, footer, length, MAX_SCHEMA_BYTES, parse_schema)
        .map(|_| ())
        .map_err(|e| format!("a footer with {e}"))
}

fn parse_schema(reader: &mut Compact<'_>) -> Result<(), Bad> {
    let mut is_done = false;
    while !is_done {
        // The schema is field 2: what follows is read by the reader itself.
        let head = reader.byte()?;
        match (head >> 4, head & 15) {
            (_, 0) => return Err(Bad::Wrong("no schema".to_owned())),
            (_, LIST) => {
                let (_, n) = reader.list()?;
                parse_elements(reader, n)?;
                is_done = true;
            }
            (_, kind) => reader.skip(kind, 0)?,
        }
    }
    Ok(())
}

fn parse_elements(reader: &mut Compact<'_>, n_elements: u64) -> Result<(), Bad> {
    // Children that are still to come, of each group that is open.
    let mut open: Vec<u64> = Vec::new();
    for i in 0..n_elements {
        let mut n_children = 0i64;
        reader.fields(1, &mut |reader, id, kind| {
            let is_count = id == 5 && kind == 5;
            if is_count {
                n_children = reader.signed()?;
            }
            Ok(is_count)
        })?;
        while open.last() == Some(&0) {
            open.pop();
        }
        if let Some(left) = open.last_mut() {
            *left -= 1;
        }
        match u64::try_from(n_children) {
            Ok(0) => {}
            Ok(n) if n < n_elements - i => open.push(n),
            _ => {
                let what =
                    format!("a schema of {n_elements} elements, one of which has {n_children} children");
                return Err(Bad::Wrong(what));
            }
        }
        if open.len() > MAX_SCHEMA_DEPTH {
            return Err(Bad::Wrong(format!("a schema of more than {MAX_SCHEMA_DEPTH} levels")));
        }
    }
    Ok(())
}

/// Checks that a file of `size` bytes may have `n_rows` rows.
pub(super) fn check_rows(n_rows: i64, size: u64) -> Result<(), String> {
    if n_rows > MANY_ROWS && n_rows as u64 > size.saturating_mul(MAX_ROWS_PER_BYTE) {
        return Err(format!("{n_rows} rows in a file of {size} bytes"));
    }
    Ok(())
}

/// Checks the headers of all pages that a reader of these columns and row groups will read, and returns how many rows of
/// them a batch may have at most: texts that share one long dictionary entry are long in each row.
///
/// # Errors
///
/// The first page that declares more than its file can hold.
pub fn check_pages(
    file: &File,
    metadata: &ParquetMetaData,
    row_groups: impl IntoIterator<Item = usize>,
    mask: &ProjectionMask,
) -> Result<usize, String> {
    let mut largest = 1;
    for group in row_groups.into_iter().filter(|group| *group < metadata.num_row_groups()) {
        let columns = metadata.row_group(group).columns().iter().enumerate();
        for (_, column) in columns.filter(|(leaf, _)| mask.leaf_included(*leaf)) {
            let dictionary = check_column(file, column)
                .map_err(|e| format!("{e} (column {}, row group {group})", column.column_path()))?;
            if column.column_type() == Type::BYTE_ARRAY {
                largest = largest.max(dictionary);
            }
        }
    }
    Ok((BATCH_TEXT_BYTES / largest).max(1) as usize)
}

/// Opens a reader of the columns that `wants` names, with everything checked that it will allocate by.
///
/// # Errors
///
/// The file cannot be opened, is no Parquet file, or declares more than it can hold.
pub fn checked_builder(
    path: &Path,
    wants: impl Fn(&str) -> bool,
) -> Result<ParquetRecordBatchReaderBuilder<File>, ParquetError> {
    let (file, metadata) = super::open_parquet(path).map_err(ParquetError::General)?;
    let fields = metadata.schema().fields().iter().enumerate();
    let roots = fields.filter(|(_, field)| wants(field.name())).map(|(i, _)| i);
    let mask = ProjectionMask::roots(metadata.parquet_schema(), roots);
    let groups = 0..metadata.metadata().num_row_groups();
    let most_rows = check_pages(&file, metadata.metadata(), groups, &mask).map_err(ParquetError::General)?;
    let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata);
    Ok(builder.with_projection(mask).with_batch_size(most_rows.min(1024)))
}

/// Checks the pages of one column chunk; returns the size of its dictionary.
fn check_column(file: &File, column: &ColumnChunkMetaData) -> Result<i64, String> {
    let (start, length) = column.byte_range();
    let (mut at, end) = (start, start.saturating_add(length));
    let mut dictionary = 1;
    while at < end {
        let (page, n_header) = read_at(file, at, end - at, MAX_HEADER_BYTES, parse_page)
            .map_err(|e| format!("a page header with {e}"))?;
        let body = at + n_header as u64;
        let stored = u64::try_from(page.stored).ok().filter(|stored| *stored <= end - body);
        let Some(stored) = stored else {
            return Err(format!("a page of {} bytes where {} are left", page.stored, end - body));
        };
        let allowed = LARGE_PAGE_BYTES.max(page.stored.saturating_mul(MAX_PAGE_RATIO));
        if page.size < 0 || page.size > allowed {
            return Err(format!(
                "a page that declares {} bytes and is stored in {}: at most {allowed} are read",
                page.size, page.stored
            ));
        }
        if let Some(n_entries) = page.dictionary {
            if n_entries < 0 || n_entries > page.size {
                return Err(format!("a dictionary of {n_entries} entries in {} bytes", page.size));
            }
            dictionary = page.size.max(1);
        }
        at = body + stored;
    }
    Ok(dictionary)
}

/// What a page header says.
struct Page {
    size: i64,
    stored: i64,
    /// Entries, if it is a dictionary.
    dictionary: Option<i64>,
}

fn parse_page(reader: &mut Compact<'_>) -> Result<Page, Bad> {
    let mut page = Page { size: -1, stored: -1, dictionary: None };
    reader.fields(0, &mut |reader, id, kind| {
        match (id, kind) {
            (2, 5) => page.size = reader.signed()?,
            (3, 5) => page.stored = reader.signed()?,
            (7, STRUCT) => reader.fields(1, &mut |reader, id, kind| {
                let is_count = (id, kind) == (1, 5);
                if is_count {
                    page.dictionary = Some(reader.signed()?);
                }
                Ok(is_count)
            })?,
            _ => return Ok(false),
        }
        Ok(true)
    })?;
    Ok(page)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn structs_within_structs_end() {
        // Field 1 is a struct, whose field 1 is a struct, and so on.
        let deep = [0x1C].repeat(100_000);
        let mut reader = Compact { bytes: &deep, at: 0 };
        assert!(matches!(reader.skip(STRUCT, 0), Err(Bad::Wrong(_))));
        // Lists of lists.
        let lists = [0x19].repeat(100_000);
        let mut reader = Compact { bytes: &lists, at: 0 };
        assert!(matches!(reader.skip(LIST, 0), Err(Bad::Wrong(_))));
        let mut cut = Compact { bytes: &[0x15], at: 0 };
        assert!(matches!(parse_page(&mut cut), Err(Bad::Cut)));
    }
}
