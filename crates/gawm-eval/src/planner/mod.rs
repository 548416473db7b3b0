//! Planners: searches for action sequences of low cost, over any dynamics.
//!
//! A [`Planner`] sees an [`Evaluator`] (candidates in, costs out) and nothing of models or environments, so that the same
//! search runs over a world model, over the true dynamics of an environment and over dynamics that ignore its wall.
//! [`ReferenceCem`] is the cross-entropy method exactly as published; it is `gawm_model::plan::cem`, which the golden
//! files test. [`SamplingPlanner`] is what we use: all problems in one batch, bounds, a floor under the spread, the best
//! plan seen, a deadline.
//!
//! **Invariant**: a plan is a function of the configuration, the evaluator and its own [`Task`]; neither the other
//! problems of the batch nor the number of threads change it.

mod config;
mod gradient;
mod noise;
mod reference;
mod sampling;
mod space;

use gawm_model::plan::PlanError;
use thiserror::Error;

pub use config::{Compat, Method, ObjectiveWeights, PlannerConfig, PlannerConfigError};
pub use gradient::GradientPlanner;
pub use noise::{NoiseSource, SeededNoise};
pub use reference::ReferenceCem;
pub use sampling::SamplingPlanner;
pub use space::ActionSpace;

/// Gives costs to candidate action sequences of one or more problems.
pub trait Evaluator: Sync {
    /// Returns the width `A` of a chunk.
    fn width(&self) -> usize;

    /// Returns the cost of each candidate, [`tasks`, N].
    ///
    /// `tasks` are positions of problems; `candidates` [`tasks`, N, L, A] are standardised chunks, row-major. The cost of a
    /// candidate depends on its own problem and numbers alone, to the bit. A cost that is not finite is never chosen.
    ///
    /// # Errors
    /// The dynamics cannot be computed at all.
    fn costs(&self, tasks: &[usize], candidates: &[f32], horizon: usize) -> Result<Vec<f32>, EvaluateError>;

    /// Returns costs and their gradients, or `None` where dynamics have no gradient.
    ///
    /// # Errors
    /// As for [`costs`](Self::costs).
    fn gradients(
        &self,
        _tasks: &[usize],
        _candidates: &[f32],
        _horizon: usize,
    ) -> Result<Option<Slopes>, EvaluateError> {
        Ok(None)
    }
}

/// Costs of candidates and which way they fall.
#[derive(Debug, Clone, PartialEq)]
pub struct Slopes {
    /// Costs [tasks, N].
    pub costs: Vec<f32>,
    /// Gradients of each cost by its own candidate, [tasks, N, L, A].
    pub gradients: Vec<f32>,
}

/// Why costs cannot be computed.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum EvaluateError {
    /// candle failed.
    #[error("the world model cannot be evaluated: {0}")]
    Candle(#[from] candle_core::Error),
}

/// What is planned for one problem.
#[derive(Debug, Clone, PartialEq)]
pub struct Task {
    /// Names the random stream: the problem's identifier.
    pub stream: String,
    /// Counts the plans of the problem; each has its own numbers.
    pub plan: u64,
    /// Warm start [L, A]; zero, the mean action, without it.
    pub start: Option<Vec<f32>>,
}

/// The result of a search.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Standardised chunks [L, A], row-major.
    pub chunks: Vec<f32>,
    /// Cost of `chunks`; `None` where it was never evaluated, as in the published search.
    pub cost: Option<f32>,
    /// Lowest cost of each iteration.
    pub lowest_costs: Vec<f32>,
    /// What the plan is.
    pub source: PlanSource,
}

/// What a plan is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PlanSource {
    /// The mean of the last distribution.
    Mean,
    /// The cheapest sequence that was seen.
    Sample,
    /// The start: the deadline passed before anything was evaluated.
    Fallback,
}

/// Why there is no plan for a problem.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PlannerError {
    /// The published search, or a setting of any, fails.
    #[error(transparent)]
    Search(#[from] PlanError),
    /// A warm start has the wrong length.
    #[error("planner: expected a start of {expected} values, got {got}")]
    Start {
        /// L x A.
        expected: usize,
        /// Values given.
        got: usize,
    },
    /// Too few costs are finite numbers.
    #[error("planner: expected at least {expected} finite costs in iteration {iteration}, got {finite}")]
    NonFinite {
        /// Elites needed.
        expected: usize,
        /// The iteration.
        iteration: usize,
        /// Number of finite costs.
        finite: usize,
    },
    /// The dynamics have no gradient.
    #[error("planner: the gradient method needs dynamics with a gradient, and these have none")]
    NoGradient,
    /// Costs cannot be computed.
    #[error("planner: {0}")]
    Evaluate(String),
}

impl From<EvaluateError> for PlannerError {
    fn from(error: EvaluateError) -> PlannerError {
        PlannerError::Evaluate(error.to_string())
    }
}

/// Whether planning has to stop now; called before each iteration.
pub type Deadline<'a> = &'a (dyn Fn() -> bool + Sync);

/// Never stops.
pub fn no_deadline() -> bool {
    false
}

/// Searches action sequences.
pub trait Planner: Send + Sync {
    /// Returns the name that reports show.
    fn name(&self) -> &'static str;

    /// Plans for all tasks at once; task i is problem i of the evaluator. One result per task, in order.
    fn plan(
        &self,
        evaluator: &dyn Evaluator,
        tasks: &[Task],
        is_late: Deadline<'_>,
    ) -> Vec<Result<Plan, PlannerError>>;
}

/// Makes the planner of a configuration.
///
/// # Errors
/// [`PlannerConfigError`] names a setting that cannot be searched with.
pub fn planner(config: &PlannerConfig, space: &ActionSpace) -> Result<Box<dyn Planner>, PlannerConfigError> {
    config.check()?;
    let noise = SeededNoise { seed: config.seed };
    Ok(match (config.compat, config.method) {
        (Compat::Reference, _) => Box::new(ReferenceCem::new(config.clone(), noise)),
        (Compat::None, Method::Gradient) => {
            Box::new(GradientPlanner::new(config.clone(), space.clone(), noise))
        }
        (Compat::None, _) => Box::new(SamplingPlanner::new(config.clone(), space.clone(), noise)),
    })
}

/// Mean squared difference of consecutive actions of a sequence [L, A] of chunks of `frameskip` actions.
fn roughness(sequence: &[f32], action_width: usize) -> f32 {
    let later = sequence.iter().skip(action_width);
    let (sum, n) =
        sequence.iter().zip(later).fold((0.0, 0), |(sum, n), (a, b)| (sum + (b - a) * (b - a), n + 1));
    if n == 0 { 0.0 } else { sum / n as f32 }
}

#[cfg(test)]
mod tests;
