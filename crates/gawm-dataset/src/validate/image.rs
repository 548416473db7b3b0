//! Rules of group IMAGE: pictures in the data files, frames of videos where this build decodes them, and the video files.

use std::collections::BTreeMap;

use gawm_image::Limits;

use super::{
    Finding, Thresholds, continuity,
    motion::place_distance,
    profile::RunProfile,
    robust::{Pair, centre_and_scale, median, quantile},
    signal::Stretch,
    views,
};
use crate::read::{DType, Dataset, Defect, FrameBytes, FrameReader, NoPicture, Run};

/// Side of the thumbnails that frames are compared by.
pub(super) const THUMB_SIDE: usize = 8;
/// Pixels of a thumbnail.
pub(super) const THUMB: usize = THUMB_SIDE * THUMB_SIDE;
/// Most pixels of a frame that is decoded.
const LIMITS: Limits = Limits { max_pixels: 1 << 26 };
/// States this many usual steps apart are the same: a simulator draws equal pictures of them.
const SAME_PLACE: f64 = 0.3;
/// Largest lag of pictures that is looked for, in rows.
const MAX_LAG: usize = 12;

/// One frame, measured.
#[derive(Debug, Clone, Copy)]
pub(super) struct FrameMeasure {
    pub(super) hash: u64,
    mean: f32,
    pub(super) std: f32,
    /// Mean of red minus mean of blue.
    warmth: f32,
    pub(super) is_picture: bool,
    pub(super) thumb: [u8; THUMB],
}

/// The frames of one camera in one run.
#[derive(Debug, Clone, Default)]
pub(super) struct CameraRun {
    pub(super) frames: Vec<FrameMeasure>,
    undecodable: Vec<(usize, String)>,
    n_undecodable: usize,
    absent: Vec<usize>,
    wrong_size: Vec<(usize, u32, u32, u32)>,
    n_wrong_size: usize,
}

struct Measurer {
    sizes: Vec<Option<(usize, usize, usize)>>,
    cameras: Vec<CameraRun>,
}

impl FrameReader for Measurer {
    type Output = Vec<CameraRun>;

    fn frame(&mut self, camera: usize, row: usize, frame: FrameBytes) {
        let run = &mut self.cameras[camera];
        let mut measure =
            FrameMeasure { hash: 0, mean: 0.0, std: 0.0, warmth: 0.0, is_picture: false, thumb: [0; THUMB] };
        if let Some(bytes) = frame.bytes() {
            let mut short = [0; 8];
            short.copy_from_slice(&blake3::hash(bytes).as_bytes()[..8]);
            measure.hash = u64::from_le_bytes(short);
        }
        match frame.thumbnail(2 * THUMB_SIDE, &LIMITS) {
            Ok((got, picture)) => {
                let luma = picture.luma();
                let n = luma.len().max(1) as f64;
                let mean = luma.iter().map(|v| f64::from(*v)).sum::<f64>() / n;
                let variance = luma.iter().map(|v| (f64::from(*v) - mean).powi(2)).sum::<f64>() / n;
                (measure.mean, measure.std, measure.is_picture) = (mean as f32, variance.sqrt() as f32, true);
                measure.warmth = warmth(&picture.rgb);
                measure.thumb.copy_from_slice(&picture.shrunk(THUMB_SIDE, THUMB_SIDE).luma());
                if let Some((height, width, channels)) = self.sizes[camera]
                    && got.map(|n| n as usize) != [height, width, channels]
                {
                    run.n_wrong_size += 1;
                    if run.wrong_size.len() < 4 {
                        run.wrong_size.push((row, got[0], got[1], got[2]));
                    }
                }
            }
            Err(NoPicture::Absent) => run.absent.push(row),
            // Depth in floats is no picture.
            Err(NoPicture::Depth) => {}
            Err(NoPicture::TooLarge(n)) => {
                run.note_undecodable(row, format!("{n} bytes are more than are permitted"));
            }
            Err(NoPicture::Damaged(reason)) => run.note_undecodable(row, reason),
        }
        run.frames.push(measure);
    }

    fn finish(self) -> Vec<CameraRun> {
        self.cameras
    }
}

