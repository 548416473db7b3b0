//! Planning in latent space: rollouts, costs, and the cross-entropy method.
//!
//! A planner encodes the current frames and the goal once, then only rolls latents forward. [`plan_to_goal`] does that
//! for many environments at once; each environment has its own random stream, so that its plan does not depend on which
//! others are planned with it.

mod cem;

use candle_core::{D, Tensor};

use crate::Result;
use crate::model::WorldModel;
use crate::pass::Pass;
use crate::predictor::Window;

pub use cem::{CemConfig, CemIteration, CemPlan, Noise, PlanError, SeededNoise, cem};

/// Rows of latents that go through the predictor at once; bounds the memory of a plan.
const ROWS_PER_BATCH: usize = 4096;

/// Rolls latents forward under action chunks, without gradients.
///
/// `z` [N, H, D] are the latents of the last H real frames; `chunks` [N, H-1+L, A] starts with the H - 1 chunks executed
/// between them, followed by the L chunks of the plan. Returns [N, L, D]: the latent after each chunk of the plan.
/// The predictor sees a window of the last `history` latents; positions restart at 0 in every window. What a window
/// shares with the one before is computed once, which saves a third of the work of the published horizon. `pass` is an
/// evaluation pass: there is no dropout.
///
/// # Errors
///
/// - if the shapes do not fit each other or no chunk is left to plan.
pub fn rollout(model: &WorldModel, z: &Tensor, chunks: &Tensor, pass: &Pass) -> Result<Tensor> {
    let ((n, n_frames, _), (rows, n_chunks, _)) = (z.dims3()?, chunks.dims3()?);
    if rows != n || n_frames == 0 || n_chunks < n_frames {
        candle_core::bail!(
            "rollout: expected chunks [{n}, at least {n_frames}, A] for latents {:?}, got {:?}",
            z.dims(),
            chunks.dims()
        );
    }
    let history = model.architecture().config().predictor.history;
    let c = model.embed_actions(chunks, pass)?.detach(); // [N, H-1+L, D]
    let modulations: Vec<Tensor> =
        model.predictor().modulations(&c, pass)?.into_iter().map(|m| m.detach()).collect(); // per block [N, H-1+L, 6 D]
    let mut latents: Vec<Tensor> = (0..n_frames).map(|t| z.narrow(1, t, 1)).collect::<Result<_>>()?; // H x [N, 1, D]
    let mut window = Window::default();
    for end in n_frames..=n_chunks {
        let start = end.saturating_sub(history);
        // While a window grows from the first frame, its tokens keep their positions; when it slides, all are new.
        let first = if start == 0 && end > n_frames { end - 1 } else { start };
        if first == start {
            window = Window::default();
        }
        let tokens = Tensor::cat(&latents[first..end], 1)?; // [N, 1 to history, D]
        let part = |m: &Tensor| m.narrow(1, first, end - first)?.contiguous();
        let modulations = modulations.iter().map(part).collect::<Result<Vec<_>>>()?;
        let x = model.predictor().extend(&mut window, &tokens, &modulations, pass)?.detach(); // [N, 1, D]
        latents.push(model.project_prediction(&x, pass)?.detach());
    }
    Tensor::cat(&latents[n_frames..], 1) // [N, L, D]
}

/// Sum of squared differences at the last step: `predicted` [N, L, D] and `goal` [N, D] or [1, D] to `[N]`.
pub fn terminal_cost(predicted: &Tensor, goal: &Tensor) -> Result<Tensor> {
    let (_, l, _) = predicted.dims3()?;
    let last = predicted.narrow(1, l - 1, 1)?.squeeze(1)?; // [N, D]
    last.broadcast_sub(goal)?.sqr()?.sum(D::Minus1) // [N]
}

/// What one environment starts from, for [`plan_to_goal`]. All environments planned together have equal shapes.
#[derive(Debug, Clone)]
pub struct Start {
    /// Latents of the last H real frames, [H, D].
    pub latents: Tensor,
    /// The chunks executed between them, [H-1, A]; `None` if H is 1.
    pub executed: Option<Tensor>,
    /// Latent of the goal, [D].
    pub goal: Tensor,
}

/// Plans one action sequence per environment with the cross-entropy method: standardised chunks, [L, A] each.
///
/// `means` [L, A] warm-starts an environment; without it the search starts at zero.
///
/// # Errors
///
/// - [`PlanError`] for settings that cannot be searched with, and for costs of which none is a number.
pub fn plan_to_goal(
    model: &WorldModel,
    starts: &[Start],
    means: &[Option<Tensor>],
    config: &CemConfig,
    noise: &mut dyn Noise,
) -> Result<Vec<CemPlan>, PlanError> {
    let width = model.architecture().widths().action;
    let pass = Pass::eval();
    let cost = |environment: usize, candidates: &Tensor| {
        let Start { latents, executed, goal } = &starts[environment];
        let (n, _, _) = candidates.dims3()?;
        let costs = (0..n).step_by(ROWS_PER_BATCH).map(|first| {
            let rows = ROWS_PER_BATCH.min(n - first);
            let candidates = candidates.narrow(0, first, rows)?; // [rows, L, A]
            let chunks = match executed {
                Some(executed) => Tensor::cat(&[&repeat(executed, rows)?, &candidates], 1)?,
                None => candidates,
            };
            let predicted = rollout(model, &repeat(latents, rows)?, &chunks, &pass)?; // [rows, L, D]
            terminal_cost(&predicted, &goal.unsqueeze(0)?)
        });
        Tensor::cat(&costs.collect::<Result<Vec<_>>>()?, 0) // [N]
    };
    let plan = |(environment, _): (usize, &Start)| {
        let mean = means.get(environment).and_then(Option::as_ref);
        let device = starts[environment].goal.device();
        cem(config, environment, width, mean, noise, device, |candidates| cost(environment, candidates))
    };
    starts.iter().enumerate().map(plan).collect()
}

/// Repeats [X, Y] to [rows, X, Y].
fn repeat(x: &Tensor, rows: usize) -> Result<Tensor> {
    let (a, b) = x.dims2()?;
    x.unsqueeze(0)?.broadcast_as((rows, a, b))?.contiguous() // [rows, X, Y]
}
