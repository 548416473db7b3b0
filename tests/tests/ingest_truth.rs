//! `gawm-ingest` against the truth files of generated logs: every value, every time, every image, exactly.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::fmt::Write as _;
use std::path::Path;

use gawm_image::{Limits, Pixels, decode};
use support::{Dataset, Truth, run, shared};

/// A stream of a contract, as text.
fn stream(name: &str, topic: &str, fields: &[String], feature: &str) -> String {
    let fields: Vec<String> = fields.iter().map(|field| format!("'{field}'")).collect();
    let mut text = format!("[[stream]]\nname = \"{name}\"\ntopic = \"{topic}\"\nfeature = \"{feature}\"\n");
    if !fields.is_empty() {
        writeln!(text, "fields = [{}]", fields.join(", ")).unwrap();
    }
    text + "align = \"hold\"\n"
}

/// Runs a contract whose rows are the samples of one stream.
fn rows_of(folder: &Path, log: &Path, reference: &str, streams: &str) -> Dataset {
    std::fs::create_dir_all(folder).unwrap();
    let contract = folder.join(format!("{reference}.toml"));
    let text = format!("[ticks]\nmode = \"reference\"\nstream = \"{reference}\"\nfps = 30\n{streams}");
    std::fs::write(&contract, text).unwrap();
    let out = folder.join(reference);
    run(&contract, &out, &[log], &[], 0);
    Dataset::open(&out)
}

/// Every message of a joint topic is a row with its time and its values, whatever order its joints are in.
fn check_joints(log: &Path, topic: &str, truth: &Truth, prefix: &str, members: &[&str], joints: &[String]) {
    let folder = tempfile::tempdir().unwrap();
    let mut streams = String::new();
    for member in members {
        let fields: Vec<String> = joints.iter().map(|joint| format!("{member}[name=\"{joint}\"]")).collect();
        streams += &stream(member, topic, &fields, &format!("observation.{member}"));
    }
    let dataset = rows_of(folder.path(), log, members[0], &streams);
    assert_eq!(dataset.integers("gawm.time_ns"), truth.times(&format!("{prefix}_stamp")), "{topic}");
    for member in members {
        for (column, joint) in joints.iter().enumerate() {
            let name = if *member == "position" { joint.clone() } else { format!("{joint}.{member}") };
            let got = dataset.values(&format!("observation.{member}"), &name);
            assert!(got == truth.column(&format!("{prefix}_{member}"), column), "{topic} {member} {joint}");
        }
    }
}

#[test]
fn joints_at_their_own_rate() {
    let Some(corpora) = shared() else { return };
    let generated = corpora.join("generated");
    let truth = Truth::open(&generated.join("truth/arm.npz"));
    let joints: Vec<String> = (1..=6).map(|joint| format!("joint_{joint}")).collect();
    for log in ["arm_ros2_zstd.mcap", "arm_ros2_unchunked.mcap", "arm_json_lz4.mcap", "arm_rosbags"] {
        check_joints(&generated.join(log), "/joint_states", &truth, "joint", &["position"], &joints);
    }
    for (log, name) in [("cell_mixed_zstd.mcap", "cell"), ("cell_split", "cell_split")] {
        let log = corpora.join("cell").join(log);
        let truth = Truth::open(&corpora.join(format!("cell/truth/{name}.npz")));
        let info = truth_info(&corpora, name);
        for (arm, topic) in [("joint_a", "/left/joint_states"), ("joint_b", "/right/joint_states")] {
            let joints: Vec<String> = info["joint_columns"][arm]
                .as_array()
                .unwrap()
                .iter()
                .map(|joint| joint.as_str().unwrap().to_owned())
                .collect();
            check_joints(&log, topic, &truth, arm, &["position", "velocity", "effort"], &joints);
        }
    }
}

fn truth_info(corpora: &Path, name: &str) -> serde_json::Value {
    let text = std::fs::read(corpora.join(format!("cell/truth/{name}.json"))).unwrap();
    serde_json::from_slice(&text).unwrap()
}

