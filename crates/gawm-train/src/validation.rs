//! What the model does on held-out clips: every term beside its baseline, skill, collapse.

mod moments;

use candle_nn::loss::mse;
use gawm_model::{
    Clips, Control, Objectives, Pass, Stream, Tensor, Term, WorldModel, latent_losses, permutation,
};
use gawm_schema::batch::Hello;

use crate::batch::Batch;
use crate::metrics::{Baseline, TermValue, ValidationRecord};
use moments::{DimErrors, LatentMoments};

/// Sums over the batches of one validation.
#[derive(Debug)]
pub struct Validation {
    objectives: Objectives,
    clips: u64,
    /// Term and sum of value times clips.
    terms: Vec<(Term, f64)>,
    /// Sums of mean squared errors times clips: prediction, identity, prediction with shuffled actions.
    prediction: f64,
    identity: f64,
    shuffled: f64,
    latents: LatentMoments,
    states: DimErrors,
    actions: DimErrors,
}

/// When latents count as collapsed.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CollapseLimits {
    /// Smallest standard deviation, averaged over dims.
    pub std: f64,
    /// Smallest effective rank.
    pub rank: f64,
}

impl Validation {
    /// Starts with no batch. Controls break what training sees, never what it is judged by.
    pub fn new(objectives: &Objectives, hello: &Hello) -> Validation {
        let names = |feature: &gawm_schema::batch::EncodedFeature| -> Vec<String> {
            feature.dims.iter().map(|dim| dim.name.clone()).collect()
        };
        Validation {
            objectives: Objectives { control: Control::None, ..objectives.clone() },
            clips: 0,
            terms: Vec::new(),
            prediction: 0.0,
            identity: 0.0,
            shuffled: 0.0,
            latents: LatentMoments::default(),
            states: DimErrors::new(names(&hello.state)),
            actions: DimErrors::new(names(&hello.action)),
        }
    }

    /// Adds the `index`-th batch, in evaluation mode and f32. Sync: waits for the device.
    ///
    /// # Errors
    ///
    /// - if the model cannot take the batch.
    pub fn add(&mut self, model: &WorldModel, batch: &Batch, index: u64) -> gawm_model::Result<()> {
        let (pass, clips) = (Pass::eval(), &batch.clips);
        let b = batch.clip_ids.len();
        let weight = b as f64;
        let z = model.encode(&clips.frames, &pass)?.detach(); // [B, T, D]
        let (_, t, _) = z.dims3()?;

        let losses = latent_losses(model, &z, clips, &self.objectives, &pass)?;
        if self.terms.is_empty() {
            self.terms = losses.terms.iter().map(|term| (term.term, 0.0)).collect();
        }
        for ((_, sum), term) in self.terms.iter_mut().zip(&losses.terms) {
            *sum += weight * f64::from(term.value.to_scalar::<f32>()?);
        }

        let (past, next) = (z.narrow(1, 0, t - 1)?, z.narrow(1, 1, t - 1)?); // [B, T-1, D]
        let predict = |actions: &Tensor| -> gawm_model::Result<f64> {
            let c = model.embed_actions(actions, &pass)?.narrow(1, 0, t - 1)?; // [B, T-1, D]
            let predicted = model.predict(&past, &c, &pass)?; // [B, T-1, D]
            Ok(f64::from(mse(&predicted, &next)?.to_scalar::<f32>()?))
        };
        self.prediction += weight * predict(&clips.actions)?;
        self.shuffled += weight * predict(&actions_of_others(&clips.actions, index)?)?;
        self.identity += weight * f64::from(mse(&past, &next)?.to_scalar::<f32>()?);

        self.latents.add(&z)?;
        self.add_heads(model, clips, &z, &pass)?;
        self.clips += b as u64;
        Ok(())
    }

    /// Adds the errors of the heads, dim by dim.
    fn add_heads(
        &mut self,
        model: &WorldModel,
        clips: &Clips,
        z: &Tensor,
        pass: &Pass,
    ) -> gawm_model::Result<()> {
        if self.objectives.computes(Term::StateAlignment) {
            let decoded = host(&model.read_states(z, pass)?)?;
            let mask = clips.state_mask.flatten_all()?.to_vec1::<u8>()?;
            self.states.add(&decoded, &host(&clips.states)?, |index| mask[index] != 0);
        }
        if self.objectives.computes(Term::InverseDynamics) {
            let (_, t, _) = z.dims3()?;
            let chunks = clips.actions.narrow(1, 0, t - 1)?; // [B, T-1, A]
            self.actions.add(&host(&model.read_actions(z, pass)?)?, &host(&chunks)?, |_| true);
        }
        Ok(())
    }

