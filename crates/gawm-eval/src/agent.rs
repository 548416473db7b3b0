//! Agents: solvers without learning, and planning over dynamics.

use std::collections::BTreeMap;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use gawm_model::Stream;
use gawm_sim::two_room::{Geometry, distance_px};
use rayon::prelude::*;

use crate::evaluate::{Agent, Decision, PlanRecord, View};
use crate::planner::{ActionSpace, EvaluateError, Evaluator, PlanSource, Planner, PlannerConfig, Task};
use crate::world::World;

/// Does nothing.
#[derive(Debug, Clone)]
pub struct NoOp {
    /// Width of an action.
    pub action_width: usize,
}

impl Agent for NoOp {
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        views.iter().map(|_| one(vec![0.0; self.action_width])).collect()
    }
}

/// Draws each action uniformly from the bounds, each problem from its own stream.
#[derive(Debug, Clone)]
pub struct Random {
    /// Bounds of each dimension.
    pub bounds: Vec<(f64, f64)>,
    /// The seed.
    pub seed: u64,
}

impl Agent for Random {
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        let draw = |view: &View<'_>| {
            let mut stream = Stream::new(self.seed, &format!("random/{}", view.problem.id), view.step as u64);
            one(self
                .bounds
                .iter()
                .map(|(low, high)| (low + (high - low) * stream.uniform()) as f32)
                .collect())
        };
        views.iter().map(draw).collect()
    }
}

/// Goes straight to the goal, ignoring obstacles.
#[expect(missing_debug_implementations, reason = "a world is a trait object")]
pub struct StraightLine<'a> {
    /// The world that knows what straight is.
    pub world: &'a dyn World,
}

impl Agent for StraightLine<'_> {
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        let act = |view: &View<'_>| match self.world.straight_line(&view.state) {
            Some(action) => one(action),
            None => Err("this environment has no straight line".to_owned()),
        };
        views.iter().map(act).collect()
    }
}

/// Does what the solver with full knowledge does.
#[derive(Debug, Clone, Copy)]
pub struct Oracle;

impl Agent for Oracle {
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        views.iter().map(|view| one(view.oracle.clone())).collect()
    }
}

fn one(action: Vec<f32>) -> Result<Decision, String> {
    Ok(Decision { actions: vec![action], plan: None })
}

/// Dynamics that plans are made over: they turn what is seen into an evaluator.
pub trait Dynamics: Send + Sync {
    /// Returns how many frames an evaluator needs; 0 for dynamics that know the state.
    fn n_frames(&self) -> usize;

    /// Makes the evaluator of these views, position by position.
    ///
    /// # Errors
    /// The views cannot be encoded.
    fn bind<'a>(&'a self, views: &'a [View<'_>]) -> Result<Box<dyn Evaluator + 'a>, EvaluateError>;
}

/// Plans with receding horizon, all problems at once.
#[expect(missing_debug_implementations, reason = "planner and dynamics are trait objects")]
pub struct PlanningAgent<'a> {
    planner: Box<dyn Planner>,
    dynamics: Box<dyn Dynamics + 'a>,
    space: ActionSpace,
    config: PlannerConfig,
    /// What is left of the last plan of each problem, by position.
    remainders: Mutex<BTreeMap<usize, Vec<f32>>>,
}

impl<'a> PlanningAgent<'a> {
    /// Joins a search with dynamics.
    pub fn new(
        planner: Box<dyn Planner>,
        dynamics: Box<dyn Dynamics + 'a>,
        space: ActionSpace,
        config: PlannerConfig,
    ) -> Self {
        PlanningAgent { planner, dynamics, space, config, remainders: Mutex::new(BTreeMap::new()) }
    }

    /// The warm start of a view: what is left of the last plan, then the mean action.
    fn task(&self, view: &View<'_>, remainders: &BTreeMap<usize, Vec<f32>>) -> Task {
        let length = self.config.horizon * self.space.chunk_width();
        let start = remainders.get(&view.index).filter(|rest| self.config.warm_start && !rest.is_empty());
        let start = start.map(|rest| {
            let mut start = rest.clone();
            start.resize(length, 0.0);
            start
        });
        Task { stream: view.problem.id.clone(), plan: view.plan, start }
    }

