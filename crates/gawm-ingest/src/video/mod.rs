//! Video: MP4 files of LeRobot folders and packets of `foxglove.CompressedVideo`, through FFmpeg's libraries.
//!
//! Only the cargo feature `video` links FFmpeg. Without it the same calls say that this build does not decode video, so
//! that the rest of the crate does not care. Frames come out as 8-bit RGB: FFmpeg decodes, [`colour`] converts, and the
//! conversion is our own integer arithmetic, equal to the bit on every machine.
//!
//! Files are read by time: a frame belongs to a row when its presentation time is within [`TOLERANCE_SECS`] of the row's,
//! as `lerobot` has it. One pass in order; jumps back, and far forward, seek. No more than one frame is kept.

#[cfg(feature = "video")]
mod colour;
#[cfg(feature = "video")]
mod decoder;
#[cfg(feature = "video")]
mod file;
#[cfg(feature = "video")]
mod h264;
#[cfg(feature = "video")]
mod lane;
#[cfg(feature = "video")]
mod packets;
#[cfg(not(feature = "video"))]
mod without;

#[cfg(test)]
#[cfg(feature = "video")]
mod run_tests;
#[cfg(test)]
#[cfg(feature = "video")]
mod tests;

use bytes::Bytes;

#[cfg(feature = "video")]
pub(crate) use lane::VideoLanes;
#[cfg(feature = "video")]
pub(crate) use packets::PacketDecoder;
#[cfg(not(feature = "video"))]
pub(crate) use without::{PacketDecoder, VideoLanes};

/// Whether this build decodes video.
pub(crate) const IS_BUILT: bool = cfg!(feature = "video");

/// What to do about a build without video.
pub(crate) const BUILD_HINT: &str = "build with `cargo build --release -p gawm-ingest --features video` (needs libavcodec-dev, libavformat-dev, libavutil-dev), convert the videos to images (lerobot-edit-dataset has convert_video_to_image), or remove its stream";

/// Largest difference between the time of a row and that of its frame, as in `lerobot`.
#[cfg(feature = "video")]
pub(crate) const TOLERANCE_SECS: f64 = 1e-4;

/// One decoded frame: rows of 8-bit RGB without padding.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct RgbFrame {
    pub(crate) width: u32,
    pub(crate) height: u32,
    pub(crate) data: Bytes,
}

/// Why a frame cannot be had.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub(crate) enum VideoError {
    /// This build has no decoder.
    #[error("this build does not decode video")]
    NotBuilt,
    /// The file is no video that FFmpeg reads.
    #[cfg(feature = "video")]
    #[error("not a readable MP4: {detail}: {path:?}")]
    Open {
        /// The file.
        path: std::path::PathBuf,
        /// What FFmpeg says.
        detail: String,
    },
    /// A codec that is not decoded.
    #[cfg(feature = "video")]
    #[error("video codec {got:?}, expected h264, h265, av1 or vp9")]
    Codec {
        /// Its name.
        got: String,
    },
    /// Frames of a size or of colours that are not taken.
    #[cfg(feature = "video")]
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
    #[cfg(feature = "video")]
    #[error("no frame at {wanted_secs:.4} s: expected one within 0.1 ms, got {nearest}")]
    NoFrame {
        /// The time of the row in the file.
        wanted_secs: f64,
        /// The nearest frame, or that there is none, and what the decoder said.
        nearest: String,
    },
    /// A packet that cannot be decoded.
    #[cfg(feature = "video")]
    #[error("damaged video packet: {detail}")]
    Packet {
        /// What FFmpeg says.
        detail: String,
    },
    /// A packet before the first from which decoding can begin.
    #[cfg(feature = "video")]
    #[error("video packet before the first keyframe")]
    BeforeKeyframe,
    /// A packet whose frame never came.
    #[error("video packet without a frame of its own")]
    Unfinished,
}

impl VideoError {
    /// Returns the reason for counting.
    pub(crate) fn reason(&self) -> &'static str {
        match self {
            VideoError::NotBuilt => "video_not_decoded",
            VideoError::Unfinished => "corrupt_video",
            #[cfg(feature = "video")]
            VideoError::Open { .. } => "unreadable_video",
            #[cfg(feature = "video")]
            VideoError::Codec { .. } | VideoError::Frame { .. } => "unsupported_image",
            #[cfg(feature = "video")]
            VideoError::NoFrame { .. } => "no_frame",
            #[cfg(feature = "video")]
            VideoError::Packet { .. } => "corrupt_video",
            #[cfg(feature = "video")]
            VideoError::BeforeKeyframe => "before_keyframe",
        }
    }
}
