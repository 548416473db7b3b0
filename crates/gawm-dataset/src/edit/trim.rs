//! `trim`: idle beginnings and ends of episodes.

use std::f64::consts::TAU;
use std::ops::Range;

use super::{EditError, Input, Piece, Plan};
use crate::read::{Dataset, EpisodeRows};
use crate::validate::{dim_labels, motion_columns};

/// Time over which a dim has to move, in seconds.
const MOTION_SECS: f64 = 0.2;
/// Motion below this many standard deviations of the noise is none.
const NOISE_SIGMAS: f64 = 5.0;

/// What is idle, and what stays of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TrimOptions {
    /// A dim moves when it covers more than this share of its range within 0.2 s. Default 0.02.
    pub threshold: f64,
    /// What stays of an idle end, in seconds. Default 0.5.
    pub margin_secs: f64,
    /// Less than this is not worth a cut, in seconds. Default 0.5.
    pub min_cut_secs: f64,
}

impl Default for TrimOptions {
    fn default() -> Self {
        TrimOptions { threshold: 0.02, margin_secs: 0.5, min_cut_secs: 0.5 }
    }
}

/// What trimming does to an episode.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct TrimmedEpisode {
    /// Episode index in the input.
    pub episode: i64,
    /// Its rows.
    pub rows: u64,
    /// Rows that stay.
    pub kept: Range<u64>,
    /// Whether nothing moves in it: then it is kept whole.
    pub is_idle: bool,
}

/// When an episode moves.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Activity {
    pub(super) rows: u64,
    pub(super) active_rows: u64,
    /// First active row and the one after the last.
    pub(super) span: Option<Range<u64>>,
}

/// Plans to cut idle ends off; nothing inside an episode is cut.
///
/// # Errors
/// The dataset cannot be scanned, or has neither states nor actions.
pub fn trim(input: &Input, options: &TrimOptions) -> Result<(Plan, Vec<TrimmedEpisode>), EditError> {
    let fps = input.dataset.info.fps;
    let rows_of = |secs: f64| (secs * fps).round().clamp(0.0, 1e15) as u64;
    let (margin, min_cut) = (rows_of(options.margin_secs), rows_of(options.min_cut_secs).max(1));
    let activity = activity(&input.dataset, Some(options.threshold))?;
    let mut plan = Plan { verb: "trim".to_owned(), ..Plan::default() };
    for (name, value) in [
        ("threshold", options.threshold),
        ("margin_s", options.margin_secs),
        ("min_cut_s", options.min_cut_secs),
    ] {
        plan.arguments.insert(name.to_owned(), value.to_string());
    }
    let mut trimmed = Vec::new();
    for piece in input.pieces(0) {
        let run = input.dataset.runs[piece.run];
        let span = activity.iter().find(|(e, _)| *e == run.episode_index).and_then(|(_, a)| a.span.clone());
        let mut kept = 0..run.n_rows;
        if let Some(span) = &span {
            let (start, end) = (span.start.saturating_sub(margin), (span.end + margin).min(run.n_rows));
            if start >= min_cut {
                kept.start = start;
            }
            if run.n_rows - end >= min_cut {
                kept.end = end;
            }
        }
        trimmed.push(TrimmedEpisode {
            episode: run.episode_index,
            rows: run.n_rows,
            kept: kept.clone(),
            is_idle: span.is_none(),
        });
        plan.pieces.push(Piece { rows: kept, ..piece });
    }
    Ok((plan, trimmed))
}

/// How far a dim goes in an episode, and how noisy it is.
struct DimScale {
    low: f64,
    high: f64,
    noise: f64,
}

/// Returns when each episode moves, in reading order; `threshold` is a share of the range of a dim over the dataset.
pub(super) fn activity(dataset: &Dataset, threshold: Option<f64>) -> Result<Vec<(i64, Activity)>, EditError> {
    let threshold = threshold.unwrap_or(TrimOptions::default().threshold);
    let columns = motion_columns(dataset);
    if columns.is_empty() {
        return Err(EditError::Damaged {
            path: dataset.root.clone(),
            place: "meta/info.json features".to_owned(),
            expected: "a state or an action that tells when the robot moves".to_owned(),
            got: "neither".to_owned(),
        });
    }
    let angles: Vec<Vec<bool>> = columns
        .iter()
        .map(|name| dim_labels(dataset, name).iter().map(|label| label.is_angle).collect())
        .collect();
    let (scales, _) = dataset.scan(&columns, |rows| scales_of(&columns, &angles, &rows))?;
    let bounds = bounds(&scales, threshold);
    let window = (MOTION_SECS * dataset.info.fps).round().max(1.0) as usize;
    let (found, _) = dataset.scan(&columns, |rows| {
        (rows.run.episode_index, activity_of(&columns, &angles, &bounds, window, &rows))
    })?;
    Ok(found)
}

