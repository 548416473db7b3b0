//! Writes a large synthetic robot log for benchmarks: the same bytes for the same arguments.
//!
//! ```text
//! cargo run --release -p gawm-ingest --example generate_log -- numeric 1000 numeric.mcap
//! ```
//!
//! `numeric` is a 7-joint arm (JointState and a command array at 500 Hz each, an IMU at 1 kHz), `image` two JPEG
//! cameras at 30 Hz beside the joints at 100 Hz, `mixed` all of it. The second argument is the size in MB.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;

use anyhow::{Context, Result, bail};
use gawm_image::{Image, Pixels, encode_jpeg};
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions, Writer};

const JOINTS: usize = 7;
const START_NS: u64 = 1_700_000_000_000_000_000;
const HEADER_TEXT: &str = "================================================================================\n\
    MSG: std_msgs/Header\nbuiltin_interfaces/Time stamp\nstring frame_id\n\
    ================================================================================\n\
    MSG: builtin_interfaces/Time\nint32 sec\nuint32 nanosec\n";

/// A topic: its type, schema text, period and how a payload is made.
struct Topic {
    name: &'static str,
    schema_name: &'static str,
    schema: String,
    period_ns: u64,
    payload: fn(&mut Cdr, &Frame<'_>),
}

/// What a payload is made from.
struct Frame<'a> {
    stamp_ns: u64,
    index: u64,
    is_right: bool,
    jpegs: &'a [Vec<u8>],
}

/// A little-endian XCDR1 writer.
#[derive(Default)]
struct Cdr(Vec<u8>);

impl Cdr {
    fn begin(&mut self) {
        self.0.clear();
        self.0.extend([0, 1, 0, 0]);
    }
    fn align(&mut self, to: usize) {
        while !(self.0.len() - 4).is_multiple_of(to) {
            self.0.push(0);
        }
    }
    fn u32(&mut self, value: u32) {
        self.align(4);
        self.0.extend(value.to_le_bytes());
    }
    fn text(&mut self, value: &str) {
        self.u32(value.len() as u32 + 1);
        self.0.extend(value.as_bytes());
        self.0.push(0);
    }
    fn f64s(&mut self, values: impl ExactSizeIterator<Item = f64>, counted: bool) {
        if counted {
            self.u32(values.len() as u32);
        }
        for value in values {
            self.align(8);
            self.0.extend(value.to_le_bytes());
        }
    }
    fn bytes(&mut self, value: &[u8]) {
        self.u32(value.len() as u32);
        self.0.extend(value);
    }
    fn header(&mut self, stamp_ns: u64, frame_id: &str) {
        self.u32((stamp_ns / 1_000_000_000) as u32);
        self.u32((stamp_ns % 1_000_000_000) as u32);
        self.text(frame_id);
    }
}

/// Returns a smooth motion with sensor noise in its low bits, so that chunks compress as real ones do.
fn reading(stamp_ns: u64, channel: usize) -> f64 {
    let t = (stamp_ns - START_NS) as f64 * 1e-9;
    let noise =
        (stamp_ns / 1000).wrapping_mul(0x9E37_79B9_7F4A_7C15).rotate_left(channel as u32 * 7 + 3) >> 40;
    (t * (0.3 + 0.1 * channel as f64)).sin() + noise as f64 * 1e-11
}

fn joint_state(cdr: &mut Cdr, frame: &Frame<'_>) {
    cdr.header(frame.stamp_ns, "base");
    cdr.u32(JOINTS as u32);
    for joint in 0..JOINTS {
        cdr.text(&format!("joint_{joint}"));
    }
    for block in 0..3 {
        cdr.f64s((0..JOINTS).map(|joint| reading(frame.stamp_ns, joint + 7 * block)), true);
    }
}

fn command(cdr: &mut Cdr, frame: &Frame<'_>) {
    cdr.u32(0); // layout.dim
    cdr.u32(0); // layout.data_offset
    cdr.f64s((0..JOINTS).map(|joint| reading(frame.stamp_ns + 40_000_000, joint)), true);
}

fn imu(cdr: &mut Cdr, frame: &Frame<'_>) {
    cdr.header(frame.stamp_ns, "imu");
    cdr.f64s((0..37).map(|channel| reading(frame.stamp_ns, channel)), false);
}

fn camera(cdr: &mut Cdr, frame: &Frame<'_>) {
    cdr.header(frame.stamp_ns, "camera");
    cdr.text("jpeg");
    // The cameras are half a cycle apart, so that no image occurs twice in a chunk.
    let shift = if frame.is_right { frame.jpegs.len() / 2 } else { 0 };
    cdr.bytes(&frame.jpegs[(frame.index as usize + shift) % frame.jpegs.len()]);
}

