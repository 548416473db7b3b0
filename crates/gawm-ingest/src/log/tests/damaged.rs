//! Each kind of damage: what is kept, and what it is called.

use super::whole::{insert, loose_message, raw_record};
use super::*;
use crate::log::{BlockKind, Foreign, ReadError};

fn find(bytes: &[u8], op: u8, nth: usize) -> (usize, usize) {
    let record = records_of(bytes).into_iter().filter(|record| record.0 == op).nth(nth).unwrap();
    (record.1, record.2)
}

fn set_u64(bytes: &mut [u8], at: usize, value: u64) {
    bytes[at..at + 8].copy_from_slice(&value.to_le_bytes());
}

/// Checks that a damaged log reports `kinds` and keeps at least `at_least` of its 60 messages, in all of which nothing is made up.
fn check_damage(bytes: &[u8], kinds: &[DamageKind], at_least: usize) {
    let whole: Vec<Seen> = read(&LAYOUTS[7].write()).sorted();
    let reading = read(bytes);
    assert_eq!(reading.kinds(), kinds, "{:#?}", reading.damage);
    let messages = reading.sorted();
    assert!(
        messages.len() >= at_least && messages.len() < 61,
        "{} messages are left, expected {at_least}",
        messages.len()
    );
    assert!(messages.iter().all(|message| whole.contains(message)));
}

#[test]
fn a_chunk_whose_crc_differs_is_dropped_alone() {
    for layout in [LAYOUTS[0], LAYOUTS[1], LAYOUTS[2], LAYOUTS[4]] {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x06, 1);
        bytes[at + 9 + 24] ^= 1;
        check_damage(&bytes, &[DamageKind::ChunkCrcMismatch], 40);
    }
}

#[test]
fn a_crc_of_zero_is_not_available_and_not_wrong() {
    let mut bytes = LAYOUTS[0].write();
    let (at, _) = find(&bytes, 0x06, 1);
    bytes[at + 9 + 24..at + 9 + 28].fill(0);
    check_damage(&bytes, &[], 60);
}

#[test]
fn an_unknown_compression_costs_its_chunk() {
    for layout in [LAYOUTS[0], LAYOUTS[4]] {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x06, 1);
        bytes[at + 9 + 32..at + 9 + 36].copy_from_slice(b"brtl");
        check_damage(&bytes, &[DamageKind::UnsupportedCompression], 40);
    }
}

#[test]
fn a_petabyte_record_length_is_corrected_by_the_index_or_by_the_chunk() {
    for (layout, nth) in [(LAYOUTS[0], 1), (LAYOUTS[4], 1), (LAYOUTS[6], 2), (LAYOUTS[2], 0)] {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x06, nth);
        set_u64(&mut bytes, at + 1, 1 << 60);
        check_damage(&bytes, &[DamageKind::RecordLengthImplausible], 60);
    }
}

#[test]
fn a_destroyed_chunk_header_costs_its_chunk_with_and_without_summary() {
    for layout in [LAYOUTS[0], LAYOUTS[4]] {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x06, 1);
        bytes[at..at + 60].fill(0xee);
        let kinds: &[DamageKind] = if layout.has_summary {
            &[DamageKind::IndexMismatch, DamageKind::UnreadableBytes]
        } else {
            &[DamageKind::UnreadableBytes]
        };
        check_damage(&bytes, kinds, 40);
    }
}

#[test]
fn a_loose_message_with_a_damaged_length_costs_itself_alone() {
    for (layout, length) in
        [(LAYOUTS[7], 1 << 50), (LAYOUTS[7], 400), (LAYOUTS[3], 777), (LAYOUTS[3], u64::MAX)]
    {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x05, 20);
        set_u64(&mut bytes, at + 1, length);
        check_damage(&bytes, &[DamageKind::UnreadableBytes], 59);
    }
}

#[test]
fn a_record_that_overruns_its_chunk_costs_what_follows_in_it() {
    let mut bytes = LAYOUTS[2].write();
    let (at, length) = find(&bytes, 0x06, 1);
    let data = at + 9 + 40;
    let inner: Vec<_> =
        crate::log::wire::Records::new(&bytes[data..at + 9 + length]).map(|inner| inner.at).collect();
    set_u64(&mut bytes, data + inner[3] + 1, 1 << 55);
    bytes[at + 9 + 24..at + 9 + 28].fill(0);
    check_damage(&bytes, &[DamageKind::RecordOverrun], 45);
}

