//! The loop.

use gawm_model::checkpoint::CheckpointError;
use gawm_model::{AdamW, ConfigError, DataWidths, Device, Pass, Precision, Term, WorldModel};
use gawm_schema::batch::{BatchError, BatchView, Hello, Split};
use thiserror::Error;

use crate::batch::{Batch, UploadError, Uploader};
use crate::config::Config;
use crate::interrupt::Interrupt;
use crate::metrics::MetricsError;
use crate::output::Output;
use crate::run_folder::{RunFolder, RunFolderError, RunInfo};
use crate::source::{BatchSource, Expected, SourceError};
use crate::state::{Best, ResumeError, Resumed, TrainState};
use crate::step::{StepError, train_step};
use crate::validation::{CollapseLimits, Validation};

/// A run: a model, its optimiser, where it is, and where it writes.
#[derive(Debug)]
pub struct Trainer {
    config: Config,
    hello: Hello,
    expected: Expected,
    uploader: Uploader,
    precision: Precision,
    model: WorldModel,
    optimizer: AdamW,
    state: TrainState,
    folder: RunFolder,
    output: Output,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Outcome {
    /// All steps were taken.
    Finished,
    /// Saved after this many steps, because the user wanted it to end.
    Interrupted {
        /// Steps taken.
        steps: u64,
    },
}

/// Why a run stopped.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum TrainError {
    /// The sizes make no model.
    #[error("[model]: {0}")]
    Model(#[from] ConfigError),
    /// Configuration and data do not fit each other.
    #[error("{what}: expected {expected}, got {got}")]
    Mismatch {
        /// What does not fit.
        what: &'static str,
        /// What would.
        expected: String,
        /// What is there.
        got: String,
    },
    /// The layout of the batches cannot be.
    #[error(transparent)]
    Layout(#[from] BatchError),
    /// A batch does not come.
    #[error(transparent)]
    Source(#[from] SourceError),
    /// A batch does not fit the device.
    #[error(transparent)]
    Upload(#[from] UploadError),
    /// A step was not taken.
    #[error(transparent)]
    Step(#[from] StepError),
    /// A checkpoint cannot be written.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The run cannot go on.
    #[error(transparent)]
    Resume(#[from] ResumeError),
    /// Metrics cannot be written.
    #[error(transparent)]
    Metrics(#[from] MetricsError),
    /// The folder of the run refuses.
    #[error(transparent)]
    Folder(#[from] RunFolderError),
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl Trainer {
    /// Prepares a run on the data that `hello` describes, from the start or from what was `resumed`.
    ///
    /// # Errors
    ///
    /// - [`TrainError::Model`], [`TrainError::Mismatch`] if configuration and data do not fit each other.
    /// - [`TrainError::Resume`] if the data is not that of the resumed run.
    pub fn new(
        config: Config,
        hello: Hello,
        device: &Device,
        folder: RunFolder,
        resumed: Option<Resumed>,
        talk: crate::output::Talk,
    ) -> Result<Trainer, TrainError> {
        check_fit(&config, &hello)?;
        let Resumed { model, optimizer, state } = match resumed {
            Some(resumed) => {
                resumed.state.check(&folder.last(), &hello)?;
                resumed
            }
            None => {
                let widths = DataWidths { action: hello.shape.action_width, state: hello.shape.state_width };
                let architecture = config.model.clone().resolve(widths)?;
                let model = WorldModel::new(architecture, config.train.seed, device)?;
                let optimizer = AdamW::new(config.train.optimizer());
                Resumed { model, optimizer, state: TrainState::fresh(&hello) }
            }
        };
        let train = &config.train;
        let precision = train.precision_on(device);
        folder.write_hello(&hello)?;
        folder.write_info(&RunInfo::new(&hello, model.parameters().count(), precision))?;
        let output = Output::open(&folder, &config, &state, &hello, talk)?;
        Ok(Trainer {
            expected: Expected::of(&hello)?,
            uploader: Uploader::new(device, &hello, train.supervised.as_deref(), &train.velocity)?,
            precision,
            model,
            optimizer,
            state,
            folder,
            output,
            hello,
            config,
        })
    }

    /// Trains until all steps are taken or the user wants an end.
    ///
    /// # Errors
    ///
    /// - [`TrainError`]; the checkpoints on disk stay as they were.
    pub fn run<S: BatchSource>(
        &mut self,
        source: &mut S,
        interrupt: &Interrupt,
    ) -> Result<Outcome, TrainError> {
        let sequence = self.hello.sequence;
        let schedule = self.config.train.schedule();
        let mut validation = Validation::new(&self.config.objectives, &self.hello);
        let mut n = self.state.resume_at;

        while let Some(id) = sequence.batch(n) {
            // Stop: what was done is saved, a validation under way is done again.
            let batch = match self.receive(source, n) {
                _ if interrupt.is_set() => return self.stop(),
                Err(TrainError::Source(SourceError::Interrupted { .. })) => return self.stop(),
                batch => batch?,
            };
            n += 1;
            match id.split {
                // Step: losses, gradients, clip, AdamW.
                Split::Train => {
                    let rate = schedule.rate(id.step);
                    let pass =
                        Pass { precision: self.precision, ..Pass::train(self.config.train.seed, id.step) };
                    let objectives = &self.config.objectives;
                    let step = train_step(&self.model, &mut self.optimizer, &batch, objectives, rate, &pass)?;
                    self.state.steps = id.step + 1;
                    self.state.resume_at = n;
                    self.output.step(id, &step)?;
                    // The last step and a validation save by themselves.
                    let is_due = self.state.steps.is_multiple_of(self.config.train.checkpoint_every);
                    if is_due && n < sequence.batches() {
                        self.save_last()?;
                    }
                }
                // Validation: the last batch of it makes the record, and the best checkpoint if it is one.
                Split::Validation => {
                    validation.add(&self.model, &batch, id.step)?;
                    if id.step + 1 == sequence.validation_batches {
                        self.state.resume_at = n;
                        self.finish_validation(&validation, &batch)?;
                        validation = Validation::new(&self.config.objectives, &self.hello);
                    }
                }
            }
        }
        self.save_last()?;
        let summary = self.output.summary(self.state.best)?;
        self.folder.write_summary(&summary)?;
        Ok(Outcome::Finished)
    }

    /// Where the run is.
    pub fn state(&self) -> &TrainState {
        &self.state
    }

    /// The model as it is now.
    pub fn model(&self) -> &WorldModel {
        &self.model
    }

    /// Waits for the n-th batch and copies it to the device; its slot is free again when this returns.
    fn receive<S: BatchSource>(&self, source: &mut S, n: u64) -> Result<Batch, TrainError> {
        let slot = source.next(n)?;
        let view: BatchView<'_> = self.expected.view(n, &slot)?;
        Ok(self.uploader.upload(&view)?)
    }

    fn finish_validation(&mut self, validation: &Validation, batch: &Batch) -> Result<(), TrainError> {
        let train = &self.config.train;
        let limits = CollapseLimits { std: train.collapse_std, rank: train.collapse_rank };
        let mut record = validation.finish(self.state.steps, limits);
        if let Some((name, value)) = record.non_finite() {
            return Err(TrainError::Step(StepError::NonFinite {
                what: "validation loss",
                step: self.state.steps,
                rate: 0.0,
                gradient_norm: 0.0,
                terms: vec![(name.to_owned(), value)],
                clip_ids: batch.clip_ids.clone(),
            }));
        }
        record.is_best = self.state.best.is_none_or(|best| record.score < best.score);
        if record.is_best {
            self.state.best = Some(Best { score: record.score, steps: self.state.steps });
        }
        let is_best = record.is_best;
        self.output.validation(record)?;
        if is_best {
            self.save(&self.folder.best(), "best")?;
        }
        match self.state.resume_at < self.hello.sequence.batches() {
            true => self.save_last(),
            false => Ok(()), // the end of the run saves
        }
    }

    fn stop(&mut self) -> Result<Outcome, TrainError> {
        self.save_last()?;
        Ok(Outcome::Interrupted { steps: self.state.steps })
    }

    fn save_last(&self) -> Result<(), TrainError> {
        self.save(&self.folder.last(), "last")
    }

    /// Saves a checkpoint; the metrics that it stands for are on disk before.
    fn save(&self, path: &std::path::Path, name: &str) -> Result<(), TrainError> {
        self.output.sync()?;
        self.output.trace(&format!("saving {name} after {} steps", self.state.steps));
        let config = self.config.to_toml();
        self.state.save(path, &self.model, &self.optimizer, &self.hello, &config)?;
        self.output.trace(&format!("saved {name}"));
        Ok(())
    }
}

/// Refuses data that the model or the objectives cannot be trained on.
fn check_fit(config: &Config, hello: &Hello) -> Result<(), TrainError> {
    let train = &config.train;
    let (frames, history) = (hello.shape.frames, config.model.predictor.history);
    if frames < 2 || frames - 1 > history {
        return Err(TrainError::Mismatch {
            what: "frames of a clip",
            expected: format!("2 to {} (model.predictor.history + 1)", history + 1),
            got: frames.to_string(),
        });
    }
    if hello.shape.state_width == 0 && config.objectives.computes(Term::StateAlignment) {
        return Err(TrainError::Mismatch {
            what: "term state-alignment",
            expected: "a dataset with states".to_owned(),
            got: "one without; see [loader] and [objectives]".to_owned(),
        });
    }
    let sequence = hello.sequence;
    for (what, expected, got) in [
        ("train.steps of the loaders", train.steps, sequence.total_steps),
        ("train.validate_every of the loaders", train.validate_every, sequence.validate_every),
        // Fewer where fewer clips are held out.
        (
            "train.validation_batches of the loaders",
            train.validation_batches.min(sequence.validation_batches),
            sequence.validation_batches,
        ),
    ] {
        if expected != got {
            return Err(TrainError::Mismatch { what, expected: expected.to_string(), got: got.to_string() });
        }
    }
    Ok(())
}
