//! Statistics of a dataset: per dim and episode, merged in episode order, so that any number of threads gives the same bits.
//!
//! Counts, minima and maxima are exact, moments are merged in f64, quantiles come from a KLL sketch (see
//! [`gawm_schema::QuantileSketch`]). Raw columns and the encoded ones (`gawm.state`, `gawm.action`) are treated alike.

mod camera;
mod difference;
mod motion;
mod render;

use std::collections::BTreeMap;
use std::sync::Mutex;

use gawm_schema::{DimStats, DimSummary};
use serde::Serialize;

pub(crate) use camera::camera_counts;
pub use camera::{CameraSummary, camera_summaries};
pub use difference::{Difference, DimDifference, difference};
pub use motion::{MotionStats, MotionSummary};
pub use render::{lerobot_stats, render_text};

use crate::read::{DType, Dataset, Defect, EpisodeRows, ScanError};

/// Points of the trace that is kept of each dim.
const TRACE_POINTS: usize = 160;

/// Statistics of one dim.
#[derive(Debug, Clone, PartialEq)]
pub struct DimTotals {
    /// Name of the dim.
    pub name: String,
    /// Unit, empty if none is declared.
    pub unit: String,
    /// Counts, moments, quantiles, histogram, directions.
    pub values: DimStats,
    /// Speed, jerk, rest and memory.
    pub motion: MotionStats,
    /// The values of the first episode, thinned out.
    pub trace: Vec<f64>,
}

/// Statistics of one column.
#[derive(Debug, Clone, PartialEq)]
pub struct ColumnTotals {
    /// Column name.
    pub name: String,
    /// The dims in order.
    pub dims: Vec<DimTotals>,
}

/// Statistics of one episode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeSummary {
    /// Episode index.
    pub episode: i64,
    /// Number of rows.
    pub rows: u64,
    /// Per column the dims; only states and actions.
    pub columns: BTreeMap<String, Vec<EpisodeDim>>,
}

/// One dim in one episode.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct EpisodeDim {
    /// Counts, moments and quantiles.
    #[serde(flatten)]
    pub values: DimSummary,
    /// Speed, jerk, rest and memory.
    #[serde(flatten)]
    pub motion: MotionSummary,
}

/// Statistics of a dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct DatasetStats {
    /// Number of rows.
    pub rows: u64,
    /// Frames per second.
    pub fps: f64,
    /// The columns in the order they are declared.
    pub columns: Vec<ColumnTotals>,
    /// The episodes in order.
    pub episodes: Vec<EpisodeSummary>,
    /// What could not be read.
    pub defects: Vec<Defect>,
}

/// Statistics of one run before they are merged.
struct RunStats {
    columns: Vec<Option<Vec<(DimStats, MotionStats)>>>,
    traces: Vec<Vec<Vec<f64>>>,
}

/// The columns whose statistics are taken.
fn wanted(dataset: &Dataset) -> Vec<String> {
    let is_wanted = |f: &&crate::read::FeatureDecl| {
        f.is_numeric()
            && !matches!(
                f.name.as_str(),
                "episode_index" | "index" | "task_index" | "frame_index" | "gawm.time_ns"
            )
    };
    dataset.info.features.iter().filter(is_wanted).map(|f| f.name.clone()).collect()
}

/// Computes the statistics of a dataset.
///
/// # Errors
/// An episode is too long to be held at once.
pub fn dataset_stats(dataset: &Dataset) -> Result<DatasetStats, ScanError> {
    let names: Vec<String> = wanted(dataset)
        .into_iter()
        .filter(|n| dataset.files.iter().any(|f| f.schema.field_with_name(n).is_ok()))
        .collect();
    let plans: Vec<ColumnPlan> = names.iter().map(|name| ColumnPlan::new(dataset, name)).collect();
    // Runs arrive in any order and are merged in theirs: what is ahead of its turn waits here.
    let merged = Mutex::new(Merged { next: 0, waiting: BTreeMap::new(), columns: empty_columns(&plans) });
    let (episodes, defects) = dataset.scan(&names, |rows| {
        let (run, summary) = run_stats(&plans, &rows, dataset.info.fps);
        merged.lock().unwrap_or_else(std::sync::PoisonError::into_inner).take(rows.run_index, run);
        summary
    })?;
    let mut merged = merged.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
    merged.flush();
    Ok(DatasetStats {
        rows: dataset.n_rows(),
        fps: dataset.info.fps,
        columns: merged.columns,
        episodes,
        defects,
    })
}

struct Merged {
    next: usize,
    waiting: BTreeMap<usize, RunStats>,
    columns: Vec<ColumnTotals>,
}

impl Merged {
    fn take(&mut self, index: usize, run: RunStats) {
        self.waiting.insert(index, run);
        while let Some(run) = self.waiting.remove(&self.next) {
            self.merge(run);
            self.next += 1;
        }
    }

    /// Merges what still waits behind runs that could not be read.
    fn flush(&mut self) {
        for run in std::mem::take(&mut self.waiting).into_values() {
            self.merge(run);
        }
    }

