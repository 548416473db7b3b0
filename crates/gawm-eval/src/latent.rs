//! A world model as dynamics: encode once, then roll candidates forward in blocks.

use std::collections::BTreeMap;
use std::sync::Mutex;

use gawm_model::plan::{rollout, terminal_cost};
use gawm_model::{Device, Pass, Tensor, WorldModel};
use gawm_sim::Frame;
use rayon::prelude::*;

use crate::agent::Dynamics;
use crate::encode::{device, encode_frames, fit_frame};
use crate::evaluate::View;
use crate::planner::{ActionSpace, EvaluateError, Evaluator, ObjectiveWeights, Slopes};
use crate::world::World;

/// Candidates that go through the predictor at once on a CPU, rounded to whole multiples of the samples of a problem.
///
/// The number depends on the configuration alone and the last block is filled up, so that a cost does not depend on
/// which problems are planned together.
const ROWS_PER_BLOCK: usize = 256;
/// The same on a GPU, which wants large batches.
const ROWS_PER_GPU_BLOCK: usize = 16_384;

/// What candidates of all problems are rolled out from.
#[derive(Debug, Clone)]
pub struct LatentEvaluator<'a> {
    model: &'a WorldModel,
    device: Device,
    weights: ObjectiveWeights,
    block: usize,
    /// Latents of the last real frames, [problems, H, D].
    starts: Tensor,
    /// Standardised chunks between them, [problems, H - 1, A]; `None` for H = 1.
    executed: Option<Tensor>,
    /// Latents of the goals, [problems, D].
    goals: Tensor,
}

impl<'a> LatentEvaluator<'a> {
    /// Joins latents of all problems: `starts` [P, H, D], `executed` [P, H-1, A] for H above 1, `goals` [P, D].
    ///
    /// `samples` is the number of candidates per problem that blocks are made for.
    pub fn new(
        model: &'a WorldModel,
        starts: Tensor,
        executed: Option<Tensor>,
        goals: Tensor,
        samples: usize,
        weights: ObjectiveWeights,
    ) -> LatentEvaluator<'a> {
        let device = device(model);
        let rows = if device.is_cpu() { ROWS_PER_BLOCK } else { ROWS_PER_GPU_BLOCK };
        let block = samples.max(1) * (rows / samples.max(1)).max(1);
        LatentEvaluator { model, device, weights, block, starts, executed, goals }
    }

    /// Costs `[rows]` of candidates [rows, L, A], row i being of problem `problems[i]`.
    fn block_costs(&self, problems: &[u32], candidates: &Tensor) -> candle_core::Result<Tensor> {
        let index = Tensor::from_slice(problems, problems.len(), &self.device)?;
        let starts = self.starts.index_select(&index, 0)?; // [rows, H, D]
        let goals = self.goals.index_select(&index, 0)?; // [rows, D]
        let chunks = match &self.executed {
            Some(executed) => Tensor::cat(&[&executed.index_select(&index, 0)?, candidates], 1)?,
            None => candidates.clone(),
        };
        let predicted = rollout(self.model, &starts, &chunks, &Pass::eval())?; // [rows, L, D]
        self.costs_of(&predicted, &goals)
    }

    /// Weighted costs `[rows]` of latents [rows, L, D] against goals [rows, D].
    fn costs_of(&self, predicted: &Tensor, goals: &Tensor) -> candle_core::Result<Tensor> {
        let mut total = (terminal_cost(predicted, goals)? * self.weights.latent)?;
        if self.weights.state > 0.0 {
            let last = predicted.narrow(1, predicted.dim(1)? - 1, 1)?; // [rows, 1, D]
            let read = |z: &Tensor| self.model.read_states(z, &Pass::eval())?.squeeze(1); // [rows, S]
            let difference = (read(&last.contiguous()?)? - read(&goals.unsqueeze(1)?)?)?;
            total = (total + (difference.sqr()?.sum(1)? * self.weights.state)?)?;
        }
        Ok(total)
    }

    /// As [`rollout`] with a window of growing length, but with gradients.
    fn differentiable_rollout(&self, start: &Tensor, chunks: &Tensor) -> candle_core::Result<Tensor> {
        let history = self.model.architecture().config().predictor.history;
        let pass = Pass::eval();
        let c = self.model.embed_actions(chunks, &pass)?;
        let n_frames = start.dim(1)?;
        let mut latents: Vec<Tensor> =
            (0..n_frames).map(|t| start.narrow(1, t, 1)).collect::<candle_core::Result<_>>()?;
        for end in n_frames..=chunks.dim(1)? {
            let first = end.saturating_sub(history);
            let window = Tensor::cat(&latents[first..end], 1)?;
            let predicted = self.model.predict(&window, &c.narrow(1, first, end - first)?, &pass)?;
            latents.push(predicted.narrow(1, end - first - 1, 1)?);
        }
        Tensor::cat(&latents[n_frames..], 1)
    }
}

