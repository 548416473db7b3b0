//! Searches on costs whose lowest point is known, and the published one against `gawm-model`.

use std::sync::atomic::{AtomicUsize, Ordering};

use gawm_model::plan::{CemConfig, Noise, SeededNoise as ModelNoise, Start, plan_to_goal};
use gawm_model::{Device, Stream, Tensor};

use super::*;
use crate::latent::LatentEvaluator;
use crate::testing::run;

/// A bowl around (1, -2) for every action; problem i's costs are scaled by i + 1.
struct Bowl {
    frameskip: usize,
    calls: AtomicUsize,
}

const CENTRE: [f32; 2] = [1.0, -2.0];

impl Evaluator for Bowl {
    fn width(&self) -> usize {
        2 * self.frameskip
    }

    fn costs(&self, tasks: &[usize], candidates: &[f32], horizon: usize) -> Result<Vec<f32>, EvaluateError> {
        self.calls.fetch_add(1, Ordering::Relaxed);
        let length = horizon * self.width();
        let n = candidates.len() / length / tasks.len();
        let cost = |(row, sequence): (usize, &[f32])| {
            let squares = |(index, x): (usize, &f32)| (x - CENTRE[index % 2]).powi(2);
            (tasks[row / n] + 1) as f32 * sequence.iter().enumerate().map(squares).sum::<f32>()
        };
        Ok(candidates.chunks_exact(length).enumerate().map(cost).collect())
    }

    fn gradients(
        &self,
        tasks: &[usize],
        candidates: &[f32],
        horizon: usize,
    ) -> Result<Option<Slopes>, EvaluateError> {
        let costs = self.costs(tasks, candidates, horizon)?;
        let slope = |(index, x): (usize, &f32)| 2.0 * (x - CENTRE[index % 2]);
        Ok(Some(Slopes { costs, gradients: candidates.iter().enumerate().map(slope).collect() }))
    }
}

fn bowl() -> Bowl {
    Bowl { frameskip: 1, calls: AtomicUsize::new(0) }
}

fn space(bound: f64) -> ActionSpace {
    let two = |value| vec![value; 2];
    ActionSpace { mean: two(0.0), scale: two(1.0), low: two(-bound), high: two(bound), frameskip: 1 }
}

fn tasks(names: &[&str]) -> Vec<Task> {
    names.iter().map(|name| Task { stream: (*name).to_owned(), plan: 0, start: None }).collect()
}

fn search(config: &PlannerConfig, bound: f64, names: &[&str]) -> Vec<Plan> {
    let planner = planner(config, &space(bound)).unwrap();
    planner.plan(&bowl(), &tasks(names), &no_deadline).into_iter().map(Result::unwrap).collect()
}

fn check_bottom(config: &PlannerConfig, tolerance: f32) {
    let plan = &search(config, 10.0, &["a"])[0];
    for (index, value) in plan.chunks.iter().enumerate() {
        let error = (value - CENTRE[index % 2]).abs();
        assert!(error < tolerance, "{:?} {:?}: value {index} off by {error}", config.method, config.compat);
    }
    let lowest = plan.lowest_costs.iter().copied().fold(f32::INFINITY, f32::min);
    assert!(plan.cost.is_none_or(|cost| cost <= lowest), "a plan is never worse than the best sample");
}

#[test]
fn all_methods_find_the_bottom() {
    let base = PlannerConfig { horizon: 3, receding: 3, ..PlannerConfig::default() };
    check_bottom(&base, 0.1); // the floor of sigma, 0.05, keeps it from settling
    check_bottom(&PlannerConfig { sigma_floor: 0.0, ..base.clone() }, 0.01);
    check_bottom(&PlannerConfig { compat: Compat::Reference, ..base.clone() }, 0.01);
    check_bottom(&PlannerConfig { method: Method::Icem, ..base.clone() }, 0.3);
    check_bottom(&PlannerConfig { method: Method::Mppi, temperature: 0.2, ..base.clone() }, 1.0);
    check_bottom(&PlannerConfig { method: Method::Gradient, iterations: 200, ..base }, 0.1);
}

#[test]
fn bounds_hold_in_standardised_units() {
    for method in [Method::Cem, Method::Icem, Method::Mppi, Method::Gradient] {
        let plan = &search(&PlannerConfig { method, ..PlannerConfig::default() }, 0.5, &["a"])[0];
        assert!(plan.chunks.iter().all(|value| value.abs() <= 0.5), "{method:?}: {:?}", plan.chunks);
    }
    let space =
        ActionSpace { mean: vec![0.5], scale: vec![0.25], low: vec![-1.0], high: vec![1.0], frameskip: 2 };
    assert_eq!(space.standardised_bounds(), [(-6.0, 2.0); 2]);
    assert_eq!(space.raw(&[2.0]), [1.0]);
    assert_eq!(space.standardised(&[1.0]), [2.0]);
}

