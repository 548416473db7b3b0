//! Validation: rules with stable codes that find what harms training.
//!
//! Numbers are read in one pass; each run of rows is measured on its own thread ([`profile`](self)), and the measures of
//! all runs are compared afterwards, so that bounds are relative to the data and not to a taste. Pictures take a pass of
//! their own. Codes are in [`RULES`], bounds in [`Thresholds`].

mod catalogue;
mod continuity;
mod copies;
mod demo;
mod finding;
mod group;
mod image;
mod layout;
mod linear;
mod motion;
mod probe;
mod profile;
mod relation;
mod render;
mod rest;
mod robust;
mod rotations;
mod row_checks;
mod saturation;
mod semantic;
mod signal;
mod split;
mod structure;
mod thresholds;
mod time;
mod tracking;
mod value;
mod views;
mod windows;

use std::collections::BTreeMap;

pub use catalogue::{RULES, Rule, rule};
pub use demo::{DemoError, DemoReport, DemoRule, run_demo};
pub use finding::{Counts, Finding, Report, Severity};
pub use render::{render_markdown, render_text};
pub use thresholds::{
    ImageThresholds, SemanticThresholds, SplitThresholds, Thresholds, ThresholdsError, TimeThresholds,
    ValueThresholds,
};
pub use windows::WindowYield;

use crate::read::{Dataset, ScanError};

/// Most findings of one code that are listed.
const MAX_LISTED: usize = 1000;

/// What is validated, and how.
#[derive(Debug, Clone, PartialEq)]
pub struct ValidateOptions {
    /// Bounds and severities.
    pub thresholds: Thresholds,
    /// Rows of a training window, for the share of windows that survive.
    pub window_rows: usize,
    /// Whether pictures are looked at.
    pub checks_images: bool,
    /// Whether a probe tests if pictures show the state (SEMANTIC-012).
    pub probes_targets: bool,
    /// Most findings of one code that are listed; the others are counted.
    pub max_listed: usize,
}

impl Default for ValidateOptions {
    fn default() -> Self {
        ValidateOptions {
            thresholds: Thresholds::default(),
            window_rows: 16,
            checks_images: true,
            probes_targets: false,
            max_listed: MAX_LISTED,
        }
    }
}

/// A validation with the measures that reports show beside the findings.
#[derive(Debug, Clone, PartialEq)]
pub struct Examination {
    /// The findings.
    pub report: Report,
    /// The runs of rows in order.
    pub episodes: Vec<EpisodeMeasures>,
    /// How many rows before the motion an action lies, if actions and states can be compared.
    pub action_lag: Option<ActionLag>,
}

/// Measures of one episode.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeMeasures {
    /// Episode index.
    pub episode: i64,
    /// Number of rows.
    pub rows: usize,
    /// Median rate.
    pub rate_hz: f64,
    /// Longest step between rows, in periods.
    pub longest_periods: f64,
    /// 95th percentile of jitter, in periods.
    pub jitter_periods: f64,
    /// Share of idle rows.
    pub idle_share: f64,
}

/// How states follow actions.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ActionLag {
    /// The motion from t to t+1 is explained best by the action of row t minus this.
    pub rows: i64,
    /// Share of the unsteady motion that the action explains there.
    pub explained: f64,
}

/// Validates a dataset.
///
/// # Errors
/// An episode is too long to be held at once.
pub fn validate(dataset: &Dataset, options: &ValidateOptions) -> Result<Report, ScanError> {
    examine(dataset, options).map(|examination| examination.report)
}

/// Validates a dataset and returns what reports show beside the findings.
///
/// # Errors
/// An episode is too long to be held at once.
pub fn examine(dataset: &Dataset, options: &ValidateOptions) -> Result<Examination, ScanError> {
    let thresholds = &options.thresholds;
    let layouts = layout::layouts(dataset);
    let has_images = options.checks_images && !dataset.frame_columns().is_empty();
    let plan = profile::Plan::new(dataset, layouts, options.window_rows, has_images);
    let columns: Vec<String> = dataset.scalar_columns();
    let (runs, scan_defects) =
        dataset.scan(&columns, |rows| profile::profile_run(dataset, &plan, thresholds, &rows))?;
    let mut findings = structure::judge_defects(dataset, &dataset.defects);
    findings.extend(structure::judge_defects(dataset, &scan_defects));
    findings.extend(runs.iter().flat_map(|run| run.findings.iter().cloned()));
    findings.extend(structure::judge_stats(dataset, &plan, &runs));
    findings.extend(value::judge(&plan, thresholds, dataset.info.fps, &runs));
    findings.extend(semantic::judge(dataset, &plan, thresholds, &runs));
    findings.extend(relation::judge(&plan, thresholds, &runs));
    findings.extend(split::judge(dataset, &plan, thresholds, &runs));
    if has_images {
        let judged = image::judge(dataset, thresholds, &runs, |_| {});
        findings.extend(judged.findings);
        findings.extend(structure::judge_defects(dataset, &judged.defects));
        if options.probes_targets {
            findings.extend(probe::judge(dataset, &plan, thresholds, &judged.pictures)?);
        }
    }
    if options.checks_images {
        findings.extend(image::judge_videos(dataset));
    }
    let windows = window_yield(dataset, options, &runs, &mut findings);
    let measures = |run: &profile::RunProfile| EpisodeMeasures {
        episode: run.episode,
        rows: run.n_rows,
        rate_hz: run.time.rate_hz,
        longest_periods: run.time.longest_periods,
        jitter_periods: run.time.jitter_periods,
        idle_share: run.motion.idle_share,
    };
    Ok(Examination {
        episodes: runs.iter().map(measures).collect(),
        action_lag: semantic::action_lag(&runs),
        report: report(dataset, options, windows, findings),
    })
}

