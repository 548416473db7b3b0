//! Which schemas are possible.

use std::collections::BTreeSet;

use thiserror::Error;

use crate::{ContentHash, Feature, FeatureData, Role, Schema};

/// Why a schema is refused.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum SchemaError {
    /// There is nothing to record.
    #[error("schema has no feature, expected at least one")]
    NoFeature,
    /// The rate is not a positive number.
    #[error("rate is {rate_hz} Hz, expected a finite number above 0")]
    Rate {
        /// The rate.
        rate_hz: f64,
    },
    /// A name is empty, too long, reserved or has characters that other software refuses.
    #[error("{what} name {name:?} {reason}")]
    Name {
        /// What is named: feature, dim, stream.
        what: &'static str,
        /// The name.
        name: String,
        /// What is wrong with it.
        reason: &'static str,
    },
    /// A name occurs twice.
    #[error("{what} name {name:?} occurs twice, expected unique names")]
    Duplicate {
        /// What is named: feature, dim, stream.
        what: &'static str,
        /// The name.
        name: String,
    },
    /// A vector feature has no dims.
    #[error("feature {feature:?} has no dims, expected at least one")]
    NoDims {
        /// The feature.
        feature: String,
    },
    /// A part's dims are no whole number of elements.
    #[error("part {part} of feature {feature:?} has {got} dims, expected a multiple of {raw_width}")]
    PartWidth {
        /// The feature.
        feature: String,
        /// Position of the part.
        part: usize,
        /// Values per element of its kind.
        raw_width: usize,
        /// Number of dims.
        got: usize,
    },
    /// Limits are not an interval.
    #[error(
        "limits of dim {dim:?} of feature {feature:?} are {limits:?}, expected finite [low, high] with low < high"
    )]
    Limits {
        /// The feature.
        feature: String,
        /// The dim.
        dim: String,
        /// The limits.
        limits: [f64; 2],
    },
    /// An image size is impossible.
    #[error(
        "image feature {feature:?} is {height}x{width}x{channels}, expected sides of 1 to 65535 and 1 or 3 channels"
    )]
    ImageSize {
        /// The feature.
        feature: String,
        /// Rows.
        height: u32,
        /// Columns.
        width: u32,
        /// Channels.
        channels: u32,
    },
    /// Role and data do not fit.
    #[error("feature {feature:?} has role {role:?} but holds {holds}")]
    RoleData {
        /// The feature.
        feature: String,
        /// Its role.
        role: Role,
        /// What it holds: images or numbers.
        holds: &'static str,
    },
}

/// Names of columns that every dataset has.
const RESERVED: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// Beyond this a name is no name.
const MAX_NAME_BYTES: usize = 200;

impl Schema {
    /// Checks everything that a schema must keep.
    ///
    /// # Errors
    /// - no feature, a rate that is not finite and positive;
    /// - names of features, dims of one feature, streams: empty, over 200 bytes, with control characters or not unique;
    /// - feature names with `/`, that are reserved by LeRobot (`index`, `timestamp`, ...) or begin with `gawm.`;
    /// - a vector feature without dims, or a part whose dims are no multiple of its kind's width;
    /// - limits that are not finite or not ascending;
    /// - images of side 0 or above 65535 or of other than 1 or 3 channels;
    /// - the role [`Role::Image`] on numbers, or another role on images.
    pub fn validate(&self) -> Result<(), SchemaError> {
        if !(self.rate_hz.is_finite() && self.rate_hz > 0.0) {
            return Err(SchemaError::Rate { rate_hz: self.rate_hz });
        }
        if self.features.is_empty() {
            return Err(SchemaError::NoFeature);
        }
        check_names("feature", self.features.iter().map(|f| f.name.as_str()))?;
        check_names("stream", self.streams.iter().map(|s| s.name.as_str()))?;
        self.features.iter().try_for_each(Feature::validate)
    }

    /// Returns the hash of the schema in canonical JSON.
    pub fn hash(&self) -> ContentHash {
        let value = serde_json::to_value(self)
            .expect("a schema has only string keys and finite numbers are not needed");
        ContentHash::of_json(&value)
    }

    /// Returns the position and the feature of that name.
    pub fn feature(&self, name: &str) -> Option<(usize, &Feature)> {
        self.features.iter().enumerate().find(|(_, feature)| feature.name == name)
    }

    /// Returns the vector features in order: the order in which rows carry them.
    pub fn vectors(&self) -> impl Iterator<Item = &Feature> {
        self.features.iter().filter(|feature| matches!(feature.data, FeatureData::Vector { .. }))
    }