    /// Makes the record of a validation after `step` steps.
    pub fn finish(&self, step: u64, limits: CollapseLimits) -> ValidationRecord {
        let mean = |sum: f64| sum / (self.clips.max(1) as f64);
        let (prediction, identity) = (mean(self.prediction), mean(self.identity));
        let skill = Baseline::compare("identity", identity, prediction).skill;
        let shuffled = Baseline::compare("identity", identity, mean(self.shuffled)).skill;
        let latents = self.latents.summary();
        let states = self.states.reports();
        let actions = self.actions.reports();

        // The mean of all latents has the loss `variance`; a variance of zero leaves nothing to be better than.
        let ratio = if latents.variance > 0.0 { prediction / latents.variance } else { 1.0 };
        let terms: Vec<TermValue> =
            self.terms.iter().map(|(term, sum)| self.term(*term, mean(*sum))).collect();
        let value =
            |name: Term| terms.iter().find(|term| term.term == name.name()).map_or(0.0, |term| term.value);
        let score = ratio + value(Term::StateAlignment) + value(Term::InverseDynamics);
        ValidationRecord {
            step,
            clips: self.clips,
            skill,
            skill_shuffled_actions: shuffled,
            skill_drop: skill - shuffled,
            prediction_over_variance: ratio,
            latent_std: latents.mean_std,
            effective_rank: latents.effective_rank,
            collapse: collapse(latents.mean_std, latents.effective_rank, limits),
            score,
            is_best: false,
            terms,
            states,
            actions,
        }
    }

    /// A term beside what costs nothing to reach.
    fn term(&self, term: Term, value: f64) -> TermValue {
        let baseline = match term {
            Term::Prediction => {
                Some(Baseline::compare("identity", self.identity / self.clips.max(1) as f64, value))
            }
            Term::StateAlignment => Some(Baseline::compare("constant", self.states.mean_variance(), value)),
            Term::InverseDynamics => Some(Baseline::compare("constant", self.actions.mean_variance(), value)),
            _ => None,
        };
        TermValue { term: term.name().to_owned(), value, baseline }
    }
}

impl ValidationRecord {
    /// The first number that is none, by name.
    pub fn non_finite(&self) -> Option<(&str, f64)> {
        let terms = self.terms.iter().map(|term| (term.term.as_str(), term.value));
        let others = [("latent std", self.latent_std), ("skill", self.skill), ("score", self.score)];
        terms.chain(others).find(|(_, value)| !value.is_finite())
    }

    /// One line for people.
    pub fn line(&self) -> String {
        let mut text = format!("validation after {} steps:", self.step);
        for term in &self.terms {
            text.push_str(&format!(" {} {:.4}", term.term, term.value));
            if let Some(baseline) = &term.baseline {
                text.push_str(&format!(" ({} {:.4})", baseline.name, baseline.value));
            }
        }
        text.push_str(&format!(
            "; skill {:.3}, {:.3} with shuffled actions; latents std {:.3}, effective rank {:.1}; score {:.4}{}",
            self.skill,
            self.skill_shuffled_actions,
            self.latent_std,
            self.effective_rank,
            self.score,
            if self.is_best { ", the best so far" } else { "" }
        ));
        text
    }
}

fn collapse(std: f64, rank: f64, limits: CollapseLimits) -> Option<String> {
    if std < limits.std {
        Some(format!("standard deviation of the latents: expected {} or more, got {std:.2e}", limits.std))
    } else if rank < limits.rank {
        Some(format!("effective rank of the latents: expected {} or more, got {rank:.2}", limits.rank))
    } else {
        None
    }
}

/// Gives every clip the chunks of another: one cycle through all clips in random order, the same in every validation.
fn actions_of_others(actions: &Tensor, index: u64) -> gawm_model::Result<Tensor> {
    /// Any number; it must only be the same for all runs that are compared.
    const SEED: u64 = 0;
    let n = actions.dim(0)?;
    let order = permutation(&mut Stream::new(SEED, "validation/actions", index), n as u32);
    let mut source = vec![0u32; n];
    for (position, clip) in order.iter().enumerate() {
        source[*clip as usize] = order[(position + 1) % n];
    }
    actions.contiguous()?.index_select(&Tensor::from_vec(source, n, actions.device())?, 0)
}

fn host(tensor: &Tensor) -> gawm_model::Result<Vec<f32>> {
    tensor.contiguous()?.flatten_all()?.to_vec1::<f32>() // Sync: waits for the device.
}