#[test]
fn a_plan_does_not_depend_on_the_other_problems() {
    for method in [Method::Cem, Method::Icem, Method::Mppi] {
        let config = PlannerConfig { method, iterations: 5, ..PlannerConfig::default() };
        let together = search(&config, 1.0, &["a", "b", "c"]);
        assert_eq!(together[0], search(&config, 1.0, &["a"])[0], "{method:?}");
        assert_ne!(together[0].chunks, together[1].chunks, "each problem has its own stream");
    }
}

#[test]
fn a_deadline_ends_the_search_with_the_best_so_far() {
    let planner = planner(&PlannerConfig::default(), &space(10.0)).unwrap();
    let plan_until = |rounds: usize, start: Option<Vec<f32>>| {
        let evaluator = bowl();
        let is_late = || evaluator.calls.load(Ordering::Relaxed) >= rounds;
        let task = Task { stream: "a".to_owned(), plan: 0, start };
        planner.plan(&evaluator, &[task], &is_late).pop().unwrap().unwrap()
    };
    let start = vec![0.25; 10];
    let fallback = plan_until(0, Some(start.clone()));
    assert_eq!((fallback.source, fallback.chunks, fallback.cost), (PlanSource::Fallback, start, None));
    let early = plan_until(2, None);
    assert_eq!((early.source, early.lowest_costs.len()), (PlanSource::Sample, 2));
    assert_eq!(early.cost, early.lowest_costs.iter().copied().reduce(f32::min));
}

/// Costs that are NaN for one problem only.
struct Broken(Bowl);

impl Evaluator for Broken {
    fn width(&self) -> usize {
        self.0.width()
    }

    fn costs(&self, tasks: &[usize], candidates: &[f32], horizon: usize) -> Result<Vec<f32>, EvaluateError> {
        let mut costs = self.0.costs(tasks, candidates, horizon)?;
        let n = costs.len() / tasks.len();
        for (row, cost) in costs.iter_mut().enumerate() {
            if tasks[row / n] == 1 {
                *cost = f32::NAN;
            }
        }
        Ok(costs)
    }
}

#[test]
fn costs_that_are_no_numbers_fail_their_problem_alone() {
    for compat in [Compat::None, Compat::Reference] {
        let config = PlannerConfig { compat, iterations: 3, ..PlannerConfig::default() };
        let planner = planner(&config, &space(1.0)).unwrap();
        let plans = planner.plan(&Broken(bowl()), &tasks(&["a", "b", "c"]), &no_deadline);
        assert!(plans[0].is_ok() && plans[2].is_ok(), "{plans:?}");
        let error = plans[1].as_ref().unwrap_err().to_string();
        assert!(error.contains("finite costs in iteration 0, got 0"), "{error}");
    }
}

#[test]
fn a_start_of_another_length_is_refused() {
    let task = Task { stream: "a".to_owned(), plan: 0, start: Some(vec![0.0; 3]) };
    for config in [PlannerConfig::default(), PlannerConfig::reference()] {
        let planner = planner(&config, &space(1.0)).unwrap();
        let plan = planner.plan(&bowl(), std::slice::from_ref(&task), &no_deadline).pop().unwrap();
        assert!(matches!(plan, Err(PlannerError::Start { expected: 10, got: 3 })), "{plan:?}");
    }
}

#[test]
fn settings_out_of_range_are_named() {
    let base = PlannerConfig::default;
    for (config, field) in [
        (PlannerConfig { elites: 1, ..base() }, "elites"),
        (PlannerConfig { elites: 301, ..base() }, "elites"),
        (PlannerConfig { receding: 6, ..base() }, "receding"),
        (PlannerConfig { sigma: f32::NAN, ..base() }, "sigma"),
        (PlannerConfig { method: Method::Icem, ..PlannerConfig::reference() }, "method"),
        (PlannerConfig { samples: 1_000_000, ..base() }, "samples"),
        (
            PlannerConfig {
                objective: ObjectiveWeights { latent: 0.0, ..ObjectiveWeights::default() },
                ..base()
            },
            "objective",
        ),
    ] {
        assert_eq!(config.check().unwrap_err().field, field);
    }
}

#[test]
fn smoothness_makes_plans_smoother() {
    let weight = |smoothness| {
        let objective = ObjectiveWeights { smoothness, ..ObjectiveWeights::default() };
        let plan =
            &search(&PlannerConfig { objective, iterations: 8, ..PlannerConfig::small() }, 10.0, &["a"])[0];
        roughness(&plan.chunks, 2)
    };
    assert!(weight(100.0) < weight(0.0));
    assert_eq!(roughness(&[0.0, 0.0, 1.0, 3.0], 2), 5.0);
}

