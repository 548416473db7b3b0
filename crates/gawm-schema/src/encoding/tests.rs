use proptest::prelude::*;

use super::*;
use crate::{EulerSequence, FloatType};

fn feature(name: &str, role: Role, parts: Vec<(Kind, usize)>) -> Feature {
    let parts = parts
        .into_iter()
        .enumerate()
        .map(|(p, (kind, n))| Part {
            kind,
            frame: None,
            dims: (0..n)
                .map(|i| Dim {
                    name: format!("p{p}.d{i}"),
                    unit: Unit("u".to_owned()),
                    source: String::new(),
                    limits: None,
                })
                .collect(),
        })
        .collect();
    Feature { name: name.to_owned(), role, data: FeatureData::Vector { dtype: FloatType::Float32, parts } }
}

fn encoder(role: Role, parts: Vec<(Kind, usize)>) -> Encoder {
    let features = vec![feature("f", role, parts)];
    let schema = Schema { robot_type: None, rate_hz: 10.0, features, streams: Vec::new() };
    schema.validate().unwrap();
    Encoder::new(&schema, role).unwrap()
}

fn encode(encoder: &Encoder, raw: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    encoder.encode(raw, &mut out).unwrap();
    assert_eq!(out.len(), encoder.width());
    out
}

fn decode(encoder: &Encoder, encoded: &[f64]) -> Vec<f64> {
    let mut out = Vec::new();
    encoder.decode(encoded, &mut out);
    assert_eq!(out.len(), encoder.raw_width());
    out
}

#[track_caller]
fn check_close(got: &[f64], expected: &[f64], tolerance: f64) {
    assert_eq!(got.len(), expected.len());
    for (i, (g, e)) in got.iter().zip(expected).enumerate() {
        assert!((g - e).abs() <= tolerance * (1.0 + e.abs()), "value {i}: {got:?} != {expected:?}");
    }
}

const QUATERNION: Kind = Kind::Quaternion { order: QuaternionOrder::Xyzw };
const SEQUENCES: [EulerSequence; 4] = [
    EulerSequence::ExtrinsicXyz,
    EulerSequence::ExtrinsicZyx,
    EulerSequence::IntrinsicXyz,
    EulerSequence::IntrinsicZyx,
];

#[test]
fn names_and_flags_of_encoded_dims() {
    let parts =
        vec![(Kind::Angle { wrap: Wrap::Pi }, 1), (QUATERNION, 4), (Kind::Bool, 1), (Kind::Linear, 1)];
    let state = encoder(Role::State, parts.clone());
    let names: Vec<&str> = state.dims().iter().map(|dim| dim.name.as_str()).collect();
    assert_eq!(
        names,
        [
            "p0.d0.sin",
            "p0.d0.cos",
            "p1.d.r00",
            "p1.d.r10",
            "p1.d.r20",
            "p1.d.r01",
            "p1.d.r11",
            "p1.d.r21",
            "p2.d0",
            "p3.d0"
        ]
    );
    let standardised: Vec<&str> =
        state.dims().iter().filter(|dim| dim.is_standardised).map(|dim| dim.name.as_str()).collect();
    assert_eq!(standardised, ["p3.d0"]);
    let action = encoder(Role::Action, parts);
    let names: Vec<&str> = action.dims().iter().map(|dim| dim.name.as_str()).collect();
    assert_eq!(names, ["p0.d0", "p1.d.rx", "p1.d.ry", "p1.d.rz", "p2.d0", "p3.d0"]);
    assert_eq!(action.dims()[1].unit.0, "rad");
    assert_eq!(action.dims()[1].raw_dims.len(), 4);
}

#[test]
fn names_stay_unique_when_prefixes_are_equal() {
    let mut both = feature("f", Role::State, vec![(QUATERNION, 8)]);
    if let FeatureData::Vector { parts, .. } = &mut both.data {
        for (dim, name) in parts[0].dims.iter_mut().zip(["x", "y", "z", "w", "qx", "qy", "qz", "qw"]) {
            dim.name = format!("tool {name}");
        }
    }
    let schema = Schema { robot_type: None, rate_hz: 1.0, features: vec![both.clone()], streams: Vec::new() };
    let encoder = Encoder::new(&schema, Role::State).unwrap();
    let mut names: Vec<&str> = encoder.dims().iter().map(|dim| dim.name.as_str()).collect();
    assert_eq!((names[0], names[6]), ("tool.r00", "tool q.r00"));
    names.sort_unstable();
    names.dedup();
    assert_eq!(names.len(), 12);
    let second = Feature { name: "g".to_owned(), ..both.clone() };
    let schema = Schema { features: vec![both, second], ..schema };
    assert_eq!(Encoder::new(&schema, Role::State).unwrap().dims()[12].name, "g:tool.r00");
}

