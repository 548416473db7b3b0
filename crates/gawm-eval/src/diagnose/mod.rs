//! Diagnostics of a run: how its latents move, what they hold, how far they can be predicted.
//!
//! Everything is computed over the same fixed trajectories, whose ids are stored: [`choose`] picks them by a seed from the
//! held-out episodes, [`encode`] turns them into [`Trajectory`]s. Definitions that the paper leaves open are stated here
//! and in `docs/evaluation.md`: stride 1, sample standard deviation, displacements of zero skipped and counted.

mod geometry;
mod rank;
mod retrieval;
mod rollouts;
mod trajectory;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

pub use geometry::{GeometryReport, TrajectoryGeometry, geometry, transition_spectrum};
pub use rank::{RankReport, rank};
pub use retrieval::{RetrievalReport, retrieval};
pub use rollouts::{HorizonReport, Prediction, RolloutReport, rollouts};
pub use trajectory::{Trajectory, choose, encode};

use crate::data::{Data, DataError};
use crate::probe::{ProbeOptions, ProbeReport, probe};
use crate::run::Run;
use crate::suite::ModelFacts;

/// Version of `diagnose.json`.
pub const DIAGNOSE_VERSION: u32 = 1;

/// What is diagnosed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct DiagnoseOptions {
    /// Number of trajectories.
    pub trajectories: usize,
    /// Longest part of an episode that is looked at, in rows.
    pub max_rows: usize,
    /// Rows from one latent to the next: 1, or the frameskip for what the predictor sees.
    pub stride: usize,
    /// Chunks that are predicted ahead.
    pub horizon: usize,
    /// Rows from a frame to its goal in goal retrieval.
    pub goal_offset: usize,
    /// Seed of the choice of trajectories, of pairs, and of the probes.
    pub seed: u64,
    /// Ids of the trajectories, instead of a choice.
    pub ids: Option<Vec<String>>,
    /// The probes.
    pub probe: ProbeOptions,
}

impl Default for DiagnoseOptions {
    fn default() -> Self {
        DiagnoseOptions {
            trajectories: 100,
            max_rows: 200,
            stride: 1,
            horizon: 5,
            goal_offset: 25,
            seed: 42,
            ids: None,
            probe: ProbeOptions::default(),
        }
    }
}

/// The result: `diagnose.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DiagnoseReport {
    /// [`DIAGNOSE_VERSION`].
    pub format_version: u32,
    /// The model.
    pub model: ModelFacts,
    /// How it was diagnosed.
    pub options: DiagnoseOptions,
    /// Whether the trajectories are held-out episodes; false where the dataset holds out none.
    pub is_held_out: bool,
    /// Ids of the trajectories, in order.
    pub trajectory_ids: Vec<String>,
    /// Latents in all.
    pub frames: usize,
    /// Straightening and transition spectrum.
    pub geometry: GeometryReport,
    /// How many directions the latents fill.
    pub rank: RankReport,
    /// Prediction over several chunks.
    pub rollouts: RolloutReport,
    /// What can be read from the latents.
    pub probe: ProbeReport,
    /// Whether the frame nearest to a goal's latent is near the goal.
    pub retrieval: Option<RetrievalReport>,
}

