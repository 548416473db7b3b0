//! Conversions between representations of a rotation, in f64.
//!
//! A quaternion here is [x, y, z, w]; a matrix is row-major; `r * v` turns a vector of the body frame into the
//! reference frame.

use crate::EulerSequence;

/// Below this length a quaternion or a matrix column carries no direction.
pub const MIN_NORM: f64 = 1e-6;

/// Row-major 3x3 matrix.
pub type Matrix = [f64; 9];

/// Returns the unit quaternion of `q`, or `None` when its norm is below [`MIN_NORM`] or not finite.
pub fn normalise(q: [f64; 4]) -> Option<[f64; 4]> {
    let norm = q.iter().map(|v| v * v).sum::<f64>().sqrt();
    (norm.is_finite() && norm >= MIN_NORM).then(|| q.map(|v| v / norm))
}

/// Returns the matrix of a unit quaternion.
pub fn matrix_from_quaternion([x, y, z, w]: [f64; 4]) -> Matrix {
    [
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - w * z),
        2.0 * (x * z + w * y),
        2.0 * (x * y + w * z),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - w * x),
        2.0 * (x * z - w * y),
        2.0 * (y * z + w * x),
        1.0 - 2.0 * (x * x + y * y),
    ]
}

/// Returns the unit quaternion of a rotation matrix with w >= 0 (Shepperd's method: the largest divisor is used).
pub fn quaternion_from_matrix(m: &Matrix) -> [f64; 4] {
    let [r00, r01, r02, r10, r11, r12, r20, r21, r22] = *m;
    let trace = r00 + r11 + r22;
    let q = if trace >= r00 && trace >= r11 && trace >= r22 {
        [r21 - r12, r02 - r20, r10 - r01, 1.0 + trace]
    } else if r00 >= r11 && r00 >= r22 {
        [1.0 + r00 - r11 - r22, r01 + r10, r02 + r20, r21 - r12]
    } else if r11 >= r22 {
        [r01 + r10, 1.0 - r00 + r11 - r22, r12 + r21, r02 - r20]
    } else {
        [r02 + r20, r12 + r21, 1.0 - r00 - r11 + r22, r10 - r01]
    };
    let q = normalise(q).unwrap_or([0.0, 0.0, 0.0, 1.0]);
    if q[3] < 0.0 { q.map(|v| -v) } else { q }
}

/// Returns the unit quaternion of a rotation vector.
pub fn quaternion_from_rotvec(v: [f64; 3]) -> [f64; 4] {
    let angle = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    // sin(a/2)/a tends to 1/2; below 1e-8 the next term is beneath f64.
    let scale = if angle < 1e-8 { 0.5 } else { (angle / 2.0).sin() / angle };
    [v[0] * scale, v[1] * scale, v[2] * scale, (angle / 2.0).cos()]
}

/// Returns the rotation vector of a unit quaternion, of length at most pi.
pub fn rotvec_from_quaternion(q: [f64; 4]) -> [f64; 3] {
    let [x, y, z, w] = if q[3] < 0.0 { q.map(|v| -v) } else { q };
    let sin = (x * x + y * y + z * z).sqrt();
    let scale = if sin < 1e-12 { 2.0 } else { 2.0 * sin.atan2(w) / sin };
    [x * scale, y * scale, z * scale]
}

/// Returns the matrix of three Euler angles.
pub fn matrix_from_euler(sequence: EulerSequence, [a, b, c]: [f64; 3]) -> Matrix {
    match sequence {
        EulerSequence::IntrinsicXyz => product(&product(&about_x(a), &about_y(b)), &about_z(c)),
        EulerSequence::ExtrinsicZyx => product(&product(&about_x(c), &about_y(b)), &about_z(a)),
        EulerSequence::IntrinsicZyx => product(&product(&about_z(a), &about_y(b)), &about_x(c)),
        EulerSequence::ExtrinsicXyz => product(&product(&about_z(c), &about_y(b)), &about_x(a)),
    }
}

/// Returns three Euler angles of a rotation matrix; in gimbal lock the angle about x (z for x-y-z orders) is 0.
pub fn euler_from_matrix(sequence: EulerSequence, m: &Matrix) -> [f64; 3] {
    match sequence {
        EulerSequence::IntrinsicXyz => intrinsic_xyz(m),
        EulerSequence::ExtrinsicZyx => reversed(intrinsic_xyz(m)),
        EulerSequence::IntrinsicZyx => intrinsic_zyx(m),
        EulerSequence::ExtrinsicXyz => reversed(intrinsic_zyx(m)),
    }
}

/// Returns the first two columns of a matrix, one after the other.
pub fn six_from_matrix(m: &Matrix) -> [f64; 6] {
    [m[0], m[3], m[6], m[1], m[4], m[7]]
}

/// Returns the rotation matrix whose first two columns are nearest to the given ones (Gram-Schmidt), or `None` when
/// they are too short or parallel.
pub fn matrix_from_six(s: [f64; 6]) -> Option<Matrix> {
    let a = unit([s[0], s[1], s[2]])?;
    let dot = a[0] * s[3] + a[1] * s[4] + a[2] * s[5];
    let b = unit([s[3] - dot * a[0], s[4] - dot * a[1], s[5] - dot * a[2]])?;
    let c = cross(a, b);
    Some([a[0], b[0], c[0], a[1], b[1], c[1], a[2], b[2], c[2]])
}

/// Returns the determinant of a matrix.
pub fn determinant(m: &Matrix) -> f64 {
    m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6])
        + m[2] * (m[3] * m[7] - m[4] * m[6])
}

fn unit(v: [f64; 3]) -> Option<[f64; 3]> {
    let norm = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]).sqrt();
    (norm.is_finite() && norm >= MIN_NORM).then(|| v.map(|x| x / norm))
}

fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    std::array::from_fn(|i| {
        let (row, column) = (i / 3 * 3, i % 3);
        a[row] * b[column] + a[row + 1] * b[column + 3] + a[row + 2] * b[column + 6]
    })
}

fn about_x(a: f64) -> Matrix {
    let (sin, cos) = a.sin_cos();
    [1.0, 0.0, 0.0, 0.0, cos, -sin, 0.0, sin, cos]
}

fn about_y(a: f64) -> Matrix {
    let (sin, cos) = a.sin_cos();
    [cos, 0.0, sin, 0.0, 1.0, 0.0, -sin, 0.0, cos]
}

fn about_z(a: f64) -> Matrix {
    let (sin, cos) = a.sin_cos();
    [cos, -sin, 0.0, sin, cos, 0.0, 0.0, 0.0, 1.0]
}

/// R = Rx(a) Ry(b) Rz(c).
fn intrinsic_xyz(m: &Matrix) -> [f64; 3] {
    let b = m[2].clamp(-1.0, 1.0).asin();
    if m[2].abs() > GIMBAL {
        [m[7].atan2(m[4]), b, 0.0]
    } else {
        [(-m[5]).atan2(m[8]), b, (-m[1]).atan2(m[0])]
    }
}

/// R = Rz(a) Ry(b) Rx(c).
fn intrinsic_zyx(m: &Matrix) -> [f64; 3] {
    let b = (-m[6]).clamp(-1.0, 1.0).asin();
    if m[6].abs() > GIMBAL { [(-m[1]).atan2(m[4]), b, 0.0] } else { [m[3].atan2(m[0]), b, m[7].atan2(m[8])] }
}

/// Beyond this sine of the middle angle the outer two are not told apart.
const GIMBAL: f64 = 1.0 - 1e-12;

fn reversed([a, b, c]: [f64; 3]) -> [f64; 3] {
    [c, b, a]
}
