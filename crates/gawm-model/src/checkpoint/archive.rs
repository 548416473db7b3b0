//! The part of zip that PyTorch writes: stored entries, large-file records, checksums.
//!
//! Read here and not by a zip library because archives of some lengths, written by PyTorch and read by everyone else,
//! are refused by the one that this workspace uses; and because a reader that knows nothing but stored entries cannot be
//! made to unpack a bomb.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

use super::torch::TorchError;

/// Longest directory that is read; an entry takes about 100 bytes.
const MAX_DIRECTORY_BYTES: u64 = 16 << 20;
const END: [u8; 4] = *b"PK\x05\x06";
const END_BYTES: u64 = 22;
const LARGE_END: [u8; 4] = *b"PK\x06\x06";
const LARGE_END_BYTES: u64 = 56;
const LOCATOR: [u8; 4] = *b"PK\x06\x07";
const LOCATOR_BYTES: u64 = 20;
const ENTRY: [u8; 4] = *b"PK\x01\x02";
const ENTRY_BYTES: usize = 46;
const LOCAL: [u8; 4] = *b"PK\x03\x04";
const LOCAL_BYTES: u64 = 30;

/// An open archive whose directory has been read.
pub(super) struct Archive {
    file: File,
    length: u64,
    entries: BTreeMap<String, Entry>,
}

struct Entry {
    /// Where its local header begins.
    offset: u64,
    size: u64,
    checksum: u32,
    stored: bool,
}

impl Archive {
    /// Opens an archive and reads its directory.
    pub(super) fn open(path: &Path) -> Result<Archive, TorchError> {
        let mut file = File::open(path)?;
        let length = file.metadata()?.len();
        let (start, size) = find_directory(&mut file, length)?;
        let end = start.checked_add(size).filter(|&end| end <= length);
        if end.is_none() || size > MAX_DIRECTORY_BYTES {
            return damaged("the directory is not within the file, or is larger than 16 MiB");
        }
        let directory = read_at(&mut file, start, size)?;
        let mut entries = BTreeMap::new();
        let mut rest = directory.as_slice();
        while !rest.is_empty() {
            let (name, entry, after) = parse_entry(rest)?;
            if entries.insert(name, entry).is_some() {
                return damaged("a name occurs twice in the directory");
            }
            rest = after;
        }
        Ok(Archive { file, length, entries })
    }

    /// Names of the entries, sorted.
    pub(super) fn names(&self) -> impl Iterator<Item = &str> {
        self.entries.keys().map(String::as_str)
    }

    /// Whether there is an entry of this name.
    pub(super) fn contains(&self, name: &str) -> bool {
        self.entries.contains_key(name)
    }

    /// Reads an entry whose size lies in `sizes`, and checks its sum.
    pub(super) fn read(
        &mut self,
        name: &str,
        sizes: std::ops::RangeInclusive<u64>,
    ) -> Result<Vec<u8>, TorchError> {
        let missing = || TorchError::Missing { name: name.to_owned() };
        let entry = self.entries.get(name).ok_or_else(missing)?;
        if !entry.stored {
            return Err(TorchError::Compressed { name: name.to_owned() });
        }
        let size = |expected| TorchError::Size { name: name.to_owned(), expected, got: entry.size };
        if !sizes.contains(&entry.size) {
            return Err(size(*sizes.end()));
        }
        if entry.offset.checked_add(LOCAL_BYTES).is_none_or(|end| end > self.length) {
            return damaged("an entry begins beyond the file");
        }
        let local = read_at(&mut self.file, entry.offset, LOCAL_BYTES)?;
        if !local.starts_with(&LOCAL) {
            return damaged("an entry does not begin with its header");
        }
        let start =
            entry.offset + LOCAL_BYTES + u64::from(u16_at(&local, 26)) + u64::from(u16_at(&local, 28));
        if start.checked_add(entry.size).is_none_or(|end| end > self.length) {
            return Err(size(self.length.saturating_sub(start)));
        }
        let bytes = read_at(&mut self.file, start, entry.size)?;
        if crc32fast::hash(&bytes) != entry.checksum {
            return Err(TorchError::Checksum { name: name.to_owned() });
        }
        Ok(bytes)
    }
}

fn damaged<T>(message: &'static str) -> Result<T, TorchError> {
    Err(TorchError::Archive { message })
}

/// Reads `size` bytes that are known to be within the file.
fn read_at(file: &mut File, start: u64, size: u64) -> Result<Vec<u8>, TorchError> {
    let mut bytes = vec![0; size as usize];
    file.seek(SeekFrom::Start(start))?;
    file.read_exact(&mut bytes)?;
    Ok(bytes)
}

