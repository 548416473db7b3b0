//! Planning in latent space: rollouts, costs, and the cross-entropy method.
//!
//! A planner encodes the current frames and the goal once, then only rolls latents forward. [`plan_to_goal`] does that
//! for many environments at once; each environment has its own random stream, so that its plan does not depend on which
//! others are planned with it.

mod cem;

use candle_core::{D, Tensor};

use crate::Result;
use crate::model::WorldModel;
use crate::pass::{Pass, Precision};

pub use cem::{CemConfig, CemIteration, CemPlan, Noise, PlanError, SeededNoise, cem};

/// Rows of latents that go through the predictor at once; bounds the memory of a plan.
const ROWS_PER_BATCH: usize = 4096;

/// Rolls latents forward under action chunks, without gradients.
///
/// `z` [N, H, D] are the latents of the last H real frames; `chunks` [N, H-1+L, A] starts with the H - 1 chunks executed
/// between them, followed by the L chunks of the plan. Returns [N, L, D]: the latent after each chunk of the plan.
/// The predictor sees a window of the last `history` latents; positions restart at 0 in every window.
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
    if pass.precision == Precision::F32 && !pass.training && model.roller().takes(z, chunks) {
        return model.roller().run(z, chunks);
    }
    rollout_composed(model, z, chunks, pass)
}

/// [`rollout`] in composed operations, window by window.
fn rollout_composed(model: &WorldModel, z: &Tensor, chunks: &Tensor, pass: &Pass) -> Result<Tensor> {
    let (n_frames, n_chunks) = (z.dim(1)?, chunks.dim(1)?);
    let history = model.architecture().config().predictor.history;
    let c = model.embed_actions(chunks, pass)?.detach(); // [N, H-1+L, D]
    let mut latents: Vec<Tensor> = (0..n_frames).map(|t| z.narrow(1, t, 1)).collect::<Result<_>>()?; // H x [N, 1, D]
    for end in n_frames..=n_chunks {
        let start = end.saturating_sub(history);
        let window = Tensor::cat(&latents[start..end], 1)?; // [N, up to history, D]
        let predicted = model.predict(&window, &c.narrow(1, start, end - start)?, pass)?;
        latents.push(predicted.narrow(1, end - start - 1, 1)?.detach()); // [N, 1, D]
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::{DataWidths, ModelConfig};
    use crate::random::Stream;

    fn normal(name: &str, shape: &[usize]) -> Tensor {
        let values = Stream::new(1, name, 0).normals(shape.iter().product());
        Tensor::from_vec(values, shape, &candle_core::Device::Cpu).unwrap()
    }

    /// A micro model with signal on every path, running statistics included.
    fn model(change: impl FnOnce(&mut ModelConfig)) -> WorldModel {
        let mut config = ModelConfig::preset("micro").unwrap();
        change(&mut config);
        let architecture = config.resolve(DataWidths { action: 7, state: 0 }).unwrap();
        let model = WorldModel::new(architecture, 3, &candle_core::Device::Cpu).unwrap();
        for (name, tensor) in model.parameters().iter() {
            let noise = (normal(name, tensor.dims()) * 0.3).unwrap();
            let value = match name {
                name if name.ends_with("running_var") => (noise.abs().unwrap() + 0.5).unwrap(),
                name if name.contains("adaLN") || name.ends_with("running_mean") => noise,
                _ => continue,
            };
            model.parameters().set(name, &value).unwrap();
        }
        model
    }

    fn check_rollout(model: &WorldModel, n: usize, frames: usize, chunks: usize) {
        let (z, actions) = (normal("z", &[n, frames, 16]), normal("actions", &[n, chunks, 7]));
        let got = rollout(model, &z, &actions, &Pass::eval()).unwrap();
        let expected = rollout_composed(model, &z, &actions, &Pass::eval()).unwrap();
        assert_eq!(got.dims(), [n, chunks - frames + 1, 16]);
        let difference =
            (got - expected).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap();
        assert!(difference < 2e-5, "{n} sequences, {frames} frames, {chunks} chunks: {difference}");
    }

    #[test]
    fn fused_and_composed_rollouts_agree() {
        let model = model(|_| {});
        for (n, frames, chunks) in
            [(1, 1, 1), (3, 1, 6), (5, 2, 5), (2, 3, 3), (2, 3, 6), (2, 5, 7), (230, 1, 5)]
        {
            check_rollout(&model, n, frames, chunks);
        }
        let other = self::model(|config| {
            (config.predictor.history, config.predictor.depth) = (1, 1);
            (config.predictor.heads, config.predictor.head_width, config.predictor.mlp_width) = (3, 5, 19);
        });
        check_rollout(&other, 4, 1, 3);
        check_rollout(&other, 4, 2, 4);
        let longer = self::model(|config| (config.predictor.history, config.predictor.depth) = (5, 3));
        check_rollout(&longer, 4, 2, 8);
    }

    #[test]
    fn rollouts_see_changed_parameters() {
        let model = model(|_| {});
        check_rollout(&model, 2, 1, 3);
        for name in
            ["predictor.pos_embedding", "pred_proj.net.1.running_mean", "action_encoder.embed.0.weight"]
        {
            let moved = (model.parameters().get(name).unwrap().copy().unwrap() + 0.25).unwrap();
            model.parameters().set(name, &moved).unwrap();
            check_rollout(&model, 2, 1, 3);
        }
    }

    #[test]
    fn a_sequence_does_not_depend_on_its_batch() {
        let model = model(|_| {});
        let (z, actions) = (normal("z", &[200, 1, 16]), normal("actions", &[200, 5, 7]));
        let values = |first, count| {
            let (z, actions) = (z.narrow(0, first, count).unwrap(), actions.narrow(0, first, count).unwrap());
            let latents = rollout(&model, &z, &actions, &Pass::eval()).unwrap();
            latents.flatten_all().unwrap().to_vec1::<f32>().unwrap()
        };
        assert_eq!(values(0, 200)[77 * 80..80 * 80], values(77, 3));
    }

    #[test]
    fn shapes_that_do_not_fit_are_errors() {
        let model = model(|_| {});
        for (z, actions) in [
            ([2, 1, 16], [3, 1, 7]),
            ([2, 2, 16], [2, 1, 7]),
            ([2, 1, 15], [2, 1, 7]),
            ([2, 1, 16], [2, 1, 6]),
        ] {
            let result = rollout(&model, &normal("z", &z), &normal("actions", &actions), &Pass::eval());
            assert!(result.unwrap_err().to_string().contains("rollout: expected"));
        }
    }
}
