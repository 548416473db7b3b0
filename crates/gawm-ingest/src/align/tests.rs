use gawm_schema::{Kind, QuaternionOrder, Wrap};
use proptest::prelude::*;

use super::*;

const MS: i64 = 1_000_000;

/// Collects what an aligner makes.
#[derive(Default)]
struct Collected {
    episodes: Vec<(EpisodeStart, Vec<Row<i64>>, EndReason)>,
    open: Option<(EpisodeStart, Vec<Row<i64>>)>,
    gaps: Vec<GapEvent>,
    discarded: Vec<u64>,
}

impl RowSink<i64> for Collected {
    fn begin(&mut self, start: EpisodeStart) {
        assert!(self.open.is_none());
        self.open = Some((start, Vec::new()));
    }
    fn row(&mut self, row: &Row<i64>) {
        self.open.as_mut().unwrap().1.push(row.clone());
    }
    fn end(&mut self, reason: EndReason) {
        let (start, rows) = self.open.take().unwrap();
        self.episodes.push((start, rows, reason));
    }
    fn discard(&mut self, interval: u64) {
        self.discarded.push(interval);
    }
    fn gap(&mut self, event: GapEvent) {
        self.gaps.push(event);
    }
}

impl Collected {
    fn times_ms(&self) -> Vec<Vec<i64>> {
        self.episodes.iter().map(|(_, rows, _)| rows.iter().map(|row| row.time_ns / MS).collect()).collect()
    }
    fn values(&self) -> Vec<Vec<f64>> {
        self.episodes.iter().flat_map(|(_, rows, _)| rows.iter().map(|row| row.values.clone())).collect()
    }
    fn valid(&self, feature: usize) -> Vec<bool> {
        self.episodes.iter().flat_map(|(_, rows, _)| rows.iter().map(|row| row.valid[feature])).collect()
    }
}

fn stream(tolerance_ms: i64) -> StreamRule {
    StreamRule {
        name: "s".to_owned(),
        width: 1,
        parts: vec![PartKind { kind: Kind::Linear, width: 1 }],
        method: Method::Asof,
        tolerance_ns: Some(tolerance_ms * MS),
        gap: GapAction::Split,
        timing: None,
        split_non_finite: false,
    }
}

fn rule(streams: Vec<StreamRule>, rate_hz: f64) -> AlignRule {
    let features = (0..streams.len())
        .map(|index| match streams[index].is_image() {
            true => FeatureRule::Image { stream: index },
            false => FeatureRule::Vector { streams: vec![index] },
        })
        .collect();
    AlignRule { streams, features, ticks: Ticks::Fixed { rate_hz }, max_gap_ns: 5_000 * MS }
}

fn at(ms: f64, ordinal: u64) -> SampleTime {
    let ns = (ms * MS as f64) as i64;
    SampleTime { key_ns: ns, clock_ns: ns, log_ns: ns + 3 * MS, ordinal }
}

/// Samples of (stream, ms, value) in reading order, through one open interval.
fn aligned(rule: AlignRule, samples: &[(usize, f64, f64)]) -> Collected {
    let mut aligner = Aligner::new(rule);
    let mut sink = Collected::default();
    aligner.open_interval(i64::MIN);
    push_all(&mut aligner, samples);
    aligner.finish(&mut sink).unwrap();
    sink
}

fn push_all(aligner: &mut Aligner<i64>, samples: &[(usize, f64, f64)]) {
    for (ordinal, &(stream, ms, value)) in samples.iter().enumerate() {
        let time = at(ms, ordinal as u64);
        if aligner.rule().streams[stream].is_image() {
            aligner.push_image(stream, time, value as i64).unwrap();
        } else {
            let values = vec![value; aligner.rule().streams[stream].width];
            aligner.push_values(stream, time, &values).unwrap();
        }
    }
}

fn steps(stream: usize, from_ms: f64, to_ms: f64, step_ms: f64) -> Vec<(usize, f64, f64)> {
    let n = ((to_ms - from_ms) / step_ms).round() as usize;
    (0..=n).map(|k| from_ms + k as f64 * step_ms).map(|ms| (stream, ms, ms)).collect()
}

