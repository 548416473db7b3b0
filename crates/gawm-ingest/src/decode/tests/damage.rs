//! Hostile bytes: damaged messages, paths and schemas end in errors, never in a panic or a huge allocation.

use super::super::*;
use super::messages::{
    JOINT_STATE, PROTO, PROTO_TEXT, descriptor_set, joint_state, proto_channel, proto_message,
};

/// Splitmix64: damage that is the same on every run.
fn next(state: &mut u64) -> usize {
    *state = state.wrapping_add(0x9e37_79b9_7f4a_7c15);
    let z = (*state ^ (*state >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    usize::try_from((z ^ (z >> 31)) >> 33).unwrap()
}

fn damage(bytes: &[u8], state: &mut u64) -> Vec<u8> {
    let mut out = bytes.to_vec();
    for _ in 0..1 + next(state) % 4 {
        let at = next(state) % out.len().max(1);
        match next(state) % 4 {
            0 if !out.is_empty() => out[at] = 0xff,
            1 if !out.is_empty() => out[at] ^= 1 << (next(state) % 8),
            2 => out.truncate(at),
            _ => out.insert(at.min(out.len()), next(state) as u8),
        }
    }
    out
}

/// Decodes damaged messages by every way there is.
fn check_messages(channel: &ChannelSchema<'_>, fields: &[&str], message: &[u8], seed: u64) {
    let library = SchemaLibrary::builtin();
    let fields: Vec<FieldPath> = fields.iter().map(|f| f.parse().unwrap()).collect();
    let plan = DecodePlan::compile(channel, &fields, &library).unwrap();
    let mut sink = RowSink::new();
    plan.decode(message, &mut sink).unwrap();
    let mut state = seed;
    for _ in 0..4000 {
        let bytes = damage(message, &mut state);
        let before = sink.values().len();
        match plan.decode(&bytes, &mut sink) {
            Ok(Decoded::Row { .. }) => assert_eq!(sink.values().len(), before + plan.width()),
            Ok(Decoded::NotInMessage { .. }) | Err(_) => assert_eq!(sink.values().len(), before),
        }
        plan.decode_values(&bytes, &mut sink).ok();
        decode_to_json_limited(channel, &bytes, &library, 8).ok();
        sample_fields(channel, &bytes, &library).ok();
        CameraInfo::decode(channel, &bytes, &library).ok();
    }
    // What damage left behind does not reach the next message.
    sink.clear();
    plan.decode(message, &mut sink).unwrap();
    let mut fresh = RowSink::new();
    plan.decode(message, &mut fresh).unwrap();
    assert_eq!(sink.values(), fresh.values());
}

#[test]
fn damaged_cdr() {
    let message = joint_state(&["wrist", "elbow", "hip"], &[1.0, 2.0, 3.0]);
    check_messages(
        &JOINT_STATE,
        &["position[name=\"hip\"]", "position[0:2]", "header.stamp.sec"],
        &message,
        1,
    );
}

#[test]
fn damaged_protobuf() {
    let set = descriptor_set(PROTO);
    let message = proto_message(&set, PROTO_TEXT);
    let fields =
        ["value[name=\"b\"]", "count[0]", "joints[name=\"elbow\"].at", "inner.value[-1]", "point", "big"];
    check_messages(&proto_channel(&set), &fields, &message, 2);
}

#[test]
fn damaged_json() {
    let channel = ChannelSchema { topic: "/json", message_encoding: "json", ..ChannelSchema::default() };
    let message = br#"{"header": {"stamp": {"sec": 1, "nanosec": 2}}, "name": ["a", "b\u00e9"], "position": [1.5, -2e3],
        "list": [{"id": "x", "v": [1, 2, 3]}, {"id": "y", "v": []}], "ok": false}"#;
    check_messages(
        &channel,
        &["position[name=\"a\"]", "list[id=\"x\"].v[2]", "ok", "position[-1]"],
        message,
        3,
    );
}

#[test]
fn damaged_schemas() {
    let library = SchemaLibrary::builtin();
    let set = descriptor_set(PROTO);
    let ros = b"std_msgs/Header header\nfloat64[3] a\nstring<=5[<=2] b\nInner[] c\n====\nMSG: p/Inner\nint8 x\nq/Other[2] o\n====\nMSG: q/Other\ntime t\n";
    let json = br##"{"type": "object", "properties": {"a": {"type": "array", "items": {"$ref": "#/b"}}}, "b": {"type": "number"}}"##;
    let cases: [(&str, &str, &str, &[u8]); 4] = [
        ("cdr", "ros2msg", "p/T", ros),
        ("ros1", "ros1msg", "p/T", ros),
        ("protobuf", "protobuf", "test.Top", &set),
        ("json", "jsonschema", "T", json),
    ];
    let mut state = 4;
    for (message_encoding, schema_encoding, schema_name, data) in cases {
        for _ in 0..1500 {
            let bytes = damage(data, &mut state);
            let channel = ChannelSchema {
                topic: "/t",
                message_encoding,
                schema_name,
                schema_encoding,
                schema_data: &bytes,
            };
            let Ok(fields) = channel_fields(&channel, &library) else { continue };
            let paths: Vec<FieldPath> =
                fields.iter().filter_map(|f| f.path.replace("[]", "[0]").parse().ok()).collect();
            let Ok(plan) = DecodePlan::compile(&channel, &paths, &library) else { continue };
            let payload: Vec<u8> = (0..200).map(|_| (next(&mut state) % 3) as u8).collect();
            plan.decode(&payload, &mut RowSink::new()).ok();
            decode_to_json_limited(&channel, &payload, &library, 4).ok();
        }
    }
}

#[test]
fn lengths_are_checked_before_memory_is_asked_for() {
    let library = SchemaLibrary::builtin();
    // Arrays of arrays of nothing, counts that overflow, types that hold themselves or double at every level.
    let deep: String = (0..40)
        .map(|i| format!("====\nMSG: p/L{i}\np/L{0}[1000000] a\np/L{0}[1000000] b\n", i + 1))
        .chain(["====\nMSG: p/L40\nuint8 x\n".to_owned()])
        .collect();
    for text in [
        "float64[4294967295] x\n".to_owned(),
        "p/E[] x\n====\nMSG: p/E\n".to_owned(),
        format!("p/L0 x\n{deep}"),
        "string[] x\n".to_owned(),
    ] {
        for (message_encoding, schema_encoding) in [("cdr", "ros2msg"), ("ros1", "ros1msg")] {
            let channel = ChannelSchema {
                topic: "/t",
                message_encoding,
                schema_name: "p/T",
                schema_encoding,
                schema_data: text.as_bytes(),
            };
            for payload in [&[0, 1, 0, 0, 0xff, 0xff, 0xff, 0xff][..], &[0xff; 40], &[0, 1, 0, 0]] {
                decode_to_json_limited(&channel, payload, &library, 10).ok();
                if let Ok(plan) = DecodePlan::compile(&channel, &[], &library) {
                    plan.decode(payload, &mut RowSink::new()).ok();
                }
            }
        }
    }
    let json = ChannelSchema { topic: "/t", message_encoding: "json", ..ChannelSchema::default() };
    let nested = "[".repeat(100_000);
    assert!(decode_to_json(&json, nested.as_bytes(), &library).is_err());
}
