//! Messages made by hand and by other serializers, in every encoding. No files needed.

use prost_reflect::prost::Message as _;
use prost_reflect::{DescriptorPool, DynamicMessage};

use super::super::*;

fn paths(fields: &[&str]) -> Vec<FieldPath> {
    fields.iter().map(|f| f.parse().unwrap()).collect()
}

fn plan(channel: &ChannelSchema<'_>, fields: &[&str]) -> DecodePlan {
    DecodePlan::compile(channel, &paths(fields), &SchemaLibrary::builtin()).unwrap()
}

fn refused(channel: &ChannelSchema<'_>, field: &str) -> CompileError {
    DecodePlan::compile(channel, &paths(&[field]), &SchemaLibrary::builtin()).unwrap_err()
}

fn check_row(
    channel: &ChannelSchema<'_>,
    fields: &[&str],
    payload: &[u8],
    stamp_ns: Option<i64>,
    row: &[f64],
) {
    let mut sink = RowSink::new();
    let got = plan(channel, fields).decode(payload, &mut sink).unwrap();
    assert_eq!(got, Decoded::Row { stamp_ns });
    assert_eq!(sink.values(), row);
}

fn row_error(channel: &ChannelSchema<'_>, fields: &[&str], payload: &[u8]) -> DecodeError {
    let mut sink = RowSink::new();
    let error = plan(channel, fields).decode(payload, &mut sink).unwrap_err();
    assert!(sink.values().is_empty() && sink.rows() == 0);
    error
}

/// Writes little-endian CDR.
#[derive(Default)]
pub(super) struct Cdr(Vec<u8>);

impl Cdr {
    fn align(mut self, n: usize) -> Self {
        while !self.0.len().is_multiple_of(n) {
            self.0.push(0);
        }
        self
    }

    fn u32(self, v: u32) -> Self {
        let mut this = self.align(4);
        this.0.extend(v.to_le_bytes());
        this
    }

    fn text(self, text: &str) -> Self {
        let mut this = self.u32(u32::try_from(text.len() + 1).unwrap());
        this.0.extend(text.as_bytes());
        this.0.push(0);
        this
    }

    fn f64(self, v: f64) -> Self {
        let mut this = self.align(8);
        this.0.extend(v.to_le_bytes());
        this
    }

    fn texts(self, texts: &[&str]) -> Self {
        texts.iter().fold(self.u32(u32::try_from(texts.len()).unwrap()), |w, t| w.text(t))
    }

    fn f64s(self, values: &[f64]) -> Self {
        values.iter().fold(self.u32(u32::try_from(values.len()).unwrap()), |w, v| w.f64(*v))
    }

    fn done(self) -> Vec<u8> {
        [&[0, 1, 0, 0], &self.0[..]].concat()
    }
}

pub(super) const JOINT_STATE: ChannelSchema<'static> = ChannelSchema {
    topic: "/joint_states",
    message_encoding: "cdr",
    schema_name: "sensor_msgs/msg/JointState",
    schema_encoding: "",
    schema_data: b"",
};

pub(super) fn joint_state(names: &[&str], position: &[f64]) -> Vec<u8> {
    Cdr::default().u32(12).u32(5).text("base").texts(names).f64s(position).f64s(&[]).f64s(&[]).done()
}

#[test]
fn joints_are_chosen_by_name_in_any_order() {
    let fields = ["position[name=\"elbow\"]", "position[name=\"wrist\"]", "position[0]", "position[-1]"];
    let plan = plan(&JOINT_STATE, &fields);
    assert_eq!(plan.width(), 4);
    let mut sink = RowSink::new();
    for (names, position) in [
        (&["wrist", "elbow"][..], &[0.25, 1.5][..]),
        (&["wrist", "elbow"], &[0.5, 2.5]),
        (&["elbow", "gripper", "wrist"], &[3.0, 4.0, 5.0]),
        (&["wrist", "elbow"], &[0.75, 3.5]),
    ] {
        let got = plan.decode(&joint_state(names, position), &mut sink).unwrap();
        assert_eq!(got, Decoded::Row { stamp_ns: Some(12_000_000_005) });
    }
    let expected = [1.5, 0.25, 0.25, 1.5, 2.5, 0.5, 0.5, 2.5, 3.0, 5.0, 3.0, 5.0, 3.5, 0.75, 0.75, 3.5];
    assert_eq!(sink.values(), expected);
}

