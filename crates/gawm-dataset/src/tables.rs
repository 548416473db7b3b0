//! The two Parquet tables of the meta folder: tasks and episodes.

use std::collections::{BTreeMap, HashMap};
use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BooleanArray, Float64Array, Int64Array, ListArray, RecordBatch, StringArray,
};
use arrow::buffer::OffsetBuffer;
use arrow::datatypes::{DataType, Field, Schema as ArrowSchema};
use arrow::error::ArrowError;
use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use crate::block::int_array;
use crate::columns::{item_field, numeric_properties};
use crate::episode::{EpisodeRecord, FeatureStats};
use crate::error::WriteError;
use crate::layout::file_position;
use crate::read::checked_builder;

/// What pandas needs to make `task` the index; LeRobot looks tasks up by it.
const PANDAS: &str = r#"{"index_columns":["task"],"column_indexes":[],"columns":[{"name":"task_index","field_name":"task_index","pandas_type":"int64","numpy_type":"int64","metadata":null},{"name":"task","field_name":"task","pandas_type":"unicode","numpy_type":"object","metadata":null}],"creator":{"library":"gawm","version":"1"},"pandas_version":"2.2.0"}"#;

/// Returns meta/tasks.parquet.
pub(crate) fn tasks_table(tasks: &[String]) -> Result<Vec<u8>, WriteError> {
    let metadata = HashMap::from([("pandas".to_owned(), PANDAS.to_owned())]);
    let fields =
        vec![Field::new("task_index", DataType::Int64, false), Field::new("task", DataType::Utf8, false)];
    let schema = Arc::new(ArrowSchema::new_with_metadata(fields, metadata));
    let columns: Vec<ArrayRef> =
        vec![int_array(0..tasks.len() as i64), Arc::new(StringArray::from_iter_values(tasks))];
    to_parquet(Path::new(crate::layout::TASKS), RecordBatch::try_new(schema, columns))
}

/// Returns meta/episodes/chunk-000/file-000.parquet.
pub(crate) fn episodes_table(episodes: &[EpisodeRecord], cameras: &[&str]) -> Result<Vec<u8>, WriteError> {
    let mut columns = plain_columns(episodes);
    let features: Vec<&String> = episodes.first().map(|e| e.stats.keys().collect()).unwrap_or_default();
    for feature in features {
        let default = FeatureStats::default();
        let stats: Vec<&FeatureStats> =
            episodes.iter().map(|e| e.stats.get(feature).unwrap_or(&default)).collect();
        columns.extend(stats_columns(feature, &stats, cameras.contains(&feature.as_str())));
    }
    let fields: Vec<Field> =
        columns.iter().map(|(name, array)| Field::new(name, array.data_type().clone(), false)).collect();
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    let schema = Arc::new(ArrowSchema::new(fields));
    to_parquet(Path::new(crate::layout::EPISODES), RecordBatch::try_new(schema, arrays))
}

fn plain_columns(episodes: &[EpisodeRecord]) -> Vec<(String, ArrayRef)> {
    let mut columns: Vec<(String, ArrayRef)> = Vec::new();
    let mut push = |name: &str, array: ArrayRef| columns.push((name.to_owned(), array));
    let ints = |value: fn(&EpisodeRecord) -> i64| int_array(episodes.iter().map(value));
    let bools = |value: fn(&EpisodeRecord) -> bool| {
        Arc::new(BooleanArray::from(episodes.iter().map(value).collect::<Vec<_>>())) as ArrayRef
    };
    push("episode_index", int_array(0..episodes.len() as i64));
    push("tasks", {
        let items = Arc::new(StringArray::from_iter_values(episodes.iter().map(|e| &e.task)));
        Arc::new(ListArray::new(
            item_field(DataType::Utf8),
            OffsetBuffer::from_repeated_length(1, episodes.len()),
            items,
            None,
        ))
    });
    push("length", ints(|e| e.length as i64));
    push("data/chunk_index", ints(|e| file_position(e.file).0 as i64));
    push("data/file_index", ints(|e| file_position(e.file).1 as i64));
    push("dataset_from_index", ints(|e| e.from_index as i64));
    push("dataset_to_index", ints(|e| (e.from_index + e.length) as i64));
    push("meta/episodes/chunk_index", ints(|_| 0));
    push("meta/episodes/file_index", ints(|_| 0));
    push("success", bools(|e| e.success == Some(true)));
    push("success_known", bools(|e| e.success.is_some()));
    let texts = |value: fn(&EpisodeRecord) -> String| {
        Arc::new(StringArray::from_iter_values(episodes.iter().map(value))) as ArrayRef
    };
    push("operator", texts(|e| e.operator.clone()));
    push("robot", texts(|e| e.robot.clone()));
    push("session", texts(|e| e.session.clone()));
    push("split", texts(|e| if e.is_training { "train" } else { "val" }.to_owned()));
    push("gawm/episode_id", texts(|e| e.id.clone()));
    push("gawm/recording", ints(|e| e.recording as i64));
    push("gawm/source_file", texts(|e| e.source_file.clone()));
    push("gawm/source_hash", texts(|e| e.source_hash.to_string()));
    push("gawm/start_ns", ints(|e| e.start_ns));
    push("gawm/end_ns", ints(|e| e.end_ns));
    push("gawm/content_hash", texts(|e| e.content_hash.to_string()));
    push("gawm/tags", texts(|e| serde_json::json!(e.tags).to_string()));
    columns
}

