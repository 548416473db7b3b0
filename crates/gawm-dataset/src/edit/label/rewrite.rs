//! Writes a gawm dataset with other labels: what does not change is linked.

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use gawm_schema::batch::Split;
use serde_json::json;

use super::super::gawm_output::add_foreign_columns;
use super::super::history;
use super::splice::{TaskRows, splice};
use super::{EditError, EpisodeLabels, Input, Label, LabelValue, Plan};
use crate::columns::Columns;
use crate::durable::{Disk, sync_folder};
use crate::edit::EditSummary;
use crate::edit::input::GawmInput;
use crate::encoded::write_encoded;
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::journal::to_json;
use crate::layout::{EPISODES, GAWM, INFO, STATISTICS, STATS, TASKS, data_path, encoded_path};
use crate::provenance::GawmMeta;
use crate::read::{guarded, join_inside};
use crate::scan::scan_recording;
use crate::tables::{episodes_table, tasks_table};
use crate::totals::Totals;
use crate::writer::fit;

/// The dataset on its way.
struct Relabelled<'a> {
    input: &'a Input,
    dir: &'a Path,
    disk: Disk,
    meta: GawmMeta,
    episodes: Vec<EpisodeRecord>,
    tasks: Vec<String>,
    /// Positions of episodes with another task.
    moved: BTreeSet<usize>,
    is_split_changed: bool,
    copies: bool,
    folders: BTreeSet<PathBuf>,
}

