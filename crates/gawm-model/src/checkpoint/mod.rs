//! Checkpoints: our own safetensors files, and the published layouts in and out.
//!
//! A checkpoint is one safetensors file: the tensors of the model under the published names, the moments of the optimiser
//! under `optimizer.`, and text in the metadata (`docs/model.md` lists the keys). Every byte of a file is checked before
//! it is believed: sizes before allocation, names and shapes against the architecture, numbers for being finite.
//!
//! - [`save`] and [`load`]: everything a run needs to go on, written atomically.
//! - [`import`]: weights of the published modules, from safetensors or a PyTorch `weights.pt`, with the key layout of
//!   transformers 4 or 5. A pickle is read by a machine that builds tensors and containers and refuses all else.
//! - [`export`]: the model alone, as `safetensors.torch.load_file` and `load_state_dict` take it.

mod archive;
mod layout;
mod pickle;
mod safetensors;
mod torch;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::config::{Architecture, ConfigError};
use crate::model::WorldModel;
use crate::optimizer::{AdamW, AdamWConfig, OptimizerError};
use crate::parameters::{ParameterError, Parameters, Specs};

pub use layout::{ImportOptions, KeyLayout};
pub use pickle::PickleError;
pub use safetensors::FormatError;
pub use torch::TorchError;

use safetensors::TensorFile;

/// Version of our checkpoints; files of another are refused.
pub const VERSION: &str = "1";

const KEY_VERSION: &str = "gawm.version";
const KEY_ARCHITECTURE: &str = "gawm.architecture";
const KEY_STATISTICS: &str = "gawm.statistics";
const KEY_SCHEMA_HASH: &str = "gawm.schema_hash";
const KEY_OPTIMIZER: &str = "gawm.optimizer";
const PREFIX_NOTE: &str = "gawm.note.";
const PREFIX_OPTIMIZER: &str = "optimizer.";

/// What a checkpoint says besides its tensors.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct About {
    /// Statistics that actions and states were standardised by (JSON, as the dataset gives them).
    pub statistics: Option<String>,
    /// Hash of the schema of the data.
    pub schema_hash: Option<String>,
    /// Anything else a run wants to find again, by name: its configuration, its best metric.
    pub notes: BTreeMap<String, String>,
}

/// What [`load`] finds.
#[derive(Debug, Clone)]
pub struct Checkpoint {
    /// The model with its running statistics.
    pub model: WorldModel,
    /// What the file says besides.
    pub about: About,
    /// The optimiser, if it was saved.
    pub optimizer: Option<AdamW>,
}

/// Settings and step of a saved optimiser, in the metadata.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct OptimizerEntry {
    config: AdamWConfig,
    step: u64,
}

