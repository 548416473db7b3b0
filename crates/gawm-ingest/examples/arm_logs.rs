//! Writes logs of a small robot arm as a recorder would: joint states at 50 Hz, commands at 10 Hz, a camera that is late.
//!
//! `cargo run --release -p gawm-ingest --example arm_logs -- OUT [EPISODES] [SEED]`
//!
//! Two joints in a plane follow velocity commands with a lag. Clocks are not aligned, as they never are: the camera has
//! stamps of its own rate and phase and arrives 30 ms late, commands have no stamp. `pipelines/arm-mcap.toml` reads them.
#![expect(clippy::print_stdout, reason = "the program says what it wrote")]

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use gawm_image::{Image, Pixels, encode_jpeg};
use mcap::records::{MessageHeader, Metadata};

/// Episodes in one log.
const EPISODES_PER_LOG: u64 = 15;
/// Length of an episode and pause between two.
const EPISODE_MS: u64 = 8_000;
const PAUSE_MS: u64 = 2_000;
/// The first log begins here.
const BEGIN_MS: u64 = 1_700_000_000_000;
/// Time constant of the joints' response to a command.
const LAG_S: f64 = 0.12;
/// Side of a frame in pixels.
const SIDE: usize = 64;
/// Lengths of the links, in sides of a frame.
const LINKS: [f64; 2] = [0.24, 0.2];

const HEADER: &str = "\
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
";
const ARRAY: &str = "\
std_msgs/MultiArrayLayout layout
float64[] data
================================================================================
MSG: std_msgs/MultiArrayLayout
std_msgs/MultiArrayDimension[] dim
uint32 data_offset
================================================================================
MSG: std_msgs/MultiArrayDimension
string label
uint32 size
uint32 stride
";

/// splitmix64.
struct Random(u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ z >> 31) >> 11) as f64 / (1u64 << 53) as f64
    }
}

/// Plain CDR, little-endian.
struct Cdr(Vec<u8>);

impl Cdr {
    fn new() -> Cdr {
        Cdr(vec![0, 1, 0, 0])
    }

    fn align(&mut self, to: usize) {
        while !(self.0.len() - 4).is_multiple_of(to) {
            self.0.push(0);
        }
    }

    fn u32(mut self, value: u32) -> Cdr {
        self.align(4);
        self.0.extend(value.to_le_bytes());
        self
    }

    fn text(self, text: &str) -> Cdr {
        let mut cdr = self.u32(text.len() as u32 + 1);
        cdr.0.extend(text.bytes().chain([0]));
        cdr
    }

    fn floats(self, values: &[f64]) -> Cdr {
        let mut cdr = self.u32(values.len() as u32);
        cdr.align(8);
        cdr.0.extend(values.iter().flat_map(|value| value.to_le_bytes()));
        cdr
    }

    fn header(self, stamp_ns: u64, frame: &str) -> Cdr {
        self.u32((stamp_ns / 1_000_000_000) as u32).u32((stamp_ns % 1_000_000_000) as u32).text(frame)
    }
}

struct Log {
    mcap: mcap::Writer<BufWriter<File>>,
    sequence: u32,
}

impl Log {
    fn channel(&mut self, topic: &str, message: &str, definition: &str) -> mcap::McapResult<u16> {
        let schema = self.mcap.add_schema(message, "ros2msg", definition.as_bytes())?;
        self.mcap.add_channel(schema, topic, "cdr", &BTreeMap::new())
    }

    /// Writes messages in the order in which they arrived.
    fn write(&mut self, mut messages: Vec<Message>) -> mcap::McapResult<()> {
        messages.sort_by_key(|message| message.log_time);
        for Message { channel_id, log_time, publish_time, cdr } in messages {
            self.sequence += 1;
            let header = MessageHeader { channel_id, sequence: self.sequence, log_time, publish_time };
            self.mcap.write_to_known_channel(&header, &cdr.0)?;
        }
        Ok(())
    }
}

struct Message {
    channel_id: u16,
    log_time: u64,
    publish_time: u64,
    cdr: Cdr,
}

/// Draws the arm: white ground, dark links, a red hand.
fn frame(angles: [f64; 2]) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    let side = SIDE as f64;
    let base = [0.5 * side, 0.5 * side];
    let elbow = [base[0] + LINKS[0] * side * angles[0].cos(), base[1] + LINKS[0] * side * angles[0].sin()];
    let reach = angles[0] + angles[1];
    let hand = [elbow[0] + LINKS[1] * side * reach.cos(), elbow[1] + LINKS[1] * side * reach.sin()];
    let distance = |p: [f64; 2], a: [f64; 2], b: [f64; 2]| {
        let (d, q) = ([b[0] - a[0], b[1] - a[1]], [p[0] - a[0], p[1] - a[1]]);
        let along = ((q[0] * d[0] + q[1] * d[1]) / (d[0] * d[0] + d[1] * d[1])).clamp(0.0, 1.0);
        (q[0] - along * d[0]).hypot(q[1] - along * d[1])
    };
    let mut pixels = Vec::with_capacity(SIDE * SIDE * 3);
    for y in 0..SIDE {
        for x in 0..SIDE {
            let p = [x as f64 + 0.5, y as f64 + 0.5];
            // One pixel of soft edge.
            let cover = |distance: f64, width: f64| (width + 0.5 - distance).clamp(0.0, 1.0);
            let links = cover(distance(p, base, elbow), 3.0).max(cover(distance(p, elbow, hand), 2.2));
            let tip = cover(distance(p, hand, [hand[0] + 1e-9, hand[1]]), 3.5);
            for (dark, red) in [(40.0, 220.0), (60.0, 30.0), (90.0, 30.0)] {
                let value = 245.0 * (1.0 - links) + dark * links;
                pixels.push((value * (1.0 - tip) + red * tip).round() as u8);
            }
        }
    }
    let image = Image::try_new(SIDE as u32, SIDE as u32, Pixels::Rgb8(pixels))?;
    Ok(encode_jpeg(&image, 90)?)
}

