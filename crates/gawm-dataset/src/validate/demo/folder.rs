//! Writes a synthetic dataset as a LeRobot v3 folder, defects and all.

use std::{collections::HashMap, fs, io, path::Path, sync::Arc};

use arrow::{
    array::{
        ArrayRef, BinaryArray, BooleanArray, Float32Array, Int64Array, ListArray, RecordBatch, StringArray,
        StructArray,
    },
    buffer::{NullBuffer, OffsetBuffer},
    datatypes::{DataType, Field, Fields, Schema},
};
use parquet::arrow::ArrowWriter;
use serde_json::{Value, json};

use super::world::{FPS, JOINTS, STATE_NAMES, World};

/// Names of the cameras.
pub(super) const CAMERAS: [&str; 2] = ["observation.images.front", "observation.images.wrist"];

/// Pandas' description of the task table.
const PANDAS: &str = r#"{"index_columns":["task"],"columns":[{"name":"task_index","field_name":"task_index","pandas_type":"int64","numpy_type":"int64","metadata":null},{"name":"task","field_name":"task","pandas_type":"unicode","numpy_type":"object","metadata":null}],"column_indexes":[]}"#;

/// Writes the folder.
pub(super) fn write(world: &World, dir: &Path) -> io::Result<()> {
    for folder in ["meta/episodes/chunk-000", "data/chunk-000"] {
        fs::create_dir_all(dir.join(folder))?;
    }
    let data = dir.join("data/chunk-000/file-000.parquet");
    write_parquet(&data, &rows(world)?)?;
    if let Some(share) = world.folder.cut_bytes {
        let bytes = fs::read(&data)?;
        let kept = (bytes.len() as f64 * (1.0 - share)) as usize;
        fs::write(&data, &bytes[..kept])?;
    }
    write_parquet(&dir.join("meta/episodes/chunk-000/file-000.parquet"), &episode_table(world)?)?;
    let texts = StringArray::from_iter_values(&world.tasks);
    let mut metadata = HashMap::new();
    if !world.folder.without_pandas {
        metadata.insert("pandas".to_owned(), PANDAS.to_owned());
    }
    let fields =
        vec![Field::new("task_index", DataType::Int64, false), Field::new("task", DataType::Utf8, false)];
    let schema = Schema::new_with_metadata(fields, metadata);
    let columns: Vec<ArrayRef> =
        vec![Arc::new(Int64Array::from_iter_values(0..world.tasks.len() as i64)), Arc::new(texts)];
    write_parquet(&dir.join("meta/tasks.parquet"), &batch(schema, columns)?)?;
    let stats = serde_json::to_string_pretty(&stats(world)).map_err(io::Error::other)?;
    fs::write(
        dir.join("meta/stats.json"),
        if world.folder.garbled_meta { stats.replace("0.", "NaN,") } else { stats },
    )?;
    let info = serde_json::to_string_pretty(&info(world)).map_err(io::Error::other)?;
    fs::write(dir.join("meta/info.json"), info)
}

fn write_parquet(path: &Path, batch: &RecordBatch) -> io::Result<()> {
    let file = fs::File::create(path)?;
    let mut writer = ArrowWriter::try_new(file, batch.schema(), None).map_err(io::Error::other)?;
    writer.write(batch).map_err(io::Error::other)?;
    writer.close().map_err(io::Error::other)?;
    Ok(())
}

fn batch(schema: Schema, columns: Vec<ArrayRef>) -> io::Result<RecordBatch> {
    RecordBatch::try_new(Arc::new(schema), columns).map_err(io::Error::other)
}

fn order(world: &World) -> Vec<usize> {
    world.folder.order.clone().unwrap_or_else(|| (0..world.episodes.len()).collect())
}

