//! What a pipeline file says to the trainer: `[model]`, `[objectives]`, `[train]`, and how many loaders `[loader]` asks for.

mod resolved;
#[cfg(test)]
mod tests;

use std::path::{Path, PathBuf};

use gawm_model::objective::ObjectiveError;
use gawm_model::{AdamWConfig, Decay, Device, ModelConfig, Objectives, Precision, WarmupCosine};
use gawm_schema::pipeline::{Override, OverrideError};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Everything that a run is told, resolved and checked.
#[derive(Debug, Clone)]
pub struct Config {
    /// The whole file with overrides applied, the sections of other programs as written.
    pub table: toml::Table,
    /// Sizes of the model, before the widths of the data are known.
    pub model: ModelConfig,
    /// The weighted terms.
    pub objectives: Objectives,
    /// The section `[train]`.
    pub train: TrainConfig,
    /// Number of loader processes, `[loader] loaders`.
    pub loaders: u16,
}

/// The section `[train]`; the default is the published setting where there is one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// Optimiser steps in all. Default 1000.
    pub steps: u64,
    /// Highest learning rate. Default 5e-5.
    pub rate: f64,
    /// Steps of linear warm-up. Default: a hundredth of the steps, at least one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub warmup_steps: Option<u64>,
    /// Decoupled weight decay per step, times the rate. Default 1e-3.
    pub weight_decay: f64,
    /// What is decayed: `all` (default, as published) or `matrices`.
    pub decay: Decay,
    /// Gradients are scaled down to this global L2 norm. Default 1.
    pub max_gradient_norm: f64,
    /// Operands of matrix products: `auto` (default: bf16 on a GPU, f32 on a CPU), `f32`, `bf16`.
    pub precision: PrecisionChoice,
    /// `auto` (default: the first GPU if the program was built for one, else the CPU), `cpu`, `cuda:0`, ...
    pub device: String,
    /// Training steps between two validations; there is always one after the last step, and 0 means no other.
    /// Default 200.
    pub validate_every: u64,
    /// Batches of a validation. Default 8.
    pub validation_batches: u64,
    /// Training steps between two saves of the last checkpoint; a validation saves too. Default 200.
    pub checkpoint_every: u64,
    /// Training steps between two lines of metrics. Default 10.
    pub log_every: u64,
    /// Seed of initial weights, dropout masks, projections and controls. Default 3072.
    pub seed: u64,
    /// Longest wait for a batch, in seconds, before the run gives up. Default 120.
    pub deadline_s: u64,
    /// Dims of the state (by name) that are supervised. Default: all.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub supervised: Option<Vec<String>>,
    /// Dims of the state (by name) that are velocities: not supervised in the first frame of a clip. Default: none.
    pub velocity: Vec<String>,
    /// Alarm when the standard deviation of the latents, averaged over dims, falls below this. Default 0.01.
    pub collapse_std: f64,
    /// Alarm when the effective rank of the latents falls below this. Default 1.5.
    pub collapse_rank: f64,
}

/// Precision as a user asks for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum PrecisionChoice {
    /// What the device is good at.
    #[default]
    Auto,
    /// 32 bit throughout.
    F32,
    /// Products of bf16 operands, everything else 32 bit.
    Bf16,
}

