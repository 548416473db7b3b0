//! Contact sheets of episodes: labelled frames of each camera over the traces of states and actions, as PNG or HTML.

mod canvas;
mod html;
mod sheet;

use std::collections::BTreeSet;

use gawm_image::{ImageError, Limits, Thumbnail};
use gawm_schema::ContentHash;

use crate::read::{Dataset, EpisodeRows, FrameBytes, NoPicture, ScanError};
use crate::validate::{action_columns, dim_labels, motion_columns};

/// Width of a frame in pixels.
const FRAME_WIDTH: usize = 160;
/// Highest frame in pixels.
const MAX_FRAME_HEIGHT: usize = 320;
/// Points of a trace.
const TRACE_POINTS: usize = 640;
/// Dims drawn of one column.
const MAX_DIMS: usize = 12;

/// What stands in the place of a frame in a video file.
const IN_VIDEO: &str = "in a video";

/// Colours of dims, to be told apart on light and dark.
const COLOURS: [[u8; 3]; MAX_DIMS] = [
    [31, 119, 180],
    [255, 127, 14],
    [44, 160, 44],
    [214, 39, 40],
    [148, 103, 189],
    [140, 86, 75],
    [227, 119, 194],
    [127, 127, 127],
    [188, 189, 34],
    [23, 190, 207],
    [57, 59, 121],
    [173, 73, 74],
];

/// What is shown.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PreviewOptions {
    /// The episodes by index; without any, `count` are chosen by `seed`.
    pub episodes: Vec<i64>,
    /// Number of episodes that are chosen. Default 4.
    pub count: usize,
    /// Another seed gives another choice. Default 0.
    pub seed: u64,
    /// Frames of each camera and episode. Default 8.
    pub frames: usize,
    /// Cameras by name; without any, all.
    pub cameras: Vec<String>,
}

impl Default for PreviewOptions {
    fn default() -> Self {
        PreviewOptions { episodes: Vec::new(), count: 4, seed: 0, frames: 8, cameras: Vec::new() }
    }
}

