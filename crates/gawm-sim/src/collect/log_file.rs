//! One MCAP log of some episodes, as a recorder on a robot would write it.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use mcap::records::{MessageHeader, Metadata};
use serde_json::json;

use super::cdr::{CdrEncoder, MessageType};
use super::image::FrameEncoder;
use super::{CollectError, CollectOptions, Episode};
use crate::environment::{Environment, Frame};
use crate::two_room::{FRAME_SIZE, TwoRoom};

/// Instant of the first row of the first episode: 1 January 2025, 00:00 UTC.
pub const FIRST_ROW_NS: u64 = 1_735_689_600_000_000_000;
/// Silence after the longest possible episode, in control periods.
const PAUSE_STEPS: u64 = 10;
/// Bytes of messages in a chunk, before compression.
const CHUNK_BYTES: u64 = 1 << 20;

/// Topic of the camera.
pub const IMAGE_TOPIC: &str = "/camera/image/compressed";
/// Topic of the agent's position.
pub const STATE_TOPIC: &str = "/agent/position";
/// Topic of the commands.
pub const ACTION_TOPIC: &str = "/agent/command";
/// Topic of the target's position.
pub const GOAL_TOPIC: &str = "/target/position";
/// Topic of the texts that begin and end an episode.
pub const MARKER_TOPIC: &str = "/episode_marker";
/// Name of the metadata records, one per episode.
pub const EPISODE_METADATA: &str = "episode";
/// Name of the metadata record of the collection.
pub const SESSION_METADATA: &str = "session";

const TOPICS: [(&str, MessageType); 5] = [
    (IMAGE_TOPIC, MessageType::CompressedImage),
    (STATE_TOPIC, MessageType::PointStamped),
    (ACTION_TOPIC, MessageType::Vector3Stamped),
    (GOAL_TOPIC, MessageType::PointStamped),
    (MARKER_TOPIC, MessageType::String),
];
/// Positions in `TOPICS`.
const IMAGE: usize = 0;
const STATE: usize = 1;
const ACTION: usize = 2;
const GOAL: usize = 3;
const MARKER: usize = 4;

/// Control periods from the start of an episode to the start of the next: the same for all, so that the times of an
/// episode depend on its number alone.
fn slot_steps(max_steps: u32) -> u64 {
    u64::from(max_steps) + 1 + PAUSE_STEPS
}

/// How many episodes fit before ROS 2 time stamps (signed 32-bit seconds) end.
pub(super) fn most_episodes(max_steps: u32) -> u64 {
    let seconds = i32::MAX as u64 - FIRST_ROW_NS / 1_000_000_000;
    // Ten control periods a second, as TwoRoom has.
    seconds * 10 / slot_steps(max_steps)
}

/// What one log holds.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct LogCounts {
    pub(super) episodes: u64,
    pub(super) successes: u64,
    pub(super) rows: u64,
    pub(super) bytes: u64,
}

/// Runs the episodes of one log and writes it: to a temporary file first, which gets its name when it is on the disk.
pub(super) fn write_log(
    path: &Path,
    indices: std::ops::Range<u64>,
    options: &CollectOptions,
    interrupt: &AtomicBool,
) -> Result<LogCounts, CollectError> {
    let partial = path.with_extension("mcap.partial");
    let io = |action, path: &Path, source| CollectError::Io { action, path: path.to_owned(), source };
    let file = File::create(&partial).map_err(|e| io("create", &partial, e))?;
    let mut log = LogWriter::create(partial.clone(), file, options)?;
    let mut room = TwoRoom::new(options.room.clone())?;
    let mut counts = LogCounts::default();
    for index in indices {
        if interrupt.load(Ordering::Relaxed) {
            drop(log);
            std::fs::remove_file(&partial).map_err(|e| io("remove", &partial, e))?;
            return Err(CollectError::Interrupted);
        }
        let episode = Episode::run(&mut room, options.expert, options.max_steps, options.seed, index);
        log.write_episode(&room, &episode)?;
        counts.episodes += 1;
        counts.successes += u64::from(episode.success);
        counts.rows += episode.states.len() as u64;
    }
    let mut file = log.finish()?;
    file.flush().map_err(|e| io("write", &partial, e))?;
    let file = file.into_inner().map_err(|e| io("write", &partial, e.into_error()))?;
    file.sync_all().map_err(|e| io("write", &partial, e))?;
    counts.bytes = file.metadata().map_err(|e| io("read", &partial, e))?.len();
    std::fs::rename(&partial, path).map_err(|e| io("rename", &partial, e))?;
    Ok(counts)
}

/// Writes episodes into one open log.
struct LogWriter<'a> {
    path: PathBuf,
    options: &'a CollectOptions,
    mcap: mcap::Writer<BufWriter<File>>,
    channels: [u16; TOPICS.len()],
    sequences: [u32; TOPICS.len()],
    cdr: CdrEncoder,
    frame: Frame,
    images: FrameEncoder,
}

