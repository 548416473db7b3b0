//! `pipeline.json`: which steps were done, of what, and by which command.

use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

/// Format of the ledger this build reads and writes.
const VERSION: u32 = 1;
/// A ledger is small; a file above this size is not one.
const MAX_BYTES: u64 = 1 << 20;

/// What a folder of results was made by.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ledger {
    version: u32,
    /// Steps in the order they were first run.
    pub steps: Vec<LedgerEntry>,
}

/// One step that was begun.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LedgerEntry {
    /// Name of the step.
    pub name: String,
    /// Hash of all that the step reads, as hexadecimal digits.
    pub key: String,
    /// Whether it ran to its end.
    pub is_done: bool,
    /// Exit code of a step that is done: 0, or 3 with a warning.
    pub exit: u8,
    /// Wall time of the step, seconds.
    pub seconds: f64,
    /// The command line that repeats it.
    pub command: String,
}

/// Why a ledger cannot be read or written.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LedgerError {
    /// The file cannot be read or written.
    #[error("{path}")]
    Io {
        /// The ledger.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The file is not a ledger.
    #[error("{path}: not a ledger of a pipeline: {detail}")]
    Foreign {
        /// The ledger.
        path: PathBuf,
        /// What is wrong with it.
        detail: String,
    },
}

impl Default for Ledger {
    fn default() -> Self {
        Ledger { version: VERSION, steps: Vec::new() }
    }
}

impl Ledger {
    /// Reads the ledger at this path; a missing file is an empty ledger.
    ///
    /// # Errors
    ///
    /// The file cannot be read, is too large, is not a ledger, or is one of another version.
    pub fn load(path: &Path) -> Result<Ledger, LedgerError> {
        let foreign = |detail: String| LedgerError::Foreign { path: path.to_owned(), detail };
        let length = match std::fs::metadata(path) {
            Ok(metadata) => metadata.len(),
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Ledger::default()),
            Err(source) => return Err(LedgerError::Io { path: path.to_owned(), source }),
        };
        if length > MAX_BYTES {
            return Err(foreign(format!("expected at most {MAX_BYTES} bytes, got {length}")));
        }
        let text = std::fs::read_to_string(path)
            .map_err(|source| LedgerError::Io { path: path.to_owned(), source })?;
        let ledger: Ledger = serde_json::from_str(&text).map_err(|error| foreign(error.to_string()))?;
        if ledger.version != VERSION {
            return Err(foreign(format!("expected version {VERSION}, got {}", ledger.version)));
        }
        Ok(ledger)
    }

    /// Writes the ledger, whole or not at all.
    ///
    /// # Errors
    ///
    /// The file cannot be written.
    pub fn save(&self, path: &Path) -> Result<(), LedgerError> {
        let io = |source| LedgerError::Io { path: path.to_owned(), source };
        let text = serde_json::to_string_pretty(self).expect("a ledger has no map keys but text");
        let part = path.with_extension("json.part");
        std::fs::write(&part, text + "\n").map_err(io)?;
        std::fs::rename(&part, path).map_err(io)
    }

    /// Returns the entry of a step.
    pub fn entry(&self, name: &str) -> Option<&LedgerEntry> {
        self.steps.iter().find(|entry| entry.name == name)
    }

    /// Puts an entry in the place of the one with its name, or at the end.
    pub fn put(&mut self, entry: LedgerEntry) {
        match self.steps.iter_mut().find(|other| other.name == entry.name) {
            Some(other) => *other = entry,
            None => self.steps.push(entry),
        }
    }
}
