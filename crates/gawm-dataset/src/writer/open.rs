//! What the output folder holds when a run begins.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gawm_schema::first_difference;

use super::DatasetWriter;
use crate::columns::Columns;
use crate::durable::{Disk, TEMPORARY, remove_file, temporary};
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::journal::{Base, DoneRecording, Journal, RunRecord, load};
use crate::layout::{
    ATTACHMENTS, CALIBRATION, EPISODES, FORMAT_VERSION, GAWM, INFO, STATISTICS, TASKS, data_path,
};
use crate::provenance::{Contract, GawmMeta};
use crate::scan::scan_recording;
use crate::spec::{DatasetSpec, WriteMode};
use crate::statistics_file::StatisticsFile;
use crate::tables::{read_episodes, read_tasks};
use crate::totals::Totals;

/// What was there before.
struct Found {
    meta: GawmMeta,
    tasks: Vec<String>,
    episodes: Vec<EpisodeRecord>,
    base: Base,
}

impl DatasetWriter {
    /// [`DatasetWriter::create`] on a disk of limited space.
    pub(super) fn create_on(
        disk: Disk,
        dir: &Path,
        spec: DatasetSpec,
        mode: WriteMode,
    ) -> Result<DatasetWriter, WriteError> {
        spec.schema.validate()?;
        if !(0.0..=1.0).contains(&spec.train_share) {
            return Err(WriteError::TrainShare { got: spec.train_share });
        }
        let is_finished = dir.join(INFO).is_file() && dir.join(GAWM).is_file();
        let is_unfinished = Journal::exists(dir);
        match mode {
            WriteMode::New if !is_empty(dir)? => return Err(WriteError::NotEmpty { dir: dir.to_owned() }),
            WriteMode::Append if is_unfinished => return Err(WriteError::Unfinished { dir: dir.to_owned() }),
            WriteMode::Append if !is_finished => return Err(WriteError::NoDataset { dir: dir.to_owned() }),
            WriteMode::Resume if !is_finished && !is_unfinished && !is_only_begun(dir)? => {
                return Err(WriteError::NotEmpty { dir: dir.to_owned() });
            }
            _ => {}
        }
        let has_made_folder = !dir.exists();
        fs::create_dir_all(dir).map_err(WriteError::io("create", dir))?;
        let (journal, found, done) = if is_unfinished {
            let (journal, run, done) = Journal::open(dir, &disk)?;
            check_version(&dir.join(crate::layout::JOURNAL), run.format_version)?;
            check_equal("spec", &run.spec, &spec)?;
            (journal, find_base(dir, &spec, run.base)?, done)
        } else {
            let base = if is_finished { finished_base(dir)? } else { Base::default() };
            let found = find_base(dir, &spec, base)?;
            if is_finished {
                check_fits(&found.meta, &spec, mode)?;
            }
            let run =
                RunRecord { format_version: FORMAT_VERSION, spec: spec.clone(), base: found.base.clone() };
            (Journal::begin(dir, &disk, &run)?, found, Vec::new())
        };
        let is_first = !is_finished && found.base.recordings == 0;
        let mut writer = DatasetWriter::with_content(dir, disk, spec, journal, found, done)?;
        writer.is_first = is_first;
        writer.has_made_folder = has_made_folder;
        writer.remove_leftovers()?;
        Ok(writer)
    }

