//! Video on its way through a run: files of LeRobot folders, topics of logs.

use std::fs;
use std::path::Path;

use base64::Engine as _;
use gawm_dataset::read::{Dataset, FrameBytes, ReadLimits};
use gawm_video::testing::{fixture, number_of, packets};

use crate::decode::SchemaLibrary;
use crate::log::OpenOptions;
use crate::rows::{push_bytes, push_header, push_text};
use crate::run::made_logs::{LogWriter, run_over};
use crate::run::{FileStatus, RunOutcome};
use crate::suggest::{suggest, to_toml};

const CAMERA: &str = "observation.images.cam";

/// The numbers drawn into the frames of a dataset, in the order of its rows.
fn numbers(out: &Path) -> Vec<usize> {
    let dataset = Dataset::open(out, ReadLimits::default()).unwrap();
    let mut numbers = Vec::new();
    for (run, found) in dataset.runs.iter().enumerate() {
        let rows: Vec<usize> = (0..found.n_rows as usize).collect();
        for frame in dataset.read_frames(run, CAMERA, &rows).unwrap() {
            let FrameBytes::Encoded(bytes) = frame else { panic!("no frame") };
            let image = gawm_image::decode(&bytes, &gawm_image::Limits::default()).unwrap();
            let gawm_image::Pixels::Rgb8(pixels) = image.pixels() else { panic!("no RGB") };
            numbers.push(number_of(64, pixels));
        }
    }
    numbers
}

/// Messages lost of the camera's topic, by reason.
fn lost(outcome: &RunOutcome, topic: &str) -> Vec<(String, u64)> {
    let topics = outcome.report.files[0].topics.iter().filter(|found| found.topic == topic);
    topics.flat_map(|found| &found.lost).map(|lost| (lost.reason.clone(), lost.count)).collect()
}

#[derive(Clone, Copy, PartialEq)]
enum Encoding {
    Cdr,
    Json,
}

/// Writes a log of 30 frames at 10 Hz and returns its path.
fn log(folder: &Path, encoding: Encoding, keeps: impl Fn(usize) -> bool) -> std::path::PathBuf {
    log_of(folder, encoding, keeps, |_, packet| packet.to_vec())
}

/// The same with what `change` makes of each packet.
fn log_of(
    folder: &Path,
    encoding: Encoding,
    keeps: impl Fn(usize) -> bool,
    change: impl Fn(usize, &[u8]) -> Vec<u8>,
) -> std::path::PathBuf {
    let mut log = LogWriter::new(folder);
    let ros = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n================================================================================\nMSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";
    let json = r#"{"title": "foxglove.CompressedVideo", "type": "object", "properties": {
        "timestamp": {"type": "object", "title": "time", "properties": {"sec": {"type": "integer"}, "nsec": {"type": "integer"}}},
        "frame_id": {"type": "string"}, "data": {"type": "string", "contentEncoding": "base64"}, "format": {"type": "string"}}}"#;
    match encoding {
        Encoding::Cdr => {
            log.channel("/video", "cdr", Some(("foxglove_msgs/msg/CompressedVideo", "ros2msg", ros)));
        }
        Encoding::Json => {
            log.channel("/video", "json", Some(("foxglove.CompressedVideo", "jsonschema", json)));
        }
    }
    for (number, packet) in packets().unwrap().iter().enumerate() {
        let packet = &change(number, packet);
        let time_ms = number as u64 * 100;
        log.write("/state", time_ms, format!("{{\"x\": {number}}}").as_bytes());
        if !keeps(number) {
            continue;
        }
        let (sec, nsec) = (1 + time_ms / 1000, time_ms % 1000 * 1_000_000);
        let payload = match encoding {
            Encoding::Cdr => {
                let mut data = Vec::new();
                let start = push_header((sec * 1_000_000_000 + nsec) as i64, &mut data);
                push_bytes(packet, start, &mut data);
                push_text("h264", start, &mut data);
                data
            }
            Encoding::Json => {
                let data = base64::engine::general_purpose::STANDARD.encode(packet);
                let stamp = format!("{{\"sec\": {sec}, \"nsec\": {nsec}}}");
                format!("{{\"timestamp\": {stamp}, \"frame_id\": \"cam\", \"data\": \"{data}\", \"format\": \"h264\"}}")
                    .into_bytes()
            }
        };
        log.write("/video", time_ms, &payload);
    }
    log.finish()
}

