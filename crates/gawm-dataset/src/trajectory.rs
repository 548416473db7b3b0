//! The data contract: the only way into a dataset.

use gawm_image::{FileFormat, ImageError, ImageHeader, read_header};
use gawm_schema::{EncodeError, Encoder, Feature, FeatureData, ImageSpec, Kind, Role, Schema};
use thiserror::Error;

use crate::{AgeColumns, ImageColumn, Rows, VectorColumn};

/// Rows of one episode that keep the data contract of a schema. Not empty.
#[derive(Debug, Clone, PartialEq)]
pub struct Trajectory {
    rows: Rows,
}

/// Why rows are refused.
#[derive(Debug, Clone, PartialEq, Error)]
#[non_exhaustive]
pub enum TrajectoryError {
    /// There is no row.
    #[error("trajectory has no row, expected at least one")]
    Empty,
    /// The number of columns differs from the schema.
    #[error("trajectory has {got} {what} columns, expected {expected} as in the schema")]
    Columns {
        /// `vector` or `image`.
        what: &'static str,
        /// Columns of the schema.
        expected: usize,
        /// Columns of the rows.
        got: usize,
    },
    /// A column has another length than the rows need.
    #[error("{what} of {feature:?} have length {got}, expected {expected}")]
    Length {
        /// The feature or age column.
        feature: String,
        /// `values`, `validity flags` or `frames`.
        what: &'static str,
        /// Rows times width.
        expected: usize,
        /// What there is.
        got: usize,
    },
    /// Time does not increase.
    #[error("time does not increase at row {row}: expected more than {previous_ns} ns, got {time_ns} ns")]
    Time {
        /// The later row.
        row: usize,
        /// Time of the row before.
        previous_ns: i64,
        /// Time of the row.
        time_ns: i64,
    },
    /// A valid row holds NaN or infinity.
    #[error("{feature:?} is {value} in dim {dim:?} at row {row}, expected a finite number in a valid row")]
    NotFinite {
        /// The feature.
        feature: String,
        /// The dim.
        dim: String,
        /// The row.
        row: usize,
        /// The value.
        value: f64,
    },
    /// A row that is not valid holds a number.
    #[error("{feature:?} is {value} in dim {dim:?} at row {row}, expected NaN in a row that is not valid")]
    ValueInInvalidRow {
        /// The feature.
        feature: String,
        /// The dim.
        dim: String,
        /// The row.
        row: usize,
        /// The value.
        value: f64,
    },
    /// A value does not fit into 32-bit floats.
    #[error("{feature:?} is {value} in dim {dim:?} at row {row}, beyond float32; declare dtype float64")]
    BeyondFloat32 {
        /// The feature.
        feature: String,
        /// The dim.
        dim: String,
        /// The row.
        row: usize,
        /// The value.
        value: f64,
    },
    /// A truth value is neither 0 nor 1.
    #[error("{feature:?} is {value} in dim {dim:?} at row {row}, expected 0 or 1 for kind bool")]
    NotBool {
        /// The feature.
        feature: String,
        /// The dim.
        dim: String,
        /// The row.
        row: usize,
        /// The value.
        value: f64,
    },
    /// A rotation has no direction.
    #[error("{feature:?} has no rotation at row {row}: {source}")]
    Rotation {
        /// The feature.
        feature: String,
        /// The row.
        row: usize,
        /// What is wrong.
        source: EncodeError,
    },
    /// An age is infinite.
    #[error("{column:?} is infinite at row {row} for stream {stream:?}")]
    Age {
        /// `gawm.age_ms` or `gawm.arrival_age_ms`.
        column: &'static str,
        /// The stream.
        stream: String,
        /// The row.
        row: usize,
    },
    /// An image is no JPEG, PNG or TIFF.
    #[error("frame of {feature:?} at row {row} cannot be read: {source}")]
    Image {
        /// The feature.
        feature: String,
        /// The row.
        row: usize,
        /// What is wrong.
        source: ImageError,
    },
    /// An image has another size than declared.
    #[error(
        "frame of {feature:?} at row {row} is {}x{}x{}, expected {}x{}x{} (height x width x channels)",
        got.height, got.width, got.channels, expected.height, expected.width, expected.channels
    )]
    ImageSize {
        /// The feature.
        feature: String,
        /// The row.
        row: usize,
        /// The declared size.
        expected: ImageSpec,
        /// The size in the frame's header.
        got: ImageHeader,
    },
}