    /// Builds the writer's state from what is there.
    fn with_content(
        dir: &Path,
        disk: Disk,
        spec: DatasetSpec,
        journal: Journal,
        found: Found,
        done: Vec<DoneRecording>,
    ) -> Result<DatasetWriter, WriteError> {
        let columns = Arc::new(Columns::new(&spec.schema));
        let Found { mut meta, mut tasks, mut episodes, base } = found;
        let mut cameras = base.cameras;
        for done in done {
            for episode in &done.episodes {
                if !tasks.contains(&episode.task) {
                    tasks.push(episode.task.clone());
                }
            }
            episodes.extend(done.episodes);
            for (name, stats) in &done.cameras {
                cameras.entry(name.clone()).or_default().merge(stats);
            }
            meta.recordings.push(done.recording);
        }
        let contract = Contract::new(&spec.contract);
        if !meta.contracts.contains(&contract) {
            meta.contracts.push(contract.clone());
        }
        meta.software.clone_from(&spec.software);
        let mut totals = Totals::new(&columns);
        for recording in &meta.recordings {
            totals.merge(&scan_recording(dir, &columns, recording, &episodes)?);
        }
        let before = (
            meta.recordings.len() as u64,
            episodes.len() as u64,
            episodes.iter().map(|episode| episode.length).sum(),
        );
        Ok(DatasetWriter {
            dir: dir.to_owned(),
            disk,
            contract: contract.hash,
            columns,
            journal,
            known: meta.recordings.iter().map(|recording| recording.source.content_hash).collect(),
            ids: episodes.iter().map(|episode| episode.id.clone()).collect(),
            meta,
            tasks,
            episodes,
            totals,
            cameras,
            before,
            recording: None,
            is_first: false,
            has_made_folder: false,
            spec,
        })
    }

    /// Removes what an interrupted run left of a recording that it did not finish.
    pub(super) fn remove_leftovers(&self) -> Result<(), WriteError> {
        let files = self.meta.recordings.iter().flat_map(|recording| &recording.files);
        let kept: BTreeSet<PathBuf> =
            files.map(|file| temporary(&self.dir.join(data_path(file.number)))).collect();
        let mut leftovers = Vec::new();
        for folder in ["data", "meta", "gawm"] {
            list_temporary(&self.dir.join(folder), &mut leftovers)?;
        }
        for path in leftovers.iter().filter(|path| !kept.contains(*path)) {
            remove_file(path).map_err(WriteError::io("remove", path))?;
        }
        let attachments = self.meta.recordings.iter().flat_map(|recording| &recording.attachments);
        let kept: BTreeSet<PathBuf> = attachments.map(|a| self.dir.join(&a.path)).collect();
        for folder in [ATTACHMENTS, CALIBRATION] {
            for path in list(&self.dir.join(folder))?.iter().filter(|path| !kept.contains(*path)) {
                remove_file(path).map_err(WriteError::io("remove", path))?;
            }
        }
        Ok(())
    }
}

/// Reads what the dataset held when the run began; a run that was interrupted while it finished has replaced some
/// meta files by longer ones.
fn find_base(dir: &Path, spec: &DatasetSpec, base: Base) -> Result<Found, WriteError> {
    if base.recordings == 0 {
        return Ok(Found { meta: GawmMeta::new(spec), tasks: Vec::new(), episodes: Vec::new(), base });
    }
    let path = dir.join(GAWM);
    let mut meta: GawmMeta = load(&path)?;
    check_version(&path, meta.format_version)?;
    if meta.recordings.len() < base.recordings {
        let reason =
            format!("expected {} recordings or more, got {}", base.recordings, meta.recordings.len());
        return Err(WriteError::Damaged { path, reason });
    }
    meta.recordings.truncate(base.recordings);
    let used: BTreeSet<_> = meta.recordings.iter().map(|recording| recording.contract).collect();
    meta.contracts.retain(|contract| used.contains(&contract.hash));
    let tasks = read_tasks(&dir.join(TASKS), base.tasks)?;
    let episodes = read_episodes(&dir.join(EPISODES), base.episodes)?;
    Ok(Found { meta, tasks, episodes, base })
}

