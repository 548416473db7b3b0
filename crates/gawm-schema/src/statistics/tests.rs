use proptest::prelude::*;

use super::*;

/// A fixed sequence without structure: SplitMix64 in [0, 1).
fn noise(n: usize) -> Vec<f64> {
    let mut state = 42u64;
    (0..n)
        .map(|_| {
            state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
            let mut z = state;
            z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
            z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
            ((z ^ (z >> 31)) >> 11) as f64 / (1u64 << 53) as f64
        })
        .collect()
}

fn stats(values: &[f64]) -> DimStats {
    let mut stats = DimStats::new(true);
    values.iter().for_each(|&value| stats.update(value));
    stats
}

/// Mean and standard deviation in two passes, as numpy does.
fn two_pass(values: &[f64]) -> (f64, f64) {
    let n = values.len() as f64;
    let mean = values.iter().sum::<f64>() / n;
    (mean, (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / n).sqrt())
}

#[track_caller]
fn check_close(got: f64, expected: f64, tolerance: f64) {
    assert!((got - expected).abs() <= tolerance * (1.0 + expected.abs()), "{got} != {expected}");
}

#[test]
fn small_numbers_by_hand() {
    let summary = stats(&[1.0, 2.0, f64::NAN, 4.0, f64::INFINITY, 9.0]).summary();
    assert_eq!((summary.count, summary.n_missing, summary.min, summary.max), (4, 2, 1.0, 9.0));
    check_close(summary.mean, 4.0, 1e-15);
    check_close(summary.std, 9.5f64.sqrt(), 1e-15);
    // numpy.quantile([1, 2, 4, 9], [.01, .1, .5, .9, .99])
    for (got, expected) in
        [(summary.q01, 1.03), (summary.q10, 1.3), (summary.q50, 3.0), (summary.q90, 7.5), (summary.q99, 8.85)]
    {
        check_close(got, expected, 1e-14);
    }
    let empty = DimStats::new(false).summary();
    assert_eq!((empty.count, empty.mean, empty.q50), (0, 0.0, 0.0));
}

#[test]
fn a_large_offset_does_not_destroy_the_spread() {
    let values: Vec<f64> = noise(10_000).iter().map(|v| 1e9 + v * 1e-3).collect();
    // Without the offset, which is exact, the oracle is accurate; E[x^2] - E[x]^2 would have no correct digit.
    let (mean, std) = two_pass(&values.iter().map(|v| v - 1e9).collect::<Vec<_>>());
    let moments = stats(&values).moments;
    check_close(moments.mean(), 1e9 + mean, 1e-15);
    check_close(moments.std() / std, 1.0, 1e-12);
    let mut merged = Moments::default();
    values.chunks(777).for_each(|part| merged.merge(&stats(part).moments));
    check_close(merged.std() / std, 1.0, 1e-12);
    let constant = stats(&[0.1; 1000]).moments;
    assert!(constant.is_constant() && constant.std() == 0.0);
    check_close(moments.sample_std() / moments.std(), (10_000.0f64 / 9_999.0).sqrt(), 1e-12);
}

#[test]
fn summaries_are_finite_whatever_the_values() {
    let summary = stats(&[f64::MAX, f64::MIN, 1e200, -1e200]).summary();
    let text = serde_json::to_string(&summary).unwrap();
    assert!(!text.contains("null"), "{text}");
}

/// Returns the largest rank error of the summary's quantiles, as a share of the count.
fn rank_error(sketch: &QuantileSketch, sorted: &[f64]) -> f64 {
    let fractions = [0.001, 0.01, 0.1, 0.25, 0.5, 0.75, 0.9, 0.99, 0.999];
    let found = sketch.quantiles(fractions);
    fractions
        .iter()
        .zip(found)
        .map(|(fraction, value)| {
            let value = value.unwrap();
            let below = sorted.partition_point(|&v| v < value) as f64 / sorted.len() as f64;
            let up_to = sorted.partition_point(|&v| v <= value) as f64 / sorted.len() as f64;
            if (below..=up_to).contains(fraction) {
                0.0
            } else {
                (fraction - below).abs().min((fraction - up_to).abs())
            }
        })
        .fold(0.0, f64::max)
}

/// The i-th value from a random number in [0, 1).
type Shape = fn(usize, f64) -> f64;

