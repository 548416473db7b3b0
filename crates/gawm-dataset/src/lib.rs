//! Trajectories on disk: the LeRobot v3 layout in Arrow and Parquet, statistics, validation, reports.
#![forbid(unsafe_code)]

mod image_header;
mod rows;
mod spec;
mod trajectory;

pub use image_header::{ImageFormat, ImageHeader, ImageHeaderError, image_header};
pub use rows::{AgeColumns, ImageColumn, Rows, VectorColumn};
pub use spec::{
    DatasetSpec, DatasetSummary, EpisodeInfo, RecordingInfo, RecordingState, SourceFile, WriteMode,
};
pub use trajectory::{Trajectory, TrajectoryError};