/// Fields of a topic, row by row, with the clock that is given.
fn check_fields(log: &Path, topic: &str, fields: &[&str], clock: &str, times: &[i64], columns: &[Vec<f64>]) {
    let folder = tempfile::tempdir().unwrap();
    let fields: Vec<String> = fields.iter().map(|field| (*field).to_owned()).collect();
    let text = stream("x", topic, &fields, "observation.x") + &format!("clock = \"{clock}\"\n");
    let dataset = rows_of(folder.path(), log, "x", &text);
    assert_eq!(dataset.integers("gawm.time_ns"), times, "{topic}");
    for (name, expected) in dataset.names("observation.x").iter().zip(columns) {
        assert!(dataset.values("observation.x", name) == *expected, "{topic} {name}");
    }
}

#[test]
fn poses_commands_and_grippers_at_their_own_rate() {
    let Some(corpora) = shared() else { return };
    let log = corpora.join("cell/cell_mixed_zstd.mcap");
    let truth = Truth::open(&corpora.join("cell/truth/cell.npz"));
    let columns = |name: &str, n: usize| (0..n).map(|at| truth.column(name, at)).collect::<Vec<_>>();
    let pose = [
        "pose.position.x",
        "pose.position.y",
        "pose.position.z",
        "pose.orientation.x",
        "pose.orientation.y",
        "pose.orientation.z",
        "pose.orientation.w",
    ];
    let times = truth.times("ee_pose_stamp");
    check_fields(&log, "/left/ee_pose", &pose, "stamp", &times, &columns("ee_pose", 7));
    let times = truth.times("command_log");
    check_fields(&log, "/cell/velocity_command", &["data[0:12]"], "log", &times, &columns("command", 12));
    let delta = ["linear.x", "linear.y", "linear.z", "angular.x", "angular.y", "angular.z"]
        .map(|field| format!("twist.{field}"));
    let delta: Vec<&str> = delta.iter().map(String::as_str).collect();
    let times = truth.times("delta_stamp");
    check_fields(&log, "/left/delta_pose_command", &delta, "stamp", &times, &columns("delta", 6));
    let gripper = [columns("gripper_left_opening_m", 1), columns("gripper_right_target_m", 1)].concat();
    let times = truth.times("gripper_pub");
    let fields = ["left.opening_m", "right.target_m"];
    check_fields(&log, "/cell/gripper", &fields, "publish", &times, &gripper);
}

/// What of a stored image the truth's checksum is of.
enum Checked {
    /// The bytes of the file.
    File,
    /// The pixels, little-endian.
    Pixels,
}

fn crc32(bytes: impl IntoIterator<Item = u8>) -> i64 {
    let bytes: Vec<u8> = bytes.into_iter().collect();
    i64::from(crc32fast::hash(&bytes))
}

fn pixel_crc32(file: &[u8]) -> i64 {
    match decode(file, &Limits::default()).unwrap().pixels() {
        Pixels::Gray16(values) => crc32(values.iter().flat_map(|value| value.to_le_bytes())),
        Pixels::GrayF32(values) => crc32(values.iter().flat_map(|value| value.to_le_bytes())),
        other => panic!("no depth: {} channels", other.channels()),
    }
}

/// Every image of a camera is a row with its stamp, and its bytes or pixels are those of the log.
fn check_camera(log: &Path, topic: &str, truth: &Truth, prefix: &str, checked: &Checked) {
    let folder = tempfile::tempdir().unwrap();
    let feature = "observation.images.camera";
    let dataset = rows_of(folder.path(), log, "camera", &stream("camera", topic, &[], feature));
    assert_eq!(dataset.integers("gawm.time_ns"), truth.times(&format!("{prefix}_stamp")), "{topic}");
    let expected = match checked {
        Checked::File => truth.times(&format!("{prefix}_crc32")),
        Checked::Pixels => truth.times(&format!("{prefix}_pixels_crc32")),
    };
    let got: Vec<i64> = dataset
        .images(feature)
        .into_iter()
        .map(|file| match checked {
            Checked::File => crc32(file),
            Checked::Pixels => pixel_crc32(&file),
        })
        .collect();
    assert_eq!(got, expected, "{topic}");
}

