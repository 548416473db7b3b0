//! `gawm-ingest` on the corpora: exact against their truth files, defined outcomes for every damage.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::path::{Path, PathBuf};

use support::{Dataset, Truth, code, ingest, last_at, lost, run, shared, stderr, stdout, suggest, text};

/// The arm's contract: joints by name, the gripper, commands in force, the camera; episodes by markers.
const ARM: &str = r#"
[ticks]
rate_hz = 20
[[stream]]
name = "joints"
topic = "/joint_states"
fields = [FIELDS]
feature = "observation.state"
kind = "angle"
wrap = "pi"
tolerance_ms = 60
[[stream]]
name = "command"
topic = "/arm/command"
fields = ["data[0:7]"]
feature = "action"
clock = "log"
action = { timing = "in-force" }
tolerance_ms = 200
[[stream]]
name = "camera"
topic = "/camera/image/compressed"
feature = "observation.images.camera"
tolerance_ms = 150
[episodes]
from = "marker"
topic = "/episode_marker"
field = "data.event"
start = "start"
stop = "end"
[labels]
task = "move"
success = { topic = "/episode_marker", field = "data.success" }
"#;

fn arm_contract(folder: &Path, more: &str) -> PathBuf {
    let fields: Vec<String> = (1..=6).map(|k| format!("'position[name=\"joint_{k}\"]'")).collect();
    let path = folder.join("arm.toml");
    std::fs::write(&path, ARM.replace("FIELDS", &fields.join(", ")) + more).unwrap();
    path
}

/// Joint values, times and commands of every row equal the truth's last samples at or before the tick.
fn check_arm_truth(dataset: &Dataset, truth: &Truth, has_command: bool) {
    let stamps = truth.times("joint_stamp");
    let ticks = dataset.integers("gawm.time_ns");
    for joint in 0..6 {
        let expected = truth.column("joint_position", joint);
        let got = dataset.values("observation.state", &format!("joint_{}", joint + 1));
        for (&tick, got) in ticks.iter().zip(got) {
            let at = last_at(&stamps, tick).unwrap();
            assert!(got == expected[at], "joint {joint} at {tick}: {got} != {}", expected[at]);
            assert!(tick - stamps[at] <= 60_000_000);
        }
    }
    if has_command {
        let times = truth.times("action_log");
        let expected = truth.column("action", 3);
        let got = dataset.values("action", "data_3");
        let rows = ticks.iter().zip(got).zip(dataset.is_last());
        for ((&tick, got), _) in rows.filter(|(_, is_last)| !is_last) {
            assert!(got == expected[last_at(&times, tick).unwrap()], "command at {tick}");
        }
    }
}

#[test]
fn the_arm_in_five_encodings_equals_its_truth() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let truth = Truth::open(&corpora.join("generated/truth/arm.npz"));
    let contract = arm_contract(folder.path(), "");
    for name in ["arm_ros2_zstd.mcap", "arm_ros2_unchunked.mcap", "arm_rosbags"] {
        let out = folder.path().join(name);
        let report = run(&contract, &out, &[&corpora.join("generated").join(name)], &[], 0);
        assert_eq!(report["episodes"].as_u64(), Some(6), "{name}");
        let dataset = Dataset::open(&out);
        check_arm_truth(&dataset, &truth, true);
        let success: Vec<String> = dataset.episode_column("success");
        assert_eq!(success, ["false", "true", "false", "false", "true", "true"], "{name}");
    }
    for name in ["arm_protobuf.mcap", "arm_json_lz4.mcap"] {
        let suggested = folder.path().join(format!("{name}.toml"));
        let log = corpora.join("generated").join(name);
        suggest(&[&log], &suggested);
        let out = folder.path().join(name);
        let report = run(&suggested, &out, &[&log], &[], 0);
        assert_eq!(report["episodes"].as_u64(), Some(6), "{name}");
        check_arm_truth(&Dataset::open(&out), &truth, false);
    }
}

