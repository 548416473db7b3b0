//! Values between two samples.

use gawm_schema::rotation::{
    euler_from_matrix, matrix_from_euler, matrix_from_quaternion, normalise, quaternion_from_matrix,
    quaternion_from_rotvec, rotvec_from_quaternion,
};
use gawm_schema::{Kind, QuaternionOrder, Wrap};

use super::PartKind;

const TURN: f64 = 2.0 * std::f64::consts::PI;

/// Appends the values at share `u` (0 to 1) of the way from `a` to `b`.
pub(crate) fn between(parts: &[PartKind], a: &[f64], b: &[f64], u: f64, out: &mut Vec<f64>) {
    let mut at = 0;
    for part in parts {
        let raw = part.kind.raw_width();
        for start in (at..at + part.width).step_by(raw) {
            let (a, b) = (&a[start..start + raw], &b[start..start + raw]);
            match part.kind {
                Kind::Angle { wrap } => out.push(angle_between(a[0], b[0], u, wrap)),
                kind if raw > 1 => rotation_between(kind, a, b, u, out),
                Kind::Bool => out.push(a[0]),
                _ => out.push(linear(a[0], b[0], u)),
            }
        }
        at += part.width;
    }
}

fn linear(a: f64, b: f64, u: f64) -> f64 {
    // Exact at both ends and where the samples are equal.
    if u <= 0.0 || a == b {
        a
    } else if u >= 1.0 {
        b
    } else {
        a + (b - a) * u
    }
}

fn angle_between(a: f64, b: f64, u: f64, wrap: Wrap) -> f64 {
    if u <= 0.0 || wrap == Wrap::None {
        return linear(a, b, u);
    }
    if u >= 1.0 {
        return b;
    }
    wrapped(a + short_way(a, b) * u, wrap)
}

/// Returns the signed angle from `a` to `b`, in [-pi, pi].
pub(crate) fn short_way(a: f64, b: f64) -> f64 {
    let turn = (b - a).rem_euclid(TURN);
    if turn > std::f64::consts::PI { turn - TURN } else { turn }
}

/// Returns the angle within its interval.
pub(crate) fn wrapped(angle: f64, wrap: Wrap) -> f64 {
    match wrap {
        Wrap::None => angle,
        Wrap::Pi => {
            let turned = (angle + std::f64::consts::PI).rem_euclid(TURN) - std::f64::consts::PI;
            if turned >= std::f64::consts::PI { turned - TURN } else { turned }
        }
        Wrap::TwoPi => {
            let turned = angle.rem_euclid(TURN);
            if turned >= TURN { 0.0 } else { turned }
        }
    }
}

fn rotation_between(kind: Kind, a: &[f64], b: &[f64], u: f64, out: &mut Vec<f64>) {
    if u <= 0.0 {
        return out.extend(a);
    }
    if u >= 1.0 {
        return out.extend(b);
    }
    match (quaternion(kind, a), quaternion(kind, b)) {
        (Some(qa), Some(qb)) => push_rotation(kind, slerp(qa, qb, u), out),
        // Not a rotation (a zero quaternion): the earlier sample stands.
        _ => out.extend(a),
    }
}

fn slerp(a: [f64; 4], b: [f64; 4], u: f64) -> [f64; 4] {
    let dot: f64 = a.iter().zip(b).map(|(x, y)| x * y).sum();
    let (b, dot) = if dot < 0.0 { (b.map(|x| -x), -dot) } else { (b, dot) };
    let mixed = |wa: f64, wb: f64| std::array::from_fn(|i| wa * a[i] + wb * b[i]);
    // Below this angle the sine loses digits and the chord is as good as the arc.
    let q = if dot > 1.0 - 1e-9 {
        mixed(1.0 - u, u)
    } else {
        let angle = dot.clamp(-1.0, 1.0).acos();
        mixed(((1.0 - u) * angle).sin() / angle.sin(), (u * angle).sin() / angle.sin())
    };
    normalise(q).unwrap_or(a)
}

/// Returns the unit quaternion (x, y, z, w) of a rotation of any kind.
pub(crate) fn quaternion(kind: Kind, v: &[f64]) -> Option<[f64; 4]> {
    match kind {
        Kind::Quaternion { order: QuaternionOrder::Xyzw } => normalise([v[0], v[1], v[2], v[3]]),
        Kind::Quaternion { order: QuaternionOrder::Wxyz } => normalise([v[1], v[2], v[3], v[0]]),
        Kind::Rotvec => normalise(quaternion_from_rotvec([v[0], v[1], v[2]])),
        Kind::Euler { sequence } => Some(quaternion_from_matrix(&matrix_from_euler(sequence, [v[0], v[1], v[2]]))),
        Kind::Matrix => {
            let matrix = std::array::from_fn(|i| v[i]);
            v.iter().all(|x| x.is_finite()).then(|| quaternion_from_matrix(&matrix))
        }
        _ => None,
    }
}

/// Appends a rotation in the form of a kind.
pub(crate) fn push_rotation(kind: Kind, q: [f64; 4], out: &mut Vec<f64>) {
    match kind {
        Kind::Quaternion { order: QuaternionOrder::Xyzw } => out.extend(q),
        Kind::Quaternion { order: QuaternionOrder::Wxyz } => out.extend([q[3], q[0], q[1], q[2]]),
        Kind::Euler { sequence } => out.extend(euler_from_matrix(sequence, &matrix_from_quaternion(q))),
        Kind::Matrix => out.extend(matrix_from_quaternion(q)),
        _ => out.extend(rotvec_from_quaternion(q)),
    }
}

/// Returns the product: first `b`, then `a`.
pub(crate) fn multiplied(a: [f64; 4], b: [f64; 4]) -> [f64; 4] {
    let ([ax, ay, az, aw], [bx, by, bz, bw]) = (a, b);
    [
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    ]
}

/// Returns the inverse of a unit quaternion.
pub(crate) fn inverse(q: [f64; 4]) -> [f64; 4] {
    [-q[0], -q[1], -q[2], q[3]]
}
