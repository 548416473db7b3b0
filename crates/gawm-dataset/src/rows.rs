//! Rows of an episode in memory, before they are checked.

use bytes::Bytes;

/// A run of consecutive rows of one episode, column by column; [`Trajectory::try_new`](crate::Trajectory::try_new)
/// says what must hold.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Rows {
    /// Time of each row in nanoseconds, strictly increasing.
    pub time_ns: Vec<i64>,
    /// One column per vector feature, in the order of [`Schema::vectors`](gawm_schema::Schema::vectors).
    pub vectors: Vec<VectorColumn>,
    /// One column per image feature, in the order of [`Schema::images`](gawm_schema::Schema::images).
    pub images: Vec<ImageColumn>,
    /// How old the samples behind each row are.
    pub ages: AgeColumns,
}

/// The values of one vector feature.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct VectorColumn {
    /// Raw values in SI units, row-major, shape [n, width].
    pub values: Vec<f64>,
    /// Per row: whether the values were measured (or commanded) and not missing.
    pub valid: Vec<bool>,
}

/// The frames of one camera.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct ImageColumn {
    /// Per row the bytes of a JPEG, PNG or TIFF file, ready to write. Cheap to clone; may share one allocation.
    pub frames: Vec<Bytes>,
    /// Per row: whether the frame belongs to this row; a held frame does not.
    pub valid: Vec<bool>,
}

/// Sample ages, row-major, shape [n, n_streams] in the order of [`Schema::streams`](gawm_schema::Schema).
#[derive(Debug, Clone, Default, PartialEq)]
pub struct AgeColumns {
    /// Age in ms by the clock that rows are aligned by; NaN when the stream has no sample yet.
    pub age_ms: Vec<f32>,
    /// Age in ms by arrival (log time); NaN when the stream has no sample yet.
    pub arrival_age_ms: Vec<f32>,
}
