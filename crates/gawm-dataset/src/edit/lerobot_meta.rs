//! The metadata of a LeRobot v3.0 folder that an edit wrote: info, tasks, episodes, statistics.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::{Map, Value, json};

use super::episode_columns::{episode_table, video_statistics};
use super::lerobot_output::OutEpisode;
use super::{EditError, Input};
use crate::durable::Disk;
use crate::episode::FeatureStats;
use crate::journal::to_json;
use crate::layout::{EPISODES, INFO, STATS, TASKS};
use crate::read::{Dataset, ReadLimits};
use crate::stats::{camera_counts, dataset_stats, lerobot_stats};
use crate::tables::tasks_table;

/// Files beside the tables that describe columns, not rows.
const KEPT_FILES: [&str; 1] = ["meta/modality.json"];

/// Checks that inputs have the same columns, rate and robot; returns what is worth knowing.
pub(super) fn check_equal(inputs: &[Input]) -> Result<Vec<String>, EditError> {
    let first = &inputs[0];
    for other in &inputs[1..] {
        let different = |place: String, expected: String, got: String| EditError::Different {
            first: first.dataset.root.clone(),
            second: other.dataset.root.clone(),
            place,
            expected,
            got,
        };
        let (a, b) = (&first.dataset.info, &other.dataset.info);
        if first.gawm.is_some() != other.gawm.is_some() {
            let kind = |input: &Input| if input.gawm.is_some() { "gawm" } else { "LeRobot" }.to_owned();
            return Err(different("format".to_owned(), kind(first), kind(other)));
        }
        if a.fps != b.fps {
            return Err(different("fps".to_owned(), a.fps.to_string(), b.fps.to_string()));
        }
        if a.robot_type != b.robot_type {
            let text = |robot: &Option<String>| robot.clone().unwrap_or_else(|| "none".to_owned());
            return Err(different("robot_type".to_owned(), text(&a.robot_type), text(&b.robot_type)));
        }
        let (a, b) = (features(first), features(other));
        for name in a.keys().chain(b.keys()) {
            let describe = |features: &Map<String, Value>| match features.get(name) {
                None => "no such feature".to_owned(),
                Some(f) => json!([f.get("dtype"), f.get("shape"), f.get("names")]).to_string(),
            };
            if describe(&a) != describe(&b) {
                return Err(different(format!("feature {name:?}"), describe(&a), describe(&b)));
            }
        }
    }
    let fps = first.dataset.info.fps;
    let mut notes = Vec::new();
    if fps.fract() != 0.0 {
        notes.push(format!(
            "fps is {fps}; LeRobot v3 wants a whole number: {} is written, and timestamps follow it",
            crate::columns::fps(fps)
        ));
    }
    if inputs.iter().any(|input| input.dataset.info.version.is_v2()) {
        notes.push("LeRobot v2 folders are written as v3.0".to_owned());
    }
    for input in inputs {
        let dropped = input.dataset.info.features.iter().filter(|f| input.is_dropped(f));
        notes.extend(dropped.map(|f| format!("camera {} is left out", f.name)));
    }
    Ok(notes)
}

/// Returns the declarations of the output: numbers first, then those of the input.
fn features(input: &Input) -> Map<String, Value> {
    let mut features = Map::new();
    let mut number = |name: &str, dtype: &str| {
        features.insert(name.to_owned(), json!({"dtype": dtype, "shape": [1], "names": null}));
    };
    number("timestamp", "float32");
    for name in ["frame_index", "episode_index", "index", "task_index"] {
        number(name, "int64");
    }
    let declared = input.dataset.info.raw.get("features").and_then(Value::as_object);
    for (name, value) in declared.into_iter().flatten() {
        let is_dropped = input.dataset.info.feature(name).is_some_and(|f| input.is_dropped(f));
        if features.contains_key(name) || is_dropped {
            continue;
        }
        let mut value = value.clone();
        if let Some(object) = value.as_object_mut() {
            // lerobot takes the key without asking.
            object.entry("names").or_insert(Value::Null);
        }
        features.insert(name.clone(), value);
    }
    features
}

/// Writes everything but the data files; `meta/info.json` last.
pub(super) fn write(
    inputs: &[Input],
    episodes: &[OutEpisode<'_>],
    tasks: &[String],
    images: &[String],
    dir: &Path,
) -> Result<Vec<String>, EditError> {
    let mut notes = Vec::new();
    let tasks = if tasks.is_empty() { vec![String::new()] } else { tasks.to_vec() };
    write_file(dir, TASKS, &tasks_table(&tasks)?)?;
    write_file(dir, EPISODES, &episode_table(inputs, episodes, &[])?)?;
    let info = info(inputs, episodes, tasks.len(), &mut notes);
    write_file(dir, INFO, &to_json(Path::new(INFO), &info)?)?;
    // Statistics are those that the verb `stats` gives of the rows as they were written.
    let dataset = Dataset::open(dir, ReadLimits::default())?;
    let stats = dataset_stats(&dataset)?;
    let (cameras, per_run) = camera_counts(&dataset);
    let mut per_episode: Vec<BTreeMap<String, FeatureStats>> = Vec::with_capacity(episodes.len());
    for (position, summary) in stats.episodes.iter().enumerate() {
        let mut features = BTreeMap::new();
        for (column, dims) in &summary.columns {
            let dims: Vec<_> = dims.iter().map(|dim| dim.values.clone()).collect();
            features.insert(column.clone(), FeatureStats::of(&dims));
        }
        for camera in images {
            if let Some(found) = per_run.get(camera).and_then(|runs| runs.get(position)) {
                features.insert(camera.clone(), found.feature_stats());
            }
        }
        per_episode.push(features);
    }
    let mut all = lerobot_stats(&dataset, &stats, &cameras);
    let videos = video_statistics(inputs, episodes, &mut per_episode);
    if let Some(object) = all.as_object_mut() {
        object.extend(videos);
    }
    write_file(dir, EPISODES, &episode_table(inputs, episodes, &per_episode)?)?;
    write_file(dir, STATS, &to_json(Path::new(STATS), &all)?)?;
    keep_files(inputs, dir, &mut notes)?;
    Ok(notes)
}

fn write_file(dir: &Path, name: &str, bytes: &[u8]) -> Result<(), EditError> {
    let path = dir.join(name);
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(EditError::io("create", folder))?;
    }
    Disk::default().write_whole(&path, bytes).map_err(EditError::io("write", &path))
}

