//! Passes over all rows, run by run, in bounded memory and on all threads.

use std::sync::{
    Mutex,
    atomic::{AtomicUsize, Ordering},
};

use arrow::array::RecordBatch;
use parquet::arrow::{ProjectionMask, arrow_reader::ParquetRecordBatchReaderBuilder};

use super::{Column, DType, Dataset, Defect, DefectKind, Run, declared, files};

/// Rows per record batch of number columns.
const BATCH_ROWS: usize = 8192;
/// Rows that a unit of reading should have at least, where row groups allow it.
const UNIT_ROWS: u64 = 32_768;

/// The rows of one run.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeRows {
    /// Position of the run in [`Dataset::runs`].
    pub run_index: usize,
    /// Which run it is.
    pub run: Run,
    /// The columns that were asked for and exist.
    pub columns: Vec<Column>,
}

impl EpisodeRows {
    /// Returns the number of rows.
    pub fn n_rows(&self) -> usize {
        self.run.n_rows as usize
    }

    /// Returns a column by name.
    pub fn column(&self, name: &str) -> Option<&Column> {
        self.columns.iter().find(|c| c.name == name)
    }

    /// Returns the values of an integer column by name.
    pub fn ints(&self, name: &str) -> Option<&[i64]> {
        self.column(name).and_then(Column::ints)
    }
}

/// Why a pass had to stop. What single files lack is a [`Defect`], not an error.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ScanError {
    /// A run is longer than is held at once.
    #[error("episode {episode} is too long: expected at most {max} rows, got {got}")]
    EpisodeTooLong {
        /// The episode index.
        episode: i64,
        /// The bound.
        max: usize,
        /// Its rows.
        got: u64,
    },
}

/// A stretch of row groups that begins and ends at a run's border.
#[derive(Debug, Clone)]
pub(super) struct Unit {
    pub(super) file: usize,
    pub(super) row_groups: Vec<usize>,
    pub(super) runs: std::ops::Range<usize>,
}

impl Dataset {
    /// Returns the names of the columns of numbers, text and integers that are declared, in order.
    pub fn scalar_columns(&self) -> Vec<String> {
        let features = self.info.features.iter();
        features.filter(|f| f.is_numeric() || f.dtype == DType::Text).map(|f| f.name.clone()).collect()
    }

    /// Calls `process` for the rows of every run and returns the results in the order of [`Dataset::runs`].
    ///
    /// Columns that do not exist are left out. What cannot be read is reported as defects beside the results; a run that
    /// cannot be read has no result. The results do not depend on the number of threads.
    ///
    /// # Errors
    /// A run has more rows than are held at once.
    pub fn scan<R: Send>(
        &self,
        columns: &[String],
        process: impl Fn(EpisodeRows) -> R + Sync,
    ) -> Result<(Vec<R>, Vec<Defect>), ScanError> {
        self.scan_some(columns, |_| true, process)
    }

    /// [`Dataset::scan`] of the runs that are wanted, by their position; files without any are not read.
    ///
    /// # Errors
    /// A run has more rows than are held at once.
    pub fn scan_some<R: Send>(
        &self,
        columns: &[String],
        is_wanted: impl Fn(usize) -> bool + Sync,
        process: impl Fn(EpisodeRows) -> R + Sync,
    ) -> Result<(Vec<R>, Vec<Defect>), ScanError> {
        for run in &self.runs {
            if run.n_rows > self.limits.max_unit_rows as u64 {
                let (episode, got) = (run.episode_index, run.n_rows);
                return Err(ScanError::EpisodeTooLong { episode, max: self.limits.max_unit_rows, got });
            }
        }
        let mut units = self.units(UNIT_ROWS);
        units.retain(|unit| unit.runs.clone().any(&is_wanted));
        let results: Mutex<Vec<(usize, R)>> = Mutex::new(Vec::with_capacity(self.runs.len()));
        let defects: Mutex<Vec<(usize, Defect)>> = Mutex::new(Vec::new());
        let n_threads = rayon::current_num_threads();
        let is_spawning = units.len() < 2 * n_threads;
        let n_in_flight = AtomicUsize::new(0);
        let keep = |index: usize, result: R| {
            results.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push((index, result));
        };
        // First in, first out: who merges results in order then waits for few of them.
        rayon::scope_fifo(|scope| {
            for (unit_index, unit) in units.iter().enumerate() {
                let (process, keep, n_in_flight, defects) = (&process, &keep, &n_in_flight, &defects);
                let is_wanted = &is_wanted;
                scope.spawn_fifo(move |scope| {
                    let outcome = files::guarded(|| {
                        self.read_unit(unit, columns, |rows| {
                            let index = rows.run_index;
                            self.rows_read.fetch_add(rows.run.n_rows, Ordering::Relaxed);
                            if !is_wanted(index) {
                                return;
                            }
                            if !is_spawning || n_in_flight.load(Ordering::Relaxed) > 2 * n_threads {
                                keep(index, process(rows));
                                return;
                            }
                            n_in_flight.fetch_add(1, Ordering::Relaxed);
                            scope.spawn_fifo(move |_| {
                                keep(index, process(rows));
                                n_in_flight.fetch_sub(1, Ordering::Relaxed);
                            });
                        })
                    });
                    if let Err(got) = outcome {
                        let place = &self.files[unit.file].relative;
                        let defect =
                            Defect::new(DefectKind::UnreadableFile, place, "readable column data", got);
                        defects
                            .lock()
                            .unwrap_or_else(std::sync::PoisonError::into_inner)
                            .push((unit_index, defect));
                    }
                });
            }
        });
        let mut results = results.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        results.sort_by_key(|(index, _)| *index);
        let mut defects = defects.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        defects.sort_by_key(|(index, _)| *index);
        Ok((results.into_iter().map(|(_, r)| r).collect(), defects.into_iter().map(|(_, d)| d).collect()))
    }

