//! Continuous encodings: what a state or action looks like to a model, before statistics.
//!
//! States: an angle becomes (sin, cos), a rotation the first two columns of its matrix, everything else stays as it is.
//! Actions are only ever per-dimension affine: a rotation becomes a rotation vector, everything else stays as it is.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::{Dim, Feature, FeatureData, Kind, Part, QuaternionOrder, Role, Schema, Unit, Wrap, rotation};

/// How one part is encoded.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Encoding {
    /// Each value as it is.
    Identity,
    /// Each angle as (sin, cos).
    SinCos,
    /// Each rotation as the first two columns of its matrix, column after column.
    Rotation6d,
    /// Each rotation as axis times angle in rad, of length at most pi.
    RotationVector,
}

/// One dimension of `gawm.state` or `gawm.action`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct EncodedDim {
    /// Unique name within the column.
    pub name: String,
    /// Unit of the value; `1` for sines, cosines and matrix entries.
    pub unit: Unit,
    /// The encoding it is a component of.
    pub encoding: Encoding,
    /// Whether standardisation applies; false for sines, cosines, matrix entries and truth values.
    pub is_standardised: bool,
    /// The feature it comes from.
    pub feature: String,
    /// The raw dims of that feature it is computed from.
    pub raw_dims: Vec<String>,
}

/// Why a row has no continuous encoding.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum EncodeError {
    /// A quaternion has no direction.
    #[error("quaternion at dim {dim:?} has norm {norm:e}, expected about 1")]
    ZeroQuaternion {
        /// First dim of the quaternion.
        dim: String,
        /// Its norm.
        norm: f64,
    },
    /// A 3x3 matrix is singular or mirrors.
    #[error("matrix at dim {dim:?} has determinant {determinant:e}, expected about 1")]
    NotARotation {
        /// First dim of the matrix.
        dim: String,
        /// Its determinant.
        determinant: f64,
    },
}

/// Encodes the rows of all features of one role into one continuous column, and decodes them.
#[derive(Debug, Clone, PartialEq)]
pub struct Encoder {
    parts: Vec<EncodedPart>,
    dims: Vec<EncodedDim>,
    /// Index in the schema and raw width of each feature, in order.
    features: Vec<(usize, usize)>,
}

#[derive(Debug, Clone, PartialEq)]
struct EncodedPart {
    kind: Kind,
    encoding: Encoding,
    /// Position of the part's first value in the concatenated raw row.
    start: usize,
    /// Number of elements (a quaternion is one).
    count: usize,
    /// Name of each element's first dim, for errors.
    names: Vec<String>,
}

impl Encoding {
    /// Returns the encoding of a kind in states.
    pub fn of_state(kind: Kind) -> Encoding {
        match kind {
            Kind::Linear | Kind::Gripper | Kind::Bool | Kind::Direction => Encoding::Identity,
            Kind::Angle { .. } => Encoding::SinCos,
            Kind::Quaternion { .. } | Kind::Rotvec | Kind::Euler { .. } | Kind::Matrix => {
                Encoding::Rotation6d
            }
        }
    }

    /// Returns the encoding of a kind in actions.
    pub fn of_action(kind: Kind) -> Encoding {
        match kind {
            Kind::Linear | Kind::Gripper | Kind::Bool | Kind::Direction | Kind::Angle { .. } => {
                Encoding::Identity
            }
            Kind::Quaternion { .. } | Kind::Rotvec | Kind::Euler { .. } | Kind::Matrix => {
                Encoding::RotationVector
            }
        }
    }

    /// Returns the number of encoded values per element.
    pub fn width(self) -> usize {
        match self {
            Encoding::Identity => 1,
            Encoding::SinCos => 2,
            Encoding::RotationVector => 3,
            Encoding::Rotation6d => 6,
        }
    }
}

impl Encoder {
    /// Builds the encoder of all vector features of `role` ([`Role::State`] or [`Role::Action`]), in schema order.
    ///
    /// Returns `None` when the schema has no such feature. Roles other than action are encoded as states.
    pub fn new(schema: &Schema, role: Role) -> Option<Encoder> {
        let features: Vec<(usize, &Feature)> =
            schema.features.iter().enumerate().filter(|(_, f)| f.role == role && f.width() > 0).collect();
        let mut encoder = Encoder { parts: Vec::new(), dims: Vec::new(), features: Vec::new() };
        let mut start = 0;
        for (index, feature) in &features {
            let FeatureData::Vector { parts, .. } = &feature.data else { continue };
            encoder.features.push((*index, feature.width()));
            for part in parts {
                let encoding = match role {
                    Role::Action => Encoding::of_action(part.kind),
                    _ => Encoding::of_state(part.kind),
                };
                encoder.push_part(feature, part, encoding, start, features.len() > 1);
                start += part.dims.len();
            }
        }
        (!encoder.dims.is_empty()).then_some(encoder)
    }

    /// Returns the encoded dims in order.
    pub fn dims(&self) -> &[EncodedDim] {
        &self.dims
    }