impl Trajectory {
    /// Checks rows against the data contract of a schema that has been [validated](Schema::validate).
    ///
    /// # Errors
    /// - no row; another number of columns than the schema has; a column of another length;
    /// - time that does not strictly increase;
    /// - a valid row of a vector feature with a NaN, an infinity, a number beyond its dtype, a truth value other than 0
    ///   and 1, or a rotation without direction (quaternion of norm about 0, singular or mirroring matrix);
    /// - a row that is not valid with anything but NaN; rows of actions may instead hold a whole row of numbers: the
    ///   last row of an episode repeats the last command (the writer refuses it elsewhere);
    /// - an infinite age (NaN says that there was no sample yet);
    /// - a frame, valid or held, that is no JPEG, PNG or TIFF, or of another size or channel count than declared.
    pub fn try_new(schema: &Schema, rows: Rows) -> Result<Trajectory, TrajectoryError> {
        let n_rows = rows.time_ns.len();
        if n_rows == 0 {
            return Err(TrajectoryError::Empty);
        }
        check_time(&rows.time_ns)?;
        check_columns("vector", schema.vectors().count(), rows.vectors.len())?;
        check_columns("image", schema.images().count(), rows.images.len())?;
        for (feature, column) in schema.vectors().zip(&rows.vectors) {
            check_vector(feature, column, n_rows)?;
        }
        for role in [Role::State, Role::Action] {
            if let Some(encoder) = Encoder::new(schema, role) {
                check_rotations(schema, &encoder, &rows)?;
            }
        }
        for ((feature, spec), column) in schema.images().zip(&rows.images) {
            check_images(&feature.name, spec, column, n_rows)?;
        }
        check_ages(schema, &rows.ages, n_rows)?;
        Ok(Trajectory { rows })
    }

    /// Returns the number of rows.
    #[expect(clippy::len_without_is_empty, reason = "a trajectory is never empty")]
    pub fn len(&self) -> usize {
        self.rows.time_ns.len()
    }

    /// Returns the rows.
    pub fn rows(&self) -> &Rows {
        &self.rows
    }

    /// Returns the rows, giving up the guarantee.
    pub fn into_rows(self) -> Rows {
        self.rows
    }
}

fn check_time(time_ns: &[i64]) -> Result<(), TrajectoryError> {
    match time_ns.windows(2).position(|pair| pair[1] <= pair[0]) {
        Some(row) => {
            Err(TrajectoryError::Time { row: row + 1, previous_ns: time_ns[row], time_ns: time_ns[row + 1] })
        }
        None => Ok(()),
    }
}

fn check_columns(what: &'static str, expected: usize, got: usize) -> Result<(), TrajectoryError> {
    if expected == got { Ok(()) } else { Err(TrajectoryError::Columns { what, expected, got }) }
}

fn check_length(
    feature: &str,
    what: &'static str,
    expected: usize,
    got: usize,
) -> Result<(), TrajectoryError> {
    if expected == got {
        Ok(())
    } else {
        Err(TrajectoryError::Length { feature: feature.to_owned(), what, expected, got })
    }
}

/// What may stand in a dim, beside being finite.
#[derive(Clone, Copy)]
struct DimRule {
    is_bool: bool,
    is_float32: bool,
}

fn check_vector(feature: &Feature, column: &VectorColumn, n_rows: usize) -> Result<(), TrajectoryError> {
    let FeatureData::Vector { dtype, parts } = &feature.data else { return Ok(()) };
    let width = feature.width();
    check_length(&feature.name, "values", n_rows.saturating_mul(width), column.values.len())?;
    check_length(&feature.name, "validity flags", n_rows, column.valid.len())?;
    let is_float32 = *dtype == gawm_schema::FloatType::Float32;
    let rules: Vec<DimRule> = parts
        .iter()
        .flat_map(|part| part.dims.iter().map(|_| DimRule { is_bool: part.kind == Kind::Bool, is_float32 }))
        .collect();
    for (row, (values, &valid)) in column.values.chunks_exact(width).zip(&column.valid).enumerate() {
        let refused = if valid {
            values.iter().zip(&rules).position(|(&value, &rule)| !is_allowed(value, rule))
        } else {
            let is_held = feature.role == Role::Action && values.iter().all(|v| v.is_finite());
            if is_held { None } else { values.iter().position(|v| !v.is_nan()) }
        };
        if let Some(dim) = refused {
            return Err(value_error(feature, dim, row, values[dim], valid));
        }
    }
    Ok(())
}

