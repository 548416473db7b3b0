//! Writes a dataset recording by recording, episode by episode, piece by piece.

mod attachments;
mod contract;
mod discard;
mod episode_rows;
mod finish;
mod open;

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use gawm_schema::batch::Split;
use gawm_schema::{ContentHash, is_training};

use crate::camera::CameraStats;
use crate::columns::Columns;
use crate::data_file::DataFile;
use crate::durable::{Disk, remove_file, sync_folder, temporary};
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::journal::{DoneRecording, Journal};
use crate::layout::data_path;
use crate::provenance::{FileRecord, GawmMeta, RecordingRecord};
use crate::spec::{DatasetSpec, DatasetSummary, EpisodeInfo, RecordingInfo, RecordingState, WriteMode};
use crate::totals::Totals;
use crate::trajectory::Trajectory;
use episode_rows::OpenEpisode;
pub(crate) use finish::fit;

/// Writes a dataset folder.
///
/// ```text
/// create -> (begin_recording -> (begin_episode -> write* -> end_episode)* -> end_recording)* -> finish
/// ```
///
/// Rows leave memory in row groups of at most 32 MiB; what stays is statistics and the episode table. Data files keep
/// a temporary name until [`finish`](DatasetWriter::finish), so that an unfinished run never changes a dataset that
/// is being extended; a recording that has ended is on the disk and is not done again by a run with
/// [`WriteMode::Resume`]. The bytes of the result depend on the specification and the rows alone: not on how episodes
/// are cut into pieces, nor on interruptions, nor on whether recordings came in one run or were appended.
pub struct DatasetWriter {
    dir: PathBuf,
    disk: Disk,
    spec: DatasetSpec,
    contract: ContentHash,
    columns: Arc<Columns>,
    journal: Journal,
    meta: GawmMeta,
    tasks: Vec<String>,
    episodes: Vec<EpisodeRecord>,
    totals: Totals,
    cameras: BTreeMap<String, CameraStats>,
    known: BTreeSet<ContentHash>,
    ids: BTreeSet<String>,
    /// Recordings, episodes and rows that this run did not add.
    before: (u64, u64, u64),
    recording: Option<OpenRecording>,
    /// Whether the folder held nothing before this run, or before the one that it resumes.
    is_first: bool,
    /// Whether this run made the folder.
    has_made_folder: bool,
}

/// A recording that has begun and not ended.
struct OpenRecording {
    record: RecordingRecord,
    n_tasks_before: usize,
    totals: Totals,
    cameras: BTreeMap<String, CameraStats>,
    file: Option<DataFile>,
    episode: Option<OpenEpisode>,
    /// Ids of its episodes.
    ids: Vec<String>,
}

impl DatasetWriter {
    /// Opens a folder for writing.
    ///
    /// # Errors
    /// - the schema or the training share is impossible;
    /// - [`WriteMode::New`]: the folder is there and not empty;
    /// - [`WriteMode::Append`]: it holds no finished dataset, or an unfinished run;
    /// - [`WriteMode::Resume`]: it holds something that is neither;
    /// - the specification (resume) or the schema and the training share (append) differ from the dataset's: the error
    ///   names the first difference;
    /// - files of the dataset are damaged or cannot be read or written.
    pub fn create(dir: &Path, spec: DatasetSpec, mode: WriteMode) -> Result<DatasetWriter, WriteError> {
        DatasetWriter::create_on(Disk::default(), dir, spec, mode)
    }

    /// Returns the schema that rows must fit.
    pub fn schema(&self) -> &gawm_schema::Schema {
        &self.spec.schema
    }

    /// Returns whether any episode has ended, in this run or before.
    pub fn has_episodes(&self) -> bool {
        !self.episodes.is_empty()
    }

    /// Begins a recording, unless the dataset has it.
    ///
    /// # Errors
    /// - the recording before has not ended.
    pub fn begin_recording(&mut self, source: RecordingInfo) -> Result<RecordingState, WriteError> {
        if self.recording.is_some() {
            return Err(order("begin_recording", "before the last recording ended"));
        }
        if self.known.contains(&source.content_hash) {
            return Ok(RecordingState::AlreadyThere);
        }
        self.recording = Some(OpenRecording {
            record: RecordingRecord {
                source,
                contract: self.contract,
                first_episode: self.episodes.len() as u64,
                episodes: 0,
                frames: 0,
                files: Vec::new(),
                attachments: Vec::new(),
            },
            n_tasks_before: self.tasks.len(),
            totals: Totals::new(&self.columns),
            cameras: BTreeMap::new(),
            file: None,
            episode: None,
            ids: Vec::new(),
        });
        Ok(RecordingState::New)
    }