fn window_yield(
    dataset: &Dataset,
    options: &ValidateOptions,
    runs: &[profile::RunProfile],
    findings: &mut Vec<Finding>,
) -> WindowYield {
    let (windows, surviving) = runs.iter().fold((0, 0), |(w, g), r| (w + r.n_windows, g + r.n_good_windows));
    let share_of_rows = surviving as f64 / dataset.n_rows().max(1) as f64;
    let bound = options.thresholds.semantic.window_share;
    if share_of_rows < bound {
        let message = format!(
            "{surviving} windows of {} rows survive from {} rows; {} of {windows} inside episodes touch a bad row",
            options.window_rows,
            dataset.n_rows(),
            windows - surviving
        );
        findings.push(Finding::new("SEMANTIC-013", message).measured(share_of_rows, bound));
    }
    WindowYield { rows_per_window: options.window_rows as u64, windows, surviving, share_of_rows }
}

/// Fills in severities and hints, orders the findings and bounds their number.
fn report(
    dataset: &Dataset,
    options: &ValidateOptions,
    windows: WindowYield,
    mut findings: Vec<Finding>,
) -> Report {
    for finding in &mut findings {
        let rule = catalogue::rule(finding.code);
        if finding.severity == Severity::Off {
            finding.severity = rule.map_or(Severity::Warning, |r| r.severity);
        }
        if let Some(severity) = options.thresholds.severity.get(finding.code) {
            finding.severity = *severity;
        }
        finding.hint = rule.map_or("", |r| r.hint);
    }
    findings.retain(|f| f.severity != Severity::Off);
    findings.sort_by(|a, b| {
        let key = |f: &Finding| (std::cmp::Reverse(f.severity), f.code, f.episode, f.rows, f.feature.clone());
        key(a).cmp(&key(b))
    });
    let mut counts = Counts::default();
    let mut listed: BTreeMap<&'static str, usize> = BTreeMap::new();
    let mut left_out = BTreeMap::new();
    for finding in &findings {
        match finding.severity {
            Severity::Error => counts.error += 1,
            Severity::Warning => counts.warning += 1,
            _ => counts.info += 1,
        }
    }
    findings.retain(|f| {
        let n = listed.entry(f.code).or_default();
        *n += 1;
        if *n > options.max_listed {
            *left_out.entry(f.code).or_default() += 1;
        }
        *n <= options.max_listed
    });
    let mut episodes: Vec<i64> = dataset.runs.iter().map(|r| r.episode_index).collect();
    episodes.sort_unstable();
    episodes.dedup();
    Report {
        dataset: dataset.name(),
        format: dataset.info.version.text(),
        episodes: episodes.len() as u64,
        rows: dataset.n_rows(),
        counts,
        windows,
        findings,
        left_out,
    }
}

/// What is declared of one dim, for statistics and reports.
#[derive(Debug, Clone, PartialEq)]
pub struct DimLabel {
    /// Name, or the dim's number.
    pub name: String,
    /// Unit, empty if none is declared.
    pub unit: String,
    /// Whether it is an angle.
    pub is_angle: bool,
}

/// Returns what is declared of the dims of a column; nothing for columns that carry no robot data.
pub fn dim_labels(dataset: &Dataset, column: &str) -> Vec<DimLabel> {
    let layouts = layout::layouts(dataset);
    let Some(layout) = layouts.iter().find(|l| l.name == column) else { return Vec::new() };
    let is_angle =
        |d: usize| matches!(layout.kinds[d], layout::DimKind::Angle | layout::DimKind::Wrapped { .. });
    let label = |d: usize| DimLabel {
        name: layout.names[d].clone(),
        unit: layout.units[d].clone(),
        is_angle: is_angle(d),
    };
    (0..layout.width()).map(label).collect()
}

/// Returns the columns that tell when the robot moves: states, or actions where there is none.
pub(crate) fn motion_columns(dataset: &Dataset) -> Vec<String> {
    let states = columns_of(dataset, layout::Purpose::State);
    if states.is_empty() { action_columns(dataset) } else { states }
}

/// Returns the columns of actions.
pub(crate) fn action_columns(dataset: &Dataset) -> Vec<String> {
    columns_of(dataset, layout::Purpose::Action)
}

fn columns_of(dataset: &Dataset, purpose: layout::Purpose) -> Vec<String> {
    layout::layouts(dataset).into_iter().filter(|l| l.purpose == purpose).map(|l| l.name).collect()
}