/// Writes the labelled dataset into `dir`.
pub(in crate::edit) fn write(
    input: &Input,
    gawm: &GawmInput,
    plan: &Plan,
    dir: &Path,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<EditSummary, EditError> {
    let Some(labels) = &plan.labels else {
        return Err(EditError::NothingLeft { verb: plan.verb.clone() });
    };
    check_whole(input, gawm, plan)?;
    let mut output = Relabelled {
        input,
        dir,
        disk: Disk::default(),
        meta: GawmMeta { software: history::software(), ..gawm.meta.clone() },
        episodes: gawm.episodes.clone(),
        tasks: input.dataset.tasks.clone(),
        moved: BTreeSet::new(),
        is_split_changed: false,
        copies: labels.copies,
        folders: BTreeSet::new(),
    };
    for (position, changes) in &labels.episodes {
        output.apply(plan.pieces[*position].run, changes);
    }
    for run in 0..output.episodes.len() {
        add_foreign_columns(input, run, &mut output.episodes[run].tags);
    }
    let n_written = output.write_data(progress)?;
    output.write_standardised()?;
    output.copy_attachments()?;
    output.write_meta(plan)?;
    let rows = input.dataset.n_rows();
    let mut notes = vec![format!(
        "{} of {} episodes have other labels now; {n_written} of {} data files were written anew, the others are {}",
        labels.episodes.len(),
        output.episodes.len(),
        output.meta.recordings.iter().map(|recording| recording.files.len()).sum::<usize>(),
        if labels.copies { "copies" } else { "linked (copied where links are not possible)" },
    )];
    if output.is_split_changed {
        notes.push("the split changed: standardisation was fitted again".to_owned());
    }
    Ok(EditSummary { episodes: output.episodes.len() as u64, rows, notes })
}

/// Files are taken over as they are, so all of them must be sound.
fn check_whole(input: &Input, gawm: &GawmInput, plan: &Plan) -> Result<(), EditError> {
    let runs = &input.dataset.runs;
    let in_order = runs.iter().enumerate().all(|(i, run)| run.episode_index == i as i64);
    if in_order && plan.pieces.len() == runs.len() && gawm.episodes.len() == runs.len() {
        return Ok(());
    }
    Err(EditError::Damaged {
        path: input.dataset.root.clone(),
        place: "data".to_owned(),
        expected: format!("{} whole episodes in order", gawm.episodes.len()),
        got: format!("{} of {} stretches of rows", plan.pieces.len(), runs.len()),
    })
}

impl Relabelled<'_> {
    /// Changes what is said of an episode.
    fn apply(&mut self, run: usize, changes: &EpisodeLabels) {
        let episode = &mut self.episodes[run];
        for (label, value) in changes {
            let text = match value {
                LabelValue::Text(text) => text.clone(),
                _ => String::new(),
            };
            match label {
                Label::Task => {
                    self.moved.insert(run);
                    if !self.tasks.contains(&text) {
                        self.tasks.push(text.clone());
                    }
                    episode.task = text;
                }
                Label::Success => {
                    episode.success = if let LabelValue::Bool(value) = value { Some(*value) } else { None };
                }
                Label::Operator => episode.operator = text,
                Label::Split => {
                    episode.is_training = *value == LabelValue::Split(Split::Train);
                    self.is_split_changed = true;
                }
                Label::Tag(name) if *value == LabelValue::Unknown => {
                    episode.tags.remove(name);
                }
                Label::Tag(name) => {
                    episode.tags.insert(name.clone(), text);
                }
            }
        }
    }

    /// Returns the episodes with another task in each data file.
    fn task_rows(&self) -> BTreeMap<&str, Vec<TaskRows>> {
        let mut files: BTreeMap<&str, Vec<TaskRows>> = BTreeMap::new();
        for &position in &self.moved {
            let run = self.input.dataset.runs[position];
            let task = self.tasks.iter().position(|task| *task == self.episodes[position].task);
            let rows =
                TaskRows { start: run.start, end: run.start + run.n_rows, task: task.unwrap_or(0) as i64 };
            files.entry(self.input.dataset.files[run.file].relative.as_str()).or_default().push(rows);
        }
        files
    }

    /// Writes or links the data files; returns how many were written.
    fn write_data(&mut self, progress: &(dyn Fn(u64) + Sync)) -> Result<usize, EditError> {
        let root = self.input.dataset.root.clone();
        let changes: BTreeMap<String, Vec<TaskRows>> =
            self.task_rows().into_iter().map(|(name, rows)| (name.to_owned(), rows)).collect();
        let mut n_written = 0;
        let mut lengths = Vec::new();
        let files: Vec<_> = self.meta.recordings.iter().flat_map(|r| &r.files).cloned().collect();
        for file in files {
            let relative = data_path(file.number);
            let name = relative.to_string_lossy().into_owned();
            let source = self.inside(&name)?;
            let target = self.target(&relative)?;
            lengths.push(match changes.get(&name) {
                Some(rows) => {
                    n_written += 1;
                    let written = guarded(|| Ok(splice(&source, &target, &self.disk, rows)));
                    let damaged = |got: String| EditError::Damaged {
                        path: root.clone(),
                        place: name.clone(),
                        expected: "a readable data file".to_owned(),
                        got,
                    };
                    written.map_err(damaged)?.map_err(WriteError::parquet(&target))?
                }
                None => {
                    self.take_over(&source, &target)?;
                    file.length_bytes
                }
            });
            progress(file.frames);
        }
        let records = self.meta.recordings.iter_mut().flat_map(|recording| &mut recording.files);
        records.zip(lengths).for_each(|(record, length)| record.length_bytes = length);
        Ok(n_written)
    }

    /// Fits the standardisation again when training data changed, and takes over the standardised columns when not.
    fn write_standardised(&mut self) -> Result<(), EditError> {
        if !self.is_split_changed {
            for file in self.meta.recordings.iter().flat_map(|r| &r.files).cloned().collect::<Vec<_>>() {
                let relative = encoded_path(file.number);
                let source = self.inside(&relative.to_string_lossy())?;
                if source.is_file() {
                    let target = self.target(&relative)?;
                    self.take_over(&source, &target)?;
                }
            }
            return Ok(());
        }
        let columns = Columns::new(&self.meta.schema);
        let mut totals = Totals::new(&columns);
        for recording in &self.meta.recordings {
            let counted = guarded(|| Ok(scan_recording(self.dir, &columns, recording, &self.episodes)));
            let damaged = |got: String| EditError::Damaged {
                path: self.input.dataset.root.clone(),
                place: "data".to_owned(),
                expected: "readable rows".to_owned(),
                got,
            };
            totals.merge(&counted.map_err(damaged)??);
        }
        self.meta.standardisation = fit(&columns, &totals, &self.episodes);
        Ok(write_encoded(self.dir, &self.disk, &self.meta)?)
    }

    fn copy_attachments(&mut self) -> Result<(), EditError> {
        let records: BTreeSet<String> = self
            .meta
            .recordings
            .iter()
            .flat_map(|recording| recording.attachments.iter().map(|record| record.path.clone()))
            .collect();
        for relative in records {
            let source = self.inside(&relative)?;
            let target = self.target(Path::new(&relative))?;
            fs::copy(&source, &target).map_err(EditError::io("copy", &source))?;
        }
        Ok(())
    }

    /// Writes the tables and descriptions; `meta/info.json` last.
    fn write_meta(&mut self, plan: &Plan) -> Result<(), EditError> {
        let columns = Columns::new(&self.meta.schema);
        let cameras: Vec<&str> = columns.images.iter().map(|image| image.name.as_str()).collect();
        self.write_file(TASKS, &tasks_table(&self.tasks)?)?;
        self.write_file(EPISODES, &episodes_table(&self.episodes, &cameras)?)?;
        for name in [STATS, STATISTICS] {
            let source = self.inside(name)?;
            let target = self.target(Path::new(name))?;
            fs::copy(&source, &target).map_err(EditError::io("copy", &source))?;
        }
        self.write_file(GAWM, &to_json(Path::new(GAWM), &self.meta)?)?;
        let counts = (self.episodes.len() as u64, self.input.dataset.n_rows());
        history::write(self.dir, std::slice::from_ref(self.input), plan, counts)?;
        for folder in &self.folders {
            sync_folder(folder).map_err(EditError::io("sync", folder))?;
        }
        let mut info = self.input.dataset.info.raw.clone();
        info["total_tasks"] = json!(self.tasks.len());
        self.write_file(INFO, &to_json(Path::new(INFO), &info)?)
    }

    fn write_file(&mut self, name: &str, bytes: &[u8]) -> Result<(), EditError> {
        let path = self.target(Path::new(name))?;
        self.disk.write_whole(&path, bytes).map_err(EditError::io("write", &path))
    }

    /// Returns the path of a file of the input; names come from its metadata.
    fn inside(&self, relative: &str) -> Result<PathBuf, EditError> {
        let root = &self.input.dataset.root;
        join_inside(root, relative).map_err(|got| EditError::Damaged {
            path: root.clone(),
            place: relative.to_owned(),
            expected: "a path inside the folder".to_owned(),
            got,
        })
    }

    /// Returns the path of a file of the output, whose folder is there then.
    fn target(&mut self, relative: &Path) -> Result<PathBuf, EditError> {
        let path = self.dir.join(relative);
        if let Some(folder) = path.parent()
            && self.folders.insert(folder.to_owned())
        {
            fs::create_dir_all(folder).map_err(EditError::io("create", folder))?;
        }
        Ok(path)
    }

    /// Links a file that stays as it is; copies it to another file system.
    fn take_over(&self, source: &Path, target: &Path) -> Result<(), EditError> {
        take_over(source, target, self.copies)
    }
}

/// Links a file, or copies it where that is asked for or links are not possible.
pub(in crate::edit) fn take_over(source: &Path, target: &Path, copies: bool) -> Result<(), EditError> {
    // A link to a symbolic link would lead astray when one of the folders moves.
    let real = source.canonicalize().map_err(EditError::io("resolve", source))?;
    if !copies && fs::hard_link(&real, target).is_ok() {
        return Ok(());
    }
    fs::copy(&real, target).map(|_| ()).map_err(EditError::io("copy to", target))?;
    fs::File::open(target).and_then(|file| file.sync_all()).map_err(EditError::io("sync", target))
}