impl CameraRun {
    /// Returns the thumbnail of a frame that is a picture.
    pub(super) fn thumb(&self, row: usize) -> Option<&[u8; THUMB]> {
        self.frames.get(row).filter(|f| f.is_picture).map(|f| &f.thumb)
    }

    fn note_undecodable(&mut self, row: usize, reason: String) {
        self.n_undecodable += 1;
        if self.undecodable.len() < 4 {
            self.undecodable.push((row, reason));
        }
    }
}

/// Returns the mean of red minus the mean of blue.
fn warmth(rgb: &[u8]) -> f32 {
    let sum: i64 = rgb.chunks_exact(3).map(|p| i64::from(p[0]) - i64::from(p[2])).sum();
    sum as f32 / (rgb.len() / 3).max(1) as f32
}

/// What pictures gave.
#[derive(Debug, Default)]
pub(super) struct Judgement {
    pub(super) findings: Vec<Finding>,
    pub(super) defects: Vec<Defect>,
    /// By run, the frames of each camera.
    pub(super) pictures: Vec<(usize, Vec<CameraRun>)>,
}

/// Looks at all frames in the data files and judges them.
pub(super) fn judge(
    dataset: &Dataset,
    thresholds: &Thresholds,
    runs: &[RunProfile],
    progress: impl Fn(usize) + Sync,
) -> Judgement {
    let cameras = dataset.frame_columns();
    if cameras.is_empty() {
        return Judgement::default();
    }
    let sizes: Vec<_> =
        cameras.iter().map(|c| dataset.info.feature(c).and_then(|f| f.image_size())).collect();
    let begin = |_: usize, _: &Run| Measurer {
        sizes: sizes.clone(),
        cameras: vec![CameraRun::default(); cameras.len()],
    };
    let (measured, defects) = dataset.scan_frames(&cameras, begin, progress);
    let by_index: BTreeMap<usize, &RunProfile> = runs.iter().map(|r| (r.run_index, r)).collect();
    let mut findings = Vec::new();
    for (camera, name) in cameras.iter().enumerate() {
        let of_camera: Vec<(&RunProfile, &CameraRun)> =
            measured.iter().filter_map(|(run, m)| by_index.get(run).map(|r| (*r, &m[camera]))).collect();
        let judge = Judge { thresholds, fps: dataset.info.fps, name, sizes: sizes[camera], runs: &of_camera };
        judge.broken(&mut findings);
        judge.flat(&mut findings);
        judge.repeats(&mut findings);
        judge.odd(&mut findings);
        findings.extend(continuity::judge(thresholds, dataset.info.fps, name, &of_camera));
        judge.exposure(&mut findings);
        judge.lag(&mut findings);
    }
    views::judge(&cameras, &measured, &by_index, &mut findings);
    Judgement { findings, defects, pictures: measured }
}

struct Judge<'a> {
    thresholds: &'a Thresholds,
    fps: f64,
    name: &'a str,
    sizes: Option<(usize, usize, usize)>,
    runs: &'a [(&'a RunProfile, &'a CameraRun)],
}

