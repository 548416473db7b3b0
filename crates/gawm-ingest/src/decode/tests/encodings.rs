//! Messages in rare encodings that other people's libraries wrote: XCDR2 and IDL, CBOR, FlatBuffers.

use base64::Engine as _;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

use crate::decode::{
    ChannelSchema, DecodePlan, FieldPath, ImagePlan, RowSink, SchemaLibrary, Value, channel_fields,
    decode_to_json, sample_fields,
};

/// A channel, one message, and values at paths.
struct Vector {
    name: String,
    message_encoding: String,
    schema_name: String,
    schema_encoding: String,
    schema: Vec<u8>,
    payload: Vec<u8>,
    expected: serde_json::Map<String, serde_json::Value>,
}

fn vectors() -> Vec<Vector> {
    let text = include_str!("../../../../../fixtures/encodings/vectors.json");
    let all: Vec<serde_json::Value> = serde_json::from_str(text).unwrap();
    let text = |of: &serde_json::Value, key: &str| of[key].as_str().unwrap().to_owned();
    let bytes = |of: &serde_json::Value, key: &str| {
        base64::engine::general_purpose::STANDARD.decode(of[key].as_str().unwrap()).unwrap()
    };
    all.iter()
        .map(|of| Vector {
            name: text(of, "name"),
            message_encoding: text(of, "message_encoding"),
            schema_name: text(of, "schema_name"),
            schema_encoding: text(of, "schema_encoding"),
            schema: bytes(of, "schema"),
            payload: bytes(of, "payload"),
            expected: of["expected"].as_object().unwrap().clone(),
        })
        .collect()
}

impl Vector {
    fn channel<'a>(&'a self, schema: &'a [u8]) -> ChannelSchema<'a> {
        ChannelSchema {
            topic: "/topic",
            message_encoding: &self.message_encoding,
            schema_name: &self.schema_name,
            schema_encoding: &self.schema_encoding,
            schema_data: schema,
        }
    }

    fn paths(&self) -> Vec<FieldPath> {
        self.expected.keys().map(|path| path.parse().unwrap()).collect()
    }
}

fn as_json(value: &Value) -> serde_json::Value {
    match value {
        Value::Text(text) => text.clone().into(),
        Value::F64(number) => (*number).into(),
        Value::I64(number) => (*number).into(),
        Value::U64(number) => (*number).into(),
        Value::Bool(flag) => (*flag).into(),
    }
}

fn is_equal(a: &serde_json::Value, b: &serde_json::Value) -> bool {
    match (a.as_f64(), b.as_f64()) {
        (Some(a), Some(b)) => a == b,
        _ => a == b,
    }
}

#[test]
fn values_are_those_that_were_written() {
    let library = SchemaLibrary::builtin();
    let vectors = vectors();
    assert!(vectors.len() >= 15, "{}", vectors.len());
    for vector in &vectors {
        let channel = vector.channel(&vector.schema);
        let plan = DecodePlan::compile(&channel, &vector.paths(), &library)
            .unwrap_or_else(|error| panic!("{}: {error}", vector.name));
        let (_, values) = plan
            .decode_values(&vector.payload, &mut RowSink::new())
            .unwrap_or_else(|error| panic!("{}: {error}", vector.name));
        for ((path, expected), got) in vector.expected.iter().zip(&values) {
            let got = as_json(got);
            assert!(is_equal(&got, expected), "{}: {path}: expected {expected}, got {got}", vector.name);
        }
        let whole = decode_to_json(&channel, &vector.payload, &library).unwrap();
        assert!(whole.as_object().is_some_and(|fields| !fields.is_empty()), "{}: {whole}", vector.name);
        if vector.message_encoding != "cbor" {
            let fields = channel_fields(&channel, &library).unwrap();
            assert!(fields.len() >= vector.expected.len().min(3), "{}: {fields:?}", vector.name);
        }
    }
}

#[test]
fn an_image_in_flatbuffers_is_an_image() {
    let library = SchemaLibrary::builtin();
    let vectors = vectors();
    let vector = vectors.iter().find(|vector| vector.schema_name == "foxglove.CompressedImage").unwrap();
    let plan = ImagePlan::compile(&vector.channel(&vector.schema), &library).unwrap();
    let image = plan.extract(&vector.payload, &mut RowSink::new()).unwrap();
    assert_eq!(image.data.as_ref(), b"\xff\xd8\xff\xe0 not really a jpeg");
    assert_eq!((image.format.as_ref(), image.stamp_ns), ("jpeg", Some(1_700_000_000_000_000_250)));
}

