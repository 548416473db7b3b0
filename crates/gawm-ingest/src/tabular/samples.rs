//! An episode's rows as samples of streams: what an aligner takes, whatever file they come from.
//!
//! Row t has the time t / rate. A contract names columns as it names topics, and elements of a row as fields:
//! `[3]`, `[0:7]`, or nothing for the whole row, which is flattened row-major.
//! A row of nothing but NaN is no sample: recorders write it where there is no value, as for the action of the
//! last observation. Single NaN values are passed on.

use std::ops::Range;
use std::sync::Arc;

use super::error::ReadError;
use super::{ColumnRows, Episode, Extent, Table};

/// One stream that is asked of an episode.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct StreamRequest {
    /// Name of the column in the episode: `obs/joint_pos`.
    pub column: String,
    /// Elements of a row, one after the other; empty for all.
    pub fields: Vec<Selection>,
    /// Rows are images instead of numbers; `fields` is empty then.
    pub is_image: bool,
}

/// Elements of a flattened row.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Selection {
    /// First and one past the last.
    pub elements: Range<usize>,
}

impl Selection {
    /// Reads `[3]` or `[0:7]`; `None` for anything else, an empty range included.
    pub fn parse(text: &str) -> Option<Self> {
        let inside = text.strip_prefix('[')?.strip_suffix(']')?;
        let elements = match inside.split_once(':') {
            Some((start, end)) => start.trim().parse().ok()?..end.trim().parse().ok()?,
            None => {
                let element: usize = inside.trim().parse().ok()?;
                element..element.checked_add(1)?
            }
        };
        (!elements.is_empty()).then_some(Self { elements })
    }
}

/// Why an episode has no such stream.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SampleError {
    /// The episode has no such column.
    #[error("episode {episode} has no column {column:?}: expected one of {known}")]
    UnknownColumn {
        /// The episode.
        episode: String,
        /// What was asked for.
        column: String,
        /// The columns with a value per step.
        known: String,
    },
    /// The column has no value per step.
    #[error(
        "column {column:?} of episode {episode} has {rows} rows for {steps} steps: expected one per step"
    )]
    NotPerStep {
        /// The episode.
        episode: String,
        /// The column.
        column: String,
        /// Its rows.
        rows: u64,
        /// The episode's steps.
        steps: u64,
    },
    /// A field is outside the row.
    #[error("field [{start}:{end}] of column {column:?}: expected elements below {width}")]
    FieldOutOfRange {
        /// The column.
        column: String,
        /// First element asked for.
        start: usize,
        /// One past the last.
        end: usize,
        /// Elements in a row.
        width: usize,
    },
    /// The rows cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
}

/// Rows of all streams of an episode, a few at a time.
#[derive(Debug, Clone, PartialEq)]
pub struct Batch {
    /// Rows of the batch, counted from the episode's first.
    pub rows: Range<u64>,
    /// One entry per stream asked for.
    pub streams: Vec<StreamBatch>,
}

/// Rows of one stream.
#[derive(Debug, Clone, PartialEq)]
pub enum StreamBatch {
    /// Numbers.
    Vector {
        /// Values in a row.
        width: usize,
        /// Row-major, widened to `f64`.
        values: Vec<f64>,
        /// Whether the row is a sample: it is there and not all NaN.
        present: Vec<bool>,
    },
    /// Images.
    Image {
        /// Height, width and channels.
        shape: [u64; 3],
        /// The pixels of every row that is there, row-major, channels last.
        frames: Vec<Vec<u8>>,
    },
}

/// Reads one episode in order.
pub struct SampleReader<'a> {
    table: &'a Table,
    rows: u64,
    next: u64,
    batch_rows: u64,
    streams: Vec<Stream>,
}

struct Stream {
    at: ColumnRows,
    fields: Vec<Selection>,
    row_elements: usize,
    is_image: bool,
}

impl<'a> SampleReader<'a> {
    /// Batches hold about this much, all streams together.
    const BATCH_BYTES: u64 = 16 << 20;

    /// Checks that the episode has the streams.
    ///
    /// # Errors
    /// - a column is not in the episode, has no row per step, or is read as images and holds none
    /// - a field is outside the row
    pub fn try_new(
        table: &'a Table,
        episode: &Episode,
        requests: &[StreamRequest],
    ) -> Result<Self, SampleError> {
        let streams = requests.iter().map(|r| stream(table, episode, r)).collect::<Result<Vec<_>, _>>()?;
        // The final observation is a row too: the last one, which has no action.
        let rows = streams.iter().map(|s| s.at.rows).max().unwrap_or(episode.steps);
        let row_bytes = streams.iter().fold(1u64, |n, s| {
            n.saturating_add((s.row_elements as u64).saturating_mul(if s.is_image { 1 } else { 8 }))
        });
        let batch_rows = (Self::BATCH_BYTES / row_bytes).clamp(1, 4096);
        Ok(Self { table, rows, next: 0, batch_rows, streams })
    }

