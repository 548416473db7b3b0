//! Finds a row of a dataset and where it comes from.

use std::path::Path;

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float32Type, Float64Type, Int64Type};
use gawm_dataset::layout::{AGE_MS, ARRIVAL_AGE_MS, GAWM, TIME_NS, VALID, data_path, encoded_path};
use gawm_dataset::read::checked_builder;
use gawm_dataset::{GawmMeta, RecordingRecord};
use gawm_schema::Feature;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::ExplainError;

/// Where a value stands and what is known of it.
pub(crate) struct RowOrigin {
    pub(crate) recording: RecordingRecord,
    /// Data file, relative to the dataset, and its number.
    pub(crate) file: String,
    pub(crate) file_number: u64,
    /// Row within the file.
    pub(crate) row: u64,
    pub(crate) time_ns: i64,
    /// Time of the next row of the episode.
    pub(crate) next_ns: Option<i64>,
    /// The value; none for images.
    pub(crate) value: Option<f64>,
    pub(crate) image_bytes: Option<usize>,
    pub(crate) is_valid: bool,
    /// Sample ages per stream.
    pub(crate) age_ms: Vec<f32>,
    pub(crate) arrival_age_ms: Vec<f32>,
}

impl RowOrigin {
    /// Returns whether it is the last row of its episode.
    pub(crate) fn is_last(&self) -> bool {
        self.next_ns.is_none()
    }

    pub(crate) fn files(&self) -> Vec<String> {
        self.recording
            .source
            .files
            .iter()
            .map(|file| format!("{} ({})", file.name, file.content_hash))
            .collect()
    }
}

/// Reads `meta/gawm.json`.
pub(crate) fn meta(dir: &Path) -> Result<GawmMeta, ExplainError> {
    let path = dir.join(GAWM);
    let fail = |detail: String| ExplainError::Dataset { path: path.clone(), detail };
    let text = std::fs::read_to_string(&path).map_err(|error| fail(error.to_string()))?;
    serde_json::from_str(&text).map_err(|error| fail(error.to_string()))
}

/// Finds the row.
pub(crate) fn origin(
    dir: &Path,
    meta: &GawmMeta,
    (wanted_episode, wanted_frame): (u64, u64),
    feature: &Feature,
    index: Option<usize>,
) -> Result<RowOrigin, ExplainError> {
    let episodes: u64 = meta.recordings.iter().map(|recording| recording.episodes).sum();
    let recording = meta
        .recordings
        .iter()
        .find(|recording| {
            (recording.first_episode..recording.first_episode + recording.episodes).contains(&wanted_episode)
        })
        .ok_or(ExplainError::Episode { episode: wanted_episode, episodes })?;
    let mut length = 0;
    let mut found: Option<RowOrigin> = None;
    for file in &recording.files {
        let path = dir.join(data_path(file.number));
        let mut row = 0;
        read(&path, feature, &mut |batch| {
            let column = |name: &str| {
                batch.column_by_name(name).and_then(|column| column.as_primitive_opt::<Int64Type>().cloned())
            };
            let (Some(episode), Some(frame), Some(time)) =
                (column("episode_index"), column("frame_index"), column(TIME_NS))
            else {
                return;
            };
            for at in 0..batch.num_rows() {
                if u64::try_from(episode.value(at)) == Ok(wanted_episode) {
                    length += 1;
                    let number = u64::try_from(frame.value(at)).unwrap_or_default();
                    if number == wanted_frame {
                        let file_number = file.number;
                        let file = data_path(file_number).display().to_string();
                        let (value, image_bytes) = value_of(batch, feature, index, at);
                        found = Some(RowOrigin {
                            recording: recording.clone(),
                            file,
                            file_number,
                            row,
                            time_ns: time.value(at),
                            next_ns: None,
                            value,
                            image_bytes,
                            is_valid: valid_of(batch, feature, at),
                            age_ms: ages_of(batch, AGE_MS, at),
                            arrival_age_ms: ages_of(batch, ARRIVAL_AGE_MS, at),
                        });
                    } else if number == wanted_frame + 1
                        && let Some(found) = &mut found
                    {
                        found.next_ns = Some(time.value(at));
                    }
                }
                row += 1;
            }
        })?;
    }
    found.ok_or(ExplainError::Frame { episode: wanted_episode, frame: wanted_frame, length })
}