/// What the bytes of a vector become must be a row or an error, whatever they are.
fn check_survives(vector: &Vector, schema: &[u8], payload: &[u8], library: &SchemaLibrary) -> bool {
    let channel = vector.channel(schema);
    let fields = channel_fields(&channel, library);
    let json = decode_to_json(&channel, payload, library);
    let plan = DecodePlan::compile(&channel, &vector.paths(), library);
    let row = plan.map(|plan| plan.decode_values(payload, &mut RowSink::new()).is_ok());
    fields.is_ok() && json.is_ok() && row.unwrap_or(false)
}

#[test]
fn damaged_messages_and_schemas_are_errors() {
    let library = SchemaLibrary::builtin();
    let mut random = ChaCha8Rng::seed_from_u64(20_261_122);
    let mut damage = |bytes: &[u8]| {
        let mut bytes = bytes.to_vec();
        match random.next_u32() % 4 {
            _ if bytes.is_empty() => {}
            0 => bytes.truncate(random.next_u32() as usize % bytes.len()),
            1 => {
                let at = random.next_u32() as usize % bytes.len();
                let count = (bytes.len() - at).min(4);
                bytes[at..at + count].copy_from_slice(&random.next_u32().to_le_bytes()[..count]);
            }
            _ => {
                for _ in 0..=random.next_u32() % 4 {
                    let at = random.next_u32() as usize % bytes.len();
                    bytes[at] = random.next_u32() as u8;
                }
            }
        }
        bytes
    };
    let (mut n_whole, mut n_refused) = (0, 0);
    for vector in &vectors() {
        assert!(check_survives(vector, &vector.schema, &vector.payload, &library), "{}", vector.name);
        for _ in 0..400 {
            let payload = damage(&vector.payload);
            let is_whole = check_survives(vector, &vector.schema, &payload, &library);
            *(if is_whole { &mut n_whole } else { &mut n_refused }) += 1;
        }
        for _ in 0..if vector.schema.is_empty() { 0 } else { 200 } {
            check_survives(vector, &damage(&vector.schema), &vector.payload, &library);
        }
    }
    assert!(n_refused > 1000 && n_whole > 100, "{n_refused} refused, {n_whole} whole");
}

#[test]
fn lengths_that_claim_too_much_are_refused_before_memory_is_taken() {
    let library = SchemaLibrary::builtin();
    for vector in vectors().iter().filter(|vector| vector.name.starts_with("xcdr2")) {
        for at in 4..vector.payload.len() {
            let mut payload = vector.payload.clone();
            let count = (payload.len() - at).min(4);
            payload[at..at + count].fill(0xff);
            check_survives(vector, &vector.schema, &payload, &library);
        }
    }
    let cbor = [0x9b, 0x7f, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff, 0xff];
    let channel = ChannelSchema { topic: "/t", message_encoding: "cbor", ..ChannelSchema::default() };
    assert!(decode_to_json(&channel, &cbor, &library).is_err(), "an array of 2^63 items");
    let nested = vec![0x81; 100_000];
    assert!(decode_to_json(&channel, &nested, &library).is_err(), "100 000 arrays in each other");
}

#[test]
fn what_follows_a_message_is_padding_or_refused() {
    let library = SchemaLibrary::builtin();
    let mut n_checked = 0;
    for vector in vectors().iter().filter(|vector| vector.name.starts_with("xcdr2")) {
        let channel = vector.channel(&vector.schema);
        let plan = DecodePlan::compile(&channel, &vector.paths(), &library).unwrap();
        let whole = plan.decode_values(&vector.payload, &mut RowSink::new()).unwrap();
        let with = |rest: &[u8]| {
            let payload = [vector.payload.as_slice(), rest].concat();
            plan.decode_values(&payload, &mut RowSink::new())
        };
        // Middleware pads to four bytes, some of it with what lay in memory; recorders with zeros to any length.
        assert_eq!(with(&[7, 7, 7]).unwrap(), whole, "{}", vector.name);
        assert_eq!(with(&[0; 40]).unwrap(), whole, "{}", vector.name);
        let error = with(&[7; 12]).unwrap_err();
        assert_eq!(error.reason(), "message_longer_than_schema", "{}: {error}", vector.name);
        n_checked += 1;
    }
    assert!(n_checked >= 3, "{n_checked}");
}

#[test]
fn leaves_of_a_sample_are_listed_in_what_is_read_as_json() {
    let library = SchemaLibrary::builtin();
    let cbor = b"\xa2\x61a\xa1\x61b\x82\x01\x02\x61t\x61x";
    let channel = ChannelSchema { topic: "/t", message_encoding: "cbor", ..ChannelSchema::default() };
    let fields = sample_fields(&channel, cbor, &library).unwrap();
    let list: Vec<&str> = fields.iter().map(|field| field.path.as_str()).collect();
    assert_eq!(list, ["a.b[]", "t"]);
    let mut n_checked = 0;
    for vector in vectors().iter().filter(|vector| vector.message_encoding == "flatbuffer") {
        let fields = sample_fields(&vector.channel(&vector.schema), &vector.payload, &library);
        assert!(fields.is_ok_and(|fields| fields.len() >= vector.paths().len()), "{}", vector.name);
        n_checked += 1;
    }
    assert!(n_checked >= 1, "{n_checked}");
}