#[test]
fn quantiles_of_many_values_are_within_half_a_percent_rank() {
    let n = 300_000;
    let shapes: [(&str, Shape); 5] = [
        ("uniform", |_, u| u),
        ("ascending", |i, _| i as f64),
        ("descending", |i, _| -(i as f64)),
        ("long tail", |_, u| (1.0 / (1.0 - u)).powi(3)),
        ("steps", |_, u| (u * 7.0).floor()),
    ];
    let noise = noise(n);
    for (name, shape) in shapes {
        let values: Vec<f64> = noise.iter().enumerate().map(|(i, &u)| shape(i, u)).collect();
        let mut sorted = values.clone();
        sorted.sort_unstable_by(f64::total_cmp);
        let mut whole = QuantileSketch::default();
        values.iter().for_each(|&value| whole.update(value));
        let mut merged = QuantileSketch::default();
        for part in values.chunks(7_777) {
            let mut sketch = QuantileSketch::default();
            part.iter().for_each(|&value| sketch.update(value));
            merged.merge(&sketch);
        }
        for (way, sketch) in [("whole", &whole), ("merged", &merged)] {
            let error = rank_error(sketch, &sorted);
            assert!(error <= 0.005, "{name} {way}: rank error {error}");
            assert_eq!(sketch.count(), n as u64);
            assert!(sketch.len() < 4 * QuantileSketch::EXACT, "{name} {way} keeps {}", sketch.len());
        }
    }
}

#[test]
fn histograms_adapt_and_keep_every_count() {
    let mut histogram = Histogram::default();
    for value in [0.0, -0.0, 1.0, -1.0, 1e-300, 1e12, -3.5] {
        histogram.update(value);
    }
    assert_eq!(histogram.counts().iter().sum::<u64>(), 7);
    assert!(histogram.counts().len() <= Histogram::MAX_BINS);
    assert!(histogram.start() <= -3.5);
    assert!(histogram.start() + histogram.bin_width() * histogram.counts().len() as f64 > 1e12);
    let mut extremes = Histogram::default();
    for value in [f64::MAX, f64::MIN, f64::MIN_POSITIVE, 5e-324] {
        extremes.update(value);
    }
    assert_eq!(extremes.counts().iter().sum::<u64>(), 4);
}

#[test]
fn directions_average_over_the_wrap() {
    let pi = std::f64::consts::PI;
    let circular = stats(&[pi - 0.1, -pi + 0.1]).circular.unwrap();
    check_close(circular.mean_direction().unwrap().abs(), pi, 1e-12);
    check_close(circular.resultant_length(), 0.1f64.cos(), 1e-12);
    assert_eq!(stats(&[0.0, pi]).circular.unwrap().mean_direction(), None);
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 100, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(11),
        ..ProptestConfig::default()
    })]

    #[test]
    fn merged_parts_equal_the_whole(
        values in prop::collection::vec(prop_oneof![9 => -1e3f64..1e3, 1 => Just(f64::NAN)], 0..300),
        cuts in prop::collection::vec(0usize..300, 0..5),
    ) {
        let mut cuts: Vec<usize> = cuts.into_iter().map(|cut| cut.min(values.len())).chain([0, values.len()]).collect();
        cuts.sort_unstable();
        let mut merged = DimStats::new(true);
        cuts.windows(2).for_each(|pair| merged.merge(&stats(&values[pair[0]..pair[1]])));
        let whole = stats(&values);
        prop_assert_eq!(&merged.histogram, &whole.histogram);
        let (a, b) = (merged.summary(), whole.summary());
        prop_assert_eq!((a.count, a.n_missing, a.min, a.max), (b.count, b.n_missing, b.min, b.max));
        prop_assert_eq!((a.q01, a.q10, a.q50, a.q90, a.q99), (b.q01, b.q10, b.q50, b.q90, b.q99));
        check_close(a.mean, b.mean, 1e-12);
        check_close(a.std, b.std, 1e-12);
        let finite: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
        if !finite.is_empty() {
            let (mean, std) = two_pass(&finite);
            check_close(b.mean, mean, 1e-12);
            check_close(b.std, std, 1e-12);
        }
        check_close(merged.circular.unwrap().resultant_length(), whole.circular.unwrap().resultant_length(), 1e-12);
    }

    #[test]
    fn order_does_not_change_a_histogram(values in prop::collection::vec(prop::num::f64::NORMAL | prop::num::f64::ZERO, 1..60)) {
        let mut forward = Histogram::default();
        values.iter().for_each(|&v| forward.update(v));
        let mut backward = Histogram::default();
        values.iter().rev().for_each(|&v| backward.update(v));
        prop_assert_eq!(&forward, &backward);
        prop_assert_eq!(forward.counts().iter().sum::<u64>(), values.len() as u64);
        prop_assert!(forward.counts().len() <= Histogram::MAX_BINS);
    }
}