    /// Begins an episode of the open recording.
    ///
    /// # Errors
    /// - no recording is open, or an episode is;
    /// - the id is taken.
    pub fn begin_episode(&mut self, mut info: EpisodeInfo) -> Result<(), WriteError> {
        let first_index = self.n_rows();
        let n_episodes = self.episodes.len() as u64;
        let recording = open_recording(&mut self.recording, "begin_episode")?;
        if recording.episode.is_some() {
            return Err(order("begin_episode", "before the last episode ended"));
        }
        if info.id.is_empty() {
            let hash = recording.record.source.content_hash.to_string();
            info.id = format!("{}-{:04}", &hash[..12], recording.record.episodes);
        }
        if self.ids.contains(&info.id) {
            return Err(WriteError::DuplicateEpisode { id: info.id });
        }
        let task = self.tasks.iter().position(|task| *task == info.task).unwrap_or_else(|| {
            self.tasks.push(info.task.clone());
            self.tasks.len() - 1
        });
        recording.episode = Some(OpenEpisode::new(
            &self.columns,
            info,
            n_episodes,
            task as u64,
            first_index,
            self.spec.schema.hash(),
        ));
        Ok(())
    }

    /// Replaces what is said of the open episode by what is known at its end; its id and task stay.
    ///
    /// # Errors
    /// - no episode is open.
    pub fn amend_episode(&mut self, info: EpisodeInfo) -> Result<(), WriteError> {
        let recording = open_recording(&mut self.recording, "amend_episode")?;
        let Some(episode) = recording.episode.as_mut() else {
            return Err(order("amend_episode", "without an open episode"));
        };
        episode.amend(info);
        Ok(())
    }

    /// Appends rows to the open episode.
    ///
    /// # Errors
    /// - no episode is open;
    /// - the trajectory was checked against another schema;
    /// - its time does not continue that of the piece before;
    /// - an action that is not valid holds numbers before the last row of the episode;
    /// - the data file cannot be written.
    pub fn write(&mut self, trajectory: Trajectory) -> Result<(), WriteError> {
        let columns = Arc::clone(&self.columns);
        let recording = open_recording(&mut self.recording, "write")?;
        let Some(episode) = recording.episode.as_mut() else {
            return Err(order("write", "without an open episode"));
        };
        if recording.file.is_none() {
            let number = next_file(&self.meta, &recording.record);
            recording.file = Some(create_file(&self.dir, &self.disk, &columns, number)?);
        }
        let Some(file) = recording.file.as_mut() else { return Ok(()) };
        episode.begin_in(file.mark());
        episode.write(&columns, file, trajectory.into_rows())
    }

    /// Ends the open episode.
    ///
    /// # Errors
    /// - no episode is open, or it has no row;
    /// - the data file cannot be written.
    pub fn end_episode(&mut self) -> Result<(), WriteError> {
        let columns = Arc::clone(&self.columns);
        let recording = open_recording(&mut self.recording, "end_episode")?;
        let Some(episode) = recording.episode.take() else {
            return Err(order("end_episode", "without an open episode"));
        };
        let Some(file) = recording.file.as_mut().filter(|_| episode.length() > 0) else {
            return Err(WriteError::EmptyEpisode { id: episode.id().to_owned() });
        };
        let mut done = episode.finish(&columns, file)?;
        done.record.file = next_file(&self.meta, &recording.record);
        done.record.recording = self.meta.recordings.len() as u64;
        fill_source(&mut done.record, &recording.record.source);
        let session = if done.record.session.is_empty() { &done.record.id } else { &done.record.session };
        done.record.is_training = match done.split {
            Some(split) => split == Split::Train,
            None => is_training(session, self.spec.train_share),
        };
        done.totals.end_episode(done.record.is_training);
        recording.totals.merge(&done.totals);
        for (name, stats) in done.cameras {
            recording.cameras.entry(name).or_default().merge(&stats);
        }
        recording.record.episodes += 1;
        recording.record.frames += done.record.length;
        recording.ids.push(done.record.id.clone());
        self.ids.insert(done.record.id.clone());
        self.episodes.push(done.record);
        if file.bytes_written() >= self.spec.max_file_bytes {
            close_file(recording, &self.meta)?;
        }
        Ok(())
    }

    /// Gives up the open episode with all rows written so far, as if it had not begun.
    ///
    /// Costs a copy of the data file's earlier episodes when more rows than fit into one block were written.
    ///
    /// # Errors
    /// - no episode is open;
    /// - the data file cannot be read or written.
    pub fn discard_episode(&mut self) -> Result<(), WriteError> {
        let columns = Arc::clone(&self.columns);
        let recording = open_recording(&mut self.recording, "discard_episode")?;
        let Some(episode) = recording.episode.take() else {
            return Err(order("discard_episode", "without an open episode"));
        };
        if let (Some(file), Some(mark)) = (recording.file.take(), episode.beginning()) {
            let path = file.path().to_owned();
            recording.file = file.rewind(&columns, mark).map_err(WriteError::parquet(&path))?;
        }
        // A task that only the discarded episode had is no task of the dataset.
        let is_new = episode.task() == self.tasks.len() as u64 - 1;
        if is_new && !self.episodes.iter().any(|done| done.task == self.tasks[episode.task() as usize]) {
            self.tasks.pop();
        }
        Ok(())
    }

