//! The harness: agents act on problems, step by step, and what happens is recorded.
//!
//! All problems of a set run side by side, so that an agent plans for all of them in one batch. An environment or a plan
//! that fails ends its own problem only; the record says so.

use std::collections::VecDeque;

use gawm_sim::{Environment, Frame, State};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::problem::Problem;
use crate::world::World;

/// Steps that the published evaluation gives a solver.
pub const REFERENCE_BUDGET_STEPS: usize = 50;

/// What an agent may look at when it decides.
#[derive(Debug)]
pub struct View<'a> {
    /// Position of the problem in its set.
    pub index: usize,
    /// The problem.
    pub problem: &'a Problem,
    /// Steps taken so far.
    pub step: usize,
    /// Decisions made so far.
    pub plan: u64,
    /// The state of the environment; for solvers that are allowed to know it.
    pub state: State,
    /// What the privileged solver of the environment would do.
    pub oracle: Vec<f32>,
    /// Frames at the starts of the last chunks, the current one last; empty unless the agent asks for frames.
    pub frames: &'a [Frame],
    /// Raw actions of the chunks between `frames`, one list of actions per chunk.
    pub executed: &'a [Vec<Vec<f32>>],
}

/// Raw actions to take next, and how they were found.
#[derive(Debug, Clone, PartialEq)]
pub struct Decision {
    /// At least one action, in order.
    pub actions: Vec<Vec<f32>>,
    /// What the planner says about its plan.
    pub plan: Option<PlanRecord>,
}

/// What is kept of a plan.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlanRecord {
    /// Step at which it was made.
    pub step: usize,
    /// Cost of the plan, where it was evaluated.
    pub cost: Option<f32>,
    /// Lowest cost of each iteration.
    pub lowest_costs: Vec<f32>,
    /// Whether the deadline passed before anything was evaluated, so that the start was taken.
    pub is_fallback: bool,
}

/// Something that acts.
pub trait Agent: Sync {
    /// Returns how many frames the agent looks at; 0 spares rendering.
    fn n_frames(&self) -> usize {
        0
    }

    /// Decides for the given problems at once. One result per view, in order; an `Err` fails the problem with its text.
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>>;
}

/// What happened on one problem.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Identifier of the problem.
    pub id: String,
    /// The episode that both ends come from.
    pub episode: String,
    /// Row of the start in the episode.
    pub start_row: usize,
    /// Row of the goal in the episode.
    pub goal_row: usize,
    /// System state at the start.
    pub start: Vec<f64>,
    /// The goal.
    pub goal: Vec<f64>,
    /// Whether the start is a solution already.
    pub is_trivial: bool,
    /// Whether the task was solved after any step, as published.
    pub success_any: bool,
    /// Whether it was solved after the last step.
    pub success_last: bool,
    /// The first step after which it was solved, from 1.
    pub first_success_step: Option<usize>,
    /// Distance to the goal after each step, in the unit of the goal.
    pub distances: Vec<f64>,
    /// System state before the first and after each step.
    pub states: Vec<Vec<f64>>,
    /// Raw actions taken.
    pub actions: Vec<Vec<f32>>,
    /// The plans made.
    pub plans: Vec<PlanRecord>,
    /// Why the problem ended early, if it did.
    pub failure: Option<Failure>,
}

/// Why a problem ended early. It counts as not solved at the last step.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Failure {
    /// Steps taken before.
    pub step: usize,
    /// `environment` or `agent`.
    pub what: FailedPart,
    /// What it said.
    pub reason: String,
}

/// What failed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FailedPart {
    /// The environment refused a state or an action.
    Environment,
    /// The agent found no action.
    Agent,
}

/// How long and in which steps.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Rules {
    /// Steps that a solver has.
    pub budget_steps: usize,
    /// Steps in a chunk: how often frames are kept.
    pub frameskip: usize,
}

/// One problem on its way.
struct Run<'a> {
    problem: &'a Problem,
    environment: Box<dyn Environment>,
    frames: Vec<Frame>,
    executed: Vec<Vec<Vec<f32>>>,
    chunk: Vec<Vec<f32>>,
    buffer: VecDeque<Vec<f32>>,
    n_plans: u64,
    outcome: Outcome,
}

