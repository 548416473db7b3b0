//! Frames of one MP4 file, by time, in one pass.

use std::collections::VecDeque;
use std::io::Read as _;
use std::path::{Path, PathBuf};

use ffmpeg_next as ffmpeg;

use ffmpeg::codec::context::Context;
use ffmpeg::format::context::Input;
use ffmpeg::media::Type;
use ffmpeg::{Dictionary, Packet};

use super::decoder::{Decoder, MAX_PACKET_BYTES, RawFrame, init};
use super::{RgbFrame, TOLERANCE_SECS, VideoError};

/// A jump forward that is longer than this seeks instead of decoding what lies between.
const SEEK_SECS: f64 = 4.0;
/// How far before the wanted time the search for a keyframe begins, each time that it began too late.
const BACK_SECS: [f64; 4] = [0.0, 1.0, 8.0, f64::INFINITY];

/// An open video file and where in it we are.
pub(super) struct VideoFile {
    path: PathBuf,
    input: Input,
    stream: usize,
    /// Seconds of one unit of presentation time.
    unit_secs: f64,
    decoder: Decoder,
    /// Decoded and not yet asked for, in presentation order.
    ready: VecDeque<RawFrame>,
    /// Presentation time of the newest frame that was passed over or handed out.
    passed_secs: Option<f64>,
    is_ended: bool,
    /// Frames before this time belong to what lies before the place that was sought.
    not_before: Option<i64>,
    /// Whether a packet was damaged: what follows may refer to it, up to the next keyframe.
    waits_for_key: bool,
    /// What the decoder complained of since the last frame.
    complaint: Option<String>,
}

/// Whether git has put a pointer in place of a large file.
fn is_git_lfs_pointer(path: &Path) -> bool {
    const BEGINNING: &[u8] = b"version https://git-lfs";
    let mut head = [0; BEGINNING.len()];
    std::fs::File::open(path).and_then(|mut file| file.read_exact(&mut head)).is_ok() && head == BEGINNING
}

impl VideoFile {
    /// Opens a file; only as MP4, whatever it says it is, and without anything that it refers to.
    pub(super) fn open(path: &Path) -> Result<VideoFile, VideoError> {
        init();
        let failed = |detail: String| VideoError::Open { path: path.to_owned(), detail };
        let text = path.to_str().filter(|text| !text.contains('\0'));
        let text = text.ok_or_else(|| failed("its path is not UTF-8".to_owned()))?;
        let mut options = Dictionary::new();
        options.set("protocol_whitelist", "file");
        options.set("format_whitelist", "mov,mp4,m4a,3gp,3g2,mj2");
        options.set("codec_whitelist", "h264,hevc,libdav1d,av1,vp9");
        let input =
            ffmpeg::format::input_with_dictionary(&format!("file:{text}"), options).map_err(|error| {
                match is_git_lfs_pointer(path) {
                    true => failed("it is a git LFS pointer, `git lfs pull` fetches the video".to_owned()),
                    false => failed(error.to_string()),
                }
            })?;
        let found = input.streams().best(Type::Video);
        let found = found.ok_or_else(|| failed("it has no video stream".to_owned()))?;
        let (stream, base) = (found.index(), found.time_base());
        let unit_secs = f64::from(base.numerator()) / f64::from(base.denominator());
        if !(unit_secs.is_finite() && unit_secs > 0.0) {
            return Err(failed("its unit of time is not above 0".to_owned()));
        }
        let parameters = found.parameters();
        let id = parameters.id();
        let context = Context::from_parameters(parameters).map_err(|error| failed(error.to_string()))?;
        let decoder = Decoder::open(context, id)?;
        Ok(VideoFile {
            path: path.to_owned(),
            input,
            stream,
            unit_secs,
            decoder,
            ready: VecDeque::new(),
            passed_secs: None,
            is_ended: false,
            not_before: None,
            waits_for_key: false,
            complaint: None,
        })
    }

    /// Returns the frame at a time.
    pub(super) fn frame_at(&mut self, wanted_secs: f64) -> Result<RgbFrame, VideoError> {
        self.raw_at(wanted_secs)?.rgb()
    }

    /// Returns the frame at a time as it was decoded; it stays the next one, for rows with the same time.
    pub(super) fn raw_at(&mut self, wanted_secs: f64) -> Result<&RawFrame, VideoError> {
        let next = self.ready.front().and_then(|frame| frame.pts).map(|pts| pts as f64 * self.unit_secs);
        let is_behind = match (self.passed_secs, next) {
            (Some(passed), _) => wanted_secs <= passed + TOLERANCE_SECS,
            (None, Some(next)) => wanted_secs < next - TOLERANCE_SECS,
            (None, None) => false,
        };
        let from_secs = next.or(self.passed_secs).unwrap_or(0.0);
        // Behind the end there is nothing to go to.
        let is_over = self.is_ended && self.ready.is_empty();
        if is_behind || (wanted_secs - from_secs > SEEK_SECS && !is_over) {
            self.seek(wanted_secs)?;
        }
        let mut nearest: Option<f64> = None;
        while let Some(secs) = self.fill(wanted_secs)? {
            let distance = (secs - wanted_secs).abs();
            if distance <= TOLERANCE_SECS {
                if self.ready.front().is_some_and(RawFrame::is_damaged) {
                    let detail = "its frame is damaged, or what it refers to is missing".to_owned();
                    return Err(VideoError::Packet { detail: self.complained(detail) });
                }
                return match self.ready.front() {
                    Some(frame) => Ok(frame),
                    None => break,
                };
            }
            if nearest.is_none_or(|other| distance < (other - wanted_secs).abs()) {
                nearest = Some(secs);
            }
            if secs > wanted_secs {
                break;
            }
            self.pass();
        }
        let distance = |secs: &f64| (secs - wanted_secs).abs();
        let known = [nearest, self.passed_secs].into_iter().flatten();
        let nearest = match known.min_by(|a, b| distance(a).total_cmp(&distance(b))) {
            Some(secs) => format!("one at {secs:.4} s"),
            None => "none at all".to_owned(),
        };
        Err(VideoError::NoFrame { wanted_secs, nearest: self.complained(nearest) })
    }