/// Returns the columns `stats/<feature>/...` of an episode table; those of a camera have shape (3, 1, 1).
pub(crate) fn stats_columns(
    feature: &str,
    stats: &[&FeatureStats],
    is_camera: bool,
) -> Vec<(String, ArrayRef)> {
    let mut columns = Vec::new();
    let names = FeatureStats::default().named().map(|(name, _)| name);
    for (position, name) in names.into_iter().enumerate() {
        let values: Vec<&[f64]> = stats.iter().map(|s| s.named()[position].1).collect();
        let items: ArrayRef =
            Arc::new(Float64Array::from_iter_values(values.iter().flat_map(|v| v.iter().copied())));
        let lengths = values.iter().map(|v| v.len());
        let array = if is_camera {
            // Shape (3, 1, 1): each value in two lists of one.
            let n_items = items.len();
            list_of(OffsetBuffer::from_lengths(lengths), list_of_ones(list_of_ones(items, n_items), n_items))
        } else {
            list_of(OffsetBuffer::from_lengths(lengths), items)
        };
        columns.push((format!("stats/{feature}/{name}"), array));
    }
    let counts = int_array(stats.iter().map(|s| s.count as i64));
    columns.push((format!("stats/{feature}/count"), list_of_ones(counts, stats.len())));
    columns
}

fn list_of_ones(items: ArrayRef, n_items: usize) -> ArrayRef {
    list_of(OffsetBuffer::from_repeated_length(1, n_items), items)
}

fn list_of(offsets: OffsetBuffer<i32>, items: ArrayRef) -> ArrayRef {
    Arc::new(ListArray::new(item_field(items.data_type().clone()), offsets, items, None))
}

/// Returns a table as Parquet.
pub(crate) fn to_parquet(path: &Path, batch: Result<RecordBatch, ArrowError>) -> Result<Vec<u8>, WriteError> {
    let mut bytes = Vec::new();
    let write = || {
        let batch = batch?;
        let mut writer =
            ArrowWriter::try_new(&mut bytes, batch.schema(), Some(numeric_properties().build()))?;
        writer.write(&batch)?;
        writer.close()
    };
    write().map_err(WriteError::parquet(path))?;
    Ok(bytes)
}

/// Reads the first `n_tasks` tasks of meta/tasks.parquet.
pub(crate) fn read_tasks(path: &Path, n_tasks: usize) -> Result<Vec<String>, WriteError> {
    let mut tasks = Vec::new();
    for batch in read_batches(path)? {
        let column = TableBatch { path, batch: &batch };
        let texts = column.texts("task")?;
        tasks.extend((0..batch.num_rows()).map(|row| texts.value(row).to_owned()));
    }
    if tasks.len() < n_tasks {
        return Err(damaged(path, format!("expected {n_tasks} tasks or more, got {}", tasks.len())));
    }
    tasks.truncate(n_tasks);
    Ok(tasks)
}

/// Reads the first `n_episodes` rows of the episode table.
pub(crate) fn read_episodes(path: &Path, n_episodes: usize) -> Result<Vec<EpisodeRecord>, WriteError> {
    let mut episodes = Vec::new();
    for batch in read_batches(path)? {
        let table = TableBatch { path, batch: &batch };
        for row in 0..batch.num_rows() {
            if episodes.len() == n_episodes {
                return Ok(episodes);
            }
            episodes.push(table.episode(row)?);
        }
    }
    if episodes.len() < n_episodes {
        return Err(damaged(path, format!("expected {n_episodes} episodes or more, got {}", episodes.len())));
    }
    Ok(episodes)
}

fn damaged(path: &Path, reason: String) -> WriteError {
    WriteError::Damaged { path: path.to_owned(), reason }
}

fn read_batches(path: &Path) -> Result<Vec<RecordBatch>, WriteError> {
    File::open(path).map_err(WriteError::io("open", path))?;
    let reader = checked_builder(path, |_| true)
        .and_then(ParquetRecordBatchReaderBuilder::build)
        .map_err(WriteError::parquet(path))?;
    reader.collect::<Result<_, _>>().map_err(|error| WriteError::parquet(path)(error.into()))
}

struct TableBatch<'a> {
    path: &'a Path,
    batch: &'a RecordBatch,
}

