//! Logs made in memory, and checks on what is read of them.

mod corpora;
mod cuts;
mod damaged;
mod grouping;
mod order;
mod whole;

use std::collections::BTreeMap;
use std::io::Cursor;
use std::path::Path;

use bytes::Bytes;
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};

use super::{Damage, DamageKind, Log, OpenLogError, OpenOptions};

/// How a test log is written.
#[derive(Debug, Clone, Copy)]
struct Layout {
    name: &'static str,
    is_chunked: bool,
    compression: Option<Compression>,
    has_summary: bool,
    has_message_indexes: bool,
}

const fn layout(
    name: &'static str,
    is_chunked: bool,
    compression: Option<Compression>,
    has_summary: bool,
) -> Layout {
    Layout { name, is_chunked, compression, has_summary, has_message_indexes: has_summary }
}

const LAYOUTS: [Layout; 8] = [
    layout("zstd", true, Some(Compression::Zstd), true),
    layout("lz4", true, Some(Compression::Lz4), true),
    layout("uncompressed", true, None, true),
    layout("loose", false, None, true),
    layout("zstd without summary", true, Some(Compression::Zstd), false),
    layout("lz4 without summary", true, Some(Compression::Lz4), false),
    layout("uncompressed without summary", true, None, false),
    layout("loose without summary", false, None, false),
];

impl Layout {
    fn options(self) -> WriteOptions {
        WriteOptions::new()
            .compression(self.compression)
            .use_chunks(self.is_chunked)
            .chunk_size(Some(600))
            .profile("test")
            .library("gawm")
            .emit_summary_records(self.has_summary)
            .emit_summary_offsets(self.has_summary)
            .emit_message_indexes(self.has_message_indexes)
    }

    fn writer(self) -> TestWriter {
        TestWriter(self.options().create(Cursor::new(Vec::new())).unwrap())
    }

    /// Two channels with 30 messages each, an attachment and a metadata record.
    fn write(self) -> Vec<u8> {
        let mut writer = self.writer();
        let schema = writer.0.add_schema("pkg/Number", "ros2msg", b"float64 value").unwrap();
        let a = writer.channel(schema, "/a");
        let b = writer.channel(0, "/b");
        for i in 0..30 {
            writer.message(a, i, 1_000 + u64::from(i) * 100, &payload(i, 40));
            writer.message(b, i, 1_050 + u64::from(i) * 100, &payload(i + 100, 25));
            if i == 12 {
                writer.attach("calibration.yaml", b"fx: 600");
                writer.metadata("episode", "success", "true");
            }
        }
        writer.finish()
    }
}

/// Payload bytes that do not compress to nothing and hold no plausible record.
fn payload(seed: u32, n_bytes: usize) -> Vec<u8> {
    let mut state = seed.wrapping_mul(2_654_435_761).wrapping_add(12_345);
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        state.to_le_bytes()[1]
    };
    (0..n_bytes).map(|_| next()).collect()
}

struct TestWriter(Writer<Cursor<Vec<u8>>>);

impl TestWriter {
    fn channel(&mut self, schema: u16, topic: &str) -> u16 {
        self.0.add_channel(schema, topic, "cdr", &BTreeMap::new()).unwrap()
    }

    fn message(&mut self, channel_id: u16, sequence: u32, log_time: u64, data: &[u8]) {
        let header =
            MessageHeader { channel_id, sequence, log_time, publish_time: log_time.saturating_sub(10) };
        self.0.write_to_known_channel(&header, data).unwrap();
    }

    fn attach(&mut self, name: &str, data: &[u8]) {
        let (media_type, data) = ("text/yaml".into(), data.into());
        self.0
            .attach(&mcap::Attachment { log_time: 5, create_time: 4, name: name.into(), media_type, data })
            .unwrap();
    }

    fn metadata(&mut self, name: &str, key: &str, value: &str) {
        let metadata = [(key.to_owned(), value.to_owned())].into();
        self.0.write_metadata(&mcap::records::Metadata { name: name.into(), metadata }).unwrap();
    }

    fn finish(mut self) -> Vec<u8> {
        self.0.finish().unwrap();
        self.0.into_inner().into_inner()
    }
}

/// One message as a test compares it.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
struct Seen {
    log_time: u64,
    topic: String,
    sequence: u32,
    publish_time: u64,
    payload: Vec<u8>,
}

/// All that can be read of a log.
#[derive(Debug)]
struct Reading {
    log: Log,
    messages: Vec<Seen>,
    damage: Vec<Damage>,
}

impl Reading {
    fn kinds(&self) -> Vec<DamageKind> {
        let mut kinds: Vec<DamageKind> = self.damage.iter().map(|damage| damage.kind).collect();
        kinds.sort_unstable();
        kinds.dedup();
        kinds
    }

    fn sorted(mut self) -> Vec<Seen> {
        self.messages.sort();
        self.messages
    }
}

fn open(bytes: &[u8]) -> Result<Log, OpenLogError> {
    Log::from_bytes(Path::new("test.mcap"), Bytes::copy_from_slice(bytes), &OpenOptions::default())
}

fn read(bytes: &[u8]) -> Reading {
    read_all(open(bytes).unwrap())
}

fn read_all(log: Log) -> Reading {
    let mut messages = Vec::new();
    let mut damage = log.damage().to_vec();
    for block_ref in log.blocks() {
        let block = log.read_block(block_ref);
        messages.extend(block.messages.iter().map(|message| Seen {
            log_time: message.log_time_ns,
            topic: block.channel(message).topic.clone(),
            sequence: message.sequence,
            publish_time: message.publish_time_ns,
            payload: block.payload(message).to_vec(),
        }));
        damage.extend(block.damage);
    }
    Reading { log, messages, damage }
}

/// File offsets and opcodes of the records of a whole file.
fn records_of(bytes: &[u8]) -> Vec<(u8, usize, usize)> {
    let records = super::wire::Records::new(&bytes[8..bytes.len() - 8]);
    records.map(|record| (record.op, 8 + record.at, record.body.len())).collect()
}
