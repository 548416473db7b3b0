//! The `metadata.yaml` of a rosbag2 folder.

use std::path::{Component, Path, PathBuf};

use serde::Deserialize;

use super::error::OpenLogError;

/// Name of the file in a rosbag2 folder.
pub(crate) const METADATA_FILE: &str = "metadata.yaml";
/// Largest metadata file that is read.
const METADATA_MAX_BYTES: u64 = 64 << 20;

/// What `metadata.yaml` says about a recording.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Rosbag2Metadata {
    /// Storage plugin: `mcap` or `sqlite3`.
    pub storage_identifier: String,
    /// Parts in order, relative to the folder.
    pub relative_file_paths: Vec<String>,
    /// Messages in all parts, as the recorder counted them.
    pub message_count: Option<u64>,
    /// Compression of files or messages, such as `zstd`; empty when there is none.
    pub compression_format: String,
    /// `FILE`, `MESSAGE`, `STORAGE`, or empty; `MESSAGE` means that message bodies are compressed.
    pub compression_mode: String,
}

impl Rosbag2Metadata {
    /// Returns whether message bodies are compressed one by one.
    pub fn has_compressed_messages(&self) -> bool {
        self.compression_mode.eq_ignore_ascii_case("message")
    }

    /// Reads the metadata file of a folder; `None` when there is none.
    ///
    /// # Errors
    /// [`OpenLogError::BadRosbag2Metadata`] when it cannot be read or parsed, or names no part.
    pub fn read(folder: &Path) -> Result<Option<Self>, OpenLogError> {
        let path = folder.join(METADATA_FILE);
        let bad = |reason: String| OpenLogError::BadRosbag2Metadata { path: path.clone(), reason };
        let Ok(about) = std::fs::metadata(&path) else { return Ok(None) };
        if !about.is_file() || about.len() > METADATA_MAX_BYTES {
            return Err(bad(format!(
                "expected a file of at most {METADATA_MAX_BYTES} bytes, got {}",
                about.len()
            )));
        }
        let text = std::fs::read_to_string(&path).map_err(|error| bad(error.to_string()))?;
        let document: Document = serde_yaml_ng::from_str(&text).map_err(|error| bad(error.to_string()))?;
        let info = document.rosbag2_bagfile_information;
        if info.relative_file_paths.is_empty() {
            return Err(bad("expected at least one entry in relative_file_paths, got none".to_owned()));
        }
        Ok(Some(Self {
            storage_identifier: info.storage_identifier.unwrap_or_default(),
            relative_file_paths: info.relative_file_paths,
            message_count: info.message_count,
            compression_format: info.compression_format.unwrap_or_default(),
            compression_mode: info.compression_mode.unwrap_or_default(),
        }))
    }

    /// Returns the parts as paths in the folder; a path that leads out of it, or is not there, is an error.
    pub(crate) fn parts(&self, folder: &Path) -> Result<Vec<PathBuf>, OpenLogError> {
        let part = |relative: &String| {
            // Old recorders wrote the folder's own name before the file's.
            let whole = Path::new(relative);
            let is_inside = whole.components().all(|part| matches!(part, Component::Normal(_)));
            let candidates =
                [is_inside.then(|| folder.join(whole)), whole.file_name().map(|name| folder.join(name))];
            let missing =
                || OpenLogError::MissingPart { path: folder.join(METADATA_FILE), part: relative.clone() };
            candidates.into_iter().flatten().find(|path| path.is_file()).ok_or_else(missing)
        };
        self.relative_file_paths.iter().map(part).collect()
    }
}

#[derive(Deserialize)]
struct Document {
    rosbag2_bagfile_information: Information,
}

#[derive(Deserialize)]
struct Information {
    storage_identifier: Option<String>,
    #[serde(default)]
    relative_file_paths: Vec<String>,
    message_count: Option<u64>,
    compression_format: Option<String>,
    compression_mode: Option<String>,
}