    /// Ends the open recording: its rows are on the disk when this returns.
    ///
    /// # Errors
    /// - no recording is open, or an episode is;
    /// - files cannot be written.
    pub fn end_recording(&mut self) -> Result<(), WriteError> {
        let recording = open_recording(&mut self.recording, "end_recording")?;
        if recording.episode.is_some() {
            return Err(order("end_recording", "before the last episode ended"));
        }
        close_file(recording, &self.meta)?;
        for file in &recording.record.files {
            let path = self.dir.join(data_path(file.number));
            let folder = path.parent().unwrap_or(&self.dir);
            sync_folder(folder).map_err(WriteError::io("sync", folder))?;
        }
        let Some(recording) = self.recording.take() else { return Ok(()) };
        let first = recording.record.first_episode as usize;
        let done = DoneRecording {
            recording: recording.record,
            episodes: self.episodes[first..].to_vec(),
            cameras: recording.cameras,
        };
        self.journal.add(&done)?;
        self.totals.merge(&recording.totals);
        self.known.insert(done.recording.source.content_hash);
        for (name, stats) in &done.cameras {
            self.cameras.entry(name.clone()).or_default().merge(stats);
        }
        self.meta.recordings.push(done.recording);
        Ok(())
    }

    /// Gives up the open recording with all its episodes, as if it had not begun.
    ///
    /// # Errors
    /// - no recording is open;
    /// - its files cannot be removed.
    pub fn abort_recording(&mut self) -> Result<(), WriteError> {
        let Some(recording) = self.recording.take() else {
            return Err(order("abort_recording", "without an open recording"));
        };
        self.episodes.truncate(recording.record.first_episode as usize);
        self.tasks.truncate(recording.n_tasks_before);
        recording.ids.iter().for_each(|id| {
            self.ids.remove(id);
        });
        let numbers = recording.record.files.iter().map(|file| file.number);
        let mut paths: Vec<PathBuf> =
            numbers.map(|number| temporary(&self.dir.join(data_path(number)))).collect();
        paths.extend(recording.file.map(|file| file.path().to_owned()));
        paths.extend(self.orphans(&recording.record.attachments));
        paths.iter().try_for_each(|path| remove_file(path).map_err(WriteError::io("remove", path)))
    }

    /// Returns the number of rows of all ended episodes.
    fn n_rows(&self) -> u64 {
        self.episodes.last().map_or(0, |last| last.from_index + last.length)
    }

    /// Writes all that describes the dataset and gives the data files their names.
    ///
    /// # Errors
    /// - a recording is open;
    /// - files cannot be written.
    pub fn finish(self) -> Result<DatasetSummary, WriteError> {
        if self.recording.is_some() {
            return Err(order("finish", "before the last recording ended"));
        }
        self.commit()
    }
}

fn order(call: &'static str, when: &'static str) -> WriteError {
    WriteError::Order { call, when }
}

fn open_recording<'a>(
    recording: &'a mut Option<OpenRecording>,
    call: &'static str,
) -> Result<&'a mut OpenRecording, WriteError> {
    recording.as_mut().ok_or(order(call, "without an open recording"))
}

/// Returns the number of the data file after those of all recordings, the open one included.
fn next_file(meta: &GawmMeta, open: &RecordingRecord) -> u64 {
    let files = meta.recordings.iter().chain([open]).rev().find_map(|recording| recording.files.last());
    files.map_or(0, |file| file.number + 1)
}

fn create_file(dir: &Path, disk: &Disk, columns: &Columns, number: u64) -> Result<DataFile, WriteError> {
    let path = temporary(&dir.join(data_path(number)));
    if let Some(folder) = path.parent().filter(|folder| !folder.exists()) {
        fs::create_dir_all(folder).map_err(WriteError::io("create", folder))?;
        let data = dir.join("data");
        sync_folder(&data).map_err(WriteError::io("sync", &data))?;
    }
    DataFile::create(disk, &path, columns).map_err(WriteError::parquet(&path))
}

/// Closes the open data file and notes it in the recording.
fn close_file(recording: &mut OpenRecording, meta: &GawmMeta) -> Result<(), WriteError> {
    let Some(file) = recording.file.take() else { return Ok(()) };
    let number = next_file(meta, &recording.record);
    let path = file.path().to_owned();
    let frames = file.n_rows();
    let length_bytes = file.close().map_err(WriteError::parquet(&path))?;
    recording.record.files.push(FileRecord { number, frames, length_bytes });
    Ok(())
}

/// Fills in the file that an episode comes from.
fn fill_source(record: &mut EpisodeRecord, source: &RecordingInfo) {
    let file = source
        .files
        .iter()
        .find(|file| file.name == record.source_file)
        .or(source.files.first().filter(|_| record.source_file.is_empty()));
    match file {
        Some(file) => {
            record.source_file.clone_from(&file.name);
            record.source_hash = file.content_hash;
        }
        None => record.source_hash = source.content_hash,
    }
}

#[cfg(test)]
mod layout_tests;
#[cfg(test)]
pub(crate) mod tests;
