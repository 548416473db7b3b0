//! CEM, iCEM and MPPI, all problems at once.

use rayon::prelude::*;

use super::noise::Colour;
use super::{
    ActionSpace, Deadline, Evaluator, Method, NoiseSource, Plan, PlanSource, Planner, PlannerConfig,
    PlannerError, Task, roughness,
};

/// A search that draws sequences around a mean, all problems in one batch.
///
/// Against the published one: samples stay within the action bounds, the spread never dies, what is returned is the
/// cheaper of the cheapest sequence seen and the last mean (which is evaluated for that), and a deadline ends the search
/// with the best so far, or with the start if nothing was evaluated.
#[derive(Debug, Clone)]
pub struct SamplingPlanner<N> {
    config: PlannerConfig,
    space: ActionSpace,
    noise: N,
    colour: Option<Colour>,
}

/// Where the search for one problem stands.
#[derive(Debug, Clone)]
struct Search {
    mean: Vec<f32>,
    sigma: Vec<f32>,
    best: Option<(f32, Vec<f32>)>,
    kept: Vec<Vec<f32>>,
    lowest_costs: Vec<f32>,
    error: Option<(usize, usize)>,
}

impl<N: NoiseSource> SamplingPlanner<N> {
    /// Makes the search with its source of noise.
    pub fn new(config: PlannerConfig, space: ActionSpace, noise: N) -> Self {
        let colour = (config.method == Method::Icem && config.noise_beta > 0.0)
            .then(|| Colour::new(config.horizon * space.frameskip, config.noise_beta));
        SamplingPlanner { config, space, noise, colour }
    }

    fn length(&self) -> usize {
        self.config.horizon * self.space.chunk_width()
    }

    fn begin(&self, task: &Task) -> Result<Search, PlannerError> {
        let length = self.length();
        let mean = match &task.start {
            Some(start) if start.len() != length => {
                return Err(PlannerError::Start { expected: length, got: start.len() });
            }
            Some(start) => start.clone(),
            None => vec![0.0; length],
        };
        let sigma = vec![self.config.sigma; length];
        Ok(Search { mean, sigma, best: None, kept: Vec::new(), lowest_costs: Vec::new(), error: None })
    }

    /// Draws [N, L, A]: slot 0 is the mean, then elites of the iteration before (iCEM), then samples.
    fn draw(&self, task: &Task, search: &Search, iteration: usize) -> Vec<f32> {
        let (n, length) = (self.config.samples, self.length());
        let bounds = self.config.bounds.then(|| self.space.standardised_bounds());
        let mut candidates = self.noise.draw(task, iteration, n * length);
        candidates.resize(n * length, 0.0);
        for (index, sample) in candidates.chunks_exact_mut(length).enumerate() {
            match index.checked_sub(1).map(|before| search.kept.get(before)) {
                None => sample.copy_from_slice(&search.mean),
                Some(Some(kept)) => sample.copy_from_slice(kept),
                Some(None) => {
                    if let Some(colour) = &self.colour {
                        colour.apply(sample, self.space.action_width());
                    }
                    for ((value, mean), sigma) in sample.iter_mut().zip(&search.mean).zip(&search.sigma) {
                        *value = mean + sigma * *value;
                    }
                }
            }
            if let Some(bounds) = &bounds {
                for (value, (low, high)) in sample.iter_mut().zip(bounds.iter().cycle()) {
                    *value = value.clamp(*low, *high);
                }
            }
        }
        candidates
    }

