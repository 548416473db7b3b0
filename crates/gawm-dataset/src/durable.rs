//! Files that are there whole or not at all, also after a power cut.

use std::fs::{self, File};
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::thread::JoinHandle;

/// Suffix of files that are being written.
pub(crate) const TEMPORARY: &str = ".tmp";

/// Bytes that are brought to the disk at once, before the end.
const EARLY_SYNC_BYTES: u64 = 16 << 20;

/// Where files are created; tests limit the space.
#[derive(Debug, Clone, Default)]
pub(crate) struct Disk {
    free_bytes: Option<Arc<AtomicU64>>,
}

/// A new file that counts against the space of its disk.
#[derive(Debug)]
pub(crate) struct DiskFile {
    file: File,
    disk: Disk,
    /// Bytes since the last early sync.
    unsynced_bytes: u64,
    /// Brings what was written so far to the disk, beside the work.
    early_sync: Option<JoinHandle<io::Result<()>>>,
}

impl Disk {
    /// Returns a disk that is full after so many bytes.
    #[cfg(test)]
    pub(crate) fn with_space(bytes: u64) -> Disk {
        Disk { free_bytes: Some(Arc::new(AtomicU64::new(bytes))) }
    }

    /// Creates or empties a file.
    pub(crate) fn create(&self, path: &Path) -> io::Result<DiskFile> {
        Ok(DiskFile { file: File::create(path)?, disk: self.clone(), unsynced_bytes: 0, early_sync: None })
    }

    /// Writes a whole file: temporary file, fsync, rename, fsync of the folder.
    pub(crate) fn write_whole(&self, path: &Path, bytes: &[u8]) -> io::Result<()> {
        let temporary = temporary(path);
        let mut file = self.create(&temporary)?;
        file.write_all(bytes)?;
        file.sync()?;
        fs::rename(&temporary, path)?;
        sync_parent(path)
    }
}

impl DiskFile {
    /// Begins to bring the bytes to the disk, so that less is left to wait for at the end. Does nothing while an
    /// earlier call is still at it, or when little was written since.
    ///
    /// # Errors
    /// - what an earlier call met: the system tells of a failed write once only.
    pub(crate) fn sync_early(&mut self) -> io::Result<()> {
        let is_running = self.early_sync.as_ref().is_some_and(|running| !running.is_finished());
        if is_running || self.unsynced_bytes < EARLY_SYNC_BYTES {
            return Ok(());
        }
        self.finish_early_sync()?;
        self.unsynced_bytes = 0;
        // Without another handle or thread all is left for the end.
        if let Ok(file) = self.file.try_clone() {
            let sync = move || file.sync_data();
            self.early_sync = std::thread::Builder::new().name("sync".to_owned()).spawn(sync).ok();
        }
        Ok(())
    }

    fn finish_early_sync(&mut self) -> io::Result<()> {
        match self.early_sync.take().map(JoinHandle::join) {
            Some(Ok(result)) => result,
            Some(Err(_)) => Err(io::Error::other("the thread that syncs the file has failed")),
            None => Ok(()),
        }
    }

    /// Waits until the bytes are on the disk.
    pub(crate) fn sync(&mut self) -> io::Result<()> {
        self.finish_early_sync()?;
        self.file.sync_all()
    }
}

impl Write for DiskFile {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if let Some(free) = &self.disk.free_bytes {
            let take = |free: u64| free.checked_sub(bytes.len() as u64);
            if free.fetch_update(Ordering::Relaxed, Ordering::Relaxed, take).is_err() {
                return Err(io::ErrorKind::StorageFull.into());
            }
        }
        let written = self.file.write(bytes)?;
        self.unsynced_bytes += written as u64;
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        self.file.flush()
    }
}

/// Returns the path with the suffix of files that are being written.
pub(crate) fn temporary(path: &Path) -> PathBuf {
    let mut name = path.as_os_str().to_owned();
    name.push(TEMPORARY);
    PathBuf::from(name)
}

/// Waits until the entries of the folder that holds `path` are on the disk.
pub(crate) fn sync_parent(path: &Path) -> io::Result<()> {
    path.parent().map_or(Ok(()), sync_folder)
}

/// Waits until the entries of a folder are on the disk.
pub(crate) fn sync_folder(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Removes a file; that it is not there is no error.
pub(crate) fn remove_file(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// Removes a folder with its content; that it is not there is no error.
pub(crate) fn remove_folder(path: &Path) -> io::Result<()> {
    match fs::remove_dir_all(path) {
        Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
        other => other,
    }
}

/// Returns whether an error says that no space is left, wherever in its chain of causes.
pub(crate) fn is_disk_full(error: &(dyn std::error::Error + 'static)) -> bool {
    let mut next = Some(error);
    while let Some(error) = next {
        if let Some(io) = error.downcast_ref::<io::Error>() {
            if matches!(io.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded) {
                return true;
            }
            if io.get_ref().is_some_and(|inner| is_disk_full(inner)) {
                return true;
            }
        }
        next = error.source();
    }
    false
}
