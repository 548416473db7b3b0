//! Folders made here: their rows, what disagrees, and damage.

use std::path::Path;
use std::sync::Arc;

use arrow::array::{
    ArrayRef, BinaryArray, BooleanArray, FixedSizeListArray, Float32Array, Int64Array, ListArray,
    RecordBatch, StringArray, StructArray,
};
use arrow::buffer::{NullBuffer, OffsetBuffer};
use arrow::datatypes::{DataType, Field, Schema};
use parquet::arrow::ArrowWriter;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

use super::*;
use crate::decode::{ChannelSchema, DecodePlan, ImagePlan, RowSink, SchemaLibrary, Value};
use crate::rows::{EPISODE_GAP_NS, RowRecording as _};

const INFO: &str = r#"{"codebase_version": "v2.1", "robot_type": "arm", "total_episodes": 2, "total_frames": 9,
 "total_tasks": 1, "chunks_size": 1000, "fps": 10, "splits": {"train": "0:2"},
 "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet", "video_path": null,
 "features": {"action": {"dtype": "float32", "shape": [2], "names": ["x", "y"]},
  "matrix": {"dtype": "float32", "shape": [2, 2], "names": null},
  "flag": {"dtype": "bool", "shape": [1], "names": null},
  "note": {"dtype": "string", "shape": [1], "names": null},
  "observation.images.front": {"dtype": "image", "shape": [2, 2, 3], "names": ["height", "width", "channels"]},
  "observation.images.side": {"dtype": "video", "shape": [2, 2, 3], "names": ["height", "width", "channels"]}}}"#;

fn png(value: u8) -> Vec<u8> {
    let image = gawm_image::Image::try_new(2, 2, gawm_image::Pixels::Rgb8(vec![value; 12])).unwrap();
    gawm_image::encode_png(&image).unwrap()
}

/// Rows of an episode: action [i, -i], matrix i..i+4, one null action, one image by its path.
fn batch(episode: i64, frames: &[i64], is_odd: bool) -> RecordBatch {
    let n = frames.len();
    let index = |i: usize| (episode * 100 + i as i64) as f32;
    let actions = Float32Array::from_iter_values((0..n).flat_map(|i| [index(i), -index(i)]));
    let item = |kind: DataType, is_nullable: bool| Arc::new(Field::new("element", kind, is_nullable));
    let nulls = is_odd.then(|| NullBuffer::from_iter((0..n).map(|i| i != 1)));
    let offsets = OffsetBuffer::from_lengths(std::iter::repeat_n(2, n));
    let action = ListArray::new(item(DataType::Float32, true), offsets, Arc::new(actions), nulls);
    let cells = Float32Array::from_iter_values((0..n).flat_map(|i| (0..4).map(move |k| index(i) + k as f32)));
    let inner = FixedSizeListArray::new(item(DataType::Float32, true), 2, Arc::new(cells), None);
    let offsets = OffsetBuffer::from_lengths(std::iter::repeat_n(2, n));
    let matrix = ListArray::new(item(inner.data_type_of(), true), offsets, Arc::new(inner), None);
    let images: Vec<Option<Vec<u8>>> = (0..n).map(|i| (!is_odd || i != 2).then(|| png(i as u8))).collect();
    let bytes: ArrayRef = Arc::new(BinaryArray::from_iter(images));
    let paths: ArrayRef = Arc::new(StringArray::from_iter((0..n).map(|i| match (is_odd, i) {
        (true, 2) => Some("images/two.png"),
        (true, 3) => Some("../outside.png"),
        _ => None,
    })));
    let camera = StructArray::from(vec![
        (Arc::new(Field::new("bytes", DataType::Binary, true)), bytes),
        (Arc::new(Field::new("path", DataType::Utf8, true)), paths),
    ]);
    let columns: Vec<(&str, ArrayRef)> = vec![
        ("action", Arc::new(action)),
        ("matrix", Arc::new(matrix)),
        ("flag", Arc::new(BooleanArray::from_iter((0..n).map(|i| Some(i % 2 == 0))))),
        ("note", Arc::new(StringArray::from_iter_values((0..n).map(|i| format!("row {i}"))))),
        ("observation.images.front", Arc::new(camera)),
        ("timestamp", Arc::new(Float32Array::from_iter_values(frames.iter().map(|f| *f as f32 / 10.0)))),
        ("frame_index", Arc::new(Int64Array::from_iter_values(frames.iter().copied()))),
        ("episode_index", Arc::new(Int64Array::from_iter_values(std::iter::repeat_n(episode, n)))),
        ("index", Arc::new(Int64Array::from_iter_values((0..n as i64).map(|i| episode * 5 + i)))),
        ("task_index", Arc::new(Int64Array::from_iter_values(std::iter::repeat_n(0, n)))),
    ];
    let fields: Vec<Field> =
        columns.iter().map(|(name, array)| Field::new(*name, array.data_type().clone(), true)).collect();
    let arrays = columns.into_iter().map(|(_, array)| array).collect();
    RecordBatch::try_new(Arc::new(Schema::new(fields)), arrays).unwrap()
}

