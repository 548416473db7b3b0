//! The lines of `metrics.jsonl`.

use serde::{Deserialize, Serialize};

/// One line.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Record {
    /// A training step.
    Train(TrainRecord),
    /// A validation.
    Validation(ValidationRecord),
}

/// What a training step did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TrainRecord {
    /// Optimiser step, from 0.
    pub step: u64,
    /// Pass over the training clips, from 0.
    pub epoch: u64,
    /// Learning rate.
    pub rate: f64,
    /// L2 norm of all gradients before clipping.
    pub gradient_norm: f64,
    /// The weighted sum.
    pub total: f32,
    /// Every term, unweighted.
    pub terms: Vec<TermValue>,
}

/// A term of the loss and its value.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TermValue {
    /// Name of the term.
    pub term: String,
    /// Its unweighted value.
    pub value: f64,
    /// What the value has to be compared with, where there is such a thing.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub baseline: Option<Baseline>,
}

/// What costs nothing to reach.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Baseline {
    /// `identity`: the next latent is the last one. `constant`: the best constant of the same data.
    pub name: String,
    /// Its loss on the same clips.
    pub value: f64,
    /// `1 - loss / baseline`: 0 is no better than the baseline, 1 is perfect.
    pub skill: f64,
}

impl Baseline {
    /// Compares a loss with what `name` reaches on the same data.
    pub fn compare(name: &str, baseline: f64, loss: f64) -> Baseline {
        let skill = if baseline > 0.0 { 1.0 - loss / baseline } else { 0.0 };
        Baseline { name: name.to_owned(), value: baseline, skill }
    }
}

/// What the model does on held-out clips, in evaluation mode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ValidationRecord {
    /// Optimiser steps taken before it.
    pub step: u64,
    /// Number of clips.
    pub clips: u64,
    /// Every term, unweighted, the mean over the batches.
    pub terms: Vec<TermValue>,
    /// `1 - prediction / identity`.
    pub skill: f64,
    /// The same with the action chunks of other clips: what is left when actions say nothing.
    pub skill_shuffled_actions: f64,
    /// `skill - skill_shuffled_actions`: how much the prediction depends on the actions.
    pub skill_drop: f64,
    /// Prediction loss over the variance of the latents: below 1 is better than their mean.
    pub prediction_over_variance: f64,
    /// Standard deviation of the latents, averaged over dims.
    pub latent_std: f64,
    /// Effective rank of the latents: participation ratio of the eigenvalues of their covariance.
    pub effective_rank: f64,
    /// Why the latents count as collapsed, if they do.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub collapse: Option<String>,
    /// `prediction / variance + state-alignment + inverse-dynamics`, of the terms that exist; the lower the better.
    pub score: f64,
    /// Whether the score is the lowest so far.
    pub is_best: bool,
    /// Dims of the state, if they are read.
    pub states: Vec<DimReport>,
    /// Dims of the action, if they are read: the mean over the steps of a chunk.
    pub actions: Vec<DimReport>,
}

/// How well one dim is read from the latents.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DimReport {
    /// Name of the dim.
    pub name: String,
    /// Mean squared error, standardised units.
    pub error: f64,
    /// Variance of the target on the same clips: the error of the best constant.
    pub variance: f64,
    /// `1 - error / variance` (R squared).
    pub skill: f64,
}