/// Why a checkpoint cannot be read or written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CheckpointError {
    /// The file system refuses.
    #[error("cannot {verb} checkpoint {path:?}: {cause}")]
    Io {
        /// `read` or `write`.
        verb: &'static str,
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// The file is no safetensors file.
    #[error("damaged checkpoint {path:?}: {cause}")]
    Format {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: FormatError,
    },
    /// The file is no PyTorch file of tensors.
    #[error("cannot import {path:?}: {cause}")]
    Torch {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: Box<TorchError>,
    },
    /// The file was not written by [`save`], or by another version.
    #[error(
        "not a gawm checkpoint of version {VERSION}: expected metadata {KEY_VERSION:?}, got {got:?} ({path:?})"
    )]
    Version {
        /// The file.
        path: PathBuf,
        /// What it has there.
        got: Option<String>,
    },
    /// The metadata does not say what it must.
    #[error("checkpoint metadata {key:?}: {message} ({path:?})")]
    Metadata {
        /// The file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// What is wrong.
        message: String,
    },
    /// The sizes make no model.
    #[error("checkpoint {path:?}: {cause}")]
    Config {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: ConfigError,
    },
    /// A tensor does not belong to the model, is missing, or holds what no weight can be.
    #[error("checkpoint {path:?}: {cause}")]
    Parameter {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: Box<ParameterError>,
    },
    /// The optimiser's state does not fit.
    #[error("checkpoint {path:?}: {cause}")]
    Optimizer {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: Box<OptimizerError>,
    },
    /// Tensors of which no published model consists.
    #[error("cannot import {path:?}: {message}")]
    Layout {
        /// The file.
        path: PathBuf,
        /// What is missing or contradicts itself.
        message: String,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

/// Saves a model, what is known about it, and optionally the optimiser, in one atomic step.
///
/// A reader sees the old file or the new one, never a part. The same state gives the same bytes.
///
/// # Errors
///
/// - [`CheckpointError::Io`]; the old file is untouched then.
pub fn save(
    path: &Path,
    model: &WorldModel,
    about: &About,
    optimizer: Option<&AdamW>,
) -> Result<(), CheckpointError> {
    let mut metadata = BTreeMap::from([
        ("format".to_owned(), "pt".to_owned()),
        (KEY_VERSION.to_owned(), VERSION.to_owned()),
        (KEY_ARCHITECTURE.to_owned(), model.architecture().to_json()),
    ]);
    metadata.extend(about.statistics.iter().map(|text| (KEY_STATISTICS.to_owned(), text.clone())));
    metadata.extend(about.schema_hash.iter().map(|hash| (KEY_SCHEMA_HASH.to_owned(), hash.clone())));
    metadata.extend(about.notes.iter().map(|(name, text)| (format!("{PREFIX_NOTE}{name}"), text.clone())));
    let mut tensors: BTreeMap<String, Tensor> =
        model.parameters().iter().map(|(name, tensor)| (name.to_owned(), tensor.clone())).collect();
    if let Some(optimizer) = optimizer {
        let entry = OptimizerEntry { config: optimizer.config().clone(), step: optimizer.step_count() };
        let entry = serde_json::to_string(&entry).expect("a struct of numbers and names becomes JSON");
        metadata.insert(KEY_OPTIMIZER.to_owned(), entry);
        let moments = optimizer.state().into_iter();
        tensors.extend(moments.map(|(name, moment)| (format!("{PREFIX_OPTIMIZER}{name}"), moment)));
    }
    safetensors::write(path, &metadata, &tensors)
}

/// Loads what [`save`] wrote.
///
/// # Errors
///
/// - [`CheckpointError`] if a byte is not as [`save`] writes it: sizes, names, shapes, numbers.
pub fn load(path: &Path, device: &Device) -> Result<Checkpoint, CheckpointError> {
    let mut file = TensorFile::open(path)?;
    let text = |key: &str| file.metadata().get(key).cloned();
    let got = text(KEY_VERSION);
    if got.as_deref() != Some(VERSION) {
        return Err(CheckpointError::Version { path: path.to_owned(), got });
    }
    let about = About {
        statistics: text(KEY_STATISTICS),
        schema_hash: text(KEY_SCHEMA_HASH),
        notes: file
            .metadata()
            .iter()
            .filter_map(|(key, text)| Some((key.strip_prefix(PREFIX_NOTE)?.to_owned(), text.clone())))
            .collect(),
    };
    let entry = match text(KEY_OPTIMIZER) {
        None => None,
        Some(text) => Some(serde_json::from_str(&text).map_err(|error| CheckpointError::Metadata {
            path: path.to_owned(),
            key: KEY_OPTIMIZER,
            message: error.to_string(),
        })?),
    };
    let architecture =
        read_architecture(path, file.metadata())?.ok_or_else(|| CheckpointError::Metadata {
            path: path.to_owned(),
            key: KEY_ARCHITECTURE,
            message: "expected the sizes of the model, got nothing".to_owned(),
        })?;

    let names: Vec<(String, Vec<usize>)> =
        file.shapes().filter(|(name, _)| !name.starts_with(PREFIX_OPTIMIZER)).collect();
    let model = fill(
        path,
        architecture,
        names.into_iter().map(|(name, shape)| (name.clone(), name, shape)),
        device,
        |name| file.read(name),
    )?;
    let optimizer = match entry {
        None => None,
        Some(entry) => Some(load_optimizer(path, &mut file, entry, &model)?),
    };
    Ok(Checkpoint { model, about, optimizer })
}

fn load_optimizer(
    path: &Path,
    file: &mut TensorFile,
    entry: OptimizerEntry,
    model: &WorldModel,
) -> Result<AdamW, CheckpointError> {
    let refuse =
        |cause: OptimizerError| CheckpointError::Optimizer { path: path.to_owned(), cause: Box::new(cause) };
    let shapes: Vec<(String, Vec<usize>)> =
        file.shapes().filter(|(name, _)| name.starts_with(PREFIX_OPTIMIZER)).collect();
    let mut state = BTreeMap::new();
    for (key, shape) in shapes {
        let moment = key[PREFIX_OPTIMIZER.len()..].to_owned();
        let name = moment.split_once('.').map_or("", |(_, name)| name);
        let spec = model.parameters().specs().get(name).filter(|spec| spec.trainable);
        let Some(spec) = spec else {
            return Err(refuse(ParameterError::Unknown { name: key }.into()));
        };
        if spec.shape != shape {
            let expected = spec.shape.clone();
            return Err(refuse(ParameterError::Shape { name: key, expected, got: shape }.into()));
        }
        let tensor = finite(path, &key, file.read(&key)?)?;
        state.insert(moment, tensor.to_dtype(DType::F32)?);
    }
    AdamW::restore(entry.config, entry.step, &state, model.parameters()).map_err(refuse)
}

/// Imports weights of the published modules: `*.pt`, `*.pth`, `*.ckpt` or safetensors, keys of transformers 4 or 5.
///
/// The sizes are read off the shapes; only numbers of heads cannot be, and follow `options`.
///
/// # Errors
///
/// - [`CheckpointError::Torch`] for pickles that hold anything but tensors, and as [`load`].
pub fn import(path: &Path, options: &ImportOptions, device: &Device) -> Result<WorldModel, CheckpointError> {
    let is_zip = {
        let io = |cause| CheckpointError::Io { verb: "read", path: path.to_owned(), cause };
        let mut magic = Vec::new();
        let file = std::fs::File::open(path).map_err(io)?;
        std::io::Read::read_to_end(&mut std::io::Read::take(file, 4), &mut magic).map_err(io)?;
        magic == *b"PK\x03\x04"
    };
    if is_zip {
        let refuse = |cause| CheckpointError::Torch { path: path.to_owned(), cause: Box::new(cause) };
        let mut archive = torch::TorchFile::open(path).map_err(refuse)?;
        let shapes: Vec<(String, Vec<usize>)> = archive.shapes().collect();
        import_tensors(path, None, shapes, options, device, |name| archive.read(name).map_err(refuse))
    } else {
        let mut file = TensorFile::open(path)?;
        let architecture = read_architecture(path, file.metadata())?;
        let shapes: Vec<(String, Vec<usize>)> =
            file.shapes().filter(|(name, _)| !name.starts_with(PREFIX_OPTIMIZER)).collect();
        import_tensors(path, architecture, shapes, options, device, |name| file.read(name))
    }
}

fn import_tensors(
    path: &Path,
    architecture: Option<Architecture>,
    shapes: Vec<(String, Vec<usize>)>,
    options: &ImportOptions,
    device: &Device,
    read: impl FnMut(&str) -> Result<Tensor, CheckpointError>,
) -> Result<WorldModel, CheckpointError> {
    let refuse = |message| CheckpointError::Layout { path: path.to_owned(), message };
    let mut named = BTreeMap::new();
    for (theirs, shape) in shapes {
        let ours = layout::our_key(&theirs);
        if let Some((other, _)) = named.insert(ours.clone(), (theirs.clone(), shape)) {
            return Err(refuse(format!("{other:?} and {theirs:?} both stand for {ours:?}")));
        }
    }
    let architecture = match architecture {
        Some(architecture) => architecture,
        None => {
            let shapes = named.iter().map(|(ours, (_, shape))| (ours.clone(), shape.clone())).collect();
            let (config, widths) = layout::infer(&shapes, options).map_err(refuse)?;
            let invalid = |cause| CheckpointError::Config { path: path.to_owned(), cause };
            config.resolve(widths).map_err(invalid)?
        }
    };
    let named = named.into_iter().map(|(ours, (theirs, shape))| (ours, theirs, shape));
    fill(path, architecture, named, device, read)
}

/// Exports the tensors of a model, running statistics included, under published keys.
///
/// # Errors
///
/// - [`CheckpointError::Io`].
pub fn export(path: &Path, model: &WorldModel, layout: KeyLayout) -> Result<(), CheckpointError> {
    let metadata = BTreeMap::from([
        ("format".to_owned(), "pt".to_owned()),
        (KEY_ARCHITECTURE.to_owned(), model.architecture().to_json()),
    ]);
    let tensors = model.parameters().iter();
    let tensors = tensors.map(|(name, tensor)| (layout::their_key(name, layout), tensor.clone())).collect();
    safetensors::write(path, &metadata, &tensors)
}

/// Reads the sizes from the metadata, if they are there.
fn read_architecture(
    path: &Path,
    metadata: &BTreeMap<String, String>,
) -> Result<Option<Architecture>, CheckpointError> {
    let invalid = |cause| CheckpointError::Config { path: path.to_owned(), cause };
    metadata.get(KEY_ARCHITECTURE).map(|text| Architecture::from_json(text).map_err(invalid)).transpose()
}

/// Makes a model of the tensors of a file, each given as (our name, name in the file, shape).
///
/// Names and shapes are compared before anything of their size is allocated or read.
fn fill(
    path: &Path,
    architecture: Architecture,
    tensors: impl Iterator<Item = (String, String, Vec<usize>)>,
    device: &Device,
    mut read: impl FnMut(&str) -> Result<Tensor, CheckpointError>,
) -> Result<WorldModel, CheckpointError> {
    let refuse = |cause| CheckpointError::Parameter { path: path.to_owned(), cause: Box::new(cause) };
    let specs: Specs = WorldModel::specs(&architecture);
    let mut names = BTreeMap::new();
    for (ours, theirs, got) in tensors {
        let Some(spec) = specs.get(&ours) else {
            return Err(refuse(ParameterError::Unknown { name: theirs }));
        };
        if spec.shape != got {
            return Err(refuse(ParameterError::Shape { name: theirs, expected: spec.shape.clone(), got }));
        }
        names.insert(ours, theirs);
    }
    if let Some((name, spec)) = specs.iter().find(|(name, _)| !names.contains_key(*name)) {
        return Err(refuse(ParameterError::Missing { name: name.clone(), expected: spec.shape.clone() }));
    }
    let parameters = Parameters::zeros(&specs, device)?;
    for (ours, theirs) in names {
        let tensor = finite(path, &theirs, read(&theirs)?)?;
        parameters.set(&ours, &tensor).map_err(refuse)?;
    }
    Ok(WorldModel::with_parameters(architecture, parameters)?)
}

/// Refuses tensors with a value that is no number, once it is f32.
fn finite(path: &Path, name: &str, tensor: Tensor) -> Result<Tensor, CheckpointError> {
    if tensor.dtype().is_int() {
        return Ok(tensor);
    }
    let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
    match values.iter().position(|value| !value.is_finite()) {
        None => Ok(tensor),
        Some(index) => {
            let cause =
                Box::new(ParameterError::NonFinite { name: name.to_owned(), index, got: values[index] });
            Err(CheckpointError::Parameter { path: path.to_owned(), cause })
        }
    }
}