impl Judge<'_> {
    fn finding(&self, code: &'static str, run: &RunProfile, message: String) -> Finding {
        Finding::new(code, message).episode(run.episode).feature(self.name)
    }

    fn broken(&self, findings: &mut Vec<Finding>) {
        for (run, camera) in self.runs {
            if let Some((row, reason)) = camera.undecodable.first() {
                let message = format!("{} frames cannot be decoded: {reason}", camera.n_undecodable);
                findings.push(
                    self.finding("IMAGE-001", run, message)
                        .rows(*row, row + 1)
                        .measured(camera.n_undecodable as f64, 0.0),
                );
            }
            if let (Some(first), Some(last)) = (camera.absent.first(), camera.absent.last()) {
                let message = format!("{} frames are missing", camera.absent.len());
                findings.push(
                    self.finding("IMAGE-002", run, message)
                        .rows(*first, last + 1)
                        .measured(camera.absent.len() as f64, 0.0),
                );
            }
            if let (Some((row, h, w, c)), Some((height, width, channels))) =
                (camera.wrong_size.first(), self.sizes)
            {
                let message = format!(
                    "{} frames have another size: expected {height} x {width} x {channels}, got {h} x {w} x {c}",
                    camera.n_wrong_size
                );
                findings.push(
                    self.finding("IMAGE-003", run, message)
                        .rows(*row, row + 1)
                        .measured(camera.n_wrong_size as f64, 0.0),
                );
            }
        }
    }

    fn flat(&self, findings: &mut Vec<Finding>) {
        let bounds = &self.thresholds.image;
        let is_black = |f: &FrameMeasure| {
            f.is_picture && f64::from(f.mean) < bounds.black_luma && f64::from(f.std) < bounds.flat_luma
        };
        let is_white = |f: &FrameMeasure| {
            f.is_picture && f64::from(f.mean) > bounds.white_luma && f64::from(f.std) < bounds.flat_luma
        };
        for (run, camera) in self.runs {
            let cases: [(&'static str, &str, IsFlat<'_>); 2] =
                [("IMAGE-004", "black", &is_black), ("IMAGE-005", "white", &is_white)];
            for (code, what, is_flat) in cases {
                let Some(first) = camera.frames.iter().position(is_flat) else { continue };
                let n = camera.frames.iter().filter(|f| is_flat(f)).count();
                let n_rows = camera.frames[first..].iter().take_while(|f| is_flat(f)).count();
                findings.push(
                    self.finding(code, run, format!("{n} frames are {what}"))
                        .rows(first, first + n_rows)
                        .measured(n as f64, 0.0),
                );
            }
        }
    }

    /// Finds frozen stretches and frames that come twice.
    fn repeats(&self, findings: &mut Vec<Finding>) {
        let measures: Vec<Repeats> = self.runs.iter().map(|(run, camera)| repeats_of(run, camera)).collect();
        let longest: Vec<f64> = measures.iter().map(|m| m.frozen.n_rows as f64).collect();
        let usual_frozen = if longest.len() >= 3 { median(&longest) } else { 0.0 };
        let n_repeated: Vec<usize> = measures.iter().map(|m| m.repeated.len()).collect();
        let shortest = (self.thresholds.image.frozen_secs * self.fps).max(5.0);
        for (i, ((run, _), measure)) in self.runs.iter().zip(&measures).enumerate() {
            let frozen = measure.frozen;
            let is_frozen =
                frozen.n_rows as f64 >= shortest && frozen.n_rows as f64 > 3.0 * usual_frozen.min(shortest);
            if is_frozen && measure.motion > 0.3 {
                let message = format!("{} frames are the same while the robot moves", frozen.n_rows);
                let finding = self.finding("IMAGE-006", run, message).rows(frozen.start, frozen.end());
                findings.push(finding.measured(frozen.n_rows as f64, shortest));
            }
            // A camera slower than the rows repeats by nature.
            let is_nature = self.is_nature(&n_repeated, i, 0.05);
            let beside: Vec<usize> = measure
                .repeated
                .iter()
                .copied()
                .filter(|r| !is_frozen || !(frozen.start..frozen.end()).contains(r))
                .collect();
            if let Some(first) = beside.first().filter(|_| !is_nature) {
                let message = format!("{} frames repeat an earlier one while the robot moves", beside.len());
                findings.push(
                    self.finding("IMAGE-007", run, message)
                        .rows(*first, first + 1)
                        .measured(beside.len() as f64, 0.0),
                );
            }
        }
    }

    /// Returns whether the other runs show this too: in more than `share` of their frames.
    ///
    /// With one or two runs all frames are asked, the run's own among them.
    fn is_nature(&self, counts: &[usize], run: usize, share: f64) -> bool {
        let asks = |i: &usize| self.runs.len() < 3 || *i != run;
        let n: usize = (0..counts.len()).filter(asks).map(|i| counts[i]).sum();
        let n_frames: usize = (0..counts.len()).filter(asks).map(|i| self.runs[i].1.frames.len()).sum();
        n as f64 > share * n_frames.max(1) as f64
    }

    fn odd(&self, findings: &mut Vec<Finding>) {
        let ratio = self.thresholds.image.odd_ratio;
        let mut events: Vec<(&RunProfile, Vec<(usize, f64)>)> = Vec::new();
        for (run, camera) in self.runs {
            let mut odd = Vec::new();
            for (t, w) in camera.frames.windows(3).enumerate() {
                if w.iter().any(|f| !f.is_picture) {
                    continue;
                }
                let (before, after, across) =
                    (distance(&w[0], &w[1]), distance(&w[1], &w[2]), distance(&w[0], &w[2]));
                let here = before.min(after);
                if here > ratio * across.max(1.0) {
                    odd.push((t + 1, here / across.max(1.0)));
                }
            }
            events.push((run, odd));
        }
        let n_odd: Vec<usize> = events.iter().map(|e| e.1.len()).collect();
        for (i, (run, odd)) in events.into_iter().enumerate() {
            // A flickering scene does it all the time.
            if let Some((row, size)) = odd.first().filter(|_| !self.is_nature(&n_odd, i, 0.01)) {
                let message = format!(
                    "{} frames differ from both neighbours, {size:.0} times more than these from each other",
                    odd.len()
                );
                findings
                    .push(self.finding("IMAGE-008", run, message).rows(*row, row + 1).measured(*size, ratio));
            }
        }
    }

    fn exposure(&self, findings: &mut Vec<Finding>) {
        if self.runs.len() < 4 {
            return;
        }
        let of = |camera: &CameraRun, f: Level| {
            median(
                &camera.frames.iter().filter(|m| m.is_picture).map(|m| f64::from(f(m))).collect::<Vec<_>>(),
            )
        };
        let measures: [(&str, Level); 3] =
            [("brightness", |f| f.mean), ("contrast", |f| f.std), ("red minus blue", |f| f.warmth)];
        for (what, measure) in measures {
            let levels: Vec<f64> = self.runs.iter().map(|(_, c)| of(c, measure)).collect();
            let (centre, scale) = centre_and_scale(&levels);
            let bound = (self.thresholds.image.exposure_sigmas * scale).max(20.0);
            for ((run, _), level) in
                self.runs.iter().zip(&levels).filter(|(_, l)| (**l - centre).abs() > bound)
            {
                let mut message =
                    format!("{what} is {level:.0} of 255, in the other episodes about {centre:.0}");
                if what == "red minus blue" && (level + centre).abs() < 0.25 * centre.abs() {
                    message += ": red and blue are exchanged (BGR for RGB)";
                }
                findings
                    .push(self.finding("IMAGE-010", run, message).measured((level - centre).abs(), bound));
            }
        }
    }

    /// Compares the change of pictures with the speed of the robot at different lags.
    fn lag(&self, findings: &mut Vec<Finding>) {
        let lags: Vec<Option<Vec<f64>>> =
            self.runs.iter().map(|(run, camera)| lag_correlations(run, camera)).collect();
        let known: Vec<f64> = lags.iter().flatten().map(|l| best_lag(l).0 as f64).collect();
        if known.len() < 4 {
            return;
        }
        let (usual, scale) = centre_and_scale(&known);
        let bound = (4.0 * scale).max(self.thresholds.image.lag_rows);
        for ((run, _), correlations) in self.runs.iter().zip(&lags) {
            let Some(correlations) = correlations else { continue };
            let (lag, correlation) = best_lag(correlations);
            let at_usual =
                correlations[(usual.round() as i64 + MAX_LAG as i64).clamp(0, 2 * MAX_LAG as i64) as usize];
            if (lag as f64 - usual).abs() >= bound && correlation - at_usual > 0.2 {
                let message = format!(
                    "pictures follow the motion by {lag} rows (correlation {correlation:.2}), in the other episodes by {usual:.0} ({at_usual:.2} here)"
                );
                findings.push(
                    self.finding("IMAGE-016", run, message).measured((lag as f64 - usual).abs(), bound),
                );
            }
        }
    }
}

