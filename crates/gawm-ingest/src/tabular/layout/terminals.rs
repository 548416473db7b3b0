//! Flat arrays with marks on last rows, as D4RL stores them.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{
    ColumnRows, Episode, EpisodeEnd, Episodes, Extent, LayoutError, check_count, read_integers, readable,
};
use crate::tabular::Table;
use crate::tabular::finding::{Finding, FindingKind};

/// A column with a row per step, and how many of its rows can be read.
type StepColumn = (Arc<str>, u64);

/// Cuts the rows after every mark; what follows the last one is unfinished.
pub(crate) fn find(
    table: &Table,
    terminals: &str,
    timeouts: Option<&str>,
    found: &mut Episodes,
) -> Result<(), LayoutError> {
    let ends = read_integers(table, terminals)?;
    let stops = match timeouts {
        Some(path) => read_integers(table, path)?,
        None => Vec::new(),
    };
    let rows = ends.len() as u64;
    if timeouts.is_some() && stops.len() != ends.len() {
        let detail = format!("expected {rows} timeouts, one per terminal, got {}", stops.len());
        return Err(LayoutError::DoesNotFit { layout: "terminals", detail });
    }
    let n_stored = table.column(terminals).and_then(|c| c.rows()).unwrap_or(rows);
    let (columns, constants) = split_columns(table, n_stored, found);
    let rows = columns.iter().fold(rows, |n, (_, readable)| n.min(*readable));
    if rows < n_stored {
        let detail = format!("{rows} of {n_stored} rows are in the file");
        found.findings.push(Finding::new(FindingKind::EpisodeCut, terminals, detail));
    }
    let n_marks =
        (0..ends.len()).filter(|&at| ends[at] != 0 || stops.get(at).is_some_and(|&s| s != 0)).count();
    check_count(n_marks, columns.len() + constants.len())?;
    let mut start = 0;
    for row in 0..rows {
        let at = row as usize;
        let end = match (ends[at] != 0, stops.get(at).is_some_and(|&s| s != 0)) {
            (true, _) => EpisodeEnd::Terminal,
            (false, true) => EpisodeEnd::Timeout,
            (false, false) => continue,
        };
        let number = found.episodes.len() as u64;
        found.episodes.push(episode(number, start..row + 1, end, &columns, &constants));
        start = row + 1;
    }
    if start < rows {
        let detail = format!(
            "rows {start}..{rows} follow the last mark: an unfinished episode of {} rows, kept apart",
            rows - start
        );
        found.findings.push(Finding::new(FindingKind::UnfinishedTail, terminals, detail));
        let number = found.episodes.len() as u64;
        found.unfinished.push(episode(number, start..rows, EpisodeEnd::Open, &columns, &constants));
    }
    Ok(())
}

/// Columns with a row per step, with the rows that can be read; and constants.
fn split_columns(table: &Table, rows: u64, found: &mut Episodes) -> (Vec<StepColumn>, Vec<Arc<str>>) {
    let (mut columns, mut constants) = (Vec::new(), Vec::new());
    for column in readable(table) {
        let path: Arc<str> = Arc::from(column.path.as_str());
        match column.rows() {
            Some(n) if n == rows => columns.push((path, column.readable_rows)),
            None | Some(1) => constants.push(path),
            Some(n) => {
                let detail = format!("expected {rows} rows, got {n}: it belongs to no episode");
                found.findings.push(Finding::new(FindingKind::LengthMismatch, &*path, detail));
            }
        }
    }
    (columns, constants)
}

fn episode(
    number: u64,
    rows: std::ops::Range<u64>,
    end: EpisodeEnd,
    columns: &[StepColumn],
    constants: &[Arc<str>],
) -> Episode {
    let steps = rows.end - rows.start;
    let one = |path: &Arc<str>, start, rows, extent| {
        (Arc::clone(path), ColumnRows { path: Arc::clone(path), start, rows, extent })
    };
    let mut all: BTreeMap<_, _> =
        columns.iter().map(|(p, _)| one(p, rows.start, steps, Extent::Steps)).collect();
    all.extend(constants.iter().map(|p| one(p, 0, 1, Extent::Constant)));
    Episode { name: number.to_string(), number: Some(number), steps, end, group: None, columns: all }
}
