//! Collected logs: read back they equal the simulator's truth; equal seeds give equal bytes.
#![expect(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::collections::BTreeMap;
use std::path::Path;

use gawm_sim::collect::{
    ACTION_TOPIC, CollectError, CollectOptions, EPISODE_METADATA, Episode, FIRST_ROW_NS, GOAL_TOPIC,
    IMAGE_TOPIC, ImageFormat, MARKER_TOPIC, SESSION_METADATA, STATE_TOPIC, collect, collect_until,
};
use gawm_sim::{Frame, TwoRoom};
use serde_json::Value;

fn options() -> CollectOptions {
    CollectOptions {
        episodes: 7,
        seed: 11,
        episodes_per_file: 3,
        max_steps: 30,
        jobs: 2,
        ..CollectOptions::default()
    }
}

/// The bytes of every log of a collection, by file name.
fn collected(options: &CollectOptions) -> BTreeMap<String, Vec<u8>> {
    let dir = tempfile::tempdir().unwrap();
    let summary = collect(dir.path(), options, &|_| ()).unwrap();
    let files: BTreeMap<_, _> = std::fs::read_dir(dir.path())
        .unwrap()
        .map(|entry| entry.unwrap())
        .map(|entry| (entry.file_name().into_string().unwrap(), std::fs::read(entry.path()).unwrap()))
        .collect();
    assert_eq!(summary.logs.len(), files.len(), "every file is a log of the summary");
    assert_eq!(summary.bytes, files.values().map(|bytes| bytes.len() as u64).sum::<u64>());
    files
}

#[test]
fn bytes_do_not_depend_on_jobs() {
    let one = collected(&CollectOptions { jobs: 1, ..options() });
    assert_eq!(
        one.keys().collect::<Vec<_>>(),
        ["two-room-000000.mcap", "two-room-000003.mcap", "two-room-000006.mcap"]
    );
    for jobs in [2, 5] {
        assert!(collected(&CollectOptions { jobs, ..options() }) == one, "{jobs} jobs");
    }
    let other = collected(&CollectOptions { seed: 12, ..options() });
    assert!(one.iter().all(|(name, bytes)| other[name] != *bytes), "another seed gives other logs");
}

/// A message: log time, and the payload after its encapsulation header.
type Payload = (u64, Vec<u8>);

/// The messages of all logs by topic, each in order of time.
fn messages(logs: &BTreeMap<String, Vec<u8>>) -> BTreeMap<String, Vec<Payload>> {
    let mut topics: BTreeMap<String, Vec<Payload>> = BTreeMap::new();
    for bytes in logs.values() {
        for message in mcap::MessageStream::new(bytes).unwrap() {
            let message = message.unwrap();
            assert_eq!(message.channel.message_encoding, "cdr");
            assert_eq!(message.channel.schema.as_ref().unwrap().encoding, "ros2msg");
            assert_eq!(&message.data[..4], [0, 1, 0, 0], "plain little-endian CDR");
            let payload = (message.log_time, message.data[4..].to_vec());
            topics.entry(message.channel.topic.clone()).or_default().push(payload);
        }
    }
    topics
}

fn u32_at(data: &[u8], at: usize) -> u32 {
    u32::from_le_bytes(data[at..at + 4].try_into().unwrap())
}

fn stamp_ns(data: &[u8]) -> u64 {
    u64::from(u32_at(data, 0)) * 1_000_000_000 + u64::from(u32_at(data, 4))
}

/// The CDR string at `at` and where it ends.
fn string_at(data: &[u8], at: usize) -> (&str, usize) {
    let end = at + 4 + u32_at(data, at) as usize;
    assert_eq!(data[end - 1], 0, "strings end in a zero");
    (std::str::from_utf8(&data[at + 4..end - 1]).unwrap(), end)
}

/// The coordinates of a stamped point or vector.
fn planar(message: &Payload) -> [f64; 3] {
    let (time_ns, data) = message;
    assert_eq!(stamp_ns(data), *time_ns);
    let (frame_id, end) = string_at(data, 8);
    assert_eq!(frame_id, "world");
    let first = end.next_multiple_of(8);
    assert_eq!(data.len(), first + 24);
    [0, 1, 2].map(|i| f64::from_le_bytes(data[first + i * 8..first + i * 8 + 8].try_into().unwrap()))
}

