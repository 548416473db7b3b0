//! Writes a plan over LeRobot folders as a LeRobot v3.0 folder: columns as they are, numbers anew.

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{Array, ArrayRef, Float32Array, Int64Array, RecordBatch};
use arrow::compute::cast;
use arrow::datatypes::{DataType, Field, Schema as ArrowSchema, SchemaRef};
use parquet::arrow::ArrowWriter;
use serde_json::Value;

use super::label::{EpisodeLabels, Label, LabelValue, split_name, take_over};
use super::piece_rows::for_each_batch;
use super::{EditError, EditSummary, Input, Piece, Plan, history, lerobot_meta};
use crate::block::int_array;
use crate::columns::image_properties;
use crate::durable::{Disk, DiskFile, sync_parent};
use crate::error::WriteError;
use crate::layout::{data_path, file_position};
use crate::read::{DType, join_inside};

/// A row group is closed before it would hold more than this.
const ROW_GROUP_BYTES: usize = 32 << 20;
/// A data file is closed at the first end of an episode at which it holds this much.
const FILE_BYTES: usize = 100 << 20;

/// The columns that are written anew, in their order.
const NUMBERED: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// Where an episode's pictures lie in a video file of the output.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct VideoPlace {
    pub(super) number: u64,
    pub(super) from_secs: f64,
    pub(super) to_secs: f64,
}

/// One episode of the output.
#[derive(Debug, Clone)]
pub(super) struct OutEpisode<'a> {
    pub(super) piece: &'a Piece,
    pub(super) length: u64,
    pub(super) file: u64,
    pub(super) from_index: u64,
    pub(super) tasks: Vec<String>,
    pub(super) videos: BTreeMap<String, VideoPlace>,
    /// Columns of the episode table that LeRobot does not know.
    pub(super) extras: BTreeMap<String, Value>,
}

pub(super) fn write(
    inputs: &[Input],
    plan: &Plan,
    dir: &Path,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<EditSummary, EditError> {
    let mut notes = lerobot_meta::check_equal(inputs)?;
    let links = plan.labels.as_ref().is_some_and(|labels| !labels.copies);
    let mut videos = Videos { dir, links, numbers: BTreeMap::new(), copied: BTreeMap::new() };
    let mut writer = RowWriter::new(inputs, dir);
    let mut episodes: Vec<OutEpisode<'_>> = Vec::new();
    for (position, piece) in plan.pieces.iter().enumerate() {
        let input = &inputs[piece.input];
        let labels = plan.labels.as_ref().and_then(|labels| labels.episodes.get(&position));
        let task = labels.and_then(task_of);
        let places = videos.take(input, piece)?;
        let from_index = episodes.last().map_or(0, |last| last.from_index + last.length);
        let (file, tasks) =
            writer.episode(input, piece, &task, (episodes.len() as i64, from_index), progress)?;
        let entry = input.dataset.entry(input.dataset.runs[piece.run].episode_index);
        let said = entry.map(|entry| entry.tasks.clone()).filter(|tasks| !tasks.is_empty() && task.is_none());
        let mut extras = entry.map(|entry| entry.extras.clone()).unwrap_or_default();
        labels.iter().for_each(|labels| say(labels, &mut extras));
        episodes.push(OutEpisode {
            piece,
            length: piece.rows.end - piece.rows.start,
            file,
            from_index,
            tasks: said.unwrap_or(tasks),
            videos: places,
            extras,
        });
    }
    writer.close()?;
    let rows = episodes.iter().map(|episode| episode.length).sum();
    history::write(dir, inputs, plan, (episodes.len() as u64, rows))?;
    notes.extend(lerobot_meta::write(inputs, &episodes, &writer.tasks, writer.image_columns(), dir)?);
    Ok(EditSummary { episodes: episodes.len() as u64, rows, notes })
}

/// Returns the task that a label names.
fn task_of(labels: &EpisodeLabels) -> Option<String> {
    match labels.get(&Label::Task)? {
        LabelValue::Text(text) => Some(text.clone()),
        _ => Some(String::new()),
    }
}

/// Says labels in the columns of the episode table.
fn say(labels: &EpisodeLabels, extras: &mut BTreeMap<String, Value>) {
    for (label, value) in labels.iter().filter(|(label, _)| **label != Label::Task) {
        let value = match value {
            LabelValue::Unknown => Value::Null,
            LabelValue::Text(text) => Value::from(text.as_str()),
            LabelValue::Bool(value) => Value::from(*value),
            LabelValue::Split(split) => Value::from(split_name(*split)),
        };
        if *label == Label::Success && extras.contains_key("success_known") {
            extras.insert("success_known".to_owned(), Value::from(!value.is_null()));
        }
        extras.insert(label.column(), value);
    }
}

/// Copies video files, each once.
struct Videos<'a> {
    dir: &'a Path,
    links: bool,
    /// Per camera the number of its next file.
    numbers: BTreeMap<String, u64>,
    /// Per source file its number.
    copied: BTreeMap<(usize, String, PathBuf), u64>,
}