#[test]
fn rows_start_when_all_required_streams_are_there() {
    let samples = [steps(0, 0.0, 100.0, 10.0), steps(1, 35.0, 95.0, 20.0)].concat();
    let got = aligned(rule(vec![stream(15), stream(30)], 100.0), &samples);
    assert_eq!(got.times_ms(), vec![(35..=100).step_by(10).collect::<Vec<_>>()]);
    assert_eq!(got.values()[0], [30.0, 35.0]);
    assert_eq!(got.values()[1], [40.0, 35.0]);
    assert_eq!(got.episodes[0].1[1].age_ms, [5.0, 10.0]);
    assert_eq!(got.episodes[0].1[1].arrival_age_ms, [2.0, 7.0]);
    assert!(got.gaps.is_empty(), "{:?}", got.gaps);
}

/// Rows of streams that are all masked, and how they begin.
fn check_all_masked(ticks: Ticks, samples: &[(usize, f64, f64)], expected: &[Vec<i64>]) {
    let masked = StreamRule { gap: GapAction::Mask, ..stream(15) };
    let rule = AlignRule { ticks, ..rule(vec![masked.clone(), masked], 100.0) };
    assert_eq!(aligned(rule, samples).times_ms(), expected);
}

#[test]
fn rows_of_masked_streams_begin_with_the_first_sample() {
    let fixed = Ticks::Fixed { rate_hz: 100.0 };
    let samples = [steps(0, 20.0, 50.0, 10.0), steps(1, 40.0, 60.0, 10.0)].concat();
    check_all_masked(fixed.clone(), &samples, &[(20..=60).step_by(10).collect()]);
    check_all_masked(fixed.clone(), &steps(1, 7.0, 27.0, 10.0), &[vec![7, 17, 27]]);
    check_all_masked(fixed, &[], &[]);
    check_all_masked(Ticks::Reference { stream: 1 }, &samples, &[vec![40, 50, 60]]);
}

#[test]
fn a_gap_splits_and_never_squeezes_time() {
    let samples = [steps(0, 0.0, 50.0, 10.0), steps(0, 203.0, 243.0, 10.0)].concat();
    let got = aligned(rule(vec![stream(15)], 100.0), &samples);
    assert_eq!(got.times_ms(), vec![vec![0, 10, 20, 30, 40, 50, 60], vec![203, 213, 223, 233, 243]]);
    assert_eq!(got.episodes[0].2, EndReason::Gap { stream: 0 });
    let event = GapEvent {
        stream: Some(0),
        last_ns: Some(50 * MS),
        resumed_ns: Some(203 * MS),
        rule: GapAction::Split,
    };
    assert_eq!(got.gaps, [event]);
}

#[test]
fn a_masked_gap_is_nan_and_a_masked_image_is_held() {
    let masked = StreamRule { gap: GapAction::Mask, ..stream(15) };
    let image = StreamRule { width: 0, parts: vec![], gap: GapAction::Mask, ..stream(15) };
    let mut samples =
        [steps(0, 0.0, 100.0, 10.0), steps(1, 0.0, 30.0, 10.0), steps(1, 70.0, 100.0, 10.0)].concat();
    samples.extend([(2, 0.0, 7.0), (2, 80.0, 8.0), (2, 90.0, 9.0), (2, 100.0, 10.0)]);
    let got = aligned(rule(vec![stream(15), masked, image], 100.0), &samples);
    assert_eq!(got.times_ms(), vec![(0..=100).step_by(10).collect::<Vec<_>>()]);
    assert_eq!(got.valid(1), [true, true, true, true, true, false, false, true, true, true, true]);
    assert!(got.values()[5][1].is_nan() && got.values()[5][0] == 50.0);
    let images: Vec<i64> = got.episodes[0].1.iter().map(|row| row.images[0]).collect();
    assert_eq!(images, [7, 7, 7, 7, 7, 7, 7, 7, 8, 9, 10]);
    assert_eq!(got.valid(2), [true, true, false, false, false, false, false, false, true, true, true]);
    assert_eq!(got.episodes[0].1[5].age_ms[2], 50.0);
    assert_eq!(got.gaps.len(), 2);
}

#[test]
fn drop_and_fail_rules() {
    let samples = [steps(0, 0.0, 50.0, 10.0), steps(0, 200.0, 240.0, 10.0)].concat();
    let dropping = StreamRule { gap: GapAction::DropEpisode, ..stream(15) };
    let got = aligned(rule(vec![dropping], 100.0), &samples);
    assert_eq!(got.discarded, [0]);
    let failing = StreamRule { gap: GapAction::Fail, ..stream(15) };
    let mut aligner = Aligner::new(rule(vec![failing], 100.0));
    aligner.open_interval(i64::MIN);
    push_all(&mut aligner, &samples);
    let stop = aligner.finish(&mut Collected::default()).unwrap_err();
    assert_eq!(stop, Stop { stream: 0, tick_ns: 70 * MS, last_ns: Some(50 * MS) });
}

