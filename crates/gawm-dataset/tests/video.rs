//! Frames of videos: each belongs to its row, and what is wrong with them is found.
#![cfg(feature = "video")]
#![cfg_attr(feature = "video", expect(clippy::unwrap_used, reason = "a test stops where its set-up fails"))]

use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use arrow::array::{ArrayRef, Float32Array, Int64Array, RecordBatch};
use gawm_dataset::read::{Dataset, FrameBytes, ReadLimits};
use gawm_dataset::validate::{Severity, ValidateOptions, validate};
use gawm_video::testing::{fixture, number_of};
use parquet::arrow::ArrowWriter;

const CAMERA: &str = "observation.images.cam";
const N_ROWS: i64 = 30;

/// A v2.1 folder with an episode per video, each of 30 rows at 10 Hz; `videos` are bytes of MP4 files.
fn folder(dir: &Path, videos: &[Vec<u8>]) -> PathBuf {
    let root = dir.join("lerobot");
    let chunk = root.join("videos/chunk-000").join(CAMERA);
    for sub in [root.join("meta"), root.join("data/chunk-000"), chunk.clone()] {
        fs::create_dir_all(sub).unwrap();
    }
    let n = videos.len();
    let scalar = r#"{"dtype": "float32", "shape": [1], "names": null}"#;
    let info = format!(
        r#"{{"codebase_version": "v2.1", "robot_type": "arm", "total_episodes": {n}, "total_frames": {}, "total_tasks": 1, "chunks_size": 1000, "fps": 10, "splits": {{"train": "0:{n}"}}, "data_path": "data/chunk-{{episode_chunk:03d}}/episode_{{episode_index:06d}}.parquet", "video_path": "videos/chunk-{{episode_chunk:03d}}/{{video_key}}/episode_{{episode_index:06d}}.mp4", "features": {{"observation.state": {scalar}, "timestamp": {scalar}, "{CAMERA}": {{"dtype": "video", "shape": [48, 64, 3], "names": ["height", "width", "channels"]}}}}}}"#,
        n as i64 * N_ROWS
    );
    fs::write(root.join("meta/info.json"), info).unwrap();
    fs::write(root.join("meta/tasks.jsonl"), "{\"task_index\": 0, \"task\": \"watch\"}\n").unwrap();
    let mut episodes = String::new();
    for (episode, video) in videos.iter().enumerate() {
        episodes +=
            &format!("{{\"episode_index\": {episode}, \"tasks\": [\"watch\"], \"length\": {N_ROWS}}}\n");
        write_rows(&root.join(format!("data/chunk-000/episode_{episode:06}.parquet")), episode as i64);
        fs::write(chunk.join(format!("episode_{episode:06}.mp4")), video).unwrap();
    }
    fs::write(root.join("meta/episodes.jsonl"), episodes).unwrap();
    root
}

fn write_rows(path: &Path, episode: i64) {
    let ints = |value: &dyn Fn(i64) -> i64| -> ArrayRef {
        Arc::new(Int64Array::from_iter_values((0..N_ROWS).map(value)))
    };
    let floats = |value: &dyn Fn(i64) -> f32| -> ArrayRef {
        Arc::new(Float32Array::from_iter_values((0..N_ROWS).map(value)))
    };
    let batch = RecordBatch::try_from_iter([
        ("observation.state", floats(&|row| (row as f32 * 0.3 + episode as f32).sin())),
        ("timestamp", floats(&|row| row as f32 / 10.0)),
        ("frame_index", ints(&|row| row)),
        ("episode_index", ints(&|_| episode)),
        ("index", ints(&|row| episode * N_ROWS + row)),
        ("task_index", ints(&|_| 0)),
    ])
    .unwrap();
    let mut writer = ArrowWriter::try_new(File::create(path).unwrap(), batch.schema(), None).unwrap();
    writer.write(&batch).unwrap();
    writer.close().unwrap();
}

fn video(name: &str) -> Vec<u8> {
    fs::read(fixture(name)).unwrap()
}

/// Codes of the findings about pictures that are warnings or worse, by episode.
fn findings(root: &Path) -> Vec<(Option<i64>, &'static str)> {
    let dataset = Dataset::open(root, ReadLimits::default()).unwrap();
    let report = validate(&dataset, &ValidateOptions::default()).unwrap();
    let pictures = report.findings.iter().filter(|f| f.code.starts_with("IMAGE"));
    pictures.filter(|f| f.severity >= Severity::Warning).map(|f| (f.episode, f.code)).collect()
}

#[test]
fn frames_of_videos_belong_to_their_rows() {
    let dir = tempfile::tempdir().unwrap();
    let root = folder(dir.path(), &["h264.mp4", "hevc.mp4", "av1.mp4", "bt709.mp4"].map(video));
    let dataset = Dataset::open(&root, ReadLimits::default()).unwrap();
    assert_eq!(dataset.frame_columns(), [CAMERA]);
    for run in 0..dataset.runs.len() {
        let rows = [0, 1, 12, 29];
        let frames = dataset.read_frames(run, CAMERA, &rows).unwrap();
        for (row, frame) in rows.iter().zip(frames) {
            let FrameBytes::Video(frame) = frame else { panic!("run {run}, row {row}: {frame:?}") };
            assert_eq!(number_of(64, &frame.data), *row, "run {run}");
        }
    }
    assert_eq!(findings(&root), []);
}

#[test]
fn what_is_wrong_with_frames_of_videos_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let whole = video("bt709.mp4");
    // The index lies at the beginning of this file: the frames at the end are missing.
    let cut = whole[..whole.len() * 7 / 10].to_vec();
    let root = folder(dir.path(), &[whole, cut]);
    let found = findings(&root);
    assert!(!found.is_empty() && found.iter().all(|(episode, _)| *episode == Some(1)), "{found:?}");
}
