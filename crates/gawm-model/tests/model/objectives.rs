//! Values of the objectives: published ones, masks, tables.

use crate::fixture::{clips, model};
use gawm_model::objective::{self, ObjectiveError, PRESETS, StateRule};
use gawm_model::{Clips, Device, ModelConfig, Objectives, Pass, Tensor, Term, losses};

fn scalar(tensor: &Tensor) -> f32 {
    tensor.to_scalar().unwrap()
}

#[test]
fn sigreg_has_the_published_value() {
    let z: Vec<f32> =
        (0..2 * 4 * 3).map(|i| (12 * (i / 12) + 3 * (i / 3 % 4) + i % 3) as f32 / 10.0 - 1.0).collect();
    let z = Tensor::from_vec(z, (2, 4, 3), &Device::Cpu).unwrap();
    let r: Vec<f32> = (0..15).map(|i| i as f32 / 7.0 - 1.0).collect();
    let r = Tensor::from_vec(r, (3, 5), &Device::Cpu).unwrap();
    let r = r.broadcast_div(&r.sqr().unwrap().sum_keepdim(0).unwrap().sqrt().unwrap()).unwrap();
    let value = scalar(&objective::sigreg(&z, &r).unwrap());
    assert!((value - 1.853_881_8).abs() < 2e-5 * 2.9, "{value}");
    let (_, weights) = objective::sigreg_weights();
    let published = [
        0.1875, 0.3684658, 0.3495384, 0.3201286, 0.2830648, 0.2416458, 0.199161, 0.1584752, 0.1217447,
        0.0902964, 0.0646581, 0.0447, 0.0298348, 0.0192252, 0.0119605, 0.0071839, 0.0020829,
    ];
    for (ours, published) in weights.iter().zip(published) {
        assert!((ours - published).abs() < 1e-7, "{ours} {published}");
    }
}

#[test]
fn sigreg_directions_have_unit_length_and_follow_the_step() {
    let directions = |step| objective::sigreg_projections(5, 7, &Pass::train(1, step), &Device::Cpu).unwrap();
    let lengths = directions(0).sqr().unwrap().sum(0).unwrap().to_vec1::<f32>().unwrap();
    assert!(lengths.iter().all(|length| (length - 1.0).abs() < 1e-6), "{lengths:?}");
    assert_ne!(directions(0).to_vec2::<f32>().unwrap(), directions(1).to_vec2::<f32>().unwrap());
}

#[test]
fn straightening_of_a_half_circle_has_the_published_value() {
    let angle = |i: usize| i as f32 * 0.1 * std::f32::consts::PI;
    let z: Vec<f32> = (0..11).flat_map(|i| [angle(i).cos(), angle(i).sin()]).collect();
    let z = Tensor::from_vec(z, (1, 11, 2), &Device::Cpu).unwrap();
    assert!((scalar(&objective::straightening(&z).unwrap()) + 0.951_056_6).abs() < 1e-6);
    assert!(objective::straightening(&z.narrow(1, 0, 2).unwrap()).is_err());
}

#[test]
fn standing_still_gives_no_nan_gradient() {
    let z = gawm_model::Tensor::zeros((1, 4, 2), gawm_model::DType::F32, &Device::Cpu).unwrap();
    let z = candle_core::Var::from_tensor(&z).unwrap();
    let gradients = objective::straightening(&z).unwrap().backward().unwrap();
    let gradient = gradients.get(&z).unwrap().flatten_all().unwrap().to_vec1::<f32>().unwrap();
    assert!(gradient.iter().all(|value| value.is_finite()), "{gradient:?}");
}