/// A command array holds joint angles, one of which wraps, and something else behind them.
#[test]
fn commands_that_joint_angles_follow_are_angles() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("c.toml");
    suggest(&[&corpora.join("generated/arm_ros2_zstd.mcap")], &contract);
    let written: toml::Table = toml::from_str(&std::fs::read_to_string(&contract).unwrap()).unwrap();
    let mut found = Vec::new();
    for stream in written["stream"].as_array().unwrap() {
        if stream["topic"].as_str() == Some("/arm/command") {
            let fields: Vec<&str> =
                stream["fields"].as_array().unwrap().iter().map(|field| field.as_str().unwrap()).collect();
            let text = |key: &str| stream.get(key).and_then(toml::Value::as_str).unwrap_or("").to_owned();
            found.push((fields.join(" "), text("kind"), text("wrap")));
        }
    }
    let expected = [("data[0:5]", "angle", ""), ("data[5]", "angle", "pi"), ("data[6]", "", "")];
    assert_eq!(found, expected.map(|(a, b, c)| (a.to_owned(), b.to_owned(), c.to_owned())));
}

#[test]
fn jobs_do_not_change_the_bytes_of_the_arm() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = arm_contract(folder.path(), "");
    let log = corpora.join("generated/arm_ros2_zstd.mcap");
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    run(&contract, &a, &[&log], &["--jobs", "1"], 0);
    run(&contract, &b, &[&log], &["--jobs", "4"], 0);
    support::check_same(&a, &b);
}

/// One damaged log: exit code, frames (none: nothing is written), words on stderr, a loss.
struct Damaged {
    file: &'static str,
    code: i32,
    frames: Option<u64>,
    words: &'static [&'static str],
    lost: Option<(&'static str, &'static str, u64)>,
}

const fn damaged(
    file: &'static str,
    code: i32,
    frames: Option<u64>,
    words: &'static [&'static str],
    lost: Option<(&'static str, &'static str, u64)>,
) -> Damaged {
    Damaged { file, code, frames, words, lost }
}

/// The undamaged log gives 80 rows: two episodes of 2 s at 20 Hz.
const DAMAGED: &[Damaged] = &[
    damaged("base_short.mcap", 0, Some(80), &[], None),
    damaged("bad_chunk_crc_field.mcap", 3, Some(40), &["chunk_crc_mismatch"], None),
    damaged("bad_clock_jump_forward.mcap", 0, Some(80), &["jump forward by 3600"], None),
    damaged(
        "bad_corrupt_jpegs.mcap",
        3,
        Some(80),
        &[],
        Some(("/camera/image/compressed", "corrupt_image", 4)),
    ),
    damaged("bad_duplicates.mcap", 0, Some(80), &[], None),
    damaged("bad_empty_file.mcap", 1, None, &["empty"], None),
    damaged("bad_end_magic.mcap", 0, Some(80), &["bad_end_magic"], None),
    damaged(
        "bad_joint_array_short.mcap",
        3,
        Some(80),
        &[],
        Some(("/joint_states", "array_length_mismatch", 6)),
    ),
    damaged("bad_missing_joint_topic.mcap", 1, None, &["/joint_states", "joints"], None),
    damaged("bad_nan_actions.mcap", 0, Some(80), &["NaN or infinity"], None),
    damaged("bad_no_summary.mcap", 0, Some(80), &[], None),
    damaged("bad_out_of_order.mcap", 0, Some(80), &["out of order"], None),
    damaged("bad_record_length_huge.mcap", 0, Some(80), &["record_length_implausible"], None),
    damaged("bad_schema_change.mcap", 0, Some(80), &[], None),
    damaged("bad_schema_garbage.mcap", 0, Some(80), &[], None),
    damaged("bad_truncated_mid_chunk.mcap", 3, Some(40), &["truncated"], None),
    damaged("bad_unclosed_episodes.mcap", 0, Some(110), &["no end mark"], None),
    damaged("bad_unknown_compression.mcap", 3, Some(40), &["brtl"], None),
];

