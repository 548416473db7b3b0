//! Parity with the published PyTorch modules: golden files hold their answers, [`compare`] ours beside them.
//!
//! A golden file names sizes; weights, batch and noise follow closed formulas of names and positions, so that only the
//! answers are stored. [`compare`] builds the model, repeats everything (forward, regularisers, diagnostics, rollouts,
//! CEM, losses, gradients, five optimiser steps) and reports the largest error of each tensor.

mod file;
mod formula;
mod report;

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor};

use crate::Result;
use crate::config::{Architecture, ModelConfig};
use crate::diagnostics::{spectrum, straightness};
use crate::frames::standardize_frames;
use crate::model::WorldModel;
use crate::objective::{
    Clips, Losses, Objectives, StateRule, Term, covariance, losses, sigreg, standard_deviation, straightening,
};
use crate::optimizer::{AdamW, AdamWConfig, Gradients};
use crate::parameters::Parameters;
use crate::pass::{Pass, Precision};
use crate::plan::{CemConfig, CemIteration, Noise, cem, rollout, terminal_cost};

pub use file::{Golden, GoldenError};
pub use report::{Line, Report};

use file::{GoldenConfig, GoldenIteration};

/// Allowed error of forward values, regularisers, rollouts and searches, times (1 + |reference|).
const FORWARD: f64 = 2e-5;
/// Allowed error of losses over optimiser steps, relative.
const LOSSES: f64 = 1e-3;
/// Allowed error of gradients, relative to the norm of the tensor's gradient.
const GRADIENT: f64 = 2e-4;
/// Allowed error of gradients, relative to the global norm.
const GRADIENT_GLOBAL: f64 = 1e-7;
/// A gradient whose norm is below this share of the global norm is zero in exact arithmetic.
const ZERO_GRADIENT: f64 = 1e-6;
/// Elites must agree where the cost gap around the last of them exceeds this, relative.
const ELITE_GAP: f64 = 1e-4;

/// Repeats everything in a golden file on `device` and reports the errors.
///
/// In bf16 the tolerances are those of f32 times 2^16 / 2^8 / 4 = 64 (bf16 keeps 8 bits of a number, products average
/// the rounding); searches and optimiser steps are not repeated, since their branches differ.
///
/// # Errors
///
/// - [`GoldenError`] if the file's sizes make no model or its shapes are not those of ours.
pub fn compare(golden: &Golden, device: &Device, precision: Precision) -> Result<Report, GoldenError> {
    let architecture = architecture(&golden.config)?;
    let mut report = Report::new(match precision {
        Precision::F32 => 1.0,
        Precision::Bf16 => 64.0,
    });
    let model = build(&architecture, device)?;
    check_shapes(golden, model.parameters())?;
    let batch = Batch::new(&golden.config, device)?;
    let eval = Pass { precision, ..Pass::eval() };

    let z = compare_forward(golden, &model, &batch, &eval, &mut report)?;
    compare_regularizers(golden, &z, &mut report)?;
    compare_diagnostics(golden, &z, &mut report)?;
    compare_rollouts(golden, &model, &batch, &z, &eval, &mut report)?;
    if precision == Precision::F32 {
        compare_search(golden, &model, &z, &mut report)?;
    }
    compare_training(golden, &model, &batch, precision, &mut report)?;
    Ok(report)
}

/// The architecture of a golden file: published, with the file's sizes and no dropout.
fn architecture(config: &GoldenConfig) -> Result<Architecture, GoldenError> {
    let mut model = ModelConfig { image_size: config.table, ..ModelConfig::default() };
    model.encoder.patch_size = config.patch;
    model.encoder.depth = config.depth;
    model.predictor.dropout = 0.0;
    Ok(model.resolve(config.widths())?)
}

/// The name of a parameter in golden files, whose state head is a bare sequence.
fn golden_name(name: &str) -> String {
    name.replace("state_probe.net.", "state_probe.")
}

/// The reverse of [`golden_name`].
fn our_name(name: &str) -> String {
    name.replace("state_probe.", "state_probe.net.")
}

