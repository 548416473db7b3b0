//! Topics of video packets: decoded in the order of the log, since a packet refers to those before it.

use std::collections::BTreeMap;

use bytes::Bytes;

use super::Session;
use crate::run::block::DecodedMessage;
use crate::run::picture::Picture;
use gawm_video::{PacketDecoder, RgbFrame, VideoError};

/// Packets whose frames may be on their way: more than any stream reorders.
const MAX_PENDING: usize = 64;

/// The state of one topic.
#[derive(Debug, Default)]
pub(super) struct VideoTopic {
    decoder: Option<PacketDecoder>,
    /// Messages whose frames have not come out yet, and their stamps.
    pending: BTreeMap<i64, (DecodedMessage, Option<i64>)>,
    next_number: i64,
}

impl VideoTopic {
    /// Takes a packet; returns the frames that are complete now.
    fn push(
        &mut self,
        message: DecodedMessage,
        stamp_ns: Option<i64>,
        format: &str,
        data: &Bytes,
    ) -> Result<Vec<(i64, RgbFrame)>, VideoError> {
        let number = self.next_number;
        self.next_number += 1;
        self.pending.insert(number, (message, stamp_ns));
        if self.decoder.is_none() {
            self.decoder = Some(PacketDecoder::new(format)?);
        }
        match &mut self.decoder {
            Some(decoder) => decoder.push(number, data),
            None => Err(VideoError::NotBuilt),
        }
    }
}

impl Session<'_, '_> {
    /// Takes a message with a video packet.
    pub(super) fn take_packet(
        &mut self,
        message: DecodedMessage,
        (format, data): (&str, &Bytes),
        stamp_ns: Option<i64>,
    ) {
        let topic = message.topic;
        let video = self.videos.entry(topic).or_default();
        match video.push(message, stamp_ns, format, data) {
            Ok(frames) => self.take_frames(topic, frames),
            // A decoder that fails forgets what it had begun.
            Err(error) => self.lose_pending(topic, 0, &error),
        }
        let lost = VideoError::Unfinished;
        self.lose_pending(topic, MAX_PENDING, &lost);
    }

    /// Takes the frames that are left when the log or its clock ends.
    pub(super) fn finish_videos(&mut self) {
        let topics: Vec<usize> = self.videos.keys().copied().collect();
        for topic in topics {
            let decoder = self.videos.get_mut(&topic).and_then(|video| video.decoder.as_mut());
            let frames = decoder.map(PacketDecoder::finish).unwrap_or_default();
            self.take_frames(topic, frames);
            self.lose_pending(topic, 0, &VideoError::Unfinished);
        }
    }

    fn take_frames(&mut self, topic: usize, frames: Vec<(i64, RgbFrame)>) {
        let name = self.rules.plans.topics[topic].topic.as_str();
        for (number, frame) in frames {
            let waiting = self.videos.get_mut(&topic).and_then(|video| video.pending.remove(&number));
            if let Some((message, stamp_ns)) = waiting {
                self.take_picture(&message, &Picture::of_frame(frame), stamp_ns, name);
            }
        }
    }

    /// Counts the oldest waiting messages as lost, but for `kept` of them.
    fn lose_pending(&mut self, topic: usize, kept: usize, error: &VideoError) {
        let name = self.rules.plans.topics[topic].topic.as_str();
        let Some(video) = self.videos.get_mut(&topic) else { return };
        while video.pending.len() > kept {
            let Some((_, (message, _))) = video.pending.pop_first() else { break };
            self.counts.lost(name, error.reason(), 1, || format!("offset {}: {error}", message.offset));
        }
    }
}