impl Videos<'_> {
    /// Copies what an episode needs and returns where it lies; frames are never encoded anew.
    fn take(&mut self, input: &Input, piece: &Piece) -> Result<BTreeMap<String, VideoPlace>, EditError> {
        let dataset = &input.dataset;
        let run = dataset.runs[piece.run];
        let mut places = BTreeMap::new();
        for camera in input.videos() {
            let missing = |video: &str, reason: String| EditError::Video {
                path: dataset.root.clone(),
                video: video.to_owned(),
                episode: run.episode_index,
                reason,
            };
            let entry = dataset.entry(run.episode_index);
            let relative = entry.and_then(|entry| dataset.video_path(entry, &camera));
            let relative = relative
                .ok_or_else(|| missing(&camera, "the metadata name no file".to_owned()))?
                .map_err(|reason| missing(&camera, reason))?;
            let path = join_inside(&dataset.root, &relative).map_err(|reason| missing(&relative, reason))?;
            if !path.is_file() {
                return Err(missing(&relative, "there is no such file".to_owned()));
            }
            let key = (piece.input, camera.clone(), path.clone());
            let number = match self.copied.get(&key) {
                Some(number) => *number,
                None => {
                    let next = self.numbers.entry(camera.clone()).or_default();
                    let number = *next;
                    *next += 1;
                    self.copy(&path, &camera, number)?;
                    self.copied.insert(key, number);
                    number
                }
            };
            let start =
                entry.and_then(|entry| entry.videos.get(&camera)).map_or(0.0, |v| v.from_timestamp_secs);
            let secs = |row: u64| start + row as f64 / dataset.info.fps;
            let place =
                VideoPlace { number, from_secs: secs(piece.rows.start), to_secs: secs(piece.rows.end) };
            places.insert(camera, place);
        }
        Ok(places)
    }

    fn copy(&self, source: &Path, camera: &str, number: u64) -> Result<(), EditError> {
        let (chunk, file) = file_position(number);
        let relative = format!("videos/{camera}/chunk-{chunk:03}/file-{file:03}.mp4");
        // Names of features come from the input.
        let target = join_inside(self.dir, &relative).map_err(|reason| EditError::Video {
            path: self.dir.to_owned(),
            video: relative.clone(),
            episode: 0,
            reason,
        })?;
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder).map_err(EditError::io("create", folder))?;
        }
        take_over(source, &target, !self.links)
    }
}

/// Writes rows into data files.
struct RowWriter<'a> {
    dir: &'a Path,
    disk: Disk,
    /// The columns of the output, those of the first file.
    arrow: SchemaRef,
    images: Vec<String>,
    fps: f64,
    tasks: Vec<String>,
    /// Per input the output's number of each of its tasks.
    task_numbers: Vec<Vec<i64>>,
    file: Option<(ArrowWriter<DiskFile>, PathBuf)>,
    n_files: u64,
}

