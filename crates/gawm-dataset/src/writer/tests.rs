use std::collections::BTreeMap;
use std::path::Path;

use bytes::Bytes;
use gawm_schema::{ContentHash, Schema};

use super::*;
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
    vec![30 + number as usize, 1100, 20]
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

pub(crate) fn write_all(dir: &Path, mode: WriteMode, recordings: &[u64], piece: usize) -> DatasetSummary {
    let mut writer = DatasetWriter::create(dir, spec(), mode).unwrap();
    recordings.iter().for_each(|&number| write_recording(&mut writer, number, piece).unwrap());
    writer.finish().unwrap()
}

/// Returns all files of a folder with their content.
pub(crate) fn tree(dir: &Path) -> BTreeMap<String, Vec<u8>> {
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
    assert_eq!((summary.recordings, summary.episodes, summary.frames), (2, 6, 2301));
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
    assert_eq!((summary.new_recordings, summary.new_episodes, summary.new_frames), (1, 3, 1152));
    check_same(&a, &b);
}

/// Copies a folder as a crash would leave it.
fn copy_tree(from: &Path, to: &Path) {
    for (name, bytes) in tree(from) {
        let path = to.join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, bytes).unwrap();
    }
}

#[test]
fn resuming_at_any_step_equals_an_undisturbed_run() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    write_all(&whole, WriteMode::New, &[0, 1], 300);
    let broken = dir.path().join("broken");
    // Each step leaves the folder as a crash at that moment would.
    let mut n_states = 0;
    let mut check = |state: &Path| {
        let resumed = dir.path().join(format!("resumed-{n_states}"));
        n_states += 1;
        copy_tree(state, &resumed);
        write_all(&resumed, WriteMode::Resume, &[0, 1], 300);
        check_same(&whole, &resumed);
        fs::remove_dir_all(&resumed).unwrap();
    };
    let mut writer = DatasetWriter::create(&broken, spec(), WriteMode::New).unwrap();
    check(&broken);
    write_recording(&mut writer, 0, 300).unwrap();
    check(&broken);
    assert_eq!(writer.begin_recording(recording(1)).unwrap(), RecordingState::New);
    writer.begin_episode(EpisodeInfo { task: "half".to_owned(), ..EpisodeInfo::default() }).unwrap();
    writer.write(Trajectory::try_new(&schema(), rows(10, 0..1060, 1100)).unwrap()).unwrap();
    check(&broken);
    drop(writer);
    check(&broken);
    check(&whole);
}

#[test]
fn a_crash_while_finishing_can_be_resumed() {
    let dir = tempfile::tempdir().unwrap();
    let (whole, base) = (dir.path().join("whole"), dir.path().join("base"));
    write_all(&whole, WriteMode::New, &[0, 1], 300);
    write_all(&base, WriteMode::New, &[0], 300);
    let mut writer = DatasetWriter::create(&base, spec(), WriteMode::Append).unwrap();
    write_recording(&mut writer, 1, 300).unwrap();
    let before = dir.path().join("before");
    copy_tree(&base, &before);
    writer.finish().unwrap();
    // Finishing renames file after file: after each of them the folder is a mixture of before and after.
    let after = tree(&base);
    let changed: Vec<&String> = after.keys().filter(|name| *name != "meta/info.json").collect();
    for n in 0..=changed.len() {
        let state = dir.path().join(format!("state-{n}"));
        copy_tree(&before, &state);
        fs::remove_file(state.join("meta/info.json")).unwrap();
        for name in &changed[..n] {
            fs::create_dir_all(state.join(name).parent().unwrap()).unwrap();
            fs::write(state.join(name), &after[*name]).unwrap();
            remove_file(&temporary(&state.join(name))).unwrap();
        }
        write_all(&state, WriteMode::Resume, &[1], 300);
        check_same(&whole, &state);
        fs::remove_dir_all(&state).unwrap();
    }
}