fn build(architecture: &Architecture, device: &Device) -> Result<WorldModel, GoldenError> {
    let specs = WorldModel::specs(architecture);
    let parameters = Parameters::zeros(&specs, device)?;
    for (name, spec) in &specs {
        let values = formula::parameter(&golden_name(name), spec);
        parameters.set(name, &Tensor::from_vec(values, spec.shape.as_slice(), &Device::Cpu)?)?;
    }
    Ok(WorldModel::with_parameters(architecture.clone(), parameters)?)
}

fn check_shapes(golden: &Golden, parameters: &Parameters) -> Result<(), GoldenError> {
    let ours: BTreeMap<String, Vec<usize>> =
        parameters.specs().iter().map(|(name, spec)| (golden_name(name), spec.shape.clone())).collect();
    for name in ours.keys().chain(golden.shapes.keys()) {
        if ours.get(name) != golden.shapes.get(name) {
            let (expected, got) = (golden.shapes.get(name).cloned(), ours.get(name).cloned());
            return Err(GoldenError::Shapes { name: name.clone(), expected, got });
        }
    }
    if parameters.count() != golden.parameters {
        return Err(GoldenError::Count { expected: golden.parameters, got: parameters.count() });
    }
    Ok(())
}

/// The inputs of a golden file.
struct Batch {
    clips: Clips,
    candidates: Tensor,
}

impl Batch {
    fn new(config: &GoldenConfig, device: &Device) -> Result<Batch, GoldenError> {
        let (b, t, size) = (config.clips, 4, config.size);
        let n_bytes = b * t * 3 * size * size;
        let bytes: Vec<u8> =
            formula::sequence(n_bytes, 78.233, 43_758.545_3).map(|u| (256.0 * u).floor() as u8).collect();
        let frames = Tensor::from_vec(bytes, (b * t, 3, size * size), &Device::Cpu)?;
        let frames = frames.transpose(1, 2)?.reshape((b, t, size, size, 3))?; // [B, T, H, W, C], as stored in datasets
        let values = |n, a, b| formula::signed(n, a, b, 1.0);
        let actions = values(b * t * config.act, 39.346, 24_634.634_5);
        let states = values(b * t * config.state, 11.135, 31_415.926_5);
        let candidates = values(config.samples * config.horizon * config.act, 27.611, 19_642.349);
        let rule = StateRule { supervised: None, velocity: config.velocity.clone() };
        let clips = Clips::try_new(
            standardize_frames(&frames.to_device(device)?)?,
            Tensor::from_vec(actions, (b, t, config.act), device)?,
            Tensor::from_vec(states, (b, t, config.state), device)?,
            None,
            &rule,
        )?;
        let shape = (config.samples, config.horizon, config.act);
        Ok(Batch { clips, candidates: Tensor::from_vec(candidates, shape, device)? })
    }
}

/// Returns the latents [B, T, D].
fn compare_forward(
    golden: &Golden,
    model: &WorldModel,
    batch: &Batch,
    pass: &Pass,
    report: &mut Report,
) -> Result<Tensor, GoldenError> {
    let z = model.encode(&batch.clips.frames, pass)?.detach();
    let c = model.embed_actions(&batch.clips.actions, pass)?;
    let predicted = model.predict(&z.narrow(1, 0, 3)?, &c.narrow(1, 0, 3)?, pass)?;
    report.values("eval.emb", &flat(&z)?, &golden.eval.emb.concat(), FORWARD);
    report.head("eval.act_emb_head", &flat(&c)?, &golden.eval.act_emb_head, FORWARD);
    report.head("eval.pred_head", &flat(&predicted)?, &golden.eval.pred_head, FORWARD);
    Ok(z)
}