/// Why a run cannot be diagnosed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum DiagnoseError {
    /// The data.
    #[error(transparent)]
    Data(#[from] DataError),
    /// A frame cannot be resized.
    #[error("episode {episode}: {cause}")]
    Image {
        /// The episode.
        episode: String,
        /// The cause.
        cause: gawm_image::ImageError,
    },
    /// A stored id is not in the dataset.
    #[error("no episode {id:?} in the dataset, which --trajectories names")]
    UnknownId {
        /// The id.
        id: String,
    },
    /// No episode is long enough.
    #[error("no episode is long enough: expected at least {expected} rows, got at most {got}")]
    TooShort {
        /// Rows needed.
        expected: usize,
        /// Rows of the longest.
        got: usize,
    },
    /// An option is out of range.
    #[error("{field}: expected {expected}, got {got}")]
    Option {
        /// The option.
        field: &'static str,
        /// What is allowed.
        expected: &'static str,
        /// The value.
        got: usize,
    },
    /// The dataset is of another schema than the model was trained on.
    #[error("the dataset is of another schema: expected {expected} as the model was trained on, got {got}")]
    Schema {
        /// Schema hash of the training data.
        expected: String,
        /// Schema hash of the dataset.
        got: String,
    },
    /// The latents are not numbers.
    #[error("the model gives latents that are not finite (episode {episode}, row {row})")]
    NonFinite {
        /// The episode.
        episode: String,
        /// The row.
        row: usize,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl DiagnoseOptions {
    /// Checks all options.
    ///
    /// # Errors
    /// - [`DiagnoseError::Option`] names the first that is out of range.
    pub fn check(&self) -> Result<(), DiagnoseError> {
        for (field, got, low, high, expected) in [
            ("trajectories", self.trajectories, 1, 100_000, "1 to 100000"),
            ("max_rows", self.max_rows, 3, 100_000, "3 to 100000"),
            ("stride", self.stride, 1, 1000, "1 to 1000"),
            ("horizon", self.horizon, 1, 100, "1 to 100"),
            ("goal_offset", self.goal_offset, 1, 10_000, "1 to 10000"),
        ] {
            if got < low || got > high {
                return Err(DiagnoseError::Option { field, expected, got });
            }
        }
        Ok(())
    }
}

/// Checks that a dataset has the schema that a run was trained on.
///
/// # Errors
/// - [`DiagnoseError::Schema`].
pub fn check_schema(run: &Run, data: &Data) -> Result<(), DiagnoseError> {
    let known: Vec<String> =
        run.hello.datasets.iter().map(|dataset| dataset.schema_hash.to_string()).collect();
    match data.schema_hash() {
        Some(got) if !known.contains(&got) => {
            Err(DiagnoseError::Schema { expected: known.join(" or "), got })
        }
        _ => Ok(()),
    }
}

/// A report and what figures are drawn from.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// The report.
    pub report: DiagnoseReport,
    /// The trajectories.
    pub trajectories: Vec<Trajectory>,
    /// Geometry of each.
    pub geometries: Vec<TrajectoryGeometry>,
    /// Time beyond encoding. Never written.
    pub seconds: f64,
}

/// Diagnoses a run on the held-out episodes of a dataset.
///
/// `progress` is told the trajectories encoded so far.
///
/// # Errors
/// - [`DiagnoseError`] names option, episode or row.
pub fn diagnose(
    run: &Run,
    data: &Data,
    options: &DiagnoseOptions,
    progress: &(dyn Fn(usize) + Sync),
) -> Result<Diagnosis, DiagnoseError> {
    options.check()?;
    check_schema(run, data)?;
    let (episodes, is_held_out) = choose(data, options)?;
    let trajectories = encode(run, data, &episodes, options.max_rows, progress)?;
    let begin = std::time::Instant::now();
    let (geometry, geometries) = geometry(&trajectories, options.stride);
    let rank = rank(&trajectories);
    let (rollouts, predictions) = rollouts(run, &trajectories, options.horizon, options.seed)?;
    let probe = probe(run, &trajectories, &predictions, &options.probe, options.seed)?;
    let retrieval = retrieval(&trajectories, options.goal_offset, options.seed);
    let report = DiagnoseReport {
        format_version: DIAGNOSE_VERSION,
        model: ModelFacts::of(run),
        options: options.clone(),
        is_held_out,
        trajectory_ids: trajectories.iter().map(|trajectory| trajectory.id.clone()).collect(),
        frames: trajectories.iter().map(|trajectory| trajectory.n_rows).sum(),
        geometry,
        rank,
        rollouts,
        probe,
        retrieval,
    };
    Ok(Diagnosis { report, trajectories, geometries, seconds: begin.elapsed().as_secs_f64() })
}