/// Why a preview cannot be made.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum PreviewError {
    /// The dataset cannot be scanned.
    #[error(transparent)]
    Scan(#[from] ScanError),
    /// An episode or a camera is not there.
    #[error("unknown {what} {got}, expected one of {expected}")]
    Unknown {
        /// Episode or camera.
        what: &'static str,
        /// What was asked for.
        got: String,
        /// What there is.
        expected: String,
    },
    /// The sheet cannot be encoded.
    #[error("cannot encode the sheet: {0}")]
    Encode(#[from] ImageError),
}

/// One episode of a sheet.
struct Clip {
    episode: i64,
    title: String,
    cameras: Vec<CameraStrip>,
    traces: Vec<Traces>,
}

struct CameraStrip {
    name: String,
    frames: Vec<(usize, Result<Thumbnail, String>)>,
}

/// The dims of one column over an episode.
struct Traces {
    name: String,
    /// Rows of the frames, as a share of the episode.
    marks: Vec<f64>,
    dims: Vec<TraceDim>,
    n_hidden: usize,
}

struct TraceDim {
    name: String,
    unit: String,
    low: f64,
    high: f64,
    values: Vec<f64>,
}

/// Draws a contact sheet as PNG.
///
/// # Errors
/// An episode or camera is unknown, or the dataset cannot be scanned.
pub fn preview_png(dataset: &Dataset, options: &PreviewOptions) -> Result<Vec<u8>, PreviewError> {
    let clips = clips(dataset, options)?;
    Ok(gawm_image::encode_png(&sheet::draw(&dataset.name(), &clips)?)?)
}

/// Writes a contact sheet as a page that loads nothing.
///
/// # Errors
/// An episode or camera is unknown, or the dataset cannot be scanned.
pub fn preview_html(dataset: &Dataset, options: &PreviewOptions) -> Result<String, PreviewError> {
    Ok(html::page(&dataset.name(), &clips(dataset, options)?))
}

fn clips(dataset: &Dataset, options: &PreviewOptions) -> Result<Vec<Clip>, PreviewError> {
    let chosen = chosen_runs(dataset, options)?;
    let in_files = dataset.frame_columns();
    let all: Vec<&str> =
        dataset.info.features.iter().filter(|f| f.is_camera()).map(|f| f.name.as_str()).collect();
    if let Some(unknown) = options.cameras.iter().find(|name| !all.contains(&name.as_str())) {
        let expected = if all.is_empty() { "none".to_owned() } else { all.join(", ") };
        return Err(PreviewError::Unknown { what: "camera", got: unknown.clone(), expected });
    }
    let is_wanted = |name: &&str| options.cameras.is_empty() || options.cameras.iter().any(|c| c == name);
    let cameras: Vec<&str> = all.into_iter().filter(|name| is_wanted(name)).collect();
    let mut columns = motion_columns(dataset);
    for name in action_columns(dataset) {
        if !columns.contains(&name) {
            columns.push(name);
        }
    }
    let (traces, _) = dataset.scan_some(
        &columns,
        |run| chosen.contains(&run),
        |rows| (rows.run_index, traces_of(dataset, &columns, &rows, options.frames)),
    )?;
    let clip = |run_index: usize| {
        let run = dataset.runs[run_index];
        let rows = frame_rows(run.n_rows as usize, options.frames);
        let strip = |name: &&str| CameraStrip {
            name: (*name).to_owned(),
            frames: frames_of(dataset, run_index, name, &rows, in_files.iter().any(|c| c == name)),
        };
        let found = traces.iter().find(|(index, _)| *index == run_index);
        Clip {
            episode: run.episode_index,
            title: title(dataset, run_index),
            cameras: cameras.iter().map(strip).collect(),
            traces: found.map(|(_, traces)| traces.iter().map(Traces::copy).collect()).unwrap_or_default(),
        }
    };
    Ok(chosen.into_iter().map(clip).collect())
}

impl Traces {
    fn copy(&self) -> Traces {
        let dims = self.dims.iter().map(|dim| TraceDim {
            name: dim.name.clone(),
            unit: dim.unit.clone(),
            low: dim.low,
            high: dim.high,
            values: dim.values.clone(),
        });
        Traces {
            name: self.name.clone(),
            marks: self.marks.clone(),
            dims: dims.collect(),
            n_hidden: self.n_hidden,
        }
    }
}

fn chosen_runs(dataset: &Dataset, options: &PreviewOptions) -> Result<BTreeSet<usize>, PreviewError> {
    let runs: Vec<usize> = (0..dataset.runs.len()).filter(|i| dataset.runs[*i].n_rows > 0).collect();
    if options.episodes.is_empty() {
        let mut order: Vec<(ContentHash, usize)> = runs
            .into_iter()
            .map(|run| (ContentHash::of(format!("{} {run}", options.seed).as_bytes()), run))
            .collect();
        order.sort_by_key(|(hash, _)| hash.0);
        return Ok(order.into_iter().take(options.count).map(|(_, run)| run).collect());
    }
    let find = |episode: &i64| {
        runs.iter().copied().find(|run| dataset.runs[*run].episode_index == *episode).ok_or_else(|| {
            let known: Vec<i64> = runs.iter().map(|run| dataset.runs[*run].episode_index).collect();
            PreviewError::Unknown {
                what: "episode",
                got: episode.to_string(),
                expected: format!(
                    "{} to {}",
                    known.iter().min().unwrap_or(&0),
                    known.iter().max().unwrap_or(&0)
                ),
            }
        })
    };
    options.episodes.iter().map(find).collect()
}

/// Returns rows spread over an episode: the first, the last and evenly between.
fn frame_rows(n_rows: usize, n_frames: usize) -> Vec<usize> {
    let n_frames = n_frames.min(n_rows);
    let mut rows: Vec<usize> = (0..n_frames).map(|k| k * (n_rows - 1) / (n_frames - 1).max(1)).collect();
    rows.dedup();
    rows
}

fn frames_of(
    dataset: &Dataset,
    run_index: usize,
    camera: &str,
    rows: &[usize],
    is_in_files: bool,
) -> Vec<(usize, Result<Thumbnail, String>)> {
    if !is_in_files {
        return rows.iter().map(|row| (*row, Err(IN_VIDEO.to_owned()))).collect();
    }
    let frames = match dataset.read_frames(run_index, camera, rows) {
        Ok(frames) => frames,
        Err(_unreadable) => return rows.iter().map(|row| (*row, Err("unreadable".to_owned()))).collect(),
    };
    let picture = |frame: Option<&FrameBytes>| {
        let limits = Limits { max_pixels: 1 << 26 };
        let found = frame.unwrap_or(&FrameBytes::Absent).thumbnail(FRAME_WIDTH / 2, &limits);
        let (_, picture) = found.map_err(|reason| match reason {
            NoPicture::Absent => "no picture".to_owned(),
            NoPicture::Depth => "depth".to_owned(),
            NoPicture::TooLarge(_) => "too large".to_owned(),
            NoPicture::Damaged(_) => "damaged".to_owned(),
        })?;
        let height = (picture.height * FRAME_WIDTH / picture.width.max(1)).clamp(1, MAX_FRAME_HEIGHT);
        Ok(picture.shrunk(FRAME_WIDTH, height))
    };
    rows.iter().enumerate().map(|(k, row)| (*row, picture(frames.get(k)))).collect()
}

fn title(dataset: &Dataset, run_index: usize) -> String {
    let run = dataset.runs[run_index];
    let entry = dataset.entry(run.episode_index);
    let mut text = format!(
        "episode {}: {} rows, {:.1} s",
        run.episode_index,
        run.n_rows,
        run.n_rows as f64 / dataset.info.fps
    );
    let known = entry.and_then(|e| e.extra_text("success_known")).is_none_or(|known| known == "true");
    if let Some(success) = entry.and_then(|e| e.extra_text("success")).filter(|_| known) {
        text += if success == "true" { ", success" } else { ", no success" };
    }
    if let Some(task) = entry.and_then(|e| e.tasks.first()).filter(|task| !task.is_empty()) {
        text += &format!(", {task}");
    }
    text
}

fn traces_of(dataset: &Dataset, columns: &[String], rows: &EpisodeRows, n_frames: usize) -> Vec<Traces> {
    let n_rows = rows.n_rows();
    let last = n_rows.saturating_sub(1).max(1) as f64;
    let marks: Vec<f64> = frame_rows(n_rows, n_frames).iter().map(|row| *row as f64 / last).collect();
    let traces = |name: &String| {
        let dims = rows.column(name)?.dims();
        let labels = dim_labels(dataset, name);
        let dim = |(i, values): (usize, &Vec<f64>)| {
            let finite = values.iter().copied().filter(|v| v.is_finite());
            let (low, high) =
                finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
            let stride = values.len().div_ceil(TRACE_POINTS).max(1);
            TraceDim {
                name: labels.get(i).map_or_else(|| i.to_string(), |label| label.name.clone()),
                unit: labels.get(i).map_or(String::new(), |label| label.unit.clone()),
                low,
                high,
                values: values.iter().step_by(stride).copied().collect(),
            }
        };
        Some(Traces {
            name: name.clone(),
            marks: marks.clone(),
            dims: widest(dims).into_iter().map(|i| dim((i, &dims[i]))).collect(),
            n_hidden: dims.len().saturating_sub(MAX_DIMS),
        })
    };
    columns.iter().filter_map(traces).collect()
}

/// Returns the dims that are drawn, in their order: of many those that cover most.
fn widest(dims: &[Vec<f64>]) -> Vec<usize> {
    let range = |dim: &Vec<f64>| {
        let finite = dim.iter().filter(|v| v.is_finite());
        let (low, high) =
            finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), v| (low.min(*v), high.max(*v)));
        (high - low).max(0.0)
    };
    let mut order: Vec<(f64, usize)> = dims.iter().map(range).zip(0..).collect();
    order.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    let mut chosen: Vec<usize> = order.into_iter().take(MAX_DIMS).map(|(_, i)| i).collect();
    chosen.sort_unstable();
    chosen
}