#[test]
fn a_message_without_the_joint_is_an_error_that_names_those_it_has() {
    let message = joint_state(&["wrist", "elbow"], &[1.0, 2.0]);
    assert_eq!(
        row_error(&JOINT_STATE, &["position[name=\"hip\"]"], &message),
        DecodeError::NameAbsent {
            path: "position[name=\"hip\"]".into(),
            name: "hip".into(),
            present: vec!["wrist".into(), "elbow".into()],
        }
    );
    let short = joint_state(&["a", "b", "c"], &[1.0, 2.0]);
    assert!(matches!(
        row_error(&JOINT_STATE, &["position[name=\"a\"]"], &short),
        DecodeError::LengthMismatch { names: 3, values: 2, .. }
    ));
    assert!(matches!(
        row_error(&JOINT_STATE, &["position[2]"], &message),
        DecodeError::IndexOutOfRange { length: 2, .. }
    ));
}

#[test]
fn cut_and_padded_messages() {
    let message = joint_state(&["wrist"], &[1.0]);
    for cut in 0..message.len() {
        let error = row_error(&JOINT_STATE, &["position[0]"], &message[..cut]);
        assert!(matches!(error, DecodeError::Truncated { .. }), "{cut}: {error}");
    }
    let fields = ["position[0]"];
    check_row(&JOINT_STATE, &fields, &[&message[..], &[1, 2, 3]].concat(), Some(12_000_000_005), &[1.0]);
    check_row(&JOINT_STATE, &fields, &[&message[..], &[0; 40]].concat(), Some(12_000_000_005), &[1.0]);
    let error = row_error(&JOINT_STATE, &fields, &[&message[..], &[7; 20]].concat());
    assert!(matches!(error, DecodeError::TrailingBytes { surplus: 20, .. }));
    for (id, name) in [(2, "PL_CDR_BE"), (3, "PL_CDR_LE"), (4, "XML")] {
        let mut other = message.clone();
        other[1] = id;
        let error = row_error(&JOINT_STATE, &fields, &other);
        assert_eq!(error, DecodeError::UnsupportedCdr { id: u16::from(id), name });
    }
}

#[test]
fn names_behind_their_values_and_wide_strings() {
    let channel = ChannelSchema {
        topic: "/t",
        message_encoding: "cdr",
        schema_name: "p/T",
        schema_encoding: "ros2msg",
        schema_data: b"float64[] value\nwstring note\nstring[] key\n",
    };
    for size in [4_usize, 2] {
        let mut cdr = Cdr::default().f64s(&[1.0, 2.0]).u32(3);
        for c in [b'a', b'b', 0xe9] {
            cdr.0.push(c);
            cdr.0.extend(vec![0; size - 1]);
        }
        let message = cdr.texts(&["x", "y"]).done();
        check_row(&channel, &["value[key=\"y\"]"], &message, None, &[2.0]);
        let mut sink = RowSink::new();
        let (_, values) = plan(&channel, &["note"]).decode_values(&message, &mut sink).unwrap();
        assert_eq!(values, [Value::Text("ab\u{e9}".into())]);
    }
}

