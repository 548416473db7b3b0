//! Decodes one block of a log: the part of the work that threads share.

use std::borrow::Cow;
use std::ops::Range;
use std::sync::Arc;

use bytes::Bytes;

use super::picture::{Picture, loss_reason};
use super::plan::{ChannelPlan, GroupSinks, MappedTopic, Plans, Row, schema_of};
use crate::decode::{CameraInfo, DecodeError, RowSink, decode_to_json};
use crate::log::{Block, Channel, Damage, Message, decompress_message, looks_like_zstd};

/// Largest message that a compressed message may become.
const MAX_MESSAGE_BYTES: u64 = 1 << 30;

/// The decoded messages of a block, in the order of the file.
#[derive(Debug, Default)]
pub(crate) struct DecodedBlock {
    pub(crate) messages: Vec<DecodedMessage>,
    /// Values that rows have ranges of.
    pub(crate) values: Vec<f64>,
    /// What values messages hold.
    pub(crate) rows: Vec<Row>,
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
    /// Its rows in the block; none when it is lost or holds no mapped element.
    rows: Range<usize>,
    /// What few messages have.
    extras: Option<Box<Extras>>,
}

/// What a message may hold beside numbers.
#[derive(Debug, Default)]
pub(crate) struct Extras {
    /// Its image and the stamp of it.
    pub(crate) picture: Option<(Picture, Option<i64>)>,
    /// The whole message, for markers and labels.
    pub(crate) event: Option<serde_json::Value>,
    pub(crate) camera_info: Option<CameraInfo>,
    /// Why nothing else of it can be used.
    pub(crate) loss: Option<MessageLoss>,
}

impl DecodedMessage {
    /// Returns the rows of the message, in the order of the groups of its topic.
    pub(crate) fn rows<'a>(&self, block_rows: &'a [Row]) -> &'a [Row] {
        block_rows.get(self.rows.clone()).unwrap_or_default()
    }

    pub(crate) fn picture(&self) -> Option<&(Picture, Option<i64>)> {
        self.extras.as_ref()?.picture.as_ref()
    }

    pub(crate) fn loss(&self) -> Option<&MessageLoss> {
        self.extras.as_ref()?.loss.as_ref()
    }

    /// Takes what few messages have.
    pub(crate) fn take_extras(&mut self) -> Option<Box<Extras>> {
        self.extras.take()
    }
}

/// Why a message is lost.
#[derive(Debug)]
pub(crate) struct MessageLoss {
    /// For counting.
    pub(crate) reason: &'static str,
    /// For the first example.
    pub(crate) detail: String,
}

/// Images are shared with their block when they are together at least this part of it.
const SHARED_PART: usize = 4;

/// Values that room is made for beforehand, at most: what schemas promise need not come.
const MAX_RESERVED: usize = 1 << 20;