/// The noise of `gawm-model` for environment 0, so that both searches draw the same numbers.
struct Shared;

impl NoiseSource for Shared {
    fn draw(&self, _: &Task, iteration: usize, count: usize) -> Vec<f32> {
        ModelNoise { seed: 9, plan: 0 }.draw(0, iteration, count)
    }
}

fn latents(name: &str, shape: &[usize]) -> Tensor {
    let values = Stream::new(3, name, 0).normals(shape.iter().product());
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

#[test]
fn the_published_search_over_a_world_model_is_that_of_gawm_model() {
    let run = run(5);
    let (start, goal, executed) =
        (latents("start", &[1, 2, 16]), latents("goal", &[1, 16]), latents("chunk", &[1, 1, 10]));
    let config = PlannerConfig { samples: 40, iterations: 3, elites: 6, ..PlannerConfig::reference() };
    let evaluator = LatentEvaluator::new(
        &run.model,
        start.clone(),
        Some(executed.clone()),
        goal.clone(),
        config.samples,
        ObjectiveWeights::default(),
    );
    let ours = ReferenceCem::new(config, Shared)
        .plan(&evaluator, &tasks(&["a"]), &no_deadline)
        .pop()
        .unwrap()
        .unwrap();
    let theirs = plan_to_goal(
        &run.model,
        &[Start {
            latents: start.squeeze(0).unwrap(),
            executed: Some(executed.squeeze(0).unwrap()),
            goal: goal.squeeze(0).unwrap(),
        }],
        &[],
        &CemConfig { samples: 40, iterations: 3, elites: 6, ..CemConfig::default() },
        &mut ModelNoise { seed: 9, plan: 0 },
    )
    .unwrap()
    .remove(0);
    let expected: Vec<f32> = theirs.mean.flatten_all().unwrap().to_vec1().unwrap();
    assert_eq!(ours.chunks.len(), expected.len());
    for (a, b) in ours.chunks.iter().zip(&expected) {
        // The same elites; blocks of other sizes may sum products in another order.
        assert!((a - b).abs() < 1e-5, "{a} {b}");
    }
}

#[test]
fn costs_of_a_world_model_do_not_depend_on_the_batch_or_on_threads() {
    let run = run(6);
    let (starts, goals) = (latents("starts", &[3, 1, 16]), latents("goals", &[3, 16]));
    let candidates: Vec<f32> = Stream::new(3, "candidates", 0).normals(3 * 70 * 50);
    let weights = ObjectiveWeights { latent: 1.0, state: 0.5, smoothness: 0.0 };
    let evaluator = LatentEvaluator::new(&run.model, starts, None, goals, 70, weights);
    let all = evaluator.costs(&[0, 1, 2], &candidates, 5).unwrap();
    let alone = evaluator.costs(&[1], &candidates[70 * 50..140 * 50], 5).unwrap();
    assert_eq!(all[70..140], alone, "to the bit");
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one_thread.install(|| evaluator.costs(&[0, 1, 2], &candidates, 5).unwrap()), all);
}

#[test]
fn gradients_of_a_world_model_are_its_slopes() {
    let run = run(7);
    let weights = ObjectiveWeights { latent: 1.0, state: 0.3, smoothness: 0.0 };
    let (starts, goals) = (latents("starts", &[1, 1, 16]), latents("goals", &[1, 16]));
    // Modulation starts at zero, where actions have no effect: move it.
    for (name, spec) in run.model.parameters().specs().clone() {
        if name.contains("adaLN") {
            run.model.parameters().set(&name, &(latents(&name, &spec.shape) * 0.05).unwrap()).unwrap();
        }
    }
    let evaluator = LatentEvaluator::new(&run.model, starts, None, goals, 4, weights);
    let x = Stream::new(4, "x", 0).normals(4 * 20);
    let Slopes { costs, gradients: slopes } = evaluator.gradients(&[0], &x, 2).unwrap().unwrap();
    let again = evaluator.costs(&[0], &x, 2).unwrap();
    for (a, b) in costs.iter().zip(&again) {
        assert!((a - b).abs() <= 1e-4 * b.abs(), "{a} {b}");
    }
    let step = 2e-2;
    for index in [0, 13, 47, 79] {
        let moved = |by: f32| {
            let mut x = x.clone();
            x[index] += by;
            f64::from(evaluator.costs(&[0], &x, 2).unwrap()[index / 20])
        };
        let measured = (moved(step) - moved(-step)) / f64::from(2.0 * step);
        let slope = f64::from(slopes[index]);
        assert!((measured - slope).abs() < 0.03 * (0.1 + slope.abs()), "value {index}: {measured} {slope}");
    }
}
