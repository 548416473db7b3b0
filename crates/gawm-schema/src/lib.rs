//! What trajectories and batches are: features, roles, units, kinds, encodings, statistics. No I/O.
//!
//! A [`Schema`] lists the [`Feature`]s of a dataset. A vector feature is a sequence of [`Part`]s; a part is a run of
//! [`Dim`]s that share a [`Kind`] (a quaternion is one part of four dims, six joint angles are one part of six dims).
//! The kind decides how raw values become continuous columns.
//!
//! **Invariant**: this crate knows neither files nor tensors.
#![forbid(unsafe_code)]

pub mod batch;
mod encoding;
mod feature;
mod hash;
mod kind;
pub mod pipeline;
pub mod rotation;
mod standardise;
mod statistics;
mod unit;
mod validate;

pub use encoding::{EncodeError, EncodedDim, Encoder, Encoding};
pub use feature::{Dim, Feature, FeatureData, FloatType, ImageSpec, Part, Role, Schema, StreamInfo};
pub use hash::{ContentHash, canonical_json};
pub use kind::{EulerSequence, Kind, QuaternionOrder, Unit, Wrap};
pub use standardise::{FittedOn, Standardisation, StandardisedDim, is_training, training_fraction};
pub use statistics::{Circular, DimStats, DimSummary, Histogram, Moments, QuantileSketch};
pub use unit::UnitConversion;
pub use validate::{SchemaError, first_difference};
