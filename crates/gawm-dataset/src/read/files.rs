//! The data files: which there are, what columns they have, and which rows belong to which episode.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, File},
    panic::{AssertUnwindSafe, catch_unwind},
    path::{Path, PathBuf},
    sync::{Mutex, PoisonError},
};

use arrow::datatypes::{DataType, SchemaRef};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use rayon::prelude::*;

use super::{
    Column, DType, Dataset, Defect, DefectKind, EpisodeEntry, FeatureDecl, Info, ReadLimits, declared,
    paths::{self, TemplateValues},
};

/// Columns that every dataset has beside its features.
const INDEX_COLUMNS: [&str; 5] = ["timestamp", "frame_index", "episode_index", "index", "task_index"];

/// One data file.
#[derive(Debug, Clone)]
pub struct DataFile {
    /// Path relative to the dataset folder, with `/`.
    pub relative: String,
    /// Path to open.
    pub path: PathBuf,
    /// Number of rows.
    pub n_rows: u64,
    /// Rows of each row group.
    pub row_groups: Vec<u64>,
    /// The Arrow schema.
    pub schema: SchemaRef,
}

/// A stretch of consecutive rows of one data file with one `episode_index`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Run {
    /// The value of `episode_index`.
    pub episode_index: i64,
    /// Position in [`Dataset::files`](super::Dataset::files).
    pub file: usize,
    /// First row within the file.
    pub start: u64,
    /// Number of rows.
    pub n_rows: u64,
    /// Rows of all files before this run.
    pub global_start: u64,
}

/// Largest column chunk that is read, in bytes as stored uncompressed.
const MAX_CHUNK_BYTES: i64 = 8 << 30;

/// Runs `read`, turning errors and panics of the Parquet reader into text.
pub(crate) fn guarded<T>(read: impl FnOnce() -> Result<T, String>) -> Result<T, String> {
    catch_unwind(AssertUnwindSafe(read))
        .unwrap_or_else(|_| Err("content that the Parquet reader cannot digest".to_owned()))
}

/// The footer that was read last: a file of many episodes is gone through piece by piece, and a footer of as many row
/// groups takes longer to read than a piece.
#[derive(Debug, Default)]
pub(super) struct LastFooter(Mutex<Option<(usize, u64, ArrowReaderMetadata)>>);

impl Dataset {
    /// Opens a data file by its position in [`Dataset::files`], and checks its footer against its size.
    ///
    /// # Errors
    /// The file cannot be opened or its footer not be used; the text says what it is instead.
    pub fn open_file(&self, index: usize) -> Result<(File, ArrowReaderMetadata), String> {
        let path = &self.files[index].path;
        let last = || self.last_footer.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (file, size) = open_regular(path)?;
        let known =
            last().as_ref().filter(|(i, s, _)| (*i, *s) == (index, size)).map(|known| known.2.clone());
        if let Some(metadata) = known {
            return Ok((file, metadata));
        }
        let metadata = checked_footer(&file, size)?;
        *last() = Some((index, size, metadata.clone()));
        Ok((file, metadata))
    }
}

/// Opens a Parquet file and checks its footer against the file's size.
pub(crate) fn open_parquet(path: &Path) -> Result<(File, ArrowReaderMetadata), String> {
    let (file, size) = open_regular(path)?;
    let metadata = checked_footer(&file, size)?;
    Ok((file, metadata))
}

/// Opens a file, and returns its size beside it.
fn open_regular(path: &Path) -> Result<(File, u64), String> {
    // Opening a pipe waits for somebody to write into it.
    if !fs::metadata(path).map_err(|e| e.to_string())?.is_file() {
        return Err("something that is not a regular file".to_owned());
    }
    let file = File::open(path).map_err(|e| e.to_string())?;
    let size = file.metadata().map_err(|e| e.to_string())?.len();
    Ok((file, size))
}

