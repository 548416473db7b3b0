//! Counts the rows of data files again.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BooleanArray, Float32Array, Float64Array, Int64Array, ListArray, RecordBatch,
};

use crate::block::{RowBlock, StoredValues};
use crate::columns::Columns;
use crate::durable::temporary;
use crate::episode::EpisodeRecord;
use crate::error::WriteError;
use crate::layout::{VALID, data_path};
use crate::provenance::RecordingRecord;
use crate::read::checked_builder;
use crate::totals::Totals;

/// Rows that are read at once.
const BATCH_ROWS: usize = 1024;

/// Returns the statistics of a recording, equal to the bit to what they were when it was written.
pub(crate) fn scan_recording(
    dir: &Path,
    columns: &Columns,
    recording: &RecordingRecord,
    episodes: &[EpisodeRecord],
) -> Result<Totals, WriteError> {
    let mut scan = Scan { columns, episodes, totals: Totals::new(columns), open: None };
    for file in &recording.files {
        let path = existing_path(dir, file.number);
        scan.file(&path, file.frames)?;
    }
    scan.end_episode();
    Ok(scan.totals)
}

/// Returns the path of a data file: an unfinished run leaves it under its temporary name.
pub(crate) fn existing_path(dir: &Path, number: u64) -> std::path::PathBuf {
    let path = dir.join(data_path(number));
    let unfinished = temporary(&path);
    if unfinished.exists() { unfinished } else { path }
}

struct Scan<'a> {
    columns: &'a Columns,
    episodes: &'a [EpisodeRecord],
    totals: Totals,
    /// Number and statistics of the episode that is being read.
    open: Option<(usize, Totals)>,
}

impl Scan<'_> {
    fn file(&mut self, path: &Path, frames: u64) -> Result<(), WriteError> {
        let damaged = |reason: String| WriteError::Damaged { path: path.to_owned(), reason };
        File::open(path).map_err(WriteError::io("open", path))?;
        let images: Vec<&str> = self.columns.images.iter().map(|image| image.name.as_str()).collect();
        let builder =
            checked_builder(path, |name| !images.contains(&name)).map_err(WriteError::parquet(path))?;
        let n_rows = builder.metadata().file_metadata().num_rows();
        if u64::try_from(n_rows) != Ok(frames) {
            return Err(damaged(format!("expected {frames} rows, got {n_rows}")));
        }
        let reader = builder.with_batch_size(BATCH_ROWS).build().map_err(WriteError::parquet(path))?;
        for batch in reader {
            let batch = batch.map_err(|error| WriteError::parquet(path)(error.into()))?;
            self.batch(&batch).map_err(damaged)?;
        }
        Ok(())
    }

    /// Counts the rows of a batch, cut where an episode ends.
    fn batch(&mut self, batch: &RecordBatch) -> Result<(), String> {
        let numbers: &Int64Array = column(batch, "episode_index")?;
        let mut start = 0;
        while start < batch.num_rows() {
            let number = numbers.value(start);
            let end = (start..batch.num_rows()).find(|&row| numbers.value(row) != number);
            let end = end.unwrap_or(batch.num_rows());
            let number = usize::try_from(number).ok().filter(|&n| n < self.episodes.len());
            let number = number.ok_or("episode_index is not in the episode table".to_owned())?;
            if self.open.as_ref().is_none_or(|(open, _)| *open != number) {
                self.end_episode();
                self.open = Some((number, Totals::new(self.columns)));
            }
            let block = read_block(self.columns, &batch.slice(start, end - start))?;
            if let Some((_, totals)) = &mut self.open {
                totals.update(self.columns, &block);
            }
            start = end;
        }
        Ok(())
    }

    fn end_episode(&mut self) {
        if let Some((number, mut totals)) = self.open.take() {
            totals.end_episode(self.episodes[number].is_training);
            self.totals.merge(&totals);
        }
    }
}

/// Returns the numeric columns of a batch as a block.
fn read_block(columns: &Columns, batch: &RecordBatch) -> Result<RowBlock, String> {
    let mut block = RowBlock::new(columns);
    block.time_ns = column::<Int64Array>(batch, crate::layout::TIME_NS)?.values().to_vec();
    for (plan, values) in columns.vectors.iter().zip(&mut block.vectors) {
        *values = vector_values(batch, &plan.name, plan.width())?;
    }
    for (plan, values) in columns.encoded.iter().zip(&mut block.encoded) {
        *values = vector_values(batch, plan.name, plan.encoder.width())?;
    }
    for (name, valid) in columns.valid_names.iter().zip(&mut block.valid) {
        *valid = column::<BooleanArray>(batch, &format!("{VALID}{name}"))?.values().iter().collect();
    }
    Ok(block)
}

/// Returns a vector column, whose lists must all have the width.
pub(crate) fn vector_values(batch: &RecordBatch, name: &str, width: usize) -> Result<StoredValues, String> {
    let array = batch.column_by_name(name).ok_or_else(|| format!("column {name:?} is missing"))?;
    let items: ArrayRef = match array.as_any().downcast_ref::<ListArray>() {
        Some(list) if list.null_count() == 0 => {
            let offsets = list.value_offsets();
            if offsets.windows(2).any(|pair| (pair[1] - pair[0]) as usize != width) {
                return Err(format!("column {name:?} has a list that is not of length {width}"));
            }
            let (start, end) = (offsets.first().copied().unwrap_or(0), offsets.last().copied().unwrap_or(0));
            list.values().slice(start as usize, (end - start) as usize)
        }
        Some(_) => return Err(format!("column {name:?} has nulls")),
        None if width == 1 => Arc::clone(array),
        None => return Err(format!("column {name:?} is {}, expected lists", array.data_type())),
    };
    if items.null_count() > 0 {
        return Err(format!("column {name:?} has nulls"));
    }
    if let Some(values) = items.as_any().downcast_ref::<Float32Array>() {
        return Ok(StoredValues::F32(values.values().to_vec()));
    }
    let values = items.as_any().downcast_ref::<Float64Array>();
    let values =
        values.ok_or_else(|| format!("column {name:?} holds {}, expected floats", items.data_type()))?;
    Ok(StoredValues::F64(values.values().to_vec()))
}

pub(crate) fn column<'a, A: Array + 'static>(batch: &'a RecordBatch, name: &str) -> Result<&'a A, String> {
    let array = batch.column_by_name(name).ok_or_else(|| format!("column {name:?} is missing"))?;
    let typed = array.as_any().downcast_ref::<A>().filter(|array| array.null_count() == 0);
    typed.ok_or_else(|| format!("column {name:?} is {} or has nulls", array.data_type()))
}
