//! One FFmpeg decoder: packets in, frames out.

use std::sync::OnceLock;

use bytes::Bytes;
use ffmpeg_next as ffmpeg;

use ffmpeg::codec::Id;
use ffmpeg::format::Pixel;
use ffmpeg::util::color::{Range, Space};
use gawm_image::Limits;

use super::colour::{BT601, BT709, BT2020, Matrix, Meaning, Plane, Sampling, rgb_of};
use super::{RgbFrame, VideoError};

/// Largest packet; FFmpeg counts in 32 bits.
pub(super) const MAX_PACKET_BYTES: usize = 256 << 20;
/// Most frames of one packet; decoders give one, rarely two.
const MAX_FRAMES: usize = 64;

/// Begins to use FFmpeg; what it has to say comes with our own errors.
pub(super) fn init() {
    static DONE: OnceLock<()> = OnceLock::new();
    DONE.get_or_init(|| {
        ffmpeg::init().ok(); // Registers network protocols and fails never; decoders are there without it.
        ffmpeg::util::log::set_level(ffmpeg::util::log::Level::Quiet);
    });
}

/// A decoder of one video stream.
pub(super) struct Decoder {
    opened: ffmpeg::codec::decoder::Video,
    is_drained: bool,
}

/// A frame as it was decoded.
pub(super) struct RawFrame {
    pub(super) pts: Option<i64>,
    frame: ffmpeg::frame::Video,
}

impl Decoder {
    /// Opens a decoder for the streams that are taken.
    pub(super) fn open(context: ffmpeg::codec::context::Context, id: Id) -> Result<Decoder, VideoError> {
        init();
        if !matches!(id, Id::H264 | Id::HEVC | Id::AV1 | Id::VP9) {
            return Err(VideoError::Codec { got: id.name().to_owned() });
        }
        let codec = ffmpeg::codec::decoder::find(id);
        let codec = codec.ok_or_else(|| VideoError::Codec { got: id.name().to_owned() })?;
        let mut options = ffmpeg::Dictionary::new();
        options.set("threads", "1");
        options.set("max_pixels", &Limits::default().max_pixels.to_string());
        if matches!(id, Id::H264 | Id::HEVC) {
            // A picture that is damaged is an error, not one that is painted over with its neighbours.
            options.set("err_detect", "explode");
        }
        let opened = context.decoder().open_as_with(codec, options).and_then(|opened| opened.video());
        let opened = opened.map_err(|error| VideoError::Packet { detail: error.to_string() })?;
        Ok(Decoder { opened, is_drained: false })
    }

    /// Takes a packet and hands on the frames that it completes.
    pub(super) fn send(
        &mut self,
        packet: &ffmpeg::Packet,
        take: impl FnMut(RawFrame),
    ) -> Result<(), VideoError> {
        if packet.size() == 0 {
            return Err(VideoError::Packet { detail: "it is empty".to_owned() });
        }
        let sent = self.opened.send_packet(packet);
        let received = self.receive(take);
        let damaged = |error: ffmpeg::Error| VideoError::Packet { detail: error.to_string() };
        sent.map_err(damaged).and(received.map_err(damaged))
    }

    /// Hands on the frames that the decoder still holds.
    pub(super) fn drain(&mut self, take: impl FnMut(RawFrame)) {
        if !self.is_drained {
            self.is_drained = true;
            // Nothing more comes after a failure either.
            self.opened.send_eof().ok();
            self.receive(take).ok();
        }
    }

    /// Forgets everything but the stream's description.
    pub(super) fn flush(&mut self) {
        self.opened.flush();
        self.is_drained = false;
    }

