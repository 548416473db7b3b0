//! Kinds of values and their units: what a number means geometrically.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The kind of a [`Part`](crate::Part): what its numbers are geometrically, hence how they are encoded continuously.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Kind {
    /// A Euclidean quantity; kept as it is.
    Linear,
    /// Angles, one per dim; encoded as (sin, cos).
    Angle {
        /// The interval the recorded values are wrapped to.
        wrap: Wrap,
    },
    /// A unit quaternion (4 dims); encoded as 6-D rotation.
    Quaternion {
        /// The order of the four components.
        order: QuaternionOrder,
    },
    /// A rotation vector, axis times angle in rad (3 dims); encoded as 6-D rotation in states, kept in actions.
    Rotvec,
    /// Euler angles in rad (3 dims); encoded as 6-D rotation.
    Euler {
        /// The axes and their order.
        sequence: EulerSequence,
    },
    /// A 3x3 rotation matrix, row-major (9 dims); encoded as 6-D rotation.
    Matrix,
    /// A gripper opening or command; kept as it is.
    Gripper,
    /// Truth values stored as 0 and 1; kept as they are and never standardised.
    Bool,
    /// Components of a unit vector as recorded, such as cosine and sine of a yaw; kept as they are and never standardised.
    Direction,
}

/// The interval that recorded angles are wrapped to.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
pub enum Wrap {
    /// Not wrapped: the angle counts turns, or the joint has limits.
    None,
    /// Wrapped to [-pi, pi).
    Pi,
    /// Wrapped to [0, 2 pi).
    TwoPi,
}

/// The order of a quaternion's components in the source.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum QuaternionOrder {
    /// x, y, z, w (ROS, SciPy).
    Xyzw,
    /// w, x, y, z (MuJoCo, Eigen's constructor).
    Wxyz,
}

/// Axes of three Euler angles; lower case is extrinsic (fixed axes), upper case intrinsic (moving axes), as in SciPy.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[non_exhaustive]
pub enum EulerSequence {
    /// Extrinsic x, y, z: roll, pitch, yaw about fixed axes (URDF, ROS).
    #[serde(rename = "xyz")]
    ExtrinsicXyz,
    /// Extrinsic z, y, x.
    #[serde(rename = "zyx")]
    ExtrinsicZyx,
    /// Intrinsic x, y, z.
    #[serde(rename = "XYZ")]
    IntrinsicXyz,
    /// Intrinsic z, y, x: yaw, pitch, roll about moving axes.
    #[serde(rename = "ZYX")]
    IntrinsicZyx,
}

/// The unit of a value in the dataset, after conversion to SI.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(transparent)]
pub struct Unit(pub String);

impl Kind {
    /// Returns how many dims one element of this kind has in the raw data (1, 3, 4 or 9).
    pub fn raw_width(self) -> usize {
        match self {
            Kind::Linear | Kind::Angle { .. } | Kind::Gripper | Kind::Bool | Kind::Direction => 1,
            Kind::Rotvec | Kind::Euler { .. } => 3,
            Kind::Quaternion { .. } => 4,
            Kind::Matrix => 9,
        }
    }
}