/// The format and the bytes of a compressed image.
fn image(message: &Payload) -> (&str, &[u8]) {
    let (time_ns, data) = message;
    assert_eq!(stamp_ns(data), *time_ns);
    let (_, end) = string_at(data, 8);
    let (format, end) = string_at(data, end.next_multiple_of(4));
    let length_at = end.next_multiple_of(4);
    assert_eq!(data.len(), length_at + 4 + u32_at(data, length_at) as usize);
    (format, &data[length_at + 4..])
}

fn decode_png(bytes: &[u8]) -> (u32, u32, Vec<u8>) {
    let mut reader = png::Decoder::new(std::io::Cursor::new(bytes)).read_info().unwrap();
    let mut rgb = vec![0; reader.output_buffer_size().unwrap()];
    let info = reader.next_frame(&mut rgb).unwrap();
    (info.width, info.height, rgb)
}

/// The episodes of a collection, simulated again.
fn truth(options: &CollectOptions) -> Vec<Episode> {
    let mut room = TwoRoom::new(options.room.clone()).unwrap();
    (0..options.episodes)
        .map(|index| Episode::run(&mut room, options.expert, options.max_steps, options.seed, index))
        .collect()
}

fn widened(xy: [f32; 2]) -> [f64; 3] {
    [xy[0].into(), xy[1].into(), 0.0]
}

#[test]
fn logs_hold_the_truth() {
    let options = options();
    let topics = messages(&collected(&options));
    let room = TwoRoom::new(options.room.clone()).unwrap();
    let mut frame = Frame::default();
    let (mut row, mut command) = (0, 0);
    for episode in truth(&options) {
        let start_ns = FIRST_ROW_NS + episode.index * (u64::from(options.max_steps) + 11) * 100_000_000;
        for (t, &state) in episode.states.iter().enumerate() {
            let time_ns = start_ns + t as u64 * 100_000_000;
            assert_eq!(topics[STATE_TOPIC][row].0, time_ns, "episode {}, row {t}", episode.index);
            assert_eq!(planar(&topics[STATE_TOPIC][row]), widened(state));
            assert_eq!(planar(&topics[GOAL_TOPIC][row]), widened(episode.goal));
            room.renderer().render(state, episode.goal, &mut frame);
            let (format, bytes) = image(&topics[IMAGE_TOPIC][row]);
            assert_eq!(format, "png");
            assert!(
                decode_png(bytes) == (224, 224, frame.rgb.clone()),
                "frame of episode {}, row {t}",
                episode.index
            );
            if let Some(&action) = episode.actions.get(t) {
                assert_eq!(topics[ACTION_TOPIC][command].0, time_ns);
                assert_eq!(planar(&topics[ACTION_TOPIC][command]), widened(action));
                command += 1;
            }
            row += 1;
        }
    }
    assert_eq!((topics[STATE_TOPIC].len(), topics[ACTION_TOPIC].len()), (row, command));
    assert_eq!((topics[IMAGE_TOPIC].len(), topics[GOAL_TOPIC].len()), (row, row));
}

#[test]
fn markers_and_metadata_tell_the_episodes() {
    let options = options();
    let logs = collected(&options);
    let topics = messages(&logs);
    let markers: Vec<Value> = topics[MARKER_TOPIC]
        .iter()
        .map(|(_, data)| serde_json::from_str(string_at(data, 0).0).unwrap())
        .collect();
    let records: Vec<_> = logs.values().flat_map(|bytes| metadata(bytes)).collect();
    let sessions: Vec<_> = records.iter().filter(|(name, _)| name == SESSION_METADATA).collect();
    assert_eq!(sessions.len(), logs.len());
    assert!(sessions.iter().all(|(_, record)| record["seed"] == "11" && record["environment"] == "two-room"));
    let episodes: Vec<_> =
        records.iter().filter(|(name, _)| name == EPISODE_METADATA).map(|(_, r)| r).collect();
    let truth = truth(&options);
    assert_eq!((episodes.len(), markers.len()), (truth.len(), 2 * truth.len()));
    assert!(truth.iter().any(|e| e.success) && truth.iter().any(|e| !e.success), "both outcomes are met");
    for (i, episode) in truth.iter().enumerate() {
        let (start, end) = (&markers[2 * i], &markers[2 * i + 1]);
        assert_eq!((&start["event"], &end["event"]), (&Value::from("start"), &Value::from("end")));
        assert_eq!(
            (&start["seed"], &end["success"]),
            (&Value::from(episode.seed), &Value::from(episode.success))
        );
        assert_eq!(episodes[i]["index"], i.to_string());
        assert_eq!(episodes[i]["success"], episode.success.to_string());
        assert_eq!(episodes[i]["seed"], episode.seed.to_string());
        assert_eq!(episodes[i]["task"], "go to the target");
        let times: Vec<u64> = [2 * i, 2 * i + 1].map(|m| topics[MARKER_TOPIC][m].0).to_vec();
        assert_eq!(episodes[i]["start_time_ns"], times[0].to_string());
        assert_eq!(episodes[i]["end_time_ns"], times[1].to_string());
        assert_eq!(times[1] - times[0], episode.actions.len() as u64 * 100_000_000 + 50_000_000);
    }
}