fn compare_regularizers(golden: &Golden, z: &Tensor, report: &mut Report) -> Result<(), GoldenError> {
    let (_, t, d) = z.dims3()?;
    let centred = z.broadcast_sub(&z.mean_keepdim(0)?)?;
    let directions = Tensor::from_vec(formula::signed(d * 64, 5.923, 16_180.34, 1.0), (d, 64), z.device())?;
    let directions = directions.broadcast_div(&directions.sqr()?.sum_keepdim(0)?.sqrt()?)?;
    let difference = (z.narrow(1, 0, t - 1)? - z.narrow(1, 1, t - 1)?)?;
    for (name, ours) in [
        ("temp_align_loss", difference.sqr()?.mean_all()?),
        ("std_loss", standard_deviation(&centred)?),
        ("std_t_loss", standard_deviation(&centred.transpose(0, 1)?)?),
        ("cov_loss", covariance(&centred)?),
        ("cov_t_loss", covariance(&centred.transpose(0, 1)?)?),
        ("straightening_loss", straightening(z)?),
        ("sigreg", sigreg(&z.transpose(0, 1)?, &directions)?),
    ] {
        let reference =
            golden.regularisers.get(name).ok_or_else(|| GoldenError::missing("regularisers", name))?;
        report.values(&format!("regularisers.{name}"), &flat(&ours)?, &[*reference], FORWARD);
    }
    Ok(())
}

fn compare_diagnostics(golden: &Golden, z: &Tensor, report: &mut Report) -> Result<(), GoldenError> {
    let d = z.dim(2)?;
    let z: Vec<f64> = flat(z)?;
    let (straightness, spectrum) = (straightness(&z, d), spectrum(&z, d));
    let reference = &golden.diagnostics_all_frames_as_one_trajectory;
    let local: Vec<f64> = straightness.local.iter().map(|cosine| cosine.unwrap_or(f64::NAN)).collect();
    report.values("diagnostics.local_straightening", &local, &reference.local_straightening, FORWARD);
    report.values(
        "diagnostics.score",
        &[straightness.score.unwrap_or(f64::NAN)],
        &[reference.score],
        FORWARD,
    );
    report.values(
        "diagnostics.singular_values",
        &spectrum.singular_values,
        &reference.singular_values,
        FORWARD,
    );
    report.values(
        "diagnostics.cumulative_energy",
        &spectrum.cumulative_energy,
        &reference.cumulative_energy,
        FORWARD,
    );
    // A count: exact unless the energy at the boundary is 95 % to within the tolerance.
    let close = reference.cumulative_energy.iter().any(|share| (share - 0.95).abs() < FORWARD);
    if !close {
        report.values("diagnostics.r95", &[spectrum.r95 as f64], &[reference.r95], 0.0);
    }
    Ok(())
}

fn compare_rollouts(
    golden: &Golden,
    model: &WorldModel,
    batch: &Batch,
    z: &Tensor,
    pass: &Pass,
    report: &mut Report,
) -> Result<(), GoldenError> {
    let (n, _, _) = batch.candidates.dims3()?;
    let (_, _, d) = z.dims3()?;
    let goal = z.narrow(0, 0, 1)?.narrow(1, 3, 1)?.squeeze(1)?; // [1, D]
    for (history, reference) in [(1, &golden.rollout_history_1), (3, &golden.rollout_history_3)] {
        // The published rollout takes the chunks between real frames from the head of each candidate.
        let start = z.narrow(0, 0, 1)?.narrow(1, 0, history)?.broadcast_as((n, history, d))?.contiguous()?;
        let predicted = rollout(model, &start, &batch.candidates, pass)?; // [N, L, D]
        let last = predicted.narrow(1, predicted.dim(1)? - 1, 1)?;
        let name = format!("rollout_history_{history}");
        report.values(&format!("{name}.last"), &flat(&last)?, &reference.last.concat(), FORWARD);
        let cost = terminal_cost(&predicted, &goal)?;
        report.values(&format!("{name}.cost"), &flat(&cost)?, &reference.cost_to_frame_3, FORWARD);
    }
    Ok(())
}

/// The noise of the golden search: a formula over iteration, sample, step and action dim.
struct FormulaNoise(Vec<f32>);

impl Noise for FormulaNoise {
    fn draw(&mut self, _: usize, iteration: usize, count: usize) -> Vec<f32> {
        self.0[iteration * count..(iteration + 1) * count].to_vec()
    }
}