    /// Returns the image features in order.
    pub fn images(&self) -> impl Iterator<Item = (&Feature, &crate::ImageSpec)> {
        self.features.iter().filter_map(|feature| match &feature.data {
            FeatureData::Image(spec) => Some((feature, spec)),
            FeatureData::Vector { .. } => None,
        })
    }

    /// Names the first difference to another schema, as `(place, here, there)` in JSON; `None` when they are equal.
    pub fn difference(&self, other: &Schema) -> Option<(String, String, String)> {
        let value = |schema: &Schema| serde_json::to_value(schema).unwrap_or_default();
        first_difference("schema", &value(self), &value(other))
    }
}

/// Names the first place where two JSON values differ: `(place, first, second)`.
pub fn first_difference(
    place: &str,
    a: &serde_json::Value,
    b: &serde_json::Value,
) -> Option<(String, String, String)> {
    use serde_json::Value;
    match (a, b) {
        (Value::Object(x), Value::Object(y)) => {
            let keys: BTreeSet<&String> = x.keys().chain(y.keys()).collect();
            keys.into_iter().find_map(|key| {
                let (x, y) = (x.get(key).unwrap_or(&Value::Null), y.get(key).unwrap_or(&Value::Null));
                first_difference(&format!("{place}.{key}"), x, y)
            })
        }
        (Value::Array(x), Value::Array(y)) => (0..x.len().max(y.len())).find_map(|i| {
            let (x, y) = (x.get(i).unwrap_or(&Value::Null), y.get(i).unwrap_or(&Value::Null));
            first_difference(&format!("{place}[{i}]"), x, y)
        }),
        _ if a == b => None,
        _ => Some((place.to_owned(), a.to_string(), b.to_string())),
    }
}

impl Feature {
    /// Checks one feature; see [`Schema::validate`].
    pub fn validate(&self) -> Result<(), SchemaError> {
        let name_error = |reason| SchemaError::Name { what: "feature", name: self.name.clone(), reason };
        if self.name.contains('/') {
            return Err(name_error("contains '/', which lerobot refuses; use '.'"));
        }
        if RESERVED.contains(&self.name.as_str()) {
            return Err(name_error("is the name of a column that every dataset has"));
        }
        if self.name.starts_with("gawm.") {
            return Err(name_error("begins with \"gawm.\", which is reserved"));
        }
        match &self.data {
            FeatureData::Image(spec) => {
                if self.role != Role::Image {
                    return Err(self.role_error("images"));
                }
                let side = |n: u32| (1..=65535).contains(&n);
                if !side(spec.height) || !side(spec.width) || !matches!(spec.channels, 1 | 3) {
                    return Err(SchemaError::ImageSize {
                        feature: self.name.clone(),
                        height: spec.height,
                        width: spec.width,
                        channels: spec.channels,
                    });
                }
            }
            FeatureData::Vector { parts, .. } => {
                if self.role == Role::Image {
                    return Err(self.role_error("numbers"));
                }
                self.validate_parts(parts)?;
            }
        }
        Ok(())
    }

    fn role_error(&self, holds: &'static str) -> SchemaError {
        SchemaError::RoleData { feature: self.name.clone(), role: self.role, holds }
    }

    fn validate_parts(&self, parts: &[crate::Part]) -> Result<(), SchemaError> {
        if self.width() == 0 {
            return Err(SchemaError::NoDims { feature: self.name.clone() });
        }
        check_names("dim", parts.iter().flat_map(|part| part.dims.iter().map(|dim| dim.name.as_str())))?;
        for (position, part) in parts.iter().enumerate() {
            let raw_width = part.kind.raw_width();
            if part.dims.is_empty() || !part.dims.len().is_multiple_of(raw_width) {
                return Err(SchemaError::PartWidth {
                    feature: self.name.clone(),
                    part: position,
                    raw_width,
                    got: part.dims.len(),
                });
            }
            for dim in &part.dims {
                let Some(limits) = dim.limits else { continue };
                if !(limits[0].is_finite() && limits[1].is_finite() && limits[0] < limits[1]) {
                    return Err(SchemaError::Limits {
                        feature: self.name.clone(),
                        dim: dim.name.clone(),
                        limits,
                    });
                }
            }
        }
        Ok(())
    }
}

fn check_names<'a>(what: &'static str, names: impl Iterator<Item = &'a str>) -> Result<(), SchemaError> {
    let mut seen = BTreeSet::new();
    for name in names {
        let error = |reason| Err(SchemaError::Name { what, name: name.to_owned(), reason });
        if name.is_empty() {
            return error("is empty");
        }
        if name.len() > MAX_NAME_BYTES {
            return error("is longer than 200 bytes");
        }
        if name.chars().any(char::is_control) {
            return error("contains a control character");
        }
        if !seen.insert(name) {
            return Err(SchemaError::Duplicate { what, name: name.to_owned() });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
