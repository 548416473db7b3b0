//! Checks that need one run and no comparison: nulls, widths, index chains, tasks, values that are not finite.

use super::{Finding, Severity};
use crate::read::{Column, ColumnValues, Dataset, EpisodeRows};

/// Checks one run.
pub(super) fn check_rows(dataset: &Dataset, rows: &EpisodeRows) -> Vec<Finding> {
    let mut findings = Vec::new();
    let episode = rows.run.episode_index;
    if rows.n_rows() < 2 {
        findings.push(
            Finding::new("STRUCT-022", format!("the episode has {} row", rows.n_rows()))
                .episode(episode)
                .measured(rows.n_rows() as f64, 2.0),
        );
    }
    for column in &rows.columns {
        check_presence(column, episode, &mut findings);
        check_finite(column, rows, episode, &mut findings);
    }
    if let Some(index) = rows.ints("index") {
        let start = rows.run.global_start as i64;
        chain("STRUCT-017", "index", index, start, episode, &mut findings);
    }
    if let Some(frame_index) = rows.ints("frame_index") {
        chain("STRUCT-018", "frame_index", frame_index, 0, episode, &mut findings);
    }
    if let Some(tasks) = rows.ints("task_index")
        && !dataset.tasks.is_empty()
    {
        let is_unknown = |t: &i64| usize::try_from(*t).map_or(true, |t| t >= dataset.tasks.len());
        if let Some(row) = tasks.iter().position(is_unknown) {
            let message = format!("task_index {} in a table of {} tasks", tasks[row], dataset.tasks.len());
            let n = tasks.iter().filter(|t| is_unknown(t)).count();
            findings.push(
                Finding::new("STRUCT-019", message).episode(episode).rows(row, row + n).feature("task_index"),
            );
        }
    }
    findings
}

fn check_presence(column: &Column, episode: i64, findings: &mut Vec<Finding>) {
    let notes = [
        ("STRUCT-010", &column.nulls, "null"),
        ("STRUCT-011", &column.wrong_widths, "a list of the wrong length"),
    ];
    for (code, notes, what) in notes {
        if let Some(first) = notes.first_rows.first() {
            let message = format!("{} rows of {} hold {what}", notes.n_rows, column.name);
            let end = notes.first_rows.last().unwrap_or(first) + 1;
            let finding = Finding::new(code, message).episode(episode).rows(*first as usize, end as usize);
            findings.push(finding.feature(&column.name).measured(notes.n_rows as f64, 0.0));
        }
    }
}

fn check_finite(column: &Column, rows: &EpisodeRows, episode: i64, findings: &mut Vec<Finding>) {
    let ColumnValues::Vector(dims) = &column.values else { return };
    // What is null or of the wrong length has its own finding.
    if column.nulls.n_rows + column.wrong_widths.n_rows > 0 || column.name == "timestamp" {
        return;
    }
    let is_clean =
        |values: &Vec<f64>| values.iter().sum::<f64>().is_finite() || values.iter().all(|v| v.is_finite());
    if dims.iter().all(is_clean) {
        return;
    }
    let n = rows.n_rows();
    let bad: Vec<usize> = (0..n).filter(|t| dims.iter().any(|d| !d[*t].is_finite())).collect();
    let Some((first, last)) = bad.first().zip(bad.last()) else { return };
    let n_nan = dims.iter().flatten().filter(|v| v.is_nan()).count();
    let n_infinite = dims.iter().flatten().filter(|v| v.is_infinite()).count();
    // The age of a sample that a stream does not have yet is NaN by the format.
    if n_infinite == 0
        && [crate::layout::AGE_MS, crate::layout::ARRIVAL_AGE_MS].contains(&column.name.as_str())
    {
        return;
    }
    let validity: Vec<&Vec<f64>> =
        rows.columns.iter().filter(|c| c.name.starts_with("gawm.valid")).flat_map(|c| c.dims()).collect();
    let is_masked =
        n_infinite == 0 && !validity.is_empty() && bad.iter().all(|t| validity.iter().any(|v| v[*t] == 0.0));
    let masked = if is_masked { ", all marked invalid; lerobot trains to NaN on them" } else { "" };
    let message = format!(
        "{} rows of {} hold {n_nan} NaN and {n_infinite} infinite values{masked}",
        bad.len(),
        column.name
    );
    let mut finding =
        Finding::new("VALUE-001", message).episode(episode).rows(*first, last + 1).feature(&column.name);
    if let Some(dim) = dims.iter().position(|d| !d[*first].is_finite()).filter(|_| dims.len() > 1) {
        finding = finding.dim(&dim.to_string());
    }
    if is_masked {
        finding = finding.at(Severity::Warning);
    }
    findings.push(finding.measured(bad.len() as f64, 0.0));
}

/// Checks that `values` count up by one from `start`.
fn chain(
    code: &'static str,
    name: &str,
    values: &[i64],
    start: i64,
    episode: i64,
    findings: &mut Vec<Finding>,
) {
    let is_broken = |(t, v): &(usize, &i64)| **v != start.wrapping_add(*t as i64);
    let Some((row, value)) = values.iter().enumerate().find(is_broken) else { return };
    let n = values.windows(2).filter(|w| w[1] != w[0].wrapping_add(1)).count();
    let message = format!(
        "{name} is {value} in row {row} where {} is expected; {n} breaks in the episode",
        start + row as i64
    );
    findings.push(
        Finding::new(code, message).episode(episode).rows(row, row + 1).feature(name).measured(n as f64, 0.0),
    );
}
