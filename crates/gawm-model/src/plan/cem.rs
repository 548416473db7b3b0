//! The cross-entropy method over action sequences.

use candle_core::{Device, Tensor};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::random::Stream;

/// Settings of the search; the default is the published one.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct CemConfig {
    /// Sequences per iteration.
    pub samples: usize,
    /// Iterations.
    pub iterations: usize,
    /// Sequences that the next distribution is fitted to; at least 2.
    pub elites: usize,
    /// First standard deviation, in units of standardised actions.
    pub sigma: f32,
    /// Chunks `L` per sequence.
    pub horizon: usize,
}

impl Default for CemConfig {
    fn default() -> CemConfig {
        CemConfig { samples: 300, iterations: 30, elites: 30, sigma: 1.0, horizon: 5 }
    }
}

/// Where the standard normal numbers of a search come from; replaceable, so that published searches can be repeated.
pub trait Noise {
    /// Returns `count` numbers for an iteration of an environment: [N, L, A], row-major.
    fn draw(&mut self, environment: usize, iteration: usize, count: usize) -> Vec<f32>;
}

/// Noise as a function of seed, plan, environment and iteration.
#[derive(Debug, Clone, Copy)]
pub struct SeededNoise {
    /// The seed.
    pub seed: u64,
    /// Counts the plans of a run, so that each plan has its own numbers.
    pub plan: u64,
}

impl Noise for SeededNoise {
    fn draw(&mut self, environment: usize, iteration: usize, count: usize) -> Vec<f32> {
        Stream::new(self.seed, &format!("cem/{environment}/{iteration}"), self.plan).normals(count)
    }
}

/// The result of a search.
#[derive(Debug, Clone)]
pub struct CemPlan {
    /// Mean of the last elites, [L, A]: the plan. It was not itself evaluated.
    pub mean: Tensor,
    /// What each iteration saw.
    pub iterations: Vec<CemIteration>,
}

/// What one iteration saw and made of it.
#[derive(Debug, Clone, PartialEq)]
pub struct CemIteration {
    /// Cost of each sample.
    pub costs: Vec<f32>,
    /// The samples of lowest cost, cheapest first; ties by index.
    pub elites: Vec<usize>,
    /// Mean of the elites, [L, A] row-major.
    pub mean: Vec<f32>,
    /// Sample standard deviation (ddof 1) of the elites, [L, A] row-major.
    pub sigma: Vec<f32>,
}

/// Why a search cannot be made.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum PlanError {
    /// A setting is out of range.
    #[error("planner.{field}: expected {expected}, got {got}")]
    Config {
        /// The setting.
        field: &'static str,
        /// What is allowed.
        expected: &'static str,
        /// The value.
        got: String,
    },
    /// Too few costs are finite numbers: the model or its input is broken.
    #[error("planner: expected at least {elites} finite costs in iteration {iteration}, got {finite}")]
    NonFinite {
        /// Elites needed.
        elites: usize,
        /// The iteration.
        iteration: usize,
        /// Number of finite costs.
        finite: usize,
    },
    /// A warm start has the wrong shape.
    #[error("planner: expected a start mean of shape {expected:?}, got {got:?}")]
    Mean {
        /// [L, A].
        expected: [usize; 2],
        /// The shape given.
        got: Vec<usize>,
    },
    /// The noise source returned another number of values.
    #[error("planner: expected {expected} noise values, got {got}")]
    NoiseCount {
        /// N x L x A.
        expected: usize,
        /// Number of values.
        got: usize,
    },
    /// candle failed.
    #[error(transparent)]
    Candle(#[from] candle_core::Error),
}

impl CemConfig {
    fn check(&self) -> Result<(), PlanError> {
        let error = |field, expected, got: String| Err(PlanError::Config { field, expected, got });
        if self.elites < 2 {
            return error("elites", "at least 2, for a standard deviation", self.elites.to_string());
        }
        if self.samples < self.elites {
            return error("samples", "at least as many as elites", self.samples.to_string());
        }
        if self.iterations == 0 || self.horizon == 0 {
            return error("iterations and horizon", "at least 1", "0".to_owned());
        }
        if !(self.sigma.is_finite() && self.sigma > 0.0) {
            return error("sigma", "a positive number", self.sigma.to_string());
        }
        Ok(())
    }
}