/// Writes a data file with the state [i, -i] in each row.
#[cfg(feature = "video")]
pub(crate) fn write_rows(path: &Path, episode: i64, n_rows: usize) {
    let frames: Vec<i64> = (0..n_rows as i64).collect();
    let rows = batch(episode, &frames, false);
    let columns = ["action", "timestamp", "frame_index", "episode_index", "index", "task_index"];
    let at = |name: &&str| rows.schema().index_of(name).unwrap();
    let rows = rows.project(&columns.iter().map(at).collect::<Vec<_>>()).unwrap();
    let mut fields: Vec<Field> = rows.schema().fields().iter().map(|field| field.as_ref().clone()).collect();
    fields[0] = fields[0].clone().with_name("observation.state");
    let rows = RecordBatch::try_new(Arc::new(Schema::new(fields)), rows.columns().to_vec()).unwrap();
    let mut writer = ArrowWriter::try_new(std::fs::File::create(path).unwrap(), rows.schema(), None).unwrap();
    writer.write(&rows).unwrap();
    writer.close().unwrap();
}

trait DataTypeOf {
    fn data_type_of(&self) -> DataType;
}

impl DataTypeOf for FixedSizeListArray {
    fn data_type_of(&self) -> DataType {
        arrow::array::Array::data_type(self).clone()
    }
}

/// A v2.1 folder of two episodes; the second has a hole in its frames, a null action, and images by their paths.
fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for sub in ["meta", "data/chunk-000", "images"] {
        std::fs::create_dir_all(dir.path().join(sub)).unwrap();
    }
    let write = |name: &str, text: &str| std::fs::write(dir.path().join(name), text).unwrap();
    write("meta/info.json", INFO);
    write("meta/tasks.jsonl", "{\"task_index\": 0, \"task\": \"push the block\"}\n");
    write(
        "meta/episodes.jsonl",
        "{\"episode_index\": 0, \"tasks\": [\"push the block\"], \"length\": 5, \"success\": true}\n{\"episode_index\": 1, \"tasks\": [\"push the block\"], \"length\": 7}\n",
    );
    std::fs::write(dir.path().join("images/two.png"), png(2)).unwrap();
    for (episode, frames) in [(0, vec![0, 1, 2, 3, 4]), (1, vec![0, 1, 2, 5])] {
        let batch = batch(episode, &frames, episode == 1);
        let path = dir.path().join(format!("data/chunk-000/episode_{episode:06}.parquet"));
        let mut writer =
            ArrowWriter::try_new(std::fs::File::create(path).unwrap(), batch.schema(), None).unwrap();
        writer.write(&batch).unwrap();
        writer.close().unwrap();
    }
    dir
}

/// All values at a path, with their times.
fn values(recording: &LerobotRecording, topic: &str, path: &str) -> Vec<(u64, Value)> {
    let library = SchemaLibrary::builtin();
    let mut out = Vec::new();
    for block in recording.blocks() {
        let read = recording.read_block(block);
        for message in read.messages.iter().filter(|message| read.channel(message).topic == topic) {
            let channel = ChannelSchema::from(&**read.channel(message));
            let plan = DecodePlan::compile(&channel, &[path.parse().unwrap()], &library).unwrap();
            let (_, found) = plan.decode_values(read.payload(message), &mut RowSink::new()).unwrap();
            out.push((message.log_time_ns, found.into_iter().next().unwrap()));
        }
    }
    out
}

#[test]
fn rows_are_messages_with_what_the_folder_says() {
    let dir = folder();
    let recording = LerobotRecording::open(dir.path()).unwrap();
    assert_eq!(recording.counts(), (2, 9));
    let start = EPISODE_GAP_NS as u64;
    let actions = values(&recording, "action", "data[1]");
    assert_eq!(actions.len(), 8, "the null one has no message");
    assert_eq!(actions[3], (start + 300_000_000, Value::F64(-3.0)));
    let second = start + 400_000_000 + start;
    assert_eq!(
        actions[7],
        (second + 500_000_000, Value::F64(-103.0)),
        "the hole in frame_index is one in time"
    );
    assert_eq!(values(&recording, "matrix", "data[3]")[4].1, Value::F64(7.0));
    assert_eq!(values(&recording, "flag", "data")[1].1, Value::Bool(false));
    assert_eq!(values(&recording, "note", "data")[8].1, Value::Text("row 3".to_owned()));
    let record = &recording.metadata()[0].values;
    assert_eq!((record["task"].as_str(), record["success"].as_str()), ("push the block", "true"));
    let said: String = recording.damage().iter().map(|found| found.detail.clone() + "\n").collect();
    for words in ["frame_index has holes", "observation.images.side", "no video file", "7"] {
        assert!(said.contains(words), "{words:?} in {said}");
    }
}