    fn merge(&mut self, run: RunStats) {
        for ((total, column), traces) in self.columns.iter_mut().zip(run.columns).zip(run.traces) {
            for (i, (values, motion)) in column.into_iter().flatten().enumerate() {
                total.dims[i].values.merge(&values);
                total.dims[i].motion.merge(&motion);
            }
            for (dim, trace) in total.dims.iter_mut().zip(traces) {
                if dim.trace.is_empty() {
                    dim.trace = trace;
                }
            }
        }
    }
}

struct ColumnPlan {
    name: String,
    names: Vec<String>,
    units: Vec<String>,
    is_angle: Vec<bool>,
    is_listed_per_episode: bool,
}

impl ColumnPlan {
    fn new(dataset: &Dataset, name: &str) -> ColumnPlan {
        let layouts = crate::validate::dim_labels(dataset, name);
        let width = dataset.info.feature(name).map_or(1, |f| f.width());
        let names = layouts.iter().map(|l| l.name.clone()).collect::<Vec<_>>();
        ColumnPlan {
            name: name.to_owned(),
            names: if names.len() == width {
                names
            } else {
                (0..width)
                    .map(|i| dataset.info.feature(name).map_or(String::new(), |f| f.dim_name(i)))
                    .collect()
            },
            units: (0..width).map(|i| layouts.get(i).map_or(String::new(), |l| l.unit.clone())).collect(),
            is_angle: (0..width).map(|i| layouts.get(i).is_some_and(|l| l.is_angle)).collect(),
            is_listed_per_episode: name == "action"
                || name.starts_with("action.")
                || name.starts_with("observation."),
        }
    }
}

fn empty_columns(plans: &[ColumnPlan]) -> Vec<ColumnTotals> {
    let dim = |plan: &ColumnPlan, i: usize| DimTotals {
        name: plan.names[i].clone(),
        unit: plan.units[i].clone(),
        values: DimStats::new(plan.is_angle[i]),
        motion: MotionStats::default(),
        trace: Vec::new(),
    };
    plans
        .iter()
        .map(|p| ColumnTotals { name: p.name.clone(), dims: (0..p.names.len()).map(|i| dim(p, i)).collect() })
        .collect()
}

fn run_stats(plans: &[ColumnPlan], rows: &EpisodeRows, fps: f64) -> (RunStats, EpisodeSummary) {
    let mut summary =
        EpisodeSummary { episode: rows.run.episode_index, rows: rows.run.n_rows, columns: BTreeMap::new() };
    let mut run = RunStats { columns: Vec::new(), traces: Vec::new() };
    for plan in plans {
        let Some(column) = rows.column(&plan.name) else {
            run.columns.push(None);
            run.traces.push(Vec::new());
            continue;
        };
        let integers: Vec<Vec<f64>>;
        let dims = match column.ints() {
            Some(values) => {
                integers =
                    vec![values.iter().map(|v| if *v == i64::MIN { f64::NAN } else { *v as f64 }).collect()];
                &integers
            }
            None => column.dims(),
        };
        let stats: Vec<(DimStats, MotionStats)> = dims
            .iter()
            .zip(&plan.is_angle)
            .map(|(values, is_angle)| (dim_stats(values, *is_angle), MotionStats::of(values, *is_angle)))
            .collect();
        if plan.is_listed_per_episode {
            let dims = stats
                .iter()
                .map(|(values, motion)| EpisodeDim { values: values.summary(), motion: motion.summary(fps) });
            summary.columns.insert(plan.name.clone(), dims.collect());
        }
        run.columns.push(Some(stats));
        let traces = if rows.run_index == 0 {
            dims.iter().map(|values| thinned(values)).collect()
        } else {
            Vec::new()
        };
        run.traces.push(traces);
    }
    (run, summary)
}

fn dim_stats(values: &[f64], is_angle: bool) -> DimStats {
    let mut stats = DimStats::new(is_angle);
    values.iter().for_each(|v| stats.update(*v));
    stats
}

fn thinned(values: &[f64]) -> Vec<f64> {
    let stride = values.len().div_ceil(TRACE_POINTS).max(1);
    values.iter().step_by(stride).copied().collect()
}

/// Returns the JSON form of the statistics.
pub fn to_json(stats: &DatasetStats, cameras: &BTreeMap<String, CameraSummary>) -> serde_json::Value {
    use serde_json::json;
    let dim = |d: &DimTotals| {
        let circular = d.values.circular.as_ref().map(|c| json!({"count": c.count, "mean_direction_rad": c.mean_direction(), "resultant_length": c.resultant_length()}));
        json!({
            "name": d.name, "unit": d.unit, "summary": d.values.summary(), "has_exact_quantiles": d.values.sketch.is_exact(),
            "motion": d.motion.summary(stats.fps), "circular": circular,
            "histogram": {"start": d.values.histogram.start(), "bin_width": d.values.histogram.bin_width(), "counts": d.values.histogram.counts()},
        })
    };
    let columns: serde_json::Map<String, serde_json::Value> =
        stats.columns.iter().map(|c| (c.name.clone(), c.dims.iter().map(dim).collect())).collect();
    json!({"rows": stats.rows, "fps": stats.fps, "columns": columns, "cameras": cameras, "episodes": stats.episodes})
}

/// Returns whether a feature's statistics belong into LeRobot's file.
fn is_lerobot_feature(dataset: &Dataset, name: &str) -> bool {
    dataset.info.feature(name).is_some_and(|f| f.dtype != DType::Bool || !name.starts_with("gawm."))
}
