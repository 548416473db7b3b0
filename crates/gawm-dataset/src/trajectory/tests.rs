use bytes::Bytes;

use super::*;
use crate::writer::tests::{png, rows, schema};

/// Checks that ten good rows after a change are refused as expected.
#[track_caller]
fn check_refused(change: impl Fn(&mut Rows), expected: impl Fn(&TrajectoryError) -> bool) {
    let mut rows = rows(3, 0..10, 20);
    change(&mut rows);
    let error = Trajectory::try_new(&schema(), rows).unwrap_err();
    assert!(expected(&error), "{error:?}");
}

fn set(rows: &mut Rows, vector: usize, position: usize, value: f64) {
    rows.vectors[vector].values[position] = value;
}

#[test]
fn good_rows_pass() {
    let all = rows(3, 0..20, 20);
    let trajectory = Trajectory::try_new(&schema(), all.clone()).unwrap();
    assert_eq!((trajectory.len(), trajectory.rows()), (20, &all));
    assert_eq!(trajectory.into_rows(), all);
}

#[test]
fn shapes_must_be_those_of_the_schema() {
    check_refused(|r| *r = Rows::default(), |e| *e == TrajectoryError::Empty);
    check_refused(
        |r| drop(r.vectors.pop()),
        |e| *e == TrajectoryError::Columns { what: "vector", expected: 3, got: 2 },
    );
    check_refused(
        |r| drop(r.images.pop()),
        |e| *e == TrajectoryError::Columns { what: "image", expected: 1, got: 0 },
    );
    let length = |wrong_feature: &'static str, expected_length: usize| move |e: &TrajectoryError| matches!(e, TrajectoryError::Length { feature, expected, .. } if feature == wrong_feature && *expected == expected_length);
    check_refused(|r| r.vectors[0].values.truncate(69), length("observation.state", 70));
    check_refused(|r| r.vectors[1].valid.push(true), length("action", 10));
    check_refused(|r| drop(r.images[0].frames.pop()), length("observation.images.front", 10));
    check_refused(|r| r.images[0].valid.truncate(9), length("observation.images.front", 10));
    check_refused(|r| r.ages.age_ms.truncate(19), length("gawm.age_ms", 20));
    check_refused(|r| r.ages.arrival_age_ms.clear(), length("gawm.arrival_age_ms", 20));
}

#[test]
fn time_must_increase() {
    for wrong in [0, -5] {
        check_refused(
            |r| r.time_ns[4] = r.time_ns[3] + wrong,
            |e| matches!(e, TrajectoryError::Time { row: 4, .. }),
        );
    }
}

#[test]
fn valid_values_must_be_usable() {
    let is_at = |e: &TrajectoryError, name: &str| matches!(e, TrajectoryError::NotFinite { dim, row: 2, .. } if dim == name);
    check_refused(|r| set(r, 0, 16, f64::NAN), |e| is_at(e, "gripper"));
    check_refused(|r| set(r, 1, 5, f64::INFINITY), |e| is_at(e, "v2"));
    check_refused(
        |r| set(r, 0, 0, 1e39),
        |e| matches!(e, TrajectoryError::BeyondFloat32 { dim, row: 0, .. } if dim == "j1"),
    );
    check_refused(|r| set(r, 2, 7, 0.5), |e| matches!(e, TrajectoryError::NotBool { row: 7, .. }));
    check_refused(
        |r| (3..7).for_each(|i| set(r, 0, 7 + i, 0.0)),
        |e| matches!(e, TrajectoryError::Rotation { feature, row: 1, .. } if feature == "observation.state"),
    );
    let mut wide = rows(3, 0..10, 20);
    set(&mut wide, 1, 0, 1e39); // the action is float64
    Trajectory::try_new(&schema(), wide).unwrap();
}

#[test]
fn missing_values_must_be_nan() {
    check_refused(
        |r| r.vectors[0].valid[6] = false,
        |e| matches!(e, TrajectoryError::ValueInInvalidRow { row: 6, .. }),
    );
    check_refused(
        |r| {
            r.vectors[1].valid[6] = false;
            set(r, 1, 12, f64::NAN); // half of a held action
        },
        |e| matches!(e, TrajectoryError::ValueInInvalidRow { dim, row: 6, .. } if dim == "v2"),
    );
    let mut masked = rows(3, 0..10, 20);
    masked.vectors[0].valid[6] = false;
    (42..49).for_each(|i| set(&mut masked, 0, i, f64::NAN));
    masked.vectors[1].valid[9] = false; // a held action
    masked.images[0].valid[0] = false; // a held frame
    masked.ages.age_ms[0] = f32::NAN; // no sample yet
    Trajectory::try_new(&schema(), masked).unwrap();
    check_refused(
        |r| r.ages.age_ms[3] = f32::INFINITY,
        |e| matches!(e, TrajectoryError::Age { row: 1, stream, .. } if stream == "front"),
    );
}

#[test]
fn frames_must_have_the_declared_size() {
    check_refused(
        |r| r.images[0].frames[5] = Bytes::new(),
        |e| matches!(e, TrajectoryError::Image { row: 5, .. }),
    );
    check_refused(
        |r| {
            let mut bytes = png(1).to_vec();
            bytes[19] = 7; // width
            r.images[0].frames[5] = bytes.into();
        },
        |e| matches!(e, TrajectoryError::ImageSize { row: 5, got, .. } if got.width == 7),
    );
}
