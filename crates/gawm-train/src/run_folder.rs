//! The folder of a run: what it was told, what it saw, what came out (`docs/formats/run.md`).

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};

use gawm_schema::batch::Hello;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::config::Config;

/// Version of the folder's layout.
pub const RUN_VERSION: u32 = 1;

/// Fields of `[train]` that may change when a run goes on: they decide no number of the training.
const FREE_FIELDS: [&str; 6] =
    ["device", "log_every", "checkpoint_every", "deadline_s", "collapse_std", "collapse_rank"];

/// The open folder of a run; one process has it at a time.
#[derive(Debug)]
pub struct RunFolder {
    path: PathBuf,
    /// Locked while the run lives.
    _lock: File,
}

/// `run.json`: where a run comes from.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct RunInfo {
    /// [`RUN_VERSION`].
    pub format_version: u32,
    /// Version of the program.
    pub program: String,
    /// Commit that the program was built from, or `unknown`.
    pub git: String,
    /// Content hashes of the datasets.
    pub dataset_hashes: Vec<String>,
    /// Hash of their schemas.
    pub schema_hash: String,
    /// Hash of everything that decides the batches.
    pub stream_hash: String,
    /// Trainable parameters of the model.
    pub parameters: usize,
    /// Type of the operands of matrix products.
    pub precision: String,
}

/// Why a folder cannot be the folder of a run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunFolderError {
    /// The file system refuses.
    #[error("cannot {verb} {path:?}: {cause}")]
    Io {
        /// What was tried.
        verb: &'static str,
        /// File or folder.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// Something is there already.
    #[error("the run folder {path:?} is not empty: expected a new or an empty folder")]
    Exists {
        /// The folder.
        path: PathBuf,
    },
    /// There is no run to go on with.
    #[error("no run in {path:?}: expected its {file}")]
    NoRun {
        /// The folder.
        path: PathBuf,
        /// The file that is missing.
        file: &'static str,
    },
    /// Another process trains in it.
    #[error("the run folder {path:?} is in use by another process")]
    InUse {
        /// The folder.
        path: PathBuf,
    },
    /// The configuration of the run differs from what is asked for.
    #[error("cannot resume {path:?}: expected {field} {expected} as in its config.toml, got {got}")]
    ConfigDiffers {
        /// The folder.
        path: PathBuf,
        /// Path of the first field that differs.
        field: String,
        /// Its value in the run.
        expected: String,
        /// The value asked for.
        got: String,
    },
    /// A file of the run cannot be understood.
    #[error("{path:?}: {message}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
}

impl RunFolder {
    /// Makes the folder of a new run. A folder in which a start failed before its first step is new.
    ///
    /// # Errors
    ///
    /// - [`RunFolderError::Exists`], [`RunFolderError::InUse`], [`RunFolderError::Io`].
    pub fn create(path: &Path, config: &Config) -> Result<RunFolder, RunFolderError> {
        fs::create_dir_all(path).map_err(io("make", path))?;
        let mut entries = path.read_dir().map_err(io("list", path))?.filter_map(Result::ok);
        if !entries.all(|entry| is_of_no_run(&entry)) {
            return Err(RunFolderError::Exists { path: path.to_owned() });
        }
        let folder = RunFolder::lock(path)?;
        folder.prepare()?;
        folder.write("config.toml", config.to_toml().as_bytes())?;
        Ok(folder)
    }

    /// Opens the folder of a run that goes on; its configuration must be the one asked for.
    ///
    /// # Errors
    ///
    /// - [`RunFolderError::NoRun`], [`RunFolderError::InUse`], [`RunFolderError::ConfigDiffers`],
    ///   [`RunFolderError::Io`].
    pub fn resume(path: &Path, config: &Config) -> Result<RunFolder, RunFolderError> {
        let file = path.join("config.toml");
        if !file.exists() {
            return Err(RunFolderError::NoRun { path: path.to_owned(), file: "config.toml" });
        }
        let folder = RunFolder::lock(path)?;
        let syntax = |message: String| RunFolderError::Syntax { path: file.clone(), message };
        let text = fs::read_to_string(&file).map_err(io("read", &file))?;
        let old: toml::Table = text.parse().map_err(|error: toml::de::Error| syntax(error.to_string()))?;
        let new: toml::Table =
            config.to_toml().parse().map_err(|error: toml::de::Error| syntax(error.to_string()))?;
        for section in ["model", "objectives", "train"] {
            let (old, new) = (flatten(section, old.get(section)), flatten(section, new.get(section)));
            let differs = |field: &&String| {
                let is_free = FREE_FIELDS.iter().any(|free| **field == format!("train.{free}"));
                !is_free && old.get(*field) != new.get(*field)
            };
            if let Some(field) = old.keys().chain(new.keys()).find(differs) {
                let show = |value: Option<&String>| value.map_or("nothing".to_owned(), Clone::clone);
                return Err(RunFolderError::ConfigDiffers {
                    path: path.to_owned(),
                    field: field.clone(),
                    expected: show(old.get(field)),
                    got: show(new.get(field)),
                });
            }
        }
        folder.prepare()?;
        folder.write("config.toml", config.to_toml().as_bytes())?;
        Ok(folder)
    }

