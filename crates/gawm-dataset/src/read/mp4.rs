//! Enough of MP4 to compare a video with its rows: size, frame count and frame times. No picture is decoded.

use std::{
    fs::File,
    io::{self, Read, Seek, SeekFrom},
    path::Path,
};

/// Largest `moov` box that is read, in bytes.
const MAX_MOOV_BYTES: u64 = 64 << 20;
/// Deepest nesting of boxes.
const MAX_DEPTH: usize = 8;

/// Why an MP4 file cannot be used.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum Mp4Error {
    /// The file cannot be read.
    #[error("cannot read: {0}")]
    Io(#[from] io::Error),
    /// There is no complete `moov` box: the recording was cut off before its index was written.
    #[error("expected a complete moov box, got none: the file was cut off")]
    NoIndex,
    /// The index is larger than is permitted.
    #[error("expected a moov box of at most {MAX_MOOV_BYTES} bytes, got {0}")]
    TooLarge(u64),
    /// There is no video track with a sample table.
    #[error("expected a video track with a sample table, got none")]
    NoVideo,
    /// The sample data lie beyond the end of the file.
    #[error("expected media data up to byte {expected}, got a file of {got} bytes: it was cut off")]
    Truncated {
        /// Where the last chunk begins.
        expected: u64,
        /// The size of the file.
        got: u64,
    },
}

/// What an MP4 file says about its video track.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct VideoTrack {
    /// Columns of pixels.
    pub width: u32,
    /// Rows of pixels.
    pub height: u32,
    /// Number of frames.
    pub n_frames: u64,
    /// Ticks per second of the durations.
    pub timescale: u32,
    /// Runs of (number of frames, ticks per frame).
    pub durations: Vec<(u32, u32)>,
    /// Codec, as a four-character code.
    pub codec: String,
}

impl VideoTrack {
    /// Returns the length in seconds.
    pub fn duration_secs(&self) -> f64 {
        let ticks: f64 = self.durations.iter().map(|(n, d)| f64::from(*n) * f64::from(*d)).sum();
        if self.timescale == 0 { 0.0 } else { ticks / f64::from(self.timescale) }
    }

    /// Returns the largest deviation of a frame's time from frame / fps, in seconds.
    pub fn max_grid_error_secs(&self, fps: f64) -> f64 {
        let (mut frame, mut ticks, mut worst) = (0.0f64, 0.0f64, 0.0f64);
        for (n, duration) in &self.durations {
            frame += f64::from(*n);
            ticks += f64::from(*n) * f64::from(*duration);
            // The time of the first frame after the run; its duration is linear in between.
            worst = worst.max((ticks / f64::from(self.timescale.max(1)) - frame / fps).abs());
        }
        worst
    }
}

/// Reads the description of the first video track of an MP4 file.
///
/// # Errors
/// - the file cannot be read, or has no complete index
/// - there is no video track, or its media data are cut off
pub fn read_video_track(path: &Path) -> Result<VideoTrack, Mp4Error> {
    let mut file = File::open(path)?;
    let size = file.metadata()?.len();
    let mut at = 0u64;
    while at.checked_add(8).is_some_and(|end| end <= size) {
        file.seek(SeekFrom::Start(at))?;
        let mut head = [0u8; 16];
        file.read_exact(&mut head[..8])?;
        let mut length = u64::from(be_u32(&head, 0));
        let mut header = 8;
        if length == 1 {
            file.read_exact(&mut head[8..16])?;
            length = u64::from(be_u32(&head, 8)) << 32 | u64::from(be_u32(&head, 12));
            header = 16;
        } else if length == 0 {
            length = size - at;
        }
        let end = at.checked_add(length).filter(|end| *end <= size && length >= header);
        let Some(end) = end else { return Err(Mp4Error::NoIndex) };
        if &head[4..8] == b"moov" {
            if length > MAX_MOOV_BYTES {
                return Err(Mp4Error::TooLarge(length));
            }
            let mut moov = vec![0; (length - header) as usize];
            file.seek(SeekFrom::Start(at + header))?;
            file.read_exact(&mut moov)?;
            return track_of(&moov, size);
        }
        at = end;
    }
    Err(Mp4Error::NoIndex)
}