#[test]
fn structs_by_their_own_member() {
    let channel = ChannelSchema {
        topic: "/tf",
        message_encoding: "cdr",
        schema_name: "tf2_msgs/msg/TFMessage",
        schema_encoding: "",
        schema_data: b"",
    };
    let message = |frames: &[(&str, u32, f64)]| {
        let mut cdr = Cdr::default().u32(u32::try_from(frames.len()).unwrap());
        for (name, sec, x) in frames {
            cdr = cdr.u32(*sec).u32(0).text("world").text(name);
            cdr = [*x, 2.0, 3.0, 0.0, 0.0, 0.0, 1.0].iter().fold(cdr, |w, v| w.f64(*v));
        }
        cdr.done()
    };
    let tool = "transforms[child_frame_id=\"tool0\"].transform.translation";
    let both = message(&[("base", 7, 9.0), ("tool0", 8, 1.0)]);
    check_row(&channel, &[tool], &both, Some(8_000_000_000), &[1.0, 2.0, 3.0]);
    let mut sink = RowSink::new();
    let plan = plan(&channel, &[tool]);
    let outcome = plan.decode(&message(&[("base", 7, 9.0)]), &mut sink).unwrap();
    assert_eq!(outcome, Decoded::NotInMessage { found: 0, missing: 1 });
    assert!(sink.values().is_empty());
    check_row(
        &channel,
        &["transforms[header.frame_id=\"world\"].transform.rotation.w"],
        &both,
        Some(7_000_000_000),
        &[1.0],
    );
}

#[test]
fn unknown_fields_list_what_exists() {
    let CompileError::UnknownField { present, type_name, .. } = refused(&JOINT_STATE, "positon[0]") else {
        panic!("an unknown field")
    };
    assert_eq!((present[0].as_str(), type_name.as_str()), ("position", "sensor_msgs/JointState"));
    assert!(matches!(refused(&JOINT_STATE, "position"), CompileError::WrongShape { .. }));
    assert!(matches!(refused(&JOINT_STATE, "position[nam=\"x\"]"), CompileError::WrongShape { .. }));
    assert!(matches!(refused(&JOINT_STATE, "header"), CompileError::WrongShape { .. }));
    assert!(matches!(refused(&JOINT_STATE, "position[0].x"), CompileError::WrongShape { .. }));
    let no_schema = ChannelSchema { schema_name: "my_msgs/msg/Thing", ..JOINT_STATE };
    assert!(matches!(refused(&no_schema, "x"), CompileError::NoSchema { .. }));
    let idl = ChannelSchema { schema_encoding: "ros2idl", schema_data: b"module", ..JOINT_STATE };
    assert!(matches!(refused(&idl, "x"), CompileError::BadSchema { .. }));
    let other = ChannelSchema { message_encoding: "capnproto", schema_encoding: "capnproto", ..JOINT_STATE };
    assert!(matches!(refused(&other, "x"), CompileError::UnsupportedEncoding { .. }));
}

#[test]
fn ros1_is_packed() {
    let channel = ChannelSchema {
        topic: "/odom",
        message_encoding: "ros1",
        schema_name: "p/T",
        schema_encoding: "ros1msg",
        schema_data: b"Header header\nbyte b\nchar c\nfloat64 x\nduration d\nstring[] name\nfloat32[] value\nbool[3] ok\n\
            ================================================================================\nMSG: std_msgs/Header\n\
            uint32 seq\ntime stamp\nstring frame_id\n",
    };
    let mut message = Vec::new();
    for v in [1_u32, 5, 6, 3] {
        message.extend(v.to_le_bytes());
    }
    message.extend(b"map");
    message.extend([0xff, 0xff]);
    message.extend(2.5_f64.to_le_bytes());
    message.extend((-1_i32).to_le_bytes());
    message.extend(7_i32.to_le_bytes());
    message.extend([2, 0, 0, 0, 1, 0, 0, 0, b'a', 1, 0, 0, 0, b'b']);
    message.extend([2, 0, 0, 0]);
    message.extend([1.0_f32.to_le_bytes(), 2.0_f32.to_le_bytes()].concat());
    message.extend([1, 0, 1]);
    let fields = ["b", "c", "x", "d", "value[name=\"b\"]", "ok"];
    let row = [-1.0, 255.0, 2.5, -1.0, 7.0, 2.0, 1.0, 0.0, 1.0];
    check_row(&channel, &fields, &message, Some(5_000_000_006), &row);
    let whole = decode_to_json(&channel, &message, &SchemaLibrary::builtin()).unwrap();
    assert_eq!(whole["header"]["frame_id"], "map");
    assert_eq!(whole["value"], serde_json::json!([1.0, 2.0]));
}