    /// Takes the costs of an iteration: remembers the best, moves mean and deviation.
    fn update(&self, search: &mut Search, candidates: &[f32], costs: &[f32], iteration: usize) {
        let length = self.length();
        let costs: Vec<f32> = costs
            .iter()
            .zip(candidates.chunks_exact(length))
            .map(|(cost, sample)| cost + self.penalty(sample))
            .collect();
        let mut order: Vec<usize> = (0..costs.len()).filter(|&index| costs[index].is_finite()).collect();
        if order.len() < self.config.elites {
            search.error = Some((iteration, order.len()));
            return;
        }
        order.sort_by(|&a, &b| costs[a].total_cmp(&costs[b]).then(a.cmp(&b)));
        let sample = |index: usize| &candidates[index * length..(index + 1) * length];
        search.lowest_costs.push(costs[order[0]]);
        offer(&mut search.best, costs[order[0]], sample(order[0]));
        if self.config.method == Method::Mppi {
            search.mean = self.weighted_mean(&order, &costs, sample);
            return;
        }
        order.truncate(self.config.elites);
        let momentum = if self.config.method == Method::Icem { self.config.momentum } else { 0.0 };
        for column in 0..length {
            let (mean, deviation) = moments(order.iter().map(|&index| f64::from(sample(index)[column])));
            let blend = |old: f32, new: f64| momentum * old + (1.0 - momentum) * new as f32;
            search.mean[column] = blend(search.mean[column], mean);
            search.sigma[column] = blend(search.sigma[column], deviation).max(self.config.sigma_floor);
        }
        if self.config.method == Method::Icem {
            let kept = self.config.kept_elites.min(self.config.samples - 1);
            search.kept = order.iter().take(kept).map(|&index| sample(index).to_vec()).collect();
        }
    }

    fn penalty(&self, sample: &[f32]) -> f32 {
        match self.config.objective.smoothness {
            0.0 => 0.0,
            weight => weight as f32 * roughness(sample, self.space.action_width()),
        }
    }

    /// Mean of all samples, weighted by exp(-(cost - lowest) / temperature).
    fn weighted_mean<'a>(
        &self,
        order: &[usize],
        costs: &[f32],
        sample: impl Fn(usize) -> &'a [f32],
    ) -> Vec<f32> {
        let lowest = costs[order[0]];
        let weight = |index: usize| f64::from(-(costs[index] - lowest) / self.config.temperature).exp();
        let weights: Vec<f64> = order.iter().map(|&index| weight(index)).collect();
        let total: f64 = weights.iter().sum();
        let column = |column: usize| {
            let terms =
                order.iter().zip(&weights).map(|(&index, weight)| weight * f64::from(sample(index)[column]));
            (terms.sum::<f64>() / total) as f32
        };
        (0..self.length()).map(column).collect()
    }

    /// One round over all live problems: draw, evaluate together, update.
    fn iterate(
        &self,
        evaluator: &dyn Evaluator,
        tasks: &[Task],
        searches: &mut [Result<Search, PlannerError>],
        iteration: usize,
    ) -> Result<(), PlannerError> {
        let live: Vec<usize> = live(searches);
        if live.is_empty() {
            return Ok(());
        }
        let candidates: Vec<f32> = live
            .par_iter()
            .flat_map_iter(|&index| {
                searches[index]
                    .as_ref()
                    .map(|search| self.draw(&tasks[index], search, iteration))
                    .unwrap_or_default()
            })
            .collect();
        let costs = evaluator.costs(&live, &candidates, self.config.horizon)?;
        let (per_problem, n) = (self.config.samples * self.length(), self.config.samples);
        let mut updates: Vec<(&mut Search, &[f32], &[f32])> = searches
            .iter_mut()
            .flatten()
            .filter(|search| search.error.is_none())
            .zip(candidates.chunks_exact(per_problem).zip(costs.chunks_exact(n)))
            .map(|(search, (candidates, costs))| (search, candidates, costs))
            .collect();
        updates
            .par_iter_mut()
            .for_each(|(search, candidates, costs)| self.update(search, candidates, costs, iteration));
        Ok(())
    }

    /// Evaluates the last means, so that they compete with the best samples.
    fn offer_means(
        &self,
        evaluator: &dyn Evaluator,
        searches: &mut [Result<Search, PlannerError>],
    ) -> Result<Vec<bool>, PlannerError> {
        let live = live(searches);
        if live.is_empty() {
            return Ok(vec![false; searches.len()]);
        }
        let mut means = Vec::with_capacity(live.len() * self.length());
        for search in searches.iter().flatten().filter(|search| search.error.is_none()) {
            let bounds = self.space.standardised_bounds();
            let clamp = |(value, (low, high)): (&f32, &(f32, f32))| {
                if self.config.bounds { value.clamp(*low, *high) } else { *value }
            };
            means.extend(search.mean.iter().zip(bounds.iter().cycle()).map(clamp));
        }
        let costs = evaluator.costs(&live, &means, self.config.horizon)?;
        let mut is_mean = vec![false; searches.len()];
        for ((index, mean), cost) in live.into_iter().zip(means.chunks_exact(self.length())).zip(costs) {
            if let Ok(search) = &mut searches[index] {
                is_mean[index] = offer(&mut search.best, cost + self.penalty(mean), mean);
            }
        }
        Ok(is_mean)
    }
}