/// Lets an agent act on all problems and returns an outcome for each, in order.
///
/// `progress` is called with the number of steps taken so far.
pub fn evaluate(
    world: &dyn World,
    problems: &[Problem],
    agent: &dyn Agent,
    rules: Rules,
    progress: &dyn Fn(usize),
) -> Vec<Outcome> {
    let mut runs: Vec<Run<'_>> =
        problems.par_iter().map(|problem| Run::begin(world, problem, agent)).collect();
    for step in 0..rules.budget_steps {
        decide(&mut runs, agent, step);
        runs.par_iter_mut().for_each(|run| run.step(agent, rules, step));
        progress(step + 1);
    }
    runs.into_iter().map(|run| run.outcome).collect()
}

/// Asks for decisions for all live problems that have no action left.
fn decide(runs: &mut [Run<'_>], agent: &dyn Agent, step: usize) {
    let waiting: Vec<usize> =
        (0..runs.len()).filter(|&i| runs[i].outcome.failure.is_none() && runs[i].buffer.is_empty()).collect();
    if waiting.is_empty() {
        return;
    }
    let view = |&index: &usize| {
        let run = &runs[index];
        View {
            index,
            problem: run.problem,
            step,
            plan: run.n_plans,
            state: run.environment.state(),
            oracle: run.environment.oracle(),
            frames: &run.frames,
            executed: &run.executed,
        }
    };
    let views: Vec<View<'_>> = waiting.iter().map(view).collect();
    let decisions = agent.decide(&views);
    for (index, decision) in waiting.into_iter().zip(decisions) {
        runs[index].take(decision, step);
    }
}

impl<'a> Run<'a> {
    fn begin(world: &dyn World, problem: &'a Problem, agent: &dyn Agent) -> Run<'a> {
        let mut environment = world.environment();
        let mut outcome = Outcome {
            id: problem.id.clone(),
            episode: problem.episode.clone(),
            start_row: problem.start_row,
            goal_row: problem.goal_row,
            start: problem.state.system.clone(),
            goal: problem.state.goal.clone(),
            is_trivial: problem.is_trivial,
            success_any: false,
            success_last: false,
            first_success_step: None,
            distances: Vec::new(),
            states: vec![problem.state.system.clone()],
            actions: Vec::new(),
            plans: Vec::new(),
            failure: None,
        };
        if let Err(error) = environment.set_state(&problem.state) {
            outcome.failure =
                Some(Failure { step: 0, what: FailedPart::Environment, reason: error.to_string() });
        }
        let mut run = Run {
            problem,
            environment,
            frames: Vec::new(),
            executed: Vec::new(),
            chunk: Vec::new(),
            buffer: VecDeque::new(),
            n_plans: 0,
            outcome,
        };
        run.look(agent);
        run
    }

    /// Keeps the current frame, and no more of them than the agent looks at.
    fn look(&mut self, agent: &dyn Agent) {
        if agent.n_frames() == 0 || self.outcome.failure.is_some() {
            return;
        }
        let mut frame = Frame::default();
        self.environment.render(&mut frame);
        self.frames.push(frame);
        let surplus = self.frames.len().saturating_sub(agent.n_frames());
        self.frames.drain(..surplus);
        let surplus = self.executed.len().saturating_sub(agent.n_frames() - 1);
        self.executed.drain(..surplus);
    }

    fn take(&mut self, decision: Result<Decision, String>, step: usize) {
        let mut fail =
            |reason| self.outcome.failure = Some(Failure { step, what: FailedPart::Agent, reason });
        match decision {
            Ok(decision) if decision.actions.is_empty() => fail("the agent gave no action".to_owned()),
            Ok(decision) => {
                self.buffer = decision.actions.into();
                self.n_plans += 1;
                self.outcome.plans.extend(decision.plan);
            }
            Err(reason) => fail(reason),
        }
    }

    fn step(&mut self, agent: &dyn Agent, rules: Rules, step: usize) {
        let action = match self.buffer.pop_front() {
            Some(action) if self.outcome.failure.is_none() => action,
            _ => return,
        };
        match self.environment.step(&action) {
            Ok(result) => {
                self.outcome.distances.push(result.distance);
                self.outcome.states.push(self.environment.state().system);
                self.outcome.success_last = result.terminated;
                self.outcome.success_any |= result.terminated;
                if result.terminated {
                    self.outcome.first_success_step.get_or_insert(step + 1);
                }
            }
            Err(error) => {
                let what = FailedPart::Environment;
                self.outcome.failure = Some(Failure { step, what, reason: error.to_string() });
                self.outcome.success_last = false;
                return;
            }
        }
        self.outcome.actions.push(action.clone());
        self.chunk.push(action);
        if self.chunk.len() == rules.frameskip {
            self.executed.push(std::mem::take(&mut self.chunk));
            self.look(agent);
        }
    }
}

#[cfg(test)]
mod tests;