    /// Adds what the decoder complained of.
    fn complained(&self, text: String) -> String {
        match &self.complaint {
            Some(complaint) => format!("{text} ({complaint})"),
            None => text,
        }
    }

    /// Goes to a keyframe before a time, or to the beginning.
    fn seek(&mut self, wanted_secs: f64) -> Result<(), VideoError> {
        for back_secs in BACK_SECS {
            let target_secs = (wanted_secs - back_secs).max(0.0);
            let target = (target_secs * f64::from(ffmpeg::ffi::AV_TIME_BASE)) as i64;
            let sought = if target_secs > 0.0 {
                self.input.seek(target, ..target)
            } else {
                self.input.seek(i64::MIN / 2, ..)
            };
            self.decoder.flush();
            self.ready.clear();
            (self.passed_secs, self.is_ended, self.not_before) = (None, false, None);
            self.waits_for_key = false;
            if sought.is_err() && target_secs > 0.0 {
                continue;
            }
            let is_early_enough =
                self.fill(f64::NEG_INFINITY)?.is_some_and(|secs| secs <= wanted_secs + TOLERANCE_SECS);
            if is_early_enough || target_secs <= 0.0 {
                break;
            }
        }
        Ok(())
    }

    /// Decodes until a frame is there that is not before a time; returns the time of the first that is there.
    fn fill(&mut self, wanted_secs: f64) -> Result<Option<f64>, VideoError> {
        loop {
            if let Some(frame) = self.ready.front() {
                // A frame without a time is nobody's.
                match frame.pts.map(|pts| pts as f64 * self.unit_secs) {
                    Some(secs) if secs >= wanted_secs - TOLERANCE_SECS => return Ok(Some(secs)),
                    Some(_) => {
                        self.pass();
                        continue;
                    }
                    None => {
                        self.ready.pop_front();
                        continue;
                    }
                }
            }
            if self.is_ended {
                return Ok(None);
            }
            self.decode_next();
        }
    }

    fn pass(&mut self) {
        if let Some(frame) = self.ready.pop_front() {
            self.passed_secs = frame.pts.map(|pts| pts as f64 * self.unit_secs).or(self.passed_secs);
        }
    }

    /// Decodes one packet of the file, or what is left at its end.
    fn decode_next(&mut self) {
        let mut packet = Packet::empty();
        match packet.read(&mut self.input) {
            Ok(()) if packet.stream() != self.stream => {}
            Ok(()) if packet.size() > MAX_PACKET_BYTES => {
                self.complaint = Some(format!("a packet of {} bytes", packet.size()));
            }
            Ok(()) if self.waits_for_key && !packet.is_key() => {}
            Ok(()) => self.decode(&packet),
            Err(error) => {
                if error != ffmpeg::Error::Eof {
                    self.complaint = Some(error.to_string());
                }
                self.drain(None);
                self.is_ended = true;
            }
        }
    }

    fn decode(&mut self, packet: &Packet) {
        if packet.is_corrupt() {
            self.complaint = Some("the file is cut off within a frame".to_owned());
        }
        if self.waits_for_key {
            (self.waits_for_key, self.not_before) = (false, packet.pts());
        }
        let (mut frames, not_before) = (Vec::new(), self.not_before);
        let sent = self.decoder.send(packet, |frame| frames.push(frame));
        frames.retain(|frame| not_before.is_none_or(|first| frame.pts.is_some_and(|pts| pts >= first)));
        let damaged = frames.iter().position(RawFrame::is_damaged);
        let first = match (sent, damaged) {
            (Ok(()), None) => None,
            (Ok(()), Some(at)) => {
                self.complaint = Some("what a frame refers to is missing".to_owned());
                frames[at].pts
            }
            (Err(error), _) => {
                self.complaint = Some(error.to_string());
                packet.pts()
            }
        };
        let is_good =
            |frame: &RawFrame| !frame.is_damaged() && first.is_none_or(|first| frame.pts < Some(first));
        self.ready.extend(frames.into_iter().filter(is_good));
        if first.is_some() {
            // Earlier frames that the decoder still holds are good; what follows may refer to this one.
            self.drain(first);
            self.decoder.flush();
            self.waits_for_key = true;
        }
        if self.not_before.is_none() {
            self.not_before = packet.pts();
        }
    }

    /// Takes the frames that the decoder still holds, those before a time only if it is given.
    fn drain(&mut self, before: Option<i64>) {
        let (ready, not_before) = (&mut self.ready, self.not_before);
        self.decoder.drain(|frame| {
            let is_late = before.is_some_and(|before| frame.is_damaged() || frame.pts >= Some(before));
            if !is_late && not_before.is_none_or(|first| frame.pts.is_some_and(|pts| pts >= first)) {
                ready.push_back(frame);
            }
        });
    }
}

impl std::fmt::Debug for VideoFile {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VideoFile").field("path", &self.path).field("passed_secs", &self.passed_secs).finish()
    }
}
