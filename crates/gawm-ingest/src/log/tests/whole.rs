//! Undamaged logs of every layout.

use bytes::Bytes;

use super::*;
use crate::log::{Schema, decompress_message, looks_like_zstd};

fn check_whole(layout: Layout) {
    let bytes = layout.write();
    let reading = read(&bytes);
    let name = layout.name;
    assert_eq!(reading.damage, [], "{name}");
    assert_eq!((reading.log.profile(), reading.log.library()), ("test", "gawm"), "{name}");
    let topics: Vec<&str> = reading.log.channels().values().map(|channel| channel.topic.as_str()).collect();
    assert_eq!(topics, ["/a", "/b"], "{name}");
    let channels: Vec<_> = reading.log.channels().values().cloned().collect();
    let schema = Schema {
        id: 1,
        name: "pkg/Number".into(),
        encoding: "ros2msg".into(),
        data: Bytes::from_static(b"float64 value"),
    };
    assert_eq!(channels[0].schema.as_deref(), Some(&schema), "{name}");
    assert_eq!((channels[1].schema_id, &channels[1].schema), (0, &None), "{name}");
    assert_eq!(reading.log.attachments().len(), 1, "{name}");
    assert_eq!(reading.log.read_attachment(0).unwrap(), b"fx: 600", "{name}");
    assert_eq!(reading.log.metadata()[0].values["success"], "true", "{name}");
    assert_eq!(reading.log.has_summary(), layout.has_summary, "{name}");
    assert!(reading.log.verify_data_section().unwrap().is_none(), "{name}");
    assert_eq!(reading.log.content_hash().unwrap(), *blake3::hash(&bytes).as_bytes(), "{name}");
    let messages = reading.sorted();
    assert_eq!(messages.len(), 60, "{name}");
    assert_eq!(
        (messages[2].topic.as_str(), messages[2].log_time, messages[2].publish_time),
        ("/a", 1100, 1090),
        "{name}"
    );
    assert_eq!(messages[2].payload, payload(1, 40), "{name}");
    assert_eq!(messages[59].payload, payload(129, 25), "{name}");
}

#[test]
fn every_layout_gives_the_same_messages() {
    LAYOUTS.into_iter().for_each(check_whole);
}

#[test]
fn a_file_on_disk_reads_like_bytes_in_memory() {
    let bytes = LAYOUTS[0].write();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("log.mcap");
    std::fs::write(&path, &bytes).unwrap();
    let on_disk = read_all(Log::open(&path, &OpenOptions::default()).unwrap());
    assert_eq!(on_disk.log.path(), path);
    assert_eq!(on_disk.log.content_hash().unwrap(), *blake3::hash(&bytes).as_bytes());
    assert_eq!(on_disk.messages, read(&bytes).messages);
}

#[test]
fn messages_outside_chunks_are_read_beside_chunks() {
    // A chunked log with an index, and loose messages put in front of the end of its data section.
    let bytes = LAYOUTS[0].write();
    let loose: Vec<u8> = [(7_000_u64, 1_u16), (7_100, 2)]
        .iter()
        .flat_map(|&(time, channel)| loose_message(channel, time, b"loose"))
        .collect();
    let end = records_of(&bytes).iter().find(|record| record.0 == 0x0f).unwrap().1;
    let mixed = insert(&bytes, end, &loose);
    let reading = read(&mixed);
    assert!(reading.kinds().contains(&DamageKind::IndexIncomplete), "{:?}", reading.damage);
    let messages = reading.sorted();
    assert_eq!(messages.len(), 62);
    assert_eq!((messages[61].topic.as_str(), messages[61].payload.as_slice()), ("/b", &b"loose"[..]));
}

pub(super) fn loose_message(channel: u16, time: u64, data: &[u8]) -> Vec<u8> {
    let mut body = channel.to_le_bytes().to_vec();
    body.extend(9_u32.to_le_bytes());
    body.extend(time.to_le_bytes());
    body.extend(time.to_le_bytes());
    body.extend(data);
    raw_record(0x05, &body)
}

pub(super) fn raw_record(op: u8, body: &[u8]) -> Vec<u8> {
    let mut record = vec![op];
    record.extend((body.len() as u64).to_le_bytes());
    record.extend(body);
    record
}

/// Inserts bytes in front of the summary and moves the footer's offsets; the summary's CRC is taken out.
pub(super) fn insert(bytes: &[u8], at: usize, inserted: &[u8]) -> Vec<u8> {
    let mut out = [&bytes[..at], inserted, &bytes[at..]].concat();
    let footer = out.len() - 8 - 20;
    for field in [footer, footer + 8] {
        let offset = u64::from_le_bytes(out[field..field + 8].try_into().unwrap());
        if offset != 0 {
            out[field..field + 8].copy_from_slice(&(offset + inserted.len() as u64).to_le_bytes());
        }
    }
    out[footer + 16..footer + 20].fill(0);
    out
}

#[test]
fn private_records_and_padding_are_skipped() {
    let bytes = LAYOUTS[7].write();
    let end = records_of(&bytes).iter().find(|record| record.0 == 0x0f).unwrap().1;
    let reading = read(&insert(&bytes, end, &raw_record(0x9a, b"private")));
    assert_eq!(reading.kinds(), []);
    assert_eq!(reading.messages.len(), 60);
}

#[test]
fn message_bodies_are_decompressed_under_a_cap() {
    let body = zstd::bulk::compress(&[7; 10_000], 3).unwrap();
    assert!(looks_like_zstd(&body) && !looks_like_zstd(b"\0\x01\0\0"));
    assert_eq!(decompress_message(&body, 10_000).unwrap(), vec![7; 10_000]);
    assert!(decompress_message(&body, 9_999).is_err());
    assert!(decompress_message(&body[..body.len() - 2], 10_000).is_err());
    // A frame that does not state its size is capped all the same.
    let streamed = zstd::stream::encode_all(&[7_u8; 10_000][..], 3).unwrap();
    assert!(decompress_message(&streamed, 9_999).is_err());
}
