//! What a loader says before its first batch.

use serde::{Deserialize, Serialize};

use super::{BatchError, BatchLayout, BatchShape, Sequence, SequenceError};
use crate::{ContentHash, Unit};

/// Version of the hello message.
pub const HELLO_VERSION: u32 = 1;

/// Everything that a trainer must know about the data; equal for all loaders of a run.
///
/// It is kept in the run folder as `hello.json`: evaluation reads from there what the model was trained on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Hello {
    /// [`HELLO_VERSION`].
    pub format_version: u32,
    /// The datasets of the mix, in the order of their numbers in clip ids.
    pub datasets: Vec<DatasetInfo>,
    /// Hash over schema hashes of all datasets.
    pub schema_hash: ContentHash,
    /// Shape of a full batch.
    pub shape: BatchShape,
    /// Hash of the layout of that shape.
    pub layout_hash: ContentHash,
    /// The order of batches.
    pub sequence: Sequence,
    /// Number of ranks that share each step.
    pub ranks: u32,
    /// Seed of the order of clips.
    pub seed: u64,
    /// `reference` (as published) or `repaired`.
    pub compat: String,
    /// Rows between two frames of a clip, and actions in a chunk.
    pub frameskip: usize,
    /// Frames of a clip that are given; the others are predicted.
    pub history: usize,
    /// Rows that a clip takes.
    pub span: usize,
    /// Rows per second.
    pub rate_hz: f64,
    /// Cameras in the order of the axis V.
    pub cameras: Vec<String>,
    /// Dims of the encoded state, in the order of the axis S.
    pub state: EncodedFeature,
    /// Dims of the encoded action of one row; the axis A holds them `frameskip` times, step by step.
    pub action: EncodedFeature,
    /// Training clips.
    pub train: ClipCounts,
    /// Held-out clips.
    pub validation: ClipCounts,
    /// Numbers of the training data that only a reader of all rows can know.
    pub baselines: Baselines,
}

/// A dataset of the mix.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DatasetInfo {
    /// The folder as it was given; not part of the stream hash.
    pub path: String,
    /// Hash over the content hashes of its episodes.
    pub content_hash: ContentHash,
    /// Hash of its schema.
    pub schema_hash: ContentHash,
    /// Share of the training clips that are drawn from it; all together 1.
    pub share: f64,
    /// Its rows.
    pub rows: u64,
}

/// A continuous column, standardised.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EncodedFeature {
    /// Its dims.
    pub dims: Vec<StandardisedDimInfo>,
    /// What means and scales were fitted on: `train`, `all` or `reference`.
    pub fitted_on: String,
    /// Hash of what they were fitted on.
    pub fitted_hash: ContentHash,
}

/// One dim of a continuous column, with its frozen standardisation `(x - mean) / scale`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StandardisedDimInfo {
    /// Name of the encoded dim.
    pub name: String,
    /// Name of the feature it comes from.
    pub feature: String,
    /// Unit of the value before standardisation.
    pub unit: Unit,
    /// What is subtracted.
    pub mean: f64,
    /// What is divided by; never 0.
    pub scale: f64,
    /// Whether all training values were equal.
    pub is_constant: bool,
    /// Smallest valid value of the training rows, standardised.
    pub min: f64,
    /// Largest valid value of the training rows, standardised.
    pub max: f64,
}

/// How many clips a split has, and what was left out.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClipCounts {
    /// Episodes that clips are drawn from.
    pub episodes: u64,
    /// Clips.
    pub clips: u64,
    /// Clips left out because they touch a frame or an action that is not valid.
    pub excluded: u64,
    /// Episodes that are too short for a clip.
    pub short_episodes: u64,
}

/// Losses that need no model: what a constant prediction (the mean) would have.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Baselines {
    /// Variance of each standardised state dim over the valid training rows.
    pub state_variance: Vec<f64>,
    /// Variance of each standardised action dim of one row over the valid training rows.
    pub action_variance: Vec<f64>,
}