#[test]
fn a_bomb_is_refused_before_it_is_allocated() {
    let mut bytes = LAYOUTS[0].write();
    let (at, _) = find(&bytes, 0x06, 1);
    set_u64(&mut bytes, at + 9 + 16, 1 << 50);
    let reading = read(&bytes);
    assert!(reading.kinds().contains(&DamageKind::SizeLimit), "{:?}", reading.damage);
    set_u64(&mut bytes, at + 9 + 16, 900 << 20);
    let reading = read(&bytes);
    assert!(reading.kinds().contains(&DamageKind::SizeLimit), "{:?}", reading.damage);
    assert!(reading.messages.len() > 40);
}

#[test]
fn a_chunk_that_holds_more_than_it_states_is_not_read_past_it() {
    for layout in [LAYOUTS[4], LAYOUTS[5]] {
        let mut bytes = layout.write();
        let (at, _) = find(&bytes, 0x06, 1);
        set_u64(&mut bytes, at + 9 + 16, 100);
        check_damage(&bytes, &[DamageKind::DecompressionFailed], 40);
    }
}

#[test]
fn a_damaged_footer_or_summary_is_replaced_by_a_scan() {
    let whole = LAYOUTS[0].write();
    let mut bytes = whole.clone();
    let n = bytes.len();
    bytes[n - 8..].fill(0);
    check_damage(&bytes, &[DamageKind::BadEndMagic], 60);
    check_damage(&whole[..n - 3], &[DamageKind::BadEndMagic], 60);
    check_damage(&[&whole, &b"more"[..]].concat(), &[DamageKind::TrailingBytes], 60);
    let mut bytes = whole.clone();
    set_u64(&mut bytes, n - 8 - 20, u64::MAX - 5);
    check_damage(&bytes, &[DamageKind::SummaryUnreadable], 60);
    let mut bytes = whole.clone();
    let (at, _) = find(&bytes, 0x0b, 0);
    bytes[at + 12] ^= 1;
    check_damage(&bytes, &[DamageKind::SummaryCrcMismatch], 60);
    let mut bytes = whole;
    bytes[3] = b'm';
    check_damage(&bytes, &[DamageKind::BadStartMagic], 60);
}

#[test]
fn a_changed_byte_in_the_data_section_is_found_by_its_crc() {
    let mut bytes = LAYOUTS[3].write();
    let (at, length) = find(&bytes, 0x05, 4);
    bytes[at + 9 + length - 1] ^= 1;
    let log = open(&bytes).unwrap();
    let damage = log.verify_data_section().unwrap().unwrap();
    assert_eq!(damage.kind, DamageKind::DataSectionCrcMismatch);
}

#[test]
fn an_attachment_whose_crc_differs_is_not_handed_out() {
    let mut bytes = LAYOUTS[0].write();
    let (at, length) = find(&bytes, 0x09, 0);
    bytes[at + 9 + length - 6] ^= 1;
    let log = open(&bytes).unwrap();
    assert!(matches!(log.read_attachment(0), Err(ReadError::AttachmentCrc { .. })));
    assert!(matches!(log.read_attachment(1), Err(ReadError::NoSuchAttachment { index: 1, count: 1 })));
}

#[test]
fn one_id_with_two_definitions_keeps_each_message_with_its_own() {
    let channel = |topic: &str| {
        let string = |text: &str| [&(text.len() as u32).to_le_bytes()[..], text.as_bytes()].concat();
        raw_record(0x04, &[&[1, 0, 0, 0][..], &string(topic), &string("cdr"), &[0; 4]].concat())
    };
    let parts = [channel("/old"), loose_message(1, 10, b"x"), channel("/new"), loose_message(1, 20, b"y")];
    let bytes = LAYOUTS[7].writer().finish();
    let end = find(&bytes, 0x0f, 0).0;
    let reading = read(&insert(&bytes, end, &parts.concat()));
    assert_eq!(reading.kinds(), [DamageKind::ChannelRedefined]);
    let topics: Vec<&str> = reading.messages.iter().map(|message| message.topic.as_str()).collect();
    assert_eq!(topics, ["/old", "/new"]);
}