/// The columns of method.md B.5: (1-2(y2+z2), 2(xy+wz), 2(xz-wy), 2(xy-wz), 1-2(x2+z2), 2(yz+wx)).
#[test]
fn six_dims_are_the_first_two_columns_of_the_matrix() {
    let (w, x, y, z) = (0.5f64.sqrt(), 0.1, 0.3, 0.4f64.sqrt());
    let norm = (w * w + x * x + y * y + z * z).sqrt();
    let (w, x, y, z) = (w / norm, x / norm, y / norm, z / norm);
    let expected = [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y + w * z),
        2.0 * (x * z - w * y),
        2.0 * (x * y - w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z + w * x),
    ];
    let wxyz = encoder(Role::State, vec![(Kind::Quaternion { order: QuaternionOrder::Wxyz }, 4)]);
    check_close(&encode(&wxyz, &[w, x, y, z]), &expected, 1e-15);
    check_close(&encode(&encoder(Role::State, vec![(QUATERNION, 4)]), &[x, y, z, w]), &expected, 1e-15);
    let matrix = rotation::matrix_from_quaternion([x, y, z, w]);
    check_close(&encode(&encoder(Role::State, vec![(Kind::Matrix, 9)]), &matrix), &expected, 1e-12);
}

#[test]
fn euler_orders_follow_scipy() {
    // Rotation.from_euler(seq, [0.1, 0.2, 0.3]).as_matrix()[:, 0], by hand from the product of the three rotations.
    let (a, b, c) = (0.1f64, 0.2f64, 0.3f64);
    let zyx = rotation::matrix_from_euler(EulerSequence::IntrinsicZyx, [a, b, c]);
    check_close(&[zyx[0], zyx[3], zyx[6]], &[a.cos() * b.cos(), a.sin() * b.cos(), -b.sin()], 1e-15);
    let xyz = rotation::matrix_from_euler(EulerSequence::ExtrinsicXyz, [c, b, a]);
    check_close(&xyz, &zyx, 1e-15);
    let xyz = rotation::matrix_from_euler(EulerSequence::IntrinsicXyz, [a, b, c]);
    check_close(&[xyz[0], xyz[1], xyz[2]], &[b.cos() * c.cos(), -b.cos() * c.sin(), b.sin()], 1e-15);
    check_close(&rotation::matrix_from_euler(EulerSequence::ExtrinsicZyx, [c, b, a]), &xyz, 1e-15);
}

#[test]
fn gimbal_lock_keeps_the_rotation() {
    for sequence in SEQUENCES {
        for middle in [std::f64::consts::FRAC_PI_2, -std::f64::consts::FRAC_PI_2] {
            let matrix = rotation::matrix_from_euler(sequence, [0.4, middle, -0.9]);
            let angles = rotation::euler_from_matrix(sequence, &matrix);
            check_close(&rotation::matrix_from_euler(sequence, angles), &matrix, 1e-7);
        }
    }
}

#[test]
fn what_has_no_direction_is_refused() {
    let state = encoder(Role::State, vec![(Kind::Linear, 1), (QUATERNION, 4)]);
    let mut out = vec![7.0];
    let error = state.encode(&[1.0, 0.0, 0.0, 0.0, 1e-9], &mut out).unwrap_err();
    assert!(matches!(&error, EncodeError::ZeroQuaternion { dim, .. } if dim == "p1.d0"), "{error:?}");
    assert_eq!(out, [7.0]);
    let matrix = encoder(Role::State, vec![(Kind::Matrix, 9)]);
    for raw in [[0.0; 9], [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, -1.0]] {
        assert!(matches!(matrix.encode(&raw, &mut out), Err(EncodeError::NotARotation { .. })));
    }
    let decoded = decode(&state, &[1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]);
    assert!(decoded[0] == 1.0 && decoded[1..].iter().all(|v| v.is_nan()));
}

#[test]
fn missing_values_stay_missing_and_touch_nothing_else() {
    let state =
        encoder(Role::State, vec![(Kind::Angle { wrap: Wrap::None }, 2), (QUATERNION, 4), (Kind::Linear, 1)]);
    let encoded = encode(&state, &[f64::NAN, 0.5, 0.0, f64::NAN, 0.0, 1.0, 3.0]);
    let missing: Vec<bool> = encoded.iter().map(|v| v.is_nan()).collect();
    assert_eq!(missing, [true, true, false, false, true, true, true, true, true, true, false]);
    let decoded = decode(&state, &encoded);
    let missing: Vec<bool> = decoded.iter().map(|v| v.is_nan()).collect();
    assert_eq!(missing, [true, false, true, true, true, true, false]);
}