#[test]
fn only_supervised_states_count() {
    let (model, clips) = (model(1, |_| {}), clips(2, 3, 4));
    let with = |states: &Tensor, valid: Option<&Tensor>, rule: &StateRule| {
        let clips =
            Clips::try_new(clips.frames.clone(), clips.actions.clone(), states.clone(), valid, rule).unwrap();
        let losses = losses(&model, &clips, &Objectives::preset("sa").unwrap(), &Pass::eval()).unwrap();
        losses.value(Term::StateAlignment).unwrap().unwrap()
    };
    let broken = |t: usize, dim: usize| {
        let mut values = clips.states.to_vec3::<f32>().unwrap();
        values.iter_mut().for_each(|clip| clip[t][dim] = f32::NAN);
        Tensor::new(values, &Device::Cpu).unwrap()
    };
    // Velocities (dim 2) are not looked at in the first frame, and only there.
    let rule = StateRule { supervised: None, velocity: vec![2] };
    assert_eq!(with(&broken(0, 2), None, &rule), with(&clips.states, None, &rule));
    assert!(with(&broken(1, 2), None, &rule).is_nan());
    assert!(with(&broken(0, 1), None, &rule).is_nan());
    // Dims that are not supervised are not looked at.
    let rule = StateRule { supervised: Some(vec![0, 2]), velocity: vec![] };
    assert_eq!(with(&broken(2, 1), None, &rule), with(&clips.states, None, &rule));
    // Nor values that were not recorded.
    let mut valid = vec![vec![vec![1u8; 3]; 4]; 3];
    valid.iter_mut().for_each(|clip| clip[3][0] = 0);
    let valid = Tensor::new(valid, &Device::Cpu).unwrap();
    assert!(!with(&broken(3, 0), Some(&valid), &StateRule::default()).is_nan());
    let wrong = StateRule { supervised: None, velocity: vec![3] };
    assert!(
        Clips::try_new(clips.frames.clone(), clips.actions.clone(), clips.states.clone(), None, &wrong)
            .is_err()
    );
}

#[test]
fn clips_that_do_not_fit_are_refused() {
    let good = clips(2, 3, 4);
    let short = good.actions.narrow(1, 0, 3).unwrap();
    let error = Clips::try_new(good.frames.clone(), short, good.states.clone(), None, &StateRule::default());
    assert!(error.unwrap_err().to_string().contains("actions"));
    let one = good.frames.narrow(1, 0, 1).unwrap();
    let error = Clips::try_new(one, good.actions, good.states, None, &StateRule::default());
    assert!(error.unwrap_err().to_string().contains("T >= 2"));
}

#[test]
fn every_preset_trains_a_model_with_just_its_heads() {
    for name in PRESETS {
        let objectives = Objectives { sigreg_projections: 16, ..Objectives::preset(name).unwrap() };
        let model = model(1, |config| objectives.configure(config));
        let losses = losses(&model, &clips(2, 4, 4), &objectives, &Pass::train(1, 1)).unwrap();
        let values = losses.values().unwrap();
        let total: f64 = losses.terms.iter().map(|t| t.weight * f64::from(scalar(&t.value))).sum();
        assert!(
            (total - f64::from(values.last().unwrap().1)).abs() < 1e-5 * total.abs(),
            "{name}: {values:?}"
        );
        let gradients = gawm_model::Gradients::of(&losses.total, model.parameters()).unwrap();
        for (parameter, _) in model.parameters().trainable() {
            assert!(gradients.get(parameter).is_some(), "{name}: {parameter} has no gradient");
        }
    }
}

#[test]
fn monitored_terms_are_logged_without_weight() {
    let table =
        "preset = \"pred-only\"\nmonitored = [\"straightening\", \"state-alignment\"]".parse().unwrap();
    let objectives = Objectives::from_table(table).unwrap();
    let mut config = ModelConfig::preset("micro").unwrap();
    objectives.configure(&mut config);
    assert!(config.state_head && !config.inverse_head);
    let model = model(1, |model| objectives.configure(model));
    let values = losses(&model, &clips(2, 3, 4), &objectives, &Pass::eval()).unwrap().values().unwrap();
    let names: Vec<&str> = values.iter().map(|(name, _)| *name).collect();
    assert_eq!(names, ["prediction", "state-alignment", "straightening", "total"]);
    assert_eq!(values[0].1, values[3].1);
}

#[test]
fn tables_with_mistakes_name_them() {
    let parse = |text: &str| Objectives::from_table(text.parse().unwrap());
    let objectives = parse("preset = \"lewm\"\nweights = { sigreg = 0.001, straightening = 1 }").unwrap();
    assert_eq!((objectives.weight(Term::Sigreg), objectives.weight(Term::Straightening)), (0.001, 1.0));
    for (text, part) in [
        ("preset = \"jepa\"", "jepa"),
        ("weight = { sigreg = 1.0 }", "weight"),
        ("weights = { sig = 1.0 }", "sig"),
        ("weights = { sigreg = \"much\" }", "sigreg"),
        ("weights = { sigreg = -1.0 }", "sigreg"),
        ("weights = { sigreg = nan }", "sigreg"),
        ("preset = \"pred-only\"\nweights = { prediction = 0 }", "all"),
        ("sigreg-projections = 0", "sigreg-projections"),
        ("monitored = [\"everything\"]", "everything"),
    ] {
        let error: ObjectiveError = parse(text).unwrap_err();
        assert!(error.to_string().contains(part), "{text}: {error}");
    }
}
