//! Which layout a file has.

use std::collections::BTreeMap;

use super::named::split_number;
use super::{Layout, LayoutError, is_action, read_integers, readable};
use crate::tabular::Table;

/// Names of columns that mark the last row of an episode that ended.
pub(crate) const TERMINALS: [&str; 4] = ["terminals", "dones", "done", "terminated"];
/// Names of columns that mark the last row of an episode that was stopped.
pub(crate) const TIMEOUTS: [&str; 4] = ["timeouts", "timeout", "truncated", "truncateds"];

/// Finds the layout, the most telling one first.
pub(crate) fn layout(table: &Table) -> Result<Layout, LayoutError> {
    flat(table)
        .or_else(|| groups(table))
        .or_else(|| suffixed(table))
        .or_else(|| terminals(table))
        .or_else(|| single(table))
        .ok_or_else(|| {
            let names: Vec<&str> = table.columns().iter().map(|c| c.path.as_str()).take(12).collect();
            LayoutError::Unknown { columns: names.join(", ") }
        })
}

/// Names of the columns of lengths and of first rows that recorders use.
const INDICES: [(&str, &str); 3] =
    [("ep_len", "ep_offset"), ("episode_lengths", "episode_starts"), ("episode_length", "episode_start")];

fn flat(table: &Table) -> Option<Layout> {
    let has = |name: &str| table.column(name).is_some();
    let (lengths, offsets) = INDICES.into_iter().find(|(lengths, offsets)| has(lengths) && has(offsets))?;
    Some(Layout::Flat {
        lengths: lengths.to_owned(),
        offsets: offsets.to_owned(),
        episode: has("ep_idx").then(|| "ep_idx".to_owned()),
        step: has("step_idx").then(|| "step_idx".to_owned()),
    })
}

/// Numbered groups under `data`, else under the root; the prefix with the most arrays wins.
fn groups(table: &Table) -> Option<Layout> {
    ["data", ""].into_iter().find_map(|parent| {
        let base = if parent.is_empty() { String::new() } else { format!("{parent}/") };
        let mut prefixes: BTreeMap<&str, usize> = BTreeMap::new();
        for column in readable(table) {
            let group =
                column.path.strip_prefix(&base).and_then(|rest| rest.split_once('/')).map(|(group, _)| group);
            let Some(group) = group else { continue };
            let prefix = group.trim_end_matches(|c: char| c.is_ascii_digit());
            if prefix.len() < group.len() {
                *prefixes.entry(prefix).or_default() += 1;
            }
        }
        let prefix = prefixes.into_iter().max_by_key(|&(_, n)| n)?.0;
        Some(Layout::Groups { parent: parent.to_owned(), prefix: prefix.to_owned() })
    })
}

/// Every array with rows ends in a number, and every number has the same names, an action among them.
fn suffixed(table: &Table) -> Option<Layout> {
    let mut stems: BTreeMap<u64, Vec<&str>> = BTreeMap::new();
    for column in readable(table).filter(|c| c.rows().is_some_and(|n| n > 1)) {
        let (stem, number) = split_number(&column.path, "_")?;
        stems.entry(number).or_default().push(stem);
    }
    let first = stems.values().next()?;
    let has_action = first.iter().any(|stem| is_action(stem));
    let is_regular = stems.values().all(|s| s == first);
    (has_action && is_regular).then(|| Layout::Suffixed { separator: super::underscore() })
}

/// Marks as long as the action, at least one of them set, and no array one row longer (that is one episode).
fn terminals(table: &Table) -> Option<Layout> {
    let action = readable(table).find(|c| is_action(&c.path) && !c.path.contains('/'))?.rows()?;
    let marks = |names: &[&str]| {
        let is_mark = |name: &&&str| {
            table.column(name).is_some_and(|c| c.problem.is_none() && c.rows() == Some(action))
        };
        names.iter().find(is_mark).map(|name| (*name).to_owned())
    };
    let terminals = marks(&TERMINALS)?;
    let timeouts = marks(&TIMEOUTS);
    if readable(table).any(|c| c.rows() == action.checked_add(1)) {
        return None;
    }
    let is_set = |path: &String| read_integers(table, path).is_ok_and(|m| m.iter().any(|&m| m != 0));
    (is_set(&terminals) || timeouts.as_ref().is_some_and(is_set))
        .then_some(Layout::Terminals { terminals, timeouts })
}

/// Arrays without groups, at least one of them with rows.
fn single(table: &Table) -> Option<Layout> {
    readable(table).any(|c| c.rows().is_some_and(|n| n > 1)).then_some(Layout::Single { steps: None })
}