/// Writes one log; its episodes depend on seed and index alone.
fn write_log(
    path: &Path,
    indices: std::ops::Range<u64>,
    seed: u64,
) -> Result<(), Box<dyn std::error::Error>> {
    let options = mcap::WriteOptions::new().profile("ros2").library("arm_logs");
    let mut log = Log { mcap: options.create(BufWriter::new(File::create(path)?))?, sequence: 0 };
    let names =
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort\n";
    let joints = log.channel("/joint_states", "sensor_msgs/msg/JointState", &format!("{names}{HEADER}"))?;
    let image = format!("std_msgs/Header header\nstring format\nuint8[] data\n{HEADER}");
    let camera = log.channel("/camera/image/compressed", "sensor_msgs/msg/CompressedImage", &image)?;
    let command = log.channel("/arm/velocity_command", "std_msgs/msg/Float64MultiArray", ARRAY)?;
    for index in indices {
        let begin_ms = BEGIN_MS + index * (EPISODE_MS + PAUSE_MS);
        let mut random = Random(seed.wrapping_mul(1_000_003).wrapping_add(index));
        let mut angles = [0, 1].map(|_| std::f64::consts::TAU * (random.uniform() - 0.5));
        let (mut velocity, mut target) = ([0.0; 2], [0.0; 2]);
        let mut messages = Vec::new();
        let mut send = |channel_id, log_time, publish_time, cdr| {
            messages.push(Message { channel_id, log_time, publish_time, cdr });
        };
        for ms in 0..EPISODE_MS {
            let now_ns = (begin_ms + ms) * 1_000_000;
            if ms.is_multiple_of(400) {
                target = [0, 1].map(|_| 3.0 * (random.uniform() - 0.5));
            }
            if ms % 100 == 7 {
                let noisy = target.map(|value| value + 0.3 * (random.uniform() - 0.5));
                let cdr = Cdr::new().u32(0).u32(0).floats(&noisy);
                send(command, now_ns + 1_000_000, now_ns, cdr);
                target = noisy;
            }
            for joint in 0..2 {
                velocity[joint] += (target[joint] - velocity[joint]) * 1e-3 / LAG_S;
                angles[joint] += velocity[joint] * 1e-3;
            }
            if ms % 20 == 3 {
                let cdr = Cdr::new().header(now_ns, "base").u32(2).text("shoulder").text("elbow");
                let cdr = cdr.floats(&angles).floats(&velocity).floats(&[]);
                send(joints, now_ns + 2_000_000, now_ns, cdr);
            }
            if ms % 50 == 11 {
                let jpeg = frame(angles)?;
                let mut cdr = Cdr::new().header(now_ns, "camera").text("jpeg").u32(jpeg.len() as u32);
                cdr.0.extend(jpeg);
                send(camera, now_ns + 30_000_000, now_ns + 25_000_000, cdr);
            }
        }
        log.write(messages)?;
        let record = [
            ("index", index.to_string()),
            ("task", "move at random".to_owned()),
            ("start_time_ns", (begin_ms * 1_000_000).to_string()),
            ("end_time_ns", ((begin_ms + EPISODE_MS) * 1_000_000).to_string()),
        ];
        let metadata = record.map(|(key, value)| (key.to_owned(), value)).into();
        log.mcap.write_metadata(&Metadata { name: "episode".to_owned(), metadata })?;
    }
    log.mcap.finish()?;
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let mut arguments = std::env::args().skip(1);
    let out = PathBuf::from(arguments.next().ok_or("expected a folder: arm_logs OUT [EPISODES] [SEED]")?);
    let episodes: u64 = arguments.next().map_or(Ok(90), |text| text.parse())?;
    let seed: u64 = arguments.next().map_or(Ok(1), |text| text.parse())?;
    std::fs::create_dir_all(&out)?;
    for (number, first) in (0..episodes).step_by(EPISODES_PER_LOG as usize).enumerate() {
        let path = out.join(format!("arm-{number:03}.mcap"));
        write_log(&path, first..episodes.min(first + EPISODES_PER_LOG), seed)?;
        println!("{}", path.display());
    }
    Ok(())
}