/// Whether a frame is of one colour.
type IsFlat<'a> = &'a dyn Fn(&FrameMeasure) -> bool;
/// Picks a level of a frame.
type Level = fn(&FrameMeasure) -> f32;

struct Repeats {
    frozen: Stretch,
    motion: f64,
    repeated: Vec<usize>,
}

fn repeats_of(run: &RunProfile, camera: &CameraRun) -> Repeats {
    let frames = &camera.frames;
    let usual = quantile(&run.speed.iter().map(|v| f64::from(*v)).collect::<Vec<_>>(), 0.5);
    let speed = |row: usize| run.speed.get(row).map_or(0.0, |v| f64::from(*v)) / usual.max(1e-12);
    let mut repeats = Repeats { frozen: Stretch::default(), motion: 0.0, repeated: Vec::new() };
    let mut seen: BTreeMap<u64, usize> = BTreeMap::new();
    let mut start = 0;
    for t in 0..frames.len() {
        if !frames[t].is_picture {
            start = t + 1;
            continue;
        }
        if t == 0 || frames[t].hash != frames[t - 1].hash {
            start = t;
        }
        let n_rows = t + 1 - start;
        if n_rows > repeats.frozen.n_rows {
            repeats.frozen = Stretch { start, n_rows };
        }
        if let Some(earlier) = seen.insert(frames[t].hash, t)
            && (run.places.is_empty() || distance_between(run, earlier, t) > SAME_PLACE)
            && speed(t) > 0.5
        {
            repeats.repeated.push(t);
        }
    }
    let frozen = repeats.frozen;
    if frozen.n_rows > 1 {
        repeats.motion =
            (frozen.start + 1..frozen.end()).map(speed).sum::<f64>() / (frozen.n_rows - 1) as f64;
    }
    repeats
}