#[test]
fn silence_of_all_streams_splits_even_what_holds() {
    let holding = StreamRule { tolerance_ns: None, ..stream(0) };
    let samples = [steps(0, 0.0, 50.0, 10.0), steps(0, 3_600_000.0, 3_600_050.0, 10.0)].concat();
    let got = aligned(rule(vec![holding], 100.0), &samples);
    assert_eq!(got.episodes.len(), 2);
    assert_eq!(got.times_ms()[1][0], 3_600_000);
    assert_eq!(got.gaps.len(), 1);
    assert_eq!((got.gaps[0].stream, got.gaps[0].resumed_ns), (None, Some(3_600_000 * MS)));
    assert!(got.times_ms()[0].len() < 600, "held for the longest allowed silence at most");
}

#[test]
fn a_latched_stream_holds_across_a_jump() {
    let latched = StreamRule { tolerance_ns: None, ..stream(0) };
    let mut samples = [steps(0, 0.0, 50.0, 10.0), steps(0, 3_600_000.0, 3_600_050.0, 10.0)].concat();
    samples.push((1, 0.0, 1.0));
    let got = aligned(rule(vec![stream(15), latched], 100.0), &samples);
    assert_eq!(got.episodes.len(), 2);
}

fn action_rule(timing: ActionTiming, tolerance_ms: i64) -> AlignRule {
    let action = StreamRule { timing: Some(timing), ..stream(tolerance_ms) };
    rule(vec![stream(25), action], 50.0)
}

fn actions(
    timing: ActionTiming,
    tolerance_ms: i64,
    commands: &[(usize, f64, f64)],
) -> (Vec<Vec<f64>>, Vec<bool>) {
    let samples = [steps(0, 0.0, 100.0, 20.0), commands.to_vec()].concat();
    let got = aligned(action_rule(timing, tolerance_ms), &samples);
    let values = got.values().into_iter().map(|row| row[1..].to_vec()).collect();
    (values, got.valid(1))
}

#[test]
fn action_in_force_is_the_last_at_or_before_the_row() {
    let (values, valid) = actions(ActionTiming::InForce, 100, &steps(1, 0.0, 100.0, 15.0));
    assert_eq!(values, [[0.0], [15.0], [30.0], [60.0], [75.0], [75.0]]);
    assert_eq!(valid, [true, true, true, true, true, false]);
}

#[test]
fn next_action_is_the_first_after_the_row() {
    let (values, valid) = actions(ActionTiming::Next, 100, &steps(1, 5.0, 105.0, 20.0));
    assert_eq!(values, [[5.0], [25.0], [45.0], [65.0], [85.0], [85.0]]);
    assert_eq!(valid, [true, true, true, true, true, false]);
}

#[test]
fn windows_are_resampled_or_reduced() {
    let commands = steps(1, 1.0, 101.0, 5.0);
    let (values, _) = actions(ActionTiming::Resample(4), 100, &commands);
    assert_eq!(values[0], [1.0, 6.0, 11.0, 16.0]);
    assert_eq!(values[1], [21.0, 26.0, 31.0, 36.0]);
    let (values, _) = actions(ActionTiming::Resample(2), 100, &commands);
    assert_eq!(values[0], [1.0, 11.0]);
    let (values, _) = actions(ActionTiming::Reduce(Reduction::Sum), 100, &commands);
    assert_eq!(values[0], [34.0]);
    let (values, _) = actions(ActionTiming::Reduce(Reduction::Mean), 100, &commands);
    assert_eq!(values[1], [28.5]);
    let (values, valid) = actions(ActionTiming::Reduce(Reduction::Last), 100, &commands);
    assert_eq!(values, [[16.0], [36.0], [56.0], [76.0], [96.0], [96.0]]);
    assert_eq!(valid.last(), Some(&false));
}

#[test]
fn a_row_without_a_command_is_the_last_of_its_episode() {
    let commands = [(1, 0.0, 1.0), (1, 20.0, 2.0), (1, 80.0, 3.0), (1, 100.0, 4.0)];
    let samples = [steps(0, 0.0, 100.0, 20.0), commands.to_vec()].concat();
    let got = aligned(action_rule(ActionTiming::InForce, 25), &samples);
    assert_eq!(got.times_ms(), vec![vec![0, 20, 40, 60], vec![80, 100]]);
    assert_eq!(got.valid(1), [true, true, true, false, true, false]);
    assert_eq!(got.values()[3], [60.0, 2.0]);
}