impl<'a> RowWriter<'a> {
    fn new(inputs: &'a [Input], dir: &'a Path) -> RowWriter<'a> {
        let first = &inputs[0].dataset;
        let is_image =
            |name: &str| first.info.feature(name).is_some_and(|feature| feature.dtype == DType::Image);
        let arrow = output_schema(&first.files[0].schema, |name| {
            first.info.feature(name).is_some_and(|feature| !inputs[0].is_dropped(feature))
        });
        let images = arrow.fields().iter().map(|f| f.name().clone()).filter(|name| is_image(name)).collect();
        let (tasks, task_numbers) = joined_tasks(inputs);
        RowWriter {
            dir,
            disk: Disk::default(),
            arrow,
            images,
            fps: f64::from(crate::columns::fps(first.info.fps)),
            tasks,
            task_numbers,
            file: None,
            n_files: 0,
        }
    }

    fn image_columns(&self) -> &[String] {
        &self.images
    }

    /// Writes an episode as row groups of its own; returns the number of its file and the tasks of its rows.
    fn episode(
        &mut self,
        input: &Input,
        piece: &Piece,
        task: &Option<String>,
        (episode, from_index): (i64, u64),
        progress: &(dyn Fn(u64) + Sync),
    ) -> Result<(u64, Vec<String>), EditError> {
        let mut tasks = Vec::new();
        let mut n_rows = 0;
        let task = task.as_ref().map(|task| self.task_number(task));
        self.open()?;
        for_each_batch(input, piece, |batch| {
            progress(batch.num_rows() as u64);
            let damaged = |got: String| EditError::Damaged {
                path: input.dataset.root.clone(),
                place: format!("episode {}", input.dataset.runs[piece.run].episode_index),
                expected: "columns of one type in all files".to_owned(),
                got,
            };
            let numbers = match task {
                Some(task) => vec![task; batch.num_rows()],
                None => self.task_numbers(input, piece.input, &batch, "task_index").map_err(damaged)?,
            };
            for number in &numbers {
                let text = usize::try_from(*number).ok().and_then(|n| self.tasks.get(n));
                if let Some(text) = text.filter(|text| !tasks.contains(*text)) {
                    tasks.push(text.clone());
                }
            }
            let position = Position { episode, frame: n_rows, index: from_index as i64 + n_rows };
            let rows = self.renumbered(input, piece.input, &batch, position, numbers).map_err(damaged)?;
            n_rows += batch.num_rows() as i64;
            self.append(&rows)
        })?;
        let number = self.n_files;
        self.end_episode()?;
        Ok((number, tasks))
    }

    /// Returns the rows with their new numbers.
    fn renumbered(
        &self,
        input: &Input,
        source: usize,
        batch: &RecordBatch,
        position: Position,
        tasks: Vec<i64>,
    ) -> Result<RecordBatch, String> {
        let n_rows = batch.num_rows() as i64;
        let frames = position.frame..position.frame + n_rows;
        let mut arrays: Vec<ArrayRef> = Vec::with_capacity(self.arrow.fields().len());
        for field in self.arrow.fields() {
            let array: ArrayRef = match field.name().as_str() {
                "timestamp" => Arc::new(Float32Array::from_iter_values(
                    frames.clone().map(|frame| (frame as f64 / self.fps) as f32),
                )),
                "frame_index" => int_array(frames.clone()),
                "episode_index" => int_array(frames.clone().map(|_| position.episode)),
                "index" => int_array(position.index..position.index + n_rows),
                "task_index" => int_array(tasks.iter().copied()),
                name => {
                    let array =
                        batch.column_by_name(name).ok_or_else(|| format!("no column {name:?} in a file"))?;
                    // Annotations of GR00T point into the task table.
                    let is_task = name.starts_with("annotation.") && self.moves_tasks(source);
                    if is_task && array.data_type().is_integer() {
                        let numbers = int_array(self.task_numbers(input, source, batch, name)?);
                        cast(&numbers, field.data_type()).map_err(|e| e.to_string())?
                    } else if array.data_type() == field.data_type() {
                        Arc::clone(array)
                    } else {
                        cast(array, field.data_type()).map_err(|e| e.to_string())?
                    }
                }
            };
            arrays.push(array);
        }
        RecordBatch::try_new(self.arrow.clone(), arrays).map_err(|error| error.to_string())
    }

    /// Returns the number of a task, which is new if it must be.
    fn task_number(&mut self, task: &str) -> i64 {
        let known = self.tasks.iter().position(|other| other == task);
        known.unwrap_or_else(|| {
            self.tasks.push(task.to_owned());
            self.tasks.len() - 1
        }) as i64
    }

    /// Returns whether the tasks of an input have other numbers in the output.
    fn moves_tasks(&self, source: usize) -> bool {
        self.task_numbers[source].iter().enumerate().any(|(old, new)| old as i64 != *new)
    }

    /// Returns the output's numbers of the tasks that a column names.
    fn task_numbers(
        &self,
        input: &Input,
        source: usize,
        batch: &RecordBatch,
        name: &str,
    ) -> Result<Vec<i64>, String> {
        let Some(array) = batch.column_by_name(name) else {
            return Ok(vec![0; batch.num_rows()]);
        };
        let array = cast(array, &DataType::Int64).map_err(|e| e.to_string())?;
        let array = array.as_any().downcast_ref::<Int64Array>().filter(|array| array.null_count() == 0);
        let array = array.ok_or_else(|| format!("column {name:?} has nulls"))?;
        let numbers = &self.task_numbers[source];
        let new = |&old: &i64| {
            let known = usize::try_from(old).ok().and_then(|old| numbers.get(old));
            match known {
                Some(new) => Ok(*new),
                // An annotation need not be a task.
                None if name != "task_index" || input.dataset.tasks.is_empty() => Ok(old),
                None => Err(format!("task_index {old} is not in the task table of {} tasks", numbers.len())),
            }
        };
        array.values().iter().map(new).collect()
    }

    fn open(&mut self) -> Result<(), EditError> {
        if self.file.is_some() {
            return Ok(());
        }
        let path = self.dir.join(data_path(self.n_files));
        if let Some(folder) = path.parent() {
            fs::create_dir_all(folder).map_err(EditError::io("create", folder))?;
        }
        let file = self.disk.create(&path).map_err(EditError::io("create", &path))?;
        let properties = image_properties(self.images.iter().map(String::as_str)).build();
        let writer = ArrowWriter::try_new(file, self.arrow.clone(), Some(properties))
            .map_err(WriteError::parquet(&path))?;
        self.file = Some((writer, path));
        Ok(())
    }

    fn append(&mut self, rows: &RecordBatch) -> Result<(), EditError> {
        let Some((writer, path)) = self.file.as_mut() else { return Ok(()) };
        if writer.in_progress_rows() > 0
            && writer.in_progress_size() + rows.get_array_memory_size() > ROW_GROUP_BYTES
        {
            writer.flush().map_err(WriteError::parquet(path))?;
        }
        Ok(writer.write(rows).map_err(WriteError::parquet(path))?)
    }

    fn end_episode(&mut self) -> Result<(), EditError> {
        let Some((writer, path)) = self.file.as_mut() else { return Ok(()) };
        writer.flush().map_err(WriteError::parquet(path))?;
        if writer.bytes_written() >= FILE_BYTES {
            self.close()?;
        }
        Ok(())
    }

    fn close(&mut self) -> Result<(), EditError> {
        let Some((mut writer, path)) = self.file.take() else { return Ok(()) };
        self.n_files += 1;
        let mut finish = || -> Result<(), parquet::errors::ParquetError> {
            writer.finish()?;
            writer.sync()?;
            Ok(writer.inner_mut().sync()?)
        };
        finish().map_err(WriteError::parquet(&path))?;
        sync_parent(&path).map_err(EditError::io("sync", &path))
    }
}