#[test]
fn an_unfinished_append_leaves_the_dataset_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    write_all(&out, WriteMode::New, &[0], 300);
    let before = tree(&out);
    let mut writer = DatasetWriter::create(&out, spec(), WriteMode::Append).unwrap();
    write_recording(&mut writer, 1, 300).unwrap();
    drop(writer);
    let after = tree(&out);
    assert!(before.iter().all(|(name, bytes)| after[name] == *bytes));
    let new: Vec<&String> = after.keys().filter(|name| !before.contains_key(*name)).collect();
    assert!(
        new.iter().all(|name| name.starts_with("gawm/journal/") || name.ends_with(".parquet.tmp")),
        "{new:?}"
    );
    let error = DatasetWriter::create(&out, spec(), WriteMode::Append).err().unwrap();
    assert!(matches!(error, WriteError::Unfinished { .. }) && error.hint().is_some());
}

#[test]
fn a_full_disk_is_named_and_can_be_resumed() {
    let dir = tempfile::tempdir().unwrap();
    let whole = dir.path().join("whole");
    write_all(&whole, WriteMode::New, &[0, 1], 300);
    let needed: u64 = tree(&whole).values().map(|bytes| bytes.len() as u64).sum();
    for share in [0, 1, 5, 10, 30, 60, 90, 99] {
        let out = dir.path().join(format!("out-{share}"));
        let disk = Disk::with_space(needed * share / 100);
        let run = || -> Result<DatasetSummary, WriteError> {
            let mut writer = DatasetWriter::create_on(disk, &out, spec(), WriteMode::New)?;
            write_recording(&mut writer, 0, 300)?;
            write_recording(&mut writer, 1, 300)?;
            writer.finish()
        };
        let error = run().err().unwrap();
        assert!(matches!(error, WriteError::DiskFull { .. }), "{share} %: {error:?}");
        write_all(&out, WriteMode::Resume, &[0, 1], 300);
        check_same(&whole, &out);
    }
}

#[test]
fn a_discarded_episode_and_an_aborted_recording_leave_no_trace() {
    let dir = tempfile::tempdir().unwrap();
    let (a, b) = (dir.path().join("a"), dir.path().join("b"));
    write_all(&a, WriteMode::New, &[0], 300);
    let mut writer = DatasetWriter::create(&b, spec(), WriteMode::New).unwrap();
    writer.begin_recording(recording(7)).unwrap();
    writer.add_attachment("robot.urdf", b"<robot/>").unwrap();
    writer.begin_episode(EpisodeInfo { task: "never".to_owned(), ..EpisodeInfo::default() }).unwrap();
    writer.write(Trajectory::try_new(&schema(), rows(1, 0..1100, 1100)).unwrap()).unwrap();
    writer.abort_recording().unwrap();
    write_recording(&mut writer, 0, 300).unwrap();
    writer.finish().unwrap();
    let mut files = tree(&b);
    assert_eq!(tree(&a).keys().collect::<Vec<_>>(), files.keys().collect::<Vec<_>>());
    check_same(&a, &b);

    let c = dir.path().join("c");
    let mut writer = DatasetWriter::create(&c, spec(), WriteMode::New).unwrap();
    writer.begin_recording(recording(0)).unwrap();
    for (n, is_kept) in [(1100, false), (40, true), (3, false), (2500, false), (50, true)] {
        writer
            .begin_episode(EpisodeInfo { task: format!("task {is_kept}"), ..EpisodeInfo::default() })
            .unwrap();
        writer.write(Trajectory::try_new(&schema(), rows(n as u64, 0..n, n)).unwrap()).unwrap();
        if is_kept { writer.end_episode() } else { writer.discard_episode() }.unwrap();
    }
    writer.end_recording().unwrap();
    let summary = writer.finish().unwrap();
    assert_eq!((summary.episodes, summary.frames), (2, 90));
    files = tree(&c);
    let info: serde_json::Value = serde_json::from_slice(&files["meta/info.json"]).unwrap();
    assert_eq!(info["total_tasks"], 1);
    // What is left reads back: a further run counts every row again.
    write_all(&c, WriteMode::Append, &[1], 300);
}

