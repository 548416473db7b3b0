//! Trajectories on disk: the LeRobot v3 layout in Arrow and Parquet, statistics, validation, reports.
#![forbid(unsafe_code)]

mod block;
mod camera;
pub mod cli;
mod columns;
mod data_file;
mod durable;
mod encoded;
mod episode;
mod error;
mod image_header;
mod journal;
pub mod layout;
mod picture;
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
pub use image_header::{ImageFormat, ImageHeader, ImageHeaderError, image_header};
pub use provenance::{AttachmentRecord, Contract, FileRecord, GawmMeta, RecordingRecord};
pub use rows::{AgeColumns, ImageColumn, Rows, VectorColumn};
pub use spec::{
    DatasetSpec, DatasetSummary, EpisodeInfo, RecordingInfo, RecordingState, SourceFile, WriteMode,
};
pub use statistics_file::{DimStatistics, StatisticsFile};
pub use trajectory::{Trajectory, TrajectoryError};
pub use writer::DatasetWriter;
