//! Layouts where every episode has arrays of its own: groups, numbered names, one file.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::{Episode, EpisodeEnd, Episodes, LayoutError, classify, is_action, readable};
use crate::tabular::column::Column;
use crate::tabular::finding::{Finding, FindingKind};
use crate::tabular::{Dtype, Table};

/// A column of one episode: the name in a contract, and the column.
type Named<'a> = (Arc<str>, &'a Column);

/// One group per episode: `parent/prefixN/...`.
pub(crate) fn groups(
    table: &Table,
    parent: &str,
    prefix: &str,
    found: &mut Episodes,
) -> Result<(), LayoutError> {
    let base = if parent.is_empty() { String::new() } else { format!("{parent}/") };
    let mut episodes: BTreeMap<u64, (String, Vec<Named<'_>>)> = BTreeMap::new();
    for column in readable(table) {
        let Some((group, name)) = column.path.strip_prefix(&base).and_then(|rest| rest.split_once('/'))
        else {
            continue;
        };
        let Some(number) = number_after(group, prefix) else { continue };
        let (_, columns) = episodes.entry(number).or_insert_with(|| (format!("{base}{group}"), Vec::new()));
        columns.push((Arc::from(name), column));
    }
    if episodes.is_empty() {
        let detail = format!(
            "expected groups named {base}{prefix}0, {base}{prefix}1, ..., got none with readable data"
        );
        return Err(LayoutError::DoesNotFit { layout: "groups", detail });
    }
    report_unlisted_groups(table, &base, prefix, &episodes, found);
    for (number, (group, columns)) in episodes {
        let name = group.strip_prefix(&base).unwrap_or(&group).to_owned();
        push(name, Some(number), Some(group), columns, None, found);
    }
    Ok(())
}

/// A group of an episode without one readable array is an episode lost.
fn report_unlisted_groups(
    table: &Table,
    base: &str,
    prefix: &str,
    episodes: &BTreeMap<u64, (String, Vec<Named<'_>>)>,
    found: &mut Episodes,
) {
    for group in table.groups().keys() {
        let Some(name) = group.strip_prefix(base).filter(|n| !n.contains('/')) else { continue };
        if number_after(name, prefix).is_some_and(|n| !episodes.contains_key(&n)) {
            let detail = "the group has no array that can be read";
            found.findings.push(Finding::new(FindingKind::EmptyEpisode, group.as_str(), detail));
        }
    }
}

/// One array per column and episode: `columnN`.
pub(crate) fn suffixed(table: &Table, separator: &str, found: &mut Episodes) -> Result<(), LayoutError> {
    let mut episodes: BTreeMap<u64, Vec<Named<'_>>> = BTreeMap::new();
    let mut shared: Vec<Named<'_>> = Vec::new();
    for column in readable(table) {
        match split_number(&column.path, separator) {
            Some((stem, number)) => episodes.entry(number).or_default().push((Arc::from(stem), column)),
            None => shared.push((Arc::from(column.path.as_str()), column)),
        }
    }
    if episodes.is_empty() {
        let detail = format!("expected arrays named like actions{separator}0, got none");
        return Err(LayoutError::DoesNotFit { layout: "suffixed", detail });
    }
    for (number, columns) in episodes {
        let constants = shared.iter().filter(|(_, c)| c.rows().is_none_or(|n| n == 1)).cloned();
        push(
            number.to_string(),
            Some(number),
            None,
            columns.into_iter().chain(constants).collect(),
            None,
            found,
        );
    }
    for (name, column) in &shared {
        if column.rows().is_some_and(|n| n != 1) {
            let detail = "has no episode number in its name, so it belongs to no episode";
            found.findings.push(Finding::new(FindingKind::LengthMismatch, &**name, detail));
        }
    }
    Ok(())
}

/// The whole file is one episode.
pub(crate) fn single(table: &Table, steps: Option<&str>, found: &mut Episodes) -> Result<(), LayoutError> {
    let columns: Vec<Named<'_>> = readable(table).map(|c| (Arc::from(c.path.as_str()), c)).collect();
    let stated = match steps {
        Some(path) => match table.column(path).and_then(Column::rows) {
            Some(rows) => Some(rows),
            None => {
                let detail = format!("expected the column {path:?} with rows, got none");
                return Err(LayoutError::DoesNotFit { layout: "single", detail });
            }
        },
        None => None,
    };
    if stated.is_none() && columns.iter().all(|(_, c)| c.rows().is_none_or(|n| n < 2)) {
        let detail = "expected an array with at least 2 rows, got only constants".to_owned();
        return Err(LayoutError::DoesNotFit { layout: "single", detail });
    }
    push("0".to_owned(), None, None, columns, stated, found);
    report_ends_inside(table, found);
    Ok(())
}

/// Adds one episode made of whole arrays.
fn push(
    name: String,
    number: Option<u64>,
    group: Option<String>,
    columns: Vec<Named<'_>>,
    stated: Option<u64>,
    found: &mut Episodes,
) {
    let place = group
        .clone()
        .unwrap_or_else(|| if number.is_some() { format!("episode {name}") } else { String::new() });
    let steps = stated.unwrap_or_else(|| step_count(&place, &columns, found));
    report_chunked_action(&place, steps, &columns, found);
    let readable_rows = columns
        .iter()
        .filter(|(_, c)| c.rows().is_some_and(|n| n >= steps && n <= steps.saturating_add(1)))
        .fold(steps, |n, (_, c)| n.min(c.readable_rows));
    let listed = columns.into_iter().map(|(name, c)| {
        // A cut column keeps the length that its header gives, so that it still counts as one row per step.
        (name, Arc::from(c.path.as_str()), c.rows())
    });
    let columns = classify(&place, steps, listed, &mut found.findings);
    let mut episode = Episode { name, number, steps, end: EpisodeEnd::Listed, group, columns };
    if readable_rows < steps {
        let detail = format!("expected {steps} rows, got {readable_rows} in the file: kept apart");
        found.findings.push(Finding::new(FindingKind::EpisodeCut, &place, detail));
        cut(&mut episode, readable_rows);
        if readable_rows > 0 {
            found.unfinished.push(episode);
        }
    } else if steps == 0 {
        found.findings.push(Finding::new(FindingKind::EmptyEpisode, &place, "expected rows, got 0"));
    } else {
        found.episodes.push(episode);
    }
}

/// Shortens an episode to the rows that are in the file.
pub(super) fn cut(episode: &mut Episode, rows: u64) {
    episode.end = EpisodeEnd::Cut;
    episode.steps = rows;
    for column in episode.columns.values_mut().filter(|c| c.extent.has_steps()) {
        column.rows = rows;
        column.extent = super::Extent::Steps;
    }
}

/// Steps are the rows of the action; without one, the length that most arrays have.
fn step_count(place: &str, columns: &[Named<'_>], found: &mut Episodes) -> u64 {
    // `obs/actions` is a copy; the action proper is the one with the shortest path.
    let action = columns
        .iter()
        .filter(|(name, c)| is_action(name) && c.rows().is_some())
        .min_by_key(|(name, _)| name.matches('/').count());
    if let Some(rows) = action.and_then(|(_, c)| c.rows()) {
        return rows;
    }
    let mut counts: BTreeMap<u64, usize> = BTreeMap::new();
    for rows in columns.iter().filter_map(|(_, c)| c.rows()).filter(|&n| n > 1) {
        *counts.entry(rows).or_default() += 1;
    }
    let steps = counts.into_iter().max_by_key(|&(rows, n)| (n, rows)).map_or(0, |(rows, _)| rows);
    let detail = format!("no array is named like an action; {steps} steps taken from the other arrays");
    found.findings.push(Finding::new(
        FindingKind::NoAction,
        if place.is_empty() { "/" } else { place },
        detail,
    ));
    steps
}

/// `action_sequence` of N x 16 x 2 is 16 future steps in every row: a set of samples, not a recording.
fn report_chunked_action(place: &str, steps: u64, columns: &[Named<'_>], found: &mut Episodes) {
    for (name, column) in columns {
        let is_chunk = column.shape.len() == 3
            && column.shape[0] == steps
            && name.to_ascii_lowercase().contains("action");
        if is_chunk && column.dtype != Dtype::U8 {
            let detail = format!(
                "every row holds {} steps of {} values: these may be training samples, not consecutive steps",
                column.shape[1], column.shape[2]
            );
            let at = if place.is_empty() { column.path.clone() } else { format!("{place}: {name}") };
            found.findings.push(Finding::new(FindingKind::ChunkedAction, at, detail));
        }
    }
}

/// Marks before the last row say that the file holds more than one episode.
fn report_ends_inside(table: &Table, found: &mut Episodes) {
    let Some(episode) = found.episodes.first() else { return };
    for name in super::detect::TERMINALS.iter().chain(&super::detect::TIMEOUTS) {
        let Some(column) = episode.columns.get(*name).filter(|c| c.rows == episode.steps) else { continue };
        let Ok(marks) = super::read_integers(table, &column.path) else { continue };
        let inside = marks.iter().rev().skip(1).filter(|&&m| m != 0).count();
        if inside > 0 {
            let detail = format!("{inside} marks before the last row: the file may hold several episodes");
            found.findings.push(Finding::new(FindingKind::EndInside, *name, detail));
        }
    }
}

/// Returns the number in `prefixN`.
pub(super) fn number_after(name: &str, prefix: &str) -> Option<u64> {
    let digits = name.strip_prefix(prefix)?;
    let is_number = !digits.is_empty() && digits.bytes().all(|b| b.is_ascii_digit());
    is_number.then(|| digits.parse().ok()).flatten()
}

/// Splits `actions_12` into `actions` and 12.
pub(super) fn split_number<'a>(name: &'a str, separator: &str) -> Option<(&'a str, u64)> {
    let stem = name.trim_end_matches(|c: char| c.is_ascii_digit());
    let number = name[stem.len()..].parse().ok()?;
    let stem = stem.strip_suffix(separator)?;
    (!stem.is_empty()).then_some((stem, number))
}