const LOG_CONTRACT: &str = "version = 1\n[ticks]\nrate_hz = 10\n\
    [[stream]]\ntopic = \"/state\"\nfields = [\"x\"]\nfeature = \"observation.state\"\ntolerance_ms = 50\n\
    [[stream]]\ntopic = \"/video\"\nfeature = \"observation.images.cam\"\ntolerance_ms = 50\n";

#[test]
fn topics_of_packets_are_cameras() {
    for encoding in [Encoding::Cdr, Encoding::Json] {
        let dir = tempfile::tempdir().unwrap();
        let path = log(dir.path(), encoding, |_| true);
        let out = dir.path().join("out");
        let outcome = run_over(LOG_CONTRACT, &path, &out, 2).unwrap();
        assert_eq!(outcome.report.files[0].status, FileStatus::Ok, "{:#?}", outcome.report);
        assert_eq!(numbers(&out), (0..30).collect::<Vec<_>>());
    }
}

#[test]
fn packets_before_the_first_keyframe_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = log(dir.path(), Encoding::Cdr, |number| number >= 13);
    let out = dir.path().join("out");
    let outcome = run_over(LOG_CONTRACT, &path, &out, 1).unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Loss);
    assert_eq!(lost(&outcome, "/video"), [("before_keyframe".to_owned(), 7)]);
    assert_eq!(numbers(&out), (20..30).collect::<Vec<_>>());
}

#[test]
fn a_packet_that_is_cut_is_lost_with_what_refers_to_it() {
    let dir = tempfile::tempdir().unwrap();
    let path = log_of(
        dir.path(),
        Encoding::Cdr,
        |_| true,
        |number, packet| match number {
            14 => packet[..packet.len() / 2].to_vec(),
            _ => packet.to_vec(),
        },
    );
    let out = dir.path().join("out");
    let outcome = run_over(LOG_CONTRACT, &path, &out, 1).unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Loss);
    let n_lost: u64 = lost(&outcome, "/video").iter().map(|(_, count)| count).sum();
    assert_eq!(n_lost, 6, "{:?}", lost(&outcome, "/video"));
    assert_eq!(numbers(&out), (0..14).chain(20..30).collect::<Vec<_>>());
}

#[test]
fn frames_that_refer_to_a_lost_packet_are_counted() {
    let dir = tempfile::tempdir().unwrap();
    let path = log(dir.path(), Encoding::Cdr, |number| number != 14);
    let out = dir.path().join("out");
    let outcome = run_over(LOG_CONTRACT, &path, &out, 1).unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Loss);
    let n_lost: u64 = lost(&outcome, "/video").iter().map(|(_, count)| count).sum();
    assert_eq!(n_lost, 5, "{:?}", lost(&outcome, "/video"));
    // The gap is longer than the tolerance: it parts the episode.
    assert_eq!(numbers(&out), (0..14).chain(20..30).collect::<Vec<_>>());
}

/// A v2.1 folder of two episodes whose camera is a video: of frames 0 to 29, and of the first 20.
fn folder(dir: &Path, videos: [&str; 2]) -> std::path::PathBuf {
    let root = dir.join("lerobot");
    let chunk = format!("videos/chunk-000/{CAMERA}");
    for sub in ["meta", "data/chunk-000", &chunk] {
        fs::create_dir_all(root.join(sub)).unwrap();
    }
    let info = format!(
        "{{\"codebase_version\": \"v2.1\", \"robot_type\": \"arm\", \"total_episodes\": 2, \"total_frames\": 50, \"total_tasks\": 1, \"chunks_size\": 1000, \"fps\": 10, \"splits\": {{\"train\": \"0:2\"}}, \"data_path\": \"data/chunk-{{episode_chunk:03d}}/episode_{{episode_index:06d}}.parquet\", \"video_path\": \"videos/chunk-{{episode_chunk:03d}}/{{video_key}}/episode_{{episode_index:06d}}.mp4\", \"features\": {{\"observation.state\": {{\"dtype\": \"float32\", \"shape\": [2], \"names\": [\"x\", \"y\"]}}, \"{CAMERA}\": {{\"dtype\": \"video\", \"shape\": [48, 64, 3], \"names\": [\"height\", \"width\", \"channels\"]}}}}}}"
    );
    fs::write(root.join("meta/info.json"), info).unwrap();
    fs::write(root.join("meta/tasks.jsonl"), "{\"task_index\": 0, \"task\": \"watch\"}\n").unwrap();
    let mut episodes = String::new();
    for (episode, n_rows) in [(0, 30), (1, 20)] {
        episodes +=
            &format!("{{\"episode_index\": {episode}, \"tasks\": [\"watch\"], \"length\": {n_rows}}}\n");
        let path = root.join(format!("data/chunk-000/episode_{episode:06}.parquet"));
        crate::lerobot::tests::write_rows(&path, episode, n_rows);
        let video = root.join(&chunk).join(format!("episode_{episode:06}.mp4"));
        match videos[episode as usize] {
            "" => {}
            "cut" => {
                let bytes = fs::read(fixture("bt709.mp4")).unwrap();
                fs::write(video, &bytes[..bytes.len() * 7 / 10]).unwrap();
            }
            name => {
                fs::copy(fixture(name), video).unwrap();
            }
        }
    }
    fs::write(root.join("meta/episodes.jsonl"), episodes).unwrap();
    root
}