    /// Returns the number of encoded values per row.
    pub fn width(&self) -> usize {
        self.dims.len()
    }

    /// Returns the number of raw values per row, all features one after the other.
    pub fn raw_width(&self) -> usize {
        self.features.iter().map(|(_, width)| width).sum()
    }

    /// Returns the positions in the schema of the features that are encoded, in order.
    pub fn feature_indices(&self) -> impl ExactSizeIterator<Item = usize> + '_ {
        self.features.iter().map(|(index, _)| *index)
    }

    /// Encodes one row: `raw` holds the features' values one after the other; appends `width()` values to `out`.
    ///
    /// An element with a NaN in it becomes NaN in all its components.
    ///
    /// # Errors
    /// - a quaternion's norm is below [`rotation::MIN_NORM`];
    /// - a matrix is not right-handed with independent columns.
    ///
    /// `out` then has the length it had.
    ///
    /// # Panics
    /// If `raw` does not hold `raw_width()` values.
    pub fn encode(&self, raw: &[f64], out: &mut Vec<f64>) -> Result<(), EncodeError> {
        assert_eq!(raw.len(), self.raw_width(), "raw row of the wrong width");
        let length = out.len();
        for part in &self.parts {
            let result = part.encode(raw, out);
            if result.is_err() {
                out.truncate(length);
                return result;
            }
        }
        Ok(())
    }

    /// Decodes one row: the inverse of [`Encoder::encode`] up to a quaternion's sign, a winding number and gimbal lock.
    ///
    /// Angles come back in the interval they were declared to be wrapped to, (-pi, pi] when not wrapped. Encoded values
    /// need not be consistent (a model's output is not): sines and cosines are taken by direction, 6-D rotations are
    /// orthonormalised. What has no direction becomes NaN.
    ///
    /// # Panics
    /// If `encoded` does not hold `width()` values.
    pub fn decode(&self, encoded: &[f64], out: &mut Vec<f64>) {
        assert_eq!(encoded.len(), self.width(), "encoded row of the wrong width");
        let mut position = 0;
        for part in &self.parts {
            let width = part.encoding.width();
            for _ in 0..part.count {
                part.decode(&encoded[position..position + width], out);
                position += width;
            }
        }
    }

    fn push_part(&mut self, feature: &Feature, part: &Part, encoding: Encoding, start: usize, prefix: bool) {
        let raw_width = part.kind.raw_width();
        let mut names = Vec::new();
        for element in part.dims.chunks(raw_width) {
            names.push(element[0].name.clone());
            let base = self.unique_base(&element_name(element), &element[0].name, feature, encoding, prefix);
            for suffix in suffixes(encoding) {
                self.dims.push(EncodedDim {
                    name: format!("{base}{suffix}"),
                    unit: match encoding {
                        Encoding::Identity => element[0].unit.clone(),
                        Encoding::RotationVector => Unit("rad".to_owned()),
                        Encoding::SinCos | Encoding::Rotation6d => Unit("1".to_owned()),
                    },
                    encoding,
                    is_standardised: !matches!(part.kind, Kind::Bool | Kind::Direction)
                        && matches!(encoding, Encoding::Identity | Encoding::RotationVector),
                    feature: feature.name.clone(),
                    raw_dims: element.iter().map(|dim| dim.name.clone()).collect(),
                });
            }
        }
        self.parts.push(EncodedPart { kind: part.kind, encoding, start, count: names.len(), names });
    }

    /// Returns the element's common name if that makes new dim names, else the (unique) name of its first dim.
    fn unique_base(
        &self,
        common: &str,
        first: &str,
        feature: &Feature,
        encoding: Encoding,
        prefix: bool,
    ) -> String {
        let full = |name: &str| if prefix { format!("{}:{name}", feature.name) } else { name.to_owned() };
        let taken = |base: &str| {
            suffixes(encoding)
                .iter()
                .any(|suffix| self.dims.iter().any(|dim| dim.name == format!("{base}{suffix}")))
        };
        let common = full(common);
        if taken(&common) { full(first) } else { common }
    }
}

fn suffixes(encoding: Encoding) -> &'static [&'static str] {
    match encoding {
        Encoding::Identity => &[""],
        Encoding::SinCos => &[".sin", ".cos"],
        Encoding::RotationVector => &[".rx", ".ry", ".rz"],
        Encoding::Rotation6d => &[".r00", ".r10", ".r20", ".r01", ".r11", ".r21"],
    }
}

/// Returns what the names of an element's dims begin with, without trailing separators; the first name if nothing.
fn element_name(dims: &[Dim]) -> String {
    let first = &dims[0].name;
    if dims.len() == 1 {
        return first.clone();
    }
    let mut length = first.len();
    for dim in &dims[1..] {
        let same = first.bytes().zip(dim.name.bytes()).take_while(|(a, b)| a == b).count();
        length = length.min(same);
    }
    while !first.is_char_boundary(length) {
        length -= 1;
    }
    let common = first[..length].trim_end_matches(|c: char| !c.is_alphanumeric());
    if common.is_empty() { first.clone() } else { common.to_owned() }
}