#[derive(Default)]
struct Draft {
    track: VideoTrack,
    is_video: bool,
    has_samples: bool,
    last_chunk: u64,
}

fn track_of(moov: &[u8], size: u64) -> Result<VideoTrack, Mp4Error> {
    let mut found = None;
    for_each_box(moov, &mut |name, body| {
        if name == b"trak" && found.is_none() {
            let mut draft = Draft::default();
            walk(body, 0, &mut draft);
            if draft.is_video && draft.has_samples {
                found = Some(draft);
            }
        }
    });
    let draft = found.ok_or(Mp4Error::NoVideo)?;
    if draft.last_chunk >= size {
        return Err(Mp4Error::Truncated { expected: draft.last_chunk, got: size });
    }
    Ok(draft.track)
}

fn walk(data: &[u8], depth: usize, draft: &mut Draft) {
    if depth > MAX_DEPTH {
        return;
    }
    for_each_box(data, &mut |name, body| match name {
        b"mdia" | b"minf" | b"stbl" => walk(body, depth + 1, draft),
        b"hdlr" => draft.is_video |= body.get(8..12) == Some(b"vide"),
        b"mdhd" => draft.track.timescale = at_u32(body, if body.first() == Some(&1) { 20 } else { 12 }),
        b"stsz" => {
            draft.track.n_frames = u64::from(at_u32(body, 8));
            draft.has_samples = body.len() >= 12;
        }
        b"stts" => {
            let n = (at_u32(body, 4) as usize).min(body.len().saturating_sub(8) / 8);
            draft.track.durations =
                (0..n).map(|i| (at_u32(body, 8 + 8 * i), at_u32(body, 12 + 8 * i))).collect();
        }
        b"stco" => {
            let n = (at_u32(body, 4) as usize).min(body.len().saturating_sub(8) / 4);
            draft.last_chunk = (0..n).map(|i| u64::from(at_u32(body, 8 + 4 * i))).max().unwrap_or(0);
        }
        b"co64" => {
            let n = (at_u32(body, 4) as usize).min(body.len().saturating_sub(8) / 8);
            let wide =
                |i: usize| u64::from(at_u32(body, 8 + 8 * i)) << 32 | u64::from(at_u32(body, 12 + 8 * i));
            draft.last_chunk = (0..n).map(wide).max().unwrap_or(0);
        }
        b"stsd" => {
            draft.track.codec = String::from_utf8_lossy(body.get(12..16).unwrap_or_default()).into_owned();
            let half = |i: usize| body.get(i..i + 2).map_or(0, |b| u32::from(b[0]) << 8 | u32::from(b[1]));
            // A visual sample entry: 8 bytes of version and count, 8 of size and name, then width at 24.
            (draft.track.width, draft.track.height) = (half(40), half(42));
        }
        _ => {}
    });
}

fn for_each_box<'a>(data: &'a [u8], f: &mut dyn FnMut(&[u8], &'a [u8])) {
    let mut at = 0usize;
    while at + 8 <= data.len() {
        let length = at_u32(data, at) as usize;
        let Some(end) = at.checked_add(length).filter(|end| length >= 8 && *end <= data.len()) else {
            return;
        };
        f(&data[at + 4..at + 8], &data[at + 8..end]);
        at = end;
    }
}

fn at_u32(data: &[u8], at: usize) -> u32 {
    if data.len() >= at + 4 { be_u32(data, at) } else { 0 }
}

fn be_u32(data: &[u8], at: usize) -> u32 {
    u32::from_be_bytes([data[at], data[at + 1], data[at + 2], data[at + 3]])
}
