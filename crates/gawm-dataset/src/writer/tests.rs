use std::collections::BTreeMap;
use std::path::Path;

use bytes::Bytes;
use gawm_schema::{ContentHash, Schema};

use super::*;
use crate::durable::is_disk_full;
use crate::rows::{AgeColumns, ImageColumn, Rows, VectorColumn};
use crate::spec::SourceFile;

/// Two joints (one an angle), a gripper, a tool orientation, an action, a camera and a one-dim annotation.
const SCHEMA: &str = r#"
robot_type = "arm"
rate_hz = 9.99

[[features]]
name = "observation.state"
role = "state"
[features.data]
type = "vector"
dtype = "float32"
[[features.data.parts]]
kind = "angle"
wrap = "pi"
dims = [{ name = "j1", unit = "rad", source = "/joints:position[0]" }, { name = "j2", unit = "rad", source = "/joints:position[1]" }]
[[features.data.parts]]
kind = "gripper"
dims = [{ name = "gripper", unit = "m", source = "/gripper:opening" }]
[[features.data.parts]]
kind = "quaternion"
order = "xyzw"
dims = [{ name = "tool.qx", unit = "1", source = "/tool:x" }, { name = "tool.qy", unit = "1", source = "/tool:y" }, { name = "tool.qz", unit = "1", source = "/tool:z" }, { name = "tool.qw", unit = "1", source = "/tool:w" }]

[[features]]
name = "action"
role = "action"
[features.data]
type = "vector"
dtype = "float64"
[[features.data.parts]]
kind = "linear"
dims = [{ name = "v1", unit = "rad/s", source = "/command:v[0]" }, { name = "v2", unit = "rad/s", source = "/command:v[1]" }]

[[features]]
name = "observation.images.front"
role = "image"
[features.data]
type = "image"
height = 4
width = 6
channels = 3

[[features]]
name = "intervention"
role = "annotation"
[features.data]
type = "vector"
dtype = "float32"
[[features.data.parts]]
kind = "bool"
dims = [{ name = "intervention", unit = "1", source = "/marker:data" }]

[[streams]]
name = "joints"
source = "/joints"
[[streams]]
name = "front"
source = "/front"
"#;

pub(crate) fn schema() -> Schema {
    toml::from_str(SCHEMA).unwrap()
}

pub(crate) fn spec() -> DatasetSpec {
    DatasetSpec::new(schema(), "fps = 10\n", "test 1")
}

/// A 6x4 RGB PNG of one colour per frame, compressed by stored blocks.
pub(crate) fn png(seed: u8) -> Bytes {
    let mut raw = Vec::new();
    for y in 0..4u8 {
        raw.push(0);
        for x in 0..6u8 {
            raw.extend([seed.wrapping_add(x), y * 60, seed]);
        }
    }
    let mut data = vec![0x78, 0x01, 1];
    data.extend((raw.len() as u16).to_le_bytes());
    data.extend((!(raw.len() as u16)).to_le_bytes());
    data.extend(&raw);
    let (mut a, mut b) = (1u32, 0u32);
    for &byte in &raw {
        a = (a + u32::from(byte)) % 65521;
        b = (b + a) % 65521;
    }
    data.extend((b << 16 | a).to_be_bytes());
    let mut file = vec![0x89, b'P', b'N', b'G', 0x0d, 0x0a, 0x1a, 0x0a];
    let mut chunk = |name: &[u8; 4], data: &[u8]| {
        file.extend((data.len() as u32).to_be_bytes());
        let start = file.len();
        file.extend(name);
        file.extend(data);
        let crc = crc32(&file[start..]);
        file.extend(crc.to_be_bytes());
    };
    chunk(b"IHDR", &[0, 0, 0, 6, 0, 0, 0, 4, 8, 2, 0, 0, 0]);
    chunk(b"IDAT", &data);
    chunk(b"IEND", &[]);
    Bytes::from(file)
}

fn crc32(bytes: &[u8]) -> u32 {
    !bytes.iter().fold(!0u32, |crc, &byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (0u32.wrapping_sub(crc & 1))))
    })
}

/// Rows `range` of an episode of `n` rows.
pub(crate) fn rows(seed: u64, range: std::ops::Range<usize>, n: usize) -> Rows {
    let column = |width: usize, value: &dyn Fn(usize, &mut Vec<f64>)| {
        let mut values = Vec::new();
        range.clone().for_each(|i| value(i, &mut values));
        assert_eq!(values.len(), range.len() * width);
        VectorColumn { values, valid: vec![true; range.len()] }
    };
    let phase = seed as f64 * 0.7;
    let state = column(7, &|i, out| {
        let t = i as f64 * 0.1 + phase;
        let half = t * 0.3;
        out.extend([(t.sin() * 3.0), (t * 1.3).cos(), 0.04, 0.0, 0.0, half.sin(), half.cos()]);
    });
    let mut action = column(2, &|i, out| {
        let i = i.min(n - 2) as f64;
        out.extend([(i * 0.2 + phase).sin(), i * 1e-3]);
    });
    if range.end == n {
        *action.valid.last_mut().unwrap() = false;
    }
    let intervention = column(1, &|i, out| out.push(f64::from(u8::from(i % 7 == 3))));
    Rows {
        time_ns: range.clone().map(|i| 1_000_000_000 * (seed as i64 + 1) + i as i64 * 100_100_100).collect(),
        vectors: vec![state, action, intervention],
        images: vec![ImageColumn {
            frames: range.clone().map(|i| png((i as u8).wrapping_mul(3).wrapping_add(seed as u8))).collect(),
            valid: vec![true; range.len()],
        }],
        ages: AgeColumns {
            age_ms: range.clone().flat_map(|i| [i as f32 * 0.01, 5.0]).collect(),
            arrival_age_ms: range.clone().flat_map(|i| [i as f32 * 0.02, 6.0]).collect(),
        },
    }
}