    /// Cuts the files into units of at least `min_rows` that end where a row group and a run end together.
    pub(super) fn units(&self, min_rows: u64) -> Vec<Unit> {
        let mut units = Vec::new();
        let mut run = 0;
        for (file_index, file) in self.files.iter().enumerate() {
            let mut unit = Unit { file: file_index, row_groups: Vec::new(), runs: run..run };
            let (mut group_end, mut run_end, mut unit_rows) = (0, 0, 0);
            for (group, n_rows) in file.row_groups.iter().enumerate() {
                group_end += n_rows;
                unit_rows += n_rows;
                unit.row_groups.push(group);
                while run_end < group_end && run < self.runs.len() && self.runs[run].file == file_index {
                    run_end += self.runs[run].n_rows;
                    run += 1;
                }
                let is_last = group + 1 == file.row_groups.len();
                if is_last || (run_end == group_end && unit_rows >= min_rows) {
                    unit.runs.end = run;
                    let next = Unit { file: file_index, row_groups: Vec::new(), runs: run..run };
                    units.push(std::mem::replace(&mut unit, next));
                    unit_rows = 0;
                }
            }
        }
        units.retain(|unit| !unit.runs.is_empty());
        units
    }

    /// Returns empty columns for the names that file `file` has.
    fn empty_columns(&self, file: usize, names: &[String]) -> Vec<Column> {
        let schema = &self.files[file].schema;
        let exists = |name: &&String| schema.field_with_name(name).is_ok();
        let column = |name: &String| {
            let field = schema.field_with_name(name).ok();
            let declared = self.info.feature(name);
            match declared.map(|f| (&f.dtype, f.width())) {
                Some((DType::Text, _)) => Column::text(name),
                Some((DType::Int, 1)) => Column::int(name),
                Some((_, width)) => Column::vector(name, width),
                None if field.is_some_and(|f| f.data_type().is_integer()) => Column::int(name),
                None => Column::vector(name, 1),
            }
        };
        names.iter().filter(exists).map(column).collect()
    }

    fn read_unit(
        &self,
        unit: &Unit,
        names: &[String],
        mut emit: impl FnMut(EpisodeRows),
    ) -> Result<(), String> {
        let empty = self.empty_columns(unit.file, names);
        let mut current = empty.clone();
        let mut runs = unit.runs.clone();
        let mut n_filled = 0;
        let mut fill = |batch: &RecordBatch, current: &mut Vec<Column>| {
            let mut from = 0;
            while from < batch.num_rows() && !runs.is_empty() {
                let run = self.runs[runs.start];
                let to = batch.num_rows().min(from + run.n_rows as usize - n_filled);
                for column in current.iter_mut() {
                    if let Some(array) = batch.column_by_name(&column.name) {
                        column.append(array, from, to);
                    }
                }
                n_filled += to - from;
                from = to;
                if n_filled == run.n_rows as usize {
                    let columns = std::mem::replace(current, empty.iter().map(Column::emptied).collect());
                    emit(EpisodeRows { run_index: runs.start, run, columns });
                    runs.start += 1;
                    n_filled = 0;
                }
            }
        };
        let projected: Vec<&str> = current.iter().map(|c| c.name.as_str()).collect();
        for batch in self.open_unit(unit, &projected, BATCH_ROWS)? {
            fill(&batch.map_err(|e| e.to_string())?, &mut current);
        }
        if runs.is_empty() { Ok(()) } else { Err(format!("{} episodes fewer than expected", runs.len())) }
    }

    /// Opens a reader of some columns of a unit.
    pub(super) fn open_unit(
        &self,
        unit: &Unit,
        columns: &[&str],
        batch_rows: usize,
    ) -> Result<parquet::arrow::arrow_reader::ParquetRecordBatchReader, String> {
        let (file, metadata) = self.open_file(unit.file)?;
        let schema = metadata.schema().clone();
        let roots = columns.iter().filter_map(|name| schema.index_of(name).ok());
        let mask = ProjectionMask::roots(metadata.parquet_schema(), roots);
        let groups = unit.row_groups.iter().copied();
        let most_rows = declared::check_pages(&file, metadata.metadata(), groups, &mask)?;
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata)
            .with_projection(mask)
            .with_row_groups(unit.row_groups.clone())
            .with_batch_size(batch_rows.min(most_rows));
        builder.build().map_err(|e| e.to_string())
    }
}
