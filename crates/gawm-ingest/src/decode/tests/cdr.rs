//! CDR: vectors made by another serializer.

use serde_json::Value as Json;

use super::super::to_json::float_to_json;
use super::super::*;
use super::shared;

fn unhex(text: &str) -> Vec<u8> {
    (0..text.len() / 2).map(|i| u8::from_str_radix(&text[2 * i..2 * i + 2], 16).unwrap()).collect()
}

/// Compares decoded JSON with the vector's; numbers by value, bytes that the vector has as hex or list.
fn check_equal(got: &Json, expected: &Json, place: &str) {
    match (got, expected) {
        (Json::Object(a), Json::Object(b)) => {
            assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>(), "{place}");
            for (key, value) in b {
                check_equal(&a[key], value, &format!("{place}.{key}"));
            }
        }
        (Json::Array(a), Json::Array(b)) => {
            assert_eq!(a.len(), b.len(), "{place}");
            for (i, (x, y)) in a.iter().zip(b).enumerate() {
                check_equal(x, y, &format!("{place}[{i}]"));
            }
        }
        (Json::Number(a), Json::Number(b)) => {
            let equal = a.as_i64().is_some() && a.as_i64() == b.as_i64()
                || a.as_u64().is_some() && a.as_u64() == b.as_u64()
                || a.as_f64() == b.as_f64();
            assert!(equal, "{place}: {a} {b}");
        }
        (Json::String(a), Json::String(b)) => {
            let known = [("inf", "Infinity"), ("-inf", "-Infinity"), ("nan", "NaN")];
            assert!(a == b || known.contains(&(b.as_str(), a.as_str())), "{place}: {a} {b}");
        }
        (a, b) => assert_eq!(a, b, "{place}"),
    }
}

#[test]
fn vectors_of_another_serializer() {
    let Some(shared) = shared() else { return };
    let path = shared.join("corpora/cdr_vectors/rosbags_humble_seed1.json");
    let vectors: Vec<Json> = serde_json::from_slice(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(vectors.len(), 168);
    let library = SchemaLibrary::builtin();
    for vector in &vectors {
        let name = vector["type"].as_str().unwrap();
        let channel = ChannelSchema {
            topic: name,
            message_encoding: "cdr",
            schema_name: name,
            schema_encoding: "ros2msg",
            schema_data: vector["msgdef"].as_str().unwrap().as_bytes(),
        };
        let payload = unhex(vector["hex"].as_str().unwrap());
        let got = decode_to_json(&channel, &payload, &library).unwrap();
        check_equal(&got, &vector["value"], name);
        // The built-in definition, where there is one, reads the same.
        if library.contains(name) {
            let bare = ChannelSchema { schema_encoding: "", schema_data: b"", ..channel };
            check_equal(&decode_to_json(&bare, &payload, &library).unwrap(), &vector["value"], name);
        }
        check_leaves(&channel, &payload, &got, &library);
    }
}

/// Reads every number of a message once more through plans of one path each, and of all paths.
fn check_leaves(channel: &ChannelSchema<'_>, payload: &[u8], whole: &Json, library: &SchemaLibrary) {
    let mut expected = Vec::new();
    let mut way = Vec::new();
    leaves(whole, &mut way, &mut expected);
    let mut paths = Vec::new();
    for (path, value) in &expected {
        let plan = DecodePlan::compile(channel, std::slice::from_ref(path), library).unwrap();
        let mut sink = RowSink::new();
        let (outcome, values) = plan
            .decode_values(payload, &mut sink)
            .unwrap_or_else(|e| panic!("{} {path}: {e}", channel.topic));
        assert!(matches!(outcome, Decoded::Row { .. }), "{path}");
        check_value(&values[0], value, path);
        if !value.is_string() {
            paths.push((path.clone(), value));
        }
    }
    let all: Vec<FieldPath> = paths.iter().map(|(p, _)| p.clone()).collect();
    let plan = DecodePlan::compile(channel, &all, library).unwrap();
    let mut sink = RowSink::new();
    // Twice: the second time with the scratch of the first.
    plan.decode(payload, &mut sink).unwrap();
    plan.decode(payload, &mut sink).unwrap();
    assert_eq!(sink.rows(), 2);
    for (row, (path, value)) in sink.values().iter().zip(paths.iter().chain(&paths)) {
        check_value(&Value::F64(*row), value, path);
    }
}

fn check_value(got: &Value, expected: &Json, path: &FieldPath) {
    match (got, expected) {
        (Value::Text(a), Json::String(b)) => assert_eq!(a, b, "{path}"),
        (Value::F64(v), Json::String(b)) => assert_eq!(float_to_json(*v), Json::String(b.clone())),
        (Value::I64(a), Json::Number(b)) if b.is_i64() => assert_eq!(Some(*a), b.as_i64(), "{path}"),
        (Value::U64(a), Json::Number(b)) if b.is_u64() => assert_eq!(Some(*a), b.as_u64(), "{path}"),
        (got, expected) => {
            let expected = expected.as_bool().map(|b| f64::from(u8::from(b))).or(expected.as_f64());
            assert_eq!(got.as_f64(), expected, "{path}");
        }
    }
}

/// Lists at most the first three elements of each array.
fn leaves(value: &Json, way: &mut Vec<Segment>, out: &mut Vec<(FieldPath, Json)>) {
    match value {
        Json::Object(members) => {
            for (key, inner) in members {
                way.push(Segment::Field(key.clone()));
                leaves(inner, way, out);
                way.pop();
            }
        }
        Json::Array(items) => {
            for (i, inner) in items.iter().enumerate().take(3) {
                let i = i64::try_from(i).unwrap();
                let from_end = i - i64::try_from(items.len()).unwrap();
                way.push(Segment::Index(if i == 1 { from_end } else { i }));
                leaves(inner, way, out);
                way.pop();
            }
        }
        leaf => out.push((super::super::path::FieldPath::from_segments(way.clone()), leaf.clone())),
    }
}
