//! What a build without the feature `video` says of video.

use std::path::Path;

use super::{RgbFrame, VideoError};

/// Decodes no packets.
#[derive(Debug)]
pub struct PacketDecoder;

impl PacketDecoder {
    /// Fails.
    ///
    /// # Errors
    /// [`VideoError::NotBuilt`].
    pub fn new(_format: &str) -> Result<PacketDecoder, VideoError> {
        Err(VideoError::NotBuilt)
    }

    /// Fails.
    ///
    /// # Errors
    /// [`VideoError::NotBuilt`].
    pub fn push(&mut self, _number: i64, _data: &[u8]) -> Result<Vec<(i64, RgbFrame)>, VideoError> {
        Err(VideoError::NotBuilt)
    }

    /// Returns nothing.
    pub fn finish(&mut self) -> Vec<(i64, RgbFrame)> {
        Vec::new()
    }
}

/// Reads no files.
#[derive(Debug, Default)]
pub struct VideoLanes {}

impl VideoLanes {
    /// Says of every time that there is no frame.
    pub fn read(
        &self,
        _path: &Path,
        wanted_secs: &[f64],
        mut take: impl FnMut(usize, Result<RgbFrame, VideoError>),
    ) {
        (0..wanted_secs.len()).for_each(|at| take(at, Err(VideoError::NotBuilt)));
    }
}