#[test]
fn derived_actions_lead_to_the_next_state() {
    for (derivation, expected) in [
        (Derivation::Next, [[0.0, 20.0], [20.0, 40.0], [40.0, 40.0]]),
        (Derivation::Difference, [[0.0, 20.0], [20.0, 20.0], [40.0, 20.0]]),
    ] {
        let mut rule = rule(vec![stream(25)], 50.0);
        let parts = rule.streams[0].parts.clone();
        rule.features.push(FeatureRule::Derived { from: 0, derivation, parts });
        let got = aligned(rule, &steps(0, 0.0, 40.0, 20.0));
        assert_eq!(got.values(), expected);
        assert_eq!(got.valid(1), [true, true, false]);
    }
}

#[test]
fn a_nan_command_is_kept_and_not_valid() {
    let commands =
        [(1, 0.0, 1.0), (1, 20.0, f64::NAN), (1, 40.0, f64::INFINITY), (1, 60.0, 4.0), (1, 80.0, f64::NAN)];
    let (values, valid) = actions(ActionTiming::InForce, 30, &commands);
    assert_eq!(format!("{values:?}"), "[[1.0], [NaN], [inf], [4.0], [NaN], [4.0]]");
    assert_eq!(valid, [true, false, false, true, false, false]);
}

#[test]
fn marked_intervals_bound_the_rows() {
    let mut aligner = Aligner::new(rule(vec![stream(15)], 100.0));
    let mut sink = Collected::default();
    push_all(&mut aligner, &steps(0, 0.0, 200.0, 10.0));
    assert_eq!(aligner.open_interval(25 * MS), 0);
    aligner.close_interval(60 * MS);
    assert_eq!(aligner.open_interval(100 * MS), 1);
    aligner.finish(&mut sink).unwrap();
    assert_eq!(sink.times_ms()[0], [25, 35, 45, 55]);
    assert_eq!(sink.times_ms()[1][0], 100);
    assert_eq!(sink.episodes[0].0, EpisodeStart { interval: 0, part: 0, start_ns: 25 * MS });
    assert_eq!(sink.episodes[1].0.interval, 1);
}

#[test]
fn reference_ticks_are_the_samples_of_a_stream() {
    let mut rule = rule(vec![stream(15), StreamRule { tolerance_ns: None, ..stream(0) }], 1.0);
    rule.ticks = Ticks::Reference { stream: 0 };
    let samples =
        [steps(1, 5.0, 300.0, 5.0), vec![(0, 3.0, 0.0), (0, 7.0, 1.0), (0, 19.0, 2.0), (0, 90.0, 3.0)]];
    let got = aligned(rule, &samples.concat());
    assert_eq!(got.times_ms(), vec![vec![7, 19], vec![90]]);
    assert_eq!(got.values(), [[1.0, 5.0], [2.0, 15.0], [3.0, 90.0]]);
}

fn interpolating(kind: Kind, width: usize) -> AlignRule {
    let parts = vec![PartKind { kind, width }];
    rule(vec![StreamRule { width, parts, method: Method::Interpolate, ..stream(50) }], 100.0)
}

#[test]
fn angles_go_the_short_way() {
    let rule = interpolating(Kind::Angle { wrap: Wrap::Pi }, 1);
    let got = aligned(rule, &[(0, 0.0, 3.0), (0, 20.0, -3.0)]);
    let middle = got.values()[1][0];
    assert!((middle.abs() - std::f64::consts::PI).abs() < 1e-12, "{middle}");
    let rule = interpolating(Kind::Angle { wrap: Wrap::None }, 1);
    let got = aligned(rule, &[(0, 0.0, 3.0), (0, 20.0, -3.0)]);
    assert_eq!(got.values()[1][0], 0.0);
}

#[test]
fn rotations_are_slerped_whatever_their_sign() {
    let kind = Kind::Quaternion { order: QuaternionOrder::Xyzw };
    let half = |angle: f64, sign: f64| [0.0, 0.0, (angle / 2.0).sin() * sign, (angle / 2.0).cos() * sign];
    for sign in [1.0, -1.0] {
        let mut aligner: Aligner<i64> = Aligner::new(interpolating(kind, 4));
        aligner.open_interval(i64::MIN);
        aligner.push_values(0, at(0.0, 0), &half(0.2, 1.0)).unwrap();
        aligner.push_values(0, at(20.0, 1), &half(1.0, sign)).unwrap();
        let mut sink = Collected::default();
        aligner.finish(&mut sink).unwrap();
        let got = &sink.values()[1];
        for (got, expected) in got.iter().zip(half(0.6, 1.0)) {
            assert!((got - expected).abs() < 1e-12, "{got} {expected}");
        }
    }
}