fn step(is_angle: bool, from: f64, to: f64) -> f64 {
    let step = to - from;
    if is_angle { step - TAU * (step / TAU).round() } else { step }
}

fn scales_of(columns: &[String], angles: &[Vec<bool>], rows: &EpisodeRows) -> Vec<DimScale> {
    let mut scales = Vec::new();
    for (name, angles) in columns.iter().zip(angles) {
        let dims = rows.column(name).map_or(&[][..], |column| column.dims());
        for (dim, &is_angle) in angles.iter().enumerate() {
            let values = dims.get(dim).map_or(&[][..], Vec::as_slice);
            let mut finite: Vec<f64> = values.iter().copied().filter(|v| v.is_finite()).collect();
            let mut at = |share: f64| {
                let rank = ((finite.len().max(1) - 1) as f64 * share) as usize;
                (!finite.is_empty()).then(|| *finite.select_nth_unstable_by(rank, f64::total_cmp).1)
            };
            let (low, high) = (at(0.01).unwrap_or(f64::INFINITY), at(0.99).unwrap_or(f64::NEG_INFINITY));
            // The second difference of a smooth motion is noise alone: its variance is six times that of a value.
            let mut bends: Vec<f64> = values
                .windows(3)
                .map(|w| (step(is_angle, w[1], w[2]) - step(is_angle, w[0], w[1])).abs())
                .filter(|b| b.is_finite())
                .collect();
            let middle = bends.len() / 2;
            let median =
                if bends.is_empty() { 0.0 } else { *bends.select_nth_unstable_by(middle, f64::total_cmp).1 };
            scales.push(DimScale { low, high, noise: median / 0.6745 / 6f64.sqrt() });
        }
    }
    scales
}

/// Returns per dim how far it has to go to count as moving.
fn bounds(scales: &[Vec<DimScale>], threshold: f64) -> Vec<f64> {
    let n_dims = scales.iter().map(Vec::len).max().unwrap_or(0);
    let bound = |dim: usize| {
        let of: Vec<&DimScale> = scales.iter().filter_map(|run| run.get(dim)).collect();
        let low = of.iter().map(|s| s.low).fold(f64::INFINITY, f64::min);
        let high = of.iter().map(|s| s.high).fold(f64::NEG_INFINITY, f64::max);
        let mut noise: Vec<f64> = of.iter().map(|s| s.noise).collect();
        noise.sort_by(f64::total_cmp);
        let noise = noise.get(noise.len() / 2).copied().unwrap_or(0.0);
        // A dim that never moves has a range of noise and stays below the bound.
        (threshold * (high - low)).max(NOISE_SIGMAS * noise).max(f64::MIN_POSITIVE)
    };
    (0..n_dims).map(bound).collect()
}

fn activity_of(
    columns: &[String],
    angles: &[Vec<bool>],
    bounds: &[f64],
    window: usize,
    rows: &EpisodeRows,
) -> Activity {
    let n_rows = rows.n_rows();
    let mut is_active = vec![false; n_rows];
    let mut bound = bounds.iter();
    for (name, angles) in columns.iter().zip(angles) {
        let dims = rows.column(name).map_or(&[][..], |column| column.dims());
        for (dim, &is_angle) in angles.iter().enumerate() {
            let bound = bound.next().copied().unwrap_or(f64::INFINITY);
            let values = dims.get(dim).map_or(&[][..], Vec::as_slice);
            // A short episode is looked at as a whole.
            let window = window.min(values.len().saturating_sub(1)).max(1);
            for (row, pair) in values.windows(window + 1).enumerate() {
                // What is not a number does not move.
                if step(is_angle, pair[0], pair[window]).abs() > bound {
                    is_active[row..=row + window].fill(true);
                }
            }
        }
    }
    let span = is_active.iter().position(|a| *a).map(|first| {
        let last = is_active.iter().rposition(|a| *a).unwrap_or(first);
        first as u64..last as u64 + 1
    });
    let active_rows = is_active.iter().filter(|a| **a).count() as u64;
    Activity { rows: n_rows as u64, active_rows, span }
}
