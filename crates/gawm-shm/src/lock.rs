//! Locks that end with the process that holds them.

use std::fs::{self, File, OpenOptions};
use std::io::{Seek, Write};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::Instant;

use rustix::fs::{FlockOperation, flock};
use rustix::io::Errno;

use crate::error::ShmError;
use crate::wait::Wait;

/// An exclusive lock on a file, held until it is dropped or the process ends, however it ends.
#[derive(Debug)]
pub(crate) struct Lock {
    file: File,
    path: PathBuf,
}

impl Lock {
    /// Takes the lock if it is free, and writes the process id into the file for error messages.
    pub(crate) fn try_take(path: &Path) -> Result<Option<Lock>, ShmError> {
        loop {
            let open = OpenOptions::new().create(true).truncate(false).read(true).write(true).open(path);
            let file = open.map_err(ShmError::io("open", path))?;
            match flock(&file, FlockOperation::NonBlockingLockExclusive) {
                Ok(()) => {}
                Err(Errno::WOULDBLOCK) => return Ok(None),
                Err(error) => return Err(ShmError::io("lock", path)(error.into())),
            }
            if !is_same_file(&file, path) {
                // Someone removed the file between opening and locking: this lock keeps nobody out.
                continue;
            }
            let mut lock = Lock { file, path: path.to_owned() };
            lock.note_process().map_err(ShmError::io("write", path))?;
            return Ok(Some(lock));
        }
    }

    /// Takes the lock, waiting for it until the deadline.
    pub(crate) fn take_until(path: &Path, deadline: Instant) -> Result<Option<Lock>, ShmError> {
        let mut wait = Wait::until(deadline);
        loop {
            if let Some(lock) = Lock::try_take(path)? {
                return Ok(Some(lock));
            }
            if !wait.again() {
                return Ok(None);
            }
        }
    }

    fn note_process(&mut self) -> std::io::Result<()> {
        self.file.set_len(0)?;
        self.file.rewind()?;
        write!(self.file, "{}", std::process::id())
    }

    /// Removes the file, then gives the lock up.
    pub(crate) fn remove(self) -> Result<(), ShmError> {
        fs::remove_file(&self.path).map_err(ShmError::io("remove", &self.path))
    }
}

/// Returns whether a living process holds the lock.
///
/// The question is asked by taking a shared lock for a moment; who wants the exclusive one must try more than once.
pub(crate) fn is_held(path: &Path) -> bool {
    let Ok(file) = File::open(path) else { return false };
    flock(&file, FlockOperation::NonBlockingLockShared) == Err(Errno::WOULDBLOCK)
}

/// Returns the process id that the holder wrote.
pub(crate) fn holder(path: &Path) -> String {
    let text = fs::read_to_string(path).unwrap_or_default();
    let is_number = !text.is_empty() && text.len() < 12 && text.bytes().all(|c| c.is_ascii_digit());
    if is_number { text } else { "unknown".to_owned() }
}

fn is_same_file(file: &File, path: &Path) -> bool {
    match (file.metadata(), fs::metadata(path)) {
        (Ok(a), Ok(b)) => (a.dev(), a.ino()) == (b.dev(), b.ino()),
        _ => false,
    }
}