pub(crate) fn recording(number: u64) -> RecordingInfo {
    let hash = ContentHash::of(&number.to_le_bytes());
    let file =
        SourceFile { name: format!("log-{number}.mcap"), content_hash: hash, length_bytes: 1000 + number };
    RecordingInfo { content_hash: hash, files: vec![file], notes: BTreeMap::new() }
}

/// Lengths of the episodes of a recording.
fn lengths(number: u64) -> Vec<usize> {
    vec![30 + number as usize, 1500, 20]
}

fn write_recording(writer: &mut DatasetWriter, number: u64, piece: usize) -> Result<(), WriteError> {
    if writer.begin_recording(recording(number))? == RecordingState::AlreadyThere {
        return Ok(());
    }
    for (i, n) in lengths(number).into_iter().enumerate() {
        let seed = number * 10 + i as u64;
        writer.begin_episode(EpisodeInfo {
            task: ["pick the red cube", "open the drawer"][i % 2].to_owned(),
            success: [Some(true), Some(false), None][i % 3],
            session: format!("day-{number}"),
            operator: "anna".to_owned(),
            start_ns: seed as i64,
            end_ns: seed as i64 + 5,
            ..EpisodeInfo::default()
        })?;
        for start in (0..n).step_by(piece) {
            let rows = rows(seed, start..(start + piece).min(n), n);
            writer.write(Trajectory::try_new(&schema(), rows).unwrap())?;
        }
        writer.end_episode()?;
    }
    writer.end_recording()
}

fn write_all(dir: &Path, mode: WriteMode, recordings: &[u64], piece: usize) -> DatasetSummary {
    let mut writer = DatasetWriter::create(dir, spec(), mode).unwrap();
    recordings.iter().for_each(|&number| write_recording(&mut writer, number, piece).unwrap());
    writer.finish().unwrap()
}

/// Returns all files of a folder with their content.
fn tree(dir: &Path) -> BTreeMap<String, Vec<u8>> {
    fn walk(dir: &Path, root: &Path, files: &mut BTreeMap<String, Vec<u8>>) {
        for entry in fs::read_dir(dir).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                walk(&path, root, files);
            } else {
                let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
                files.insert(name, fs::read(&path).unwrap());
            }
        }
    }
    let mut files = BTreeMap::new();
    walk(dir, dir, &mut files);
    files
}

#[track_caller]
fn check_same(a: &Path, b: &Path) {
    let (a, b) = (tree(a), tree(b));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (name, bytes) in &a {
        assert!(bytes == &b[name], "{name} differs");
    }
}

#[test]
fn writes_what_design_says() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let summary = write_all(&out, WriteMode::New, &[0, 1], 100);
    assert_eq!((summary.recordings, summary.episodes, summary.frames), (2, 6, 3101));
    let files: Vec<String> = tree(&out).into_keys().collect();
    assert_eq!(
        files,
        [
            "data/chunk-000/file-000.parquet",
            "data/chunk-000/file-001.parquet",
            "gawm/encoded/chunk-000/file-000.parquet",
            "gawm/encoded/chunk-000/file-001.parquet",
            "meta/episodes/chunk-000/file-000.parquet",
            "meta/gawm-statistics.json",
            "meta/gawm.json",
            "meta/info.json",
            "meta/stats.json",
            "meta/tasks.parquet",
        ]
    );
}

#[test]
fn bytes_do_not_depend_on_pieces() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    write_all(&a, WriteMode::New, &[0], 1024);
    write_all(&b, WriteMode::New, &[0], 7);
    check_same(&a, &b);
}

#[test]
fn appending_equals_one_run() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    write_all(&a, WriteMode::New, &[0, 1, 2], 500);
    write_all(&b, WriteMode::New, &[0], 500);
    write_all(&b, WriteMode::Append, &[1], 500);
    let summary = write_all(&b, WriteMode::Append, &[0, 2, 1], 500);
    assert_eq!((summary.new_recordings, summary.new_episodes, summary.new_frames), (1, 3, 1552));
    check_same(&a, &b);
    assert!(!is_disk_full(&std::io::Error::other("x")));
}
