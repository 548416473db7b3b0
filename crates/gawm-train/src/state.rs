//! Where a run is, as its checkpoints say it.

use std::path::{Path, PathBuf};

use gawm_model::checkpoint::{self, About, Checkpoint, CheckpointError};
use gawm_model::{AdamW, Device, WorldModel};
use gawm_schema::batch::Hello;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Version of the note.
const STATE_VERSION: u32 = 1;
/// Name of the note in the metadata of a checkpoint.
const NOTE_STATE: &str = "train";
/// Name of the note with the resolved configuration.
const NOTE_CONFIG: &str = "config";

/// Where a run is: with weights, moments and running statistics all that it needs to go on to the bit.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainState {
    /// Version of this text.
    pub format_version: u32,
    /// Optimiser steps taken.
    pub steps: u64,
    /// Position in the sequence of batches at which to go on: never within a validation.
    pub resume_at: u64,
    /// The best validation so far.
    pub best: Option<Best>,
    /// Hash of everything that decides the batches.
    pub stream_hash: String,
}

/// The best validation so far.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Best {
    /// Its score; the lower the better.
    pub score: f64,
    /// Optimiser steps taken before it.
    pub steps: u64,
}

/// Why a run cannot go on from a checkpoint.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ResumeError {
    /// The file is damaged.
    #[error(transparent)]
    Checkpoint(#[from] CheckpointError),
    /// The file does not say where the run was.
    #[error("checkpoint {path:?} is not of a run: {message}")]
    State {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// The data differs from what the run was trained on.
    #[error("cannot resume {path:?}: expected batches of stream {expected}, got {got}")]
    OtherData {
        /// The file.
        path: PathBuf,
        /// Stream hash of the run.
        expected: String,
        /// Stream hash of the loaders.
        got: String,
    },
}

/// What is loaded to go on with.
#[derive(Debug)]
pub struct Resumed {
    /// The model with its running statistics.
    pub model: WorldModel,
    /// The optimiser with its moments.
    pub optimizer: AdamW,
    /// Where the run was.
    pub state: TrainState,
}

impl TrainState {
    /// The state before the first step.
    pub fn fresh(hello: &Hello) -> TrainState {
        let stream_hash = hello.stream_hash().to_string();
        TrainState { format_version: STATE_VERSION, steps: 0, resume_at: 0, best: None, stream_hash }
    }

    /// Saves everything in one atomic step.
    ///
    /// # Errors
    ///
    /// - [`CheckpointError`]; an older file is untouched then.
    pub fn save(
        &self,
        path: &Path,
        model: &WorldModel,
        optimizer: &AdamW,
        hello: &Hello,
        config: &str,
    ) -> Result<(), CheckpointError> {
        let state = serde_json::to_string(self).expect("a struct of numbers and texts becomes JSON");
        let notes = [(NOTE_STATE.to_owned(), state), (NOTE_CONFIG.to_owned(), config.to_owned())];
        let about = About {
            statistics: Some(statistics(hello)),
            schema_hash: Some(hello.schema_hash.to_string()),
            notes: notes.into(),
        };
        checkpoint::save(path, model, &about, Some(optimizer))
    }

    /// Loads what [`TrainState::save`] wrote.
    ///
    /// # Errors
    ///
    /// - [`ResumeError`] if the file is damaged or no checkpoint of a run.
    pub fn load(path: &Path, device: &Device) -> Result<Resumed, ResumeError> {
        let Checkpoint { model, about, optimizer } = checkpoint::load(path, device)?;
        let refuse = |message: String| ResumeError::State { path: path.to_owned(), message };
        let text =
            about.notes.get(NOTE_STATE).ok_or_else(|| refuse(format!("expected a note {NOTE_STATE:?}")))?;
        let state: TrainState = serde_json::from_str(text).map_err(|error| refuse(error.to_string()))?;
        if state.format_version != STATE_VERSION {
            let got = state.format_version;
            return Err(refuse(format!("expected version {STATE_VERSION} of the state, got {got}")));
        }
        let optimizer = optimizer.ok_or_else(|| refuse("expected an optimiser, got none".to_owned()))?;
        if optimizer.step_count() != state.steps {
            let got = optimizer.step_count();
            return Err(refuse(format!("expected an optimiser after {} steps, got {got}", state.steps)));
        }
        Ok(Resumed { model, optimizer, state })
    }

    /// Checks that the loaders make the batches of this run.
    ///
    /// # Errors
    ///
    /// - [`ResumeError::OtherData`].
    pub fn check(&self, path: &Path, hello: &Hello) -> Result<(), ResumeError> {
        let got = hello.stream_hash().to_string();
        if got == self.stream_hash {
            return Ok(());
        }
        Err(ResumeError::OtherData { path: path.to_owned(), expected: self.stream_hash.clone(), got })
    }
}

/// The frozen standardisation, as checkpoints carry it.
fn statistics(hello: &Hello) -> String {
    let value = serde_json::json!({
        "frameskip": hello.frameskip,
        "rate_hz": hello.rate_hz,
        "action": hello.action,
        "state": hello.state,
    });
    value.to_string()
}