impl TableBatch<'_> {
    fn column<A: Array + 'static>(&self, name: &str) -> Result<&A, WriteError> {
        let column = self.batch.column_by_name(name);
        let array = column.and_then(|column| column.as_any().downcast_ref::<A>());
        match array {
            Some(array) if array.null_count() == 0 => Ok(array),
            Some(_) => Err(damaged(self.path, format!("column {name:?} has nulls, expected none"))),
            None => {
                let got = column.map_or("nothing".to_owned(), |c| c.data_type().to_string());
                Err(damaged(self.path, format!("column {name:?} has another type than expected: {got}")))
            }
        }
    }

    fn texts(&self, name: &str) -> Result<&StringArray, WriteError> {
        self.column(name)
    }

    fn text(&self, name: &str, row: usize) -> Result<String, WriteError> {
        Ok(self.texts(name)?.value(row).to_owned())
    }

    fn int(&self, name: &str, row: usize) -> Result<i64, WriteError> {
        Ok(self.column::<Int64Array>(name)?.value(row))
    }

    fn count(&self, name: &str, row: usize) -> Result<u64, WriteError> {
        let value = self.int(name, row)?;
        u64::try_from(value).map_err(|_negative| {
            damaged(self.path, format!("{name:?} is {value} in row {row}, expected 0 or more"))
        })
    }

    fn bool(&self, name: &str, row: usize) -> Result<bool, WriteError> {
        Ok(self.column::<BooleanArray>(name)?.value(row))
    }

    fn hash(&self, name: &str, row: usize) -> Result<gawm_schema::ContentHash, WriteError> {
        self.text(name, row)?.try_into().map_err(|error| damaged(self.path, format!("{name:?}: {error}")))
    }

    fn episode(&self, row: usize) -> Result<EpisodeRecord, WriteError> {
        let tasks = self.column::<ListArray>("tasks")?.value(row);
        let task = tasks.as_any().downcast_ref::<StringArray>().filter(|tasks| tasks.len() == 1);
        let task = task.ok_or_else(|| damaged(self.path, format!("expected one task in row {row}")))?;
        let tags = serde_json::from_str(&self.text("gawm/tags", row)?)
            .map_err(|error| damaged(self.path, format!("\"gawm/tags\" in row {row}: {error}")))?;
        let (chunk, file) = (self.count("data/chunk_index", row)?, self.count("data/file_index", row)?);
        Ok(EpisodeRecord {
            id: self.text("gawm/episode_id", row)?,
            task: task.value(0).to_owned(),
            length: self.count("length", row)?,
            file: chunk.saturating_mul(crate::layout::FILES_PER_CHUNK).saturating_add(file),
            from_index: self.count("dataset_from_index", row)?,
            success: self.bool("success_known", row)?.then_some(self.bool("success", row)?),
            operator: self.text("operator", row)?,
            robot: self.text("robot", row)?,
            session: self.text("session", row)?,
            is_training: self.text("split", row)? == "train",
            recording: self.count("gawm/recording", row)?,
            source_file: self.text("gawm/source_file", row)?,
            source_hash: self.hash("gawm/source_hash", row)?,
            start_ns: self.int("gawm/start_ns", row)?,
            end_ns: self.int("gawm/end_ns", row)?,
            content_hash: self.hash("gawm/content_hash", row)?,
            tags,
            stats: self.stats(row)?,
        })
    }

    fn stats(&self, row: usize) -> Result<BTreeMap<String, FeatureStats>, WriteError> {
        let mut stats: BTreeMap<String, FeatureStats> = BTreeMap::new();
        for field in self.batch.schema().fields() {
            let Some((feature, name)) = field.name().strip_prefix("stats/").and_then(|n| n.rsplit_once('/'))
            else {
                continue;
            };
            let values = flat_numbers(self.column::<ListArray>(field.name())?.value(row));
            let values =
                values.ok_or_else(|| damaged(self.path, format!("{:?} holds no numbers", field.name())))?;
            let entry = stats.entry(feature.to_owned()).or_default();
            match entry.slot(name) {
                Some(slot) => *slot = values,
                None => entry.count = values.first().map_or(0, |count| *count as u64),
            }
        }
        Ok(stats)
    }
}

/// Returns the numbers in lists of any depth.
fn flat_numbers(mut array: ArrayRef) -> Option<Vec<f64>> {
    while let Some(list) = array.as_any().downcast_ref::<ListArray>() {
        let offsets = list.value_offsets();
        let (start, end) = (*offsets.first()? as usize, *offsets.last()? as usize);
        let inner = list.values().slice(start, end - start);
        array = inner;
    }
    if let Some(floats) = array.as_any().downcast_ref::<Float64Array>() {
        return Some(floats.values().to_vec());
    }
    let ints = array.as_any().downcast_ref::<Int64Array>()?;
    Some(ints.values().iter().map(|&v| v as f64).collect())
}