fn compare_search(
    golden: &Golden,
    model: &WorldModel,
    z: &Tensor,
    report: &mut Report,
) -> Result<(), GoldenError> {
    let (horizon, width) = (golden.config.horizon, golden.config.act);
    let config = CemConfig { samples: 12, iterations: golden.cem.len(), elites: 4, sigma: 1.0, horizon };
    let n_noise = config.iterations * config.samples * horizon * width;
    let mut noise = FormulaNoise(formula::signed(n_noise, 19.19, 27_183.18, 3.0));
    let first = z.narrow(0, 0, 1)?;
    let d = z.dim(2)?;
    let (start, goal) = (first.narrow(1, 0, 1)?, first.narrow(1, 3, 1)?.squeeze(1)?);
    let start = start.broadcast_as((config.samples, 1, d))?.contiguous()?;
    let cost =
        |candidates: &Tensor| terminal_cost(&rollout(model, &start, candidates, &Pass::eval())?, &goal);
    let plan = cem(&config, 0, width, None, &mut noise, z.device(), cost)?;
    for (index, (ours, reference)) in plan.iterations.iter().zip(&golden.cem).enumerate() {
        if !compare_iteration(index, ours, reference, report) {
            break; // elites differ within a tie: what follows is another search
        }
    }
    Ok(())
}

/// Returns whether the same elites were chosen.
fn compare_iteration(
    index: usize,
    ours: &CemIteration,
    reference: &GoldenIteration,
    report: &mut Report,
) -> bool {
    let wide = |values: &[f32]| values.iter().copied().map(f64::from).collect::<Vec<_>>();
    report.values(&format!("cem.{index}.cost"), &wide(&ours.costs), &reference.cost, FORWARD);
    let mut elites = ours.elites.clone();
    elites.sort_unstable();
    let same = elites == reference.elites;
    let mut sorted = reference.cost.clone();
    sorted.sort_by(f64::total_cmp);
    let count = reference.elites.len();
    let gap = match (sorted.get(count - 1), sorted.get(count)) {
        (Some(last), Some(next)) => (next - last) / last.abs().max(f64::MIN_POSITIVE),
        _ => f64::INFINITY,
    };
    if gap > ELITE_GAP {
        let differing = elites.iter().filter(|elite| !reference.elites.contains(elite)).count();
        report.values(&format!("cem.{index}.elites_differing"), &[differing as f64], &[0.0], 0.0);
    }
    if same {
        report.values(&format!("cem.{index}.mean"), &wide(&ours.mean), &reference.mean.concat(), FORWARD);
        report.values(&format!("cem.{index}.sigma"), &wide(&ours.sigma), &reference.sigma.concat(), FORWARD);
    }
    same
}

fn compare_training(
    golden: &Golden,
    model: &WorldModel,
    batch: &Batch,
    precision: Precision,
    report: &mut Report,
) -> Result<(), GoldenError> {
    let parameters = model.parameters();
    let objectives = Objectives::default();
    let start = parameters.snapshot()?;
    let step = |step| -> Result<(Losses, Gradients)> {
        let pass = Pass { precision, ..Pass::train(0, step) };
        let losses = losses(model, &batch.clips, &objectives, &pass)?;
        let gradients = Gradients::of(&losses.total, parameters)?;
        Ok((losses, gradients))
    };
    compare_train_forward(golden, model, batch, precision, report)?;
    for (name, value) in &start {
        parameters.set(name, value)?; // the pass above moved the running statistics
    }

    let (losses, gradients) = step(0)?;
    for (name, term, reference) in [
        ("train.loss_pred", Term::Prediction, golden.train.loss_pred),
        ("train.loss_sa", Term::StateAlignment, golden.train.loss_sa),
        ("train.loss_idm", Term::InverseDynamics, golden.train.loss_idm),
    ] {
        report.values(name, &[term_value(&losses, term)?], &[reference], FORWARD);
    }
    compare_gradients(golden, &gradients, report)?;
    if precision != Precision::F32 {
        return Ok(());
    }

    let mut optimizer = AdamW::new(AdamWConfig::default());
    optimizer.step(parameters, &gradients, 5e-5)?;
    compare_step(golden, parameters, &start, report)?;
    for (index, reference) in golden.losses_steps_2_to_5.iter().enumerate() {
        let (losses, gradients) = step(index as u64 + 1)?;
        let terms = [Term::Prediction, Term::StateAlignment, Term::InverseDynamics];
        let ours = terms.map(|term| term_value(&losses, term)).into_iter().collect::<Result<Vec<_>>>()?;
        report.relative(&format!("losses_step_{}", index + 2), &ours, reference, LOSSES);
        optimizer.step(parameters, &gradients, 5e-5)?;
    }
    Ok(())
}

