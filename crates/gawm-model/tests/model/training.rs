//! Training steps: what they learn, that they repeat, and that a saved run goes on to the bit.

use crate::fixture::{bits, clips, has_zero_gradient, model, normal};
use gawm_model::{
    AdamW, AdamWConfig, Clips, Control, Decay, Gradients, Objectives, OptimizerError, Pass, Precision,
    StepReport, Tensor, WorldModel, losses,
};

fn step(
    model: &WorldModel,
    optimizer: &mut AdamW,
    clips: &Clips,
    objectives: &Objectives,
    rate: f64,
) -> Result<(f32, StepReport), OptimizerError> {
    let losses = losses(model, clips, objectives, &Pass::train(9, optimizer.step_count()))?;
    let gradients = Gradients::of(&losses.total, model.parameters())?;
    let report = optimizer.step(model.parameters(), &gradients, rate)?;
    Ok((losses.total.to_scalar()?, report))
}

#[test]
fn one_batch_is_learned_by_heart() {
    let model = model(1, |config| config.predictor.dropout = 0.0);
    let (clips, objectives) = (clips(2, 3, 4), Objectives::default());
    let mut optimizer = AdamW::new(AdamWConfig { weight_decay: 0.0, ..AdamWConfig::default() });
    let first = step(&model, &mut optimizer, &clips, &objectives, 3e-3).unwrap().0;
    for _ in 0..150 {
        step(&model, &mut optimizer, &clips, &objectives, 3e-3).unwrap();
    }
    let last = step(&model, &mut optimizer, &clips, &objectives, 3e-3).unwrap().0;
    // Noise can only be learned by heart: three clips and 20 000 parameters.
    assert!(last < 0.1 * first, "from {first} to {last}");
}

#[test]
fn a_saved_run_goes_on_to_the_bit() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("run.safetensors");
    let (clips, objectives) = (clips(2, 3, 4), Objectives::preset("sa-idm-sigreg").unwrap());
    let whole = model(1, |_| {});
    let mut optimizer = AdamW::new(AdamWConfig::default());
    for index in 0..5 {
        if index == 3 {
            gawm_model::checkpoint::save(&path, &whole, &Default::default(), Some(&optimizer)).unwrap();
        }
        step(&whole, &mut optimizer, &clips, &objectives, 1e-3).unwrap();
    }
    let resumed = gawm_model::checkpoint::load(&path, &gawm_model::Device::Cpu).unwrap();
    let mut optimizer = resumed.optimizer.unwrap();
    assert_eq!(optimizer.step_count(), 3);
    for _ in 3..5 {
        step(&resumed.model, &mut optimizer, &clips, &objectives, 1e-3).unwrap();
    }
    assert_eq!(bits(&resumed.model), bits(&whole));
}

#[test]
fn dropout_is_a_function_of_seed_step_site_and_index() {
    let x = Tensor::ones((64, 100), gawm_model::DType::F32, &gawm_model::Device::Cpu).unwrap();
    let mask = |pass: Pass, site| {
        let y = pass.dropout(&x, 0.1, site).unwrap();
        y.flatten_all().unwrap().to_vec1::<f32>().unwrap()
    };
    let reference = mask(Pass::train(1, 2), "a");
    assert_eq!(mask(Pass::train(1, 2), "a"), reference);
    for (pass, site) in [(Pass::train(2, 2), "a"), (Pass::train(1, 3), "a"), (Pass::train(1, 2), "b")] {
        assert_ne!(mask(pass, site), reference);
    }
    assert_eq!(mask(Pass::eval(), "a"), vec![1.0; 6400]);
    let dropped = reference.iter().filter(|value| **value == 0.0).count();
    assert!((540..740).contains(&dropped), "{dropped} of 6400 at rate 0.1: standard error 24");
    assert!(reference.iter().all(|value| *value == 0.0 || (*value - 1.0 / 0.9).abs() < 1e-6));
    // A shorter tensor sees the beginning of the same mask.
    let short =
        Pass::train(1, 2).dropout(&x.narrow(0, 0, 8).unwrap().contiguous().unwrap(), 0.1, "a").unwrap();
    assert_eq!(short.flatten_all().unwrap().to_vec1::<f32>().unwrap(), reference[..800]);
}