/// Gives up a run after a few steps; the folder is then as it was.
fn check_discarded(has_folder: bool, other_file: bool, steps: impl FnOnce(&mut DatasetWriter)) {
    let root = tempfile::tempdir().unwrap();
    let dir = root.path().join("out");
    if has_folder {
        std::fs::create_dir(&dir).unwrap();
    }
    let mut writer = DatasetWriter::create(&dir, spec(), WriteMode::New).unwrap();
    steps(&mut writer);
    if other_file {
        std::fs::write(dir.join("data/notes.txt"), "mine").unwrap();
    }
    assert!(writer.discard().unwrap());
    assert_eq!(dir.exists(), has_folder || other_file);
    let left: Vec<String> = if dir.exists() { tree(&dir).into_keys().collect() } else { Vec::new() };
    assert_eq!(left, if other_file { vec!["data/notes.txt"] } else { Vec::new() });
}

#[test]
fn a_run_that_made_nothing_is_given_up_without_a_trace() {
    let part = |writer: &mut DatasetWriter| {
        writer.begin_recording(recording(0)).unwrap();
        writer.add_attachment("a.urdf", b"x").unwrap();
        writer.begin_episode(EpisodeInfo::default()).unwrap();
        writer.write(Trajectory::try_new(&schema(), rows(1, 0..8, 20)).unwrap()).unwrap();
    };
    check_discarded(false, false, |_| {});
    check_discarded(true, false, |_| {});
    check_discarded(false, false, part);
    check_discarded(true, false, part);
    check_discarded(false, true, part);
}

#[test]
fn a_run_with_episodes_is_not_given_up() {
    let root = tempfile::tempdir().unwrap();
    let dir = root.path().join("out");
    let mut writer = DatasetWriter::create(&dir, spec(), WriteMode::New).unwrap();
    write_recording(&mut writer, 0, 7).unwrap();
    let before = tree(&dir);
    assert!(!writer.discard().unwrap());
    assert!(tree(&dir) == before);
    // Nor is one that adds to a dataset.
    DatasetWriter::create(&dir, spec(), WriteMode::Resume).unwrap().finish().unwrap();
    let before = tree(&dir);
    assert!(!DatasetWriter::create(&dir, spec(), WriteMode::Append).unwrap().discard().unwrap());
    assert!(before.iter().all(|(name, bytes)| tree(&dir).get(name) == Some(bytes)));
}

#[test]
fn attachments_are_kept_once_and_inside() {
    let dir = tempfile::tempdir().unwrap();
    let out = dir.path().join("out");
    let mut writer = DatasetWriter::create(&out, spec(), WriteMode::New).unwrap();
    assert!(matches!(writer.add_attachment("a", b""), Err(WriteError::Order { .. })));
    writer.begin_recording(recording(0)).unwrap();
    let first = writer.add_attachment("../../robot.urdf", b"<robot/>").unwrap();
    assert_eq!(first, "meta/attachments/robot.urdf");
    assert_eq!(writer.add_attachment("robot.urdf", b"<robot/>").unwrap(), first);
    let other = writer.add_attachment("robot.urdf", b"<other/>").unwrap();
    assert!(other.starts_with("meta/attachments/robot-") && other.ends_with(".urdf"), "{other}");
    let k = serde_json::json!({"K": [1.0, 0.5]});
    assert_eq!(writer.add_calibration("front", &k).unwrap(), "meta/calibration/front.json");
    writer.end_recording().unwrap();
    writer.finish().unwrap();
    let files = tree(&out);
    assert_eq!(files["meta/attachments/robot.urdf"], b"<robot/>");
    assert_eq!(files[&other], b"<other/>");
    let meta: GawmMeta = serde_json::from_slice(&files["meta/gawm.json"]).unwrap();
    assert_eq!(meta.recordings[0].attachments.len(), 4);
}

fn check_refused(
    name: &str,
    mode: WriteMode,
    change: impl Fn(&mut DatasetSpec),
    expected: fn(&WriteError) -> bool,
) {
    let dir = tempfile::tempdir().unwrap();
    write_all(dir.path(), WriteMode::New, &[0], 300);
    let before = tree(dir.path());
    let mut spec = spec();
    change(&mut spec);
    let error = DatasetWriter::create(dir.path(), spec, mode).err().expect(name);
    assert!(expected(&error), "{name}: {error:?}");
    assert!(tree(dir.path()) == before, "{name} changed the dataset");
}