/// Decodes a block.
pub(crate) fn decode_block(read: Block, plans: &Plans) -> DecodedBlock {
    let mut out = DecodedBlock::default();
    let by_channel: Vec<Arc<ChannelPlan>> = read.channels.iter().map(|channel| plans.of(channel)).collect();
    let mut sinks: Vec<Vec<GroupSinks>> =
        by_channel.iter().map(|plan| plan.vectors.iter().map(|_| GroupSinks::default()).collect()).collect();
    let mut unmapped = vec![0_u64; read.channels.len()];
    let is_image = |message: &&Message| by_channel[message.channel as usize].image.is_some();
    let image_bytes: usize =
        read.messages.iter().filter(is_image).map(|message| read.payload(message).len()).sum();
    let is_shared = image_bytes >= read.data.len() / SHARED_PART;
    out.messages.reserve(read.messages.len());
    out.rows.reserve(read.messages.len());
    let n_values: usize = read.messages.iter().map(|m| by_channel[m.channel as usize].width).sum();
    out.values.reserve(n_values.min(MAX_RESERVED));
    for message in &read.messages {
        let channel = message.channel as usize;
        let plan = &by_channel[channel];
        match plan.topic {
            None => unmapped[channel] += 1,
            Some(topic) => {
                let decoder = MessageDecoder { block: &read, plan, topic, plans, is_shared };
                decoder.decode(message, &mut sinks[channel], &mut out);
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

/// What is known of a message before it is decoded.
struct MessageDecoder<'a> {
    block: &'a Block,
    plan: &'a ChannelPlan,
    topic: usize,
    plans: &'a Plans,
    /// Whether images share the memory of the block.
    is_shared: bool,
}

impl MessageDecoder<'_> {
    fn decode(&self, message: &Message, sinks: &mut [GroupSinks], out: &mut DecodedBlock) {
        let payload = self.block.payload(message);
        let log_ns = i64::try_from(message.log_time_ns).unwrap_or(i64::MAX);
        let publish_ns = match i64::try_from(message.publish_time_ns) {
            Ok(0) | Err(_) => log_ns,
            Ok(ns) => ns,
        };
        let (first_value, first_row) = (out.values.len(), out.rows.len());
        let result = self.fill(message, payload, sinks, out);
        let extras = match result {
            Ok(extras) => extras,
            Err(loss) => {
                out.values.truncate(first_value);
                out.rows.truncate(first_row);
                Some(Box::new(Extras { loss: Some(loss), ..Extras::default() }))
            }
        };
        out.messages.push(DecodedMessage {
            topic: self.topic,
            sequence: message.sequence,
            log_ns,
            publish_ns,
            crc: crc32fast::hash(payload),
            length: payload.len(),
            offset: message.offset,
            rows: first_row..out.rows.len(),
            extras,
        });
    }

    fn fill(
        &self,
        message: &Message,
        payload: &[u8],
        sinks: &mut [GroupSinks],
        out: &mut DecodedBlock,
    ) -> Result<Option<Box<Extras>>, MessageLoss> {
        let channel = self.block.channel(message);
        let payload = body(channel, payload)?;
        if let Some(error) = &self.plan.error {
            return Err(MessageLoss { reason: "undecodable", detail: error.to_string() });
        }
        for (group, (decoder, sinks)) in self.plan.vectors.iter().zip(sinks).enumerate() {
            let to = (&mut out.values, &mut out.rows);
            decoder.decode(group, &payload, sinks, to).map_err(|error| loss_of(&error))?;
        }
        let topic = &self.plans.topics[self.topic];
        if self.plan.image.is_none() && !topic.is_event && !topic.is_camera_info {
            return Ok(None);
        }
        self.extras(channel, topic, &payload).map(|extras| Some(Box::new(extras)))
    }

    /// Decodes what is no row of numbers.
    fn extras(&self, channel: &Channel, topic: &MappedTopic, payload: &[u8]) -> Result<Extras, MessageLoss> {
        let mut extras = Extras::default();
        if let Some(image) = &self.plan.image {
            let message = image.extract(payload, &mut RowSink::new()).map_err(|error| loss_of(&error))?;
            let stamp_ns = message.stamp_ns;
            let picture = Picture::new(&message, |data| self.keep(data))
                .map_err(|error| MessageLoss { reason: loss_reason(&error), detail: error.to_string() })?;
            extras.picture = Some((picture, stamp_ns));
        }
        if topic.is_event {
            let json = decode_to_json(&schema_of(channel), payload, self.plans.library());
            extras.event = Some(json.map_err(|error| loss_of(&error))?);
        }
        if topic.is_camera_info {
            let info = CameraInfo::decode(&schema_of(channel), payload, self.plans.library());
            extras.camera_info = Some(info.map_err(|error| loss_of(&error))?);
        }
        Ok(extras)
    }

    /// Returns image bytes that outlive the block: shared with it, or copied when it is mostly something else.
    fn keep(&self, data: &[u8]) -> Bytes {
        let block = self.block.data.as_ptr_range();
        let range = data.as_ptr_range();
        let is_inside = block.start <= range.start && range.end <= block.end;
        if is_inside && self.is_shared {
            self.block.data.slice_ref(data)
        } else {
            Bytes::copy_from_slice(data)
        }
    }
}

/// Returns the body of a message, which rosbag2 may have compressed.
pub(crate) fn body<'a>(channel: &Channel, payload: &'a [u8]) -> Result<Cow<'a, [u8]>, MessageLoss> {
    if channel.message_encoding != "cdr" || !looks_like_zstd(payload) {
        return Ok(Cow::Borrowed(payload));
    }
    decompress_message(payload, MAX_MESSAGE_BYTES)
        .map(Cow::Owned)
        .map_err(|error| MessageLoss { reason: "compressed_message", detail: error.to_string() })
}

fn loss_of(error: &DecodeError) -> MessageLoss {
    MessageLoss { reason: error.reason(), detail: error.to_string() }
}