/// Returns how much a finished dataset holds.
fn finished_base(dir: &Path) -> Result<Base, WriteError> {
    let meta: GawmMeta = load(&dir.join(GAWM))?;
    check_version(&dir.join(GAWM), meta.format_version)?;
    let statistics: StatisticsFile = load(&dir.join(STATISTICS))?;
    let episodes: u64 = meta.recordings.iter().map(|recording| recording.episodes).sum();
    let info: serde_json::Value = load(&dir.join(INFO))?;
    let number = |key: &str| {
        info.get(key).and_then(serde_json::Value::as_u64).ok_or_else(|| WriteError::Damaged {
            path: dir.join(INFO),
            reason: format!("{key:?} is missing or no whole number"),
        })
    };
    if number("total_episodes")? != episodes {
        let reason =
            format!("total_episodes is {}, but meta/gawm.json has {episodes}", number("total_episodes")?);
        return Err(WriteError::Damaged { path: dir.join(INFO), reason });
    }
    let cameras: BTreeMap<_, _> = statistics.cameras;
    Ok(Base {
        recordings: meta.recordings.len(),
        episodes: episodes as usize,
        tasks: number("total_tasks")? as usize,
        cameras,
    })
}

fn check_version(path: &Path, version: u32) -> Result<(), WriteError> {
    if version == FORMAT_VERSION {
        return Ok(());
    }
    let reason = format!("format version is {version}, expected {FORMAT_VERSION}");
    Err(WriteError::Damaged { path: path.to_owned(), reason })
}

/// A finished dataset is extended with the same schema; a resumed run also has the same contract.
fn check_fits(meta: &GawmMeta, spec: &DatasetSpec, mode: WriteMode) -> Result<(), WriteError> {
    check_equal("schema", &meta.schema, &spec.schema)?;
    check_equal("train_share", &meta.train_share, &spec.train_share)?;
    if mode == WriteMode::Resume
        && !meta.contracts.is_empty()
        && !meta.contracts.contains(&Contract::new(&spec.contract))
    {
        check_equal("contract", &meta.contracts[0].text, &spec.contract)?;
    }
    Ok(())
}

fn check_equal<T: serde::Serialize>(place: &str, expected: &T, got: &T) -> Result<(), WriteError> {
    let value = |value: &T| serde_json::to_value(value).unwrap_or_default();
    match first_difference(place, &value(expected), &value(got)) {
        Some((place, expected, got)) => Err(WriteError::SpecChanged { place, expected, got }),
        None => Ok(()),
    }
}

fn is_empty(dir: &Path) -> Result<bool, WriteError> {
    match fs::read_dir(dir) {
        Ok(mut entries) => Ok(entries.next().is_none()),
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => Ok(true),
        Err(error) => Err(WriteError::io("list", dir)(error)),
    }
}

/// Returns whether a run was interrupted before it wrote its journal: there are folders, but no files of others.
fn is_only_begun(dir: &Path) -> Result<bool, WriteError> {
    if is_empty(dir)? {
        return Ok(true);
    }
    let only = |folder: &Path, name: &str| -> Result<bool, WriteError> {
        Ok(list(folder)?.iter().all(|path| path.file_name().is_some_and(|n| n == name)))
    };
    let journal = dir.join(crate::layout::JOURNAL);
    Ok(only(dir, "gawm")? && only(&dir.join("gawm"), "journal")? && only(&journal, "run.json.tmp")?)
}

/// Returns the entries of a folder; none when it is not there.
fn list(folder: &Path) -> Result<Vec<PathBuf>, WriteError> {
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(Vec::new()),
        Err(error) => return Err(WriteError::io("list", folder)(error)),
    };
    let mut paths = Vec::new();
    for entry in entries {
        paths.push(entry.map_err(WriteError::io("list", folder))?.path());
    }
    paths.sort();
    Ok(paths)
}

fn list_temporary(folder: &Path, found: &mut Vec<PathBuf>) -> Result<(), WriteError> {
    for path in list(folder)? {
        if path.is_dir() && !path.is_symlink() {
            list_temporary(&path, found)?;
        } else if path.as_os_str().to_string_lossy().ends_with(TEMPORARY) {
            found.push(path);
        }
    }
    Ok(())
}