/// Why a hello cannot be used.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum HelloError {
    /// It is of another version.
    #[error("hello message of another version: expected {HELLO_VERSION}, got {got}")]
    Version {
        /// The version found.
        got: u32,
    },
    /// It is not JSON of this form.
    #[error("unreadable hello message: {reason}")]
    Syntax {
        /// What the parser said.
        reason: String,
    },
    /// Its shape cannot be laid out.
    #[error("hello message: {0}")]
    Shape(#[from] BatchError),
    /// Its sequence cannot be.
    #[error("hello message: {0}")]
    Sequence(#[from] SequenceError),
    /// It contradicts itself.
    #[error("hello message that contradicts itself: expected {field} {expected}, got {got}")]
    Contradiction {
        /// What.
        field: &'static str,
        /// What the other fields say.
        expected: String,
        /// What it says.
        got: String,
    },
}

impl Hello {
    /// Reads and checks a hello message.
    ///
    /// # Errors
    /// [`HelloError`] for the first thing that is wrong.
    pub fn from_json(json: &[u8]) -> Result<Hello, HelloError> {
        #[derive(Deserialize)]
        struct Version {
            format_version: u32,
        }
        let syntax = |error: serde_json::Error| HelloError::Syntax { reason: error.to_string() };
        // The version first: a later one may have fields that this one does not know.
        let Version { format_version } = serde_json::from_slice(json).map_err(syntax)?;
        if format_version != HELLO_VERSION {
            return Err(HelloError::Version { got: format_version });
        }
        let hello: Hello = serde_json::from_slice(json).map_err(syntax)?;
        hello.check()?;
        Ok(hello)
    }

    /// Returns the message as JSON.
    pub fn to_json(&self) -> String {
        serde_json::to_string_pretty(self).expect("numbers, texts and lists of them are JSON")
    }

    /// Returns the layout of its batches.
    ///
    /// # Errors
    /// [`BatchError::Shape`] if the shape cannot be laid out.
    pub fn layout(&self) -> Result<BatchLayout, BatchError> {
        BatchLayout::try_new(self.shape)
    }

    /// Returns a hash over everything that decides what the n-th batch holds: all fields but the paths of datasets.
    pub fn stream_hash(&self) -> ContentHash {
        let mut nameless = self.clone();
        nameless.datasets.iter_mut().for_each(|dataset| dataset.path.clear());
        let value = serde_json::to_value(&nameless).expect("numbers, texts and lists of them are JSON");
        ContentHash::of_json(&value)
    }

    fn check(&self) -> Result<(), HelloError> {
        let layout = self.layout()?;
        self.sequence.check()?;
        expect("layout_hash", &layout.hash(), &self.layout_hash)?;
        expect("number of cameras", &self.shape.views, &self.cameras.len())?;
        expect("number of state dims", &self.shape.state_width, &self.state.dims.len())?;
        let action_width = self.frameskip.saturating_mul(self.action.dims.len());
        expect("action width", &action_width, &self.shape.action_width)?;
        expect("number of state variances", &self.shape.state_width, &self.baselines.state_variance.len())?;
        expect("number of action variances", &self.action.dims.len(), &self.baselines.action_variance.len())?;
        if self.history == 0 || self.history >= self.shape.frames {
            let (expected, got) = (format!("1 to {}", self.shape.frames - 1), self.history.to_string());
            return Err(HelloError::Contradiction { field: "history", expected, got });
        }
        let scales = self.state.dims.iter().chain(&self.action.dims);
        if let Some(dim) =
            scales.into_iter().find(|d| !(d.scale.is_normal() && d.scale > 0.0 && d.mean.is_finite()))
        {
            let got = format!("{} with mean {} and scale {}", dim.name, dim.mean, dim.scale);
            let expected = "finite, the scale above 0".to_owned();
            return Err(HelloError::Contradiction { field: "standardisation", expected, got });
        }
        Ok(())
    }
}

fn expect<T: PartialEq + ToString>(field: &'static str, expected: &T, got: &T) -> Result<(), HelloError> {
    if expected == got {
        return Ok(());
    }
    let (expected, got) = (expected.to_string(), got.to_string());
    Err(HelloError::Contradiction { field, expected, got })
}