#[test]
fn every_damage_has_its_outcome() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = arm_contract(folder.path(), "");
    let truth = Truth::open(&corpora.join("generated/truth/base_short.npz"));
    for case in DAMAGED {
        let log = corpora.join("generated").join(case.file);
        let out = folder.path().join(case.file);
        let report_path = folder.path().join("r.json");
        let output = ingest(&[
            "run",
            "-v",
            "--config",
            text(&contract),
            "--out",
            text(&out),
            "--report",
            text(&report_path),
            text(&log),
        ]);
        let said = stderr(&output);
        assert_eq!(code(&output), case.code, "{}: {said}\n{}", case.file, stdout(&output));
        for word in case.words {
            assert!(said.contains(word), "{}: expected {word:?} in {said}", case.file);
        }
        let report = serde_json::from_slice(&std::fs::read(&report_path).unwrap()).unwrap();
        support::check_report(&report);
        if let Some((topic, reason, count)) = case.lost {
            assert_eq!(lost(&report, topic, reason), count, "{}", case.file);
        }
        assert_eq!(report["frames"].as_u64(), Some(case.frames.unwrap_or(0)), "{}", case.file);
        assert_eq!(out.exists(), case.frames.is_some());
        let is_shifted = case.file.contains("jump") || case.file.contains("array_short");
        if case.frames.is_some() && !is_shifted {
            check_arm_truth(&Dataset::open(&out), &truth, false);
        }
    }
}

#[test]
fn order_and_duplicates_do_not_change_the_rows() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = arm_contract(folder.path(), "");
    let data = |file: &str| {
        let out = folder.path().join(file);
        run(&contract, &out, &[&corpora.join("generated").join(file)], &[], 0);
        std::fs::read(out.join("data/chunk-000/file-000.parquet")).unwrap()
    };
    let base = data("base_short.mcap");
    for file in ["bad_duplicates.mcap", "bad_out_of_order.mcap", "bad_no_summary.mcap", "bad_end_magic.mcap"]
    {
        assert!(data(file) == base, "{file}");
    }
}

#[test]
fn a_joint_that_does_not_exist_is_an_error_that_lists_those_that_do() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = arm_contract(folder.path(), "");
    let written = std::fs::read_to_string(&contract).unwrap().replace("joint_4", "elbow");
    std::fs::write(&contract, written).unwrap();
    let out = folder.path().join("out");
    let log = corpora.join("generated/base_short.mcap");
    let output = ingest(&["run", "--config", text(&contract), "--out", text(&out), text(&log)]);
    assert_eq!(code(&output), 1, "{}", stdout(&output));
    let said = stderr(&output);
    assert!(said.contains("elbow") && said.contains("joint_4") && said.contains("600"), "{said}");
}

#[test]
fn nan_commands_are_kept_and_flagged() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = arm_contract(folder.path(), "");
    let out = folder.path().join("out");
    run(&contract, &out, &[&corpora.join("generated/bad_nan_actions.mcap")], &[], 0);
    let dataset = Dataset::open(&out);
    let (values, valid) = (dataset.values("action", "data_0"), dataset.bools("gawm.valid.action"));
    let is_last = dataset.is_last();
    let flagged = (0..valid.len()).filter(|&row| !valid[row] && !is_last[row]).count();
    assert!(flagged > 0);
    for row in 0..valid.len() {
        assert_eq!(values[row].is_nan(), !valid[row] && !is_last[row], "row {row}");
    }
    let stats: serde_json::Value =
        serde_json::from_slice(&std::fs::read(out.join("meta/stats.json")).unwrap()).unwrap();
    assert!(
        stats["action"]["mean"].as_array().unwrap().iter().all(serde_json::Value::is_f64),
        "{}",
        stats["action"]
    );
}