    fn lock(path: &Path) -> Result<RunFolder, RunFolderError> {
        let file = path.join("lock");
        let lock = File::options().create(true).append(true).open(&file).map_err(io("open", &file))?;
        match rustix::fs::flock(&lock, rustix::fs::FlockOperation::NonBlockingLockExclusive) {
            Ok(()) => Ok(RunFolder { path: path.to_owned(), _lock: lock }),
            Err(rustix::io::Errno::WOULDBLOCK) => Err(RunFolderError::InUse { path: path.to_owned() }),
            Err(error) => Err(io("lock", &file)(error.into())),
        }
    }

    /// Makes the folders inside and removes what a killed process left half written.
    fn prepare(&self) -> Result<(), RunFolderError> {
        let checkpoints = self.path.join("checkpoints");
        fs::create_dir_all(&checkpoints).map_err(io("make", &checkpoints))?;
        for folder in [&self.path, &checkpoints] {
            for entry in folder.read_dir().map_err(io("list", folder))? {
                let path = entry.map_err(io("list", folder))?.path();
                let name = path.file_name().unwrap_or_default().to_string_lossy();
                if name.contains(".tmp-") || name.ends_with(".tmp") {
                    fs::remove_file(&path).map_err(io("remove", &path))?;
                }
            }
        }
        Ok(())
    }

    /// The folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The resolved configuration.
    pub fn config(&self) -> PathBuf {
        self.path.join("config.toml")
    }

    /// The numbers of the run.
    pub fn metrics(&self) -> PathBuf {
        self.path.join("metrics.jsonl")
    }

    /// The checkpoint to go on from.
    pub fn last(&self) -> PathBuf {
        self.path.join("checkpoints/last.safetensors")
    }

    /// The checkpoint with the best validation.
    pub fn best(&self) -> PathBuf {
        self.path.join("checkpoints/best.safetensors")
    }

    /// The event files, one folder per curve family: `model`, `constant`, `identity`.
    pub fn events(&self, curves: &str) -> PathBuf {
        self.path.join("tensorboard").join(curves)
    }

    /// Keeps what the loaders said: schema, frozen standardisation, hashes.
    ///
    /// # Errors
    ///
    /// - [`RunFolderError::Io`].
    pub fn write_hello(&self, hello: &Hello) -> Result<(), RunFolderError> {
        self.write("hello.json", (hello.to_json() + "\n").as_bytes())
    }

    /// Keeps where the run comes from.
    ///
    /// # Errors
    ///
    /// - [`RunFolderError::Io`].
    pub fn write_info(&self, info: &RunInfo) -> Result<(), RunFolderError> {
        let text = serde_json::to_string_pretty(info).expect("a struct of numbers and texts becomes JSON");
        self.write("run.json", (text + "\n").as_bytes())
    }

    /// Keeps the summary.
    ///
    /// # Errors
    ///
    /// - [`RunFolderError::Io`].
    pub fn write_summary(&self, text: &str) -> Result<(), RunFolderError> {
        self.write("summary.txt", text.as_bytes())
    }

    /// Writes a file of the folder: temporary name, sync, rename.
    fn write(&self, name: &str, bytes: &[u8]) -> Result<(), RunFolderError> {
        let path = self.path.join(name);
        let temporary = self.path.join(format!("{name}.tmp"));
        let mut file = File::create(&temporary).map_err(io("write", &temporary))?;
        file.write_all(bytes).and_then(|()| file.sync_all()).map_err(io("write", &temporary))?;
        fs::rename(&temporary, &path).map_err(io("write", &path))
    }
}

/// Whether a start that ended before it saw data leaves this: nothing of a run is lost with it.
fn is_of_no_run(entry: &fs::DirEntry) -> bool {
    match entry.file_name().to_str() {
        Some("lock" | "config.toml" | "config.toml.tmp") => true,
        Some("checkpoints") => entry.path().read_dir().is_ok_and(|mut files| files.next().is_none()),
        _ => false,
    }
}

impl RunInfo {
    /// Describes a run.
    pub fn new(hello: &Hello, parameters: usize, precision: gawm_model::Precision) -> RunInfo {
        RunInfo {
            format_version: RUN_VERSION,
            program: format!("gawm-train {}", env!("CARGO_PKG_VERSION")),
            git: env!("GAWM_GIT").to_owned(),
            dataset_hashes: hello.datasets.iter().map(|dataset| dataset.content_hash.to_string()).collect(),
            schema_hash: hello.schema_hash.to_string(),
            stream_hash: hello.stream_hash().to_string(),
            parameters,
            precision: format!("{precision:?}").to_lowercase(),
        }
    }
}

fn io(verb: &'static str, path: &Path) -> impl FnOnce(std::io::Error) -> RunFolderError {
    let path = path.to_owned();
    move |cause| RunFolderError::Io { verb, path, cause }
}

/// Lists the leaves of a table by path.
fn flatten(name: &str, value: Option<&toml::Value>) -> std::collections::BTreeMap<String, String> {
    match value {
        None => Default::default(),
        Some(toml::Value::Table(table)) => {
            let inner = |(key, value): (&String, _)| flatten(&format!("{name}.{key}"), Some(value));
            table.iter().flat_map(inner).collect()
        }
        Some(value) => [(name.to_owned(), value.to_string())].into(),
    }
}