impl Evaluator for LatentEvaluator<'_> {
    fn width(&self) -> usize {
        self.model.architecture().widths().action
    }

    fn costs(&self, tasks: &[usize], candidates: &[f32], horizon: usize) -> Result<Vec<f32>, EvaluateError> {
        let length = horizon * self.width();
        let n_rows = candidates.len() / length;
        let n = n_rows / tasks.len().max(1);
        let evaluate = |first: usize| -> candle_core::Result<Vec<f32>> {
            let rows = self.block.min(n_rows - first);
            let mut values = candidates[first * length..(first + rows) * length].to_vec();
            values.resize(self.block * length, 0.0);
            let problem = |row: usize| tasks[(first + row.min(rows - 1)) / n] as u32;
            let problems: Vec<u32> = (0..self.block).map(problem).collect();
            let candidates = Tensor::from_vec(values, (self.block, horizon, self.width()), &self.device)?;
            let costs = self.block_costs(&problems, &candidates)?;
            let mut costs = costs.to_vec1::<f32>()?; // Sync: waits for the device.
            costs.truncate(rows);
            Ok(costs)
        };
        let firsts: Vec<usize> = (0..n_rows).step_by(self.block).collect();
        let blocks: Vec<candle_core::Result<Vec<f32>>> = firsts.into_par_iter().map(evaluate).collect();
        Ok(blocks.into_iter().collect::<candle_core::Result<Vec<_>>>()?.concat())
    }

    fn gradients(
        &self,
        tasks: &[usize],
        candidates: &[f32],
        horizon: usize,
    ) -> Result<Option<Slopes>, EvaluateError> {
        let width = self.width();
        let n_rows = candidates.len() / (horizon * width);
        let n = n_rows / tasks.len().max(1);
        let index: Vec<u32> = (0..n_rows).map(|row| tasks[row / n] as u32).collect();
        let index = Tensor::from_vec(index, n_rows, &self.device)?;
        let variable = candle_core::Var::from_slice(candidates, (n_rows, horizon, width), &self.device)?;
        let chunks = match &self.executed {
            Some(executed) => Tensor::cat(&[&executed.index_select(&index, 0)?, variable.as_tensor()], 1)?,
            None => variable.as_tensor().clone(),
        };
        let predicted = self.differentiable_rollout(&self.starts.index_select(&index, 0)?, &chunks)?;
        let costs = self.costs_of(&predicted, &self.goals.index_select(&index, 0)?)?;
        let mut gradients = costs.sum_all()?.backward()?;
        let gradient = gradients.remove(&variable).map_or_else(|| variable.zeros_like(), Ok)?;
        Ok(Some(Slopes { costs: costs.to_vec1()?, gradients: gradient.flatten_all()?.to_vec1()? }))
    }
}

/// A world model with everything that planning over it needs.
#[expect(missing_debug_implementations, reason = "a world is a trait object")]
pub struct LatentDynamics<'a> {
    model: &'a WorldModel,
    world: &'a dyn World,
    space: ActionSpace,
    image_size: (usize, usize),
    history: usize,
    samples: usize,
    weights: ObjectiveWeights,
    /// Latents of goals by position of the problem: encoded once.
    goals: Mutex<BTreeMap<usize, Vec<f32>>>,
}

