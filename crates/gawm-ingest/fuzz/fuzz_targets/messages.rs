//! Any bytes as a schema and a message of each encoding: compiled, decoded field by field and as a whole.
#![no_main]

use std::sync::OnceLock;

use gawm_ingest::decode::{
    CameraInfo, ChannelSchema, DecodePlan, FieldPath, ImagePlan, RowSink, SchemaLibrary, channel_fields,
    decode_to_json_limited, sample_fields,
};
use libfuzzer_sys::fuzz_target;

const ENCODINGS: [(&str, &str, &str); 8] = [
    ("cdr", "ros2msg", "p/T"),
    ("cdr", "", "sensor_msgs/msg/JointState"),
    ("ros1", "ros1msg", "p/T"),
    ("protobuf", "protobuf", "T"),
    ("json", "jsonschema", "T"),
    ("cbor", "jsonschema", "T"),
    ("cdr", "ros2idl", "p/T"),
    ("flatbuffer", "flatbuffer", "T"),
];

/// Made once: parsing the built-in types takes longer than most inputs.
static LIBRARY: OnceLock<SchemaLibrary> = OnceLock::new();

fuzz_target!(|data: &[u8]| {
    let [which, split, rest @ ..] = data else { return };
    let (schema_data, payload) = rest.split_at(rest.len() * usize::from(*split) / 256);
    let (message_encoding, schema_encoding, schema_name) = ENCODINGS[usize::from(*which) % ENCODINGS.len()];
    let schema_data = if schema_encoding.is_empty() { &[][..] } else { schema_data };
    let channel =
        ChannelSchema { topic: "/fuzz", message_encoding, schema_name, schema_encoding, schema_data };
    let library = LIBRARY.get_or_init(SchemaLibrary::builtin);
    let mut sink = RowSink::new();
    if let Ok(fields) = channel_fields(&channel, library) {
        let paths: Vec<FieldPath> =
            fields.iter().take(64).filter_map(|f| f.path.replace("[]", "[0]").parse().ok()).collect();
        if let Ok(plan) = DecodePlan::compile(&channel, &paths, library) {
            std::hint::black_box(plan.decode(payload, &mut sink).is_ok());
            std::hint::black_box(plan.decode_values(payload, &mut sink).is_ok());
        }
    }
    if let Ok(plan) = ImagePlan::compile(&channel, library) {
        std::hint::black_box(plan.extract(payload, &mut sink).is_ok());
    }
    std::hint::black_box(decode_to_json_limited(&channel, payload, library, 16).is_ok());
    std::hint::black_box(sample_fields(&channel, payload, library).is_ok());
    std::hint::black_box(CameraInfo::decode(&channel, payload, library).is_ok());
});