fn checked_footer(file: &File, size: u64) -> Result<ArrowReaderMetadata, String> {
    declared::check_schema(file, size)?;
    let metadata =
        guarded(|| ArrowReaderMetadata::load(file, ArrowReaderOptions::new()).map_err(|e| e.to_string()))?;
    let mut n_rows: i64 = 0;
    for group in metadata.metadata().row_groups() {
        n_rows = n_rows
            .checked_add(group.num_rows())
            .filter(|_| group.num_rows() >= 0)
            .ok_or("negative row counts")?;
        for column in group.columns() {
            let start = column.dictionary_page_offset().unwrap_or_else(|| column.data_page_offset());
            let end = start.checked_add(column.compressed_size());
            if column.uncompressed_size() > MAX_CHUNK_BYTES {
                return Err(format!(
                    "a column chunk of {} bytes (column {})",
                    column.uncompressed_size(),
                    column.column_path()
                ));
            }
            if start < 4 || column.compressed_size() < 0 || end.is_none_or(|end| end as u64 > size) {
                return Err(format!(
                    "a footer that points outside the file (column {})",
                    column.column_path()
                ));
            }
        }
    }
    declared::check_rows(n_rows, size)?;
    if n_rows != metadata.metadata().file_metadata().num_rows() {
        let declared = metadata.metadata().file_metadata().num_rows();
        return Err(format!("a footer of {declared} rows whose row groups have {n_rows}"));
    }
    Ok(metadata)
}

/// Lists and opens the data files, comparing them with what metadata name.
pub(super) fn find_data_files(
    root: &Path,
    info: &Info,
    episodes: &[EpisodeEntry],
    defects: &mut Vec<Defect>,
) -> Vec<DataFile> {
    let mut named = BTreeSet::new();
    for entry in episodes {
        let values = TemplateValues {
            chunk: entry.data_chunk,
            file: entry.data_file,
            episode: entry.episode_index as u64,
            video_key: "",
        };
        match paths::fill(&info.data_path, values).and_then(|p| paths::join_inside(root, &p).map(|_| p)) {
            Ok(path) => {
                named.insert(path);
            }
            Err(got) => {
                defects.push(Defect::new(
                    DefectKind::UnsafePath,
                    "meta/info.json data_path",
                    "a path inside the folder",
                    got,
                ));
                break;
            }
        }
    }
    let found: BTreeSet<String> = list_parquet(root, defects).into_iter().collect();
    let mut missing: Vec<&String> = named.difference(&found).collect();
    let n_missing = missing.len();
    missing.truncate(20);
    for path in missing {
        let got = if n_missing > 20 {
            format!("nothing ({n_missing} files are missing)")
        } else {
            "nothing".to_owned()
        };
        defects.push(Defect::new(
            DefectKind::MissingFile,
            path,
            "a Parquet file that the episode table names",
            got,
        ));
    }
    if !named.is_empty() {
        for path in found.difference(&named) {
            defects.push(Defect::new(
                DefectKind::StrayFile,
                path,
                "only files that the episode table names",
                "another one",
            ));
        }
    }
    // A stray file in a LeRobot v2 folder is not read by anyone; in v3 every file is.
    let mut wanted: Vec<&String> =
        found.iter().filter(|p| !info.version.is_v2() || named.is_empty() || named.contains(*p)).collect();
    wanted.sort_by_key(|path| natural_key(path));
    let opened: Vec<Result<DataFile, Defect>> =
        wanted.par_iter().map(|relative| open_data_file(root, relative)).collect();
    let mut files = Vec::new();
    for file in opened {
        match file {
            Ok(file) => files.push(file),
            Err(defect) => defects.push(defect),
        }
    }
    check_columns(&files, info, defects);
    files
}

/// Orders `file-1000` after `file-999`: by the numbers in the path.
fn natural_key(path: &str) -> (Vec<u64>, String) {
    let numbers = path.split(|c: char| !c.is_ascii_digit()).filter_map(|n| n.parse().ok()).collect();
    (numbers, path.to_owned())
}

/// Lists `data/*/*.parquet`, as LeRobot globs it.
fn list_parquet(root: &Path, defects: &mut Vec<Defect>) -> Vec<String> {
    let mut found = Vec::new();
    let read =
        |path: &Path| -> Vec<fs::DirEntry> { fs::read_dir(path).into_iter().flatten().flatten().collect() };
    for chunk in read(&root.join("data")) {
        let chunk_name = chunk.file_name().to_string_lossy().into_owned();
        if !chunk.path().is_dir() {
            continue;
        }
        for file in read(&chunk.path()) {
            let name = file.file_name().to_string_lossy().into_owned();
            let relative = format!("data/{chunk_name}/{name}");
            if !name.ends_with(".parquet") || !file.path().is_file() {
                continue;
            }
            match paths::join_inside(root, &relative) {
                Ok(_) => found.push(relative),
                Err(got) => defects.push(Defect::new(
                    DefectKind::UnsafePath,
                    relative,
                    "a file inside the folder",
                    got,
                )),
            }
        }
    }
    found.sort();
    found
}