fn info(inputs: &[Input], episodes: &[OutEpisode<'_>], n_tasks: usize, notes: &mut Vec<String>) -> Value {
    let first = &inputs[0];
    let features = features(first);
    let has_videos = !first.videos().is_empty();
    let size = |key: &str, default: u64| {
        first.dataset.info.raw.get(key).and_then(Value::as_u64).filter(|n| *n > 0).unwrap_or(default)
    };
    json!({
        "codebase_version": "v3.0",
        "robot_type": first.dataset.info.robot_type,
        "total_episodes": episodes.len(),
        "total_frames": episodes.iter().map(|episode| episode.length).sum::<u64>(),
        "total_tasks": n_tasks,
        "chunks_size": crate::layout::FILES_PER_CHUNK,
        "data_files_size_in_mb": size("data_files_size_in_mb", 100),
        "video_files_size_in_mb": size("video_files_size_in_mb", 200),
        "fps": crate::columns::fps(first.dataset.info.fps),
        "splits": splits(inputs, episodes, notes),
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": has_videos.then_some("videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"),
        "features": features,
    })
}

/// Returns the named ranges of episodes, moved with their episodes; what is no range any more becomes `train`.
fn splits(inputs: &[Input], episodes: &[OutEpisode<'_>], notes: &mut Vec<String>) -> Value {
    let all = json!({"train": format!("0:{}", episodes.len())});
    let mut moved: BTreeMap<&str, Vec<usize>> = BTreeMap::new();
    for (position, episode) in episodes.iter().enumerate() {
        let dataset = &inputs[episode.piece.input].dataset;
        let index = dataset.runs[episode.piece.run].episode_index;
        let is_in = |range: &str| {
            let ends = range.split_once(':').map(|(a, b)| (a.trim().parse(), b.trim().parse()));
            matches!(ends, Some((Ok(from), Ok(to))) if (from..to).contains(&index))
        };
        for (name, _) in dataset.info.splits.iter().filter(|(_, range)| is_in(range)) {
            moved.entry(name).or_default().push(position);
        }
    }
    let is_cover = moved.values().map(Vec::len).sum::<usize>() == episodes.len();
    let is_range = |of: &Vec<usize>| of.windows(2).all(|pair| pair[1] == pair[0] + 1);
    if moved.is_empty() || !is_cover || !moved.values().all(is_range) {
        if moved.len() > 1 {
            notes.push(
                "the splits of meta/info.json are no ranges any more: all episodes are \"train\"".to_owned(),
            );
        }
        return all;
    }
    let range = |of: &Vec<usize>| {
        format!("{}:{}", of.first().copied().unwrap_or(0), of.last().map_or(0, |last| last + 1))
    };
    moved.iter().map(|(name, of)| ((*name).to_owned(), Value::from(range(of)))).collect::<Map<_, _>>().into()
}

/// Takes over files that describe columns, and names those that are not taken over.
fn keep_files(inputs: &[Input], dir: &Path, notes: &mut Vec<String>) -> Result<(), EditError> {
    let first = &inputs[0].dataset;
    for name in KEPT_FILES {
        let mut defects = Vec::new();
        let value = crate::read::read_json(&first.root, name, &first.limits, &mut defects);
        if let Some(value) = value {
            write_file(dir, name, &to_json(Path::new(name), &value)?)?;
        }
    }
    let known = [
        "info.json",
        "stats.json",
        "tasks.parquet",
        "tasks.jsonl",
        "episodes",
        "episodes.jsonl",
        "episodes_stats.jsonl",
        "modality.json",
        "gawm-edits.json",
    ];
    for input in inputs {
        let entries = std::fs::read_dir(input.dataset.root.join("meta")).into_iter().flatten().flatten();
        let mut names: Vec<String> = entries.map(|e| e.file_name().to_string_lossy().into_owned()).collect();
        names.retain(|name| !known.contains(&name.as_str()));
        names.sort();
        if !names.is_empty() {
            notes.push(format!(
                "not taken over from meta/ of {}: {}",
                input.dataset.name(),
                names.join(", ")
            ));
        }
    }
    Ok(())
}
