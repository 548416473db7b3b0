//! Positional reads of a file, bounded per read.

use std::fs::File;
use std::os::unix::fs::FileExt;

use hdf5_reader::error::{Error, Result};
use hdf5_reader::{Storage, StorageBuffer};

/// A file that is read by position, never mapped: a file cut while it is read gives an error, not a signal.
pub(crate) struct BoundedFile {
    file: File,
    len: u64,
    max_read_bytes: u64,
}

impl BoundedFile {
    /// Takes an open file; one read may return `max_read_bytes`.
    pub(crate) fn try_new(file: File, max_read_bytes: u64) -> std::io::Result<Self> {
        let len = file.metadata()?.len();
        Ok(Self { file, len, max_read_bytes })
    }
}

impl Storage for BoundedFile {
    fn len(&self) -> u64 {
        self.len
    }

    fn read_range(&self, offset: u64, len: usize) -> Result<StorageBuffer> {
        let needed = len as u64;
        if offset.checked_add(needed).is_none_or(|end| end > self.len) {
            let available = self.len.saturating_sub(offset);
            return Err(Error::UnexpectedEof { offset, needed, available });
        }
        if needed > self.max_read_bytes {
            return Err(Error::ResourceLimit(format!(
                "a read of {needed} bytes at offset {offset}, limit {}",
                self.max_read_bytes
            )));
        }
        let mut bytes = vec![0; len];
        self.file.read_exact_at(&mut bytes, offset)?;
        Ok(StorageBuffer::from_vec(bytes))
    }
}