fn read(path: &Path, feature: &Feature, take: &mut dyn FnMut(&RecordBatch)) -> Result<(), ExplainError> {
    let fail = |detail: String| ExplainError::Dataset { path: path.to_owned(), detail };
    let valid = format!("{VALID}{}", feature.name);
    let wanted = ["episode_index", "frame_index", TIME_NS, AGE_MS, ARRIVAL_AGE_MS, &feature.name, &valid];
    let reader = checked_builder(path, |name| wanted.contains(&name))
        .and_then(ParquetRecordBatchReaderBuilder::build)
        .map_err(|error| fail(error.to_string()))?;
    for batch in reader {
        take(&batch.map_err(|error| fail(error.to_string()))?);
    }
    Ok(())
}

/// The values of an encoded column in a row.
#[derive(Debug, Default)]
pub(crate) struct EncodedRow {
    /// As in `data/`.
    pub(crate) plain: Vec<f64>,
    /// As in `gawm/encoded/`; empty where that was deleted.
    pub(crate) standardised: Vec<f64>,
}

/// Reads an encoded column in the row of a frame; `number` is that of the data file.
pub(crate) fn encoded(dir: &Path, number: u64, column: &str, (episode, frame): (u64, u64)) -> EncodedRow {
    let row = |path: std::path::PathBuf| {
        let wanted = ["episode_index", "frame_index", column];
        let reader = checked_builder(&path, |name| wanted.contains(&name))
            .and_then(ParquetRecordBatchReaderBuilder::build)
            .ok()?;
        reader.map_while(Result::ok).find_map(|batch| {
            let position = |name: &str| {
                batch.column_by_name(name).and_then(|column| column.as_primitive_opt::<Int64Type>().cloned())
            };
            let (episodes, frames) = (position("episode_index")?, position("frame_index")?);
            let is_wanted = |at: &usize| {
                u64::try_from(episodes.value(*at)) == Ok(episode)
                    && u64::try_from(frames.value(*at)) == Ok(frame)
            };
            let at = (0..batch.num_rows()).find(is_wanted)?;
            Some(numbers(batch.column_by_name(column)?.as_ref(), at))
        })
    };
    let plain = row(dir.join(data_path(number))).unwrap_or_default();
    EncodedRow { plain, standardised: row(dir.join(encoded_path(number))).unwrap_or_default() }
}

fn value_of(
    batch: &RecordBatch,
    feature: &Feature,
    index: Option<usize>,
    row: usize,
) -> (Option<f64>, Option<usize>) {
    let Some(column) = batch.column_by_name(&feature.name) else { return (None, None) };
    match index {
        None => {
            let bytes = column.as_struct_opt().and_then(|image| image.column_by_name("bytes").cloned());
            (None, bytes.map(|bytes| bytes.as_binary::<i32>().value_length(row) as usize))
        }
        Some(index) => (numbers(column.as_ref(), row).get(index).copied(), None),
    }
}

fn numbers(column: &dyn Array, row: usize) -> Vec<f64> {
    let items = if let Some(list) = column.as_list_opt::<i32>() {
        list.value(row)
    } else if let Some(list) = column.as_fixed_size_list_opt() {
        list.value(row)
    } else {
        column.slice(row, 1)
    };
    if let Some(values) = items.as_primitive_opt::<Float64Type>() {
        values.values().to_vec()
    } else if let Some(values) = items.as_primitive_opt::<Float32Type>() {
        values.values().iter().map(|value| f64::from(*value)).collect()
    } else {
        Vec::new()
    }
}

fn valid_of(batch: &RecordBatch, feature: &Feature, row: usize) -> bool {
    let column = batch.column_by_name(&format!("{VALID}{}", feature.name));
    column.and_then(|column| column.as_boolean_opt().map(|valid| valid.value(row))).unwrap_or(true)
}

fn ages_of(batch: &RecordBatch, name: &str, row: usize) -> Vec<f32> {
    let Some(column) = batch.column_by_name(name) else { return Vec::new() };
    numbers(column.as_ref(), row).into_iter().map(|age| age as f32).collect()
}
