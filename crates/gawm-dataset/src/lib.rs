//! Trajectories on disk: the LeRobot v3 layout in Arrow and Parquet, statistics, validation, reports.
//!
//! [`Trajectory::try_new`] checks [`Rows`] against the data contract of a [`Schema`](gawm_schema::Schema); a
//! [`DatasetWriter`] takes trajectories and leaves a folder that `lerobot` and any Parquet reader open.
//! The format is described in `docs/formats/dataset.md`.
//!
//! ```
//! use gawm_dataset::{
//!     DatasetSpec, DatasetWriter, EpisodeInfo, RecordingInfo, Rows, Trajectory, VectorColumn, WriteMode,
//! };
//!
//! let schema: gawm_schema::Schema = toml::from_str(
//!     r#"
//!     rate_hz = 10.0
//!     streams = []
//!     [[features]]
//!     name = "observation.state"
//!     role = "state"
//!     data = { type = "vector", dtype = "float32", parts = [
//!         { kind = "angle", wrap = "pi", dims = [{ name = "elbow", unit = "rad", source = "/joints:position[0]" }] },
//!     ] }
//!     "#,
//! )?;
//! let dir = tempfile::tempdir()?;
//! let spec = DatasetSpec::new(schema.clone(), "", "example 1");
//! let mut writer = DatasetWriter::create(&dir.path().join("out"), spec, WriteMode::New)?;
//! let content_hash = gawm_schema::ContentHash::of(b"the bytes of a log");
//! writer.begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: Default::default() })?;
//! writer.begin_episode(EpisodeInfo { task: "wave".to_owned(), ..EpisodeInfo::default() })?;
//! let angles = VectorColumn { values: vec![0.1, 0.2, 0.3], valid: vec![true; 3] };
//! let rows = Rows { time_ns: vec![0, 100_000_000, 200_000_000], vectors: vec![angles], ..Rows::default() };
//! writer.write(Trajectory::try_new(&schema, rows)?)?;
//! writer.end_episode()?;
//! writer.end_recording()?;
//! assert_eq!(writer.finish()?.frames, 3);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! One data file never holds rows of two recordings. So one run over N logs, N appends and a run that was killed and
//! resumed write the same bytes, and a damaged source costs no other source's files.
//!
//! **Invariant**: what is in a dataset went through `Trajectory::try_new`; `meta/info.json` exists only when all
//! other files are whole and on the disk.
#![forbid(unsafe_code)]

mod block;
mod camera;
pub mod cli;
mod columns;
pub mod csv;
mod data_file;
mod durable;
pub mod edit;
mod encoded;
mod episode;
mod error;
mod journal;
pub mod layout;
pub mod preview;
mod provenance;
pub mod read;
pub mod report;
mod rows;
mod scan;
mod spec;
mod statistics_file;
pub mod stats;
mod tables;
mod totals;
mod trajectory;
pub mod validate;
mod writer;

pub use camera::{CameraStats, is_sampled};
pub use columns::fps;
pub use encoded::standardize;
pub use error::WriteError;
pub use provenance::{AttachmentRecord, Contract, FileRecord, GawmMeta, RecordingRecord};
pub use rows::{AgeColumns, ImageColumn, Rows, VectorColumn};
pub use spec::{
    DatasetSpec, DatasetSummary, EpisodeInfo, RecordingInfo, RecordingState, SourceFile, WriteMode,
};
pub use statistics_file::{DimStatistics, StatisticsFile};
pub use trajectory::{Trajectory, TrajectoryError};
pub use writer::DatasetWriter;
