//! Gradient descent on the actions, through differentiable dynamics.

use super::{
    ActionSpace, Deadline, Evaluator, NoiseSource, Plan, PlanSource, Planner, PlannerConfig, PlannerError,
    Slopes, Task,
};

const BETA1: f32 = 0.9;
const BETA2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// Adam on a batch of sequences per problem: slot 0 starts at the warm start, the others at noise around it.
///
/// Returns the cheapest sequence that was evaluated; the published one forgets what came before the last step. The
/// smoothness weight is not part of its cost.
#[derive(Debug, Clone)]
pub struct GradientPlanner<N> {
    config: PlannerConfig,
    space: ActionSpace,
    noise: N,
}

impl<N: NoiseSource> GradientPlanner<N> {
    /// Makes the search with its source of noise.
    pub fn new(config: PlannerConfig, space: ActionSpace, noise: N) -> Self {
        GradientPlanner { config, space, noise }
    }

    fn search(
        &self,
        evaluator: &dyn Evaluator,
        index: usize,
        task: &Task,
        is_late: Deadline<'_>,
    ) -> Result<Plan, PlannerError> {
        let length = self.config.horizon * self.space.chunk_width();
        let start = task.start.clone().unwrap_or_else(|| vec![0.0; length]);
        if start.len() != length {
            return Err(PlannerError::Start { expected: length, got: start.len() });
        }
        let bounds = self.space.standardised_bounds();
        let mut x = self.noise.draw(task, 0, self.config.samples * length);
        for (slot, sample) in x.chunks_exact_mut(length).enumerate() {
            for (value, start) in sample.iter_mut().zip(&start) {
                *value = start + if slot == 0 { 0.0 } else { self.config.sigma * *value };
            }
        }
        let (mut first, mut second) = (vec![0.0f32; x.len()], vec![0.0f32; x.len()]);
        let mut best: Option<(f32, Vec<f32>)> = None;
        let mut lowest_costs = Vec::new();
        for iteration in 0..self.config.iterations {
            if is_late() {
                break;
            }
            if self.config.bounds {
                let clamp = |(value, (low, high)): (&mut f32, &(f32, f32))| *value = value.clamp(*low, *high);
                x.iter_mut().zip(bounds.iter().cycle()).for_each(clamp);
            }
            let found = evaluator.gradients(&[index], &x, self.config.horizon)?;
            let Slopes { costs, gradients } = found.ok_or(PlannerError::NoGradient)?;
            let cheapest = (0..costs.len())
                .filter(|&i| costs[i].is_finite())
                .min_by(|&a, &b| costs[a].total_cmp(&costs[b]));
            let Some(cheapest) = cheapest else {
                return Err(PlannerError::NonFinite { expected: 1, iteration, finite: 0 });
            };
            lowest_costs.push(costs[cheapest]);
            if best.as_ref().is_none_or(|(cost, _)| costs[cheapest] < *cost) {
                best = Some((costs[cheapest], x[cheapest * length..(cheapest + 1) * length].to_vec()));
            }
            let corrections = [BETA1, BETA2].map(|beta| 1.0 - beta.powi(iteration as i32 + 1));
            for ((x, g), (m, v)) in x.iter_mut().zip(&gradients).zip(first.iter_mut().zip(&mut second)) {
                *m = BETA1 * *m + (1.0 - BETA1) * g;
                *v = BETA2 * *v + (1.0 - BETA2) * g * g;
                *x -= self.config.learning_rate * (*m / corrections[0])
                    / ((*v / corrections[1]).sqrt() + EPSILON);
            }
        }
        Ok(match best {
            Some((cost, chunks)) => {
                Plan { chunks, cost: Some(cost), lowest_costs, source: PlanSource::Sample }
            }
            None => Plan { chunks: start, cost: None, lowest_costs, source: PlanSource::Fallback },
        })
    }
}

impl<N: NoiseSource> Planner for GradientPlanner<N> {
    fn name(&self) -> &'static str {
        "gradient"
    }

    fn plan(
        &self,
        evaluator: &dyn Evaluator,
        tasks: &[Task],
        is_late: Deadline<'_>,
    ) -> Vec<Result<Plan, PlannerError>> {
        let search = |(index, task): (usize, &Task)| self.search(evaluator, index, task, is_late);
        tasks.iter().enumerate().map(search).collect()
    }
}