/// What `suggest` proposes for a log of the work cell runs, and its joint values are the truth's.
fn check_cell(corpora: &Path, log: &str, truth: &str, episodes: u64) -> (Dataset, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("cell.toml");
    let path = corpora.join("cell").join(log);
    suggest(&[&path], &contract);
    let out = folder.path().join("out");
    let report = run(&contract, &out, &[&path], &[], 0);
    assert_eq!(report["episodes"].as_u64(), Some(episodes), "{log}");
    let dataset = Dataset::open(&out);
    let truth_arrays = Truth::open(&corpora.join(format!("cell/truth/{truth}.npz")));
    let info: serde_json::Value =
        serde_json::from_slice(&std::fs::read(corpora.join(format!("cell/truth/{truth}.json"))).unwrap())
            .unwrap();
    let ticks = dataset.integers("gawm.time_ns");
    for (stream, joints) in info["joint_columns"].as_object().unwrap() {
        let stamps = truth_arrays.times(&format!("{stream}_stamp"));
        for (column, joint) in joints.as_array().unwrap().iter().enumerate() {
            let joint = joint.as_str().unwrap();
            let expected = truth_arrays.column(&format!("{stream}_position"), column);
            let got = dataset.values("observation.state", joint);
            for (&tick, got) in ticks.iter().zip(got) {
                assert!(got == expected[last_at(&stamps, tick).unwrap()], "{log}: {joint} at {tick}");
            }
        }
    }
    (dataset, folder)
}

#[test]
fn the_work_cell_equals_its_truth() {
    let Some(corpora) = shared() else { return };
    let (dataset, _kept) = check_cell(&corpora, "cell_mixed_zstd.mcap", "cell", 6);
    assert_eq!(dataset.episode_column("operator"), ["ines", "tom", "ines", "tom", "ines", "tom"]);
    assert_eq!(dataset.episode_column("success"), ["true", "true", "true", "false", "true", "false"]);
    let (split, _kept_too) = check_cell(&corpora, "cell_split", "cell_split", 6);
    assert_eq!(dataset.integers("gawm.time_ns"), split.integers("gawm.time_ns"));
    check_cell(&corpora, "cell_no_action.mcap", "cell_no_action", 3);
    check_cell(&corpora, "odd_gripper_stuck.mcap", "odd_gripper_stuck", 3);
    check_cell(&corpora, "odd_idle_ends.mcap", "odd_idle_ends", 1);
    check_cell(&corpora, "odd_saturated.mcap", "odd_saturated", 2);
    check_cell(&corpora, "odd_stall_burst.mcap", "odd_stall_burst", 3);
}

#[test]
fn calibrations_follow_their_images() {
    let Some(corpora) = shared() else { return };
    let (dataset, _kept) = check_cell(&corpora, "cell_mixed_zstd.mcap", "cell", 6);
    let path = dataset.dir.join("meta/calibration/observation.images.wrist.json");
    let calibration: serde_json::Value = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(calibration["stored"]["k"][0], 288.0);
    assert!(dataset.dir.join("meta/attachments/cell.urdf").exists());
}

#[test]
fn gaps_are_reported_and_never_bridged() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    for (log, words) in [("odd_stall_lost.mcap", "gap of 2"), ("odd_camera_dies.mcap", "silent from 2.9")] {
        let path = corpora.join("cell").join(log);
        let contract = folder.path().join(format!("{log}.toml"));
        suggest(&[&path], &contract);
        let out = folder.path().join(log);
        let output = ingest(&["run", "--config", text(&contract), "--out", text(&out), text(&path)]);
        assert!(stderr(&output).contains(words), "{log}: {}", stderr(&output));
        let dataset = Dataset::open(&out);
        let (ticks, is_last) = (dataset.integers("gawm.time_ns"), dataset.is_last());
        let period = 1_000_000_000 / 15;
        for row in 0..ticks.len() - 1 {
            let step = ticks[row + 1] - ticks[row];
            assert!(
                is_last[row] || (step - period).abs() <= 1,
                "{log}: row {row} is {step} ns before the next"
            );
        }
    }
}