#[test]
fn images_keep_their_bytes_and_depth_its_pixels() {
    let Some(corpora) = shared() else { return };
    for (log, name) in [("cell_mixed_zstd.mcap", "cell"), ("cell_split", "cell_split")] {
        let log = corpora.join("cell").join(log);
        let truth = Truth::open(&corpora.join(format!("cell/truth/{name}.npz")));
        check_camera(&log, "/cam/wrist/image/compressed", &truth, "wrist", &Checked::File);
        check_camera(&log, "/cam/overhead/image", &truth, "overhead", &Checked::File);
        check_camera(&log, "/cam/side/depth/image_raw", &truth, "depth16", &Checked::Pixels);
        check_camera(&log, "/cam/overhead/depth/compressedDepth", &truth, "depthc", &Checked::Pixels);
        check_camera(&log, "/cam/wrist/depth/image", &truth, "depthf", &Checked::Pixels);
    }
}

/// Raw colour images are stored without loss: what the log held comes back in the order of its channels.
#[test]
fn raw_images_in_changing_encodings() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let log = corpora.join("cell/cell_mixed_zstd.mcap");
    let truth = Truth::open(&corpora.join("cell/truth/cell.npz"));
    let feature = "observation.images.side";
    let dataset = rows_of(folder.path(), &log, "side", &stream("side", "/cam/side/image_raw", &[], feature));
    assert_eq!(dataset.integers("gawm.time_ns"), truth.times("side_stamp"));
    let (checksums, steps) = (truth.times("side_crc32"), truth.times("side_step"));
    let mut counts = [0; 3];
    for (row, file) in dataset.images(feature).iter().enumerate() {
        let image = decode(file, &Limits::default()).unwrap();
        let Pixels::Rgb8(pixels) = image.pixels() else { panic!("row {row} is no colour image") };
        let rgb = || pixels.chunks_exact(3);
        let recorded = [
            (480, crc32(pixels.iter().copied())),
            (480, crc32(rgb().flat_map(|p| [p[2], p[1], p[0]]))),
            (640, crc32(rgb().flat_map(|p| [p[0], p[1], p[2], 255]))),
        ];
        for (count, (step, crc)) in counts.iter_mut().zip(recorded) {
            *count += usize::from(steps[row] == step && checksums[row] == crc);
        }
    }
    let of_step = |step: i64| steps.iter().filter(|other| **other == step).count();
    assert!(counts.iter().all(|count| *count > 0), "{counts:?}");
    assert_eq!(counts[0] + counts[1], of_step(480));
    assert_eq!(counts[2], of_step(640));
}

/// Five writers, one robot: the images are the same bytes.
#[test]
fn the_arms_images_in_five_encodings() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let truth = Truth::open(&corpora.join("generated/truth/arm.npz"));
    let mut first = None;
    for (n, name) in [
        "arm_ros2_zstd.mcap",
        "arm_ros2_unchunked.mcap",
        "arm_json_lz4.mcap",
        "arm_protobuf.mcap",
        "arm_rosbags",
    ]
    .into_iter()
    .enumerate()
    {
        let log = corpora.join("generated").join(name);
        let feature = "observation.images.camera";
        let text = stream("camera", "/camera/image/compressed", &[], feature);
        let dataset = rows_of(&folder.path().join(n.to_string()), &log, "camera", &text);
        assert_eq!(dataset.integers("gawm.time_ns"), truth.times("image_stamp"), "{name}");
        let images = dataset.images(feature);
        assert_eq!(images.len(), 600, "{name}");
        assert!(*first.get_or_insert_with(|| images.clone()) == images, "{name}");
    }
}