fn topics(kind: &str) -> Result<Vec<Topic>> {
    let joint_schema = format!(
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n{HEADER_TEXT}"
    );
    let command_schema = "std_msgs/MultiArrayLayout layout\nfloat64[] data\n\
        ================================================================================\n\
        MSG: std_msgs/MultiArrayLayout\nstd_msgs/MultiArrayDimension[] dim\nuint32 data_offset\n\
        ================================================================================\n\
        MSG: std_msgs/MultiArrayDimension\nstring label\nuint32 size\nuint32 stride\n";
    let imu_schema = format!(
        "std_msgs/Header header\nfloat64[4] orientation\nfloat64[9] orientation_covariance\nfloat64[3] angular_velocity\n\
         float64[9] angular_velocity_covariance\nfloat64[3] linear_acceleration\nfloat64[9] linear_acceleration_covariance\n{HEADER_TEXT}"
    );
    let image_schema = format!("std_msgs/Header header\nstring format\nuint8[] data\n{HEADER_TEXT}");
    let topic = |name, schema_name, schema: &str, hz: u64, payload| Topic {
        name,
        schema_name,
        schema: schema.to_owned(),
        period_ns: 1_000_000_000 / hz,
        payload,
    };
    let joints = |hz| topic("/joint_states", "sensor_msgs/msg/JointState", &joint_schema, hz, joint_state);
    let commands = |hz| topic("/command", "std_msgs/msg/Float64MultiArray", command_schema, hz, command);
    let cameras = [
        topic("/camera/left", "sensor_msgs/msg/CompressedImage", &image_schema, 30, camera),
        topic("/camera/right", "sensor_msgs/msg/CompressedImage", &image_schema, 30, camera),
    ];
    let imu = topic("/imu", "bench_msgs/msg/FlatImu", &imu_schema, 1000, imu);
    Ok(match kind {
        "numeric" => vec![joints(500), commands(500), imu],
        "image" => [joints(100), commands(100)].into_iter().chain(cameras).collect(),
        "mixed" => [joints(500), commands(500), imu].into_iter().chain(cameras).collect(),
        other => bail!("kind {other:?}: expected numeric, image or mixed"),
    })
}

/// Returns 64 textured 640x480 JPEG frames, about 60 kB each.
fn jpegs() -> Result<Vec<Vec<u8>>> {
    let (width, height) = (640u32, 480u32);
    (0..64u32)
        .map(|frame| {
            let mut pixels = Vec::with_capacity((width * height * 3) as usize);
            for y in 0..height {
                for x in 0..width {
                    let texture =
                        (x / 3 + frame * 5).wrapping_mul(2_654_435_761).rotate_left(y / 3 % 31) >> 27;
                    let shade = (x + y + frame * 10) / 8 % 200;
                    pixels.extend([
                        (shade + texture) as u8,
                        (shade + texture / 2) as u8,
                        (200 - shade) as u8,
                    ]);
                }
            }
            Ok(encode_jpeg(&Image::try_new(width, height, Pixels::Rgb8(pixels))?, 90)?)
        })
        .collect()
}

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [kind, megabytes, path] = arguments.as_slice() else {
        bail!("usage: generate_log numeric|image|mixed MB OUT.mcap")
    };
    let target_bytes = megabytes.parse::<u64>().context("the size in MB")? * 1_000_000;
    let topics = topics(kind)?;
    let jpegs = if kind == "numeric" { Vec::new() } else { jpegs()? };
    let file = BufWriter::new(File::create(path).with_context(|| format!("creating {path}"))?);
    let options =
        WriteOptions::new().compression(Some(Compression::Zstd)).chunk_size(Some(1 << 20)).profile("ros2");
    let mut writer: Writer<_> = options.create(file)?;
    let mut channels = Vec::new();
    for topic in &topics {
        let schema = writer.add_schema(topic.schema_name, "ros2msg", topic.schema.as_bytes())?;
        channels.push(writer.add_channel(schema, topic.name, "cdr", &BTreeMap::new())?);
    }
    let (mut cdr, mut written, mut messages) = (Cdr::default(), 0u64, 0u64);
    let mut next: Vec<(u64, u64)> = topics.iter().map(|_| (START_NS, 0)).collect();
    while written < target_bytes {
        let (which, &(stamp_ns, index)) =
            next.iter().enumerate().min_by_key(|(_, due)| due.0).expect("a topic");
        cdr.begin();
        (topics[which].payload)(
            &mut cdr,
            &Frame { stamp_ns, index, is_right: topics[which].name.ends_with("right"), jpegs: &jpegs },
        );
        let header = MessageHeader {
            channel_id: channels[which],
            sequence: index as u32,
            log_time: stamp_ns + 1_000_000,
            publish_time: stamp_ns + 500_000,
        };
        writer.write_to_known_channel(&header, &cdr.0)?;
        written += cdr.0.len() as u64;
        messages += 1;
        next[which] = (stamp_ns + topics[which].period_ns, index + 1);
    }
    writer.finish()?;
    println!("{path}: {messages} messages, {written} payload bytes");
    Ok(())
}
