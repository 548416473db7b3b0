//! Measures messages per second of the decoders on one thread: `cargo run --release -p gawm-ingest --example decode_speed`.

use std::time::Instant;

use gawm_ingest::decode::{ChannelSchema, DecodePlan, FieldPath, RowSink, SchemaLibrary};

const NAMES: [&str; 7] = ["joint_1", "joint_2", "joint_3", "joint_4", "joint_5", "joint_6", "gripper"];

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let cdr = ChannelSchema {
        topic: "/joint_states",
        message_encoding: "cdr",
        schema_name: "sensor_msgs/msg/JointState",
        ..ChannelSchema::default()
    };
    let json = ChannelSchema { message_encoding: "json", ..cdr };
    measure("JointState, cdr", &cdr, &cdr_message())?;
    measure("JointState, json", &json, json_message().as_bytes())?;
    Ok(())
}

fn measure(
    name: &str,
    channel: &ChannelSchema<'_>,
    message: &[u8],
) -> Result<(), Box<dyn std::error::Error>> {
    let fields: Result<Vec<FieldPath>, _> =
        NAMES.iter().map(|name| format!("position[name=\"{name}\"]").parse()).collect();
    let plan = DecodePlan::compile(channel, &fields?, &SchemaLibrary::builtin())?;
    let mut sink = RowSink::new();
    let n = 2_000_000;
    let start = Instant::now();
    for i in 0..n {
        plan.decode(message, &mut sink)?;
        if i % 1000 == 0 {
            sink.clear();
        }
    }
    let seconds = start.elapsed().as_secs_f64();
    println!(
        "{name}: {} bytes, {:.2} M messages/s, {:.0} MB/s",
        message.len(),
        f64::from(n) / seconds / 1e6,
        f64::from(n) * message.len() as f64 / seconds / 1e6
    );
    Ok(())
}

fn cdr_message() -> Vec<u8> {
    let mut body = Vec::new();
    let pad = |body: &mut Vec<u8>, n: usize| body.resize(body.len().next_multiple_of(n), 0);
    let word = |body: &mut Vec<u8>, v: usize| {
        body.resize(body.len().next_multiple_of(4), 0);
        body.extend((v as u32).to_le_bytes());
    };
    let text = |body: &mut Vec<u8>, text: &str| {
        word(body, text.len() + 1);
        body.extend(text.as_bytes());
        body.push(0);
    };
    word(&mut body, 1_750_000_000);
    word(&mut body, 5);
    text(&mut body, "base_link");
    word(&mut body, NAMES.len());
    for name in NAMES {
        text(&mut body, name);
    }
    for _ in 0..3 {
        word(&mut body, NAMES.len());
        pad(&mut body, 8);
        for i in 0..NAMES.len() {
            body.extend((i as f64 * 0.1).to_le_bytes());
        }
    }
    [&[0, 1, 0, 0], &body[..]].concat()
}

fn json_message() -> String {
    let numbers =
        |scale: f64| (0..7).map(|i| format!("{}", f64::from(i) * scale)).collect::<Vec<_>>().join(", ");
    format!(
        r#"{{"header": {{"stamp": {{"sec": 1750000000, "nanosec": 5}}, "frame_id": "base_link"}}, "name": [{}], "position": [{}], "velocity": [{}], "effort": [{}]}}"#,
        NAMES.map(|n| format!("{n:?}")).join(", "),
        numbers(0.123_456_789),
        numbers(0.987_654_321),
        numbers(0.5)
    )
}
