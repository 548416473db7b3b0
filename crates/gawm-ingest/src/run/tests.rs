//! Logs made here, through the contract to rows.

use std::collections::BTreeMap;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use arrow::array::AsArray;
use arrow::datatypes::Float64Type;
use mcap::records::MessageHeader;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;

use super::*;
use crate::contract;
use crate::suggest::{suggest, to_toml};

const MS: u64 = 1_000_000;
const START: u64 = 1_760_000_000_000_000_000;

/// One JSON message: topic, milliseconds since the start, text.
type Sent = (&'static str, u64, String);

fn write_log(path: &Path, messages: &[Sent]) {
    let mut writer = mcap::Writer::new(BufWriter::new(std::fs::File::create(path).unwrap())).unwrap();
    let mut sequences: BTreeMap<u16, u32> = BTreeMap::new();
    for (topic, ms, text) in messages {
        let channel_id = writer.add_channel(0, topic, "json", &BTreeMap::new()).unwrap();
        let sequence = sequences.entry(channel_id).or_default();
        *sequence += 1;
        let log_time = START + ms * MS;
        let header = MessageHeader { channel_id, sequence: *sequence, log_time, publish_time: log_time };
        writer.write_to_known_channel(&header, text.as_bytes()).unwrap();
    }
    writer.finish().unwrap();
}

/// An arm of two joints every 10 ms and its gripper every 20 ms, 3 ms later, on one topic.
fn two_publishers(more: &[Sent]) -> Vec<Sent> {
    let mut sent: Vec<Sent> = Vec::new();
    for i in 0..200 {
        let value = |k: u64| i as f64 + k as f64 / 10.0;
        sent.push((
            "/joints",
            10 * i,
            format!(r#"{{"name":["b","a"],"position":[{},{}]}}"#, value(2), value(1)),
        ));
        if i % 2 == 0 {
            sent.push(("/joints", 10 * i + 3, format!(r#"{{"name":["jaw"],"position":[{}]}}"#, value(3))));
        }
    }
    sent.extend(more.iter().cloned());
    sent
}

/// A contract of streams of `/joints`, each of the joints given, at 50 Hz.
fn contract_of(streams: &[&[&str]], more: &str) -> contract::CheckedContract {
    let mut text = "[ticks]\nrate_hz = 50\n".to_owned();
    for (number, joints) in streams.iter().enumerate() {
        let fields: Vec<String> =
            joints.iter().map(|joint| format!("'position[name=\"{joint}\"]'")).collect();
        text.push_str(&format!(
            "[[stream]]\nname = \"s{number}\"\ntopic = \"/joints\"\nfields = [{}]\nfeature = \"observation.state\"\nclock = \"log\"\ntolerance_ms = 50\n{more}\n",
            fields.join(", ")
        ));
    }
    contract::check(&contract::parse(&text, "test.toml", &[]).unwrap(), "test.toml").unwrap()
}

fn run_of(
    contract: &contract::CheckedContract,
    log: &Path,
    out: &Path,
) -> (Result<RunOutcome, RunError>, Report) {
    let options = RunOptions {
        contract,
        contract_folder: Path::new(""),
        out,
        logs: &[log.to_owned()],
        mode: WriteMode::New,
        jobs: 2,
        shard: None,
        interrupt: &AtomicBool::new(false),
        progress: &|_, _, _| {},
    };
    let mut report = Report::default();
    let outcome = run(&options, &mut report);
    (outcome, report)
}

/// The states of a dataset, row by row.
fn states(out: &Path) -> Vec<Vec<f64>> {
    let file = std::fs::File::open(out.join("data/chunk-000/file-000.parquet")).unwrap();
    let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap();
    let mut rows = Vec::new();
    for batch in reader.map(Result::unwrap) {
        let column = &batch["observation.state"];
        for row in 0..batch.num_rows() {
            let values = match (column.as_list_opt::<i32>(), column.as_fixed_size_list_opt()) {
                (Some(list), _) => list.value(row),
                (_, Some(list)) => list.value(row),
                _ => column.slice(row, 1),
            };
            rows.push(values.as_primitive::<Float64Type>().values().to_vec());
        }
    }
    rows
}

struct Made {
    _folder: tempfile::TempDir,
    log: PathBuf,
    out: PathBuf,
}

fn made(messages: &[Sent]) -> Made {
    let folder = tempfile::tempdir().unwrap();
    let (log, out) = (folder.path().join("log.mcap"), folder.path().join("out"));
    write_log(&log, messages);
    Made { log, out, _folder: folder }
}

fn check_rows_of_two_publishers(streams: &[&[&str]], names: &[&str]) {
    let made = made(&two_publishers(&[]));
    let (outcome, _) = run_of(&contract_of(streams, ""), &made.log, &made.out);
    let outcome = outcome.unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Ok, "{:#?}", outcome.report);
    let topic = &outcome.report.files[0].topics[0];
    assert_eq!((topic.read, topic.kept), (300, 300));
    let gawm_schema::FeatureData::Vector { parts, .. } = &outcome.schema.features[0].data else { panic!() };
    let dims: Vec<&str> = parts.iter().flat_map(|part| &part.dims).map(|dim| dim.name.as_str()).collect();
    assert_eq!(dims, names);
    // The first tick is at 3 ms, when the gripper has spoken; then every 20 ms.
    for (row, values) in states(&made.out).iter().enumerate() {
        let i = 2.0 * row as f64;
        let expected = |name: &&str| match *name {
            "a" => i + 0.1,
            "b" => i + 0.2,
            _ => i + 0.3,
        };
        assert_eq!(*values, names.iter().map(expected).collect::<Vec<f64>>(), "row {row}");
    }
}

#[test]
fn joints_come_from_whichever_message_has_them() {
    check_rows_of_two_publishers(&[&["a", "b", "jaw"]], &["a", "b", "jaw"]);
    check_rows_of_two_publishers(&[&["jaw", "b"]], &["jaw", "b"]);
    check_rows_of_two_publishers(&[&["a", "jaw", "b"]], &["a", "jaw", "b"]);
    check_rows_of_two_publishers(&[&["a", "b"], &["jaw"]], &["a", "b", "jaw"]);
}

#[test]
fn messages_without_any_mapped_joint_are_no_loss() {
    let made = made(&two_publishers(&[]));
    let (outcome, _) = run_of(&contract_of(&[&["a", "b"]], ""), &made.log, &made.out);
    let outcome = outcome.unwrap();
    assert_eq!(outcome.report.files[0].status, FileStatus::Ok, "{:#?}", outcome.report);
    let warnings = outcome.report.warnings.join("\n");
    assert!(warnings.contains("/joints: 100 messages hold none of the mapped elements"), "{warnings}");
}

#[test]
fn messages_with_some_of_the_joints_of_a_publisher_are_lost() {
    let partial = ("/joints", 1001, r#"{"name":["b"],"position":[7]}"#.to_owned());
    let made = made(&two_publishers(&[partial]));
    let (outcome, _) = run_of(&contract_of(&[&["a", "b"], &["jaw"]], ""), &made.log, &made.out);
    let outcome = outcome.unwrap();
    let topic = &outcome.report.files[0].topics[0];
    assert_eq!((topic.read, topic.kept, topic.lost[0].reason.as_str()), (301, 300, "name_absent"));
    assert!(topic.lost[0].first.contains("no \"a\" in this message, which has \"b\""), "{:?}", topic.lost);
}

#[test]
fn a_joint_that_nobody_publishes_is_an_error_that_lists_those_that_are() {
    let made = made(&two_publishers(&[]));
    let (outcome, report) = run_of(&contract_of(&[&["a", "b"], &["elbow"]], ""), &made.log, &made.out);
    assert!(matches!(outcome, Err(RunError::Nothing { .. })), "{outcome:?}");
    let error = report.files[0].error.clone().unwrap();
    assert!(error.contains("stream \"s1\"") && error.contains("which has \"b\", \"a\""), "{error}");
}

#[test]
fn a_suggestion_gives_each_publisher_its_stream() {
    let made = made(&two_publishers(&[]));
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let joints: Vec<(Vec<String>, f64)> = suggestion
        .contract
        .stream
        .iter()
        .filter(|stream| stream.topic.is_some())
        .map(|stream| (stream.fields.clone(), stream.tolerance_ms.unwrap_or_default()))
        .collect();
    let field = |joint: &str| format!("position[name=\"{joint}\"]");
    assert_eq!(joints[0].0, [field("b"), field("a")]);
    assert_eq!(joints[1].0, [field("jaw")]);
    assert!((30.0..50.0).contains(&joints[0].1) && (55.0..80.0).contains(&joints[1].1), "{joints:?}");
    let text = to_toml(&suggestion);
    let contract = contract::check(&contract::parse(&text, "s.toml", &[]).unwrap(), "s.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    assert!(!outcome.has_loss() && outcome.report.episodes == 1, "{:#?}", outcome.report);
}

#[test]
fn a_suggestion_takes_frames_that_move_where_nothing_else_says_how_the_robot_stands() {
    let transform = |child: &str, x: f64| {
        format!(
            r#"{{"transforms":[{{"child_frame_id":"{child}","transform":{{"translation":{{"x":{x},"y":0.5,"z":0}},"rotation":{{"x":0,"y":0,"z":0,"w":1}}}}}}]}}"#
        )
    };
    let mut sent: Vec<Sent> = vec![("/tf_static", 0, transform("laser", 0.2))];
    for i in 0..100 {
        sent.push(("/tf", 20 * i, transform("base", i as f64 / 100.0)));
        sent.push(("/tf", 20 * i + 1, transform("mount", 0.1)));
        sent.push(("/scan/temperature", 20 * i, format!(r#"{{"celsius":{}}}"#, 20 + i % 3)));
    }
    let made = made(&sent);
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let text = to_toml(&suggestion);
    let contract = contract::check(&contract::parse(&text, "s.toml", &[]).unwrap(), "s.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    assert!(!outcome.has_loss(), "{:#?}", outcome.report);
    let rows = states(&made.out);
    assert_eq!(rows[10].len(), 7, "{text}");
    assert_eq!(rows[10], [0.1, 0.5, 0.0, 0.0, 0.0, 0.0, 1.0]);
    assert!(text.contains("\"base.qw\""), "{text}");
}

#[test]
fn a_run_that_failed_is_not_in_the_way_of_the_corrected_one() {
    let mut sent = two_publishers(&[]);
    sent.retain(|(_, ms, _)| !(1000..1500).contains(ms));
    let made = made(&sent);
    let streams: [&[&str]; 1] = [&["a", "b"]];
    for has_folder in [false, true] {
        if has_folder {
            std::fs::create_dir(&made.out).unwrap();
        }
        let (outcome, _) = run_of(&contract_of(&streams, "gap = \"fail\""), &made.log, &made.out);
        assert!(matches!(outcome, Err(RunError::Gap { .. })), "{outcome:?}");
        assert_eq!(made.out.exists(), has_folder);
    }
    let (outcome, _) = run_of(&contract_of(&streams, ""), &made.log, &made.out);
    assert_eq!(outcome.unwrap().report.episodes, 2);
}

/// A trot: the legs move alike, half a period apart, and the commands name them in another order.
#[test]
fn commands_are_matched_to_joints_by_name() {
    let angle = |joint: f64, ms: f64| 0.4 * (std::f64::consts::PI * (ms / 400.0 + joint)).sin();
    let mut sent: Vec<Sent> = Vec::new();
    for i in 0..600_u64 {
        let ms = 10 * i;
        let values = |late_ms: f64| [0.0, 1.0, 0.5].map(|joint| angle(joint, ms as f64 - late_ms));
        let [a, b, c] = values(40.0);
        sent.push(("/joints", ms, format!(r#"{{"name":["a","b","c"],"position":[{a},{b},{c}]}}"#)));
        if i % 2 == 0 {
            let [a, b, c] = values(0.0);
            let text = format!(r#"{{"joint_names":["c","b","a"],"points":[{{"positions":[{c},{b},{a}]}}]}}"#);
            sent.push(("/legs/command", ms + 1, text));
        }
    }
    let made = made(&sent);
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let action = suggestion.contract.stream.iter().find(|stream| stream.feature == "action").unwrap();
    let named = |joint: &str| format!("points[0].positions[joint_names=\"{joint}\"]");
    assert_eq!(action.fields, ["c", "b", "a"].map(named), "{}", to_toml(&suggestion));
    assert!((38.0..40.0).contains(&action.offset_ms), "{}", to_toml(&suggestion));
}

#[test]
fn a_stream_that_keeps_rows_from_beginning_is_named() {
    let mut sent = two_publishers(&[]);
    sent.retain(|(_, ms, text)| *ms >= 1500 || !text.contains("jaw"));
    let made = made(&sent);
    let streams: [&[&str]; 2] = [&["a", "b"], &["jaw"]];
    let outcome = run_of(&contract_of(&streams, ""), &made.log, &made.out).0.unwrap();
    let said = outcome.report.warnings.join("\n");
    assert!(said.contains("\"s1\" (/joints) begins 1.503 s after"), "{said}");
}

#[test]
fn messages_with_some_of_the_structs_that_are_picked_are_lost() {
    let joint = |name: &str, i: u64| format!(r#"{{"name":"{name}","position":{i}}}"#);
    let mut sent: Vec<Sent> = Vec::new();
    for i in 0..100 {
        let joints = match i {
            40 => joint("a", i),
            41 => joint("other", i),
            _ => [joint("b", i), joint("a", i)].join(","),
        };
        sent.push(("/joints", 20 * i, format!(r#"{{"joints":[{joints}]}}"#)));
    }
    let made = made(&sent);
    let text = r#"
        [ticks]
        rate_hz = 50
        [[stream]]
        topic = "/joints"
        fields = ['joints[name="a"].position', 'joints[name="b"].position']
        feature = "observation.state"
        clock = "log"
        tolerance_ms = 50
    "#;
    let contract = contract::check(&contract::parse(text, "t.toml", &[]).unwrap(), "t.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    let topic = &outcome.report.files[0].topics[0];
    assert_eq!((topic.read, topic.kept, topic.lost.len()), (100, 99, 1), "{topic:#?}");
    assert_eq!((topic.lost[0].reason.as_str(), topic.lost[0].count), ("name_absent", 1));
    assert!(outcome.has_loss() && outcome.report.warnings.iter().any(|w| w.contains("1 messages hold none")));
    let gawm_schema::FeatureData::Vector { parts, .. } = &outcome.schema.features[0].data else { panic!() };
    assert_eq!(parts[0].dims.iter().map(|dim| dim.name.as_str()).collect::<Vec<_>>(), ["a", "b"]);
}

#[test]
fn a_suggestion_takes_the_task_beside_the_episode_marks_and_lists_what_it_leaves_out() {
    let mut sent: Vec<Sent> = Vec::new();
    for i in 0..300_u64 {
        let value = (i as f64 / 20.0).sin();
        let text = format!(r#"{{"name":["a","b"],"position":[{value},0.5],"velocity":[{i},1]}}"#);
        sent.push(("/joints", 20 * i, text));
        sent.push(("/gripper", 20 * i, format!(r#"{{"opening_mm":{}}}"#, i % 40)));
    }
    for (ms, task) in [(500, "pick"), (3500, "place")] {
        sent.push(("/events", ms, format!(r#"{{"event":"start","instruction":"{task}"}}"#)));
        sent.push(("/events", ms + 2000, r#"{"event":"end","success":true}"#.to_owned()));
    }
    sent.sort_by_key(|(_, ms, _)| *ms);
    let made = made(&sent);
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let text = to_toml(&suggestion);
    for expected in ["field = \"instruction\"", "unit = \"mm\"", "/joints also holds velocity[]"] {
        assert!(text.contains(expected), "{expected}: {text}");
    }
    assert!(!text.contains("/events (json"), "{text}");
    let contract = contract::check(&contract::parse(&text, "s.toml", &[]).unwrap(), "s.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    assert_eq!((outcome.report.episodes, outcome.has_loss()), (2, false), "{:#?}", outcome.report);
}

#[test]
fn a_suggestion_knows_images_without_a_schema_and_the_order_that_a_name_says() {
    let mut sent: Vec<Sent> = Vec::new();
    for i in 0..60_u64 {
        let (sin, cos) = (i as f64 / 50.0).sin_cos();
        sent.push(("/body", 20 * i, format!(r#"{{"quat_wxyz":[{cos},0.0,0.0,{sin}]}}"#)));
        let pixels = format!(r#""height":1,"width":2,"encoding":"rgb8","step":6,"data":[{i},2,3,4,5,6]"#);
        sent.push(("/camera", 20 * i, format!(r#"{{"is_bigendian":0,{pixels}}}"#)));
    }
    let made = made(&sent);
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let text = to_toml(&suggestion);
    assert!(text.contains("order = \"wxyz\"") && text.contains("in w, x, y, z order"), "{text}");
    assert!(text.contains("observation.images.camera"), "{text}");
    let contract = contract::check(&contract::parse(&text, "s.toml", &[]).unwrap(), "s.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    assert_eq!((outcome.report.frames, outcome.has_loss()), (60, false), "{:#?}", outcome.report);
}

#[test]
fn a_suggestion_takes_the_rate_of_bursts_with_pauses_between() {
    let mut sent: Vec<Sent> = Vec::new();
    for episode in 0..3_u64 {
        for i in 0..40 {
            sent.push(("/x", 9000 * episode + 20 * i, format!(r#"{{"v":[{i},1.5]}}"#)));
        }
        sent.push(("/done", 9000 * episode + 800, format!(r#"{{"ok":{}}}"#, episode != 1)));
    }
    let made = made(&sent);
    let suggestion =
        suggest(std::slice::from_ref(&made.log), &SchemaLibrary::builtin(), &OpenOptions::default()).unwrap();
    let text = to_toml(&suggestion);
    assert_eq!(suggestion.contract.ticks.rate_hz, Some(50.0), "{text}");
    let contract = contract::check(&contract::parse(&text, "s.toml", &[]).unwrap(), "s.toml").unwrap();
    let outcome = run_of(&contract, &made.log, &made.out).0.unwrap();
    // The last sample of a burst serves for as long as the tolerance says.
    assert!(
        outcome.report.episodes == 3 && (120..130).contains(&outcome.report.frames),
        "{:#?}",
        outcome.report
    );
}