impl EncodedPart {
    fn encode(&self, raw: &[f64], out: &mut Vec<f64>) -> Result<(), EncodeError> {
        let width = self.kind.raw_width();
        for (i, name) in self.names.iter().enumerate() {
            let element = &raw[self.start + i * width..self.start + (i + 1) * width];
            if element.iter().any(|v| v.is_nan()) {
                out.extend(std::iter::repeat_n(f64::NAN, self.encoding.width()));
                continue;
            }
            match self.encoding {
                Encoding::Identity => out.push(element[0]),
                Encoding::SinCos => {
                    let (sin, cos) = element[0].sin_cos();
                    out.extend([sin, cos]);
                }
                Encoding::Rotation6d => {
                    out.extend(rotation::six_from_matrix(&self.matrix(element, name)?));
                }
                Encoding::RotationVector => {
                    let matrix = self.matrix(element, name)?;
                    let quaternion = match self.kind {
                        Kind::Quaternion { order } => quaternion(order, element, name)?,
                        _ => rotation::quaternion_from_matrix(&matrix),
                    };
                    out.extend(rotation::rotvec_from_quaternion(quaternion));
                }
            }
        }
        Ok(())
    }

    fn matrix(&self, v: &[f64], name: &str) -> Result<rotation::Matrix, EncodeError> {
        match self.kind {
            Kind::Quaternion { order } => Ok(rotation::matrix_from_quaternion(quaternion(order, v, name)?)),
            Kind::Rotvec => {
                Ok(rotation::matrix_from_quaternion(rotation::quaternion_from_rotvec([v[0], v[1], v[2]])))
            }
            Kind::Euler { sequence } => Ok(rotation::matrix_from_euler(sequence, [v[0], v[1], v[2]])),
            Kind::Matrix => {
                let matrix: rotation::Matrix = std::array::from_fn(|i| v[i]);
                let determinant = rotation::determinant(&matrix);
                let refused = || EncodeError::NotARotation { dim: name.to_owned(), determinant };
                if determinant.is_nan() || determinant < rotation::MIN_NORM {
                    return Err(refused());
                }
                rotation::matrix_from_six(rotation::six_from_matrix(&matrix)).ok_or_else(refused)
            }
            Kind::Linear | Kind::Gripper | Kind::Bool | Kind::Direction | Kind::Angle { .. } => {
                unreachable!("kinds of width 1 are never encoded as rotations")
            }
        }
    }

    fn decode(&self, v: &[f64], out: &mut Vec<f64>) {
        let matrix = match self.encoding {
            Encoding::Identity => return out.push(v[0]),
            Encoding::SinCos => return out.push(decode_angle(self.kind, v[0], v[1])),
            Encoding::Rotation6d => rotation::matrix_from_six([v[0], v[1], v[2], v[3], v[4], v[5]]),
            Encoding::RotationVector => v.iter().all(|x| x.is_finite()).then(|| {
                rotation::matrix_from_quaternion(rotation::quaternion_from_rotvec([v[0], v[1], v[2]]))
            }),
        };
        let Some(matrix) = matrix else {
            return out.extend(std::iter::repeat_n(f64::NAN, self.kind.raw_width()));
        };
        match self.kind {
            Kind::Quaternion { order } => {
                let [x, y, z, w] = rotation::quaternion_from_matrix(&matrix);
                out.extend(match order {
                    QuaternionOrder::Xyzw => [x, y, z, w],
                    QuaternionOrder::Wxyz => [w, x, y, z],
                });
            }
            Kind::Euler { sequence } => out.extend(rotation::euler_from_matrix(sequence, &matrix)),
            Kind::Matrix => out.extend(matrix),
            _ => out.extend(rotation::rotvec_from_quaternion(rotation::quaternion_from_matrix(&matrix))),
        }
    }
}

fn quaternion(order: QuaternionOrder, v: &[f64], name: &str) -> Result<[f64; 4], EncodeError> {
    let q = match order {
        QuaternionOrder::Xyzw => [v[0], v[1], v[2], v[3]],
        QuaternionOrder::Wxyz => [v[1], v[2], v[3], v[0]],
    };
    rotation::normalise(q).ok_or_else(|| EncodeError::ZeroQuaternion {
        dim: name.to_owned(),
        norm: q.iter().map(|x| x * x).sum::<f64>().sqrt(),
    })
}

fn decode_angle(kind: Kind, sin: f64, cos: f64) -> f64 {
    if sin == 0.0 && cos == 0.0 {
        return f64::NAN;
    }
    let angle = sin.atan2(cos);
    let pi = std::f64::consts::PI;
    match kind {
        Kind::Angle { wrap: Wrap::TwoPi } if angle < 0.0 => {
            let turned = angle + 2.0 * pi;
            // -1e-17 + 2 pi rounds to 2 pi, which is outside of [0, 2 pi).
            if turned >= 2.0 * pi { 0.0 } else { turned }
        }
        Kind::Angle { wrap: Wrap::Pi } if angle >= pi => -pi,
        _ => angle,
    }
}

#[cfg(test)]
mod tests;
