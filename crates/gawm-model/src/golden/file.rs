//! The JSON of a golden file.

use std::collections::BTreeMap;

use serde::Deserialize;
use thiserror::Error;

use crate::config::{ConfigError, DataWidths};
use crate::objective::ClipsError;
use crate::optimizer::OptimizerError;
use crate::parameters::ParameterError;
use crate::plan::PlanError;

/// The answers of the published modules for one set of sizes.
#[derive(Debug, Clone, Deserialize)]
pub struct Golden {
    pub(super) config: GoldenConfig,
    pub(super) parameters: usize,
    pub(super) shapes: BTreeMap<String, Vec<usize>>,
    pub(super) eval: Eval,
    pub(super) rollout_history_1: Rollout,
    pub(super) rollout_history_3: Rollout,
    pub(super) regularisers: BTreeMap<String, f64>,
    pub(super) diagnostics_all_frames_as_one_trajectory: Diagnostics,
    pub(super) cem: Vec<GoldenIteration>,
    pub(super) train: Train,
    pub(super) grad: BTreeMap<String, Grad>,
    pub(super) grad_norm: f64,
    pub(super) after_step: BTreeMap<String, AfterStep>,
    pub(super) losses_steps_2_to_5: Vec<Vec<f64>>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct GoldenConfig {
    pub(super) size: usize,
    pub(super) patch: usize,
    pub(super) clips: usize,
    pub(super) act: usize,
    pub(super) state: usize,
    pub(super) samples: usize,
    pub(super) horizon: usize,
    pub(super) table: usize,
    pub(super) depth: usize,
    pub(super) velocity: Vec<usize>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct Eval {
    pub(super) emb: Vec<Vec<f64>>,
    pub(super) act_emb_head: Vec<f64>,
    pub(super) pred_head: Vec<f64>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct Rollout {
    pub(super) last: Vec<Vec<f64>>,
    pub(super) cost_to_frame_3: Vec<f64>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct Diagnostics {
    pub(super) local_straightening: Vec<f64>,
    pub(super) score: f64,
    pub(super) singular_values: Vec<f64>,
    pub(super) cumulative_energy: Vec<f64>,
    pub(super) r95: f64,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct GoldenIteration {
    pub(super) cost: Vec<f64>,
    pub(super) elites: Vec<usize>,
    pub(super) mean: Vec<Vec<f64>>,
    pub(super) sigma: Vec<Vec<f64>>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct Train {
    pub(super) loss_pred: f64,
    pub(super) loss_sa: f64,
    pub(super) loss_idm: f64,
    pub(super) emb: Vec<Vec<f64>>,
    pub(super) pred_head: Vec<f64>,
    pub(super) state_head: Vec<f64>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct Grad {
    pub(super) l2: f64,
    pub(super) head: Vec<f64>,
}

#[derive(Debug, Clone, Deserialize)]
pub(super) struct AfterStep {
    pub(super) delta_l2: f64,
    pub(super) head: Vec<f64>,
}

/// Why a golden file cannot be compared with.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum GoldenError {
    /// The text is not a golden file.
    #[error("not a golden file: {message}")]
    Syntax {
        /// What the parser says, with the place.
        message: String,
    },
    /// A size of the batch is out of range.
    #[error("golden config {field}: expected {minimum} to {maximum}, got {got}")]
    Range {
        /// The field.
        field: &'static str,
        /// Smallest value allowed.
        minimum: usize,
        /// Largest value allowed.
        maximum: usize,
        /// The value.
        got: usize,
    },
    /// A parameter's shape differs, or one side does not have it.
    #[error("shape mismatch on {name:?}: expected {expected:?}, got {got:?}")]
    Shapes {
        /// The parameter.
        name: String,
        /// Its shape in the file.
        expected: Option<Vec<usize>>,
        /// Its shape in our model.
        got: Option<Vec<usize>>,
    },
    /// The number of trainable values differs.
    #[error("expected {expected} trainable values, got {got}")]
    Count {
        /// In the file.
        expected: usize,
        /// In our model.
        got: usize,
    },
    /// Something that must be there is not.
    #[error("{what} has no entry {name:?}")]
    Missing {
        /// The table.
        what: &'static str,
        /// The entry.
        name: String,
    },
    /// The sizes make no model.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The batch does not fit.
    #[error(transparent)]
    Clips(#[from] ClipsError),
    /// A parameter does not fit.
    #[error(transparent)]
    Parameter(#[from] ParameterError),
    /// The optimiser failed.
    #[error(transparent)]
    Optimizer(#[from] OptimizerError),
    /// The search failed.
    #[error(transparent)]
    Plan(#[from] PlanError),
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Golden {
    /// Reads a golden file.
    ///
    /// # Errors
    ///
    /// - [`GoldenError::Syntax`] if it is none, [`GoldenError::Range`] for sizes beyond what is sensible to repeat.
    pub fn parse(text: &str) -> Result<Golden, GoldenError> {
        let golden: Golden =
            serde_json::from_str(text).map_err(|error| GoldenError::Syntax { message: error.to_string() })?;
        let config = &golden.config;
        for (field, got, minimum, maximum) in [
            ("size", config.size, config.patch, 1024),
            ("clips", config.clips, 1, 1024),
            ("samples", config.samples, 1, 4096),
            ("horizon", config.horizon, 3, 256),
            ("cem iterations", golden.cem.len(), 1, 1024),
        ] {
            if got < minimum || got > maximum {
                return Err(GoldenError::Range { field, minimum, maximum, got });
            }
        }
        Ok(golden)
    }
}

impl GoldenConfig {
    pub(super) fn widths(&self) -> DataWidths {
        DataWidths { action: self.act, state: self.state }
    }
}

impl GoldenError {
    pub(super) fn missing(what: &'static str, name: &str) -> GoldenError {
        GoldenError::Missing { what, name: name.to_owned() }
    }
}
