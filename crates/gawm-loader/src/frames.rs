//! Encoded frames by position: one positional read each.
//!
//! The writer puts each frame on a page of its own, PLAIN and uncompressed, so the offset index of a column says where a
//! frame lies. Nothing of it is trusted: positions are checked against the file, and each page against its header.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

use gawm_dataset::read::Dataset;
use parquet::basic::Compression;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaData, ParquetMetaDataReader};

use crate::error::LoadError;

/// Largest page that is read: far above any frame.
const MAX_PAGE_BYTES: i32 = 256 << 20;

/// The data files of a dataset with the positions of all frames.
#[derive(Debug)]
pub(crate) struct FrameFiles {
    cameras: Vec<String>,
    files: Vec<FrameFile>,
}

#[derive(Debug)]
struct FrameFile {
    path: PathBuf,
    file: File,
    /// Its first row in the dataset.
    first_row: u64,
    /// Pages by camera, then by row of the file.
    pages: Vec<Vec<Page>>,
}

/// Where a frame's page lies.
#[derive(Debug, Clone, Copy)]
struct Page {
    offset: u64,
    bytes: u32,
}

impl FrameFiles {
    /// Reads the offset indexes of the cameras' columns.
    pub(crate) fn open(dataset: &Dataset, cameras: &[String]) -> Result<FrameFiles, LoadError> {
        let mut files = Vec::with_capacity(dataset.files.len());
        let mut first_row = 0;
        for data in &dataset.files {
            let file = File::open(&data.path).map_err(LoadError::io("open", &data.path))?;
            let refused = |got: String| {
                LoadError::dataset(
                    &data.path,
                    "one frame per page, PLAIN and uncompressed, with an offset index",
                    got,
                )
            };
            let length = file.metadata().map_err(LoadError::io("ask the length of", &data.path))?.len();
            let reader = ParquetMetaDataReader::new()
                .with_column_index_policy(PageIndexPolicy::Skip)
                .with_offset_index_policy(PageIndexPolicy::Required);
            let metadata = reader.parse_and_finish(&file).map_err(|e| refused(e.to_string()))?;
            let pages = cameras.iter().map(|camera| pages(&metadata, camera, length).map_err(refused));
            let pages: Vec<Vec<Page>> = pages.collect::<Result<_, _>>()?;
            files.push(FrameFile { path: data.path.clone(), file, first_row, pages });
            first_row += data.n_rows;
        }
        Ok(FrameFiles { cameras: cameras.to_vec(), files })
    }

    /// Reads the frame of a row by position; returns it as a part of `buffer`, which is reused.
    pub(crate) fn read<'a>(
        &self,
        camera: usize,
        row: u64,
        buffer: &'a mut Vec<u8>,
    ) -> Result<&'a [u8], LoadError> {
        let file = self.file_of(row);
        let page = file.pages[camera][(row - file.first_row) as usize];
        buffer.resize(page.bytes as usize, 0);
        file.file.read_exact_at(buffer, page.offset).map_err(LoadError::io("read", &file.path))?;
        frame_of(buffer).map_err(|got| LoadError::Page {
            path: file.path.clone(),
            camera: self.cameras[camera].clone(),
            row,
            expected: "a PLAIN page of one value",
            got,
        })
    }

    /// Returns the file that holds a row, for messages.
    pub(crate) fn path_of(&self, row: u64) -> &Path {
        &self.file_of(row).path
    }

    fn file_of(&self, row: u64) -> &FrameFile {
        let after = self.files.partition_point(|file| file.first_row <= row);
        &self.files[after - 1]
    }
}

/// Lists the pages of a camera, or says what is wrong.
fn pages(metadata: &ParquetMetaData, camera: &str, length: u64) -> Result<Vec<Page>, String> {
    let index = metadata.offset_index().ok_or("no offset index")?;
    let mut pages = Vec::new();
    for (group, columns) in metadata.row_groups().iter().zip(index) {
        let is_wanted =
            |parts: &[String]| matches!(parts, [name, bytes] if name == camera && bytes == "bytes");
        let column = group.columns().iter().position(|c| is_wanted(c.column_path().parts()));
        let column = column.ok_or_else(|| format!("no column {camera}.bytes"))?;
        let compression = group.column(column).compression();
        if compression != Compression::UNCOMPRESSED {
            return Err(format!("column {camera} with compression {compression}"));
        }
        let locations = columns.get(column).ok_or("an offset index with too few columns")?;
        let locations = &locations.page_locations;
        if locations.len() as i64 != group.num_rows() {
            return Err(format!("{} pages for {} rows of {camera}", locations.len(), group.num_rows()));
        }
        for (row, location) in locations.iter().enumerate() {
            let bytes = location.compressed_page_size;
            let end = u64::try_from(location.offset).ok().and_then(|o| o.checked_add(bytes.max(0) as u64));
            let is_inside = end.is_some_and(|end| end <= length) && (1..=MAX_PAGE_BYTES).contains(&bytes);
            if location.first_row_index != row as i64 || !is_inside {
                return Err(format!("an offset index that points outside the file ({camera}, row {row})"));
            }
            pages.push(Page { offset: location.offset as u64, bytes: bytes as u32 });
        }
    }
    Ok(pages)
}

