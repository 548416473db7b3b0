//! A stream of packets, one per message, as `foxglove.CompressedVideo` has them.

use ffmpeg_next as ffmpeg;

use ffmpeg::Packet;
use ffmpeg::codec::Id;
use ffmpeg::codec::context::Context;

use super::decoder::{Decoder, MAX_PACKET_BYTES, RawFrame};
use super::h264::{PictureNumbers, units};
use super::{RgbFrame, VideoError};

/// Decodes the packets of one topic in their order.
pub struct PacketDecoder {
    decoder: Decoder,
    id: Id,
    /// Whether a packet came from which decoding can begin.
    is_begun: bool,
    numbers: PictureNumbers,
}

impl PacketDecoder {
    /// Opens a decoder for a format as messages name it.
    pub fn new(format: &str) -> Result<PacketDecoder, VideoError> {
        let id = match format.trim().to_ascii_lowercase().as_str() {
            "h264" => Id::H264,
            "h265" | "hevc" => Id::HEVC,
            "av1" => Id::AV1,
            "vp9" => Id::VP9,
            _ => return Err(VideoError::Codec { got: format.to_owned() }),
        };
        let decoder = Decoder::open(Context::new(), id)?;
        Ok(PacketDecoder { decoder, id, is_begun: false, numbers: PictureNumbers::default() })
    }

    /// Takes a packet; returns the frames that it completes, with the numbers of their packets.
    ///
    /// # Errors
    /// The packet is damaged, or comes before the first from which decoding can begin.
    pub fn push(&mut self, number: i64, data: &[u8]) -> Result<Vec<(i64, RgbFrame)>, VideoError> {
        if data.is_empty() || data.len() > MAX_PACKET_BYTES {
            return Err(VideoError::Packet { detail: format!("it has {} bytes", data.len()) });
        }
        if !self.is_begun && !self.can_begin(data) {
            return Err(VideoError::BeforeKeyframe);
        }
        self.is_begun = true;
        if self.id == Id::H264 && self.numbers.has_gap(data) {
            self.reset();
            let detail = "what its frame refers to is missing".to_owned();
            return Err(VideoError::Packet { detail });
        }
        let mut packet = Packet::copy(data);
        packet.set_pts(Some(number));
        packet.set_dts(Some(number));
        let mut frames = Vec::new();
        let sent = self.decoder.send(&packet, |frame| frames.push(frame));
        if let Err(error) = sent {
            // What follows may refer to this one: it is lost up to the next keyframe.
            self.reset();
            return Err(error);
        }
        self.taken(&frames)
    }

    /// Returns the frames that are left at the end.
    pub fn finish(&mut self) -> Vec<(i64, RgbFrame)> {
        let mut frames = Vec::new();
        self.decoder.drain(|frame| frames.push(frame));
        self.reset();
        self.taken(&frames).unwrap_or_default()
    }

    fn reset(&mut self) {
        self.decoder.flush();
        self.numbers.reset();
        self.is_begun = false;
    }

    fn taken(&mut self, frames: &[RawFrame]) -> Result<Vec<(i64, RgbFrame)>, VideoError> {
        let mut out = Vec::with_capacity(frames.len());
        for frame in frames {
            if frame.is_damaged() {
                self.reset();
                let detail = "what its frame refers to is missing".to_owned();
                return Err(VideoError::Packet { detail });
            }
            out.extend(frame.pts.map(|number| frame.rgb().map(|rgb| (number, rgb))).transpose()?);
        }
        Ok(out)
    }

    /// Returns whether a packet holds a picture that refers to no other. AV1 and VP9 decoders know themselves.
    fn can_begin(&self, data: &[u8]) -> bool {
        match self.id {
            Id::H264 => units(data).any(|unit| unit.first().is_some_and(|header| header & 0x1f == 5)),
            // Pictures of random access: BLA, IDR, CRA.
            Id::HEVC => units(data)
                .any(|unit| unit.first().is_some_and(|header| (16..=21).contains(&((header >> 1) & 0x3f)))),
            _ => true,
        }
    }
}

impl std::fmt::Debug for PacketDecoder {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("PacketDecoder").field("id", &self.id).field("is_begun", &self.is_begun).finish()
    }
}