/// The metadata records of a log in the order of the file.
fn metadata(bytes: &[u8]) -> Vec<(String, BTreeMap<String, String>)> {
    mcap::read::LinearReader::new(bytes)
        .unwrap()
        .filter_map(|record| match record.unwrap() {
            mcap::records::Record::Metadata(record) => Some((record.name, record.metadata)),
            _ => None,
        })
        .collect()
}

#[test]
fn jpeg_and_size_are_obeyed() {
    let small = CollectOptions { episodes: 1, max_steps: 3, image_size: Some(64), ..options() };
    let topics = messages(&collected(&small));
    let (width, height, rgb) = decode_png(image(&topics[IMAGE_TOPIC][0]).1);
    assert_eq!((width, height, rgb.len()), (64, 64, 64 * 64 * 3));
    let jpeg = CollectOptions { image: ImageFormat::Jpeg { quality: 90 }, ..small };
    let topics = messages(&collected(&jpeg));
    let (format, bytes) = image(&topics[IMAGE_TOPIC][0]);
    assert_eq!((format, &bytes[..3]), ("jpeg", &[0xff, 0xd8, 0xff][..]));
    let decoded = gawm_image::decode(bytes, &gawm_image::Limits::default()).unwrap();
    assert_eq!((decoded.width(), decoded.height()), (64, 64));
    let gawm_image::Pixels::Rgb8(decoded) = decoded.into_pixels() else { panic!("not RGB") };
    let furthest = decoded.iter().zip(&rgb).map(|(a, b)| a.abs_diff(*b)).max();
    let mean: f64 =
        decoded.iter().zip(&rgb).map(|(a, b)| f64::from(a.abs_diff(*b))).sum::<f64>() / rgb.len() as f64;
    assert!(mean < 4.0, "mean difference {mean}, largest {furthest:?}");
}

fn check_refused(dir: &Path, options: &CollectOptions, expected: &str) {
    let error: CollectError = collect(dir, options, &|_| ()).unwrap_err();
    assert!(error.to_string().contains(expected), "{error}");
}

#[test]
fn unusable_requests_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    let base = options();
    check_refused(dir.path(), &CollectOptions { episodes: 0, ..base.clone() }, "episodes is not usable");
    check_refused(
        dir.path(),
        &CollectOptions { episodes: u64::MAX, ..base.clone() },
        "too much for one collection",
    );
    let mut narrow = base.clone();
    narrow.room.doors[0].half_extent_px = 3;
    check_refused(dir.path(), &narrow, "configuration of the environment");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 0, "nothing was written");
    std::fs::write(dir.path().join("b.txt"), "mine").unwrap();
    check_refused(dir.path(), &base, "found \"b.txt\"");
    check_refused(&dir.path().join("b.txt"), &base, "failed to create folder");
}

#[test]
fn an_interrupt_leaves_whole_logs_only() {
    let dir = tempfile::tempdir().unwrap();
    let interrupt = std::sync::atomic::AtomicBool::new(false);
    let stop = |_: u64| interrupt.store(true, std::sync::atomic::Ordering::Relaxed);
    let options = CollectOptions { jobs: 1, ..options() };
    let error = collect_until(dir.path(), &options, &stop, &interrupt).unwrap_err();
    assert!(matches!(error, CollectError::Interrupted), "{error}");
    let names: Vec<_> =
        std::fs::read_dir(dir.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    assert_eq!(names, ["two-room-000000.mcap"], "the log that was done");
}