pub(super) const PROTO: &str = r#"
syntax = "proto3";
package test;
message Stamp { int64 seconds = 1; int32 nanos = 2; }
message Point { double x = 1; float y = 2; sint32 z = 3; }
message Joint { string name = 1; optional double position = 2; Point at = 3; }
enum Mode { IDLE = 0; RUN = 5; }
message Top {
  Stamp timestamp = 1;
  repeated string name = 2;
  repeated double value = 3;
  repeated int64 count = 4 [packed = false];
  repeated Joint joints = 5;
  Point point = 6;
  Mode mode = 7;
  bool ok = 8;
  uint64 big = 9;
  string text = 10;
  map<string, double> params = 11;
  Top inner = 12;
  fixed32 fixed = 13;
}
"#;

pub(super) fn descriptor_set(source: &str) -> Vec<u8> {
    let file = protox_file(source);
    let mut compiler = protox::Compiler::with_file_resolver(file);
    compiler.include_imports(true).open_file("test.proto").unwrap();
    compiler.encode_file_descriptor_set()
}

fn protox_file(source: &str) -> Memory {
    Memory(source.to_owned())
}

struct Memory(String);

impl protox::file::FileResolver for Memory {
    fn open_file(&self, name: &str) -> Result<protox::file::File, protox::Error> {
        protox::file::File::from_source(name, &self.0)
    }
}

pub(super) fn proto_message(set: &[u8], text: &str) -> Vec<u8> {
    let pool = DescriptorPool::decode(set).unwrap();
    let message = pool.get_message_by_name("test.Top").unwrap();
    let mut json = serde_json::Deserializer::from_str(text);
    DynamicMessage::deserialize(message, &mut json).unwrap().encode_to_vec()
}

pub(super) fn proto_channel(set: &[u8]) -> ChannelSchema<'_> {
    ChannelSchema {
        topic: "/proto",
        message_encoding: "protobuf",
        schema_name: "test.Top",
        schema_encoding: "protobuf",
        schema_data: set,
    }
}

pub(super) const PROTO_TEXT: &str = r#"{
    "timestamp": {"seconds": "12", "nanos": 5}, "name": ["a", "b", "c"], "value": [1.5, 2.5, 3.5], "count": ["-1", "7"],
    "joints": [{"name": "hip", "position": 1.0}, {"name": "elbow", "position": 2.0, "at": {"x": 4.0, "z": -3}}],
    "point": {"y": 0.5}, "mode": "RUN", "ok": true, "big": "18446744073709551615", "text": "hi",
    "params": {"gain": 0.25}, "inner": {"value": [9.0]}, "fixed": 77}"#;

#[test]
fn protobuf_fields_of_every_kind() {
    let set = descriptor_set(PROTO);
    let channel = proto_channel(&set);
    let message = proto_message(&set, PROTO_TEXT);
    let fields = [
        "value[name=\"b\"]",
        "value[-1]",
        "count[0]",
        "joints[name=\"elbow\"].position",
        "joints[name=\"elbow\"].at",
        "point",
        "mode",
        "ok",
        "params[key=\"gain\"].value",
        "inner.value[0]",
        "fixed",
        "joints[-1].at.x",
    ];
    let row = [2.5, 3.5, -1.0, 2.0, 4.0, 0.0, -3.0, 0.0, 0.5, 0.0, 5.0, 1.0, 0.25, 9.0, 77.0, 4.0];
    check_row(&channel, &fields, &message, Some(12_000_000_005), &row);
    let mut sink = RowSink::new();
    let exact = plan(&channel, &["big", "text", "ok", "count[1]"]);
    let (_, values) = exact.decode_values(&message, &mut sink).unwrap();
    assert_eq!(values, [Value::U64(u64::MAX), Value::Text("hi".into()), Value::Bool(true), Value::I64(7)]);
    assert!(matches!(row_error(&channel, &["text"], &message), DecodeError::NotNumeric { .. }));
}

