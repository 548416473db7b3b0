//! Collection: an expert acts, and what happens is written as MCAP logs.
//!
//! A log is what a recorder on a robot would leave: ROS 2 messages of standard types in CDR (the most common encoding in
//! the field, decodable without any schema of our own), one header stamp per row, markers and metadata for episodes.
//! Every log depends on the seed and on the numbers of its episodes alone, so any number of jobs gives the same bytes.

mod cdr;
mod episode;
mod image;
mod log_file;

pub use episode::Episode;
pub use image::ImageFormat;
pub use log_file::{
    ACTION_TOPIC, EPISODE_METADATA, FIRST_ROW_NS, GOAL_TOPIC, IMAGE_TOPIC, MARKER_TOPIC, SESSION_METADATA,
    STATE_TOPIC,
};

use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use gawm_image::ImageError;
use rayon::prelude::*;
use thiserror::Error;

use crate::two_room::{ConfigError, ExpertConfig, TwoRoomConfig};

/// What is collected.
#[derive(Clone, Debug, PartialEq)]
pub struct CollectOptions {
    /// The environment.
    pub room: TwoRoomConfig,
    /// Who acts.
    pub expert: ExpertConfig,
    /// Number of episodes.
    pub episodes: u64,
    /// Seed of all of them.
    pub seed: u64,
    /// Longest episode, in steps.
    pub max_steps: u32,
    /// Episodes in a log; the last one may have fewer.
    pub episodes_per_file: u64,
    /// Logs that are written at the same time.
    pub jobs: usize,
    /// How frames are stored.
    pub image: ImageFormat,
    /// Side of the stored frames in pixels; `None` for the renderer's own 224.
    pub image_size: Option<u32>,
}

impl Default for CollectOptions {
    fn default() -> Self {
        CollectOptions {
            room: TwoRoomConfig::default(),
            expert: ExpertConfig::default(),
            episodes: 100,
            seed: 0,
            max_steps: 100,
            episodes_per_file: 50,
            jobs: 1,
            image: ImageFormat::Png,
            image_size: None,
        }
    }
}

/// What was collected.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct CollectSummary {
    /// The logs, in the order of their episodes.
    pub logs: Vec<PathBuf>,
    /// Number of episodes.
    pub episodes: u64,
    /// Episodes whose target was reached.
    pub successes: u64,
    /// Rows of all episodes.
    pub rows: u64,
    /// Bytes of all logs.
    pub bytes: u64,
}

/// Why nothing, or not everything, was collected.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CollectError {
    /// The output folder holds something.
    #[error("output folder is not empty: expected a new or empty folder, found {found:?} in {}", dir.display())]
    NotEmpty {
        /// The folder.
        dir: PathBuf,
        /// The first thing in it, in the order of names.
        found: String,
    },
    /// A count is zero.
    #[error("{option} is not usable: expected at least 1, got 0")]
    Zero {
        /// Field of [`CollectOptions`].
        option: &'static str,
    },
    /// The simulated time of the last episode does not fit a time stamp.
    #[error(
        "too much for one collection: expected at most {most} episodes of {max_steps} steps, got {episodes}"
    )]
    TooMany {
        /// How many were asked for.
        episodes: u64,
        /// Longest episode, in steps.
        max_steps: u32,
        /// How many fit.
        most: u64,
    },
    /// The environment's configuration is not usable.
    #[error("configuration of the environment is not usable")]
    Config(#[from] ConfigError),
    /// A file or folder could not be used.
    #[error("failed to {action} {}", path.display())]
    Io {
        /// What was tried.
        action: &'static str,
        /// The file or folder.
        path: PathBuf,
        /// Why it failed.
        source: std::io::Error,
    },
    /// A log could not be written.
    #[error("failed to write log {}", path.display())]
    Mcap {
        /// The log.
        path: PathBuf,
        /// Why it failed.
        source: mcap::McapError,
    },
    /// A frame could not be encoded.
    #[error("failed to encode a frame")]
    Encode {
        /// Why.
        source: ImageError,
    },
    /// The user wanted to stop.
    #[error("interrupted")]
    Interrupted,
    /// The configuration could not be written into the log.
    #[error("failed to describe the environment in the log")]
    Describe {
        /// Why it failed.
        source: serde_json::Error,
    },
    /// The threads could not be started.
    #[error("failed to start {jobs} jobs")]
    Jobs {
        /// How many were asked for.
        jobs: usize,
        /// Why it failed.
        source: rayon::ThreadPoolBuildError,
    },
}