fn compare_train_forward(
    golden: &Golden,
    model: &WorldModel,
    batch: &Batch,
    precision: Precision,
    report: &mut Report,
) -> Result<(), GoldenError> {
    let pass = Pass { precision, ..Pass::train(0, 0) };
    let z = model.encode(&batch.clips.frames, &pass)?;
    let c = model.embed_actions(&batch.clips.actions, &pass)?;
    let predicted = model.predict(&z.narrow(1, 0, 3)?, &c.narrow(1, 0, 3)?, &pass)?;
    report.values("train.emb", &flat(&z)?, &golden.train.emb.concat(), FORWARD);
    report.head("train.pred_head", &flat(&predicted)?, &golden.train.pred_head, FORWARD);
    report.head(
        "train.state_head",
        &flat(&model.read_states(&z, &pass)?)?,
        &golden.train.state_head,
        FORWARD,
    );
    Ok(())
}

fn compare_gradients(golden: &Golden, gradients: &Gradients, report: &mut Report) -> Result<(), GoldenError> {
    let global = flat(&gradients.norm()?)?[0];
    report.relative("grad_norm", &[global], &[golden.grad_norm], GRADIENT);
    for (name, reference) in &golden.grad {
        let gradient =
            gradients.get(&our_name(name)).ok_or_else(|| GoldenError::missing("our gradients", name))?;
        let ours = flat(gradient)?;
        let norm = ours.iter().map(|value| value * value).sum::<f64>().sqrt();
        let allowed = GRADIENT * reference.l2 + GRADIENT_GLOBAL * golden.grad_norm;
        report.absolute(&format!("grad.{name}.l2"), &[norm], &[reference.l2], allowed);
        let head = &ours[..reference.head.len().min(ours.len())];
        report.absolute(&format!("grad.{name}.head"), head, &reference.head, allowed);
    }
    Ok(())
}

fn compare_step(
    golden: &Golden,
    parameters: &Parameters,
    start: &BTreeMap<String, Tensor>,
    report: &mut Report,
) -> Result<(), GoldenError> {
    for (name, reference) in &golden.after_step {
        // A gradient that is zero in exact arithmetic is rounding noise, and the first step of AdamW makes it +-rate.
        let zero = golden.grad.get(name).is_some_and(|grad| grad.l2 <= ZERO_GRADIENT * golden.grad_norm);
        if zero {
            continue;
        }
        let (before, after) = match start.get(&our_name(name)) {
            Some(before) => (flat(before)?, flat(&parameters.get(&our_name(name))?)?),
            None => return Err(GoldenError::missing("our parameters", name)),
        };
        let moved = before.iter().zip(&after).map(|(a, b)| (a - b).powi(2)).sum::<f64>().sqrt();
        report.relative(&format!("after_step.{name}.delta_l2"), &[moved], &[reference.delta_l2], LOSSES);
        report.head(&format!("after_step.{name}.head"), &after, &reference.head, FORWARD);
    }
    Ok(())
}

fn term_value(losses: &Losses, term: Term) -> Result<f64> {
    Ok(losses.value(term)?.map_or(f64::NAN, f64::from))
}

/// Reads a tensor of any shape. Sync: waits for the device.
fn flat(tensor: &Tensor) -> Result<Vec<f64>> {
    tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1()
}
