//! The objectives of training, in one weighted table.
//!
//! [`losses`] reads like the method: encode, embed, predict, and one line per term. Targets and losses are f32 and the
//! target of the prediction is *not* detached: latents are shaped by all terms.

mod clips;
mod collapse;
mod straightening;
mod table;

use candle_core::{DType, Tensor};
use candle_nn::loss::mse;

use crate::Result;
use crate::model::WorldModel;
use crate::pass::Pass;

pub use clips::{Clips, ClipsError, StateRule};
pub use collapse::{KNOTS, covariance, sigreg, sigreg_projections, sigreg_weights, standard_deviation};
pub use straightening::straightening;
pub use table::{Control, ObjectiveError, Objectives, ObjectivesTable, PRESETS, Term};

/// The loss of a batch: every term, and their weighted sum.
#[derive(Debug, Clone)]
pub struct Losses {
    /// The sum of weight times value over the terms with a weight; a scalar that carries the gradient.
    pub total: Tensor,
    /// Every term computed, unweighted, in the order of [`Term::ALL`].
    pub terms: Vec<LossTerm>,
}

/// One term of a loss.
#[derive(Debug, Clone)]
pub struct LossTerm {
    /// Which term.
    pub term: Term,
    /// Its weight in the total; 0 if it is only monitored.
    pub weight: f64,
    /// Its unweighted value, a detached scalar.
    pub value: Tensor,
}

impl Losses {
    /// Reads names and values of all terms, then `("total", ..)`. Sync: waits for the device.
    pub fn values(&self) -> Result<Vec<(&'static str, f32)>> {
        let mut values = Vec::with_capacity(self.terms.len() + 1);
        for term in &self.terms {
            values.push((term.term.name(), term.value.to_scalar()?));
        }
        values.push(("total", self.total.to_scalar()?));
        Ok(values)
    }

    /// Reads the value of one term, if it was computed. Sync: waits for the device.
    pub fn value(&self, term: Term) -> Result<Option<f32>> {
        self.terms.iter().find(|t| t.term == term).map(|t| t.value.to_scalar()).transpose()
    }
}

/// Computes the loss of a batch of clips.
///
/// ```text
/// z_t   = Enc(o_t)              c_t = Act(a_t)            z^_{t+1} = Pred(z_{<=t}, c_{<=t})
/// pred  = mean (z^_{t+1} - z_{t+1})^2
/// sa    = mean over supervised dims (G(z_{t-1}, z_t) - s_t)^2        (z_{-1} = z_0; velocities not at t = 0)
/// idm   = mean (H(z_t, z_{t+1}) - a_t)^2
/// total = sum of weight x term
/// ```
///
/// All means are over elements (the paper writes squared norms: factors D, S and A more).
///
/// # Errors
///
/// - if a term needs a head that the model does not have, or shapes do not fit the model.
pub fn losses(model: &WorldModel, clips: &Clips, objectives: &Objectives, pass: &Pass) -> Result<Losses> {
    let clips = objectives.control.apply(clips, pass)?;
    let z = model.encode(&clips.frames, pass)?.to_dtype(DType::F32)?; // [B, T, D]
    latent_losses(model, &z, &clips, objectives, pass)
}

/// Computes the loss of a batch whose latents `z` [B, T, D] are known, f32; no control is applied.
///
/// # Errors
///
/// - as [`losses`].
pub fn latent_losses(
    model: &WorldModel,
    z: &Tensor,
    clips: &Clips,
    objectives: &Objectives,
    pass: &Pass,
) -> Result<Losses> {
    let (_, t, _) = z.dims3()?;
    let c = model.embed_actions(&clips.actions, pass)?; // [B, T, D]
    let (past, next) = (z.narrow(1, 0, t - 1)?, z.narrow(1, 1, t - 1)?); // [B, T-1, D]
    let actions = clips.actions.narrow(1, 0, t - 1)?; // [B, T-1, A]; the last chunk leaves the clip

    let term = |term: Term| match term {
        Term::Prediction => {
            let predicted = model.predict(&past, &c.narrow(1, 0, t - 1)?, pass)?; // [B, T-1, D]
            mse(&predicted, &next)
        }
        Term::StateAlignment => {
            state_alignment(&model.read_states(z, pass)?, &clips.states, &clips.state_mask)
        }
        Term::InverseDynamics => mse(&model.read_actions(z, pass)?, &actions),
        Term::Sigreg => {
            let directions = sigreg_projections(z.dim(2)?, objectives.sigreg_projections, pass, z.device())?;
            sigreg(&z.transpose(0, 1)?, &directions)
        }
        Term::Std => standard_deviation(&centre(z)?),
        Term::StdTime => standard_deviation(&centre(z)?.transpose(0, 1)?),
        Term::Covariance => covariance(&centre(z)?),
        Term::CovarianceTime => covariance(&centre(z)?.transpose(0, 1)?),
        Term::TemporalAlignment => mse(&past, &next),
        Term::Straightening => straightening(z),
    };
    objectives.evaluate(term, z.device())
}

/// Mean squared error over the elements where `mask` is not 0; the values of the others are not looked at.
///
/// `decoded` and `states` have shape [B, T, S], f32; `mask` the same, u8.
///
/// # Errors
///
/// - if `mask` is 0 everywhere.
pub fn state_alignment(decoded: &Tensor, states: &Tensor, mask: &Tensor) -> Result<Tensor> {
    let count = mask.to_dtype(DType::F32)?.sum_all()?;
    // `where_cond` and not a product: a masked target may be NaN. The target is replaced first, so that no NaN
    // enters the backward pass either.
    let states = mask.where_cond(states, &states.zeros_like()?)?;
    let squared = (decoded - states)?.sqr()?;
    let supervised = mask.where_cond(&squared, &squared.zeros_like()?)?; // [B, T, S]
    supervised.sum_all()? / count
}

/// Subtracts the mean over the batch from each frame position and dim. Shape [B, T, D], kept.
fn centre(z: &Tensor) -> Result<Tensor> {
    z.broadcast_sub(&z.mean_keepdim(0)?)
}
