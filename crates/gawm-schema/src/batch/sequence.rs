//! The order of batches in a run.

use serde::{Deserialize, Serialize};

/// Which episodes a batch is made of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Split {
    /// Training episodes (or clips, as published).
    Train,
    /// What is held out.
    Validation,
}

/// One batch of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub struct BatchId {
    /// What it is made of.
    pub split: Split,
    /// Training: pass over the training clips, from 0. Validation: which validation of the run it is, from 0.
    pub epoch: u64,
    /// Training: step of the run, from 0. Validation: batch of this validation, from 0.
    pub step: u64,
}

/// The order of all batches of a run; a pure function that trainer and loaders share.
///
/// Training steps come in order; after step s with `(s + 1) % validate_every == 0`, and after the last one, come
/// the validation batches. Loader k of K makes the batches n with `n % K == k`; the trainer takes them in order of n.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Sequence {
    /// Training steps of the run.
    pub total_steps: u64,
    /// Training steps between validations; 0: one validation, after the last step.
    pub validate_every: u64,
    /// Batches of a validation; 0: none.
    pub validation_batches: u64,
    /// Training steps of a pass over the data, at least 1.
    pub steps_per_epoch: u64,
}

/// Why a sequence cannot be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SequenceError {
    /// There is not one full batch of training clips.
    #[error("expected at least 1 training step per epoch, got 0")]
    NoSteps,
    /// The number of batches does not fit 64 bits.
    #[error(
        "expected fewer than 2^63 batches, got {total_steps} steps with {validation_batches} validation batches"
    )]
    TooLong {
        /// Training steps.
        total_steps: u64,
        /// Batches of a validation.
        validation_batches: u64,
    },
}

impl Sequence {
    /// Checks that the numbers make a sequence.
    ///
    /// # Errors
    /// - [`SequenceError::NoSteps`] if `steps_per_epoch` is 0
    /// - [`SequenceError::TooLong`] if there are 2^63 batches or more
    pub fn check(&self) -> Result<(), SequenceError> {
        if self.steps_per_epoch == 0 {
            return Err(SequenceError::NoSteps);
        }
        let batches = u128::from(self.total_steps)
            + u128::from(self.validations()) * u128::from(self.validation_batches);
        if batches >= 1 << 63 {
            let Sequence { total_steps, validation_batches, .. } = *self;
            return Err(SequenceError::TooLong { total_steps, validation_batches });
        }
        Ok(())
    }

    /// Returns the number of validations of the run.
    pub fn validations(&self) -> u64 {
        let round = self.steps_between();
        if round == 0 { 0 } else { self.total_steps.div_ceil(round) }
    }

    /// Returns the number of batches of the run.
    pub fn batches(&self) -> u64 {
        self.total_steps.saturating_add(self.validations().saturating_mul(self.validation_batches))
    }

    /// Returns the n-th batch, or `None` after the last.
    pub fn batch(&self, n: u64) -> Option<BatchId> {
        if n >= self.batches() {
            return None;
        }
        let round = self.steps_between();
        let length = round.saturating_add(self.validation_batches);
        let (validation, within) = (n / length, n % length);
        let first_step = validation * round;
        // The last round may be short.
        let steps = round.min(self.total_steps - first_step);
        if within < steps {
            let step = first_step + within;
            return Some(BatchId { split: Split::Train, epoch: step / self.steps_per_epoch.max(1), step });
        }
        Some(BatchId { split: Split::Validation, epoch: validation, step: within - steps })
    }

    /// Returns the position of a training step; validations before it lie before that position.
    ///
    /// A run that was stopped between a step and its validation goes on at the position after that step,
    /// `position_of_step(step) + 1`. For `step >= total_steps` it is the end.
    pub fn position_of_step(&self, step: u64) -> u64 {
        if step >= self.total_steps {
            return self.batches();
        }
        let validations = step.checked_div(self.steps_between()).unwrap_or(0);
        step + validations * self.validation_batches
    }

    /// Returns the steps before each validation.
    fn steps_between(&self) -> u64 {
        match self.validate_every {
            0 => self.total_steps,
            steps => steps.min(self.total_steps),
        }
    }
}

impl Split {
    /// Returns the number that stands for the split in a slot.
    pub fn code(self) -> u32 {
        match self {
            Split::Train => 0,
            Split::Validation => 1,
        }
    }

    /// Returns the split that a number stands for.
    pub fn from_code(code: u32) -> Option<Split> {
        match code {
            0 => Some(Split::Train),
            1 => Some(Split::Validation),
            _ => None,
        }
    }
}
