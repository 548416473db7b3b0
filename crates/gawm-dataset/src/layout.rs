//! Names of the files and columns of a dataset.

use std::path::{Path, PathBuf};

/// Version of the format that `docs/formats/dataset.md` describes.
pub const FORMAT_VERSION: u32 = 1;

/// Continuous encoding of all state features.
pub const STATE: &str = "gawm.state";
/// Continuous encoding of all action features.
pub const ACTION: &str = "gawm.action";
/// Time of the row in ns.
pub const TIME_NS: &str = "gawm.time_ns";
/// Sample ages by the clock of alignment.
pub const AGE_MS: &str = "gawm.age_ms";
/// Sample ages by arrival.
pub const ARRIVAL_AGE_MS: &str = "gawm.arrival_age_ms";
/// Prefix of the validity column of a feature.
pub const VALID: &str = "gawm.valid.";

/// LeRobot's description of the dataset, written last.
pub const INFO: &str = "meta/info.json";
/// LeRobot's statistics.
pub const STATS: &str = "meta/stats.json";
/// LeRobot's task table.
pub const TASKS: &str = "meta/tasks.parquet";
/// LeRobot's episode table.
pub const EPISODES: &str = "meta/episodes/chunk-000/file-000.parquet";
/// Schema, contract, provenance, encodings, standardisation.
pub const GAWM: &str = "meta/gawm.json";
/// Histograms, circular statistics, camera histograms.
pub const STATISTICS: &str = "meta/gawm-statistics.json";
/// What edits the dataset went through, the last one last; absent when there was none.
pub const EDITS: &str = "meta/gawm-edits.json";
/// Folder of files taken over from the logs.
pub const ATTACHMENTS: &str = "meta/attachments";
/// Folder of camera calibrations.
pub const CALIBRATION: &str = "meta/calibration";
/// Folder of standardised columns; can be made again.
pub const ENCODED: &str = "gawm/encoded";
/// Folder of an unfinished run.
pub const JOURNAL: &str = "gawm/journal";

/// Data files per chunk folder.
pub const FILES_PER_CHUNK: u64 = 1000;

/// Returns chunk and file index of the n-th data file.
pub fn file_position(number: u64) -> (u64, u64) {
    (number / FILES_PER_CHUNK, number % FILES_PER_CHUNK)
}

/// Returns the relative path of the n-th data file.
pub fn data_path(number: u64) -> PathBuf {
    numbered("data", number)
}

/// Returns the relative path of the standardised columns of the n-th data file.
pub fn encoded_path(number: u64) -> PathBuf {
    numbered(ENCODED, number)
}

fn numbered(folder: &str, number: u64) -> PathBuf {
    let (chunk, file) = file_position(number);
    Path::new(folder).join(format!("chunk-{chunk:03}")).join(format!("file-{file:03}.parquet"))
}
