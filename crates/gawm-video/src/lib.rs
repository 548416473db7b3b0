//! Video: MP4 files of LeRobot folders and packets of `foxglove.CompressedVideo`, through FFmpeg's libraries.
//!
//! Only the cargo feature `ffmpeg` links FFmpeg. Without it the same calls say that this build does not decode video, so
//! that callers do not care. Frames come out as 8-bit RGB: FFmpeg decodes, and the conversion is our own integer
//! arithmetic, equal to the bit on every machine.
//!
//! Files are read by time: a frame belongs to a row when its presentation time is within 0.1 ms of the row's,
//! as `lerobot` has it. One pass in order; jumps back, and far forward, seek. No more than one frame is kept.

#![forbid(unsafe_code)]

#[cfg(feature = "ffmpeg")]
mod colour;
#[cfg(feature = "ffmpeg")]
mod decoder;
#[cfg(feature = "ffmpeg")]
mod file;
#[cfg(feature = "ffmpeg")]
mod h264;
#[cfg(feature = "ffmpeg")]
mod lane;
#[cfg(feature = "ffmpeg")]
mod packets;
pub mod testing;
#[cfg(not(feature = "ffmpeg"))]
mod without;

#[cfg(test)]
#[cfg(feature = "ffmpeg")]
mod tests;

use bytes::Bytes;

#[cfg(feature = "ffmpeg")]
pub use lane::VideoLanes;
#[cfg(feature = "ffmpeg")]
pub use packets::PacketDecoder;
#[cfg(not(feature = "ffmpeg"))]
pub use without::{PacketDecoder, VideoLanes};

/// Whether this build decodes video.
pub const IS_BUILT: bool = cfg!(feature = "ffmpeg");

/// Largest difference between the time of a row and that of its frame, as in `lerobot`.
#[cfg(feature = "ffmpeg")]
pub const TOLERANCE_SECS: f64 = 1e-4;

/// One decoded frame: rows of 8-bit RGB without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RgbFrame {
    /// Pixels in a row.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Shape [height, width, 3].
    pub data: Bytes,
}

/// Why a frame cannot be had.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum VideoError {
    /// This build has no decoder.
    #[error("this build does not decode video")]
    NotBuilt,
    /// The file is no video that FFmpeg reads.
    #[cfg(feature = "ffmpeg")]
    #[error("not a readable MP4: {detail}: {path:?}")]
    Open {
        /// The file.
        path: std::path::PathBuf,
        /// What FFmpeg says.
        detail: String,
    },
    /// A codec that is not decoded.
    #[cfg(feature = "ffmpeg")]
    #[error("video codec {got:?}, expected h264, h265, av1 or vp9")]
    Codec {
        /// Its name.
        got: String,
    },
    /// Frames of a size or of colours that are not taken.
    #[cfg(feature = "ffmpeg")]
    #[error("{what}: expected {expected}, got {got}")]
    Frame {
        /// What is wrong.
        what: &'static str,
        /// What would do.
        expected: &'static str,
        /// What there is.
        got: String,
    },
    /// No frame has the time of a row.
    #[cfg(feature = "ffmpeg")]
    #[error("no frame at {wanted_secs:.4} s: expected one within 0.1 ms, got {nearest}")]
    NoFrame {
        /// The time of the row in the file.
        wanted_secs: f64,
        /// The nearest frame, or that there is none, and what the decoder said.
        nearest: String,
    },
    /// A packet that cannot be decoded.
    #[cfg(feature = "ffmpeg")]
    #[error("damaged video packet: {detail}")]
    Packet {
        /// What FFmpeg says.
        detail: String,
    },
    /// A packet before the first from which decoding can begin.
    #[cfg(feature = "ffmpeg")]
    #[error("video packet before the first keyframe")]
    BeforeKeyframe,
    /// A packet whose frame never came.
    #[error("video packet without a frame of its own")]
    Unfinished,
}

impl VideoError {
    /// Returns whether there is a readable video, and no frame in it at the wanted time.
    pub fn is_no_frame(&self) -> bool {
        #[cfg(feature = "ffmpeg")]
        return matches!(self, VideoError::NoFrame { .. });
        #[cfg(not(feature = "ffmpeg"))]
        return false;
    }

    /// Returns the reason for counting.
    pub fn reason(&self) -> &'static str {
        match self {
            VideoError::NotBuilt => "video_not_decoded",
            VideoError::Unfinished => "corrupt_video",
            #[cfg(feature = "ffmpeg")]
            VideoError::Open { .. } => "unreadable_video",
            #[cfg(feature = "ffmpeg")]
            VideoError::Codec { .. } | VideoError::Frame { .. } => "unsupported_image",
            #[cfg(feature = "ffmpeg")]
            VideoError::NoFrame { .. } => "no_frame",
            #[cfg(feature = "ffmpeg")]
            VideoError::Packet { .. } => "corrupt_video",
            #[cfg(feature = "ffmpeg")]
            VideoError::BeforeKeyframe => "before_keyframe",
        }
    }
}
