//! Rows of all episodes one after another, with lengths and first rows, as stable-worldmodel stores them.

use std::collections::BTreeMap;
use std::ops::Range;
use std::sync::Arc;

use super::named::cut;
use super::{
    ColumnRows, Episode, EpisodeEnd, Episodes, Extent, LayoutError, check_count, read_integers, readable,
};
use crate::tabular::Table;
use crate::tabular::finding::{Finding, FindingKind};

/// The columns that say where episodes lie.
pub(crate) struct IndexColumns<'a> {
    pub(crate) lengths: &'a str,
    pub(crate) offsets: &'a str,
    pub(crate) episode: Option<&'a str>,
    pub(crate) step: Option<&'a str>,
}

/// The columns of the file by what a row of them is.
struct Parts {
    /// One row per step.
    steps: Vec<Arc<str>>,
    /// One row per episode.
    per_episode: Vec<Arc<str>>,
    /// One row, or none.
    constants: Vec<Arc<str>>,
    /// Rows that the column headers promise.
    rows: u64,
    /// Rows that every column has in the file.
    readable_rows: u64,
}

/// Takes the episodes that the index lists; rows that it does not list are unfinished.
pub(crate) fn find(table: &Table, index: &IndexColumns<'_>, found: &mut Episodes) -> Result<(), LayoutError> {
    let lengths = read_integers(table, index.lengths)?;
    let offsets = read_integers(table, index.offsets)?;
    if lengths.len() != offsets.len() {
        let detail = format!("{} lengths, {} offsets", lengths.len(), offsets.len());
        note(found, FindingKind::InconsistentIndex, index.lengths, detail);
    }
    let parts = split_columns(table, index, lengths.len().min(offsets.len()) as u64, found);
    let n_columns = parts.steps.len() + parts.per_episode.len() + parts.constants.len();
    check_count(lengths.len(), n_columns)?;
    let mut listed_end = 0;
    for (number, (&length, &offset)) in lengths.iter().zip(&offsets).enumerate() {
        let rows = u64::try_from(offset).ok().zip(u64::try_from(length).ok());
        let rows = rows.and_then(|(o, l)| Some(o..o.checked_add(l)?));
        match rows {
            Some(rows) => {
                if rows.start < listed_end {
                    let detail = format!(
                        "starts at row {}, before the end of the one before it at {listed_end}",
                        rows.start
                    );
                    note(found, FindingKind::InconsistentIndex, &format!("episode {number}"), detail);
                }
                listed_end = listed_end.max(rows.end);
                push(number as u64, rows, EpisodeEnd::Listed, &parts, found);
            }
            None => {
                let detail =
                    format!("expected rows inside the file, got offset {offset} and length {length}");
                note(found, FindingKind::InconsistentIndex, &format!("episode {number}"), detail);
            }
        }
    }
    check_rows(table, index, found)?;
    unlisted_rows(table, index, &parts, listed_end, found)
}

fn note(found: &mut Episodes, kind: FindingKind, place: &str, detail: String) {
    found.findings.push(Finding::new(kind, place, detail));
}

fn split_columns(table: &Table, index: &IndexColumns<'_>, n_episodes: u64, found: &mut Episodes) -> Parts {
    let rows = row_count(table, index, n_episodes);
    let mut parts = Parts {
        steps: Vec::new(),
        per_episode: Vec::new(),
        constants: Vec::new(),
        rows,
        readable_rows: rows,
    };
    for column in readable(table).filter(|c| c.path != index.lengths && c.path != index.offsets) {
        let path: Arc<str> = Arc::from(column.path.as_str());
        match column.rows() {
            // A killed writer may have grown some columns further than others.
            Some(n) if n == rows || (table.is_unclean() && n != n_episodes && n > 0) => {
                if column.readable_rows == 0 && rows > 0 {
                    note(
                        found,
                        FindingKind::UnflushedRows,
                        &path,
                        "none of its rows are in the file: left out".to_owned(),
                    );
                } else {
                    parts.readable_rows = parts.readable_rows.min(column.readable_rows);
                    parts.steps.push(path);
                }
            }
            Some(n) if n == n_episodes => parts.per_episode.push(path),
            None | Some(1) => parts.constants.push(path),
            Some(n) => {
                let detail = format!(
                    "expected {rows} rows, or {n_episodes}, one per episode, got {n}: it belongs to no episode"
                );
                note(found, FindingKind::LengthMismatch, &path, detail);
            }
        }
    }
    parts
}

/// Rows are those of the step column; without one, the length that most columns have.
fn row_count(table: &Table, index: &IndexColumns<'_>, n_episodes: u64) -> u64 {
    let of = |path: Option<&str>| path.and_then(|p| table.column(p)).and_then(|c| c.rows());
    if let Some(rows) = of(index.step).or_else(|| of(index.episode)) {
        return rows;
    }
    let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
    for rows in readable(table).filter_map(|c| c.rows()).filter(|&n| n != n_episodes) {
        *counts.entry(rows).or_default() += 1;
    }
    counts.into_iter().max_by_key(|&(rows, n)| (n, rows)).map_or(n_episodes, |(rows, _)| rows)
}