#[test]
fn protobuf_absence() {
    let set = descriptor_set(PROTO);
    let channel = proto_channel(&set);
    let empty = proto_message(&set, "{}");
    // Proto3 leaves out scalars of value 0; a message that is not there has no values.
    check_row(&channel, &["ok", "mode", "big"], &empty, None, &[0.0; 3]);
    assert!(matches!(row_error(&channel, &["point.x"], &empty), DecodeError::FieldAbsent { .. }));
    assert!(matches!(
        row_error(&channel, &["value[0]"], &empty),
        DecodeError::IndexOutOfRange { length: 0, .. }
    ));
    let message = proto_message(&set, PROTO_TEXT);
    assert!(matches!(
        row_error(&channel, &["value[7]"], &message),
        DecodeError::IndexOutOfRange { length: 3, .. }
    ));
    assert!(matches!(
        row_error(&channel, &["value[name=\"z\"]"], &message),
        DecodeError::NameAbsent { present, .. } if present == ["a", "b", "c"]
    ));
    assert!(matches!(
        row_error(&channel, &["count[name=\"a\"]"], &message),
        DecodeError::LengthMismatch { names: 3, values: 2, .. }
    ));
    let unset = proto_message(&set, r#"{"joints": [{"name": "hip"}]}"#);
    let position = ["joints[name=\"hip\"].position"];
    assert!(matches!(row_error(&channel, &position, &unset), DecodeError::FieldAbsent { .. }));
    let mut sink = RowSink::new();
    let outcome = plan(&channel, &position).decode(&empty, &mut sink).unwrap();
    assert_eq!(outcome, Decoded::NotInMessage { found: 0, missing: 1 });
}

#[test]
fn protobuf_parts_and_unknown_fields() {
    let set = descriptor_set(PROTO);
    let channel = proto_channel(&set);
    // The last scalar wins, packed arrays may come in pieces, and unknown fields and groups are stepped over.
    let piece = |v: f64| [&[0x1a, 8][..], &v.to_le_bytes()].concat();
    let message = [
        &[0x40, 1, 0x40, 0][..],
        &piece(1.0),
        &[0xf3, 0x06, 0x08, 1, 0xf4, 0x06],
        &[0x19],
        &2.0_f64.to_le_bytes(),
        &[0x12, 1, b'a', 0x12, 1, b'b'],
    ]
    .concat();
    check_row(&channel, &["ok", "value[0]", "value[name=\"b\"]"], &message, None, &[0.0, 1.0, 2.0]);
    for bad in [
        &[0x40][..],
        &[0x1a, 9, 0, 0, 0, 0, 0, 0, 0, 0, 0],
        &[0x1a, 0xff, 0xff, 0xff, 0xff, 0x0f],
        &[0x00, 1],
        &[0x45, 0, 0, 0, 0],
    ] {
        row_error(&channel, &["ok", "value[0]"], bad);
    }
}

const JSON: ChannelSchema<'static> = ChannelSchema {
    topic: "/json",
    message_encoding: "json",
    schema_name: "",
    schema_encoding: "",
    schema_data: b"",
};

#[test]
fn json_values_wherever_they_stand() {
    let message = br#"{"position": [1.5, 2.5], "list": [{"id": 3, "v": {"x": 7}}, {"id": 4, "v": {"x": 8}}], "ok": true,
        "name": ["a", "b"], "deep": {"odd key": [[1, 2], [3, 4]]}, "n": NaN, "timestamp": "2025-06-15T15:06:40.5Z"}"#;
    let fields = ["position[name=\"b\"]", "list[id=4].v.x", "ok", "deep.\"odd key\"[1][-2]", "position[0:2]"];
    let row = [2.5, 8.0, 1.0, 3.0, 1.5, 2.5];
    check_row(&JSON, &fields, message, Some(1_750_000_000_500_000_000), &row);
    let mut sink = RowSink::new();
    plan(&JSON, &["n"]).decode(message, &mut sink).unwrap();
    assert!(sink.values()[0].is_nan());
}