#[test]
fn typed_arrays_of_cbor_are_arrays() {
    let library = SchemaLibrary::builtin();
    let channel = ChannelSchema { topic: "/t", message_encoding: "cbor", ..ChannelSchema::default() };
    let check = |tag: u8, bytes: &[u8], expected: &str| {
        let mut cbor = vec![0xa1, 0x61, b'x', 0xd8, tag, 0x40 + bytes.len() as u8];
        cbor.extend_from_slice(bytes);
        let got = match decode_to_json(&channel, &cbor, &library) {
            Ok(value) => value.to_string(),
            Err(error) => error.to_string(),
        };
        assert!(got.contains(expected), "tag {tag}: {got}");
    };
    check(86, &[1.5f64.to_le_bytes(), (-2.0f64).to_le_bytes()].concat(), "[1.5,-2.0]");
    check(82, &0.1f64.to_be_bytes(), "[0.1]");
    check(85, &0.5f32.to_le_bytes(), "[0.5]");
    check(80, &[0x3c, 0x00, 0xc0, 0x00], "[1.0,-2.0]");
    check(72, &[0xff, 1], "[-1,1]");
    check(69, &[0xff, 0xfe], "[65279]");
    check(73, &[0xff, 0xfe], "[-2]");
    check(79, &(-3i64).to_le_bytes(), "[-3]");
    check(67, &u64::MAX.to_be_bytes(), "[18446744073709551615]");
    check(86, b"", "[]");
    // Bytes stay bytes, as images are; reserved tags and those of 16-byte floats too.
    check(64, &[1, 2, 3], "\"AQID\"");
    check(68, &[1, 2, 3], "\"AQID\"");
    check(76, &[1, 2, 3], "\"AQID\"");
    check(87, &[0; 3], "\"AAAA\"");
    check(86, &[0; 9], "expected whole numbers of 8 bytes, got 9 bytes");
    // An item that ends early is named without the words of a library.
    let error = decode_to_json(&channel, &[0xa1, 0x61, b'x', 0x43, 1], &library).unwrap_err().to_string();
    assert!(error.contains("the message ends within an item"), "{error}");
}

#[test]
fn labels_that_do_not_fit_are_named() {
    let library = SchemaLibrary::builtin();
    let check = |message_encoding, schema_encoding, schema_data: &[u8], payload: &[u8], expected: &str| {
        let channel = ChannelSchema {
            topic: "/t",
            message_encoding,
            schema_name: "pkg/msg/A",
            schema_encoding,
            schema_data,
        };
        let got = match decode_to_json(&channel, payload, &library) {
            Ok(value) => value.to_string(),
            Err(error) => error.to_string(),
        };
        assert!(got.contains(expected), "{message_encoding} {schema_encoding}: {got}");
    };
    check("cdr", "jsonschema", b"{}", b"{\"a\": 1}", "{\"a\":1}");
    check("", "ros2msg", b"int32 a", &[0, 1, 0, 0, 5, 0, 0, 0], "{\"a\":5}");
    check("cdr", "ros2msg", b"int32 a", b"{\"a\": 1}", "labelled wrongly");
    check("cdr", "ros2msg", b"int32 a", &[0x04, 0x22, 0x4d, 0x18, 0x60, 0x40], "LZ4");
    check("msgpack", "", b"", &[0x80], "not supported");
    // ROS 1 pads nothing: what follows was written with another schema, or is CDR.
    check("ros1", "ros1msg", b"int32 a", &[0, 1, 0, 0, 5, 0, 0, 0], "4 bytes follow");
    check("cdr", "ros2idl", b"module pkg { union", &[0, 1, 0, 0], "line 1");
    check(
        "cdr",
        "ros2idl",
        b"module pkg { struct A {\n double x",
        &[0, 1, 0, 0],
        "got \"the end of the text\"",
    );
    check("cdr", "ros2idl", b"module pkg { struct A { double x y", &[0, 1, 0, 0], "got \"y\"");
    check(
        "cdr",
        "ros2idl",
        b"module pkg { module msg { struct A { pkg::msg::A a; }; }; };",
        &[0, 1, 0, 0],
        "A",
    );
    check("flatbuffer", "flatbuffer", b"table A { x:int; }", &[0; 8], "bfbs");
    // The text of a service says nothing of the events that are recorded.
    check("cdr", "ros2msg", b"int64 a\n---\nint64 sum\n", &[0, 1, 0, 0], "service");
}