fn open_data_file(root: &Path, relative: &str) -> Result<DataFile, Defect> {
    let path = root.join(relative);
    let (_, metadata) = open_parquet(&path)
        .map_err(|got| Defect::new(DefectKind::UnreadableFile, relative, "a readable Parquet file", got))?;
    Ok(DataFile {
        relative: relative.to_owned(),
        path,
        n_rows: metadata.metadata().file_metadata().num_rows() as u64,
        row_groups: metadata.metadata().row_groups().iter().map(|g| g.num_rows() as u64).collect(),
        schema: metadata.schema().clone(),
    })
}

/// Compares the columns of all files with the declared features.
fn check_columns(files: &[DataFile], info: &Info, defects: &mut Vec<Defect>) {
    let mut seen: BTreeMap<(DefectKind, String, String), (usize, String, String)> = BTreeMap::new();
    let mut note = |kind, name: &str, expected: String, got: String, file: &DataFile| {
        let entry =
            seen.entry((kind, name.to_owned(), got.clone())).or_insert((0, expected, file.relative.clone()));
        entry.0 += 1;
    };
    for file in files {
        for field in file.schema.fields() {
            if info.feature(field.name()).is_none() {
                let got = field.data_type().to_string();
                note(
                    DefectKind::UndeclaredColumn,
                    field.name(),
                    "a declaration in features".to_owned(),
                    got,
                    file,
                );
            }
        }
        for name in INDEX_COLUMNS {
            if info.feature(name).is_none() && file.schema.field_with_name(name).is_err() {
                // v2.0 folders of some converters have no frame_index.
                note(DefectKind::MissingColumn, name, "a column".to_owned(), "none".to_owned(), file);
            }
        }
        for feature in info.features.iter().filter(|f| f.dtype != DType::Video) {
            match file.schema.field_with_name(&feature.name) {
                Err(_) => {
                    note(
                        DefectKind::MissingColumn,
                        &feature.name,
                        "the declared column".to_owned(),
                        "none".to_owned(),
                        file,
                    );
                }
                Ok(field) => {
                    if let Some(expected) = wrong_type(feature, field.data_type()) {
                        note(
                            DefectKind::WrongType,
                            &feature.name,
                            expected,
                            field.data_type().to_string(),
                            file,
                        );
                    }
                }
            }
        }
    }
    for ((kind, name, got), (n_files, expected, first)) in seen {
        let got = if n_files > 1 {
            format!("{got} (in {n_files} files, first {first})")
        } else {
            format!("{got} (in {first})")
        };
        defects.push(Defect::new(kind, name, expected, got));
    }
}

/// Returns what was expected if `datasets` cannot read a column of type `got` as the declared feature.
fn wrong_type(feature: &FeatureDecl, got: &DataType) -> Option<String> {
    let is_scalar = feature.shape == [1];
    let expected = match feature.dtype {
        DType::Image => {
            let ok = matches!(got, DataType::Struct(_) | DataType::Binary | DataType::LargeBinary);
            return (!ok).then(|| "struct<bytes, path> or binary".to_owned());
        }
        DType::Text => {
            return (!matches!(got, DataType::Utf8 | DataType::LargeUtf8)).then(|| "text".to_owned());
        }
        DType::Video | DType::Unknown(_) => return None,
        _ => format!("{}{}", feature.dtype_name, if is_scalar { ", a bare scalar" } else { ", a list" }),
    };
    let mut depth = 0;
    let mut leaf = got;
    while let DataType::List(field) | DataType::LargeList(field) | DataType::FixedSizeList(field, _) = leaf {
        depth += 1;
        leaf = field.data_type();
        if let DataType::FixedSizeList(_, n) = got
            && depth == 1
            && feature.shape.len() == 1
            && usize::try_from(*n) != Ok(feature.shape[0])
        {
            return Some(format!("lists of {}", feature.shape[0]));
        }
    }
    let is_right_depth = if is_scalar { depth == 0 } else { depth == feature.shape.len() };
    let is_right_leaf = match feature.dtype {
        DType::Float => leaf.is_numeric(),
        DType::Int => leaf.is_integer() || *leaf == DataType::Boolean,
        _ => leaf.is_integer() || *leaf == DataType::Boolean,
    };
    (!is_right_depth || !is_right_leaf).then_some(expected)
}

