//! One data file that is being written.

use std::path::{Path, PathBuf};

use parquet::arrow::ArrowWriter;
use parquet::errors::ParquetError;

use crate::block::{BlockPosition, RowBlock};
use crate::columns::Columns;
use crate::durable::{Disk, DiskFile};

/// A row group is closed before it would hold more than this.
pub(crate) const ROW_GROUP_BYTES: u64 = 32 << 20;

/// A Parquet file under its temporary name.
pub(crate) struct DataFile {
    path: PathBuf,
    writer: ArrowWriter<DiskFile>,
    n_rows: u64,
    /// Bytes of rows in the open row group, before encoding.
    group_bytes: u64,
}

impl DataFile {
    /// Creates the file.
    pub(crate) fn create(disk: &Disk, path: &Path, columns: &Columns) -> Result<DataFile, ParquetError> {
        let file = disk.create(path)?;
        let writer = ArrowWriter::try_new(file, columns.arrow.clone(), Some(columns.writer_properties()))?;
        Ok(DataFile { path: path.to_owned(), writer, n_rows: 0, group_bytes: 0 })
    }

    /// Returns the temporary path.
    pub(crate) fn path(&self) -> &Path {
        &self.path
    }

    /// Returns the number of rows.
    pub(crate) fn n_rows(&self) -> u64 {
        self.n_rows
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
        self.n_rows += block.len() as u64;
        self.group_bytes += bytes;
        Ok(())
    }

    /// Closes the open row group.
    pub(crate) fn end_row_group(&mut self) -> Result<(), ParquetError> {
        self.group_bytes = 0;
        self.writer.flush()
    }

    /// Writes the footer, waits until all is on the disk and returns the length of the file.
    pub(crate) fn close(mut self) -> Result<u64, ParquetError> {
        self.writer.finish()?;
        let length = self.writer.bytes_written() as u64;
        self.writer.sync()?;
        self.writer.inner().sync()?;
        Ok(length)
    }
}