fn rows(world: &World) -> io::Result<RecordBatch> {
    let mut columns: Vec<(String, ArrayRef)> = Vec::new();
    let order = order(world);
    let episodes = || order.iter().map(|i| (*i, &world.episodes[*i]));
    let floats = |values: Vec<f32>| Arc::new(Float32Array::from(values)) as ArrayRef;
    let ints = |values: Vec<i64>| Arc::new(Int64Array::from(values)) as ArrayRef;
    let mut global = 0;
    let mut index = Vec::new();
    for (_, episode) in episodes() {
        for shift in &episode.index_shift {
            index.push(global + shift);
            global += 1;
        }
    }
    columns.push((
        "timestamp".into(),
        floats(episodes().flat_map(|(_, e)| e.timestamp.iter().map(|v| *v as f32)).collect()),
    ));
    columns.push(("frame_index".into(), ints(episodes().flat_map(|(_, e)| e.frame_index.clone()).collect())));
    columns.push((
        "episode_index".into(),
        ints(episodes().flat_map(|(i, e)| vec![i as i64; e.n_rows()]).collect()),
    ));
    columns.push(("index".into(), ints(index)));
    columns.push(("task_index".into(), ints(episodes().flat_map(|(_, e)| e.task_index.clone()).collect())));
    columns.push(("gawm.time_ns".into(), ints(episodes().flat_map(|(_, e)| e.time_ns.clone()).collect())));
    let groups: [(&str, DimsOf); 6] = [
        ("observation.state", |e| &e.state),
        ("action", |e| &e.action),
        ("observation.heading", |e| &e.heading),
        ("observation.tool_rot6d", |e| &e.six),
        ("gawm.age_ms", |e| &e.age_ms),
        ("gawm.arrival_age_ms", |e| &e.arrival_age_ms),
    ];
    for (name, of) in groups {
        let mut lists = Lists::default();
        for (_, episode) in episodes() {
            for row in 0..episode.n_rows() {
                let is_state = name == "observation.state";
                let is_null = is_state && episode.null_states.contains(&row);
                let is_short = is_state && episode.short_states.contains(&row);
                lists.push(of(episode), row, is_null, is_short);
            }
        }
        columns.push((name.to_owned(), lists.finish()));
    }
    if world.episodes.iter().all(|e| !e.frames.is_empty()) {
        for (camera, name) in CAMERAS.iter().enumerate() {
            let frames: Vec<Option<&[u8]>> =
                episodes().flat_map(|(_, e)| e.frames[camera].iter().map(|f| f.as_deref())).collect();
            columns.push(((*name).to_owned(), image_array(frames)));
        }
    }
    if let Some(name) = world.folder.extra_column {
        let n = columns[0].1.len();
        columns.push((name.to_owned(), floats(vec![0.5; n])));
    }
    columns.retain(|(name, _)| Some(name.as_str()) != world.folder.dropped_column);
    let fields: Vec<Field> =
        columns.iter().map(|(n, a)| Field::new(n, a.data_type().clone(), true)).collect();
    batch(Schema::new(fields), columns.into_iter().map(|(_, a)| a).collect())
}

/// Picks a group of dims of an episode.
type DimsOf = fn(&super::world::Episode) -> &Vec<Vec<f64>>;

#[derive(Default)]
struct Lists {
    values: Vec<f32>,
    lengths: Vec<usize>,
    valid: Vec<bool>,
}

impl Lists {
    fn push(&mut self, dims: &[Vec<f64>], row: usize, is_null: bool, is_short: bool) {
        let n = if is_null { 0 } else { dims.len() - usize::from(is_short) };
        self.values.extend(dims[..n].iter().map(|d| d[row] as f32));
        self.lengths.push(n);
        self.valid.push(!is_null);
    }

    fn finish(self) -> ArrayRef {
        let field = Arc::new(Field::new_list_field(DataType::Float32, true));
        let nulls = self.valid.contains(&false).then(|| NullBuffer::from(self.valid));
        Arc::new(ListArray::new(
            field,
            OffsetBuffer::from_lengths(self.lengths),
            Arc::new(Float32Array::from(self.values)),
            nulls,
        ))
    }
}

fn image_array(frames: Vec<Option<&[u8]>>) -> ArrayRef {
    let n = frames.len();
    let bytes: ArrayRef = Arc::new(BinaryArray::from(frames));
    let path: ArrayRef = Arc::new(StringArray::new_null(n));
    let fields = Fields::from(vec![
        Field::new("bytes", DataType::Binary, true),
        Field::new("path", DataType::Utf8, true),
    ]);
    Arc::new(StructArray::new(fields, vec![bytes, path], None))
}

fn episode_table(world: &World) -> io::Result<RecordBatch> {
    let mut from = vec![0i64; world.episodes.len()];
    let mut global = 0;
    for i in order(world) {
        from[i] = global;
        global += world.episodes[i].n_rows() as i64;
    }
    let extra = |i: usize| world.folder.extra_length.iter().find(|(e, _)| *e == i).map_or(0, |(_, n)| *n);
    let n = world.episodes.len();
    let ints = |f: &dyn Fn(usize) -> i64| Arc::new(Int64Array::from_iter_values((0..n).map(f))) as ArrayRef;
    let texts =
        |f: &dyn Fn(usize) -> String| Arc::new(StringArray::from_iter_values((0..n).map(f))) as ArrayRef;
    let length = |i: usize| world.episodes[i].n_rows() as i64 + extra(i);
    let task = |i: usize| {
        let index = world.episodes[i].task_index.first().copied().unwrap_or(0) as usize;
        world.tasks.get(index).cloned().unwrap_or_default()
    };
    let tasks = ListArray::new(
        Arc::new(Field::new_list_field(DataType::Utf8, true)),
        OffsetBuffer::from_lengths(vec![1; n]),
        texts(&task),
        None,
    );
    let success: ArrayRef =
        Arc::new(BooleanArray::from(world.episodes.iter().map(|e| e.success).collect::<Vec<_>>()));
    let columns: Vec<(&str, ArrayRef)> = vec![
        ("episode_index", ints(&|i| i as i64)),
        ("tasks", Arc::new(tasks)),
        ("length", ints(&length)),
        ("data/chunk_index", ints(&|_| 0)),
        ("data/file_index", ints(&|_| 0)),
        ("dataset_from_index", ints(&|i| from[i])),
        ("dataset_to_index", ints(&|i| from[i] + length(i))),
        ("success", success),
        ("session", texts(&|i| world.episodes[i].session.clone())),
        ("split", texts(&|i| world.episodes[i].split.clone())),
    ];
    let fields: Vec<Field> =
        columns.iter().map(|(n, a)| Field::new(*n, a.data_type().clone(), true)).collect();
    batch(Schema::new(fields), columns.into_iter().map(|(_, a)| a).collect())
}