#[test]
fn images_come_from_cells_and_from_paths_inside() {
    let dir = folder();
    let recording = LerobotRecording::open(dir.path()).unwrap();
    let library = SchemaLibrary::builtin();
    let (mut found, mut said) = (Vec::new(), String::new());
    for block in recording.blocks() {
        let read = recording.read_block(block);
        said.extend(read.damage.iter().map(|damage| damage.detail.clone()));
        for message in &read.messages {
            let channel = ChannelSchema::from(&**read.channel(message));
            if channel.topic == "observation.images.front" {
                let plan = ImagePlan::compile(&channel, &library).unwrap();
                let image = plan.extract(read.payload(message), &mut RowSink::new()).unwrap();
                assert_eq!(image.stamp_ns, i64::try_from(message.log_time_ns).ok());
                found.push(image.data.into_owned());
            }
        }
    }
    let expected: Vec<Vec<u8>> = [0, 1, 2, 3, 4, 0, 1, 2, 3].map(png).to_vec();
    assert_eq!(found, expected);
    assert!(said.contains("action: 1 rows have no value (null)"), "{said}");
    // A path that leads out of the folder is not followed; here the cell holds bytes, so that nobody asks for it.
    std::fs::remove_file(dir.path().join("images/two.png")).unwrap();
    let recording = LerobotRecording::open(dir.path()).unwrap();
    let lost: Vec<String> =
        recording.blocks().iter().flat_map(|b| recording.read_block(b).damage).map(|d| d.detail).collect();
    assert!(lost.iter().any(|detail| detail.contains("images/two.png")), "{lost:?}");
}

fn check_refused(change: impl Fn(&Path), expected: &str) {
    let dir = folder();
    change(dir.path());
    match LerobotRecording::open(dir.path()) {
        Ok(_) => panic!("expected {expected:?}"),
        Err(error) => assert!(error.to_string().contains(expected), "{error}"),
    }
}

#[test]
fn folders_without_what_is_needed_are_refused() {
    check_refused(|dir| std::fs::write(dir.join("meta/info.json"), "").unwrap(), "meta/info.json");
    check_refused(
        |dir| std::fs::write(dir.join("meta/info.json"), "{\"fps\": 1}").unwrap(),
        "codebase_version",
    );
    check_refused(
        |dir| std::fs::write(dir.join("meta/info.json"), INFO.replace("\"fps\": 10", "\"fps\": 0")).unwrap(),
        "fps",
    );
    check_refused(|dir| std::fs::remove_dir_all(dir.join("data")).unwrap(), "no readable data file");
}

#[test]
fn damaged_folders_are_errors_or_losses() {
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let dir = folder();
    let names = ["data/chunk-000/episode_000001.parquet", "meta/info.json", "meta/episodes.jsonl"];
    let (mut n_whole, mut n_lost, mut n_refused) = (0, 0, 0);
    for name in names {
        let path = dir.path().join(name);
        let whole = std::fs::read(&path).unwrap();
        for round in 0..120 {
            let mut bytes = whole.clone();
            if round % 4 == 0 {
                bytes.truncate(random.next_u32() as usize % bytes.len());
            } else {
                for _ in 0..=random.next_u32() % 6 {
                    let at = random.next_u32() as usize % bytes.len();
                    bytes[at] = random.next_u32() as u8;
                }
            }
            std::fs::write(&path, &bytes).unwrap();
            match LerobotRecording::open(dir.path()) {
                Err(_) => n_refused += 1,
                Ok(recording) => {
                    let lost = recording.blocks().iter().any(|b| {
                        recording.read_block(b).damage.iter().any(|found| found.detail.contains("rows "))
                    });
                    *(if lost { &mut n_lost } else { &mut n_whole }) += 1;
                }
            }
        }
        std::fs::write(&path, &whole).unwrap();
    }
    assert!(n_refused > 20 && n_lost > 20, "{n_refused} refused, {n_lost} with losses, {n_whole} whole");
}
