//! Gradients against finite differences, and that no parameter is cut off.

use crate::fixture::{clips, has_zero_gradient, model, normal};
use gawm_model::{Clips, Gradients, InverseInput, Objectives, Pass, Tensor, Term, WorldModel, losses};

/// All terms at once, so that one backward pass covers everything.
fn everything() -> Objectives {
    let weight = |term| (term, if term == Term::Sigreg { 0.1 } else { 1.0 });
    Objectives { sigreg_projections: 16, ..Objectives::of(&Term::ALL.map(weight)) }
}

fn loss(model: &WorldModel, clips: &Clips, objectives: &Objectives) -> f64 {
    let losses = losses(model, clips, objectives, &Pass::train(3, 5)).unwrap();
    f64::from(losses.total.to_scalar::<f32>().unwrap())
}

fn scalar(tensor: &Tensor) -> f64 {
    f64::from(tensor.to_scalar::<f32>().unwrap())
}

/// Compares the derivative along a random direction in every tensor whose name starts with `prefix`.
///
/// f32 losses near 1 are exact to 1e-7 or so; a step of length `STEP` in one tensor moves them by 1e-5 and more. The
/// difference is compared with what a random direction sees of the gradient, norm / sqrt(count).
fn check_tensors(objectives: &Objectives, inverse_input: InverseInput, prefix: &str) {
    const STEP: f64 = 0.02;
    let model = model(1, |config| config.inverse_input = inverse_input);
    let clips = clips(2, 3, 4);
    let total = losses(&model, &clips, objectives, &Pass::train(3, 5)).unwrap().total;
    let gradients = Gradients::of(&total, model.parameters()).unwrap();
    let mut compared = 0;
    for (name, gradient) in gradients.iter().filter(|(name, _)| name.starts_with(prefix)) {
        let direction = normal(7, name, gradient.dims());
        let length = scalar(&direction.sqr().unwrap().sum_all().unwrap().sqrt().unwrap());
        let direction = (direction / length).unwrap();
        let expected = scalar(&(gradient * &direction).unwrap().sum_all().unwrap());
        let start = model.parameters().get(name).unwrap().copy().unwrap();
        let moved = |step: f64| {
            let value = (&start + (&direction * step).unwrap()).unwrap();
            model.parameters().set(name, &value).unwrap();
            loss(&model, &clips, objectives)
        };
        let got = (moved(STEP) - moved(-STEP)) / (2.0 * STEP);
        model.parameters().set(name, &start).unwrap();
        let norm = scalar(&gradient.sqr().unwrap().sum_all().unwrap().sqrt().unwrap());
        let seen = norm / (gradient.elem_count() as f64).sqrt();
        let allowed = 0.05 * seen + 5e-7 / STEP;
        assert!((got - expected).abs() <= allowed, "{name}: expected {expected}, got {got} (+-{allowed})");
        compared += 1;
    }
    assert!(compared > 0, "no tensor {prefix:?}");
}

#[test]
fn encoder_gradients_are_derivatives() {
    check_tensors(&everything(), InverseInput::Pair, "encoder");
}

#[test]
fn predictor_gradients_are_derivatives() {
    check_tensors(&everything(), InverseInput::Pair, "pred");
}

#[test]
fn other_gradients_are_derivatives() {
    for prefix in ["action_encoder", "projector", "state_probe", "idm_head"] {
        check_tensors(&everything(), InverseInput::Pair, prefix);
    }
}

#[test]
fn each_term_has_the_gradient_of_its_value() {
    for term in Term::ALL {
        // The last layer of the projector moves every latent, hence every term.
        check_tensors(
            &Objectives { sigreg_projections: 16, ..Objectives::of(&[(term, 1.0)]) },
            InverseInput::Pair,
            "projector.net.3",
        );
    }
    for input in [InverseInput::PairReversed, InverseInput::Difference] {
        check_tensors(&Objectives::of(&[(Term::InverseDynamics, 1.0)]), input, "projector.net.3");
        check_tensors(&Objectives::of(&[(Term::InverseDynamics, 1.0)]), input, "idm_head");
    }
}

/// Walks every parameter: each receives a gradient that is not zero, unless it is zero in exact arithmetic.
#[test]
fn every_parameter_receives_a_gradient() {
    let model = model(1, |_| {});
    let total = losses(&model, &clips(2, 3, 4), &Objectives::default(), &Pass::train(3, 5)).unwrap().total;
    let gradients = Gradients::of(&total, model.parameters()).unwrap();
    let global = scalar(&gradients.norm().unwrap());
    for (name, _) in model.parameters().trainable() {
        let gradient = gradients.get(name).unwrap_or_else(|| panic!("{name} has no gradient"));
        let norm = scalar(&gradient.sqr().unwrap().sum_all().unwrap().sqrt().unwrap());
        if has_zero_gradient(name) {
            assert!(norm < 1e-5 * global, "{name}: expected zero, got {norm} of {global}");
        } else {
            assert!(norm > 1e-5 * global, "{name}: expected a gradient, got {norm} of {global}");
        }
    }
}

/// At the start, the modulation is zero and the predictor is the identity on z + positions, up to its last norm.
#[test]
fn untrained_blocks_are_the_identity() {
    let config = gawm_model::ModelConfig::preset("micro").unwrap();
    let model = WorldModel::new(config.resolve(crate::fixture::WIDTHS).unwrap(), 3, &gawm_model::Device::Cpu)
        .unwrap();
    let (z, c) = (normal(1, "z", &[2, 3, 16]), normal(1, "c", &[2, 3, 16]));
    let predictor = gawm_model::Predictor::load(model.parameters(), model.architecture()).unwrap();
    let got = predictor.forward(&z, &c, &Pass::eval()).unwrap();
    let positions = model.parameters().get("predictor.pos_embedding").unwrap();
    let expected = gawm_model::layers::normalize(&z.broadcast_add(&positions).unwrap(), 1e-5).unwrap();
    let largest = scalar(&(got - expected).unwrap().abs().unwrap().max_all().unwrap());
    assert!(largest < 1e-6, "{largest}");
}

/// The last position sees everything, the first only itself.
#[test]
fn predictions_do_not_see_the_future() {
    let model = model(1, |_| {});
    let (z, c) = (normal(1, "z", &[2, 3, 16]), normal(1, "c", &[2, 3, 16]));
    let predict = |z: &Tensor, c: &Tensor| {
        let predictor = gawm_model::Predictor::load(model.parameters(), model.architecture()).unwrap();
        predictor.forward(z, c, &Pass::eval()).unwrap()
    };
    let whole = predict(&z, &c);
    for t in 1..=3 {
        let part = predict(&z.narrow(1, 0, t).unwrap(), &c.narrow(1, 0, t).unwrap());
        let difference = (whole.narrow(1, 0, t).unwrap() - part).unwrap().abs().unwrap();
        let largest = scalar(&difference.max_all().unwrap());
        assert!(largest < 1e-5, "window {t}: {largest}");
    }
}
