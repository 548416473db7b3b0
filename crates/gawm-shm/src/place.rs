//! Where locks and shared-memory files lie, and how everything that nobody uses is removed.

use std::fs::{self, DirBuilder};
use std::os::unix::fs::DirBuilderExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use gawm_schema::ContentHash;

use crate::domain::{self, Domain};
use crate::error::ShmError;
use crate::lock::{self, Lock};

/// Where Linux keeps POSIX shared memory.
pub(crate) const SHM: &str = "/dev/shm";
/// Beginning of all our files there.
const PREFIX: &str = "gawm_";
/// Name of the lock that a trainer holds.
const TRAINER_LOCK: &str = "trainer.lock";
/// How long removing waits for a process that is just asking who is alive.
const PATIENCE: Duration = Duration::from_millis(200);

/// A folder for the locks of services; services in different folders do not know of each other.
///
/// All processes of a run must use the same one. Shared memory itself always lies in `/dev/shm`, under names that begin
/// with `gawm_` and a hash of the folder.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    root: PathBuf,
}

/// What [`Place::clean`] found.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct CleanReport {
    /// Services of which a process is alive; they were left alone.
    pub alive: Vec<String>,
    /// Services that were removed.
    pub removed: Vec<String>,
    /// Files that were removed from `/dev/shm`.
    pub files: u64,
    /// Bytes that those files had.
    pub bytes: u64,
}

impl Place {
    /// Returns the default place of this user: `gawm-<uid>` in the folder for temporary files.
    pub fn of_user() -> Place {
        let uid = rustix::process::getuid().as_raw();
        Place { root: std::env::temp_dir().join(format!("gawm-{uid}")) }
    }

    /// Returns a place in a folder, which is created when it is needed.
    pub fn at(root: &Path) -> Place {
        Place { root: root.to_owned() }
    }

    /// Returns the folder.
    pub fn root(&self) -> &Path {
        &self.root
    }

    /// Removes everything that belongs to services of which no process is alive.
    ///
    /// # Errors
    /// [`ShmError::Io`] if a folder cannot be listed or a file not removed.
    pub fn clean(&self) -> Result<CleanReport, ShmError> {
        let mut report = CleanReport::default();
        for name in self.services()? {
            let service = self.service(&name)?;
            match service.clean()? {
                Some(swept) => {
                    report.files += swept.files;
                    report.bytes += swept.bytes;
                    report.removed.push(name);
                }
                None => report.alive.push(name),
            }
        }
        // Files of services whose folder is gone, say after /tmp was emptied.
        let known: Vec<String> = report.alive.iter().map(|name| self.prefix(name)).collect();
        let is_orphan = |file: &str| {
            file.starts_with(&self.place_prefix()) && !known.iter().any(|prefix| file.starts_with(prefix))
        };
        let swept = domain::sweep_files(is_orphan)?;
        report.files += swept.files;
        report.bytes += swept.bytes;
        Ok(report)
    }

    /// Returns the names of services that have a folder, sorted.
    fn services(&self) -> Result<Vec<String>, ShmError> {
        let mut names = Vec::new();
        let entries = match fs::read_dir(&self.root) {
            Ok(entries) => entries,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(names),
            Err(error) => return Err(ShmError::io("list", &self.root)(error)),
        };
        for entry in entries {
            let entry = entry.map_err(ShmError::io("list", &self.root))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            if is_name(&name) && entry.path().is_dir() {
                names.push(name);
            }
        }
        names.sort();
        Ok(names)
    }

    pub(crate) fn service(&self, name: &str) -> Result<ServicePlace, ShmError> {
        if !is_name(name) {
            return Err(ShmError::BadName { name: name.to_owned() });
        }
        Ok(ServicePlace { folder: self.root.join(name), prefix: self.prefix(name), name: name.to_owned() })
    }

    pub(crate) fn place_prefix(&self) -> String {
        // The folder as it is, however it was written.
        let root = fs::canonicalize(&self.root).unwrap_or_else(|_| self.root.clone());
        format!("{PREFIX}{}_", short_hash(root.to_string_lossy().as_bytes()))
    }

    fn prefix(&self, name: &str) -> String {
        format!("{}{}_", self.place_prefix(), short_hash(name.as_bytes()))
    }
}

/// The files of one service.
#[derive(Debug, Clone)]
pub(crate) struct ServicePlace {
    pub(crate) name: String,
    folder: PathBuf,
    prefix: String,
}

impl ServicePlace {
    /// Creates the folder, for this user only.
    pub(crate) fn create(&self) -> Result<(), ShmError> {
        let made = DirBuilder::new().recursive(true).mode(0o700).create(&self.folder);
        made.map_err(ShmError::io("create", &self.folder))
    }

    pub(crate) fn trainer_lock(&self) -> PathBuf {
        self.folder.join(TRAINER_LOCK)
    }

    pub(crate) fn domain(&self, loader: u32) -> Domain {
        Domain::new(&self.name, loader, &self.folder, &self.prefix)
    }

    /// Returns the numbers of loaders that left a lock file, sorted.
    pub(crate) fn loaders(&self) -> Result<Vec<u32>, ShmError> {
        let mut loaders = Vec::new();
        for entry in fs::read_dir(&self.folder).map_err(ShmError::io("list", &self.folder))? {
            let entry = entry.map_err(ShmError::io("list", &self.folder))?;
            let name = entry.file_name().to_string_lossy().into_owned();
            loaders.extend(domain::loader_of_lock(&name));
        }
        loaders.sort_unstable();
        Ok(loaders)
    }

    /// Removes the service if nobody is alive.
    fn clean(&self) -> Result<Option<domain::Swept>, ShmError> {
        let Some(trainer) = Lock::take_until(&self.trainer_lock(), Instant::now() + PATIENCE)? else {
            return Ok(None);
        };
        let mut swept = domain::Swept::default();
        let mut locks = Vec::new();
        for loader in self.loaders()? {
            let domain = self.domain(loader);
            match Lock::take_until(&domain.lock_path(), Instant::now() + PATIENCE)? {
                Some(lock) => {
                    swept.add(domain.sweep()?);
                    locks.push(lock);
                }
                None => return Ok(None),
            }
        }
        locks.into_iter().try_for_each(Lock::remove)?;
        self.forget(trainer)?;
        Ok(Some(swept))
    }

    /// Removes the trainer's lock and the folder, if nothing else is in it.
    pub(crate) fn forget(&self, trainer: Lock) -> Result<(), ShmError> {
        trainer.remove()?;
        match fs::remove_dir(&self.folder) {
            // A loader that waits for its trainer has just made its lock file.
            Err(error) if error.kind() != std::io::ErrorKind::DirectoryNotEmpty => {
                Err(ShmError::io("remove", &self.folder)(error))
            }
            _ => Ok(()),
        }
    }

    pub(crate) fn is_trainer_alive(&self) -> bool {
        lock::is_held(&self.trainer_lock())
    }
}

fn is_name(name: &str) -> bool {
    let is_allowed = |c: char| c.is_ascii_alphanumeric() || matches!(c, '-' | '_' | '.');
    (1..=64).contains(&name.len()) && name.chars().all(is_allowed) && !name.starts_with('.')
}

fn short_hash(bytes: &[u8]) -> String {
    ContentHash::of(bytes).to_string()[..8].to_owned()
}