/// Returns how many usual steps lie between the states of two rows, or of the rows before them if that is less.
///
/// A camera may show the state of the row before.
fn distance_between(run: &RunProfile, a: usize, b: usize) -> f64 {
    let far = |a: Option<usize>, b: Option<usize>| {
        let places = a.zip(b).and_then(|(a, b)| run.places.get(a).zip(run.places.get(b)));
        places.map_or(f64::INFINITY, |(a, b)| place_distance(a, b))
    };
    far(Some(a), Some(b)).min(far(a.checked_sub(1), b.checked_sub(1)))
}

/// Returns the mean distance of two frames' thumbnails in levels.
pub(super) fn distance(a: &FrameMeasure, b: &FrameMeasure) -> f64 {
    a.thumb.iter().zip(&b.thumb).map(|(x, y)| f64::from(x.abs_diff(*y))).sum::<f64>() / THUMB as f64
}

/// Returns the correlation of changes of the picture with speed at lags of -12..=12 rows, if one is clear.
fn lag_correlations(run: &RunProfile, camera: &CameraRun) -> Option<Vec<f64>> {
    let frames = &camera.frames;
    if frames.len() < 8 * MAX_LAG || run.speed.len() != frames.len() || frames.iter().any(|f| !f.is_picture) {
        return None;
    }
    let change: Vec<f64> =
        std::iter::once(0.0).chain(frames.windows(2).map(|w| distance(&w[0], &w[1]))).collect();
    let correlation = |k: usize| {
        let mut pair = Pair::default();
        for t in MAX_LAG..frames.len() - MAX_LAG {
            pair.add(f64::from(run.speed[t]), change[t + k - MAX_LAG]);
        }
        pair.correlation()
    };
    let all: Vec<f64> = (0..=2 * MAX_LAG).map(correlation).collect();
    let (lag, best) = best_lag(&all);
    // At the rim of the search the true lag is unknown.
    (best > 0.5 && lag.unsigned_abs() < MAX_LAG as u64).then_some(all)
}

fn best_lag(correlations: &[f64]) -> (i64, f64) {
    let best = correlations.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1));
    best.map_or((0, 0.0), |(k, c)| (k as i64 - MAX_LAG as i64, *c))
}

/// The episodes that a video file shows.
#[derive(Default)]
struct VideoUse {
    episodes: Vec<i64>,
    n_rows: u64,
    /// Frames up to the end of the last episode in it.
    n_needed: u64,
    /// The first episode whose place in the file is of another length than its rows.
    misfit: Option<(i64, f64, u64)>,
}

