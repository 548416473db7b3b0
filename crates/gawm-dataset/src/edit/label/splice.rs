//! A data file with other tasks: the column `task_index` is written anew, the bytes of all others are copied.

use std::fs::File;
use std::path::Path;

use arrow::array::{Array, AsArray};
use arrow::datatypes::Int64Type as ArrowInt64;
use parquet::column::writer::ColumnCloseResult;
use parquet::data_type::Int64Type;
use parquet::errors::ParquetError;
use parquet::file::metadata::{PageIndexPolicy, ParquetMetaData, ParquetMetaDataReader, RowGroupMetaData};
use parquet::file::page_index::column_index::ColumnIndexMetaData;
use parquet::file::properties::WriterProperties;
use parquet::file::writer::{SerializedFileWriter, SerializedRowGroupWriter};
use parquet::schema::types::ColumnPath;

use crate::columns::numeric_properties;
use crate::durable::{Disk, DiskFile};
use crate::read::checked_builder;

/// The column that is written anew.
const COLUMN: &str = "task_index";

/// Rows of one episode in a data file, and their task.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct TaskRows {
    /// First row in the file.
    pub(super) start: u64,
    /// One behind the last.
    pub(super) end: u64,
    /// Row of the task table.
    pub(super) task: i64,
}

/// Copies a data file with other tasks in these rows; returns its length.
pub(super) fn splice(
    source: &Path,
    target: &Path,
    disk: &Disk,
    changes: &[TaskRows],
) -> Result<u64, ParquetError> {
    let file = File::open(source)?;
    let metadata = ParquetMetaDataReader::new()
        .with_page_index_policy(PageIndexPolicy::Optional)
        .parse_and_finish(&file)?;
    let new = disk.create(target)?;
    let schema = metadata.file_metadata().schema_descr().root_schema_ptr();
    let mut writer = SerializedFileWriter::new(new, schema, properties(&metadata).into())?;
    let mut first_row = 0;
    for group in 0..metadata.num_row_groups() {
        let row_group = metadata.row_group(group);
        let mut out = writer.next_row_group()?;
        for column in 0..row_group.num_columns() {
            if row_group.column(column).column_path().string() == COLUMN {
                write_tasks(&mut out, source, group, first_row, changes)?;
            } else {
                copy_column(&mut out, &file, &metadata, group, column)?;
            }
        }
        out.close()?;
        first_row += row_group.num_rows().unsigned_abs();
    }
    writer.finish()?;
    let length = writer.bytes_written() as u64;
    let file: &mut DiskFile = writer.inner_mut();
    std::io::Write::flush(file)?;
    file.sync()?;
    Ok(length)
}

/// Returns how the new file is written: what its footer says stays, and so does the way of the column.
fn properties(metadata: &ParquetMetaData) -> WriterProperties {
    let footer = metadata.file_metadata();
    let mut properties = numeric_properties()
        .set_key_value_metadata(footer.key_value_metadata().cloned())
        .set_column_dictionary_enabled(ColumnPath::new(vec![COLUMN.to_owned()]), true);
    if let Some(by) = footer.created_by() {
        properties = properties.set_created_by(by.to_owned());
    }
    properties.build()
}

fn copy_column(
    out: &mut SerializedRowGroupWriter<'_, DiskFile>,
    file: &File,
    metadata: &ParquetMetaData,
    group: usize,
    column: usize,
) -> Result<(), ParquetError> {
    let row_group: &RowGroupMetaData = metadata.row_group(group);
    let chunk = row_group.column(column).clone();
    let column_index = metadata.column_index().and_then(|index| index.get(group)?.get(column)).cloned();
    let close = ColumnCloseResult {
        bytes_written: chunk.compressed_size().unsigned_abs(),
        rows_written: row_group.num_rows().unsigned_abs(),
        metadata: chunk,
        bloom_filter: None,
        column_index: column_index.filter(|index| !matches!(index, ColumnIndexMetaData::NONE)),
        offset_index: metadata.offset_index().and_then(|index| index.get(group)?.get(column)).cloned(),
    };
    out.append_column(file, close)
}

fn write_tasks(
    out: &mut SerializedRowGroupWriter<'_, DiskFile>,
    source: &Path,
    group: usize,
    first_row: u64,
    changes: &[TaskRows],
) -> Result<(), ParquetError> {
    let mut tasks = read_tasks(source, group)?;
    for (at, task) in tasks.iter_mut().enumerate() {
        let row = first_row + at as u64;
        if let Some(change) = changes.iter().find(|change| (change.start..change.end).contains(&row)) {
            *task = change.task;
        }
    }
    let mut writer =
        out.next_column()?.ok_or_else(|| ParquetError::General(format!("no room for {COLUMN}")))?;
    writer.typed::<Int64Type>().write_batch(&tasks, None, None)?;
    writer.close()
}

fn read_tasks(source: &Path, group: usize) -> Result<Vec<i64>, ParquetError> {
    let builder = checked_builder(source, |name| name == COLUMN)?;
    let mut tasks = Vec::new();
    for batch in builder.with_row_groups(vec![group]).build()? {
        let batch = batch?;
        let array = batch.column_by_name(COLUMN).and_then(|array| array.as_primitive_opt::<ArrowInt64>());
        let array = array.filter(|array| array.null_count() == 0);
        let array =
            array.ok_or_else(|| ParquetError::General(format!("{COLUMN} is not Int64, or has nulls")))?;
        tasks.extend(array.values());
    }
    Ok(tasks)
}
