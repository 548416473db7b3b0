//! Giving up a run that has made nothing.

use std::fs;
use std::io;
use std::path::Path;

use super::DatasetWriter;
use crate::error::WriteError;
use crate::layout::{ATTACHMENTS, CALIBRATION};

impl DatasetWriter {
    /// Gives up a run that began in an absent or empty folder and has ended no recording with episodes: removes what
    /// it wrote, and nothing else. The folder itself goes if the run made it.
    ///
    /// Returns whether it did so. What any other run has written stays for [`WriteMode::Resume`](crate::WriteMode).
    ///
    /// # Errors
    /// - files cannot be listed or removed.
    pub fn discard(mut self) -> Result<bool, WriteError> {
        if !self.is_first || self.meta.recordings.iter().any(|recording| recording.episodes > 0) {
            return Ok(false);
        }
        // Closes its file.
        self.recording = None;
        self.meta.recordings.clear();
        self.remove_leftovers()?;
        // Last of the files: until then the run can be resumed.
        self.journal.remove()?;
        for folder in ["data/chunk-000", "data", ATTACHMENTS, CALIBRATION, "meta", "gawm"] {
            remove_if_empty(&self.dir.join(folder))?;
        }
        if self.has_made_folder {
            remove_if_empty(&self.dir)?;
        }
        Ok(true)
    }
}

/// Removes a folder unless it holds something.
fn remove_if_empty(folder: &Path) -> Result<(), WriteError> {
    match fs::remove_dir(folder) {
        Err(error) if !matches!(error.kind(), io::ErrorKind::NotFound | io::ErrorKind::DirectoryNotEmpty) => {
            Err(WriteError::io("remove", folder)(error))
        }
        _ => Ok(()),
    }
}