#[test]
fn dropout_acts_in_training_only() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let total = |pass: Pass| {
        let losses = losses(&model, &clips, &Objectives::preset("pred-only").unwrap(), &pass).unwrap();
        losses.total.to_scalar::<f32>().unwrap()
    };
    assert_eq!(total(Pass::train(1, 1)), total(Pass::train(1, 1)));
    assert_ne!(total(Pass::train(1, 1)), total(Pass::train(1, 2)));
    assert_eq!(total(Pass::eval()), total(Pass { seed: 5, step: 6, ..Pass::eval() }));
}

/// Runs in a process of its own for [`threads_do_not_change_the_bits`].
#[test]
fn prints_the_bits_of_a_step() {
    let config = gawm_model::ModelConfig::preset("nano").unwrap();
    let architecture = config.resolve(crate::fixture::WIDTHS).unwrap();
    let model = WorldModel::new(architecture, 1, &gawm_model::Device::Cpu).unwrap();
    let mut clips = clips(2, 4, 4);
    clips.frames = normal(3, "large frames", &[4, 4, 3, 64, 64]);
    let mut optimizer = AdamW::new(AdamWConfig::default());
    let mut bits = Vec::new();
    for _ in 0..2 {
        let (loss, report) = step(&model, &mut optimizer, &clips, &Objectives::default(), 1e-3).unwrap();
        bits.push(format!("{:08x}/{:016x}", loss.to_bits(), report.gradient_norm.to_bits()));
    }
    println!("bits: {}", bits.join(" "));
}

#[test]
fn threads_do_not_change_the_bits() {
    let with_threads = |count: &str| {
        let mut command = std::process::Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", "training::prints_the_bits_of_a_step", "--nocapture"])
            .env("RAYON_NUM_THREADS", count);
        let output = String::from_utf8(command.output().unwrap().stdout).unwrap();
        let line = output.lines().find(|line| line.contains("bits: ")).unwrap_or_else(|| panic!("{output}"));
        line.to_owned()
    };
    let one = with_threads("1");
    assert_eq!(with_threads("2"), one);
    assert_eq!(with_threads("5"), one);
}

#[test]
fn parameters_without_gradient_and_undecayed_ones_stay() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let before = bits(&model);
    let mut optimizer = AdamW::new(AdamWConfig::default());
    step(&model, &mut optimizer, &clips, &Objectives::preset("pred-only").unwrap(), 1e-3).unwrap();
    let after = bits(&model);
    for (name, values) in before.iter().filter(|(name, _)| !has_zero_gradient(name)) {
        let head = name.starts_with("state_probe") || name.starts_with("idm_head");
        assert_eq!(after[name] == *values, head, "{name}");
    }

    // With gradients of nearly nothing, all that moves a parameter is the decay.
    let zero =
        (losses(&model, &clips, &Objectives::default(), &Pass::train(0, 0)).unwrap().total * 1e-30).unwrap();
    let gradients = Gradients::of(&zero, model.parameters()).unwrap();
    let before = model.parameters().snapshot().unwrap();
    let config =
        AdamWConfig { decay: Decay::Matrices, weight_decay: 0.5, epsilon: 1.0, ..AdamWConfig::default() };
    AdamW::new(config).step(model.parameters(), &gradients, 0.1).unwrap();
    for (name, variable) in model.parameters().trainable() {
        let decayed = variable.rank() >= 2 && !name.contains("token") && !name.contains("pos");
        let moved = (variable.as_detached_tensor() - &before[name]).unwrap().abs().unwrap();
        let moved = moved.flatten_all().unwrap().max(0).unwrap().to_scalar::<f32>().unwrap();
        assert_eq!(moved > 1e-9, decayed, "{name} moved {moved}");
    }
}