    fn decision(&self, chunks: &[f32], record: PlanRecord) -> Decision {
        let executed = self.config.receding * self.space.frameskip;
        let actions = chunks.chunks_exact(self.space.action_width()).take(executed);
        Decision { actions: actions.map(|action| self.space.raw(action)).collect(), plan: Some(record) }
    }
}

impl Agent for PlanningAgent<'_> {
    fn n_frames(&self) -> usize {
        self.dynamics.n_frames()
    }

    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        let begin = Instant::now();
        let limit = self.config.deadline_ms.map(Duration::from_millis);
        let is_late = move || limit.is_some_and(|limit| begin.elapsed() >= limit);
        let evaluator = match self.dynamics.bind(views) {
            Ok(evaluator) => evaluator,
            Err(error) => return views.iter().map(|_| Err(error.to_string())).collect(),
        };
        let mut remainders = self.remainders.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let tasks: Vec<Task> = views.iter().map(|view| self.task(view, &remainders)).collect();
        let plans = self.planner.plan(evaluator.as_ref(), &tasks, &is_late);
        let finish = |(view, plan): (&View<'_>, Result<crate::planner::Plan, _>)| {
            let plan = plan.map_err(|error: crate::planner::PlannerError| error.to_string())?;
            let rest = plan.chunks.get(self.config.receding * self.space.chunk_width()..);
            remainders.insert(view.index, rest.unwrap_or_default().to_vec());
            let is_fallback = plan.source == PlanSource::Fallback;
            let record =
                PlanRecord { step: view.step, cost: plan.cost, lowest_costs: plan.lowest_costs, is_fallback };
            Ok(self.decision(&plan.chunks, record))
        };
        views.iter().zip(plans).map(finish).collect()
    }
}

/// The physics of a TwoRoom, with its wall or without: a ceiling and a floor for learnt dynamics.
#[derive(Debug, Clone)]
pub struct KnownDynamics {
    /// The physics.
    pub geometry: Geometry,
    /// Whether the wall is seen.
    pub has_wall: bool,
    /// How actions are standardised.
    pub space: ActionSpace,
}

struct KnownEvaluator<'a> {
    dynamics: &'a KnownDynamics,
    ends: Vec<([f32; 2], [f32; 2])>,
}

impl Dynamics for KnownDynamics {
    fn n_frames(&self) -> usize {
        0
    }

    fn bind<'a>(&'a self, views: &'a [View<'_>]) -> Result<Box<dyn Evaluator + 'a>, EvaluateError> {
        let pair =
            |values: &[f64]| std::array::from_fn(|i| values.get(i).map_or(f32::NAN, |value| *value as f32));
        let ends = views.iter().map(|view| (pair(&view.state.system), pair(&view.state.goal))).collect();
        Ok(Box::new(KnownEvaluator { dynamics: self, ends }))
    }
}

impl KnownEvaluator<'_> {
    /// Squared distance in pixels between where a sequence leads and the goal.
    fn cost(&self, task: usize, sequence: &[f32]) -> f32 {
        let KnownDynamics { geometry, has_wall, space } = self.dynamics;
        let (mut at, goal) = self.ends[task];
        for action in sequence.chunks_exact(2) {
            let raw = std::array::from_fn(|i| (f64::from(action[i]) * space.scale[i] + space.mean[i]) as f32);
            at = if *has_wall {
                geometry.next_position(at, raw)
            } else {
                geometry.next_position_without_wall(at, raw)
            };
        }
        distance_px(at, goal).powi(2)
    }
}

impl Evaluator for KnownEvaluator<'_> {
    fn width(&self) -> usize {
        self.dynamics.space.chunk_width()
    }

    fn costs(&self, tasks: &[usize], candidates: &[f32], horizon: usize) -> Result<Vec<f32>, EvaluateError> {
        let length = horizon * self.width();
        let n = candidates.len() / length / tasks.len().max(1);
        let cost = |(row, sequence): (usize, &[f32])| self.cost(tasks[row / n], sequence);
        Ok(candidates.par_chunks_exact(length).enumerate().map(cost).collect())
    }
}