/// Compares video files with the rows they belong to; no picture is decoded.
pub(super) fn judge_videos(dataset: &Dataset) -> Vec<Finding> {
    let mut findings = Vec::new();
    let mut rows_of: BTreeMap<i64, u64> = BTreeMap::new();
    dataset.runs.iter().for_each(|run| *rows_of.entry(run.episode_index).or_default() += run.n_rows);
    for feature in dataset.info.features.iter().filter(|f| f.dtype == DType::Video) {
        let mut by_file: BTreeMap<String, VideoUse> = BTreeMap::new();
        for entry in &dataset.episodes {
            let Some(&n_rows) = rows_of.get(&entry.episode_index) else { continue };
            match dataset.video_path(entry, &feature.name) {
                Some(Ok(path)) => {
                    let file = by_file.entry(path).or_default();
                    file.episodes.push(entry.episode_index);
                    file.n_rows += n_rows;
                    if let Some(span) = entry.videos.get(&feature.name) {
                        let frames = |secs: f64| secs * dataset.info.fps;
                        let length = frames(span.to_timestamp_secs - span.from_timestamp_secs);
                        file.n_needed = file.n_needed.max(frames(span.to_timestamp_secs).round() as u64);
                        if (length - n_rows as f64).abs() > 0.5 {
                            file.misfit.get_or_insert((entry.episode_index, length, n_rows));
                        }
                    }
                }
                Some(Err(got)) => findings
                    .push(Finding::new("STRUCT-003", format!("video_path: {got}")).feature(&feature.name)),
                None => {}
            }
        }
        let is_any_there = by_file.keys().any(|p| dataset.root.join(p).is_file());
        if !is_any_there && !by_file.is_empty() {
            let message = format!(
                "none of {} video files exists, the first is {}",
                by_file.len(),
                by_file.keys().next().map_or("", String::as_str)
            );
            findings.push(
                Finding::new("IMAGE-011", message).feature(&feature.name).measured(by_file.len() as f64, 0.0),
            );
            continue;
        }
        for (path, used) in &by_file {
            judge_video(dataset, feature, path, used, &mut findings);
        }
    }
    findings
}

fn judge_video(
    dataset: &Dataset,
    feature: &crate::read::FeatureDecl,
    path: &str,
    used: &VideoUse,
    findings: &mut Vec<Finding>,
) {
    let finding = |code: &'static str, message: String| {
        Finding::new(code, message)
            .episode(used.episodes.first().copied().unwrap_or(0))
            .feature(&feature.name)
    };
    let file = dataset.root.join(path);
    if !file.is_file() {
        findings.push(finding("IMAGE-011", format!("{path}: expected a video, got nothing")));
        return;
    }
    let track = match crate::read::read_video_track(&file) {
        Ok(track) => track,
        Err(e) => {
            findings.push(finding("IMAGE-012", format!("{path}: {e}")));
            return;
        }
    };
    let n_rows = used.n_rows;
    // In v3 a file may hold frames that no episode shows: those of episodes that were filtered or trimmed away.
    let is_v2 = dataset.info.version.is_v2();
    if (is_v2 && track.n_frames != n_rows) || track.n_frames < used.n_needed.max(n_rows) {
        let message = format!(
            "{path} has {} frames, its {} episodes have {n_rows} rows and end at frame {}",
            track.n_frames,
            used.episodes.len(),
            used.n_needed
        );
        findings.push(finding("IMAGE-013", message).measured(track.n_frames as f64, n_rows as f64));
    } else if let Some((episode, length, n_rows)) = used.misfit {
        let message = format!("{path}: episode {episode} is given {length:.1} frames and has {n_rows} rows");
        findings.push(finding("IMAGE-013", message).episode(episode).measured(length, n_rows as f64));
    }
    if let Some((height, width, _)) = feature.image_size()
        && (track.height as usize, track.width as usize) != (height, width)
    {
        let message = format!("{path} is {} x {}, declared is {height} x {width}", track.height, track.width);
        findings.push(finding("IMAGE-014", message));
    }
    let error = track.max_grid_error_secs(dataset.info.fps);
    if error > 0.5 / dataset.info.fps {
        let message =
            format!("{path}: frames are up to {error:.4} s off the grid of {} Hz", dataset.info.fps);
        findings.push(finding("IMAGE-015", message).measured(error, 0.5 / dataset.info.fps));
    }
}
