//! Logs of other people's writers, with the counts that the corpora's catalogue states. Needs `GAWM_SHARED`.

use std::path::PathBuf;

use super::*;
use crate::log::{Foreign, discover, looks_like_zstd};

/// The corpora, `None` when the environment names none.
fn corpora() -> Option<PathBuf> {
    let shared = std::env::var_os("GAWM_SHARED");
    if shared.is_none() {
        println!("skipped: GAWM_SHARED is not set");
    }
    let corpora = PathBuf::from(shared?).join("corpora");
    assert!(corpora.is_dir(), "GAWM_SHARED is set, but there is no folder {corpora:?}");
    Some(corpora)
}

/// File, channels, messages, attachments, metadata records.
const SOUND: &[(&str, usize, usize, usize, usize)] = &[
    ("robocodec/robocodec_test_0.mcap", 6, 6, 0, 0),
    ("robocodec/robocodec_test_3.mcap", 9, 9, 0, 0),
    ("robocodec/robocodec_test_4.mcap", 6, 6, 0, 0),
    ("robocodec/robocodec_test_5.mcap", 1, 1, 0, 0),
    ("robocodec/robocodec_test_7.mcap", 6, 6, 0, 0),
    ("robocodec/robocodec_test_9.mcap", 7, 7, 0, 0),
    ("robocodec/robocodec_test_11.mcap", 11, 11, 0, 0),
    ("franka_teach/trajectory_20250527_002946_00m00s.mcap", 6, 27, 1, 3),
    ("franka_teach/trajectory_20250527_003848_00m00s.mcap", 7, 18, 1, 3),
    ("cart_pole/ddpg_simulation_example.mcap", 2, 1096, 0, 0),
    ("cart_pole/kill_me_pls.mcap", 7, 43950, 0, 0),
    ("cart_pole/out_of_bounds.mcap", 2, 244, 0, 0),
    ("cart_pole/test.mcap", 2, 1, 0, 0),
    ("plotjuggler/test_bad_schema.mcap", 2, 20, 0, 0),
    ("plotjuggler/test_embedded_timestamp.mcap", 1, 50, 0, 0),
    ("plotjuggler/test_large_arrays.mcap", 1, 30, 0, 0),
    ("plotjuggler/test_sample_0_6.mcap", 2, 1500, 0, 0),
    ("rerun/rosbag2_2025_09_10-13_03_56_0.mcap", 32, 194, 0, 1),
    ("rerun/simple_protobuf_vec3.mcap", 1, 5, 0, 0),
    ("rosbag2/only_services.mcap", 1, 12, 0, 2),
    ("rosbag2/talker.mcap", 3, 20, 0, 0),
    ("rosbag2/cdr_test_0.mcap", 2, 7, 0, 0),
    ("rosbag2/test_bag_for_seek_0.mcap", 1, 5, 0, 0),
    ("rosbag2/rewriter_a_0.mcap", 2, 150, 0, 0),
    ("foxglove_tutorials/tutorial.mcap", 3, 153, 0, 0),
    ("mcap_explorer/demo.mcap", 3, 330, 0, 1),
    ("depthai/recording.mcap", 1, 124, 0, 0),
    ("mcap_encrypt/sample.mcap", 2, 100, 0, 0),
    ("amber/soccer_goal_12.mcap", 1, 2, 0, 0),
    ("rosbag2parquet/array_msgs_0.mcap", 2, 2, 0, 1),
    ("coscene/example.mcap", 1, 9, 0, 0),
    ("lichtblick/example.mcap", 1, 111, 0, 0),
    ("cell/cell_mixed_zstd.mcap", 22, 17791, 2, 7),
    ("cell/cell_no_action.mcap", 15, 4637, 2, 4),
    ("cell/fleet/cell_a_s1.mcap", 13, 4753, 2, 3),
    ("cell/fleet/cell_a_s2.mcap", 13, 4751, 2, 3),
    ("cell/fleet/cell_b_s1.mcap", 13, 4750, 2, 3),
    ("cell/fleet/cell_b_s2.mcap", 13, 4751, 2, 3),
    ("cell/odd_camera_dies.mcap", 17, 7831, 2, 4),
    ("cell/odd_gripper_stuck.mcap", 13, 7607, 2, 4),
    ("cell/odd_idle_ends.mcap", 8, 11664, 2, 2),
    ("cell/odd_saturated.mcap", 8, 6370, 2, 3),
    ("cell/odd_stall_burst.mcap", 17, 7937, 2, 4),
    ("cell/odd_stall_lost.mcap", 17, 7675, 2, 4),
];