const FOLDER_CONTRACT: &str = "version = 1\n[ticks]\nmode = \"native\"\n[episodes]\nfrom = \"metadata\"\nrecord = \"episode\"\nstart_key = \"start_ns\"\nend_key = \"end_ns\"\n\
    [[stream]]\ntopic = \"observation.state\"\nfields = [\"data[0:2]\"]\nfeature = \"observation.state\"\ntolerance_ms = 150\n\
    [[stream]]\ntopic = \"observation.images.cam\"\nfeature = \"observation.images.cam\"\ntolerance_ms = 50\n";

#[test]
fn videos_of_a_folder_are_cameras() {
    let dir = tempfile::tempdir().unwrap();
    let root = folder(dir.path(), ["h264.mp4", "av1.mp4"]);
    let mut files = Vec::new();
    for jobs in [1, 3] {
        let out = dir.path().join(format!("out-{jobs}"));
        let outcome = run_over(FOLDER_CONTRACT, &root, &out, jobs).unwrap();
        assert_eq!(outcome.report.files[0].status, FileStatus::Ok, "{:#?}", outcome.report);
        assert_eq!(numbers(&out), (0..30).chain(0..20).collect::<Vec<_>>());
        files.push(fs::read(out.join("data/chunk-000/file-000.parquet")).unwrap());
    }
    assert!(files[0] == files[1], "the bytes depend on the number of jobs");
}

#[test]
fn a_suggested_contract_maps_videos() {
    let dir = tempfile::tempdir().unwrap();
    let root = folder(dir.path(), ["h264.mp4", "av1.mp4"]);
    let inputs = [root.clone()];
    let suggestion = suggest(&inputs, &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let text = to_toml(&suggestion);
    let out = dir.path().join("out");
    let outcome = run_over(&text, &root, &out, 2).unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Ok, "{:#?}", outcome.report);
    assert_eq!(numbers(&out), (0..30).chain(0..20).collect::<Vec<_>>(), "{text}");
}

#[test]
fn what_a_folder_lacks_of_its_videos_is_counted() {
    let dir = tempfile::tempdir().unwrap();
    for (videos, expected) in
        [(["hevc.mp4", ""], (0..30).collect::<Vec<usize>>()), (["cut", "hevc.mp4"], Vec::new())]
    {
        let root = folder(dir.path(), videos);
        let out = dir.path().join(format!("out-{}", videos[0]));
        let outcome = run_over(FOLDER_CONTRACT, &root, &out, 2).unwrap();
        assert!(outcome.has_loss(), "{:#?}", outcome.report);
        let text = serde_json::to_string(&outcome.report).unwrap();
        let got = numbers(&out);
        if videos[0] == "cut" {
            // As many as were in the file, from the first on, then the whole of the other.
            let n_whole = got.len() - 20;
            assert!((5..30).contains(&n_whole), "{got:?}");
            assert_eq!(got, (0..n_whole).chain(0..20).collect::<Vec<_>>());
            assert!(text.contains("no frame at"), "{text}");
        } else {
            assert_eq!(got, expected);
            assert!(text.contains("episode_000001.mp4"), "{text}");
        }
        fs::remove_dir_all(&root).unwrap();
    }
}