/// Finds the value of a PLAIN data page (version 1) that holds one.
///
/// ```text
/// header (Thrift compact): 0x15 type, 0x15 uncompressed size, 0x15 compressed size, ...
/// payload, the last `size` bytes: u32 n, n bytes of definition levels; u32 length, the value
/// ```
fn frame_of(page: &[u8]) -> Result<&[u8], String> {
    let mut header = page;
    let page_type = thrift_i32(&mut header).ok_or("no page header")?;
    if page_type != 0 {
        return Err(format!("a page of type {page_type}"));
    }
    let uncompressed = thrift_i32(&mut header).ok_or("no page header")?;
    let stored = thrift_i32(&mut header).ok_or("no page header")?;
    if uncompressed != stored {
        return Err("a compressed page".to_owned());
    }
    let payload =
        usize::try_from(stored).ok().and_then(|n| header.len().checked_sub(n)).map(|at| &header[at..]);
    let levels = payload.and_then(take_block).ok_or("a page without definition levels")?;
    match take_block(levels.1) {
        Some((value, [])) if !value.is_empty() => Ok(value),
        Some(([], [])) => Err("an empty value".to_owned()),
        Some((value, rest)) => Err(format!("{} bytes behind a value of {} bytes", rest.len(), value.len())),
        None => Err("no value (a missing frame?)".to_owned()),
    }
}

/// Takes a 32-bit length and so many bytes.
fn take_block(bytes: &[u8]) -> Option<(&[u8], &[u8])> {
    let (length, rest) = bytes.split_first_chunk()?;
    rest.split_at_checked(u32::from_le_bytes(*length) as usize)
}

/// Takes the next field of a Thrift compact struct, which must be the next in number and an i32.
fn thrift_i32(bytes: &mut &[u8]) -> Option<i32> {
    let (0x15, mut rest) = bytes.split_first().map(|(first, rest)| (*first, rest))? else { return None };
    let mut value = 0_u64;
    for shift in (0..35).step_by(7) {
        let (byte, tail) = rest.split_first()?;
        rest = tail;
        value |= u64::from(byte & 0x7f) << shift;
        if byte & 0x80 == 0 {
            *bytes = rest;
            let zigzag = u32::try_from(value).ok()?;
            return Some((zigzag >> 1) as i32 ^ -((zigzag & 1) as i32));
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    fn page(value: &[u8]) -> Vec<u8> {
        let mut payload = vec![2, 0, 0, 0, 2, 2];
        payload.extend((value.len() as u32).to_le_bytes());
        payload.extend(value);
        let zigzag = |n: usize| {
            let n = (n as u32) << 1;
            vec![0x15, n as u8 & 0x7f | 0x80, (n >> 7) as u8 & 0x7f | 0x80, (n >> 14) as u8]
        };
        let mut page = vec![0x15, 0];
        page.extend([zigzag(payload.len()), zigzag(payload.len())].concat());
        page.extend([0x2c, 0x15, 2, 0x15, 0, 0x15, 6, 0x15, 6, 0, 0]);
        page.extend(payload);
        page
    }

    #[test]
    fn the_value_of_a_page_is_found() {
        let value: Vec<u8> = (0..1000).map(|i| i as u8).collect();
        assert_eq!(frame_of(&page(&value)).unwrap(), value);
        assert!(frame_of(&page(b"")).is_err());
        assert!(frame_of(b"").is_err());
    }

    #[test]
    fn mutated_pages_never_break_the_reader() {
        let whole = page(&[7; 300]);
        let mut state = 3072_u32;
        let mut next = |bound: usize| {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 8) as usize % bound
        };
        let mut found = 0;
        for _ in 0..20_000 {
            let mut page = whole.clone();
            for _ in 0..1 + next(4) {
                let at = next(40);
                page[at] = next(256) as u8;
            }
            page.truncate(if next(4) == 0 { next(page.len()) } else { page.len() });
            found += usize::from(frame_of(&page).is_ok_and(|value| value.len() <= page.len()));
        }
        assert!(found > 100 && found < 20_000, "{found}");
    }
}