#[test]
fn late_samples_are_refused_and_early_rows_are_not_held_back() {
    let mut aligner = Aligner::new(rule(vec![stream(15)], 100.0));
    let mut sink = Collected::default();
    aligner.open_interval(i64::MIN);
    push_all(&mut aligner, &steps(0, 0.0, 100.0, 10.0));
    aligner.advance(60 * MS, &mut sink).unwrap();
    let emitted = sink.open.as_ref().unwrap().1.len();
    assert_eq!(emitted, 5, "rows 0..=40 are final; row 50 waits for the next");
    let late = aligner.push_values(0, at(55.0, 99), &[1.0]).unwrap_err();
    assert_eq!(late, Late { key_ns: 55 * MS, complete_ns: 60 * MS });
}

/// A random log: streams with jitter, disorder and pauses.
fn random_log() -> impl Strategy<Value = Vec<(usize, f64, f64)>> {
    prop::collection::vec((0_usize..3, 0_u32..2_000_000), 1..200).prop_map(|samples| {
        let mut samples: Vec<(usize, f64)> =
            samples.into_iter().map(|(s, us)| (s, f64::from(us) / 1e3)).collect();
        samples.sort_by(|a, b| a.1.total_cmp(&b.1));
        samples.into_iter().map(|(stream, ms)| (stream, ms, ms)).collect()
    })
}

fn random_rule() -> AlignRule {
    let action = StreamRule { timing: Some(ActionTiming::Next), gap: GapAction::Mask, ..stream(100) };
    rule(vec![stream(100), StreamRule { tolerance_ns: None, ..stream(0) }, action], 37.0)
}

proptest! {
    #![proptest_config(ProptestConfig { rng_seed: proptest::test_runner::RngSeed::Fixed(7), ..ProptestConfig::default() })]

    /// Every value is the time of its sample in ms, so that a row shows which samples it used.
    #[test]
    fn no_row_uses_a_later_sample(samples in random_log()) {
        let got = aligned(random_rule(), &samples);
        for (_, rows, _) in &got.episodes {
            for (k, row) in rows.iter().enumerate() {
                let tick = row.time_ns as f64 / MS as f64;
                let newest = |stream: usize| {
                    samples.iter().rfind(|s| s.0 == stream && (s.1 * MS as f64) as i64 <= row.time_ns).map(|s| s.2)
                };
                for stream in 0..2 {
                    prop_assert!(row.values[stream] <= tick + 1e-5);
                    prop_assert_eq!(Some(row.values[stream]), newest(stream));
                }
                prop_assert!(tick - row.values[0] <= 100.0 + 1e-6);
                if row.valid[2] {
                    let end = rows[k + 1].time_ns as f64 / MS as f64;
                    prop_assert!(row.values[2] > tick - 1e-6 && row.values[2] <= end + 1e-6);
                }
                if k > 0 {
                    let step = (row.time_ns - rows[0].time_ns) as f64 / 1e9 * 37.0;
                    prop_assert!((step - k as f64).abs() < 1e-6, "time is not squeezed");
                }
            }
            prop_assert!(rows.last().is_none_or(|row| !row.valid[2]));
        }
    }

    /// Advancing in steps, and disorder within what is not complete yet, change nothing.
    #[test]
    fn reading_in_pieces_changes_nothing(samples in random_log(), window in 0.0_f64..300.0) {
        let whole = aligned(random_rule(), &samples);
        let mut shuffled: Vec<(f64, (usize, f64, f64), u64)> = samples.iter().enumerate()
            .map(|(k, &s)| (s.1 + window * ((k * 7919 % 101) as f64 / 101.0), s, k as u64)).collect();
        shuffled.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut aligner = Aligner::new(random_rule());
        let mut sink = Collected::default();
        aligner.open_interval(i64::MIN);
        for (arrival, (stream, ms, value), ordinal) in shuffled {
            aligner.push_values(stream, at(ms, ordinal), &[value]).unwrap();
            aligner.advance(((arrival - window) * MS as f64) as i64 - 1, &mut sink).unwrap();
        }
        aligner.finish(&mut sink).unwrap();
        prop_assert_eq!(format!("{:?}", whole.episodes), format!("{:?}", sink.episodes));
    }
}