/// Searches the action sequence of lowest cost for one environment.
///
/// Each iteration draws `mean + sigma * noise` with sample 0 replaced by the mean, takes the cheapest as elites, and
/// moves mean and sigma to theirs. `cost` maps candidates [N, L, A] to costs `[N]`.
///
/// # Errors
///
/// - [`PlanError`] for settings that cannot be searched with, and when too few costs are finite.
pub fn cem(
    config: &CemConfig,
    environment: usize,
    width: usize,
    start: Option<&Tensor>,
    noise: &mut dyn Noise,
    device: &Device,
    mut cost: impl FnMut(&Tensor) -> candle_core::Result<Tensor>,
) -> Result<CemPlan, PlanError> {
    config.check()?;
    let (n, l) = (config.samples, config.horizon);
    let mut mean = match start {
        None => vec![0.0; l * width],
        Some(start) if start.dims() == [l, width] => start.flatten_all()?.to_vec1::<f32>()?,
        Some(start) => return Err(PlanError::Mean { expected: [l, width], got: start.dims().to_vec() }),
    };
    let mut sigma = vec![config.sigma; l * width];
    let mut iterations = Vec::with_capacity(config.iterations);
    for iteration in 0..config.iterations {
        let mut candidates = noise.draw(environment, iteration, n * l * width);
        if candidates.len() != n * l * width {
            return Err(PlanError::NoiseCount { expected: n * l * width, got: candidates.len() });
        }
        for (index, sample) in candidates.chunks_exact_mut(l * width).enumerate() {
            for ((value, mean), sigma) in sample.iter_mut().zip(&mean).zip(&sigma) {
                *value = if index == 0 { *mean } else { mean + sigma * *value };
            }
        }
        let on_device = Tensor::from_slice(&candidates, (n, l, width), device)?;
        let costs = cost(&on_device)?.to_vec1::<f32>()?; // Sync: waits for the device.
        let elites = cheapest(&costs, config.elites, iteration)?;
        (mean, sigma) = moments(&candidates, l * width, &elites);
        iterations.push(CemIteration { costs, elites, mean: mean.clone(), sigma: sigma.clone() });
    }
    Ok(CemPlan { mean: Tensor::from_vec(mean, (l, width), device)?, iterations })
}

/// Returns the indices of the `count` lowest finite costs, cheapest first, ties by index.
fn cheapest(costs: &[f32], count: usize, iteration: usize) -> Result<Vec<usize>, PlanError> {
    let mut order: Vec<usize> = (0..costs.len()).filter(|&index| costs[index].is_finite()).collect();
    if order.len() < count {
        return Err(PlanError::NonFinite { elites: count, iteration, finite: order.len() });
    }
    order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(a.cmp(&b)));
    order.truncate(count);
    Ok(order)
}

/// Mean and sample standard deviation (ddof 1) over the chosen rows of [N, width], summed in f64.
fn moments(candidates: &[f32], width: usize, rows: &[usize]) -> (Vec<f32>, Vec<f32>) {
    let count = rows.len() as f64;
    let column = |index: usize| rows.iter().map(move |row| f64::from(candidates[row * width + index]));
    let moment = |index| {
        let mean = column(index).sum::<f64>() / count;
        let variance = column(index).map(|value| (value - mean).powi(2)).sum::<f64>() / (count - 1.0);
        (mean as f32, variance.sqrt() as f32)
    };
    (0..width).map(moment).unzip()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Cost of a quadratic bowl around (1, -2) repeated over the chunk.
    fn bowl(candidates: &Tensor) -> candle_core::Result<Tensor> {
        let target = Tensor::new(&[1f32, -2.0], candidates.device())?;
        candidates.broadcast_sub(&target)?.sqr()?.sum((1, 2))
    }

    fn search(config: &CemConfig, environment: usize) -> Result<CemPlan, PlanError> {
        let mut noise = SeededNoise { seed: 42, plan: 0 };
        cem(config, environment, 2, None, &mut noise, &Device::Cpu, bowl)
    }

    #[test]
    fn finds_the_bottom_of_a_bowl() {
        let plan = search(&CemConfig { horizon: 3, ..CemConfig::default() }, 0).unwrap();
        let mean = plan.mean.to_vec2::<f32>().unwrap();
        for row in mean {
            // Thirty elites of three hundred samples halve sigma in about two iterations; 30 iterations end below 1e-3.
            assert!((row[0] - 1.0).abs() < 1e-2 && (row[1] + 2.0).abs() < 1e-2, "{row:?}");
        }
    }

    #[test]
    fn a_search_repeats_and_environments_differ() {
        let config = CemConfig { iterations: 2, ..CemConfig::default() };
        let costs = |environment| search(&config, environment).unwrap().iterations[0].costs.clone();
        assert_eq!(costs(3), costs(3));
        assert_ne!(costs(3), costs(4));
    }

    #[test]
    fn useless_settings_and_costs_are_refused() {
        for (config, field) in [
            (CemConfig { elites: 1, ..CemConfig::default() }, "elites"),
            (CemConfig { samples: 10, ..CemConfig::default() }, "samples"),
            (CemConfig { horizon: 0, ..CemConfig::default() }, "horizon"),
            (CemConfig { sigma: f32::NAN, ..CemConfig::default() }, "sigma"),
        ] {
            let error = search(&config, 0).unwrap_err().to_string();
            assert!(error.contains(field), "{error}");
        }
        let mut noise = SeededNoise { seed: 0, plan: 0 };
        let nan = |candidates: &Tensor| bowl(candidates)? * f64::NAN;
        let result = cem(&CemConfig::default(), 0, 2, None, &mut noise, &Device::Cpu, nan);
        assert!(matches!(result, Err(PlanError::NonFinite { finite: 0, .. })), "{result:?}");
    }
}
