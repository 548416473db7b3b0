//! Result files: written whole or not at all, the same bytes for the same results.

use std::fs::{self, File};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{ArrayRef, Float64Array, RecordBatch, StringArray};
use serde::Serialize;
use thiserror::Error;

/// Why a result cannot be written.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum OutputError {
    /// The file system refuses.
    #[error("cannot write {path:?}: {cause}")]
    Io {
        /// File or folder.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// A table cannot be made.
    #[error("cannot write {path:?}: {message}")]
    Table {
        /// The file.
        path: PathBuf,
        /// What the library said.
        message: String,
    },
    /// A picture cannot be made.
    #[error("cannot write {path:?}: {cause}")]
    Image {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: gawm_image::ImageError,
    },
}

/// Writes a file under a temporary name, syncs it and renames it; makes the folder.
///
/// # Errors
/// - [`OutputError::Io`]; an older file is untouched then.
pub fn write(path: &Path, bytes: &[u8]) -> Result<(), OutputError> {
    let io = |cause| OutputError::Io { path: path.to_owned(), cause };
    if let Some(folder) = path.parent() {
        fs::create_dir_all(folder).map_err(io)?;
    }
    let mut temporary = path.as_os_str().to_owned();
    temporary.push(".tmp");
    let temporary = PathBuf::from(temporary);
    let mut file = File::create(&temporary).map_err(io)?;
    file.write_all(bytes).and_then(|()| file.sync_all()).map_err(io)?;
    fs::rename(&temporary, path).map_err(io)
}

/// Writes a value as indented JSON.
///
/// # Errors
/// - [`OutputError::Io`].
pub fn write_json(path: &Path, value: &impl Serialize) -> Result<(), OutputError> {
    let text = serde_json::to_string_pretty(value).expect("structs of numbers and texts become JSON");
    write(path, (text + "\n").as_bytes())
}

/// A table of named columns of equal length.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Table {
    columns: Vec<(String, Cells)>,
}

#[derive(Debug, Clone, PartialEq)]
enum Cells {
    Text(Vec<String>),
    Number(Vec<Option<f64>>),
}

impl Table {
    /// Adds a column of texts.
    #[must_use]
    pub fn text(mut self, name: &str, values: impl IntoIterator<Item = String>) -> Table {
        self.columns.push((name.to_owned(), Cells::Text(values.into_iter().collect())));
        self
    }

    /// Adds a column of numbers; `None` is an empty cell.
    #[must_use]
    pub fn number(mut self, name: &str, values: impl IntoIterator<Item = Option<f64>>) -> Table {
        self.columns.push((name.to_owned(), Cells::Number(values.into_iter().collect())));
        self
    }

    fn len(&self) -> usize {
        let lengths = self.columns.iter().map(|(_, cells)| match cells {
            Cells::Text(values) => values.len(),
            Cells::Number(values) => values.len(),
        });
        lengths.min().unwrap_or(0)
    }

    /// Returns the table as comma-separated values with a header; texts with commas or quotes are quoted.
    pub fn to_csv(&self) -> String {
        let quote = |text: &str| {
            if text.contains([',', '"', '\n']) {
                format!("\"{}\"", text.replace('"', "\"\""))
            } else {
                text.to_owned()
            }
        };
        let names: Vec<String> = self.columns.iter().map(|(name, _)| quote(name)).collect();
        let mut csv = names.join(",") + "\n";
        for row in 0..self.len() {
            let cell = |(_, cells): &(String, Cells)| match cells {
                Cells::Text(values) => quote(&values[row]),
                Cells::Number(values) => values[row].map(|value| value.to_string()).unwrap_or_default(),
            };
            csv += &(self.columns.iter().map(cell).collect::<Vec<_>>().join(",") + "\n");
        }
        csv
    }

    /// Writes `NAME.csv` and `NAME.parquet`.
    ///
    /// # Errors
    /// - [`OutputError`].
    pub fn write(&self, folder: &Path, name: &str) -> Result<(), OutputError> {
        write(&folder.join(format!("{name}.csv")), self.to_csv().as_bytes())?;
        let path = folder.join(format!("{name}.parquet"));
        let refuse = |message: String| OutputError::Table { path: path.clone(), message };
        let n = self.len();
        let column = |(name, cells): &(String, Cells)| -> (String, ArrayRef) {
            let array: ArrayRef = match cells {
                Cells::Text(values) => Arc::new(StringArray::from(values[..n].to_vec())),
                Cells::Number(values) => Arc::new(Float64Array::from(values[..n].to_vec())),
            };
            (name.clone(), array)
        };
        let columns: Vec<(String, ArrayRef)> = self.columns.iter().map(column).collect();
        let batch = RecordBatch::try_from_iter(columns).map_err(|error| refuse(error.to_string()))?;
        let mut bytes = Vec::new();
        let mut writer = parquet::arrow::ArrowWriter::try_new(&mut bytes, batch.schema(), None)
            .map_err(|error| refuse(error.to_string()))?;
        writer.write(&batch).map_err(|error| refuse(error.to_string()))?;
        writer.close().map_err(|error| refuse(error.to_string()))?;
        write(&path, &bytes)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn csv_quotes_what_it_must() {
        let table = Table::default()
            .text("name", ["a,b".to_owned(), "say \"x\"".to_owned()])
            .number("value", [Some(0.5), None]);
        assert_eq!(table.to_csv(), "name,value\n\"a,b\",0.5\n\"say \"\"x\"\"\",\n");
    }

    #[test]
    fn parquet_holds_the_same_rows() {
        let folder = tempfile::tempdir().unwrap();
        Table::default().number("x", [Some(1.0), None, Some(3.0)]).write(folder.path(), "t").unwrap();
        let file = File::open(folder.path().join("t.parquet")).unwrap();
        let reader = parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
        let batches: Vec<RecordBatch> = reader.build().unwrap().map(Result::unwrap).collect();
        assert_eq!(batches.iter().map(RecordBatch::num_rows).sum::<usize>(), 3);
        assert!(!folder.path().join("t.csv.tmp").exists());
    }
}