    fn receive(&mut self, mut take: impl FnMut(RawFrame)) -> Result<(), ffmpeg::Error> {
        for _ in 0..MAX_FRAMES {
            let mut frame = ffmpeg::frame::Video::empty();
            match self.opened.receive_frame(&mut frame) {
                Ok(()) => take(RawFrame { pts: frame.timestamp().or(frame.pts()), frame }),
                Err(ffmpeg::Error::Eof) => return Ok(()),
                Err(ffmpeg::Error::Other { errno }) if errno == ffmpeg::error::EAGAIN => return Ok(()),
                Err(error) => return Err(error),
            }
        }
        Ok(())
    }
}

impl RawFrame {
    /// Returns whether the decoder had to make something up.
    pub(super) fn is_damaged(&self) -> bool {
        self.frame.is_corrupt()
    }

    /// Returns the planes that hold pixels, without padding.
    #[cfg(test)]
    pub(super) fn plane_bytes(&self) -> Vec<u8> {
        let bytes = if self.meaning().is_ok_and(|meaning| meaning.bits > 8) { 2 } else { 1 };
        let mut all = Vec::new();
        for plane in 0..self.frame.planes() {
            let n = self.frame.plane_width(plane) as usize * bytes;
            let rows = self.frame.plane_height(plane) as usize;
            for row in self.frame.data(plane).chunks(self.frame.stride(plane)).take(rows) {
                all.extend_from_slice(&row[..n]);
            }
        }
        all
    }

    /// Returns the frame as RGB.
    pub(super) fn rgb(&self) -> Result<RgbFrame, VideoError> {
        let (width, height) = (self.frame.width(), self.frame.height());
        Limits::default().check(u64::from(width), u64::from(height)).map_err(|_too_large| {
            VideoError::Frame {
                what: "frame size",
                expected: "a size that images may have",
                got: format!("{width}x{height}"),
            }
        })?;
        let meaning = self.meaning()?;
        let planes: Vec<Plane<'_>> = (0..self.frame.planes())
            .map(|plane| Plane { data: self.frame.data(plane), stride: self.frame.stride(plane) })
            .collect();
        let data = rgb_of(width as usize, height as usize, &planes, &meaning)?;
        Ok(RgbFrame { width, height, data: Bytes::from(data) })
    }

    fn meaning(&self) -> Result<Meaning, VideoError> {
        let format = self.frame.format();
        let planar = |across, down| Sampling::Planar { across, down };
        let (sampling, bits, is_full) = match format {
            Pixel::YUV420P => (planar(1, 1), 8, false),
            Pixel::YUVJ420P => (planar(1, 1), 8, true),
            Pixel::YUV422P => (planar(1, 0), 8, false),
            Pixel::YUVJ422P => (planar(1, 0), 8, true),
            Pixel::YUV444P => (planar(0, 0), 8, false),
            Pixel::YUVJ444P => (planar(0, 0), 8, true),
            Pixel::YUV420P10LE => (planar(1, 1), 10, false),
            Pixel::YUV422P10LE => (planar(1, 0), 10, false),
            Pixel::YUV444P10LE => (planar(0, 0), 10, false),
            Pixel::GRAY8 => (Sampling::Gray, 8, false),
            Pixel::GBRP => (Sampling::Gbr, 8, true),
            other => {
                return Err(VideoError::Frame {
                    what: "pixel format",
                    expected: "8 or 10 bits of YUV, 8 bits of grey or RGB",
                    got: format!("{other:?}"),
                });
            }
        };
        let is_full = is_full || self.frame.color_range() == Range::JPEG;
        Ok(Meaning { sampling, bits, is_full_range: is_full, matrix: self.matrix()? })
    }

    fn matrix(&self) -> Result<Matrix, VideoError> {
        match self.frame.color_space() {
            Space::BT709 => Ok(BT709),
            Space::BT2020NCL => Ok(BT2020),
            Space::Unspecified | Space::BT470BG | Space::SMPTE170M | Space::RGB => Ok(BT601),
            other => Err(VideoError::Frame {
                what: "colour matrix",
                expected: "BT.601, BT.709, BT.2020 or none named",
                got: format!("{other:?}"),
            }),
        }
    }
}
