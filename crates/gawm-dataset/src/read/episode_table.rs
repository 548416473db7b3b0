//! The tables of episodes and tasks, in the forms of v2 (JSON lines) and v3 (Parquet).

use std::{collections::BTreeMap, io, path::Path};

use arrow::{
    array::{Array, ArrayRef, AsArray, RecordBatch},
    datatypes::{DataType, Schema},
};
use parquet::arrow::{ProjectionMask, arrow_reader::ParquetRecordBatchReaderBuilder};
use serde_json::Value;

use crate::episode::FeatureStats;

use super::{Column, DataFile, Defect, DefectKind, Info, ReadLimits, Run, declared, files, info, paths};

/// Most defects of one kind that are listed one by one.
const MAX_LISTED: usize = 50;

/// One episode of the table.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct EpisodeEntry {
    /// The episode's index.
    pub episode_index: i64,
    /// Declared number of rows.
    pub length: Option<u64>,
    /// The texts of its tasks.
    pub tasks: Vec<String>,
    /// Number of the chunk folder of its data.
    pub data_chunk: u64,
    /// Number of the data file in the chunk.
    pub data_file: u64,
    /// First global row.
    pub from_index: Option<u64>,
    /// Global row after the last.
    pub to_index: Option<u64>,
    /// Per camera in video files: chunk, file, first and last second.
    pub videos: BTreeMap<String, VideoSpan>,
    /// All other columns but statistics: success, session, split and the like.
    pub extras: BTreeMap<String, Value>,
}

/// Where an episode's video lies.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct VideoSpan {
    /// Number of the chunk folder.
    pub chunk: u64,
    /// Number of the file in it.
    pub file: u64,
    /// Where the episode begins in the file.
    pub from_timestamp_secs: f64,
    /// Where it ends.
    pub to_timestamp_secs: f64,
}

impl EpisodeEntry {
    /// Returns an extra column as text, if it is there and not null.
    pub fn extra_text(&self, name: &str) -> Option<String> {
        match self.extras.get(name)? {
            Value::Null => None,
            Value::String(text) => Some(text.clone()),
            other => Some(other.to_string()),
        }
    }
}