    /// Returns the rows that all batches together have: the steps, and the final observation where there is one.
    pub fn rows(&self) -> u64 {
        self.rows
    }

    /// Reads the next rows; `None` after the last.
    ///
    /// # Errors
    /// As [`Table::read_rows`].
    pub fn next_batch(&mut self) -> Result<Option<Batch>, ReadError> {
        if self.next >= self.rows {
            return Ok(None);
        }
        let rows = self.next..self.next.saturating_add(self.batch_rows).min(self.rows);
        let streams = self.streams.iter().map(|s| s.read(self.table, &rows)).collect::<Result<_, _>>()?;
        self.next = rows.end;
        Ok(Some(Batch { rows, streams }))
    }
}

fn stream(table: &Table, episode: &Episode, request: &StreamRequest) -> Result<Stream, SampleError> {
    let column = request.column.clone();
    let Some(at) = episode.columns.get(column.as_str()) else {
        let known: Vec<&str> = step_columns(episode).map(|(name, _)| &**name).collect();
        return Err(SampleError::UnknownColumn {
            episode: episode.name.clone(),
            column,
            known: known.join(", "),
        });
    };
    if !at.extent.has_steps() {
        let (episode, rows, steps) = (episode.name.clone(), at.rows, episode.steps);
        return Err(SampleError::NotPerStep { episode, column, rows, steps });
    }
    let of = table.column(&at.path);
    if request.is_image && of.and_then(|c| c.image_shape()).is_none() {
        let got = of.map_or_else(String::new, |c| format!("{} of extent {:?}", c.dtype.name(), c.shape));
        return Err(ReadError::WrongKind { column, wanted: "images (u8, H x W x C)", got }.into());
    }
    let row_elements = of.map_or(0, |c| usize::try_from(c.row_elements()).unwrap_or(usize::MAX));
    for field in &request.fields {
        if field.elements.end > row_elements {
            let Range { start, end } = field.elements;
            return Err(SampleError::FieldOutOfRange { column, start, end, width: row_elements });
        }
    }
    Ok(Stream { at: at.clone(), fields: request.fields.clone(), row_elements, is_image: request.is_image })
}

fn step_columns(episode: &Episode) -> impl Iterator<Item = (&Arc<str>, &ColumnRows)> {
    episode.columns.iter().filter(|(_, at)| matches!(at.extent, Extent::Steps | Extent::StepsAndFinal))
}

impl Stream {
    fn read(&self, table: &Table, rows: &Range<u64>) -> Result<StreamBatch, ReadError> {
        // A stream may end one row before the others.
        let end = rows.end.min(self.at.rows);
        let stored = self.at.start + rows.start.min(end)..self.at.start + end;
        if self.is_image {
            return self.read_images(table, stored);
        }
        let read = table.read_rows(&self.at.path, stored)?;
        let Some(all) = read.values.to_f64() else {
            let got = "text".to_owned();
            return Err(ReadError::WrongKind { column: self.at.path.to_string(), wanted: "numbers", got });
        };
        let width = if self.fields.is_empty() {
            self.row_elements
        } else {
            self.fields.iter().map(|f| f.elements.len()).sum()
        };
        let mut values = Vec::with_capacity(all.len() / self.row_elements.max(1) * width);
        let mut present = Vec::with_capacity(read.rows);
        for row in all.chunks_exact(self.row_elements.max(1)) {
            let start = values.len();
            if self.fields.is_empty() {
                values.extend_from_slice(row);
            }
            for field in &self.fields {
                values.extend_from_slice(&row[field.elements.clone()]);
            }
            present.push(values[start..].iter().any(|v| !v.is_nan()));
        }
        // The row of the final observation has no value in this stream.
        let n_rows = usize::try_from(rows.end - rows.start).unwrap_or(present.len());
        values.resize(n_rows.saturating_mul(width), f64::NAN);
        present.resize(n_rows, false);
        Ok(StreamBatch::Vector { width, values, present })
    }

    fn read_images(&self, table: &Table, stored: Range<u64>) -> Result<StreamBatch, ReadError> {
        let mut shape = [0; 3];
        let mut frames = Vec::new();
        for row in stored {
            let mut frame = Vec::new();
            shape = table.read_image(&self.at.path, row, &mut frame)?;
            frames.push(frame);
        }
        Ok(StreamBatch::Image { shape, frames })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn selections() {
        assert_eq!(Selection::parse("[3]"), Some(Selection { elements: 3..4 }));
        assert_eq!(Selection::parse("[0:7]"), Some(Selection { elements: 0..7 }));
        for text in ["", "3", "[]", "[3:3]", "[4:3]", "[-1]", "[1:2:3]", "[18446744073709551615]", "data[0]"]
        {
            assert_eq!(Selection::parse(text), None, "{text:?}");
        }
    }
}
