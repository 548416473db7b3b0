//! A table as a log, decoded by the decoder of logs.

use std::collections::BTreeMap;

use super::super::recording::{RecordingError, TableRecording};
use super::*;
use crate::decode::{ChannelSchema, DecodePlan, FieldPath, ImagePlan, RowSink, SchemaLibrary, Value};
use crate::log::{Channel, DamageKind};
use crate::rows::{EPISODE_GAP_NS, RowRecording};

fn schema_of(channel: &Channel) -> ChannelSchema<'_> {
    let schema = channel.schema.as_deref().unwrap();
    ChannelSchema {
        topic: &channel.topic,
        message_encoding: &channel.message_encoding,
        schema_name: &schema.name,
        schema_encoding: &schema.encoding,
        schema_data: &schema.data,
    }
}

/// Decodes one field of one topic: time and values of every message.
fn decode(recording: &TableRecording, topic: &str, field: &str) -> Vec<(u64, Vec<f64>)> {
    let library = SchemaLibrary::builtin();
    let field: FieldPath = field.parse().unwrap();
    let mut all = Vec::new();
    for block in recording.blocks() {
        let read = recording.read_block(block);
        assert_eq!(read.damage, []);
        for message in &read.messages {
            let channel = read.channel(message);
            if channel.topic == topic {
                let plan =
                    DecodePlan::compile(&schema_of(channel), std::slice::from_ref(&field), &library).unwrap();
                let mut sink = RowSink::new();
                plan.decode(read.payload(message), &mut sink).unwrap();
                assert_eq!(message.log_time_ns, message.publish_time_ns);
                all.push((message.log_time_ns, sink.values().to_vec()));
            }
        }
    }
    assert!(all.is_sorted_by_key(|(time, _)| *time));
    all
}

#[test]
fn columns_are_topics_and_rows_are_messages() {
    let recording = TableRecording::try_new(open_fixture("killed.h5"), None, 10.0).unwrap();
    let start = EPISODE_GAP_NS as u64;
    let proprio = decode(&recording, "proprio", "data[1]");
    assert_eq!(proprio.len(), 21);
    assert_eq!(proprio[..2], [(start, vec![0.0]), (start + 100_000_000, vec![1.0])]);
    assert_eq!(proprio[12], (2 * start + 1_100_000_000, vec![0.0]));
    // The action that ends an episode is NaN: no message.
    let actions = decode(&recording, "action", "data[0:2]");
    assert_eq!(actions.len(), 19);
    assert_eq!(actions[11].1, [12.0, -12.0]);
    assert_eq!(decode(&recording, "step_idx", "data")[20].1, [8.0]);
    let of = |key: &str| recording.metadata().iter().map(|r| r.values[key].clone()).collect::<Vec<_>>();
    assert_eq!(
        (of("steps"), of("name")),
        (vec!["12".to_owned(), "9".to_owned()], vec!["0".to_owned(), "1".to_owned()])
    );
    assert_eq!(of("start_ns")[1], (2 * start + 1_100_000_000).to_string());
    assert_eq!(of("end_ns")[0], (start + 1_100_000_000).to_string());
    assert_eq!(recording.episodes().unfinished.len(), 1);
    assert_eq!(
        recording.damage().iter().map(|d| d.kind).collect::<Vec<_>>(),
        [DamageKind::MissingFooter, DamageKind::IndexIncomplete]
    );
}

#[test]
fn images_are_raw_images() {
    let mut recording = TableRecording::try_new(open_fixture("killed.h5"), None, 10.0).unwrap();
    recording.select(&["pixels".to_owned()]);
    let library = SchemaLibrary::builtin();
    let mut n = 0;
    let mut expected = Vec::new();
    for block in recording.blocks() {
        let read = recording.read_block(block);
        for message in &read.messages {
            let channel = read.channel(message);
            assert_eq!(channel.topic, "pixels");
            let plan = ImagePlan::compile(&schema_of(channel), &library).unwrap();
            let mut sink = RowSink::new();
            let image = plan.extract(read.payload(message), &mut sink).unwrap();
            recording.table().read_image("pixels", n, &mut expected).unwrap();
            assert_eq!((image.format.as_ref(), image.width, image.height, image.step), ("rgb8", 6, 6, 18));
            assert_eq!(image.data.as_ref(), expected);
            assert_eq!(image.stamp_ns, i64::try_from(message.log_time_ns).ok());
            n += 1;
        }
    }
    assert_eq!(n, 21);
}

#[test]
fn every_type_keeps_its_values() {
    let stated = Layout::Single { steps: Some("contiguous".to_owned()) };
    let recording = TableRecording::try_new(open_fixture("layouts_v3.h5"), Some(&stated), 50.0).unwrap();
    for column in ["contiguous", "big_endian", "half", "gzip_shuffle"] {
        let rows = decode(&recording, column, "data[0:3]");
        let values: Vec<f64> = rows.into_iter().flat_map(|(_, values)| values).collect();
        assert_eq!(values, expected(0..300), "{column}");
    }
    assert_eq!(decode(&recording, "bools", "data")[9].1, [1.0]);
    // All NaN: the fill value of a dataset that was never written.
    assert_eq!(decode(&recording, "never_written", "data[0]"), []);
    let record = &recording.metadata()[0].values;
    assert_eq!(record.get("scalar").map(String::as_str), Some("-7"));
}

#[test]
fn texts_are_strings() {
    let stated = Layout::Single { steps: Some("text".to_owned()) };
    let recording = TableRecording::try_new(open_fixture("layouts_v0.h5"), Some(&stated), 1.0).unwrap();
    let library = SchemaLibrary::builtin();
    let mut texts = BTreeMap::new();
    for block in recording.blocks() {
        let read = recording.read_block(block);
        for message in read.messages.iter().filter(|m| read.channel(m).topic == "text") {
            let schema = schema_of(read.channel(message));
            let plan = DecodePlan::compile(&schema, &["data".parse().unwrap()], &library).unwrap();
            let mut sink = RowSink::new();
            let (_, values) = plan.decode_values(read.payload(message), &mut sink).unwrap();
            texts.insert(message.sequence, values.first().and_then(Value::as_text).unwrap().to_owned());
        }
    }
    assert_eq!(texts.into_values().collect::<Vec<_>>(), ["row 0", "row 1", "row 2", "row 3", "row 4"]);
}

#[test]
fn a_rate_must_be_a_number() {
    for rate_hz in [0.0, -1.0, f64::NAN, f64::INFINITY, 1e9] {
        let refused = TableRecording::try_new(open_fixture("stored.npz"), None, rate_hz);
        assert!(matches!(refused, Err(RecordingError::Rate { .. })), "{rate_hz}");
    }
}

/// Values of a published recording through the decoder of logs equal its rows.
#[test]
fn a_recording_of_the_corpora_passes_the_decoder() {
    let Some(path) = corpus("swm_h5/tworoom.h5") else { return };
    let table = open(&path, &Limits::default()).unwrap();
    let proprio = table.read_all("proprio").unwrap().values.to_f64().unwrap();
    let mut recording = TableRecording::try_new(table, None, 10.0).unwrap();
    recording.select(&["proprio".to_owned(), "action".to_owned()]);
    let rows = decode(&recording, "proprio", "data[0:2]");
    assert_eq!(rows.into_iter().flat_map(|(_, v)| v).collect::<Vec<_>>(), proprio);
    assert_eq!(decode(&recording, "action", "data[0:2]").len(), 155 - 4);
    assert_eq!(recording.metadata().len(), 4);
}