fn is_allowed(value: f64, rule: DimRule) -> bool {
    value.is_finite()
        && (!rule.is_float32 || (value as f32).is_finite())
        && (!rule.is_bool || value == 0.0 || value == 1.0)
}

fn value_error(feature: &Feature, dim: usize, row: usize, value: f64, valid: bool) -> TrajectoryError {
    let FeatureData::Vector { parts, .. } = &feature.data else { return TrajectoryError::Empty };
    let name =
        parts.iter().flat_map(|part| &part.dims).nth(dim).map(|dim| dim.name.clone()).unwrap_or_default();
    let feature = feature.name.clone();
    if !valid {
        TrajectoryError::ValueInInvalidRow { feature, dim: name, row, value }
    } else if !value.is_finite() {
        TrajectoryError::NotFinite { feature, dim: name, row, value }
    } else if !(value as f32).is_finite() {
        TrajectoryError::BeyondFloat32 { feature, dim: name, row, value }
    } else {
        TrajectoryError::NotBool { feature, dim: name, row, value }
    }
}

fn check_rotations(schema: &Schema, encoder: &Encoder, rows: &Rows) -> Result<(), TrajectoryError> {
    let has_rotation = encoder.dims().iter().any(|dim| dim.raw_dims.len() > 1);
    if !has_rotation {
        return Ok(());
    }
    let columns = vector_positions(schema, encoder);
    let (mut raw, mut encoded) = (Vec::new(), Vec::new());
    for row in 0..rows.time_ns.len() {
        raw.clear();
        encoded.clear();
        for &(column, width) in &columns {
            raw.extend_from_slice(&rows.vectors[column].values[row * width..(row + 1) * width]);
        }
        encoder.encode(&raw, &mut encoded).map_err(|source| TrajectoryError::Rotation {
            feature: rotation_feature(encoder, &source),
            row,
            source,
        })?;
    }
    Ok(())
}

/// Returns position among the vector features and raw width of each feature that an encoder reads.
pub(crate) fn vector_positions(schema: &Schema, encoder: &Encoder) -> Vec<(usize, usize)> {
    let vector_of: Vec<usize> = schema
        .features
        .iter()
        .scan(0, |next, feature| {
            let position = *next;
            *next += usize::from(feature.width() > 0);
            Some(position)
        })
        .collect();
    encoder.feature_indices().map(|index| (vector_of[index], schema.features[index].width())).collect()
}

fn rotation_feature(encoder: &Encoder, error: &EncodeError) -> String {
    let name = match error {
        EncodeError::ZeroQuaternion { dim, .. } | EncodeError::NotARotation { dim, .. } => dim,
        _ => return String::new(),
    };
    let found = encoder.dims().iter().find(|dim| dim.raw_dims.first() == Some(name));
    found.map(|dim| dim.feature.clone()).unwrap_or_default()
}

fn check_images(
    feature: &str,
    spec: &ImageSpec,
    column: &ImageColumn,
    n_rows: usize,
) -> Result<(), TrajectoryError> {
    check_length(feature, "frames", n_rows, column.frames.len())?;
    check_length(feature, "validity flags", n_rows, column.valid.len())?;
    for (row, frame) in column.frames.iter().enumerate() {
        let got = read_header(frame).map_err(|source| TrajectoryError::Image {
            feature: feature.to_owned(),
            row,
            source,
        })?;
        let is_wrong_format = got.format == FileFormat::Tiff && !spec.depth;
        if is_wrong_format
            || (got.height, got.width, u32::from(got.channels)) != (spec.height, spec.width, spec.channels)
        {
            return Err(TrajectoryError::ImageSize {
                feature: feature.to_owned(),
                row,
                expected: spec.clone(),
                got,
            });
        }
    }
    Ok(())
}

fn check_ages(schema: &Schema, ages: &AgeColumns, n_rows: usize) -> Result<(), TrajectoryError> {
    let n_streams = schema.streams.len();
    for (column, values) in [("gawm.age_ms", &ages.age_ms), ("gawm.arrival_age_ms", &ages.arrival_age_ms)] {
        check_length(column, "values", n_rows.saturating_mul(n_streams), values.len())?;
        if let Some(position) = values.iter().position(|v| v.is_infinite()) {
            return Err(TrajectoryError::Age {
                column,
                stream: schema.streams[position % n_streams].name.clone(),
                row: position / n_streams,
            });
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests;