#[test]
fn what_does_not_fit_is_refused() {
    check_refused("new over old", WriteMode::New, |_| {}, |e| matches!(e, WriteError::NotEmpty { .. }));
    check_refused(
        "other rate",
        WriteMode::Append,
        |spec| spec.schema.rate_hz = 20.0,
        |e| matches!(e, WriteError::SpecChanged { place, expected, got } if place == "schema.rate_hz" && expected == "9.99" && got == "20.0"),
    );
    check_refused(
        "other split",
        WriteMode::Append,
        |spec| spec.train_share = 0.5,
        |e| matches!(e, WriteError::SpecChanged { place, .. } if place == "train_share"),
    );
    check_refused(
        "other contract",
        WriteMode::Resume,
        |spec| spec.contract.push('#'),
        |e| matches!(e, WriteError::SpecChanged { place, .. } if place == "contract"),
    );
    check_refused(
        "share",
        WriteMode::Append,
        |spec| spec.train_share = f64::NAN,
        |e| matches!(e, WriteError::TrainShare { .. }),
    );
    let empty = tempfile::tempdir().unwrap();
    let error = DatasetWriter::create(empty.path(), spec(), WriteMode::Append).err().unwrap();
    assert!(matches!(error, WriteError::NoDataset { .. }));
    fs::write(empty.path().join("notes.txt"), "mine").unwrap();
    for mode in [WriteMode::New, WriteMode::Resume] {
        let error = DatasetWriter::create(empty.path(), spec(), mode).err().unwrap();
        assert!(matches!(error, WriteError::NotEmpty { .. }), "{error:?}");
    }
}

#[test]
fn calls_in_the_wrong_order_are_errors() {
    let dir = tempfile::tempdir().unwrap();
    let mut writer = DatasetWriter::create(&dir.path().join("out"), spec(), WriteMode::New).unwrap();
    let trajectory =
        |range: std::ops::Range<usize>| Trajectory::try_new(&schema(), rows(0, range, 100)).unwrap();
    assert!(matches!(writer.begin_episode(EpisodeInfo::default()), Err(WriteError::Order { .. })));
    writer.begin_recording(recording(0)).unwrap();
    assert!(matches!(writer.write(trajectory(0..3)), Err(WriteError::Order { .. })));
    assert!(matches!(writer.begin_recording(recording(1)), Err(WriteError::Order { .. })));
    let named = EpisodeInfo { id: "one".to_owned(), ..EpisodeInfo::default() };
    writer.begin_episode(named.clone()).unwrap();
    assert!(matches!(writer.end_episode(), Err(WriteError::EmptyEpisode { .. })));
    writer.begin_episode(named.clone()).unwrap();
    writer.write(trajectory(0..3)).unwrap();
    assert!(matches!(writer.write(trajectory(2..5)), Err(WriteError::Time { frame: 3, .. })));
    writer.write(trajectory(90..100)).unwrap();
    let mut later = rows(50, 0..3, 100);
    later.vectors[1].valid[0] = true;
    let later = Trajectory::try_new(&schema(), later).unwrap();
    assert!(matches!(writer.write(later), Err(WriteError::HeldActionInside { frame: 12, .. })));
    assert!(matches!(writer.end_recording(), Err(WriteError::Order { .. })));
    writer.end_episode().unwrap();
    assert!(matches!(writer.begin_episode(named), Err(WriteError::DuplicateEpisode { .. })));
    writer.end_recording().unwrap();
    writer.finish().unwrap();
}

#[test]
fn a_large_recording_is_cut_at_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let mut small = spec();
    small.max_file_bytes = 20_000;
    let mut writer = DatasetWriter::create(dir.path(), small, WriteMode::New).unwrap();
    write_recording(&mut writer, 0, 300).unwrap();
    write_recording(&mut writer, 1, 300).unwrap();
    writer.finish().unwrap();
    let meta: GawmMeta = serde_json::from_slice(&tree(dir.path())["meta/gawm.json"]).unwrap();
    let frames: Vec<Vec<u64>> =
        meta.recordings.iter().map(|r| r.files.iter().map(|file| file.frames).collect()).collect();
    assert_eq!(frames, [[1130, 20], [1131, 20]]);
}