impl<'a> LogWriter<'a> {
    fn create(path: PathBuf, file: File, options: &'a CollectOptions) -> Result<Self, CollectError> {
        let failed = |source| CollectError::Mcap { path: path.clone(), source };
        let mut mcap = mcap::WriteOptions::new()
            .profile("ros2")
            .library(concat!("gawm-sim ", env!("CARGO_PKG_VERSION")))
            .chunk_size(Some(CHUNK_BYTES))
            .create(BufWriter::new(file))
            .map_err(failed)?;
        let mut channels = [0; TOPICS.len()];
        for ((topic, message_type), channel) in TOPICS.into_iter().zip(&mut channels) {
            let schema = mcap
                .add_schema(message_type.name(), "ros2msg", message_type.definition().as_bytes())
                .map_err(failed)?;
            *channel = mcap.add_channel(schema, topic, "cdr", &BTreeMap::new()).map_err(failed)?;
        }
        let images = FrameEncoder::new(options.image, options.image_size.unwrap_or(FRAME_SIZE as u32));
        let mut log = LogWriter {
            path,
            options,
            mcap,
            channels,
            sequences: [0; TOPICS.len()],
            cdr: CdrEncoder::default(),
            frame: Frame::default(),
            images,
        };
        log.write_session()?;
        Ok(log)
    }

    fn write_session(&mut self) -> Result<(), CollectError> {
        let options = self.options;
        let room =
            serde_json::to_string(&options.room).map_err(|source| CollectError::Describe { source })?;
        let record = [
            ("environment", "two-room".to_owned()),
            ("robot_id", "two-room".to_owned()),
            ("session", format!("two-room-seed-{}", options.seed)),
            ("seed", options.seed.to_string()),
            ("configuration", room),
            ("policy", "expert".to_owned()),
            ("action_noise", options.expert.action_noise.to_string()),
            ("action_repeat", options.expert.action_repeat.to_string()),
            ("door_reach_px", options.expert.door_reach_px.to_string()),
            ("max_steps", options.max_steps.to_string()),
        ];
        self.write_metadata(SESSION_METADATA, record)
    }

    /// Writes all rows of an episode. Row t holds image, state and goal at its instant, and the command that acts from
    /// then on; the last row has no command. The episode ends half a period after its last row.
    fn write_episode(&mut self, room: &TwoRoom, episode: &Episode) -> Result<(), CollectError> {
        let task = room.spec().task;
        let period_ns = (1e9 / room.spec().control_hz).round() as u64;
        let first_step = episode.index * slot_steps(self.options.max_steps);
        let row_ns = |row: u64| FIRST_ROW_NS + (first_step + row) * period_ns;
        let (start_ns, last_ns) = (row_ns(0), row_ns(episode.actions.len() as u64));
        let end_ns = last_ns + period_ns / 2;
        let start = json!({"event": "start", "episode": episode.index, "task": task, "seed": episode.seed});
        self.write_marker(start_ns, &start)?;
        for (row, &state) in episode.states.iter().enumerate() {
            let stamp_ns = row_ns(row as u64);
            room.renderer().render(state, episode.goal, &mut self.frame);
            self.write_image(stamp_ns)?;
            self.write_planar(STATE, stamp_ns, state)?;
            self.write_planar(GOAL, stamp_ns, episode.goal)?;
            if let Some(&action) = episode.actions.get(row) {
                self.write_planar(ACTION, stamp_ns, action)?;
            }
        }
        let end = json!({"event": "end", "episode": episode.index, "success": episode.success});
        self.write_marker(end_ns, &end)?;
        let record = [
            ("index", episode.index.to_string()),
            ("task", task.to_owned()),
            ("success", episode.success.to_string()),
            ("seed", episode.seed.to_string()),
            ("rows", episode.states.len().to_string()),
            ("start_time_ns", start_ns.to_string()),
            ("end_time_ns", end_ns.to_string()),
        ];
        self.write_metadata(EPISODE_METADATA, record)
    }

    fn write_image(&mut self, stamp_ns: u64) -> Result<(), CollectError> {
        let encoded = self.images.encode(&self.frame).map_err(|source| CollectError::Encode { source })?;
        self.cdr.compressed_image(stamp_ns, self.options.image.name(), &encoded);
        self.write_encoded(IMAGE, stamp_ns)
    }

    fn write_planar(&mut self, topic: usize, stamp_ns: u64, xy: [f32; 2]) -> Result<(), CollectError> {
        self.cdr.planar(stamp_ns, xy);
        self.write_encoded(topic, stamp_ns)
    }

    fn write_marker(&mut self, time_ns: u64, marker: &serde_json::Value) -> Result<(), CollectError> {
        self.cdr.text(&marker.to_string());
        self.write_encoded(MARKER, time_ns)
    }

    /// Writes the message that the encoder holds.
    fn write_encoded(&mut self, topic: usize, time_ns: u64) -> Result<(), CollectError> {
        let header = MessageHeader {
            channel_id: self.channels[topic],
            sequence: self.sequences[topic],
            log_time: time_ns,
            publish_time: time_ns,
        };
        self.sequences[topic] += 1;
        self.mcap
            .write_to_known_channel(&header, self.cdr.encoded())
            .map_err(|source| CollectError::Mcap { path: self.path.clone(), source })
    }

    fn write_metadata<const N: usize>(
        &mut self,
        name: &str,
        record: [(&str, String); N],
    ) -> Result<(), CollectError> {
        let metadata = record.into_iter().map(|(key, value)| (key.to_owned(), value)).collect();
        self.mcap
            .write_metadata(&Metadata { name: name.to_owned(), metadata })
            .map_err(|source| CollectError::Mcap { path: self.path.clone(), source })
    }

    fn finish(mut self) -> Result<BufWriter<File>, CollectError> {
        self.mcap.finish().map_err(|source| CollectError::Mcap { path: self.path, source })?;
        Ok(self.mcap.into_inner())
    }
}
