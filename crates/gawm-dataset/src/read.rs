//! Opens dataset folders written by anyone: gawm and LeRobot v2.0, v2.1 and v3.0.
//!
//! Nothing in a folder is trusted. What is inconsistent but readable becomes a [`Defect`]; only a folder of which nothing
//! can be read is an [`OpenError`]. Paths that come from metadata never lead out of the folder, lengths are checked before
//! memory is asked for, and columns are read one unit of row groups at a time.
//!
//! A [`Run`] is a stretch of consecutive rows with one `episode_index` in one data file: in a sound dataset, an episode.

mod column;
mod declared;
mod defect;
mod episode_table;
mod files;
mod frames;
mod info;
mod mp4;
mod paths;
mod scan;

pub use declared::{check_pages, checked_builder};
pub(crate) use episode_table::episode_statistics;
pub(crate) use files::{guarded, open_parquet};
pub(crate) use info::read_json;
pub(crate) use paths::join_inside;

pub use column::{Column, ColumnValues};
pub use defect::{Defect, DefectKind};
pub use episode_table::{EpisodeEntry, VideoSpan};
pub use files::{DataFile, Run};
pub(crate) use frames::NoPicture;
pub use frames::{FrameBytes, FrameReader};
pub use info::{DType, FeatureDecl, FormatVersion, Info};
pub use mp4::{Mp4Error, VideoTrack, read_video_track};
pub use scan::{EpisodeRows, ScanError};

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicU64;

/// Why a folder cannot be used at all.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum OpenError {
    /// The folder does not exist or is not a folder.
    #[error("expected a dataset folder, got something else or nothing at {}", path.display())]
    NotAFolder {
        /// The path that was given.
        path: PathBuf,
    },
    /// `meta/info.json` cannot be read.
    #[error("cannot read meta/info.json in {}: {source}", path.display())]
    Info {
        /// The dataset folder.
        path: PathBuf,
        /// What the file system said.
        source: std::io::Error,
    },
    /// `meta/info.json` is not a usable description.
    #[error("unusable meta/info.json in {}: expected {expected}, got {got}", path.display())]
    BadInfo {
        /// The dataset folder.
        path: PathBuf,
        /// What a sound file holds.
        expected: String,
        /// What was found.
        got: String,
    },
    /// No data file could be read.
    #[error("no readable data file in {}: {reason}", path.display())]
    NoData {
        /// The dataset folder.
        path: PathBuf,
        /// What was wrong with the first of them.
        reason: String,
    },
}

/// Bounds on what is read from foreign files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ReadLimits {
    /// Largest JSON or JSON-lines file, in bytes.
    pub max_json_bytes: u64,
    /// Largest number of dims of one feature.
    pub max_width: usize,
    /// Largest number of episodes.
    pub max_episodes: u64,
    /// Largest number of rows held at once.
    pub max_unit_rows: usize,
    /// Largest size of one encoded frame, in bytes.
    pub max_frame_bytes: usize,
}

impl Default for ReadLimits {
    fn default() -> Self {
        ReadLimits {
            max_json_bytes: 256 << 20,
            max_width: 4096,
            max_episodes: 10_000_000,
            max_unit_rows: 16_000_000,
            max_frame_bytes: 256 << 20,
        }
    }
}

/// A dataset folder, opened.
#[derive(Debug)]
pub struct Dataset {
    /// The folder.
    pub root: PathBuf,
    /// What `meta/info.json` says.
    pub info: Info,
    /// The task texts, by task index.
    pub tasks: Vec<String>,
    /// The episode table, in the order it has on disk.
    pub episodes: Vec<EpisodeEntry>,
    /// The data files found, in reading order.
    pub files: Vec<DataFile>,
    /// Runs of rows with one episode index, in reading order.
    pub runs: Vec<Run>,
    /// `meta/stats.json`, if there is one that parses.
    pub stats: Option<serde_json::Value>,
    /// `meta/gawm.json`, if there is one that parses.
    pub gawm: Option<serde_json::Value>,
    /// The typed schema of a gawm dataset, if `meta/gawm.json` has one.
    pub schema: Option<gawm_schema::Schema>,
    /// All inconsistencies met while opening.
    pub defects: Vec<Defect>,
    /// The bounds in force.
    pub limits: ReadLimits,
    /// Rows that passes over the data have read so far, for those who watch.
    pub rows_read: Arc<AtomicU64>,
    last_footer: files::LastFooter,
}