impl TraceDim {
    /// Returns where a value lies between the smallest and the largest, 0 to 1.
    fn share(&self, value: f64) -> f64 {
        if self.high > self.low { (value - self.low) / (self.high - self.low) } else { 0.5 }
    }

    fn legend(&self) -> String {
        // "1" says that there is no unit.
        let unit =
            if self.unit.is_empty() || self.unit == "1" { String::new() } else { format!(" {}", self.unit) };
        if self.low > self.high {
            return format!("{}: no numbers", self.name);
        }
        format!("{} {} to {}{unit}", self.name, short(self.low), short(self.high))
    }
}

/// Returns a number with three digits.
fn short(value: f64) -> String {
    let magnitude = value.abs();
    if magnitude != 0.0 && !(1e-3..1e5).contains(&magnitude) {
        return format!("{value:.1e}");
    }
    let digits = if magnitude >= 100.0 {
        0
    } else if magnitude >= 10.0 {
        1
    } else {
        3
    };
    let text = format!("{value:.digits$}");
    if text.contains('.') { text.trim_end_matches('0').trim_end_matches('.').to_owned() } else { text }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn frames_are_spread_from_first_to_last() {
        assert_eq!(frame_rows(100, 4), [0, 33, 66, 99]);
        assert_eq!(frame_rows(3, 8), [0, 1, 2]);
        assert_eq!(frame_rows(1, 8), [0]);
        assert_eq!(frame_rows(5, 1), [0]);
        assert_eq!(frame_rows(0, 8), [] as [usize; 0]);
    }

    #[test]
    fn of_many_dims_those_that_move_are_drawn() {
        let mut dims = vec![vec![0.5, 0.5, f64::NAN]; 20];
        dims[17] = vec![0.0, 2.0, 1.0];
        dims[15] = vec![0.0, 1.0, f64::NAN];
        let chosen = widest(&dims);
        assert_eq!(chosen.len(), MAX_DIMS);
        assert!(chosen.ends_with(&[15, 17]) && chosen.starts_with(&[0, 1]), "{chosen:?}");
    }

    #[test]
    fn numbers_are_short() {
        let texts: Vec<String> =
            [0.0, 0.5, -2.71449, 123.456, 1e-7, 2.5e9].iter().map(|v| short(*v)).collect();
        assert_eq!(texts, ["0", "0.5", "-2.714", "123", "1.0e-7", "2.5e9"]);
    }
}