#[test]
fn json_faults_say_what_is_there() {
    let message = br#"{"opening_m": "0.02", "force_n": null, "name": ["a"], "position": [1, 2], "list": []}"#;
    assert!(matches!(row_error(&JSON, &["opening_m"], message), DecodeError::NotNumeric { .. }));
    assert!(matches!(row_error(&JSON, &["force_n"], message), DecodeError::FieldAbsent { .. }));
    assert!(matches!(
        row_error(&JSON, &["opening"], message),
        DecodeError::FieldAbsent { present, .. } if present[0] == "opening_m"
    ));
    assert!(matches!(row_error(&JSON, &["name"], message), DecodeError::WrongType { .. }));
    assert!(matches!(
        row_error(&JSON, &["position[name=\"a\"]"], message),
        DecodeError::LengthMismatch { .. }
    ));
    assert!(matches!(
        row_error(&JSON, &["position[9]"], message),
        DecodeError::IndexOutOfRange { length: 2, .. }
    ));
    assert!(matches!(row_error(&JSON, &["lists[id=1].x"], message), DecodeError::FieldAbsent { .. }));
    assert!(matches!(row_error(&JSON, &["x"], b"{\"x\": 1"), DecodeError::Malformed { .. }));
    assert!(matches!(row_error(&JSON, &["x"], b"[]"), DecodeError::FieldAbsent { .. }));
    let mut sink = RowSink::new();
    let outcome = plan(&JSON, &["list[id=1].x"]).decode(message, &mut sink).unwrap();
    assert_eq!(outcome, Decoded::NotInMessage { found: 0, missing: 1 });
}