#[test]
fn angles_come_back_in_their_interval() {
    let pi = std::f64::consts::PI;
    let check = |wrap, angle: f64, expected: f64| {
        let encoder = encoder(Role::State, vec![(Kind::Angle { wrap }, 1)]);
        check_close(&decode(&encoder, &encode(&encoder, &[angle])), &[expected], 1e-12);
    };
    check(Wrap::None, 1.0 + 4.0 * pi, 1.0);
    check(Wrap::Pi, -pi, -pi);
    check(Wrap::TwoPi, -0.5, 2.0 * pi - 0.5);
    check(Wrap::TwoPi, 2.0 * pi + 0.25, 0.25);
    let two_pi = Kind::Angle { wrap: Wrap::TwoPi };
    assert_eq!(decode_angle(two_pi, -1e-20, 1.0), 0.0);
    assert_eq!(decode_angle(Kind::Angle { wrap: Wrap::Pi }, 0.0, -1.0), -pi);
    assert!(decode_angle(two_pi, 0.0, 0.0).is_nan());
}

fn direction() -> impl Strategy<Value = [f64; 4]> {
    prop::array::uniform4(-1.0f64..1.0)
        .prop_filter("a direction", |q| q.iter().map(|v| v * v).sum::<f64>() > 1e-3)
}

proptest! {
    #![proptest_config(ProptestConfig {
        cases: 200, failure_persistence: None, rng_seed: proptest::test_runner::RngSeed::Fixed(7),
        ..ProptestConfig::default()
    })]

    #[test]
    fn quaternions_come_back_up_to_sign_and_length(q in direction(), length in 0.01f64..100.0) {
        let unit = rotation::normalise(q).unwrap();
        let expected = if unit[3] < 0.0 { unit.map(|v| -v) } else { unit };
        for role in [Role::State, Role::Action] {
            let encoder = encoder(role, vec![(QUATERNION, 4)]);
            let one = encode(&encoder, &unit.map(|v| v * length));
            // q and -q are one rotation: the encoding does not jump where the sign does.
            check_close(&encode(&encoder, &unit.map(|v| -v)), &one, 1e-9);
            let back = decode(&encoder, &one);
            let dot: f64 = back.iter().zip(&expected).map(|(a, b)| a * b).sum();
            prop_assert!((dot.abs() - 1.0).abs() < 1e-9, "{back:?} {expected:?}");
        }
    }

    #[test]
    fn rotation_vectors_and_matrices_come_back(q in direction()) {
        let unit = rotation::normalise(q).unwrap();
        let rotvec = rotation::rotvec_from_quaternion(unit);
        for role in [Role::State, Role::Action] {
            let vectors = encoder(role, vec![(Kind::Rotvec, 3)]);
            let back = decode(&vectors, &encode(&vectors, &rotvec));
            let matrix = |v: &[f64]| rotation::matrix_from_quaternion(rotation::quaternion_from_rotvec([v[0], v[1], v[2]]));
            check_close(&matrix(&back), &matrix(&rotvec), 1e-9);
            let matrices = encoder(role, vec![(Kind::Matrix, 9)]);
            let raw = rotation::matrix_from_quaternion(unit);
            check_close(&decode(&matrices, &encode(&matrices, &raw)), &raw, 1e-7);
        }
    }

    #[test]
    fn euler_angles_come_back(a in -3.1f64..3.1, b in -1.5f64..1.5, c in -3.1f64..3.1) {
        for sequence in SEQUENCES {
            let encoder = encoder(Role::State, vec![(Kind::Euler { sequence }, 3)]);
            check_close(&decode(&encoder, &encode(&encoder, &[a, b, c])), &[a, b, c], 1e-9);
        }
    }

    #[test]
    fn everything_else_comes_back_as_it_is(values in prop::array::uniform4(-1e6f64..1e6)) {
        let parts = vec![(Kind::Linear, 2), (Kind::Gripper, 1), (Kind::Bool, 1)];
        for role in [Role::State, Role::Action] {
            let encoder = encoder(role, parts.clone());
            prop_assert_eq!(decode(&encoder, &encode(&encoder, &values)), values.to_vec());
        }
        let angles = encoder(Role::Action, vec![(Kind::Angle { wrap: Wrap::None }, 4)]);
        prop_assert_eq!(encode(&angles, &values), values.to_vec());
    }
}
