//! Trajectories on disk: the LeRobot v3 layout in Arrow and Parquet, statistics, validation, reports.
#![forbid(unsafe_code)]

pub mod cli;
pub mod read;
pub mod validate;