/// Where a batch is in the output.
#[derive(Debug, Clone, Copy)]
struct Position {
    episode: i64,
    frame: i64,
    index: i64,
}

/// Returns the columns of the output: numbers first, then those of the first file that are declared.
fn output_schema(first: &ArrowSchema, is_declared: impl Fn(&str) -> bool) -> SchemaRef {
    let number = |name: &&str| {
        Field::new(*name, if *name == "timestamp" { DataType::Float32 } else { DataType::Int64 }, false)
    };
    let mut fields: Vec<Field> = NUMBERED.iter().map(number).collect();
    let others = first.fields().iter().filter(|field| !NUMBERED.contains(&field.name().as_str()));
    fields.extend(others.filter(|field| is_declared(field.name())).map(|field| field.as_ref().clone()));
    let metadata = first.metadata().iter().filter(|(key, _)| *key == "huggingface");
    Arc::new(ArrowSchema::new_with_metadata(
        fields,
        metadata.map(|(key, value)| (key.clone(), value.clone())).collect(),
    ))
}

/// Returns the tasks of all inputs, each once, and per input the number of each of its tasks.
fn joined_tasks(inputs: &[Input]) -> (Vec<String>, Vec<Vec<i64>>) {
    let mut tasks: Vec<String> = inputs[0].dataset.tasks.clone();
    let mut numbers: Vec<Vec<i64>> = vec![(0..tasks.len() as i64).collect()];
    for input in &inputs[1..] {
        let number = |task: &String| {
            let known = tasks.iter().position(|other| other == task);
            known.unwrap_or_else(|| {
                tasks.push(task.clone());
                tasks.len() - 1
            }) as i64
        };
        numbers.push(input.dataset.tasks.iter().map(number).collect());
    }
    (tasks, numbers)
}
