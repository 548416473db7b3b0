//! Standardisation of encoded columns and membership of the training data.

use serde::{Deserialize, Serialize};

use crate::{ContentHash, EncodedDim, Moments};

/// Per-dimension affine standardisation `(x - mean) / scale` of one encoded column.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Standardisation {
    /// The column: `gawm.state` or `gawm.action`.
    pub column: String,
    /// One entry per encoded dim.
    pub dims: Vec<StandardisedDim>,
    /// What it was fitted on.
    pub fitted_on: FittedOn,
}

/// Mean and scale of one encoded dim.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct StandardisedDim {
    /// Name of the encoded dim.
    pub name: String,
    /// What is subtracted; 0 for dims that are not standardised.
    pub mean: f64,
    /// What is divided by; 1 for dims that are not standardised or constant.
    pub scale: f64,
    /// Whether mean and scale were fitted (false for sines, cosines, 6-D rotations and truth values).
    pub is_standardised: bool,
    /// Whether all training values were equal (or there was none), so that scale is 1.
    pub is_constant: bool,
}

/// The data that a standardisation was fitted on.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct FittedOn {
    /// `train`, or `all` when no episode is training data.
    pub episodes_of: String,
    /// Number of episodes.
    pub episodes: u64,
    /// Number of rows with values.
    pub frames: u64,
    /// Hash over the content hashes of the episodes, in order.
    pub hash: ContentHash,
}

impl Standardisation {
    /// Fits means and scales (ddof 0) from the moments of each encoded dim.
    ///
    /// # Panics
    /// If `dims` and `moments` differ in length.
    pub fn fit(
        column: &str,
        dims: &[EncodedDim],
        moments: &[Moments],
        fitted_on: FittedOn,
    ) -> Standardisation {
        assert_eq!(dims.len(), moments.len(), "one set of moments per encoded dim");
        let dims = dims
            .iter()
            .zip(moments)
            .map(|(dim, moments)| {
                let is_constant = moments.is_constant();
                let (mean, scale) = match (dim.is_standardised, is_constant) {
                    (false, _) => (0.0, 1.0),
                    (true, true) => (moments.mean(), 1.0),
                    (true, false) => (moments.mean(), positive_scale(moments.std())),
                };
                StandardisedDim {
                    name: dim.name.clone(),
                    mean,
                    scale,
                    is_standardised: dim.is_standardised,
                    is_constant,
                }
            })
            .collect();
        Standardisation { column: column.to_owned(), dims, fitted_on }
    }

    /// Standardises the values of one row in place; NaN stays NaN.
    pub fn apply(&self, row: &mut [f64]) {
        for (value, dim) in row.iter_mut().zip(&self.dims) {
            *value = (*value - dim.mean) / dim.scale;
        }
    }

    /// Undoes [`Standardisation::apply`].
    pub fn invert(&self, row: &mut [f64]) {
        for (value, dim) in row.iter_mut().zip(&self.dims) {
            *value = *value * dim.scale + dim.mean;
        }
    }
}

/// A spread so small that its square vanishes in f64 is no scale.
fn positive_scale(std: f64) -> f64 {
    if std.is_normal() { std } else { 1.0 }
}

/// Returns whether a session (or an episode that is its own session) is training data.
///
/// The answer depends on nothing but its arguments: appending data never moves an episode.
pub fn is_training(session_or_episode: &str, train_share: f64) -> bool {
    training_fraction(session_or_episode) < train_share
}

/// Returns the place in [0, 1) that the hash of a session or episode gives.
pub fn training_fraction(session_or_episode: &str) -> f64 {
    let hash = ContentHash::of(session_or_episode.as_bytes()).0;
    let [a, b, c, d, e, f, g, _, ..] = hash;
    // 53 bits, so that the quotient is exact and below 1.
    let bits = u64::from_be_bytes([0, a, b, c, d, e, f, g]) >> 3;
    bits as f64 / (1u64 << 53) as f64
}

#[cfg(test)]
mod tests;