#[test]
fn stamps_in_their_places() {
    let read = |message: &str, stamp: &StampSource| {
        let plan = DecodePlan::compile_with(&JSON, &paths(&["v"]), stamp, &SchemaLibrary::builtin()).unwrap();
        match plan.decode(message.as_bytes(), &mut RowSink::new()).unwrap() {
            Decoded::Row { stamp_ns } => stamp_ns,
            other => panic!("{other:?}"),
        }
    };
    let auto = StampSource::Auto;
    assert_eq!(read(r#"{"v": 1, "header": {"stamp": {"sec": 1, "nsec": 2}}}"#, &auto), Some(1_000_000_002));
    assert_eq!(read(r#"{"v": 1, "header": {"stamp": {"secs": 1, "nsecs": 2}}}"#, &auto), Some(1_000_000_002));
    assert_eq!(read(r#"{"v": 1, "timestamp": 1750000000.25}"#, &auto), Some(1_750_000_000_250_000_000));
    assert_eq!(read(r#"{"v": 1, "timestamp": 3.5}"#, &auto), None);
    assert_eq!(read(r#"{"v": 1, "stamp": {"sec": 0, "nanosec": 0}}"#, &auto), None);
    let path = |text: &str, unit| StampSource::Path { path: text.parse().unwrap(), unit };
    assert_eq!(read(r#"{"v": 1, "t": 3.5}"#, &path("t", StampUnit::Seconds)), Some(3_500_000_000));
    assert_eq!(read(r#"{"v": 1, "t": 12}"#, &path("t", StampUnit::Milliseconds)), Some(12_000_000));
    assert_eq!(
        read(r#"{"v": 1, "t": {"sec": 3, "nsec": 1}}"#, &path("t", StampUnit::Auto)),
        Some(3_000_000_001)
    );
    assert_eq!(read(r#"{"v": 1, "stamp": {"sec": 5, "nanosec": 0}}"#, &StampSource::None), None);
}

/// Messages without a schema, whatever the type is called, tell by their members what they hold.
fn check_open_images(library: &SchemaLibrary) {
    let read = |schema_name: &str, message: &str| {
        let plan = ImagePlan::compile(&ChannelSchema { schema_name, ..JSON }, library).unwrap();
        let got = plan.extract(message.as_bytes(), &mut RowSink::new()).unwrap();
        (got.kind, got.format.into_owned(), got.width, got.step, got.is_big_endian, got.data.into_owned())
    };
    let raw = r#"{"header": {}, "height": 1, "width": 2, "encoding": "16UC1", "is_bigendian": 1, "step": 4, "data": "AQIDBA=="}"#;
    for name in ["", "sensor_msgs/msg/Image", "foxglove.CompressedImage"] {
        let expected = (ImageKind::Raw, "16UC1".to_owned(), 2, 4, true, vec![1, 2, 3, 4]);
        assert_eq!(read(name, raw), expected, "{name}");
    }
    let file = (ImageKind::Compressed, "jpeg".to_owned(), 0, 0, false, vec![1, 2, 3]);
    assert_eq!(read("", r#"{"format": "jpeg", "data": "AQID"}"#), file);
    assert_eq!(read("sensor_msgs/msg/Image", r#"{"data": [1, 2, 3], "encoding": "jpeg"}"#), file);
    let plan = ImagePlan::compile(&JSON, library).unwrap();
    let lacking = plan.extract(br#"{"format": "jpeg"}"#, &mut RowSink::new());
    assert!(matches!(lacking, Err(DecodeError::FieldAbsent { path, .. }) if path == "data"));
}

#[test]
fn images_of_all_four_types_in_every_encoding() {
    let library = SchemaLibrary::builtin();
    let mut sink = RowSink::new();
    let pixels = [1, 2, 3, 4, 5, 6];
    let raw = ChannelSchema { schema_name: "sensor_msgs/msg/Image", ..JOINT_STATE };
    let mut cdr = Cdr::default().u32(12).u32(5).text("cam").u32(1).u32(2).text("rgb8");
    cdr.0.push(0);
    cdr = cdr.u32(6).u32(6);
    cdr.0.extend(pixels);
    let message = cdr.done();
    let image = ImagePlan::compile(&raw, &library).unwrap();
    assert_eq!(image.kind(), Some(ImageKind::Raw));
    let got = image.extract(&message, &mut sink).unwrap();
    assert_eq!((got.width, got.height, got.step, &*got.format, &*got.frame_id), (2, 1, 6, "rgb8", "cam"));
    assert!(matches!(got.data, std::borrow::Cow::Borrowed(data) if data == pixels));
    assert_eq!(got.stamp_ns, Some(12_000_000_005));

    let json = ChannelSchema { schema_name: "foxglove.CompressedImage", ..JSON };
    let message =
        br#"{"timestamp": {"sec": 3, "nsec": 4}, "frame_id": "cam", "format": "png", "data": "AQID"}"#;
    let image = ImagePlan::compile(&json, &library).unwrap();
    let got = image.extract(message, &mut sink).unwrap();
    assert_eq!((&got.data[..], &*got.format, got.stamp_ns), (&[1, 2, 3][..], "png", Some(3_000_000_004)));
    let raw_json = ChannelSchema { schema_name: "foxglove.RawImage", ..JSON };
    let message = br#"{"width": 1, "height": 1, "encoding": "rgb8", "step": 3, "data": [1, 2, 3]}"#;
    let got = ImagePlan::compile(&raw_json, &library).unwrap().extract(message, &mut sink).unwrap();
    assert_eq!((got.width, got.step, &got.data[..]), (1, 3, &[1, 2, 3][..]));

    check_open_images(&library);

    let set = descriptor_set(
        r#"syntax = "proto3"; package test; message T { int64 seconds = 1; int32 nanos = 2; }
        message Top { T timestamp = 1; string frame_id = 2; fixed32 width = 3; fixed32 height = 4; string encoding = 5;
        fixed32 step = 6; bytes data = 7; }"#,
    );
    let message = proto_message(
        &set,
        r#"{"timestamp": {"seconds": "3"}, "width": 2, "height": 1, "encoding": "mono8", "step": 2, "data": "AQI="}"#,
    );
    let got =
        ImagePlan::compile(&proto_channel(&set), &library).unwrap().extract(&message, &mut sink).unwrap();
    assert_eq!(
        (got.width, &*got.format, &got.data[..], got.stamp_ns),
        (2, "mono8", &[1, 2][..], Some(3_000_000_000))
    );
    assert!(matches!(ImagePlan::compile(&JOINT_STATE, &library), Err(CompileError::NotAnImage { .. })));
    let video = ChannelSchema { schema_name: "foxglove.CompressedVideo", ..JSON };
    let compiled = ImagePlan::compile(&video, &library);
    match cfg!(feature = "video") {
        true => assert_eq!(compiled.unwrap().kind(), Some(ImageKind::Video)),
        false => assert!(matches!(compiled, Err(CompileError::NotAnImage { .. }))),
    }
}

#[test]
fn compressed_bodies_are_unpacked_up_to_a_cap() {
    let body = vec![7_u8; 100_000];
    let packed = zstd::encode_all(&body[..], 3).unwrap();
    assert!(is_compressed_message(&packed) && !is_compressed_message(&body));
    assert_eq!(decompress_message(&packed, 100_000).unwrap(), body);
    assert!(matches!(decompress_message(&packed, 99_999), Err(DecompressError::TooLarge { limit: 99_999 })));
    assert!(matches!(decompress_message(&packed[..10], 1000), Err(DecompressError::Damaged { .. })));
}

#[test]
fn schema_folders_teach_types() {
    let folder = tempfile::tempdir().unwrap();
    let package = folder.path().join("my_msgs/msg");
    std::fs::create_dir_all(&package).unwrap();
    std::fs::write(package.join("Thing.msg"), "Inner inner\nfloat64 y # note\n").unwrap();
    std::fs::write(package.join("Inner.msg"), "float64 x\n").unwrap();
    let mut library = SchemaLibrary::builtin();
    library.add_folder(folder.path()).unwrap();
    let channel = ChannelSchema { schema_name: "my_msgs/msg/Thing", ..JOINT_STATE };
    let fields: Vec<String> =
        channel_fields(&channel, &library).unwrap().into_iter().map(|f| f.path).collect();
    assert_eq!(fields, ["inner.x", "y"]);
    std::fs::write(package.join("Bad.msg"), "float64[x] y\n").unwrap();
    assert!(matches!(
        SchemaLibrary::builtin().add_folder(folder.path()),
        Err(SchemaFolderError::BadDefinition { .. })
    ));
    assert!(SchemaLibrary::builtin().add_folder(&folder.path().join("absent")).is_err());
}

#[test]
fn fields_of_channels() {
    let library = SchemaLibrary::builtin();
    let fields = channel_fields(&JOINT_STATE, &library).unwrap();
    let list: Vec<(&str, &str)> = fields.iter().map(|f| (f.path.as_str(), f.type_name)).collect();
    assert_eq!(
        list,
        [
            ("header.stamp.sec", "int32"),
            ("header.stamp.nanosec", "uint32"),
            ("header.frame_id", "string"),
            ("name[]", "string"),
            ("position[]", "float64"),
            ("velocity[]", "float64"),
            ("effort[]", "float64"),
        ]
    );
    // A type that holds itself is listed to a depth.
    let set = descriptor_set(PROTO);
    let fields = channel_fields(&proto_channel(&set), &library).unwrap();
    assert!(fields.iter().any(|f| f.path == "inner.inner.point.x") && fields.len() < 5000);
    let sampled = sample_fields(&JSON, br#"{"a": {"b": [1, 2]}, "t": "x"}"#, &library).unwrap();
    let list: Vec<&str> = sampled.iter().map(|f| f.path.as_str()).collect();
    assert_eq!(list, ["a.b[]", "t"]);
}