fn info(world: &World) -> Value {
    let mut features = serde_json::Map::new();
    let mut add = |name: &str, dtype: &str, shape: Value, names: Value, units: Value| {
        features
            .insert(name.to_owned(), json!({"dtype": dtype, "shape": shape, "names": names, "units": units}));
    };
    add("timestamp", "float32", json!([1]), Value::Null, Value::Null);
    for name in ["frame_index", "episode_index", "index", "task_index", "gawm.time_ns"] {
        add(name, "int64", json!([1]), Value::Null, Value::Null);
    }
    let units = |n: usize| -> Value {
        (0..n)
            .map(|i| {
                if i < JOINTS {
                    "rad"
                } else if (7..10).contains(&i) {
                    "m"
                } else {
                    "1"
                }
            })
            .collect()
    };
    let dtype = world.folder.action_dtype.unwrap_or("float32");
    add(
        "observation.state",
        "float32",
        json!([STATE_NAMES.len()]),
        json!(STATE_NAMES),
        units(STATE_NAMES.len()),
    );
    add("action", dtype, json!([JOINTS + 1]), json!(STATE_NAMES[..=JOINTS]), units(JOINTS + 1));
    add("observation.heading", "float32", json!([2]), json!(["heading_sin", "heading_cos"]), Value::Null);
    let six: Vec<String> = (0..6).map(|i| format!("tool_6d_{i}")).collect();
    add("observation.tool_rot6d", "float32", json!([6]), json!(six), Value::Null);
    for name in ["gawm.age_ms", "gawm.arrival_age_ms"] {
        add(name, "float32", json!([2]), json!(["joints", "camera"]), Value::Null);
    }
    if world.episodes.iter().all(|e| !e.frames.is_empty()) {
        for camera in CAMERAS {
            add(camera, "image", json!([32, 32, 3]), json!(["height", "width", "channels"]), Value::Null);
        }
    }
    let n_frames: usize = world.episodes.iter().map(|e| e.n_rows()).sum();
    let splits = world.folder.splits.clone().unwrap_or_else(|| format!("0:{}", world.episodes.len()));
    json!({
        "codebase_version": "v3.0", "robot_type": "synthetic", "total_episodes": world.episodes.len(),
        "total_frames": n_frames as i64 + world.folder.extra_frames, "total_tasks": world.tasks.len(), "chunks_size": 1000,
        "data_files_size_in_mb": 100, "video_files_size_in_mb": 200, "fps": FPS as u64, "splits": {"train": splits},
        "data_path": world.folder.data_path.clone().unwrap_or_else(|| "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet".to_owned()),
        "video_path": null, "features": features,
    })
}

fn stats(world: &World) -> Value {
    let of = |dims: fn(&super::world::Episode) -> &Vec<Vec<f64>>| {
        let width = dims(&world.episodes[0]).len();
        let column = |d: usize| {
            world
                .episodes
                .iter()
                .flat_map(move |e| dims(e)[d].iter().copied())
                .filter(|v| v.is_finite())
                .collect::<Vec<f64>>()
        };
        let columns: Vec<Vec<f64>> = (0..width).map(column).collect();
        let mean = |c: &Vec<f64>| c.iter().sum::<f64>() / c.len().max(1) as f64 + world.folder.stats_shift;
        let min = |c: &Vec<f64>| c.iter().copied().fold(f64::INFINITY, f64::min);
        let max = |c: &Vec<f64>| c.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let std = |c: &Vec<f64>| {
            let m = c.iter().sum::<f64>() / c.len().max(1) as f64;
            (c.iter().map(|v| (v - m) * (v - m)).sum::<f64>() / c.len().max(1) as f64).sqrt()
        };
        json!({
            "mean": columns.iter().map(mean).collect::<Vec<_>>(), "min": columns.iter().map(min).collect::<Vec<_>>(),
            "max": columns.iter().map(max).collect::<Vec<_>>(), "std": columns.iter().map(std).collect::<Vec<_>>(),
            "count": [columns[0].len()],
        })
    };
    json!({"observation.state": of(|e| &e.state), "action": of(|e| &e.action)})
}
