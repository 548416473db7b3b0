//! One optimiser step: losses, gradients, clip, update.

use gawm_model::{
    AdamW, Gradients, Losses, Objectives, OptimizerError, Pass, StepReport, WorldModel, losses,
};
use thiserror::Error;

use crate::batch::Batch;

/// What a step did.
#[derive(Debug, Clone)]
pub struct Step {
    /// Every term, from before the update.
    pub terms: Vec<(&'static str, f32)>,
    /// The weighted sum.
    pub total: f32,
    /// Rate and gradient norm.
    pub report: StepReport,
}

/// Why a step was not taken; weights and moments are as before.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum StepError {
    /// The loss or its gradient is no number.
    #[error(
        "{what} is not finite at step {step}: expected a number, got {} (rate {rate:e}, gradient norm \
         {gradient_norm}, clips {})",
        values(terms),
        clips(clip_ids)
    )]
    NonFinite {
        /// `training loss`, `gradient` or `validation loss`.
        what: &'static str,
        /// Optimiser step, from 0.
        step: u64,
        /// Rate of the step.
        rate: f64,
        /// Norm of all gradients; 0 where there is none.
        gradient_norm: f64,
        /// Every term.
        terms: Vec<(String, f64)>,
        /// The clips of the batch.
        clip_ids: Vec<u64>,
    },
    /// The optimiser refuses.
    #[error(transparent)]
    Optimizer(#[from] OptimizerError),
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

fn values(terms: &[(String, f64)]) -> String {
    terms.iter().map(|(name, value)| format!("{name} {value}")).collect::<Vec<_>>().join(", ")
}

/// Dataset and first row of each clip.
fn clips(ids: &[u64]) -> String {
    ids.iter().map(|id| format!("{}:{}", id >> 48, id & ((1 << 48) - 1))).collect::<Vec<_>>().join(" ")
}

/// Takes one step at `rate`. Sync: waits for the device.
///
/// # Errors
///
/// - [`StepError`]; nothing is updated then but the running statistics of batch norm.
pub fn train_step(
    model: &WorldModel,
    optimizer: &mut AdamW,
    batch: &Batch,
    objectives: &Objectives,
    rate: f64,
    pass: &Pass,
) -> Result<Step, StepError> {
    let losses = losses(model, &batch.clips, objectives, pass)?;
    let total = losses.total.to_scalar::<f32>()?; // Sync: waits for the device.
    let gradients = Gradients::of(&losses.total, model.parameters())?;
    if !total.is_finite() {
        let norm = f64::from(gradients.norm()?.to_scalar::<f32>()?);
        return Err(non_finite("training loss", &losses, batch, pass.step, rate, norm));
    }
    let report = match optimizer.step(model.parameters(), &gradients, rate) {
        Err(OptimizerError::NonFinite { got, .. }) => {
            return Err(non_finite("gradient", &losses, batch, pass.step, rate, got));
        }
        other => other?,
    };
    let values = losses.values()?;
    let terms = values.into_iter().filter(|(name, _)| *name != "total").collect();
    Ok(Step { terms, total, report })
}

fn non_finite(
    what: &'static str,
    losses: &Losses,
    batch: &Batch,
    step: u64,
    rate: f64,
    gradient_norm: f64,
) -> StepError {
    // A device that fails now leaves the list empty; the error itself is what matters.
    let values = losses.values().unwrap_or_default();
    let terms = values.into_iter().map(|(name, value)| (name.to_owned(), f64::from(value))).collect();
    StepError::NonFinite { what, step, rate, gradient_norm, terms, clip_ids: batch.clip_ids.clone() }
}
