//! What can go wrong between loaders and a trainer.

use std::path::{Path, PathBuf};
use std::time::Duration;

use gawm_schema::batch::{BatchError, HelloError};

/// Why a batch could not be handed over.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ShmError {
    /// The name of the service cannot be a folder.
    #[error("unusable service name: expected 1 to 64 letters, digits, '-', '_' or '.', got {name:?}")]
    BadName {
        /// The name.
        name: String,
    },
    /// A loader asks for an impossible number of slots.
    #[error("expected 1 to {} slots, got {got}", crate::MAX_SLOTS)]
    Slots {
        /// The number.
        got: usize,
    },
    /// Another trainer has the name.
    #[error("service name {name:?} is in use by another trainer (process {process})")]
    NameInUse {
        /// The name.
        name: String,
        /// Process id of the holder, `unknown` if it did not say.
        process: String,
    },
    /// Another loader has the number.
    #[error("loader {loader} of service {name:?} is already running (process {process})")]
    LoaderInUse {
        /// The name of the service.
        name: String,
        /// The number of the loader.
        loader: u32,
        /// Process id of the holder, `unknown` if it did not say.
        process: String,
    },
    /// No trainer has opened the service.
    #[error("no trainer serves {name:?}: waited {} ms", waited.as_millis())]
    NoTrainer {
        /// The name of the service.
        name: String,
        /// How long was waited.
        waited: Duration,
    },
    /// The trainer is gone, or has given this loader up.
    #[error("the trainer of service {name:?} is gone")]
    TrainerGone {
        /// The name of the service.
        name: String,
    },
    /// The loader is gone.
    #[error("loader {loader} of service {name:?} is gone")]
    LoaderGone {
        /// The name of the service.
        name: String,
        /// The number of the loader.
        loader: u32,
    },
    /// A wait has reached its deadline.
    #[error("no {what} within {} ms", waited.as_millis())]
    Timeout {
        /// What was waited for.
        what: &'static str,
        /// How long.
        waited: Duration,
    },
    /// The slots do not fit into shared memory.
    #[error("too little shared memory in {}: expected {needed} bytes for {slots} slots, got {available}", path.display())]
    NoRoom {
        /// Bytes that the slots of this loader need.
        needed: u64,
        /// Bytes that are free.
        available: u64,
        /// Number of slots.
        slots: usize,
        /// The file system.
        path: PathBuf,
    },
    /// The hello message cannot be used.
    #[error("loader {loader}: {source}")]
    Hello {
        /// The number of the loader.
        loader: u32,
        /// What is wrong with it.
        source: HelloError,
    },
    /// What came first is no hello message.
    #[error("loader {loader} is foreign or older: expected {expected}, got {got}")]
    Foreign {
        /// The number of the loader.
        loader: u32,
        /// What should have come.
        expected: String,
        /// What came.
        got: String,
    },
    /// A slot is not the batch that is expected.
    #[error("slot of loader {loader}: {source}")]
    Batch {
        /// The number of the loader.
        loader: u32,
        /// What is wrong with it.
        source: BatchError,
    },
    /// A slot has another place in the run than is due.
    #[error("slot of loader {loader} out of sequence: expected {field} {expected}, got {got}")]
    Sequence {
        /// The number of the loader.
        loader: u32,
        /// The field of the header.
        field: &'static str,
        /// The value that is due.
        expected: String,
        /// The value found.
        got: String,
    },
    /// iceoryx2 refused.
    #[error("shared memory of service {name:?}: cannot {operation}: {reason}")]
    Transport {
        /// The name of the service.
        name: String,
        /// What was tried.
        operation: &'static str,
        /// What it said.
        reason: String,
    },
    /// A file operation failed.
    #[error("cannot {operation} {}: {source}", path.display())]
    Io {
        /// What was tried.
        operation: &'static str,
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl ShmError {
    pub(crate) fn io(operation: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> ShmError {
        move |source| ShmError::Io { operation, path: path.to_owned(), source }
    }

    pub(crate) fn transport(
        name: &str,
        operation: &'static str,
    ) -> impl FnOnce(&dyn std::fmt::Debug) -> ShmError {
        move |reason| ShmError::Transport { name: name.to_owned(), operation, reason: format!("{reason:?}") }
    }

    /// Returns what a user can do about it.
    pub fn hint(&self) -> Option<String> {
        let hint = match self {
            ShmError::NameInUse { .. } => {
                "wait for that run to end, stop it, or give this run another service name".to_owned()
            }
            ShmError::LoaderInUse { .. } => {
                "each loader needs a number of its own below the number of loaders".to_owned()
            }
            ShmError::NoTrainer { .. } => "start the trainer first, with the same service name".to_owned(),
            ShmError::NoRoom { needed, path, .. } => format!(
                "make {} larger by at least {} MiB (mount -o remount,size=..., or --shm-size of a container), or \
                 lower the batch size, the image size, the slots or the number of loaders",
                path.display(),
                needed.div_ceil(1 << 20)
            ),
            ShmError::Foreign { .. } | ShmError::Hello { .. } => {
                "loader and trainer must be of the same version of gawm".to_owned()
            }
            _ => return None,
        };
        Some(hint)
    }
}