/// Returns where the directory begins and how long it is.
fn find_directory(file: &mut File, length: u64) -> Result<(u64, u64), TorchError> {
    // The record at the end may be followed by a comment of up to 65535 bytes.
    let tail_bytes = length.min(END_BYTES + 0xffff);
    let tail = read_at(file, length - tail_bytes, tail_bytes)?;
    let is_end = |at: &usize| {
        let record = &tail[*at..];
        record.starts_with(&END)
            && record.len() >= END_BYTES as usize
            && usize::from(u16_at(record, 20)) == record.len() - END_BYTES as usize
    };
    let Some(at) = (0..tail.len()).rev().find(is_end) else {
        return damaged("no directory at the end");
    };
    let record = &tail[at..];
    let end = length - tail_bytes + at as u64;
    if let Some(start) = end.checked_sub(LOCATOR_BYTES) {
        let locator = read_at(file, start, LOCATOR_BYTES)?;
        if locator.starts_with(&LOCATOR) {
            return find_large_directory(file, u64_at(&locator, 8), start);
        }
    }
    Ok((u32_at(record, 16).into(), u32_at(record, 12).into()))
}

/// The same from the record for large files at `start`, which must end before `limit`.
fn find_large_directory(file: &mut File, start: u64, limit: u64) -> Result<(u64, u64), TorchError> {
    if start.checked_add(LARGE_END_BYTES).is_none_or(|end| end > limit) {
        return damaged("the record for large files is not within the file");
    }
    let record = read_at(file, start, LARGE_END_BYTES)?;
    if !record.starts_with(&LARGE_END) {
        return damaged("no record for large files where one must be");
    }
    Ok((u64_at(&record, 48), u64_at(&record, 40)))
}

/// Takes one entry off a directory; returns its name and what follows it.
fn parse_entry(directory: &[u8]) -> Result<(String, Entry, &[u8]), TorchError> {
    if directory.len() < ENTRY_BYTES || !directory.starts_with(&ENTRY) {
        return damaged("the directory is cut off");
    }
    let length = |at| usize::from(u16_at(directory, at));
    let (name, extra, comment) = (length(28), length(30), length(32));
    let Some(rest) = directory.get(ENTRY_BYTES + name + extra + comment..) else {
        return damaged("the directory is cut off");
    };
    let Ok(text) = std::str::from_utf8(&directory[ENTRY_BYTES..ENTRY_BYTES + name]) else {
        return damaged("a name is not UTF-8");
    };
    let extra = &directory[ENTRY_BYTES + name..ENTRY_BYTES + name + extra];
    let (packed, size, offset) = (u32_at(directory, 20), u32_at(directory, 24), u32_at(directory, 42));
    let [size, packed, offset] = widen(extra, [size, packed, offset])?;
    let stored = u16_at(directory, 10) == 0 && size == packed;
    let entry = Entry { offset, size, checksum: u32_at(directory, 16), stored };
    Ok((text.to_owned(), entry, rest))
}

/// Replaces numbers that are all ones by those of the extra field for large files, in its order.
fn widen(mut extra: &[u8], narrow: [u32; 3]) -> Result<[u64; 3], TorchError> {
    let mut wide: &[u8] = &[];
    while extra.len() >= 4 {
        let (tag, length) = (u16_at(extra, 0), usize::from(u16_at(extra, 2)));
        let Some(field) = extra.get(4..4 + length) else { break };
        if tag == 1 {
            wide = field;
        }
        extra = &extra[4 + length..];
    }
    let mut numbers = [0; 3];
    for (number, narrow) in numbers.iter_mut().zip(narrow) {
        *number = narrow.into();
        if narrow == u32::MAX {
            let Some((head, rest)) = wide.split_at_checked(8) else {
                return damaged("a large entry does not state its size");
            };
            (*number, wide) = (u64_at(head, 0), rest);
        }
    }
    Ok(numbers)
}

// The callers have checked that the bytes are there.
fn u16_at(bytes: &[u8], at: usize) -> u16 {
    u16::from_le_bytes([bytes[at], bytes[at + 1]])
}

fn u32_at(bytes: &[u8], at: usize) -> u32 {
    u32::from(u16_at(bytes, at)) | u32::from(u16_at(bytes, at + 2)) << 16
}

fn u64_at(bytes: &[u8], at: usize) -> u64 {
    u64::from(u32_at(bytes, at)) | u64::from(u32_at(bytes, at + 4)) << 32
}
