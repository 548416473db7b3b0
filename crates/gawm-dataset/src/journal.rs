//! What an unfinished run has done: read by a run that resumes it, removed when the dataset is finished.
//!
//! `gawm/journal/run.json` holds the specification and how much of the dataset there was before;
//! `gawm/journal/recording-NNNNNN.json` appears, whole, when a recording is done and its data files are on the disk.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize, de::DeserializeOwned};

use crate::camera::CameraStats;
use crate::durable::{Disk, remove_folder, sync_parent};
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::layout::JOURNAL;
use crate::provenance::RecordingRecord;
use crate::spec::DatasetSpec;

/// The beginning of a run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct RunRecord {
    pub(crate) format_version: u32,
    pub(crate) spec: DatasetSpec,
    pub(crate) base: Base,
}

/// How much of the dataset there was when the run began. The finishing of a run replaces the meta files, but all that
/// they held before stays at the beginning of the new ones.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct Base {
    pub(crate) recordings: usize,
    pub(crate) episodes: usize,
    pub(crate) tasks: usize,
    pub(crate) cameras: BTreeMap<String, CameraStats>,
}

/// A recording that is done.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(crate) struct DoneRecording {
    pub(crate) recording: RecordingRecord,
    pub(crate) episodes: Vec<EpisodeRecord>,
    pub(crate) cameras: BTreeMap<String, CameraStats>,
}

/// The journal of a dataset folder.
#[derive(Debug)]
pub(crate) struct Journal {
    folder: PathBuf,
    disk: Disk,
    n_done: usize,
}

impl Journal {
    /// Returns whether a folder holds an unfinished run.
    pub(crate) fn exists(dir: &Path) -> bool {
        dir.join(JOURNAL).join("run.json").exists()
    }

    /// Begins a run.
    pub(crate) fn begin(dir: &Path, disk: &Disk, run: &RunRecord) -> Result<Journal, WriteError> {
        let folder = dir.join(JOURNAL);
        remove_folder(&folder).map_err(WriteError::io("remove", &folder))?;
        fs::create_dir_all(&folder).map_err(WriteError::io("create", &folder))?;
        sync_parent(&folder).map_err(WriteError::io("sync", &folder))?;
        let journal = Journal { folder, disk: disk.clone(), n_done: 0 };
        journal.save("run.json", run)?;
        Ok(journal)
    }

    /// Opens an unfinished run: the journal, how it began, and its recordings in order.
    pub(crate) fn open(
        dir: &Path,
        disk: &Disk,
    ) -> Result<(Journal, RunRecord, Vec<DoneRecording>), WriteError> {
        let folder = dir.join(JOURNAL);
        let run: RunRecord = load(&folder.join("run.json"))?;
        let mut done = Vec::new();
        loop {
            let path = folder.join(recording_name(done.len()));
            if !path.exists() {
                break;
            }
            done.push(load(&path)?);
        }
        let journal = Journal { folder, disk: disk.clone(), n_done: done.len() };
        Ok((journal, run, done))
    }

    /// Notes that a recording is done.
    pub(crate) fn add(&mut self, done: &DoneRecording) -> Result<(), WriteError> {
        self.save(&recording_name(self.n_done), done)?;
        self.n_done += 1;
        Ok(())
    }

    /// Removes the journal: the dataset is finished.
    pub(crate) fn remove(self) -> Result<(), WriteError> {
        // Without run.json the rest is no journal, whatever happens while it is removed.
        let run = self.folder.join("run.json");
        fs::remove_file(&run).map_err(WriteError::io("remove", &run))?;
        remove_folder(&self.folder).map_err(WriteError::io("remove", &self.folder))?;
        sync_parent(&self.folder).map_err(WriteError::io("sync", &self.folder))
    }

    fn save(&self, name: &str, value: &impl Serialize) -> Result<(), WriteError> {
        let path = self.folder.join(name);
        self.disk.write_whole(&path, &to_json(&path, value)?).map_err(WriteError::io("write", &path))
    }
}

fn recording_name(number: usize) -> String {
    format!("recording-{number:06}.json")
}

/// Returns a value as indented JSON.
pub(crate) fn to_json(path: &Path, value: &impl Serialize) -> Result<Vec<u8>, WriteError> {
    let mut bytes = serde_json::to_vec_pretty(value)
        .map_err(|error| WriteError::Damaged { path: path.to_owned(), reason: error.to_string() })?;
    bytes.push(b'\n');
    Ok(bytes)
}

/// Reads a JSON file.
pub(crate) fn load<T: DeserializeOwned>(path: &Path) -> Result<T, WriteError> {
    let bytes = fs::read(path).map_err(WriteError::io("read", path))?;
    serde_json::from_slice(&bytes)
        .map_err(|error| WriteError::Damaged { path: path.to_owned(), reason: error.to_string() })
}
