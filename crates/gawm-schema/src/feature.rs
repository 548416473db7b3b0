//! Features of a dataset and their dimensions.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::{Kind, Unit};

/// Everything that is fixed for all episodes of a dataset.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Schema {
    /// Kind of robot, if known.
    pub robot_type: Option<String>,
    /// Nominal ticks per second.
    pub rate_hz: f64,
    /// The features in column order.
    pub features: Vec<Feature>,
    /// The streams whose sample ages are recorded per row, in column order.
    pub streams: Vec<StreamInfo>,
}

/// One recorded stream, as far as rows need to know it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct StreamInfo {
    /// Unique name.
    pub name: String,
    /// Topic or dataset path in the source.
    pub source: String,
    /// What its column is for, where a row may use samples of after its tick: an action acts until the next one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub role: Option<Role>,
}

/// One column of the dataset that carries robot data.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Feature {
    /// Column name, such as `observation.state`, `action` or `observation.images.wrist`.
    pub name: String,
    /// What the feature is for.
    pub role: Role,
    /// What it holds.
    pub data: FeatureData,
}

/// What a feature is for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[non_exhaustive]
pub enum Role {
    /// Measured physical state.
    State,
    /// What acts between this row and the next.
    Action,
    /// A camera image.
    Image,
    /// Any other observation: carried along, not a target.
    Observation,
    /// A per-frame annotation such as an intervention flag.
    Annotation,
}

/// What a feature holds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "type", rename_all = "kebab-case")]
pub enum FeatureData {
    /// A vector of numbers; its width is the number of dims in all parts.
    Vector {
        /// How values are stored.
        dtype: FloatType,
        /// Runs of dims of one kind each, in order.
        parts: Vec<Part>,
    },
    /// Encoded images of one size.
    Image(ImageSpec),
}

/// How the values of a vector feature are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "lowercase")]
pub enum FloatType {
    /// 32-bit, the default of LeRobot.
    #[default]
    Float32,
    /// 64-bit, lossless for what most logs hold.
    Float64,
}

/// The size of a camera's images in the dataset.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
pub struct ImageSpec {
    /// Rows of pixels.
    pub height: u32,
    /// Columns of pixels.
    pub width: u32,
    /// Channels: 3 for colour, 1 for grey and depth.
    pub channels: u32,
    /// Whether pixels are distances and not colours.
    #[serde(default)]
    pub depth: bool,
}

/// A run of dims that share a kind.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Part {
    /// What the numbers are geometrically.
    #[serde(flatten)]
    pub kind: Kind,
    /// The coordinate frame the values are expressed in, where that matters.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub frame: Option<String>,
    /// The dims; their number is a multiple of `kind.raw_width()`.
    pub dims: Vec<Dim>,
}

/// One dimension of a vector feature.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, JsonSchema)]
pub struct Dim {
    /// Name, unique within its feature.
    pub name: String,
    /// Unit of the stored value (SI).
    pub unit: Unit,
    /// Where it comes from: `topic:path`.
    pub source: String,
    /// Physical limits in `unit`, if known.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub limits: Option<[f64; 2]>,
}

impl Feature {
    /// Returns the number of values per row of a vector feature, 0 for images.
    pub fn width(&self) -> usize {
        match &self.data {
            FeatureData::Vector { parts, .. } => parts.iter().map(|part| part.dims.len()).sum(),
            FeatureData::Image(_) => 0,
        }
    }
}