/// Reads the task table.
pub(super) fn read_tasks(
    root: &Path,
    info: &Info,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Vec<String> {
    let place = if info.version.is_v2() { "meta/tasks.jsonl" } else { "meta/tasks.parquet" };
    let rows = if info.version.is_v2() { task_lines(root, limits) } else { task_rows(root) };
    let rows = match rows {
        Ok((rows, complaints)) => {
            for (expected, got) in complaints {
                defects.push(Defect::new(DefectKind::TaskTable, place, expected, got));
            }
            rows
        }
        Err(got) => {
            defects.push(Defect::new(DefectKind::TaskTable, place, "a table of tasks", got));
            return Vec::new();
        }
    };
    if let Some((i, row)) = rows.iter().enumerate().find(|(i, row)| row.0 != *i as i64) {
        let expected = format!("row {i} to have task_index {i}");
        defects.push(Defect::new(DefectKind::TaskTable, place, expected, row.0.to_string()));
    }
    if let Some(total) = info.total_tasks
        && total != rows.len() as u64
    {
        let expected = format!("{} tasks as in {place}", rows.len());
        defects.push(Defect::new(
            DefectKind::WrongCount,
            "meta/info.json total_tasks",
            expected,
            total.to_string(),
        ));
    }
    let mut tasks = vec![String::new(); rows.len()];
    for (index, text) in rows {
        if let Some(slot) = usize::try_from(index).ok().and_then(|i| tasks.get_mut(i)) {
            *slot = text;
        }
    }
    tasks
}

type TaskRows = (Vec<(i64, String)>, Vec<(&'static str, String)>);

fn task_lines(root: &Path, limits: &ReadLimits) -> Result<TaskRows, String> {
    let text = info::read_text(root, "meta/tasks.jsonl", limits).map_err(|e| e.to_string())?;
    let mut rows = Vec::new();
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let value: Value = serde_json::from_str(line).map_err(|e| format!("line {}: {e}", n + 1))?;
        let index = value
            .get("task_index")
            .and_then(Value::as_i64)
            .ok_or_else(|| format!("line {} without task_index", n + 1))?;
        rows.push((index, value.get("task").and_then(Value::as_str).unwrap_or("").to_owned()));
    }
    Ok((rows, Vec::new()))
}

fn task_rows(root: &Path) -> Result<TaskRows, String> {
    let path = paths::join_inside(root, "meta/tasks.parquet")?;
    let (batches, schema) = read_table(&path, |_| true)?;
    let has_index = |s: &Schema| s.metadata().get("pandas").is_some_and(|p| p.contains("index_columns"));
    let mut complaints = Vec::new();
    if !has_index(&schema) {
        complaints.push((
            "pandas metadata with the task text as index",
            "none: lerobot shows the number 1 as task".to_owned(),
        ));
    }
    // pandas names an index without a name __index_level_0__.
    let text_column =
        ["task", "__index_level_0__"].into_iter().find(|name| schema.field_with_name(name).is_ok());
    let text_column = text_column.ok_or("no column task")?;
    let mut rows = Vec::new();
    for batch in &batches {
        let index = ints(batch, "task_index").ok_or("no column task_index")?;
        let texts = batch.column_by_name(text_column).map(texts).unwrap_or_default();
        rows.extend(index.into_iter().zip(texts).map(|(i, t)| (i, t.unwrap_or_default())));
    }
    Ok((rows, complaints))
}

/// Reads the episode table.
pub(super) fn read_episodes(
    root: &Path,
    info: &Info,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Vec<EpisodeEntry> {
    let entries = if info.version.is_v2() {
        episode_lines(root, info, limits)
    } else {
        episode_rows(root, limits, defects)
    };
    let place = if info.version.is_v2() { "meta/episodes.jsonl" } else { "meta/episodes" };
    let entries = entries.unwrap_or_else(|got| {
        defects.push(Defect::new(DefectKind::EpisodeTable, place, "a table of episodes", got));
        Vec::new()
    });
    if let Some((i, entry)) = entries.iter().enumerate().find(|(i, e)| e.episode_index != *i as i64) {
        let expected = format!("row {i} to be episode {i}: lookup is by position");
        let got = format!("episode {}", entry.episode_index);
        defects.push(
            Defect::new(DefectKind::EpisodeTable, place, expected, got).in_episode(entry.episode_index),
        );
    }
    entries
}

fn episode_lines(root: &Path, info: &Info, limits: &ReadLimits) -> Result<Vec<EpisodeEntry>, String> {
    let text = info::read_text(root, "meta/episodes.jsonl", limits).map_err(|e| e.to_string())?;
    let mut entries = Vec::new();
    let mut from = 0u64;
    for (n, line) in text.lines().enumerate().filter(|(_, l)| !l.trim().is_empty()) {
        let value: Value = serde_json::from_str(line).map_err(|e| format!("line {}: {e}", n + 1))?;
        let object = value.as_object().ok_or_else(|| format!("line {} that is no object", n + 1))?;
        let index = object.get("episode_index").and_then(Value::as_i64).filter(|i| *i >= 0);
        let index = index.ok_or_else(|| format!("line {} without episode_index", n + 1))?;
        let length = object.get("length").and_then(Value::as_u64);
        let tasks = object.get("tasks").and_then(Value::as_array).into_iter().flatten();
        let chunk = index as u64 / info.chunks_size;
        let mut entry = EpisodeEntry {
            episode_index: index,
            length,
            tasks: tasks.filter_map(Value::as_str).map(str::to_owned).collect(),
            data_chunk: chunk,
            from_index: Some(from),
            ..EpisodeEntry::default()
        };
        from = from.saturating_add(length.unwrap_or(0));
        entry.to_index = Some(from);
        for (key, value) in
            object.iter().filter(|(k, _)| !["episode_index", "length", "tasks"].contains(&k.as_str()))
        {
            entry.extras.insert(key.clone(), value.clone());
        }
        for feature in info.features.iter().filter(|f| f.dtype == super::DType::Video) {
            let to = length.unwrap_or(0) as f64 / info.fps;
            entry.videos.insert(
                feature.name.clone(),
                VideoSpan { chunk, to_timestamp_secs: to, ..VideoSpan::default() },
            );
        }
        entries.push(entry);
    }
    Ok(entries)
}

/// Lists the Parquet files of the episode table.
fn table_files(root: &Path) -> Vec<String> {
    let folder = root.join("meta/episodes");
    let mut names = Vec::new();
    let list = |path: &Path| std::fs::read_dir(path).into_iter().flatten().flatten().collect::<Vec<_>>();
    for chunk in list(&folder) {
        for file in list(&chunk.path()) {
            let name = format!(
                "meta/episodes/{}/{}",
                chunk.file_name().to_string_lossy(),
                file.file_name().to_string_lossy()
            );
            if name.ends_with(".parquet") {
                names.push(name);
            }
        }
    }
    names.sort();
    names
}

fn episode_rows(
    root: &Path,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Result<Vec<EpisodeEntry>, String> {
    let names = table_files(root);
    if names.is_empty() {
        return Err("no Parquet file in meta/episodes".to_owned());
    }
    let mut entries = Vec::new();
    for name in names {
        let table = paths::join_inside(root, &name)
            .and_then(|path| read_table(&path, |column| !column.starts_with("stats/")));
        let (batches, _) = match table {
            Ok(table) => table,
            Err(got) => {
                defects.push(Defect::new(DefectKind::UnreadableFile, name, "a readable Parquet file", got));
                continue;
            }
        };
        for batch in &batches {
            if entries.len() as u64 + batch.num_rows() as u64 > limits.max_episodes {
                return Err(format!("more than {} episodes", limits.max_episodes));
            }
            entries.extend(entries_of(batch)?);
        }
    }
    Ok(entries)
}

/// Returns what the folder says of the pixels of some cameras in single episodes; what cannot be read is not there.
pub(crate) fn episode_statistics(
    dataset: &super::Dataset,
    cameras: &[String],
) -> BTreeMap<(i64, String), FeatureStats> {
    let mut found = BTreeMap::new();
    if dataset.info.version.is_v2() {
        let text = info::read_text(&dataset.root, "meta/episodes_stats.jsonl", &dataset.limits);
        for line in text.unwrap_or_default().lines().filter(|line| !line.trim().is_empty()) {
            let Ok(value) = serde_json::from_str::<Value>(line) else { continue };
            let Some(index) = value.get("episode_index").and_then(Value::as_i64) else { continue };
            for camera in cameras {
                let stats = value.get("stats").and_then(|s| s.get(camera)).and_then(FeatureStats::from_json);
                found.extend(stats.map(|stats| ((index, camera.clone()), stats)));
            }
        }
        return found;
    }
    let is_wanted = |column: &str| {
        let feature = column.strip_prefix("stats/").and_then(|name| name.rsplit_once('/'));
        column == "episode_index" || feature.is_some_and(|(name, _)| cameras.iter().any(|c| c == name))
    };
    for name in table_files(&dataset.root) {
        let table = paths::join_inside(&dataset.root, &name).and_then(|path| read_table(&path, is_wanted));
        for batch in table.map(|(batches, _)| batches).unwrap_or_default() {
            let index = ints(&batch, "episode_index").unwrap_or_default();
            for (row, camera) in (0..index.len()).flat_map(|row| cameras.iter().map(move |c| (row, c))) {
                let of = |name: &str| batch.column_by_name(&format!("stats/{camera}/{name}"));
                let names = ["min", "max", "mean", "std", "q01", "q10", "q50", "q90", "q99", "count"];
                let value = names.iter().filter_map(|n| Some(((*n).to_owned(), json_value(of(n)?, row, 0))));
                let stats = FeatureStats::from_json(&Value::Object(value.collect()));
                found.extend(stats.map(|stats| ((index[row], camera.clone()), stats)));
            }
        }
    }
    found
}

fn entries_of(batch: &RecordBatch) -> Result<Vec<EpisodeEntry>, String> {
    let index = ints(batch, "episode_index").ok_or("no column episode_index")?;
    let count = |name: &str| {
        ints(batch, name).map(|v| v.into_iter().map(|n| u64::try_from(n).ok()).collect::<Vec<_>>())
    };
    let (length, chunk, file) = (count("length"), count("data/chunk_index"), count("data/file_index"));
    let (from, to) = (count("dataset_from_index"), count("dataset_to_index"));
    let at = |column: &Option<Vec<Option<u64>>>, i: usize| column.as_ref().and_then(|c| c[i]);
    let mut entries: Vec<EpisodeEntry> = (0..batch.num_rows())
        .map(|i| EpisodeEntry {
            episode_index: index[i],
            length: at(&length, i),
            data_chunk: at(&chunk, i).unwrap_or(0),
            data_file: at(&file, i).unwrap_or(0),
            from_index: at(&from, i),
            to_index: at(&to, i),
            ..EpisodeEntry::default()
        })
        .collect();
    let own = [
        "episode_index",
        "length",
        "data/chunk_index",
        "data/file_index",
        "dataset_from_index",
        "dataset_to_index",
    ];
    for (field, array) in batch.schema().fields().iter().zip(batch.columns()) {
        let name = field.name().as_str();
        if own.contains(&name) || name.starts_with("meta/") {
            continue;
        }
        for (i, entry) in entries.iter_mut().enumerate() {
            let value = json_value(array, i, 0);
            if name == "tasks" {
                let texts = value.as_array().into_iter().flatten().filter_map(Value::as_str);
                entry.tasks = texts.map(str::to_owned).collect();
            } else if let Some((key, part)) = name.strip_prefix("videos/").and_then(|n| n.rsplit_once('/')) {
                let span = entry.videos.entry(key.to_owned()).or_default();
                match part {
                    "chunk_index" => span.chunk = value.as_u64().unwrap_or(0),
                    "file_index" => span.file = value.as_u64().unwrap_or(0),
                    "from_timestamp" => span.from_timestamp_secs = value.as_f64().unwrap_or(0.0),
                    "to_timestamp" => span.to_timestamp_secs = value.as_f64().unwrap_or(0.0),
                    _ => {}
                }
            } else {
                entry.extras.insert(name.to_owned(), value);
            }
        }
    }
    Ok(entries)
}

/// Returns element `i` of a small metadata column as JSON.
pub(crate) fn json_value(array: &ArrayRef, i: usize, depth: usize) -> Value {
    if array.is_null(i) || depth > 4 {
        return Value::Null;
    }
    match array.data_type() {
        DataType::Utf8 => Value::from(array.as_string::<i32>().value(i)),
        DataType::LargeUtf8 => Value::from(array.as_string::<i64>().value(i)),
        DataType::Boolean => Value::from(array.as_boolean().value(i)),
        DataType::List(_) => list_value(&array.as_list::<i32>().value(i), depth),
        DataType::LargeList(_) => list_value(&array.as_list::<i64>().value(i), depth),
        DataType::FixedSizeList(..) => list_value(&array.as_fixed_size_list().value(i), depth),
        t if t.is_integer() => {
            let mut column = Column::int("");
            column.append(array, i, i + 1);
            column.ints().map_or(Value::Null, |v| Value::from(v[0]))
        }
        t if t.is_floating() => {
            let mut column = Column::vector("", 1);
            column.append(array, i, i + 1);
            serde_json::Number::from_f64(column.dims()[0][0]).map_or(Value::Null, Value::Number)
        }
        _ => Value::Null,
    }
}

fn list_value(items: &ArrayRef, depth: usize) -> Value {
    Value::Array((0..items.len().min(10_000)).map(|i| json_value(items, i, depth + 1)).collect())
}

fn ints(batch: &RecordBatch, name: &str) -> Option<Vec<i64>> {
    let array = batch.column_by_name(name)?;
    let mut column = Column::int(name);
    column.append(array, 0, batch.num_rows());
    column.ints().map(<[i64]>::to_vec)
}

fn texts(array: &ArrayRef) -> Vec<Option<String>> {
    (0..array.len()).map(|i| json_value(array, i, 0).as_str().map(str::to_owned)).collect()
}

/// Reads the chosen columns of a small Parquet table.
fn read_table(path: &Path, wants: impl Fn(&str) -> bool) -> Result<(Vec<RecordBatch>, Schema), String> {
    if !path.exists() {
        return Err(io::Error::from(io::ErrorKind::NotFound).to_string());
    }
    let (file, metadata) = files::open_parquet(path)?;
    files::guarded(|| {
        let schema = metadata.schema().as_ref().clone();
        let roots = schema.fields().iter().enumerate().filter(|(_, f)| wants(f.name())).map(|(i, _)| i);
        let mask = ProjectionMask::roots(metadata.parquet_schema(), roots);
        let groups = 0..metadata.metadata().num_row_groups();
        let most_rows = declared::check_pages(&file, metadata.metadata(), groups, &mask)?;
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(file, metadata);
        let reader = builder.with_projection(mask).with_batch_size(most_rows.min(1024));
        let reader = reader.build().map_err(|e| e.to_string())?;
        let batches = reader.collect::<Result<Vec<_>, _>>().map_err(|e| e.to_string())?;
        Ok((batches, schema))
    })
}

/// Compares the runs of rows with the episode table and the counts in `meta/info.json`.
pub(super) fn compare(
    files: &[DataFile],
    runs: &[Run],
    info: &Info,
    entries: &[EpisodeEntry],
    defects: &mut Vec<Defect>,
) {
    let mut listed: Vec<Defect> = Vec::new();
    let mut by_episode: BTreeMap<i64, Vec<&Run>> = BTreeMap::new();
    for run in runs {
        by_episode.entry(run.episode_index).or_default().push(run);
    }
    for (episode, runs) in by_episode.iter().filter(|(_, runs)| runs.len() > 1) {
        let got = format!("{} separate stretches", runs.len());
        listed.push(
            Defect::new(DefectKind::BrokenRuns, &files[runs[1].file].relative, "all its rows together", got)
                .in_episode(*episode),
        );
    }
    for pair in runs.windows(2).filter(|pair| pair[1].episode_index < pair[0].episode_index) {
        let expected = format!("an episode after {}", pair[0].episode_index);
        let defect = Defect::new(
            DefectKind::BrokenRuns,
            &files[pair[1].file].relative,
            expected,
            pair[1].episode_index.to_string(),
        );
        listed.push(defect.in_episode(pair[1].episode_index));
    }
    let expected_indices = by_episode.keys().copied().eq(0..by_episode.len() as i64);
    if !expected_indices {
        let first = by_episode.keys().enumerate().find(|(i, e)| *i as i64 != **e).map_or(0, |(_, e)| *e);
        let expected = format!("episode_index 0 to {} without gaps", by_episode.len().saturating_sub(1));
        listed.push(Defect::new(
            DefectKind::BrokenRuns,
            "column episode_index",
            expected,
            format!("a jump to {first}"),
        ));
    }
    let known: BTreeMap<i64, &EpisodeEntry> = entries.iter().map(|e| (e.episode_index, e)).collect();
    for (episode, runs) in &by_episode {
        let Some(entry) = known.get(episode) else {
            if !entries.is_empty() {
                listed.push(
                    Defect::new(DefectKind::EpisodeTable, "episode table", "an entry", "none")
                        .in_episode(*episode),
                );
            }
            continue;
        };
        let n_rows: u64 = runs.iter().map(|r| r.n_rows).sum();
        if entry.length != Some(n_rows) {
            let got = entry.length.map_or("nothing".to_owned(), |n| n.to_string());
            listed.push(
                Defect::new(
                    DefectKind::EpisodeTable,
                    "episode table: length",
                    format!("{n_rows} as in the data"),
                    got,
                )
                .in_episode(*episode),
            );
        } else if !info.version.is_v2() && runs.len() == 1 {
            let (from, to) = (runs[0].global_start, runs[0].global_start + n_rows);
            if (entry.from_index, entry.to_index) != (Some(from), Some(to)) {
                let got = format!("{:?} to {:?}", entry.from_index.unwrap_or(0), entry.to_index.unwrap_or(0));
                let expected = format!("rows {from} to {to}");
                listed.push(
                    Defect::new(
                        DefectKind::EpisodeTable,
                        "episode table: dataset_from_index, dataset_to_index",
                        expected,
                        got,
                    )
                    .in_episode(*episode),
                );
            }
        }
    }
    for entry in entries.iter().filter(|e| !by_episode.contains_key(&e.episode_index)) {
        listed.push(
            Defect::new(DefectKind::EpisodeTable, "episode table", "rows in the data", "none")
                .in_episode(entry.episode_index),
        );
    }
    let n_left_out = listed.len().saturating_sub(MAX_LISTED);
    listed.truncate(MAX_LISTED);
    defects.extend(listed);
    if n_left_out > 0 {
        let got = format!("{n_left_out} more defects of this kind");
        defects.push(Defect::new(DefectKind::EpisodeTable, "episode table", "agreement with the data", got));
    }
    let n_rows: u64 = files.iter().map(|f| f.n_rows).sum();
    for (key, declared, actual) in [
        ("total_frames", info.total_frames, n_rows),
        ("total_episodes", info.total_episodes, by_episode.len() as u64),
    ] {
        if let Some(declared) = declared.filter(|d| *d != actual) {
            let place = format!("meta/info.json {key}");
            defects.push(Defect::new(
                DefectKind::WrongCount,
                place,
                format!("{actual} as in the data"),
                declared.to_string(),
            ));
        }
    }
}