/// Why a configuration is refused.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("cannot read configuration {path:?}: {cause}")]
    Read {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// The file is no TOML, or a section of ours has an unknown field or a wrong type.
    #[error("{place}: {message}")]
    Syntax {
        /// The file, or the override.
        place: String,
        /// What the parser says, with line and column where it knows them.
        message: String,
    },
    /// A section is refused.
    #[error("{place}: {message}")]
    Section {
        /// File and section.
        place: String,
        /// What is wrong.
        message: String,
    },
    /// Values are out of range; all of them are listed.
    #[error("{place}: {}", list(values))]
    Values {
        /// The file.
        place: String,
        /// Every refused value.
        values: Vec<RefusedValue>,
    },
    /// An override does not fit.
    #[error(transparent)]
    Override(#[from] OverrideError),
    /// The device does not exist or the program was not built for it.
    #[error("train.device: expected a device of this machine, got {got:?} ({cause})")]
    Device {
        /// As given.
        got: String,
        /// What the library says.
        cause: String,
    },
}

/// A value that cannot be used.
#[derive(Debug, Clone, PartialEq)]
pub struct RefusedValue {
    /// Path of the field, `section.field`.
    pub field: &'static str,
    /// What would be accepted.
    pub expected: &'static str,
    /// The value.
    pub got: String,
}

fn list(values: &[RefusedValue]) -> String {
    let one =
        |value: &RefusedValue| format!("{}: expected {}, got {}", value.field, value.expected, value.got);
    values.iter().map(one).collect::<Vec<_>>().join("\n  ")
}

impl Default for TrainConfig {
    fn default() -> TrainConfig {
        TrainConfig {
            steps: 1000,
            rate: 5e-5,
            warmup_steps: None,
            weight_decay: 1e-3,
            decay: Decay::All,
            max_gradient_norm: 1.0,
            precision: PrecisionChoice::Auto,
            device: "auto".to_owned(),
            validate_every: 200,
            validation_batches: 8,
            checkpoint_every: 200,
            log_every: 10,
            seed: 3072,
            deadline_s: 120,
            supervised: None,
            velocity: Vec::new(),
            collapse_std: 0.01,
            collapse_rank: 1.5,
        }
    }
}

impl TrainConfig {
    /// Lists every value that is out of range.
    fn refused(&self) -> Vec<RefusedValue> {
        let positive = |value: f64| value.is_finite() && value > 0.0;
        let not_negative = |value: f64| value.is_finite() && value >= 0.0;
        let count = |value: u64| (1..=1_000_000_000_000).contains(&value);
        let warmup = self.warmup_steps.unwrap_or(0);
        let checks = [
            ("train.steps", "1 to 10^12", self.steps.to_string(), count(self.steps)),
            ("train.rate", "a number above 0", self.rate.to_string(), positive(self.rate)),
            ("train.warmup_steps", "at most train.steps", warmup.to_string(), warmup <= self.steps),
            (
                "train.weight_decay",
                "a number >= 0",
                self.weight_decay.to_string(),
                not_negative(self.weight_decay),
            ),
            (
                "train.max_gradient_norm",
                "a number above 0",
                self.max_gradient_norm.to_string(),
                positive(self.max_gradient_norm),
            ),
            (
                "train.validate_every",
                "0 (after the last step only) to 10^12 steps",
                self.validate_every.to_string(),
                self.validate_every <= 1_000_000_000_000,
            ),
            (
                "train.validation_batches",
                "0 (no validation) to 10^6",
                self.validation_batches.to_string(),
                self.validation_batches <= 1_000_000,
            ),
            (
                "train.checkpoint_every",
                "1 to 10^12 steps",
                self.checkpoint_every.to_string(),
                count(self.checkpoint_every),
            ),
            ("train.log_every", "1 to 10^12 steps", self.log_every.to_string(), count(self.log_every)),
            (
                "train.deadline_s",
                "1 to 86400 seconds",
                self.deadline_s.to_string(),
                (1..=86_400).contains(&self.deadline_s),
            ),
            (
                "train.collapse_std",
                "a number >= 0",
                self.collapse_std.to_string(),
                not_negative(self.collapse_std),
            ),
            (
                "train.collapse_rank",
                "a number >= 0",
                self.collapse_rank.to_string(),
                not_negative(self.collapse_rank),
            ),
        ];
        let wrong = checks.into_iter().filter(|(.., is_good)| !is_good);
        wrong.map(|(field, expected, got, _)| RefusedValue { field, expected, got }).collect()
    }

    /// The rate of each step.
    pub fn schedule(&self) -> WarmupCosine {
        let published = WarmupCosine::published(self.rate, self.steps);
        WarmupCosine { warmup_steps: self.warmup_steps.unwrap_or(published.warmup_steps), ..published }
    }

    /// Settings of the optimiser.
    pub fn optimizer(&self) -> AdamWConfig {
        AdamWConfig {
            weight_decay: self.weight_decay,
            decay: self.decay,
            max_gradient_norm: self.max_gradient_norm,
            ..AdamWConfig::default()
        }
    }

    /// Opens the device.
    ///
    /// # Errors
    ///
    /// - [`ConfigError::Device`] for a name that is none, or a GPU that is not there or not built for.
    pub fn open_device(&self) -> Result<Device, ConfigError> {
        let refuse = |cause: String| ConfigError::Device { got: self.device.clone(), cause };
        match self.device.as_str() {
            "cpu" => Ok(Device::Cpu),
            "auto" => Device::cuda_if_available(0).map_err(|error| refuse(error.to_string())),
            name => {
                let ordinal = name.strip_prefix("cuda:").and_then(|ordinal| ordinal.parse().ok());
                let ordinal = ordinal
                    .ok_or_else(|| refuse("devices are called auto, cpu, cuda:0, cuda:1, ...".to_owned()))?;
                Device::new_cuda(ordinal).map_err(|error| refuse(error.to_string()))
            }
        }
    }

    /// The precision on a device.
    pub fn precision_on(&self, device: &Device) -> Precision {
        match self.precision {
            PrecisionChoice::F32 => Precision::F32,
            PrecisionChoice::Bf16 => Precision::Bf16,
            PrecisionChoice::Auto if device.is_cuda() => Precision::Bf16,
            PrecisionChoice::Auto => Precision::F32,
        }
    }
}

impl Config {
    /// Reads a pipeline file and applies overrides.
    ///
    /// # Errors
    ///
    /// - [`ConfigError`] with the place, what was expected and what was found.
    pub fn read(path: &Path, overrides: &[Override]) -> Result<Config, ConfigError> {
        let text = std::fs::read_to_string(path)
            .map_err(|cause| ConfigError::Read { path: path.to_owned(), cause })?;
        Config::parse(&path.display().to_string(), &text, overrides)
    }
}

fn objectives(place: &str, table: toml::Table) -> Result<Objectives, ConfigError> {
    let refuse = |error: ObjectiveError| ConfigError::Section {
        place: format!("{place}, [objectives]"),
        message: error.to_string(),
    };
    Objectives::from_table(table).map_err(refuse)
}
