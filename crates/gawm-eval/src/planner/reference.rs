//! The published cross-entropy method behind the trait.

use candle_core::{Device, Tensor};
use gawm_model::plan::{CemConfig, Noise, cem};
use rayon::prelude::*;

use super::{Deadline, Evaluator, NoiseSource, Plan, PlanSource, Planner, PlannerConfig, PlannerError, Task};

/// The published search: no bounds, no floor, the plan is a mean that was never evaluated. It knows no deadline.
///
/// It stays in `gawm-model`, where the golden files test it; this only turns costs of candidates into its shape.
#[derive(Debug, Clone)]
pub struct ReferenceCem<N> {
    config: PlannerConfig,
    noise: N,
}

impl<N: NoiseSource> ReferenceCem<N> {
    /// Makes the search with its source of noise.
    pub fn new(config: PlannerConfig, noise: N) -> Self {
        ReferenceCem { config, noise }
    }

    fn search(&self, evaluator: &dyn Evaluator, index: usize, task: &Task) -> Result<Plan, PlannerError> {
        let PlannerConfig { samples, iterations, elites, sigma, horizon, .. } = self.config;
        let config = CemConfig { samples, iterations, elites, sigma, horizon };
        let width = evaluator.width();
        let start = match &task.start {
            Some(values) if values.len() != horizon * width => {
                return Err(PlannerError::Start { expected: horizon * width, got: values.len() });
            }
            Some(values) => Some(Tensor::from_slice(values, (horizon, width), &Device::Cpu).map_err(candle)?),
            None => None,
        };
        let cost = |candidates: &Tensor| {
            let candidates = candidates.flatten_all()?.to_vec1::<f32>()?;
            let costs = evaluator
                .costs(&[index], &candidates, horizon)
                .map_err(|error| candle_core::Error::Msg(error.to_string()))?;
            Tensor::from_vec(costs, samples, &Device::Cpu)
        };
        let mut noise = TaskNoise { source: &self.noise, task };
        let plan = cem(&config, index, width, start.as_ref(), &mut noise, &Device::Cpu, cost)?;
        let lowest = |costs: &[f32]| {
            costs.iter().copied().filter(|cost| cost.is_finite()).fold(f32::INFINITY, f32::min)
        };
        Ok(Plan {
            chunks: plan.mean.flatten_all().and_then(|mean| mean.to_vec1()).map_err(candle)?,
            cost: None,
            lowest_costs: plan.iterations.iter().map(|iteration| lowest(&iteration.costs)).collect(),
            source: PlanSource::Mean,
        })
    }
}

fn candle(error: candle_core::Error) -> PlannerError {
    PlannerError::Evaluate(error.to_string())
}

impl<N: NoiseSource> Planner for ReferenceCem<N> {
    fn name(&self) -> &'static str {
        "cem (reference)"
    }

    fn plan(
        &self,
        evaluator: &dyn Evaluator,
        tasks: &[Task],
        _is_late: Deadline<'_>,
    ) -> Vec<Result<Plan, PlannerError>> {
        tasks.par_iter().enumerate().map(|(index, task)| self.search(evaluator, index, task)).collect()
    }
}

/// The noise of one task in the shape that `gawm-model` asks for.
struct TaskNoise<'a, N> {
    source: &'a N,
    task: &'a Task,
}

impl<N: NoiseSource> Noise for TaskNoise<'_, N> {
    fn draw(&mut self, _environment: usize, iteration: usize, count: usize) -> Vec<f32> {
        self.source.draw(self.task, iteration, count)
    }
}