impl Dataset {
    /// Opens the dataset in folder `root`.
    ///
    /// # Errors
    /// - `root` is no folder, or `meta/info.json` is missing, too large or not a usable description
    /// - not one data file has a readable Parquet footer
    pub fn open(root: &Path, limits: ReadLimits) -> Result<Dataset, OpenError> {
        if !root.is_dir() {
            return Err(OpenError::NotAFolder { path: root.to_owned() });
        }
        let mut defects = Vec::new();
        let info = info::read_info(root, &limits, &mut defects)?;
        let tasks = episode_table::read_tasks(root, &info, &limits, &mut defects);
        let episodes = episode_table::read_episodes(root, &info, &limits, &mut defects);
        let files = files::find_data_files(root, &info, &episodes, &mut defects);
        if files.is_empty() {
            let reason = defects
                .iter()
                .find(|d| {
                    matches!(
                        d.kind,
                        DefectKind::UnreadableFile | DefectKind::MissingFile | DefectKind::UnsafePath
                    )
                })
                .map_or("there are no Parquet files under data/".to_owned(), |d| {
                    format!("{}: {}", d.place, d.got)
                });
            return Err(OpenError::NoData { path: root.to_owned(), reason });
        }
        let runs = files::find_runs(&files, &info, &episodes, &limits, &mut defects);
        let stats = info::read_json(root, "meta/stats.json", &limits, &mut defects);
        let gawm = info::read_json(root, "meta/gawm.json", &limits, &mut defects);
        let schema = info::typed_schema(gawm.as_ref(), &mut defects);
        Ok(Dataset {
            root: root.to_owned(),
            info,
            tasks,
            episodes,
            files,
            runs,
            stats,
            gawm,
            schema,
            defects,
            limits,
            rows_read: Arc::default(),
            last_footer: files::LastFooter::default(),
        })
    }

    /// Returns the name of the folder, for people.
    pub fn name(&self) -> String {
        let named = self.root.canonicalize().unwrap_or_else(|_| self.root.clone());
        named.file_name().map_or_else(|| "dataset".to_owned(), |n| n.to_string_lossy().into_owned())
    }

    /// Returns the number of rows that the data files hold.
    pub fn n_rows(&self) -> u64 {
        self.files.iter().map(|f| f.n_rows).sum()
    }

    /// Returns the entry of the episode table for `episode_index`, if there is one.
    pub fn entry(&self, episode_index: i64) -> Option<&EpisodeEntry> {
        let guess = usize::try_from(episode_index).ok().and_then(|i| self.episodes.get(i));
        guess
            .filter(|e| e.episode_index == episode_index)
            .or_else(|| self.episodes.iter().find(|e| e.episode_index == episode_index))
    }

    /// Returns the path of an episode's video relative to the folder, or what is wrong with it; `None` without videos.
    pub fn video_path(&self, entry: &EpisodeEntry, camera: &str) -> Option<Result<String, String>> {
        let template = self.info.video_path.as_deref()?;
        let span = entry.videos.get(camera)?;
        let episode = u64::try_from(entry.episode_index).unwrap_or(0);
        let values = paths::TemplateValues { chunk: span.chunk, file: span.file, episode, video_key: camera };
        let path = paths::fill(template, values);
        Some(path.and_then(|path| paths::join_inside(&self.root, &path).map(|_| path)))
    }
}
