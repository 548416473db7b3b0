//! One data file that is being written.

use std::fs::{self, File};
use std::path::{Path, PathBuf};

use parquet::arrow::ArrowWriter;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::errors::ParquetError;

use crate::block::{BlockPosition, RowBlock};
use crate::columns::Columns;
use crate::durable::{Disk, DiskFile, temporary};

/// A row group is closed before it would hold more than this.
pub(crate) const ROW_GROUP_BYTES: u64 = 32 << 20;

/// A Parquet file under its temporary name.
pub(crate) struct DataFile {
    path: PathBuf,
    disk: Disk,
    writer: ArrowWriter<DiskFile>,
    mark: FileMark,
    /// Bytes of rows in the open row group, before encoding.
    group_bytes: u64,
}

/// A place between two row groups.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct FileMark {
    /// Closed row groups before it.
    n_groups: usize,
    /// Rows before it.
    n_rows: u64,
}

impl DataFile {
    /// Creates the file.
    pub(crate) fn create(disk: &Disk, path: &Path, columns: &Columns) -> Result<DataFile, ParquetError> {
        let file = disk.create(path)?;
        let writer = ArrowWriter::try_new(file, columns.arrow.clone(), Some(columns.writer_properties()))?;
        let mark = FileMark { n_groups: 0, n_rows: 0 };
        Ok(DataFile { path: path.to_owned(), disk: disk.clone(), writer, mark, group_bytes: 0 })
    }

    /// Returns the temporary path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of rows.
    pub(crate) fn n_rows(&self) -> u64 {
        self.mark.n_rows
    }

    /// Returns the present place; no row group is open between episodes.
    pub(crate) fn mark(&self) -> FileMark {
        self.mark
    }

    /// Returns the bytes that are in closed row groups.
    pub(crate) fn bytes_written(&self) -> u64 {
        self.writer.bytes_written() as u64
    }

    /// Returns whether the open row group has room for so many bytes; an empty one always has.
    pub(crate) fn has_room(&self, bytes: u64) -> bool {
        self.group_bytes == 0 || self.group_bytes + bytes <= ROW_GROUP_BYTES
    }

    /// Appends rows to the open row group.
    pub(crate) fn write(
        &mut self,
        columns: &Columns,
        block: &RowBlock,
        position: BlockPosition,
        bytes: u64,
    ) -> Result<(), ParquetError> {
        self.writer.write(&block.to_arrow(columns, position)?)?;
        self.mark.n_rows += block.len() as u64;
        self.group_bytes += bytes;
        Ok(())
    }

    /// Closes the open row group.
    pub(crate) fn end_row_group(&mut self) -> Result<(), ParquetError> {
        if self.group_bytes > 0 {
            self.mark.n_groups += 1;
            self.group_bytes = 0;
        }
        self.writer.flush()?;
        self.writer.inner_mut().sync_early()?;
        Ok(())
    }

    /// Writes the footer, waits until all is on the disk and returns the length of the file.
    pub(crate) fn close(mut self) -> Result<u64, ParquetError> {
        self.writer.finish()?;
        let length = self.writer.bytes_written() as u64;
        self.writer.sync()?;
        self.writer.inner_mut().sync()?;
        Ok(length)
    }

    /// Gives up all rows behind a mark; `None` when nothing is left. Parquet cannot take rows back, so what stays is
    /// copied row group by row group: slow, and rare.
    pub(crate) fn rewind(
        mut self,
        columns: &Columns,
        mark: FileMark,
    ) -> Result<Option<DataFile>, ParquetError> {
        if mark == self.mark && self.group_bytes == 0 {
            return Ok(Some(self));
        }
        if mark.n_groups == 0 {
            fs::remove_file(&self.path)?;
            return Ok(None);
        }
        self.writer.finish()?;
        self.writer.sync()?;
        let target = temporary(&self.path);
        let mut copy = DataFile::create(&self.disk, &target, columns)?;
        for group in 0..mark.n_groups {
            let source = ParquetRecordBatchReaderBuilder::try_new(File::open(&self.path)?)?;
            let batches = source.with_row_groups(vec![group]).with_batch_size(BATCH_ROWS).build()?;
            for batch in batches {
                copy.writer.write(&batch?)?;
            }
            copy.writer.flush()?;
        }
        copy.mark = mark;
        fs::rename(&target, &self.path)?;
        copy.path = self.path;
        Ok(Some(copy))
    }
}

/// Rows that are copied at once.
const BATCH_ROWS: usize = 256;
