//! A training run as evaluation sees it: the model and the frozen facts about its data.

use std::path::{Path, PathBuf};

use gawm_model::{Device, Objectives, WorldModel, checkpoint};
use gawm_schema::batch::{Hello, HelloError, StandardisedDimInfo};
use thiserror::Error;

/// Largest text file of a run that is read.
const MAX_TEXT_BYTES: u64 = 64 << 20;

/// A run, loaded.
#[derive(Debug, Clone)]
pub struct Run {
    /// The folder.
    pub path: PathBuf,
    /// What was trained: the objective's preset (`sa-idm`, ...), or the folder's name.
    pub method: String,
    /// Seed of the training.
    pub seed: Option<u64>,
    /// The model.
    pub model: WorldModel,
    /// Which checkpoint it is: `best` or `last`.
    pub checkpoint: String,
    /// What the loaders said: standardisation, frameskip, cameras, hashes.
    pub hello: Hello,
}

/// Why a run cannot be used.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum RunError {
    /// A file is missing or unreadable.
    #[error("cannot read {path:?}: {cause}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// A file is too large to be what it should be.
    #[error("{path:?} is too large: expected at most {MAX_TEXT_BYTES} bytes, got {got}")]
    TooLarge {
        /// The file.
        path: PathBuf,
        /// Its size.
        got: u64,
    },
    /// `hello.json` is not usable.
    #[error("{path:?}: {cause}")]
    Hello {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: HelloError,
    },
    /// `config.toml` is not TOML.
    #[error("{path:?}: {message}")]
    Config {
        /// The file.
        path: PathBuf,
        /// What the parser said.
        message: String,
    },
    /// There is no checkpoint yet.
    #[error(
        "no checkpoint in {path:?}: expected checkpoints/best.safetensors or checkpoints/last.safetensors"
    )]
    NoCheckpoint {
        /// The run folder.
        path: PathBuf,
    },
    /// The checkpoint cannot be loaded.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::CheckpointError),
    /// The checkpoint was trained on data of another schema.
    #[error("the checkpoint is of another schema: expected {expected}, got {got} ({path:?})")]
    Schema {
        /// Schema hash in `hello.json` (or of the dataset).
        expected: String,
        /// Schema hash in the checkpoint (or in `hello.json`).
        got: String,
        /// The file that disagrees.
        path: PathBuf,
    },
    /// The checkpoint does not fit the data that the run says it had.
    #[error("{path:?} does not fit hello.json: expected {field} {expected}, got {got}")]
    Widths {
        /// The checkpoint.
        path: PathBuf,
        /// `action width` or `state width`.
        field: &'static str,
        /// What `hello.json` says.
        expected: usize,
        /// What the checkpoint has.
        got: usize,
    },
    /// Evaluation sees one camera only.
    #[error("evaluation sees one camera: expected 1 in hello.json, got {got}")]
    Cameras {
        /// Number of cameras.
        got: usize,
    },
    /// Model code failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Run {
    /// Loads a run folder: `hello.json`, `config.toml` (for its name) and the best checkpoint, else the last.
    ///
    /// # Errors
    /// - [`RunError`] for what is missing, damaged, or of another schema.
    pub fn open(path: &Path, device: &Device) -> Result<Run, RunError> {
        let hello_path = path.join("hello.json");
        let hello = Hello::from_json(&read(&hello_path)?)
            .map_err(|cause| RunError::Hello { path: hello_path, cause })?;
        if hello.cameras.len() != 1 {
            return Err(RunError::Cameras { got: hello.cameras.len() });
        }
        let config = read_config(&path.join("config.toml"))?;
        let found = ["best", "last"]
            .map(|name| (name, path.join(format!("checkpoints/{name}.safetensors"))))
            .into_iter()
            .find(|(_, file)| file.exists());
        let Some((name, file)) = found else { return Err(RunError::NoCheckpoint { path: path.to_owned() }) };
        let checkpoint = checkpoint::load(&file, device)?;
        check(&hello, &checkpoint, &file)?;
        let folder = path.file_name().map(|name| name.to_string_lossy().into_owned());
        let objectives = config.get("objectives").and_then(toml::Value::as_table).cloned();
        let objectives = objectives.and_then(|table| Objectives::from_table(table).ok());
        let preset = objectives.and_then(|objectives| objectives.preset_name()).map(str::to_owned);
        let seed = config.get("train").and_then(|table| table.get("seed")).and_then(toml::Value::as_integer);
        Ok(Run {
            path: path.to_owned(),
            method: preset.or(folder).unwrap_or_else(|| "run".to_owned()),
            seed: seed.and_then(|seed| u64::try_from(seed).ok()),
            model: checkpoint.model,
            checkpoint: name.to_owned(),
            hello,
        })
    }

    /// Returns the same run with untrained weights of a seed: a floor.
    ///
    /// # Errors
    /// candle failed.
    pub fn untrained(&self, seed: u64) -> Result<Run, RunError> {
        let device = self.model.parameters().iter().next().map_or(Device::Cpu, |(_, t)| t.device().clone());
        let model = WorldModel::new(self.model.architecture().clone(), seed, &device)?;
        Ok(Run { model, method: "untrained".to_owned(), ..self.clone() })
    }

    /// Returns mean and scale of each dim of an action.
    pub fn action_standardisation(&self) -> Vec<(f64, f64)> {
        self.hello.action.dims.iter().map(|dim| (dim.mean, dim.scale)).collect()
    }

    /// Returns (height, width) of the frames that the model was trained on.
    pub fn image_size(&self) -> (usize, usize) {
        (self.hello.shape.height, self.hello.shape.width)
    }
}

/// Standardises a row in place.
pub fn standardise(row: &mut [f64], dims: &[StandardisedDimInfo]) {
    for (value, dim) in row.iter_mut().zip(dims) {
        *value = (*value - dim.mean) / dim.scale;
    }
}

fn check(hello: &Hello, checkpoint: &checkpoint::Checkpoint, file: &Path) -> Result<(), RunError> {
    let expected = hello.schema_hash.to_string();
    if let Some(got) = checkpoint.about.schema_hash.as_ref().filter(|got| **got != expected) {
        return Err(RunError::Schema { expected, got: got.clone(), path: file.to_owned() });
    }
    let widths = checkpoint.model.architecture().widths();
    for (field, expected, got) in [
        ("action width", hello.shape.action_width, widths.action),
        ("state width", hello.shape.state_width, widths.state),
    ] {
        if expected != got {
            return Err(RunError::Widths { path: file.to_owned(), field, expected, got });
        }
    }
    Ok(())
}

fn read(path: &Path) -> Result<Vec<u8>, RunError> {
    let io = |cause| RunError::Io { path: path.to_owned(), cause };
    let got = std::fs::metadata(path).map_err(io)?.len();
    if got > MAX_TEXT_BYTES {
        return Err(RunError::TooLarge { path: path.to_owned(), got });
    }
    std::fs::read(path).map_err(io)
}

fn read_config(path: &Path) -> Result<toml::Table, RunError> {
    let refuse = |message| RunError::Config { path: path.to_owned(), message };
    let text = String::from_utf8(read(path)?).map_err(|error| refuse(error.to_string()))?;
    text.parse().map_err(|error: toml::de::Error| refuse(error.to_string()))
}
