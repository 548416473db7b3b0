//! The rows of a piece, batch by batch.

use arrow::array::RecordBatch;
use parquet::arrow::arrow_reader::{ParquetRecordBatchReaderBuilder, RowSelection, RowSelector};

use super::{EditError, Input, Piece};
use crate::read::{Dataset, check_pages, guarded};

/// Bytes that a batch aims at.
const BATCH_BYTES: u64 = 8 << 20;
/// Most rows of a batch.
const MAX_BATCH_ROWS: u64 = 1024;

/// Calls `take` with all columns of the rows of a piece, in order.
///
/// A batch holds about 8 MiB, whatever the rows hold.
pub(super) fn for_each_batch(
    input: &Input,
    piece: &Piece,
    mut take: impl FnMut(RecordBatch) -> Result<(), EditError>,
) -> Result<(), EditError> {
    let dataset = &input.dataset;
    let run = dataset.runs[piece.run];
    let file = &dataset.files[run.file];
    let unreadable = |got: String| EditError::Damaged {
        path: dataset.root.clone(),
        place: file.relative.clone(),
        expected: format!("the rows of episode {}", run.episode_index),
        got,
    };
    let (from, to) = (run.start + piece.rows.start, run.start + piece.rows.end.min(run.n_rows));
    let mut reader = guarded(|| open(dataset, run.file, from, to)).map_err(unreadable)?;
    let mut n_rows = 0;
    // A panic of the Parquet reader is an error like others; one of `take` is ours.
    while let Some(batch) =
        guarded(|| reader.next().transpose().map_err(|e| e.to_string())).map_err(unreadable)?
    {
        n_rows += batch.num_rows() as u64;
        take(batch)?;
    }
    if n_rows == to - from { Ok(()) } else { Err(unreadable(format!("{n_rows} of {} rows", to - from))) }
}

fn open(
    dataset: &Dataset,
    index: usize,
    from: u64,
    to: u64,
) -> Result<parquet::arrow::arrow_reader::ParquetRecordBatchReader, String> {
    let file = &dataset.files[index];
    let (handle, metadata) = dataset.open_file(index)?;
    let (mut groups, mut skipped, mut start, mut bytes) = (Vec::new(), 0, 0, 0u64);
    for (group, n_rows) in file.row_groups.iter().enumerate() {
        let end = start + n_rows;
        if end <= from {
            skipped = end;
        } else if start < to {
            groups.push(group);
            bytes =
                bytes.saturating_add(metadata.metadata().row_group(group).total_byte_size().max(0) as u64);
        }
        start = end;
    }
    let n_rows: u64 = groups.iter().map(|group| file.row_groups[*group]).sum();
    let row_bytes = (bytes / n_rows.max(1)).max(1);
    let batch_rows = (BATCH_BYTES / row_bytes).clamp(1, MAX_BATCH_ROWS);
    let selection = RowSelection::from(vec![
        RowSelector::skip((from - skipped) as usize),
        RowSelector::select((to - from) as usize),
    ]);
    let mask = parquet::arrow::ProjectionMask::all();
    let most_rows = check_pages(&handle, metadata.metadata(), groups.iter().copied(), &mask)?;
    ParquetRecordBatchReaderBuilder::new_with_metadata(handle, metadata)
        .with_row_groups(groups)
        .with_row_selection(selection)
        .with_batch_size(most_rows.min(batch_rows as usize))
        .build()
        .map_err(|error| error.to_string())
}