#[test]
fn sound_logs_are_read_whole_and_without_damage() {
    let Some(corpora) = corpora() else { return };
    for &(name, channels, messages, attachments, metadata) in SOUND {
        let reading = read_all(Log::open(&corpora.join(name), &OpenOptions::default()).unwrap());
        let log = &reading.log;
        let got =
            (log.channels().len(), reading.messages.len(), log.attachments().len(), log.metadata().len());
        assert_eq!(got, (channels, messages, attachments, metadata), "{name}");
        assert_eq!(reading.damage, [], "{name}");
        assert!(log.verify_data_section().unwrap().is_none(), "{name}");
        (0..attachments).for_each(|i| assert!(log.read_attachment(i).is_ok(), "{name}"));
        assert!(log.summary_counts().is_none_or(|counts| counts.messages == messages as u64), "{name}");
    }
}

/// Damaged file, kinds of damage, and how many messages it has less than the undamaged log.
const DAMAGED: &[(&str, &[DamageKind])] = &[
    ("bad_chunk_crc_field.mcap", &[DamageKind::ChunkCrcMismatch]),
    ("bad_end_magic.mcap", &[DamageKind::BadEndMagic]),
    ("bad_no_summary.mcap", &[]),
    ("bad_record_length_huge.mcap", &[DamageKind::RecordLengthImplausible]),
    ("bad_truncated_mid_chunk.mcap", &[DamageKind::Truncated, DamageKind::ChunkTruncated]),
    ("bad_unknown_compression.mcap", &[DamageKind::UnsupportedCompression]),
];

#[test]
fn damaged_logs_keep_what_is_sound() {
    let Some(corpora) = corpora() else { return };
    let generated = corpora.join("generated");
    let read = |name: &str| read_all(Log::open(&generated.join(name), &OpenOptions::default()).unwrap());
    let whole = read("base_short.mcap");
    assert_eq!(whole.damage, []);
    let third_chunk = whole.log.read_block(&whole.log.blocks()[2]).messages.len();
    let n_before_third: usize =
        whole.log.blocks()[..2].iter().map(|block| whole.log.read_block(block).messages.len()).sum();
    for &(name, kinds) in DAMAGED {
        let reading = read(name);
        assert_eq!(reading.kinds(), kinds, "{name}: {:#?}", reading.damage);
        let n = reading.messages.len();
        match name {
            "bad_chunk_crc_field.mcap" | "bad_unknown_compression.mcap" => {
                assert_eq!(whole.messages.len() - n, third_chunk, "{name}");
            }
            "bad_truncated_mid_chunk.mcap" => {
                assert!((n_before_third..n_before_third + third_chunk).contains(&n), "{name}: {n}")
            }
            _ => assert_eq!(n, whole.messages.len(), "{name}"),
        }
        assert!(reading.messages.iter().all(|message| whole.messages.contains(message)), "{name}");
    }
    let same = |name: &str| assert_eq!(read(name).damage, [], "{name}");
    for name in [
        "bad_clock_jump_forward",
        "bad_corrupt_jpegs",
        "bad_duplicates",
        "bad_out_of_order",
        "bad_schema_change",
        "bad_schema_garbage",
        "arm_json_lz4",
        "arm_protobuf",
        "arm_ros2_unchunked",
        "arm_ros2_zstd",
    ] {
        same(&format!("{name}.mcap"));
    }
}

#[test]
fn what_is_no_log_is_refused_by_name() {
    let Some(corpora) = corpora() else { return };
    let refusal = |name: &str| Log::open(&corpora.join(name), &OpenOptions::default()).unwrap_err();
    assert!(matches!(refusal("generated/bad_empty_file.mcap"), OpenLogError::Empty { .. }));
    assert!(matches!(
        refusal("rosbag2/cdr_test_0.db3"),
        OpenLogError::NotMcap { found: Foreign::Sqlite, .. }
    ));
    let keelson = refusal("keelson/2024-05-15.mcap");
    assert!(keelson.to_string().contains("CR LF was converted to LF"), "{keelson}");
}

#[test]
fn split_recordings_are_one() {
    let Some(corpora) = corpora() else { return };
    for (folder, parts, expected) in [
        ("cell/cell_split", 3, 17791),
        ("rosbag2/multiple_files", 3, 3177),
        ("generated/arm_rosbags", 1, 4225),
    ] {
        let found = discover(&[corpora.join(folder)]);
        assert_eq!((found.recordings.len(), found.refused.len()), (1, 0), "{folder}");
        let recording = &found.recordings[0];
        assert_eq!(recording.parts.len(), parts, "{folder}");
        let count =
            |part: &PathBuf| read_all(Log::open(part, &OpenOptions::default()).unwrap()).messages.len();
        assert_eq!(recording.parts.iter().map(count).sum::<usize>(), expected, "{folder}");
    }
    assert_eq!(discover(&[corpora.join("cell/fleet")]).recordings.len(), 4);
}

#[test]
fn compressed_message_bodies_can_be_read() {
    let Some(corpora) = corpora() else { return };
    let reading = read(&std::fs::read(corpora.join("amber/soccer_goal_12.mcap")).unwrap());
    for message in &reading.messages {
        assert!(looks_like_zstd(&message.payload));
        let body = crate::log::decompress_message(&message.payload, 16 << 20).unwrap();
        assert!(body.len() > 640 * 480 * 3);
    }
}
