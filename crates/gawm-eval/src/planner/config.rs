//! What a user may say about planning.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// How the search goes.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// Cross-entropy method.
    #[default]
    Cem,
    /// Cross-entropy method with noise that is coloured along time, momentum and kept elites (iCEM).
    Icem,
    /// Path integral: samples weighted by exp(-cost / temperature).
    Mppi,
    /// Gradient descent (Adam) through the world model.
    Gradient,
}

/// Which implementation is repeated.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Compat {
    /// Ours.
    #[default]
    None,
    /// The published cross-entropy method, number by number.
    Reference,
}

/// Weights of the parts of a cost.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct ObjectiveWeights {
    /// Squared distance of the last latent to the goal's, summed over its values. The only one for headline numbers.
    pub latent: f64,
    /// Squared distance of the state that the head G reads from the last two latents to the one it reads from the goal.
    pub state: f64,
    /// Mean squared difference of consecutive standardised actions.
    pub smoothness: f64,
}

impl Default for ObjectiveWeights {
    fn default() -> Self {
        ObjectiveWeights { latent: 1.0, state: 0.0, smoothness: 0.0 }
    }
}

/// Settings of a planner. The default is the published size with our repairs.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub struct PlannerConfig {
    /// How the search goes.
    pub method: Method,
    /// Which implementation is repeated; `reference` needs the method `cem`.
    pub compat: Compat,
    /// Sequences per iteration.
    pub samples: usize,
    /// Iterations.
    pub iterations: usize,
    /// Sequences that the next distribution is fitted to, at least 2.
    pub elites: usize,
    /// Chunks of a plan.
    pub horizon: usize,
    /// Chunks that are executed before the next plan, at most `horizon`.
    pub receding: usize,
    /// First standard deviation, in units of standardised actions.
    pub sigma: f32,
    /// The standard deviation never falls below this. Unused by the published search.
    pub sigma_floor: f32,
    /// Whether samples are clamped to the action bounds of the environment, in standardised units.
    pub bounds: bool,
    /// Real frames that the first prediction sees, as far as there are: 1 as published, up to the model's history.
    pub history: usize,
    /// Whether a plan starts from what is left of the one before.
    pub warm_start: bool,
    /// Share of the old mean and deviation that is kept (iCEM).
    pub momentum: f32,
    /// Exponent of the spectrum of the noise along time (iCEM); 0 is white.
    pub noise_beta: f64,
    /// Elites of one iteration that are evaluated again in the next (iCEM).
    pub kept_elites: usize,
    /// Cost difference at which a weight falls to 1/e (MPPI).
    pub temperature: f32,
    /// Step of Adam (gradient).
    pub learning_rate: f32,
    /// Parts of the cost.
    pub objective: ObjectiveWeights,
    /// Time for one batch of plans in milliseconds, after which the best plan so far is taken; results then depend on
    /// the machine. None by default.
    pub deadline_ms: Option<u64>,
    /// Seed of all random numbers of planning.
    pub seed: u64,
}

impl Default for PlannerConfig {
    fn default() -> Self {
        PlannerConfig {
            method: Method::Cem,
            compat: Compat::None,
            samples: 300,
            iterations: 30,
            elites: 30,
            horizon: 5,
            receding: 5,
            sigma: 1.0,
            sigma_floor: 0.05,
            bounds: true,
            history: 1,
            warm_start: true,
            momentum: 0.1,
            noise_beta: 2.0,
            kept_elites: 5,
            temperature: 0.5,
            learning_rate: 0.1,
            objective: ObjectiveWeights::default(),
            deadline_ms: None,
            seed: 42,
        }
    }
}

/// Why a planner cannot be made.
#[derive(Debug, Clone, Error, PartialEq)]
#[error("planner.{field}: expected {expected}, got {got}")]
pub struct PlannerConfigError {
    /// The setting.
    pub field: &'static str,
    /// What is allowed.
    pub expected: &'static str,
    /// The value.
    pub got: String,
}

/// Most candidates of an iteration of one problem; bounds memory.
const MAX_SAMPLES: usize = 100_000;

impl PlannerConfig {
    /// Returns the settings that are enough for small models: 64 samples, 6 iterations, 8 elites.
    pub fn small() -> PlannerConfig {
        PlannerConfig { samples: 64, iterations: 6, elites: 8, ..PlannerConfig::default() }
    }

    /// Returns the published settings.
    pub fn reference() -> PlannerConfig {
        PlannerConfig { compat: Compat::Reference, ..PlannerConfig::default() }
    }

    /// Checks all settings.
    ///
    /// # Errors
    /// [`PlannerConfigError`] names the first that cannot be searched with.
    pub fn check(&self) -> Result<(), PlannerConfigError> {
        let refuse = |field, expected, got: String| Err(PlannerConfigError { field, expected, got });
        let positive = |value: f32| value.is_finite() && value > 0.0;
        let share = |value: f32| (0.0..1.0).contains(&value);
        let ObjectiveWeights { latent, state, smoothness } = self.objective;
        let kept_most = match self.method {
            Method::Icem => self.elites.min(self.samples.saturating_sub(1)),
            // The others keep none.
            _ => usize::MAX,
        };
        let counts = [
            ("samples", self.samples, 2, MAX_SAMPLES, "2 to 100000"),
            ("iterations", self.iterations, 1, 10_000, "1 to 10000"),
            ("elites", self.elites, 2, self.samples, "2 to the number of samples"),
            ("horizon", self.horizon, 1, 1000, "1 to 1000"),
            ("receding", self.receding, 1, self.horizon, "1 to the horizon"),
            ("history", self.history, 1, 1024, "1 to the history of the model"),
            ("kept_elites", self.kept_elites, 0, kept_most, "0 to the number of elites"),
        ];
        for (field, got, low, high, expected) in counts {
            if got < low || got > high {
                return refuse(field, expected, got.to_string());
            }
        }
        if self.compat == Compat::Reference && self.method != Method::Cem {
            return refuse(
                "method",
                "cem with compat = \"reference\"",
                format!("{:?}", self.method).to_lowercase(),
            );
        }
        if self.deadline_ms == Some(0) {
            return refuse("deadline_ms", "at least 1", "0".to_owned());
        }
        let numbers = [
            ("sigma", positive(self.sigma), "a positive number", self.sigma),
            ("sigma_floor", share(self.sigma_floor), "0 to below 1", self.sigma_floor),
            ("momentum", share(self.momentum), "0 to below 1", self.momentum),
            ("temperature", positive(self.temperature), "a positive number", self.temperature),
            ("learning_rate", positive(self.learning_rate), "a positive number", self.learning_rate),
            ("noise_beta", (0.0..=8.0).contains(&self.noise_beta), "0 to 8", self.noise_beta as f32),
        ];
        for (field, is_good, expected, got) in numbers {
            if !is_good {
                return refuse(field, expected, got.to_string());
            }
        }
        let weights = [latent, state, smoothness];
        if weights.iter().any(|weight| !weight.is_finite() || *weight < 0.0) || latent + state == 0.0 {
            return refuse(
                "objective",
                "weights from 0, latent or state above 0",
                format!("latent {latent}, state {state}, smoothness {smoothness}"),
            );
        }
        Ok(())
    }
}