/// Collects into `dir`, which is made where it does not exist, and calls `progress` with the episodes of each log done.
///
/// # Errors
/// - [`CollectError::NotEmpty`] when `dir` holds anything.
/// - [`CollectError::Zero`] when a count is 0; [`CollectError::TooMany`] when time stamps would overflow; [`CollectError::Config`] when the environment's values are out of range.
/// - [`CollectError::Io`], [`CollectError::Mcap`] when a log cannot be written (such as on a full disk): logs that are
///   complete stay, an incomplete one ends in `.partial`.
pub fn collect(
    dir: &Path,
    options: &CollectOptions,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<CollectSummary, CollectError> {
    collect_until(dir, options, progress, &AtomicBool::new(false))
}

/// Collects as [`collect`] does, until `interrupt` is set: then logs that are complete stay, the others are removed.
///
/// # Errors
/// As [`collect`], and [`CollectError::Interrupted`].
pub fn collect_until(
    dir: &Path,
    options: &CollectOptions,
    progress: &(dyn Fn(u64) + Sync),
    interrupt: &AtomicBool,
) -> Result<CollectSummary, CollectError> {
    check(options)?;
    prepare(dir)?;
    let n_logs = options.episodes.div_ceil(options.episodes_per_file);
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.jobs)
        .build()
        .map_err(|source| CollectError::Jobs { jobs: options.jobs, source })?;
    let written = pool.install(|| {
        (0..n_logs)
            .into_par_iter()
            .map(|log| {
                let first = log * options.episodes_per_file;
                let end = (first + options.episodes_per_file).min(options.episodes);
                let path = dir.join(format!("two-room-{first:06}.mcap"));
                let counts = log_file::write_log(&path, first..end, options, interrupt)?;
                progress(counts.episodes);
                Ok((path, counts))
            })
            .collect::<Result<Vec<_>, CollectError>>()
    })?;
    let mut summary = CollectSummary::default();
    for (path, counts) in written {
        summary.logs.push(path);
        summary.episodes += counts.episodes;
        summary.successes += counts.successes;
        summary.rows += counts.rows;
        summary.bytes += counts.bytes;
    }
    Ok(summary)
}

fn check(options: &CollectOptions) -> Result<(), CollectError> {
    options.room.check()?;
    let counts = [
        ("episodes", options.episodes),
        ("max_steps", options.max_steps.into()),
        ("episodes_per_file", options.episodes_per_file),
        ("jobs", options.jobs as u64),
        ("image_size", options.image_size.map_or(1, u64::from)),
    ];
    if let Some((option, _)) = counts.into_iter().find(|(_, count)| *count == 0) {
        return Err(CollectError::Zero { option });
    }
    let most = log_file::most_episodes(options.max_steps);
    if options.episodes > most {
        return Err(CollectError::TooMany { episodes: options.episodes, max_steps: options.max_steps, most });
    }
    Ok(())
}

/// Makes the folder, or checks that it is empty.
fn prepare(dir: &Path) -> Result<(), CollectError> {
    let io = |action, source| CollectError::Io { action, path: dir.to_owned(), source };
    std::fs::create_dir_all(dir).map_err(|e| io("create folder", e))?;
    let mut names = Vec::new();
    for entry in std::fs::read_dir(dir).map_err(|e| io("list", e))? {
        names.push(entry.map_err(|e| io("list", e))?.file_name().to_string_lossy().into_owned());
    }
    match names.into_iter().min() {
        Some(found) => Err(CollectError::NotEmpty { dir: dir.to_owned(), found }),
        None => Ok(()),
    }
}
