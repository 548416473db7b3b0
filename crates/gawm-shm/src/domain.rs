//! The pair (service, loader): its own iceoryx2 world, so that all of it can be removed.

use std::fs;
use std::path::{Path, PathBuf};

use iceoryx2::prelude::{
    Config, FileName, LogLevel, Node, NodeBuilder, Path as IpcPath, SemanticString, SignalHandlingMode,
    ipc_threadsafe, set_log_level,
};

use crate::error::ShmError;
use crate::lock;
use crate::place::SHM;

/// The flavour of iceoryx2 in use: between processes, ports may change threads.
pub(crate) type Ipc = ipc_threadsafe::Service;

/// Longest ready file that is read.
const MAX_TOKEN_BYTES: usize = 64;

/// The files of one loader of one service.
#[derive(Debug, Clone)]
pub(crate) struct Domain {
    pub(crate) service: String,
    pub(crate) loader: u32,
    folder: PathBuf,
    prefix: String,
}

/// What a sweep removed from `/dev/shm`.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Swept {
    pub(crate) files: u64,
    pub(crate) bytes: u64,
}

impl Swept {
    pub(crate) fn add(&mut self, other: Swept) {
        self.files += other.files;
        self.bytes += other.bytes;
    }
}

/// Returns the number in the name of a loader's lock file.
pub(crate) fn loader_of_lock(file: &str) -> Option<u32> {
    file.strip_prefix("loader-")?.strip_suffix(".lock")?.parse().ok()
}

impl Domain {
    pub(crate) fn new(service: &str, loader: u32, folder: &Path, prefix: &str) -> Domain {
        let prefix = format!("{prefix}{loader}_");
        Domain { service: service.to_owned(), loader, folder: folder.to_owned(), prefix }
    }

    /// Returns the lock that the loader holds while it lives.
    pub(crate) fn lock_path(&self) -> PathBuf {
        self.folder.join(format!("loader-{}.lock", self.loader))
    }

    fn ready_path(&self) -> PathBuf {
        self.folder.join(format!("loader-{}.ready", self.loader))
    }

    fn root(&self) -> PathBuf {
        self.folder.join(format!("loader-{}", self.loader))
    }

    /// Returns the beginning of the names of its files in `/dev/shm`.
    pub(crate) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Says that the trainer's side is open under this token.
    pub(crate) fn write_ready(&self, token: &str) -> Result<(), ShmError> {
        let path = self.ready_path();
        let unfinished = path.with_extension("tmp");
        fs::write(&unfinished, token).map_err(ShmError::io("write", &unfinished))?;
        fs::rename(&unfinished, &path).map_err(ShmError::io("rename", &path))
    }

    /// Returns the token of the trainer's side, if it is open.
    pub(crate) fn read_ready(&self) -> Option<String> {
        let token = fs::read_to_string(self.ready_path()).ok()?;
        let is_token = (1..=MAX_TOKEN_BYTES).contains(&token.len())
            && token.bytes().all(|c| c.is_ascii_alphanumeric() || c == b'-');
        is_token.then_some(token)
    }

    /// Says that the trainer's side is closed; a loader that is attached leaves.
    pub(crate) fn remove_ready(&self) -> Result<(), ShmError> {
        remove_if_there(&self.ready_path(), |path| fs::remove_file(path))
    }

    /// Removes every file of the domain. Only for who holds the loader's lock, when the trainer has not opened it.
    pub(crate) fn sweep(&self) -> Result<Swept, ShmError> {
        self.remove_ready()?;
        remove_if_there(&self.root(), |path| fs::remove_dir_all(path))?;
        sweep_files(|file| file.starts_with(&self.prefix))
    }

    /// Creates a node in the domain.
    pub(crate) fn node(&self) -> Result<Node<Ipc>, ShmError> {
        // What iceoryx2 reports is in the errors that it returns; on the console it would only be noise.
        set_log_level(LogLevel::Fatal);
        let refused = |reason: &dyn std::fmt::Debug| {
            ShmError::transport(&self.service, "use the folder for shared memory")(reason)
        };
        let root = self.root();
        let mut config = Config::default();
        let path = IpcPath::new(root.to_string_lossy().as_bytes()).map_err(|e| refused(&e))?;
        config.global.set_root_path(&path);
        config.global.prefix = FileName::new(self.prefix.as_bytes()).map_err(|e| refused(&e))?;
        // The two processes of a domain know of each other's end by locks, and sweep: iceoryx2's own search for dead
        // nodes would only race with that.
        config.global.node.cleanup_dead_nodes_on_creation = false;
        config.global.node.cleanup_dead_nodes_on_destruction = false;
        config.global.service.cleanup_dead_nodes_on_open = false;
        NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| ShmError::transport(&self.service, "create a node")(&e))
    }

    /// Returns whether the loader lives.
    pub(crate) fn is_loader_alive(&self) -> bool {
        lock::is_held(&self.lock_path())
    }
}

/// Removes the files in `/dev/shm` whose name is wanted.
pub(crate) fn sweep_files(is_wanted: impl Fn(&str) -> bool) -> Result<Swept, ShmError> {
    let mut swept = Swept::default();
    for (path, bytes) in shm_files(is_wanted)? {
        remove_if_there(&path, |path| fs::remove_file(path))?;
        swept.add(Swept { files: 1, bytes });
    }
    Ok(swept)
}

/// Lists the files in `/dev/shm` whose name is wanted, with their lengths.
pub(crate) fn shm_files(is_wanted: impl Fn(&str) -> bool) -> Result<Vec<(PathBuf, u64)>, ShmError> {
    let shm = Path::new(SHM);
    let mut files = Vec::new();
    for entry in fs::read_dir(shm).map_err(ShmError::io("list", shm))? {
        let entry = entry.map_err(ShmError::io("list", shm))?;
        if is_wanted(&entry.file_name().to_string_lossy()) {
            // A file that has just been removed by its owner has no length any more.
            files.push((entry.path(), entry.metadata().map_or(0, |m| m.len())));
        }
    }
    files.sort();
    Ok(files)
}

fn remove_if_there(path: &Path, remove: impl Fn(&Path) -> std::io::Result<()>) -> Result<(), ShmError> {
    match remove(path) {
        Err(error) if error.kind() != std::io::ErrorKind::NotFound => {
            Err(ShmError::io("remove", path)(error))
        }
        _ => Ok(()),
    }
}