fn push(number: u64, rows: Range<u64>, end: EpisodeEnd, parts: &Parts, found: &mut Episodes) {
    let place = format!("episode {number}");
    let steps = rows.end - rows.start;
    if steps == 0 {
        note(found, FindingKind::EmptyEpisode, &place, "expected rows, got 0".to_owned());
        return;
    }
    let one = |path: &Arc<str>, start, rows, extent| {
        (Arc::clone(path), ColumnRows { path: Arc::clone(path), start, rows, extent })
    };
    let mut columns: BTreeMap<_, _> =
        parts.steps.iter().map(|p| one(p, rows.start, steps, Extent::Steps)).collect();
    if end == EpisodeEnd::Listed {
        columns.extend(parts.per_episode.iter().map(|p| one(p, number, 1, Extent::Constant)));
    }
    columns.extend(parts.constants.iter().map(|p| one(p, 0, 1, Extent::Constant)));
    let mut episode =
        Episode { name: number.to_string(), number: Some(number), steps, end, group: None, columns };
    let in_file = parts.readable_rows.saturating_sub(rows.start).min(steps);
    if in_file < steps {
        let detail = format!(
            "expected rows {}..{}, got {} rows in the file: kept apart",
            rows.start, rows.end, parts.readable_rows
        );
        note(found, FindingKind::EpisodeCut, &place, detail);
        cut(&mut episode, in_file);
        if in_file > 0 {
            found.unfinished.push(episode);
        }
    } else if end == EpisodeEnd::Open {
        found.unfinished.push(episode);
    } else {
        found.episodes.push(episode);
    }
}

/// Compares the episode and step of every row with the list; a lost chunk shows here as zeros.
fn check_rows(table: &Table, index: &IndexColumns<'_>, found: &mut Episodes) -> Result<(), LayoutError> {
    let read = |path: Option<&str>| match path.filter(|p| table.column(p).is_some()) {
        Some(path) => read_integers(table, path).map(Some),
        None => Ok(None),
    };
    let (numbers, steps) = (read(index.episode)?, read(index.step)?);
    if numbers.is_none() && steps.is_none() {
        return Ok(());
    }
    let mut notes = Vec::new();
    for episode in found.episodes.iter().chain(&found.unfinished) {
        let (Some(number), Some(start)) =
            (episode.number, episode.columns.values().find(|c| c.extent.has_steps()))
        else {
            continue;
        };
        let start = start.start as usize;
        for step in 0..episode.steps as usize {
            let is_other = |v: &Option<Vec<i64>>, expected: i64| {
                v.as_ref().and_then(|v| v.get(start + step)).is_some_and(|&got| got != expected)
            };
            if is_other(&numbers, number as i64) || is_other(&steps, step as i64) {
                let got = |v: &Option<Vec<i64>>| {
                    v.as_ref()
                        .and_then(|v| v.get(start + step))
                        .map_or("none".to_owned(), ToString::to_string)
                };
                notes.push(Finding::new(
                    FindingKind::InconsistentIndex,
                    format!("episode {number}"),
                    format!(
                        "row {}: expected episode {number} step {step}, got episode {} step {}",
                        start + step,
                        got(&numbers),
                        got(&steps)
                    ),
                ));
                break;
            }
        }
    }
    found.findings.extend(notes);
    Ok(())
}

/// Rows after the last listed episode: what a killed writer was recording.
fn unlisted_rows(
    table: &Table,
    index: &IndexColumns<'_>,
    parts: &Parts,
    listed_end: u64,
    found: &mut Episodes,
) -> Result<(), LayoutError> {
    let rows = parts.rows.min(parts.readable_rows);
    if listed_end >= rows {
        return Ok(());
    }
    let detail = format!("rows {listed_end}..{rows} belong to no listed episode: unfinished, kept apart");
    note(found, FindingKind::UnfinishedTail, index.lengths, detail);
    let numbers = match index.episode.filter(|p| table.column(p).is_some()) {
        Some(path) => read_integers(table, path)?,
        None => Vec::new(),
    };
    if numbers.is_empty() {
        let next = (found.episodes.len() + found.unfinished.len()) as u64;
        push(next, listed_end..rows, EpisodeEnd::Open, parts, found);
        return Ok(());
    }
    let mut start = listed_end;
    for row in listed_end + 1..=rows {
        let number = |row: u64| numbers.get(row as usize).copied();
        if row == rows || number(row) != number(start) {
            let named = number(start).and_then(|n| u64::try_from(n).ok());
            let named = named.unwrap_or((found.episodes.len() + found.unfinished.len()) as u64);
            push(named, start..row, EpisodeEnd::Open, parts, found);
            check_count(found.unfinished.len(), parts.steps.len() + parts.constants.len())?;
            start = row;
        }
    }
    Ok(())
}