/// Positions of the searches that still run.
fn live(searches: &[Result<Search, PlannerError>]) -> Vec<usize> {
    let is_live =
        |search: &Result<Search, PlannerError>| search.as_ref().is_ok_and(|search| search.error.is_none());
    (0..searches.len()).filter(|&index| is_live(&searches[index])).collect()
}

/// Keeps a sequence if it is cheaper than what is kept; returns whether it was.
fn offer(best: &mut Option<(f32, Vec<f32>)>, cost: f32, sequence: &[f32]) -> bool {
    let is_better = cost.is_finite() && best.as_ref().is_none_or(|(kept, _)| cost < *kept);
    if is_better {
        *best = Some((cost, sequence.to_vec()));
    }
    is_better
}

/// Mean and sample standard deviation (ddof 1), in f64.
fn moments(values: impl Iterator<Item = f64> + Clone) -> (f64, f64) {
    let (sum, n) = values.clone().fold((0.0, 0), |(sum, n), value| (sum + value, n + 1));
    let mean = sum / f64::from(n);
    let squares: f64 = values.map(|value| (value - mean).powi(2)).sum();
    (mean, (squares / f64::from(n - 1)).sqrt())
}

impl<N: NoiseSource> Planner for SamplingPlanner<N> {
    fn name(&self) -> &'static str {
        match self.config.method {
            Method::Icem => "icem",
            Method::Mppi => "mppi",
            Method::Cem | Method::Gradient => "cem",
        }
    }

    fn plan(
        &self,
        evaluator: &dyn Evaluator,
        tasks: &[Task],
        is_late: Deadline<'_>,
    ) -> Vec<Result<Plan, PlannerError>> {
        let mut searches: Vec<Result<Search, PlannerError>> =
            tasks.iter().map(|task| self.begin(task)).collect();
        let mut is_mean = vec![false; tasks.len()];
        let mut was_late = false;
        let outcome = (0..self.config.iterations).try_for_each(|iteration| {
            was_late |= is_late();
            if was_late { Ok(()) } else { self.iterate(evaluator, tasks, &mut searches, iteration) }
        });
        let outcome = outcome.and_then(|()| {
            if !was_late && !is_late() {
                is_mean = self.offer_means(evaluator, &mut searches)?;
            }
            Ok(())
        });
        if let Err(error) = outcome {
            let text = error.to_string();
            return tasks.iter().map(|_| Err(PlannerError::Evaluate(text.clone()))).collect();
        }
        searches.into_iter().zip(is_mean).map(|(search, is_mean)| self.finish(search?, is_mean)).collect()
    }
}

impl<N> SamplingPlanner<N> {
    fn finish(&self, search: Search, is_mean: bool) -> Result<Plan, PlannerError> {
        if let Some((iteration, finite)) = search.error {
            return Err(PlannerError::NonFinite { expected: self.config.elites, iteration, finite });
        }
        let lowest_costs = search.lowest_costs;
        Ok(match search.best {
            Some((cost, chunks)) => {
                let source = if is_mean { PlanSource::Mean } else { PlanSource::Sample };
                Plan { chunks, cost: Some(cost), lowest_costs, source }
            }
            None => Plan { chunks: search.mean, cost: None, lowest_costs, source: PlanSource::Fallback },
        })
    }
}
