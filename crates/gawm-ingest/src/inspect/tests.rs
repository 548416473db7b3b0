//! Reports of logs made in memory.

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use bytes::Bytes;
use mcap::WriteOptions;
use mcap::records::MessageHeader;

use super::*;

const MS: u64 = 1_000_000;
const START: u64 = 1_760_000_000_000_000_000;

/// Stamps are the first eight bytes of a payload.
struct StampProbe;

impl MessageProbe for StampProbe {
    fn probe(&self, channel: &Channel) -> ChannelProbe {
        let obstacle = (channel.topic == "/secret").then(|| "no decoder".to_owned());
        ChannelProbe {
            obstacle,
            stamp: Some(Box::new(|payload| Some(i64::from_le_bytes(*payload.first_chunk()?)))),
        }
    }
}

/// One message: topic, sequence, log time, publish time, header stamp.
type Row = (&'static str, u32, u64, u64, u64);

fn report(rows: &[Row], options: WriteOptions) -> FileReport {
    let mut writer = options.create(Cursor::new(Vec::new())).unwrap();
    for &(topic, sequence, log_time, publish_time, stamp) in rows {
        let channel_id = writer.add_channel(0, topic, "cdr", &BTreeMap::new()).unwrap();
        let header = MessageHeader { channel_id, sequence, log_time, publish_time };
        writer.write_to_known_channel(&header, &stamp.to_le_bytes()).unwrap();
    }
    writer.finish().unwrap();
    let bytes = Bytes::from(writer.into_inner().into_inner());
    let log = Log::from_bytes(Path::new("x.mcap"), bytes, &OpenOptions::default()).unwrap();
    inspect_log(&log, Path::new("x.mcap"), &StampProbe)
}

/// A channel at 100 Hz whose clocks are 2 ms and 5 ms apart.
fn regular(topic: &'static str, n: u64) -> Vec<Row> {
    (0..n)
        .map(|i| {
            (topic, i as u32, START + i * 10 * MS, START + i * 10 * MS - 2 * MS, START + i * 10 * MS - 5 * MS)
        })
        .collect()
}

fn notices_of(rows: &[Row]) -> Vec<(NoticeKind, String)> {
    report(rows, WriteOptions::new()).notices.into_iter().map(|notice| (notice.kind, notice.detail)).collect()
}

#[test]
fn a_regular_channel_has_a_rate_and_clocks() {
    let file = report(&regular("/a", 300), WriteOptions::new());
    assert_eq!((file.messages, file.start_ns, file.end_ns), (300, Some(START), Some(START + 2990 * MS)));
    let channel = &file.channels[0];
    let rate = channel.rate.as_ref().unwrap();
    assert!((rate.median_hz - 100.0).abs() < 1.1, "got {}", rate.median_hz);
    assert_eq!((rate.gaps, rate.jitter_ms), (0, 0.0));
    assert_eq!(channel.publish_to_log.as_ref().unwrap().median_ms, 2.0);
    assert_eq!(channel.stamp_to_log.as_ref().unwrap().median_ms, 5.0);
    assert_eq!(channel.stamp_to_publish.as_ref().unwrap().median_ms, 3.0);
    assert_eq!((channel.missing_by_sequence, channel.duplicates, channel.stamps), (Some(0), 0, 300));
    assert_eq!((file.damage.len(), file.notices.len()), (0, 0), "{:?} {:?}", file.damage, file.notices);
}

#[test]
fn lost_messages_are_a_gap_and_skipped_numbers() {
    let rows: Vec<Row> = regular("/a", 300).into_iter().filter(|row| !(100..120).contains(&row.1)).collect();
    let notices = notices_of(&rows);
    assert_eq!(
        notices.iter().map(|(kind, _)| *kind).collect::<Vec<_>>(),
        [NoticeKind::Gap, NoticeKind::MissingBySequence]
    );
    assert_eq!(notices[0].1, "a gap of 210 ms at 0.990 s (period 10.0 ms)");
    assert_eq!(notices[1].1, "20 sequence numbers skipped");
}

#[test]
fn a_stalled_recorder_is_bunching_and_no_gap() {
    let stall = |mut row: Row| {
        if (100..120).contains(&row.1) {
            row.2 = START + 1200 * MS;
        }
        row
    };
    let rows: Vec<Row> = regular("/a", 300).into_iter().map(stall).collect();
    let notices = notices_of(&rows);
    assert_eq!(notices.len(), 1, "{notices:?}");
    assert_eq!(notices[0].0, NoticeKind::Bunching);
}

#[test]
fn steps_back_duplicates_and_early_ends_are_told() {
    let mut rows = regular("/a", 300);
    rows.insert(50, rows[49]);
    rows.push(("/a", 9, START, START - 2 * MS, START));
    rows.extend(regular("/b", 100));
    let kinds: Vec<NoticeKind> = notices_of(&rows).into_iter().map(|(kind, _)| kind).collect();
    assert_eq!(kinds, [NoticeKind::BackwardSteps, NoticeKind::Duplicates, NoticeKind::EndsEarly]);
}

#[test]
fn equal_publish_times_are_no_publish_clock() {
    let rows: Vec<Row> = regular("/a", 30).into_iter().map(|row| (row.0, 0, row.2, row.2, row.4)).collect();
    let file = report(&rows, WriteOptions::new());
    assert_eq!(file.notices[0].kind, NoticeKind::NoPublishClock);
    assert_eq!(
        (file.channels[0].publish_to_log.as_ref(), file.channels[0].missing_by_sequence),
        (None, None)
    );
}

#[test]
fn a_drifting_header_clock_is_told_with_its_rate() {
    let drifting = |row: Row| (row.0, row.1, row.2, row.3, row.4 + (row.2 - START) / 20_000);
    let rows: Vec<Row> = regular("/a", 1200).into_iter().map(drifting).collect();
    let notices = notices_of(&rows);
    assert_eq!(notices.len(), 1, "{notices:?}");
    assert!(notices[0].1.starts_with("header stamps run +50.0 ppm"), "{}", notices[0].1);
}

#[test]
fn log_time_zero_is_reported_and_not_in_the_span() {
    let mut rows = regular("/a", 30);
    rows.insert(0, ("/latched", 0, 0, 0, 0));
    let file = report(&rows, WriteOptions::new());
    assert_eq!((file.start_ns, file.messages), (Some(START), 31));
    let kinds: Vec<DamageKind> = file.damage.iter().map(|damage| damage.kind).collect();
    assert_eq!(kinds, [DamageKind::LogTimeZero]);
    assert!(!InspectReport { files: vec![file], ..InspectReport::default() }.has_loss());
}

#[test]
fn the_report_is_the_same_at_any_chunk_size() {
    let mut rows = regular("/a", 300);
    rows.extend(regular("/secret", 10));
    let strip = |mut file: FileReport| {
        (file.bytes, file.chunks, file.uncompressed_bytes, file.loose_blocks) = (0, 0, 0, 0);
        file.compression.clear();
        file
    };
    let whole = strip(report(&rows, WriteOptions::new()));
    assert_eq!(strip(report(&rows, WriteOptions::new().chunk_size(Some(400)))), whole);
    assert_eq!(strip(report(&rows, WriteOptions::new().use_chunks(false))), whole);
    assert_eq!(whole.channels.iter().map(|channel| channel.decodable).collect::<Vec<_>>(), [true, false]);
}

#[test]
fn the_json_has_the_keys_that_others_rely_on() {
    let mut rows = regular("/a", 5);
    rows.push(("/latched", 0, 0, 0, 0));
    let file = report(&rows, WriteOptions::new().profile("ros2"));
    let json = serde_json::to_value(InspectReport { files: vec![file], ..InspectReport::default() }).unwrap();
    let file = &json["files"][0];
    for key in [
        "path",
        "profile",
        "library",
        "messages",
        "attachments",
        "metadata",
        "start_ns",
        "end_ns",
        "channels",
        "damage",
    ] {
        assert!(file.get(key).is_some(), "no key {key}");
    }
    for key in ["topic", "schema_name", "schema_encoding", "message_encoding", "messages", "decodable"] {
        assert!(file["channels"][0].get(key).is_some(), "no key {key}");
    }
    assert_eq!(file["damage"][0]["kind"], "log_time_zero");
    assert!(file["damage"][0]["offset"].is_u64() && file["damage"][0]["detail"].is_string());
}

#[test]
fn the_text_says_damage_first_and_then_one_line_per_channel() {
    let mut rows = regular("/arm/joint_states", 300);
    rows.push(("/latched", 0, 0, 0, 0));
    let text = render_text(&InspectReport {
        files: vec![report(&rows, WriteOptions::new())],
        ..InspectReport::default()
    });
    let lines: Vec<&str> = text.lines().collect();
    assert_eq!(lines[0], "x.mcap");
    assert!(lines[1].starts_with("  note  log_time_zero at byte 0: 1 message on \"/latched\""), "{text}");
    assert!(lines[2].contains("301 messages, 2.990 s from 2025-10-09 08:53:20.000 UTC"), "{text}");
    let row = lines.iter().find(|line| line.starts_with("  /arm/joint_states")).unwrap();
    let cells: Vec<&str> = row.split_whitespace().collect();
    assert_eq!(cells[..6], ["/arm/joint_states", "cdr/no", "schema", "300", "2.4", "kB"], "{text}");
    // Not one channel has a schema: a column that says nothing is left out.
    assert!(!lines.iter().any(|line| line.starts_with("  topic") && line.contains("schema")), "{text}");
}

#[test]
fn every_damage_kind_is_documented() {
    let text =
        std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/formats/inspect.md"))
            .unwrap();
    for kind in DamageKind::ALL {
        assert!(
            text.contains(&format!("| `{}` |", kind.as_str())),
            "docs/formats/inspect.md does not document {}",
            kind.as_str()
        );
    }
}

#[test]
fn the_generated_arm_and_cell_logs_show_what_is_odd() {
    let Some(shared) = std::env::var_os("GAWM_SHARED") else {
        println!("skipped: GAWM_SHARED is not set");
        return;
    };
    let corpora = Path::new(&shared).join("corpora");
    let kinds_of = |name: &str| -> Vec<NoticeKind> {
        let found = inspect(&[corpora.join(name)], &OpenOptions::default(), &DecoderProbe::default());
        assert_eq!(found.files.len(), 1, "{name}: {:?}", found.refused);
        found.files[0].notices.iter().map(|notice| notice.kind).collect()
    };
    for (name, kind) in [
        ("generated/bad_clock_jump_forward.mcap", NoticeKind::Gap),
        ("generated/bad_duplicates.mcap", NoticeKind::Duplicates),
        ("generated/bad_out_of_order.mcap", NoticeKind::BackwardSteps),
        ("generated/bad_schema_change.mcap", NoticeKind::SeveralChannels),
        ("cart_pole/kill_me_pls.mcap", NoticeKind::BackwardSteps),
        ("cell/cell_mixed_zstd.mcap", NoticeKind::ClockDrift),
        ("cell/odd_camera_dies.mcap", NoticeKind::EndsEarly),
        ("cell/odd_stall_burst.mcap", NoticeKind::Bunching),
        ("cell/odd_stall_lost.mcap", NoticeKind::Gap),
        ("amber/soccer_goal_12.mcap", NoticeKind::CompressedMessages),
        ("plotjuggler/test_sample_0_6.mcap", NoticeKind::NotDecodable),
    ] {
        assert!(kinds_of(name).contains(&kind), "{name}: expected {kind:?}, got {:?}", kinds_of(name));
    }
    let whole = kinds_of("generated/base_short.mcap");
    assert!(!whole.contains(&NoticeKind::Gap) && !whole.contains(&NoticeKind::EndsEarly), "{whole:?}");
}