#[test]
fn gradients_are_clipped_to_the_global_norm() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let total = losses(&model, &clips, &Objectives::default(), &Pass::train(0, 0)).unwrap().total;
    let moved = |scale: f64, max_gradient_norm: f64| {
        let model = crate::fixture::model(1, |_| {});
        let total = losses(&model, &clips, &Objectives::default(), &Pass::train(0, 0)).unwrap().total;
        let gradients = Gradients::of(&(total * scale).unwrap(), model.parameters()).unwrap();
        // A large epsilon makes the update proportional to the gradient.
        let config =
            AdamWConfig { epsilon: 1e3, max_gradient_norm, weight_decay: 0.0, ..AdamWConfig::default() };
        let report = AdamW::new(config).step(model.parameters(), &gradients, 1e3).unwrap();
        (
            report.gradient_norm,
            model.parameters().get("projector.net.3.bias").unwrap().to_vec1::<f32>().unwrap(),
        )
    };
    let norm = f64::from(
        Gradients::of(&total, model.parameters()).unwrap().norm().unwrap().to_scalar::<f32>().unwrap(),
    );
    let (reported, clipped) = moved(100.0, norm);
    assert!((reported / (100.0 * norm) - 1.0).abs() < 1e-5);
    let (_, plain) = moved(1.0, 1e9);
    for (clipped, plain) in clipped.iter().zip(&plain) {
        assert!((clipped - plain).abs() < 1e-6, "{clipped} {plain}");
    }
}

#[test]
fn useless_gradients_change_nothing() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let total = losses(&model, &clips, &Objectives::default(), &Pass::train(0, 0)).unwrap().total;
    let before = bits(&model);
    let gradients = Gradients::of(&(total * f64::NAN).unwrap(), model.parameters()).unwrap();
    let mut optimizer = AdamW::new(AdamWConfig::default());
    let error = optimizer.step(model.parameters(), &gradients, 1e-3).unwrap_err();
    assert!(matches!(error, OptimizerError::NonFinite { step: 0, .. }), "{error}");
    assert_eq!((bits(&model), optimizer.step_count()), (before, 0));
    let nothing = Tensor::zeros((), gawm_model::DType::F32, &gawm_model::Device::Cpu).unwrap();
    let gradients = Gradients::of(&nothing, model.parameters()).unwrap();
    let error = optimizer.step(model.parameters(), &gradients, 1e-3).unwrap_err();
    assert!(matches!(error, OptimizerError::NoGradients { .. }), "{error}");
}

#[test]
fn controls_break_one_relation_only() {
    let (model, clips) = (model(1, |_| {}), clips(2, 8, 4));
    let values = |control| {
        let objectives = Objectives { control, ..Objectives::default() };
        let losses = losses(&model, &clips, &objectives, &Pass::eval()).unwrap();
        losses.values().unwrap().into_iter().map(|(_, value)| value).collect::<Vec<f32>>()
    };
    let (plain, states, actions) =
        (values(Control::None), values(Control::StatesShuffled), values(Control::ActionsShuffled));
    assert_eq!(
        (plain[0], plain[2]),
        (states[0], states[2]),
        "prediction and inverse dynamics do not see states"
    );
    assert_ne!(plain[1], states[1]);
    assert_eq!(plain[1], actions[1], "state alignment does not see actions");
    assert_ne!(plain[0], actions[0]);
    assert_ne!(plain[2], actions[2]);
}

#[test]
fn bf16_products_stay_close() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let total = |precision| {
        let pass = Pass { precision, ..Pass::train(0, 0) };
        losses(&model, &clips, &Objectives::default(), &pass).unwrap().total.to_scalar::<f32>().unwrap()
    };
    let (full, half) = (total(Precision::F32), total(Precision::Bf16));
    assert_ne!(full, half);
    assert!((full - half).abs() < 0.02 * full, "{full} {half}");
}
