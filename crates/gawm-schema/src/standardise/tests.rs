use super::*;
use crate::{Encoding, Unit};

fn dim(name: &str, is_standardised: bool) -> EncodedDim {
    EncodedDim {
        name: name.to_owned(),
        unit: Unit("m".to_owned()),
        encoding: Encoding::Identity,
        is_standardised,
        feature: "observation.state".to_owned(),
        raw_dims: vec![name.to_owned()],
    }
}

fn moments(values: &[f64]) -> Moments {
    let mut moments = Moments::default();
    values.iter().for_each(|&value| moments.update(value));
    moments
}

#[test]
fn scales_what_varies_and_nothing_else() {
    let dims = [dim("x", true), dim("constant", true), dim("sin", false), dim("never", true)];
    let all = [moments(&[1.0, 3.0, 5.0]), moments(&[0.1; 3]), moments(&[0.5, -0.5]), Moments::default()];
    let fitted_on =
        FittedOn { episodes_of: "train".to_owned(), episodes: 1, frames: 3, hash: ContentHash::of(b"") };
    let affine = Standardisation::fit("gawm.state", &dims, &all, fitted_on);
    let scales: Vec<f64> = affine.dims.iter().map(|d| d.scale).collect();
    assert_eq!(scales, [(8.0f64 / 3.0).sqrt(), 1.0, 1.0, 1.0]);
    let means: Vec<f64> = affine.dims.iter().map(|d| d.mean).collect();
    assert_eq!(means, [3.0, 0.1, 0.0, 0.0]);
    assert_eq!(affine.dims.iter().map(|d| d.is_constant).collect::<Vec<_>>(), [false, true, false, true]);
    let mut row = [5.0, 0.1, 0.25, f64::NAN];
    affine.apply(&mut row);
    assert!((row[0] - 2.0 / (8.0f64 / 3.0).sqrt()).abs() < 1e-15 && row[1] == 0.0 && row[2] == 0.25);
    assert!(row[3].is_nan());
    affine.invert(&mut row);
    assert!((row[0] - 5.0).abs() < 1e-15);
    let text = serde_json::to_string(&affine).unwrap();
    assert_eq!(serde_json::from_str::<Standardisation>(&text).unwrap(), affine);
}

#[test]
fn membership_is_fixed_and_has_the_asked_share() {
    let n = 20_000;
    let count = |share: f64| (0..n).filter(|i| is_training(&format!("session-{i}"), share)).count() as f64;
    // Four standard deviations of a binomial of 20 000.
    assert!((count(0.9) / f64::from(n) - 0.9).abs() < 0.009);
    assert_eq!((count(0.0), count(1.0)), (0.0, f64::from(n)));
    // Fixed for ever: datasets on disk rely on it.
    assert_eq!(training_fraction("session-0"), 0.822_400_614_721_049_2);
    assert_eq!(training_fraction("session-1"), 0.043_006_195_990_994_31);
    // What is training data at a small share is so at a larger one.
    assert!((0..100).all(|i| !is_training(&i.to_string(), 0.3) || is_training(&i.to_string(), 0.6)));
}