#[test]
fn a_fleet_in_one_go_or_appended_is_the_same() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let logs: Vec<PathBuf> = ["a_s1", "a_s2", "b_s1", "b_s2"]
        .iter()
        .map(|name| corpora.join(format!("cell/fleet/cell_{name}.mcap")))
        .collect();
    let refs: Vec<&Path> = logs.iter().map(PathBuf::as_path).collect();
    let contract = folder.path().join("fleet.toml");
    suggest(&refs, &contract);
    let (once, appended) = (folder.path().join("once"), folder.path().join("appended"));
    let report = run(&contract, &once, &refs, &[], 0);
    assert_eq!(report["episodes"].as_u64(), Some(8));
    run(&contract, &appended, &refs[..1], &[], 0);
    for log in &refs[1..] {
        run(&contract, &appended, &[log], &["--append"], 0);
    }
    support::check_same(&once, &appended);
}

/// Logs of other people: frames that their suggested contract gives; none where there is nothing to map, 0 where the
/// log is too short.
const FOREIGN: &[(&str, Option<u64>)] = &[
    ("amber/soccer_goal_12.mcap", Some(0)),
    ("cart_pole/ddpg_simulation_example.mcap", Some(1099)),
    ("cart_pole/out_of_bounds.mcap", Some(244)),
    ("cart_pole/test.mcap", Some(0)),
    ("coscene/example.mcap", None),
    ("depthai/recording.mcap", Some(123)),
    ("foxglove_tutorials/tutorial.mcap", Some(51)),
    ("keelson/2024-05-15.mcap", None),
    ("lichtblick/example.mcap", Some(32)),
    ("mcap_encrypt/sample.mcap", Some(50)),
    ("plotjuggler/test_bad_schema.mcap", Some(10)),
    ("plotjuggler/test_large_arrays.mcap", Some(30)),
    ("plotjuggler/test_sample_0_6.mcap", None),
    ("rerun/simple_protobuf_vec3.mcap", Some(5)),
    ("robocodec/robocodec_test_0.mcap", Some(0)),
    ("robocodec/robocodec_test_3.mcap", Some(0)),
    ("robocodec/robocodec_test_4.mcap", Some(0)),
    ("robocodec/robocodec_test_5.mcap", None),
    ("robocodec/robocodec_test_7.mcap", Some(0)),
    ("robocodec/robocodec_test_9.mcap", Some(0)),
    ("robocodec/robocodec_test_11.mcap", Some(0)),
    ("rosbag2/only_services.mcap", None),
    ("rosbag2/talker.mcap", None),
    ("rosbag2/test_bag_for_seek_0.mcap", Some(5)),
    ("rosbag2/cdr_test_0.db3", None),
    ("rosbag2parquet/array_msgs_0.mcap", Some(0)),
];

#[test]
fn logs_of_other_people_run_with_what_suggest_proposes() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    for (name, frames) in FOREIGN {
        let log = corpora.join(name);
        let output = ingest(&["suggest", text(&log)]);
        let Some(frames) = frames else {
            assert_eq!(code(&output), 1, "{name}: {}", stdout(&output));
            assert!(!stderr(&output).contains("panicked"), "{name}");
            continue;
        };
        assert_eq!(code(&output), 0, "{name}: {}", stderr(&output));
        let contract = folder.path().join("c.toml");
        std::fs::write(&contract, &output.stdout).unwrap();
        let out = folder.path().join(name.replace('/', "_"));
        let expected = if *frames == 0 { 1 } else { 0 };
        let report = run(&contract, &out, &[&log], &[], expected);
        assert_eq!(report["frames"].as_u64(), Some(*frames), "{name}");
        if *frames == 0 {
            assert!(report["files"][0]["error"].as_str().unwrap().contains("too short"), "{name}: {report}");
        }
    }
}

#[test]
fn a_clock_that_is_reset_hundreds_of_times_gives_as_many_episodes() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let log = corpora.join("cart_pole/kill_me_pls.mcap");
    let contract = folder.path().join("c.toml");
    suggest(&[&log], &contract);
    let report = run(&contract, &folder.path().join("out"), &[&log], &[], 0);
    let episodes = report["episodes"].as_u64().unwrap();
    assert!((250..=320).contains(&episodes), "{episodes}");
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("clock reset"), "{warnings}");
}