impl<'a> LatentDynamics<'a> {
    /// Joins a model with the world that draws its goals. `history` real frames are used, as far as the model can.
    pub fn new(
        model: &'a WorldModel,
        world: &'a dyn World,
        space: ActionSpace,
        image_size: (usize, usize),
        config: &crate::planner::PlannerConfig,
    ) -> LatentDynamics<'a> {
        let history = config.history.min(model.architecture().config().predictor.history);
        let (samples, weights) = (config.samples, config.objective);
        let goals = Mutex::new(BTreeMap::new());
        LatentDynamics { model, world, space, image_size, history, samples, weights, goals }
    }

    fn fit(&self, frame: &Frame) -> Result<Vec<u8>, EvaluateError> {
        fit_frame(frame, self.image_size)
            .map_err(|error| EvaluateError::Candle(candle_core::Error::Msg(error.to_string())))
    }

    /// The goal image: the dataset's, or a rendering of the goal state.
    fn goal_frame(&self, view: &View<'_>) -> Result<Vec<u8>, EvaluateError> {
        self.fit(&goal_frame(self.world, view.problem)?)
    }

    fn goal_latents(&self, views: &[View<'_>]) -> Result<Vec<f32>, EvaluateError> {
        let mut known = self.goals.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        let missing: Vec<&View<'_>> = views.iter().filter(|view| !known.contains_key(&view.index)).collect();
        let frames = missing.par_iter().map(|view| self.goal_frame(view)).collect::<Result<Vec<_>, _>>()?;
        let latents = encode_frames(self.model, &frames, self.image_size)?;
        let width = self.model.architecture().config().latent_width;
        for (view, latent) in missing.iter().zip(latents.chunks_exact(width)) {
            known.insert(view.index, latent.to_vec());
        }
        Ok(views.iter().flat_map(|view| known[&view.index].iter().copied()).collect())
    }
}

/// Returns what the goal looks like: the dataset's image, or a rendering of the goal state.
///
/// # Errors
/// The environment refuses the goal state.
pub fn goal_frame(world: &dyn World, problem: &crate::problem::Problem) -> Result<Frame, EvaluateError> {
    if let Some(frame) = &problem.goal_image {
        return Ok(frame.as_ref().clone());
    }
    let mut environment = world.environment();
    let state = gawm_sim::State { system: problem.goal_system.clone(), goal: problem.state.goal.clone() };
    environment.set_state(&state).map_err(|error| {
        EvaluateError::Candle(candle_core::Error::Msg(format!("goal of {}: {error}", problem.id)))
    })?;
    let mut frame = Frame::default();
    environment.render(&mut frame);
    Ok(frame)
}

impl Dynamics for LatentDynamics<'_> {
    fn n_frames(&self) -> usize {
        self.history
    }

    fn bind<'b>(&'b self, views: &'b [View<'_>]) -> Result<Box<dyn Evaluator + 'b>, EvaluateError> {
        let (p, width) = (views.len(), self.model.architecture().config().latent_width);
        // All problems of a call have taken equally many steps, hence have equally many frames.
        let h = views.iter().map(|view| view.frames.len()).min().unwrap_or(0).max(1);
        let frames = views
            .par_iter()
            .flat_map_iter(|view| view.frames[view.frames.len() - h..].iter().map(|frame| self.fit(frame)))
            .collect::<Result<Vec<_>, _>>()?;
        let device = device(self.model);
        let starts = encode_frames(self.model, &frames, self.image_size)?;
        let starts = Tensor::from_vec(starts, (p, h, width), &device)?;
        let goals = Tensor::from_vec(self.goal_latents(views)?, (p, width), &device)?;
        let executed = if h == 1 {
            None
        } else {
            let chunk = |actions: &Vec<Vec<f32>>| {
                actions.iter().flat_map(|action| self.space.standardised(action)).collect::<Vec<f32>>()
            };
            let chunks = |view: &View<'_>| -> Vec<f32> {
                view.executed[view.executed.len() - (h - 1)..].iter().flat_map(chunk).collect()
            };
            let values: Vec<f32> = views.iter().flat_map(chunks).collect();
            Some(Tensor::from_vec(values, (p, h - 1, self.space.chunk_width()), &device)?)
        };
        Ok(Box::new(LatentEvaluator::new(self.model, starts, executed, goals, self.samples, self.weights)))
    }
}
