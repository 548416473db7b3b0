//! Positional reads from a file or from memory.

use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;

use bytes::Bytes;

/// The bytes of a log; reads never move a shared position, so that many threads read at once.
#[derive(Debug)]
pub(crate) enum Source {
    /// An open file and its length when it was opened.
    File { file: File, length: u64 },
    /// Bytes in memory.
    Memory(Bytes),
}

impl Source {
    pub(crate) fn len(&self) -> u64 {
        match self {
            Self::File { length, .. } => *length,
            Self::Memory(bytes) => bytes.len() as u64,
        }
    }

    /// Returns exactly `length` bytes; the caller has capped `length`.
    pub(crate) fn read(&self, offset: u64, length: usize) -> io::Result<Bytes> {
        match self {
            Self::File { file, .. } => {
                let mut buffer = vec![0; length];
                file.read_exact_at(&mut buffer, offset)?;
                Ok(Bytes::from(buffer))
            }
            Self::Memory(bytes) => memory_range(bytes, offset, length).map(|range| bytes.slice(range)),
        }
    }

    /// Reads exactly `buffer.len()` bytes into `buffer`.
    pub(crate) fn read_into(&self, offset: u64, buffer: &mut [u8]) -> io::Result<()> {
        match self {
            Self::File { file, .. } => file.read_exact_at(buffer, offset),
            Self::Memory(bytes) => {
                let range = memory_range(bytes, offset, buffer.len())?;
                buffer.copy_from_slice(&bytes[range]);
                Ok(())
            }
        }
    }
}

fn memory_range(bytes: &Bytes, offset: u64, length: usize) -> io::Result<std::ops::Range<usize>> {
    let start = usize::try_from(offset).ok();
    let end = start.and_then(|start| start.checked_add(length)).filter(|&end| end <= bytes.len());
    match (start, end) {
        (Some(start), Some(end)) => Ok(start..end),
        _ => Err(io::ErrorKind::UnexpectedEof.into()),
    }
}

/// The smallest read of a [`Window`].
const WINDOW_MIN: u64 = 4 << 10;
/// The largest read of a [`Window`].
const WINDOW_MAX: u64 = 1 << 20;

/// A view that slides over a source: small reads after a jump, larger ones while it goes on in sequence.
#[derive(Debug)]
pub(crate) struct Window<'a> {
    source: &'a Source,
    start: u64,
    /// The buffer, of which the first `n_valid` bytes are the source's.
    bytes: Vec<u8>,
    n_valid: usize,
    next_length: u64,
}

impl<'a> Window<'a> {
    pub(crate) fn new(source: &'a Source) -> Self {
        Self { source, start: 0, bytes: Vec::new(), n_valid: 0, next_length: WINDOW_MIN }
    }

    /// Returns `length` bytes at `offset`, or fewer when the source ends before; the caller has capped `length`.
    pub(crate) fn peek(&mut self, offset: u64, length: u64) -> io::Result<&[u8]> {
        let length = length.min(self.source.len().saturating_sub(offset));
        if length == 0 {
            return Ok(&[]);
        }
        let end = self.start + self.n_valid as u64;
        if offset < self.start || offset + length > end {
            let in_sequence = offset >= self.start && offset <= end;
            self.next_length = if in_sequence { (self.next_length * 2).min(WINDOW_MAX) } else { WINDOW_MIN };
            let wanted = length.max(self.next_length).min(self.source.len().saturating_sub(offset));
            let wanted = usize::try_from(wanted).map_err(io::Error::other)?;
            if self.bytes.len() < wanted {
                self.bytes.resize(wanted, 0);
            }
            self.n_valid = 0;
            self.source.read_into(offset, &mut self.bytes[..wanted])?;
            (self.start, self.n_valid) = (offset, wanted);
        }
        let from = usize::try_from(offset - self.start).map_err(io::Error::other)?;
        let until = from + usize::try_from(length).map_err(io::Error::other)?;
        Ok(&self.bytes[from..until.min(self.n_valid)])
    }
}
