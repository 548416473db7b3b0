//! Decodes one block of a log: the part of the work that threads share.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;

use super::picture::{Picture, loss_reason};
use super::plan::{ChannelPlan, Plans, Sinks, schema_of};
use crate::decode::{CameraInfo, DecodeError, Decoded, RowSink, decode_to_json};
use crate::log::{Block, Damage, Message, decompress_message, looks_like_zstd};

/// Largest message that a compressed message may become.
const MAX_MESSAGE_BYTES: u64 = 1 << 30;

/// The decoded messages of a block, in the order of the file.
#[derive(Debug, Default)]
pub(crate) struct DecodedBlock {
    pub(crate) messages: Vec<DecodedMessage>,
    /// Values that messages have ranges of.
    pub(crate) values: Vec<f64>,
    /// Messages of topics that are not mapped.
    pub(crate) unmapped: Vec<(String, u64)>,
    /// What was lost or odd.
    pub(crate) damage: Vec<Damage>,
}

/// One message of a mapped topic.
#[derive(Debug)]
pub(crate) struct DecodedMessage {
    /// Index of the topic.
    pub(crate) topic: usize,
    pub(crate) sequence: u32,
    pub(crate) log_ns: i64,
    pub(crate) publish_ns: i64,
    /// CRC-32 of the payload, to know duplicates.
    pub(crate) crc: u32,
    pub(crate) length: usize,
    /// File offset of the message or its chunk.
    pub(crate) offset: u64,
    /// Range of the values of each group, and the stamp.
    pub(crate) rows: Vec<(Range<usize>, Option<i64>)>,
    pub(crate) picture: Option<(Picture, Option<i64>)>,
    pub(crate) event: Option<serde_json::Value>,
    pub(crate) camera_info: Option<Box<CameraInfo>>,
    pub(crate) loss: Option<MessageLoss>,
}

/// Why a message is lost.
#[derive(Debug)]
pub(crate) struct MessageLoss {
    /// For counting.
    pub(crate) reason: &'static str,
    /// For the first example.
    pub(crate) detail: String,
}

/// Decodes a block.
pub(crate) fn decode_block(read: Block, plans: &Plans) -> DecodedBlock {
    let mut out = DecodedBlock::default();
    let by_channel: Vec<Arc<ChannelPlan>> = read.channels.iter().map(|channel| plans.of(channel)).collect();
    let mut sinks: Vec<Vec<Sinks>> =
        by_channel.iter().map(|plan| plan.vectors.iter().map(|_| Sinks::default()).collect()).collect();
    let mut unmapped = vec![0_u64; read.channels.len()];
    out.messages.reserve(read.messages.len());
    for message in &read.messages {
        let channel = message.channel as usize;
        let plan = &by_channel[channel];
        match plan.topic {
            None => unmapped[channel] += 1,
            Some(topic) => {
                let decoded = decode_message(&read, message, plan, topic, plans, &mut sinks[channel], &mut out.values);
                out.messages.push(decoded);
            }
        }
    }
    for (channel, count) in read.channels.iter().zip(unmapped) {
        if count > 0 {
            out.unmapped.push((channel.topic.clone(), count));
        }
    }
    out.damage = read.damage;
    out
}

fn decode_message(
    block: &Block,
    message: &Message,
    plan: &ChannelPlan,
    topic: usize,
    plans: &Plans,
    sinks: &mut [Sinks],
    values: &mut Vec<f64>,
) -> DecodedMessage {
    let payload = block.payload(message);
    let log_ns = i64::try_from(message.log_time_ns).unwrap_or(i64::MAX);
    let publish_ns = match i64::try_from(message.publish_time_ns) {
        Ok(0) | Err(_) => log_ns,
        Ok(ns) => ns,
    };
    let mut out = DecodedMessage {
        topic,
        sequence: message.sequence,
        log_ns,
        publish_ns,
        crc: crc32fast::hash(payload),
        length: payload.len(),
        offset: message.offset,
        rows: Vec::new(),
        picture: None,
        event: None,
        camera_info: None,
        loss: None,
    };
    let channel = block.channel(message);
    let start = values.len();
    let is_compressed = channel.message_encoding == "cdr" && looks_like_zstd(payload);
    let payload = if is_compressed {
        match decompress_message(payload, MAX_MESSAGE_BYTES) {
            Ok(bytes) => Cow::Owned(bytes),
            Err(error) => {
                out.loss = Some(MessageLoss { reason: "compressed_message", detail: error.to_string() });
                return out;
            }
        }
    } else {
        Cow::Borrowed(payload)
    };
    let whole = Payload { payload, block: &block.data };
    if let Err(loss) = fill(&mut out, &whole, channel, plan, plans, sinks, values) {
        values.truncate(start);
        out.rows.clear();
        out.loss = Some(loss);
    }
    out
}

/// The bytes of a message and those of its block, which images may share.
struct Payload<'a> {
    payload: Cow<'a, [u8]>,
    block: &'a Bytes,
}

impl Payload<'_> {
    /// Returns image bytes that outlive the block: shared when they are a large part of it, else copied.
    fn keep(&self, data: &[u8]) -> Bytes {
        let block = self.block.as_ptr_range();
        let range = data.as_ptr_range();
        let is_inside = block.start <= range.start && range.end <= block.end;
        if is_inside && data.len() >= self.block.len() / 4 {
            self.block.slice_ref(data)
        } else {
            Bytes::copy_from_slice(data)
        }
    }
}

fn fill(
    out: &mut DecodedMessage,
    whole: &Payload<'_>,
    channel: &crate::log::Channel,
    plan: &ChannelPlan,
    plans: &Plans,
    sinks: &mut [Sinks],
    values: &mut Vec<f64>,
) -> Result<(), MessageLoss> {
    let payload: &[u8] = &whole.payload;
    if let Some(error) = &plan.error {
        return Err(MessageLoss { reason: "undecodable", detail: error.to_string() });
    }
    for (decoder, sinks) in plan.vectors.iter().zip(sinks) {
        sinks.rows.clear();
        match decoder.decode(payload, sinks).map_err(|error| loss_of(&error))? {
            Decoded::Row { stamp_ns } => {
                let start = values.len();
                values.extend_from_slice(sinks.rows.values());
                out.rows.push((start..values.len(), stamp_ns));
            }
            Decoded::NotInMessage { .. } => out.rows.push((0..0, None)),
        }
    }
    if let Some(image) = &plan.image {
        let message = image.extract(payload, &mut RowSink::new()).map_err(|error| loss_of(&error))?;
        let stamp_ns = message.stamp_ns;
        let picture = Picture::new(&message, image.kind(), |data| whole.keep(data))
            .map_err(|error| MessageLoss { reason: loss_reason(&error), detail: error.to_string() })?;
        out.picture = Some((picture, stamp_ns));
    }
    let topic = &plans.topics[out.topic];
    if topic.is_event {
        let json = decode_to_json(&schema_of(channel), payload, plans.library());
        out.event = Some(json.map_err(|error| loss_of(&error))?);
    }
    if topic.is_camera_info {
        let info = CameraInfo::decode(&schema_of(channel), payload, plans.library());
        out.camera_info = Some(Box::new(info.map_err(|error| loss_of(&error))?));
    }
    Ok(())
}

fn loss_of(error: &DecodeError) -> MessageLoss {
    MessageLoss { reason: error.reason(), detail: error.to_string() }
}
