//! Batches at the edge of what has a meaning: computed, or refused with an error, never a panic.

use candle_core::{DType, Device};
use gawm_model::plan::rollout;
use gawm_model::{AdamW, AdamWConfig, Gradients, ModelConfig, Objectives, Pass, Tensor, WorldModel, losses};

use crate::fixture::{WIDTHS, clips, model, normal};

/// Takes a training step and evaluates, and returns the first error.
fn run(model: &WorldModel, b: usize, t: usize) -> Result<f32, String> {
    let clips = clips(1, b, t);
    let objectives = Objectives::default();
    let losses_of = |pass: Pass| losses(model, &clips, &objectives, &pass).map_err(|error| error.to_string());
    let total = losses_of(Pass::train(1, 2))?.total;
    let gradients = Gradients::of(&total, model.parameters()).map_err(|error| error.to_string())?;
    let mut optimizer = AdamW::new(AdamWConfig::default());
    optimizer.step(model.parameters(), &gradients, 1e-3).map_err(|error| error.to_string())?;
    losses_of(Pass::eval())?.total.to_scalar::<f32>().map_err(|error| error.to_string())
}

#[test]
fn small_batches_are_computed() {
    for (b, t) in [(1, 3), (1, 4), (2, 2), (7, 3)] {
        assert!(run(&model(1, |_| {}), b, t).unwrap().is_finite(), "{b} x {t}");
    }
}

#[test]
fn a_batch_of_one_prediction_is_refused() {
    // The batch norm after the predictor has a single row.
    let error = run(&model(1, |_| {}), 1, 2).unwrap_err();
    assert!(error.contains("expected at least 2 rows in training, got 1"), "{error}");
}

/// More frames than the predictor has positions for.
#[test]
fn clips_that_are_too_long_are_refused() {
    let error = run(&model(1, |_| {}), 2, 6).unwrap_err();
    assert!(!error.is_empty());
}

#[test]
fn widths_that_fill_no_vector_are_computed() {
    let odd = |config: &mut ModelConfig| {
        (config.encoder.width, config.encoder.heads, config.encoder.mlp_width) = (21, 3, 37);
        (config.latent_width, config.projector_width) = (19, 33);
        (config.predictor.heads, config.predictor.head_width, config.predictor.mlp_width) = (5, 3, 29);
        (config.state_head_width, config.inverse_head_width) = (11, 13);
    };
    assert!(run(&model(1, odd), 3, 4).unwrap().is_finite());
    // A patch as large as the frame: the class token and one other.
    let one_patch = |config: &mut ModelConfig| config.encoder.patch_size = 16;
    assert!(run(&model(1, one_patch), 2, 3).unwrap().is_finite());
}

#[test]
fn nothing_at_all_is_no_panic() {
    let model = model(1, |_| {});
    let latent = model.architecture().config().latent_width;
    let empty = |dims: &[usize]| Tensor::zeros(dims, DType::F32, &Device::Cpu).unwrap();
    // Whether an empty batch is an error or an empty result is not promised, only that it returns.
    for pass in [Pass::eval(), Pass::train(1, 2)] {
        if let Ok(z) = model.encode(&empty(&[0, 2, 3, 16, 16]), &pass) {
            assert_eq!(z.elem_count(), 0);
        }
        if let Ok(z) = model.predict(&empty(&[0, 2, latent]), &empty(&[0, 2, latent]), &pass) {
            assert_eq!(z.elem_count(), 0);
        }
    }
    let predicted = rollout(&model, &empty(&[0, 1, latent]), &empty(&[0, 3, WIDTHS.action]), &Pass::eval());
    assert_eq!(predicted.unwrap().dims(), [0, 3, latent]);
    let z = normal(1, "z", &[2, 1, latent]);
    assert!(rollout(&model, &z, &empty(&[2, 0, WIDTHS.action]), &Pass::eval()).is_err());
    assert!(rollout(&model, &z, &empty(&[2, 2, WIDTHS.action + 1]), &Pass::eval()).is_err());
}
