//! What a build without the feature `video` says of video.

use std::path::Path;

use super::{RgbFrame, VideoError};

/// Decodes no packets.
#[derive(Debug)]
pub(crate) struct PacketDecoder;

impl PacketDecoder {
    pub(crate) fn new(_format: &str) -> Result<PacketDecoder, VideoError> {
        Err(VideoError::NotBuilt)
    }

    pub(crate) fn push(&mut self, _number: i64, _data: &[u8]) -> Result<Vec<(i64, RgbFrame)>, VideoError> {
        Err(VideoError::NotBuilt)
    }

    pub(crate) fn finish(&mut self) -> Vec<(i64, RgbFrame)> {
        Vec::new()
    }
}

/// Reads no files.
#[derive(Debug, Default)]
pub(crate) struct VideoLanes {}

impl VideoLanes {
    pub(crate) fn read(
        &self,
        _path: &Path,
        wanted_secs: &[f64],
        mut take: impl FnMut(usize, Result<RgbFrame, VideoError>),
    ) {
        (0..wanted_secs.len()).for_each(|at| take(at, Err(VideoError::NotBuilt)));
    }
}
