//! The end of a run: meta files, names of data files, info.json last.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use gawm_schema::{ContentHash, FittedOn, Standardisation};
use serde_json::{Value, json};

use super::DatasetWriter;
use crate::columns::Columns;
use crate::durable::{remove_file, sync_folder, sync_parent, temporary};
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::journal::to_json;
use crate::layout::{EPISODES, FILES_PER_CHUNK, GAWM, INFO, STATISTICS, STATS, TASKS, data_path};
use crate::spec::DatasetSummary;
use crate::statistics_file::{StatisticsFile, lerobot_stats};
use crate::tables::{episodes_table, tasks_table};
use crate::totals::Totals;

/// Fits the standardisation of the continuous columns on training episodes; on all where there is none.
pub(crate) fn fit(columns: &Columns, totals: &Totals, episodes: &[EpisodeRecord]) -> Vec<Standardisation> {
    let has_training = totals.training_rows > 0;
    let moments = if has_training { &totals.training } else { &totals.all };
    let used: Vec<_> = episodes.iter().filter(|e| !has_training || e.is_training).collect();
    let mut hasher = blake3::Hasher::new();
    used.iter().for_each(|episode| {
        hasher.update(&episode.content_hash.0);
    });
    let hash = ContentHash(*hasher.finalize().as_bytes());
    let plans = columns.encoded.iter().zip(moments);
    plans
        .map(|(plan, moments)| {
            let fitted_on = FittedOn {
                episodes_of: if has_training { "train" } else { "all" }.to_owned(),
                episodes: used.len() as u64,
                frames: moments.iter().map(|m| m.count()).max().unwrap_or(0),
                hash,
            };
            Standardisation::fit(plan.name, plan.encoder.dims(), moments, fitted_on)
        })
        .collect()
}

impl DatasetWriter {
    /// Writes the meta files under temporary names, takes info.json away, renames everything, writes info.json.
    ///
    /// Until info.json is away a dataset that is being extended is as it was; from then on until the new one is there
    /// the journal makes a resumed run do all of this again.
    pub(super) fn commit(mut self) -> Result<DatasetSummary, WriteError> {
        let standardisation = fit(&self.columns, &self.totals, &self.episodes);
        for (column, plan) in self.columns.encoded.iter().map(|plan| (plan.name, plan)) {
            self.meta.encodings.insert(column.to_owned(), plan.encoder.dims().to_vec());
        }
        self.meta.standardisation = standardisation;
        let meta_paths = self.write_meta()?;
        let info = self.dir.join(INFO);
        remove_file(&info).map_err(WriteError::io("remove", &info))?;
        sync_parent(&info).map_err(WriteError::io("sync", &info))?;
        self.rename_data()?;
        for path in &meta_paths {
            fs::rename(temporary(path), path).map_err(WriteError::io("rename", path))?;
            sync_parent(path).map_err(WriteError::io("sync", path))?;
        }
        crate::encoded::write_encoded(&self.dir, &self.disk, &self.meta)?;
        self.disk
            .write_whole(&info, &to_json(&info, &self.info_json())?)
            .map_err(WriteError::io("write", &info))?;
        let summary = self.summary();
        self.journal.remove()?;
        Ok(summary)
    }

    /// Writes all meta files but info.json under temporary names and returns their final ones.
    fn write_meta(&self) -> Result<Vec<PathBuf>, WriteError> {
        let cameras: Vec<&str> = self.columns.images.iter().map(|image| image.name.as_str()).collect();
        let stats = lerobot_stats(&self.columns, &self.totals, &self.cameras);
        let statistics = StatisticsFile::new(&self.columns, &self.totals, &self.cameras);
        let files = [
            (TASKS, tasks_table(&self.tasks)?),
            (EPISODES, episodes_table(&self.episodes, &cameras)?),
            (STATS, to_json(Path::new(STATS), &stats)?),
            (STATISTICS, to_json(Path::new(STATISTICS), &statistics)?),
            (GAWM, to_json(Path::new(GAWM), &self.meta)?),
        ];
        let mut paths = Vec::new();
        for (name, bytes) in files {
            let path = self.dir.join(name);
            if let Some(folder) = path.parent() {
                fs::create_dir_all(folder).map_err(WriteError::io("create", folder))?;
            }
            let file = temporary(&path);
            let write = || -> std::io::Result<()> {
                use std::io::Write;
                let mut new = self.disk.create(&file)?;
                new.write_all(&bytes)?;
                new.sync()
            };
            write().map_err(WriteError::io("write", &file))?;
            paths.push(path);
        }
        let episodes = self.dir.join("meta/episodes");
        for folder in [self.dir.join("meta"), episodes, self.dir.clone()] {
            sync_folder(&folder).map_err(WriteError::io("sync", &folder))?;
        }
        Ok(paths)
    }

    /// Gives data files their names.
    fn rename_data(&self) -> Result<(), WriteError> {
        let mut folders = BTreeSet::new();
        for file in self.meta.recordings.iter().flat_map(|recording| &recording.files) {
            let path = self.dir.join(data_path(file.number));
            let unfinished = temporary(&path);
            if unfinished.exists() {
                fs::rename(&unfinished, &path).map_err(WriteError::io("rename", &path))?;
                folders.extend(path.parent().map(Path::to_owned));
            }
        }
        folders.iter().try_for_each(|folder| sync_folder(folder).map_err(WriteError::io("sync", folder)))
    }

    fn info_json(&self) -> Value {
        let schema = &self.spec.schema;
        json!({
            "codebase_version": "v3.0",
            "robot_type": schema.robot_type,
            "total_episodes": self.episodes.len(),
            "total_frames": self.n_rows(),
            "total_tasks": self.tasks.len(),
            "chunks_size": FILES_PER_CHUNK,
            "data_files_size_in_mb": (self.spec.max_file_bytes >> 20).max(1),
            "video_files_size_in_mb": 200,
            "fps": self.columns.fps,
            "splits": {"train": format!("0:{}", self.episodes.len())},
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": null,
            "features": self.columns.lerobot_features(schema),
        })
    }

    fn summary(&self) -> DatasetSummary {
        let (recordings, episodes, frames) = self.before;
        let files = self.meta.recordings.iter().flat_map(|recording| &recording.files);
        DatasetSummary {
            recordings: self.meta.recordings.len() as u64,
            episodes: self.episodes.len() as u64,
            frames: self.n_rows(),
            new_recordings: self.meta.recordings.len() as u64 - recordings,
            new_episodes: self.episodes.len() as u64 - episodes,
            new_frames: self.n_rows() - frames,
            data_bytes: files.map(|file| file.length_bytes).sum(),
        }
    }
}