/// Finds the runs of equal `episode_index` and compares them with the metadata.
pub(super) fn find_runs(
    files: &[DataFile],
    info: &Info,
    episodes: &[EpisodeEntry],
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Vec<Run> {
    let found: Vec<Result<Vec<(i64, u64)>, Defect>> =
        files.par_iter().map(|file| runs_of_file(file, info, episodes, limits)).collect();
    let mut runs = Vec::new();
    let mut global_start = 0;
    for (i, (file, found)) in files.iter().zip(found).enumerate() {
        let mut start = 0;
        match found {
            Err(defect) => {
                defects.push(defect);
                global_start += file.n_rows;
                continue;
            }
            Ok(found) => {
                for (episode_index, n_rows) in found {
                    runs.push(Run { episode_index, file: i, start, n_rows, global_start });
                    start += n_rows;
                    global_start += n_rows;
                }
            }
        }
    }
    super::episode_table::compare(files, &runs, info, episodes, defects);
    runs
}

fn runs_of_file(
    file: &DataFile,
    info: &Info,
    episodes: &[EpisodeEntry],
    limits: &ReadLimits,
) -> Result<Vec<(i64, u64)>, Defect> {
    if file.schema.field_with_name("episode_index").is_err() {
        return Ok(runs_from_table(file, info, episodes));
    }
    let unreadable =
        |got| Defect::new(DefectKind::UnreadableFile, &file.relative, "a readable column episode_index", got);
    let mut runs: Vec<(i64, u64)> = Vec::new();
    guarded(|| {
        let (handle, metadata) = open_parquet(&file.path)?;
        let mask = ProjectionMask::columns(metadata.parquet_schema(), ["episode_index"]);
        declared::check_pages(&handle, metadata.metadata(), 0..file.row_groups.len(), &mask)?;
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(handle, metadata);
        let reader =
            builder.with_projection(mask).with_batch_size(65_536).build().map_err(|e| e.to_string())?;
        for batch in reader {
            let batch = batch.map_err(|e| e.to_string())?;
            let mut column = Column::int("episode_index");
            column.append(batch.column(0), 0, batch.num_rows());
            for value in column.ints().unwrap_or_default() {
                match runs.last_mut() {
                    Some((last, n)) if last == value => *n += 1,
                    _ => runs.push((*value, 1)),
                }
            }
            if runs.len() as u64 > limits.max_episodes {
                return Err("more episodes than are permitted".to_owned());
            }
        }
        Ok(())
    })
    .map_err(unreadable)?;
    Ok(runs)
}

/// Returns runs of a file without the column `episode_index`, by its name (v2) or the episode table (v3).
fn runs_from_table(file: &DataFile, info: &Info, episodes: &[EpisodeEntry]) -> Vec<(i64, u64)> {
    let number = |text: &str| {
        text.chars().filter(char::is_ascii_digit).collect::<String>().parse::<u64>().unwrap_or(0)
    };
    let name = file.relative.rsplit('/').next().unwrap_or("");
    if info.version.is_v2() {
        return vec![(number(name) as i64, file.n_rows)];
    }
    let chunk = number(file.relative.split('/').nth(1).unwrap_or(""));
    let mut left = file.n_rows;
    let mut runs = Vec::new();
    for entry in episodes.iter().filter(|e| e.data_chunk == chunk && e.data_file == number(name)) {
        let n_rows = entry.length.unwrap_or(0).min(left);
        if n_rows > 0 {
            runs.push((entry.episode_index, n_rows));
            left -= n_rows;
        }
    }
    if left > 0 {
        runs.push((runs.last().map_or(0, |r| r.0 + 1), left));
    }
    runs
}