#[test]
fn messages_of_an_undefined_channel_are_counted_and_dropped() {
    let bytes = LAYOUTS[7].write();
    let end = find(&bytes, 0x0f, 0).0;
    let loose = [loose_message(77, 5_000, b"x"), loose_message(77, 5_001, b"y")].concat();
    let reading = read(&insert(&bytes, end, &loose));
    assert_eq!(reading.messages.len(), 60);
    assert_eq!(reading.damage.len(), 1, "{:?}", reading.damage);
    assert_eq!(reading.damage[0].kind, DamageKind::UnknownChannel);
    assert!(reading.damage[0].detail.contains("2 messages"), "{}", reading.damage[0].detail);
}

#[test]
fn channels_are_known_without_a_summary_and_without_message_indexes() {
    let layout = Layout { has_message_indexes: false, ..LAYOUTS[4] };
    check_damage(&layout.write(), &[], 60);
    // The first chunk holds the definitions; without it they are taken from its damaged data.
    let mut bytes = LAYOUTS[6].write();
    let (at, _) = find(&bytes, 0x06, 0);
    bytes[at + 9 + 24] ^= 1;
    check_damage(&bytes, &[DamageKind::ChunkCrcMismatch, DamageKind::DefinitionFromDamagedChunk], 40);
}

#[test]
fn a_wrong_index_is_not_followed() {
    let whole = LAYOUTS[2].write();
    let (at, _) = find(&whole, 0x08, 1);
    let n = whole.len();
    for offset in [0_u64, 9, 1 << 62, n as u64 - 20] {
        let mut bytes = whole.clone();
        set_u64(&mut bytes, at + 9 + 16, offset);
        bytes[n - 12..n - 8].fill(0);
        check_damage(&bytes, &[DamageKind::IndexMismatch, DamageKind::IndexIncomplete], 60);
    }
    // The same entry twice.
    let mut bytes = whole.clone();
    let (first, length) = find(&whole, 0x08, 0);
    let (second, _) = find(&whole, 0x08, 1);
    let entry = whole[first..first + 9 + length].to_vec();
    bytes[second..second + 9 + length].copy_from_slice(&entry);
    bytes[n - 12..n - 8].fill(0);
    check_damage(&bytes, &[DamageKind::IndexMismatch, DamageKind::IndexIncomplete], 60);
}

fn check_refused(bytes: &[u8], expected: &Foreign) {
    match open(bytes) {
        Err(OpenLogError::NotMcap { found, .. }) => assert_eq!(found, *expected),
        other => panic!("expected {expected}, got {other:?}"),
    }
}

#[test]
fn other_files_are_refused_by_name() {
    assert!(matches!(open(b""), Err(OpenLogError::Empty { .. })));
    check_refused(b"\x89MCAP0\n\x01\x19", &Foreign::TextModeCopy { conversion: "CR LF was converted to LF" });
    check_refused(b"#ROSBAG V2.0\n", &Foreign::RosBag1);
    check_refused(b"SQLite format 3\0....", &Foreign::Sqlite);
    check_refused(
        &zstd::bulk::compress(&LAYOUTS[0].write(), 3).unwrap(),
        &Foreign::Compressed { name: "zstd" },
    );
    check_refused(b"\x1f\x8b\x08\0\0", &Foreign::Compressed { name: "gzip" });
    check_refused(b"version https://git-lfs.github.com/spec/v1\n", &Foreign::GitLfsPointer);
    check_refused(b"time,x\n0,1\n", &Foreign::Text { start: "time,x".into() });
    check_refused(&[0; 4096], &Foreign::Zeros);
    check_refused(&[0x89, 0x4d, 0x43, 1, 2], &Foreign::Unknown { start: vec![0x89, 0x4d, 0x43, 1, 2] });
    let error = open(b"#ROSBAG V2.0\n").unwrap_err();
    assert_eq!(error.hint().unwrap(), "convert it first: mcap convert test.mcap test.mcap");
}

#[test]
fn a_log_without_messages_is_a_log() {
    for layout in LAYOUTS {
        let reading = read(&layout.writer().finish());
        assert_eq!((reading.messages.len(), reading.damage), (0, vec![]), "{}", layout.name);
        assert!(reading.log.blocks().iter().all(|block| block.kind == BlockKind::Chunk));
    }
}

#[test]
fn a_log_behind_a_log_is_not_passed_over_in_silence() {
    for layout in LAYOUTS {
        let reading = read(&[layout.write(), layout.write()].concat());
        assert!(reading.kinds().contains(&DamageKind::TrailingBytes), "{layout:?}: {:?}", reading.damage);
        assert_eq!(reading.messages.len(), 60, "{layout:?}");
    }
}
