//! `filter`: the episodes of which a condition is true.

use std::collections::BTreeMap;

use gawm_schema::DimSummary;
use serde_json::Value;

use super::condition::{Condition, EpisodeValue};
use super::trim::activity;
use super::{EditError, Input, Plan};
use crate::stats::{EpisodeDim, MotionSummary, dataset_stats};
use crate::validate::{Severity, ValidateOptions, validate};

/// Plans to keep the episodes of which a condition is true; returns also which episodes those are.
///
/// # Errors
/// The condition has unknown names or compares what cannot be compared, or the dataset cannot be scanned.
pub fn filter(input: &Input, text: &str) -> Result<Plan, EditError> {
    let condition = Condition::parse(text)?;
    let values = episode_values(input, &condition)?;
    let mut plan = Plan { verb: "filter".to_owned(), ..Plan::default() };
    plan.arguments.insert("where".to_owned(), text.to_owned());
    for piece in input.pieces(0) {
        let episode = input.dataset.runs[piece.run].episode_index;
        let Some(values) = values.get(&episode) else { continue };
        if condition.holds(values)? {
            plan.pieces.push(piece);
        }
    }
    Ok(plan)
}

type NumberOf = (&'static str, fn(&DimSummary, &MotionSummary) -> f64);

/// The statistics that a condition may ask of a dim.
const STATISTICS: [NumberOf; 15] = [
    ("count", |s, _| s.count as f64),
    ("missing", |s, _| s.n_missing as f64),
    ("mean", |s, _| s.mean),
    ("std", |s, _| s.std),
    ("min", |s, _| s.min),
    ("max", |s, _| s.max),
    ("q01", |s, _| s.q01),
    ("q10", |s, _| s.q10),
    ("q50", |s, _| s.q50),
    ("q90", |s, _| s.q90),
    ("q99", |s, _| s.q99),
    ("mean_speed", |_, m| m.mean_speed),
    ("max_speed", |_, m| m.max_speed),
    ("mean_jerk", |_, m| m.mean_jerk),
    ("idle_share", |_, m| m.idle_share),
];

/// Names of the statistics that a condition may ask of a dim.
pub const STATISTIC_NAMES: [&str; STATISTICS.len()] = {
    let mut names = [""; STATISTICS.len()];
    let mut i = 0;
    while i < names.len() {
        names[i] = STATISTICS[i].0;
        i += 1;
    }
    names
};

/// Returns what a condition can ask of each episode, by episode index. What costs a pass over the data is there only if
/// the condition asks for it, or for something unknown.
///
/// # Errors
/// The dataset cannot be scanned.
pub fn episode_values(
    input: &Input,
    condition: &Condition,
) -> Result<BTreeMap<i64, BTreeMap<String, EpisodeValue>>, EditError> {
    let dataset = &input.dataset;
    let mut values: BTreeMap<i64, BTreeMap<String, EpisodeValue>> = BTreeMap::new();
    for run in &dataset.runs {
        values.insert(run.episode_index, table_values(input, run));
    }
    // A column that only some episodes have is unknown in the others.
    let names: std::collections::BTreeSet<String> =
        values.values().flat_map(|episode| episode.keys().cloned()).collect();
    for episode in values.values_mut() {
        for name in &names {
            episode.entry(name.clone()).or_insert(EpisodeValue::Null);
        }
    }
    let is_unknown = |name: &str| !names.contains(name);
    let asks = |wanted: &[&str]| condition.mentions(|name| wanted.contains(&name));
    let asks_else =
        condition.mentions(|name| is_unknown(name) && !["errors", "warnings", "idle_share"].contains(&name));
    if condition.mentions(|name| name.contains('(')) || asks_else {
        add_statistics(input, &mut values)?;
    }
    if asks(&["errors", "warnings"]) || asks_else {
        add_findings(input, &mut values)?;
    }
    if asks(&["idle_share"]) || asks_else {
        for (episode, activity) in activity(&input.dataset, None)? {
            let share = 1.0 - activity.active_rows as f64 / activity.rows.max(1) as f64;
            if let Some(values) = values.get_mut(&episode) {
                values.insert("idle_share".to_owned(), EpisodeValue::Number(share));
            }
        }
    }
    Ok(values)
}

/// Returns what the episode table and the rows' numbers say.
fn table_values(input: &Input, run: &crate::read::Run) -> BTreeMap<String, EpisodeValue> {
    let dataset = &input.dataset;
    let number = |value: f64| EpisodeValue::Number(value);
    let mut values = BTreeMap::from([
        ("episode_index".to_owned(), number(run.episode_index as f64)),
        ("length".to_owned(), number(run.n_rows as f64)),
        ("duration_s".to_owned(), number(run.n_rows as f64 / dataset.info.fps)),
    ]);
    let entry = dataset.entry(run.episode_index);
    let task = entry.and_then(|entry| entry.tasks.first().cloned());
    values.insert("task".to_owned(), task.map_or(EpisodeValue::Null, EpisodeValue::Text));
    for (name, value) in entry.into_iter().flat_map(|entry| &entry.extras) {
        if name == "gawm/tags" {
            let tags = value.as_str().and_then(|text| serde_json::from_str::<Value>(text).ok());
            for (tag, value) in tags.as_ref().and_then(Value::as_object).into_iter().flatten() {
                values.insert(format!("tags.{tag}"), from_json(value));
            }
        } else {
            values.insert(name.clone(), from_json(value));
        }
    }
    if values.get("success_known") == Some(&EpisodeValue::Bool(false)) {
        values.insert("success".to_owned(), EpisodeValue::Null);
    }
    // The tables of gawm have empty texts for what nobody said.
    if input.gawm.is_some() {
        for name in ["operator", "robot", "session"] {
            if values.get(name) == Some(&EpisodeValue::Text(String::new())) {
                values.insert(name.to_owned(), EpisodeValue::Null);
            }
        }
    }
    values
}

fn from_json(value: &Value) -> EpisodeValue {
    match value {
        Value::Null => EpisodeValue::Null,
        Value::Bool(t) => EpisodeValue::Bool(*t),
        Value::Number(number) => number.as_f64().map_or(EpisodeValue::Null, EpisodeValue::Number),
        Value::String(text) => EpisodeValue::Text(text.clone()),
        other => EpisodeValue::Text(other.to_string()),
    }
}

fn add_statistics(
    input: &Input,
    values: &mut BTreeMap<i64, BTreeMap<String, EpisodeValue>>,
) -> Result<(), EditError> {
    let stats = dataset_stats(&input.dataset)?;
    for episode in &stats.episodes {
        let Some(values) = values.get_mut(&episode.episode) else { continue };
        for (column, dims) in &episode.columns {
            let names = stats.columns.iter().find(|c| c.name == *column).map(|c| &c.dims);
            for (i, dim) in dims.iter().enumerate() {
                let name = names.and_then(|names| names.get(i)).map_or("", |d| d.name.as_str());
                add_dim(values, column, i, name, dims.len(), dim);
            }
            // Of a column as a whole only what needs no dim: extremes and what is missing.
            let whole = |value: &dyn Fn(&EpisodeDim) -> f64, join: fn(f64, f64) -> f64| {
                EpisodeValue::Number(dims.iter().map(value).reduce(join).unwrap_or(0.0))
            };
            values.insert(format!("min({column})"), whole(&|d| d.values.min, f64::min));
            values.insert(format!("max({column})"), whole(&|d| d.values.max, f64::max));
            values.insert(format!("missing({column})"), whole(&|d| d.values.n_missing as f64, f64::max));
            values.insert(format!("max_speed({column})"), whole(&|d| d.motion.max_speed, f64::max));
        }
    }
    Ok(())
}

fn add_dim(
    values: &mut BTreeMap<String, EpisodeValue>,
    column: &str,
    position: usize,
    name: &str,
    width: usize,
    dim: &EpisodeDim,
) {
    for (statistic, value) in STATISTICS {
        let value = EpisodeValue::Number(value(&dim.values, &dim.motion));
        if width == 1 {
            values.insert(format!("{statistic}({column})"), value.clone());
        }
        values.insert(format!("{statistic}({column}[{position}])"), value.clone());
        if !name.is_empty() && name.parse::<usize>().is_err() {
            values.insert(format!("{statistic}({column}.{name})"), value);
        }
    }
}

fn add_findings(
    input: &Input,
    values: &mut BTreeMap<i64, BTreeMap<String, EpisodeValue>>,
) -> Result<(), EditError> {
    let options = ValidateOptions { max_listed: usize::MAX, ..ValidateOptions::default() };
    let report = validate(&input.dataset, &options)?;
    for (name, severity) in [("errors", Severity::Error), ("warnings", Severity::Warning)] {
        let mut counts: BTreeMap<i64, f64> = BTreeMap::new();
        let found = report.findings.iter().filter(|f| f.severity == severity);
        found.filter_map(|f| f.episode).for_each(|episode| *counts.entry(episode).or_default() += 1.0);
        for (episode, values) in values.iter_mut() {
            let count = counts.get(episode).copied().unwrap_or(0.0);
            values.insert(name.to_owned(), EpisodeValue::Number(count));
        }
    }
    Ok(())
}
