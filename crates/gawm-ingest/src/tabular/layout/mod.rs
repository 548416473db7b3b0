//! How episodes lie in a file.
//!
//! | layout | looks like | met in |
//! |---|---|---|
//! | `flat` | `ep_len`, `ep_offset`, one array per column with the rows of all episodes | stable-worldmodel |
//! | `groups` | `data/demo_0/actions`, `demo_0/action` | robomimic, Isaac Lab |
//! | `suffixed` | `actions_0`, `states_0`, `actions_1` | hand-written recorders |
//! | `terminals` | `actions`, `observations`, `terminals`, `timeouts` | D4RL |
//! | `single` | one array per column, one episode per file | npz |
//!
//! Nothing is cut in silence: an unfinished tail is an episode of its own ([`Episodes::unfinished`]), the one
//! observation more than actions stays in the column ([`Extent::StepsAndFinal`]), and both are findings.

mod detect;
mod flat;
mod named;
mod terminals;

use std::collections::BTreeMap;
use std::sync::Arc;

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::column::Column;
use super::error::ReadError;
use super::finding::{Finding, FindingKind};
use super::{Table, Values};

/// A way to lay episodes out; stated in a contract as `{ kind = "groups", parent = "data", prefix = "demo_" }`.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(tag = "kind", rename_all = "snake_case", deny_unknown_fields)]
pub enum Layout {
    /// Rows of all episodes one after another, with the episodes' lengths and first rows.
    Flat {
        /// Column of lengths, one per episode.
        #[serde(default = "ep_len")]
        lengths: String,
        /// Column of first rows, one per episode.
        #[serde(default = "ep_offset")]
        offsets: String,
        /// Column of the episode's number in every row; checked, if there is one.
        #[serde(default = "ep_idx")]
        episode: Option<String>,
        /// Column of the step in every row; checked, if there is one.
        #[serde(default = "step_idx")]
        step: Option<String>,
    },
    /// One group per episode.
    Groups {
        /// Group of the episodes' groups; empty for the root.
        #[serde(default)]
        parent: String,
        /// Text before the number of an episode's group.
        prefix: String,
    },
    /// One array per column and episode, the episode's number at the end of the name.
    Suffixed {
        /// Text between a column's name and the number.
        #[serde(default = "underscore")]
        separator: String,
    },
    /// Rows of all episodes one after another, with marks on last rows.
    Terminals {
        /// Column that is true on the last row of an episode that ended.
        terminals: String,
        /// Column that is true on the last row of an episode that was stopped.
        #[serde(default)]
        timeouts: Option<String>,
    },
    /// The file is one episode.
    Single {
        /// Column whose length is the number of steps; found by its name (`actions`, ...) if not stated.
        #[serde(default)]
        steps: Option<String>,
    },
}

fn ep_len() -> String {
    "ep_len".to_owned()
}
fn ep_offset() -> String {
    "ep_offset".to_owned()
}
#[expect(clippy::unnecessary_wraps, reason = "the default of an optional field")]
fn ep_idx() -> Option<String> {
    Some("ep_idx".to_owned())
}
#[expect(clippy::unnecessary_wraps, reason = "the default of an optional field")]
fn step_idx() -> Option<String> {
    Some("step_idx".to_owned())
}
fn underscore() -> String {
    "_".to_owned()
}

impl Layout {
    /// Returns the layout's name, as in `kind`.
    pub fn name(&self) -> &'static str {
        match self {
            Self::Flat { .. } => "flat",
            Self::Groups { .. } => "groups",
            Self::Suffixed { .. } => "suffixed",
            Self::Terminals { .. } => "terminals",
            Self::Single { .. } => "single",
        }
    }
}

/// The episodes of a file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Episodes {
    /// The layout that was found or stated.
    pub layout: Layout,
    /// Episodes that have an end, in the file's order (by number, for named ones).
    pub episodes: Vec<Episode>,
    /// Episodes without an end, or with rows that are not in the file: kept apart.
    pub unfinished: Vec<Episode>,
    /// What was noticed.
    pub findings: Vec<Finding>,
}

impl Episodes {
    /// Returns the steps of all finished episodes.
    pub fn rows(&self) -> u64 {
        self.episodes.iter().fold(0, |n, e| n.saturating_add(e.steps))
    }

    /// Returns the names of columns that have a value per step in every episode.
    pub fn step_columns(&self) -> Vec<Arc<str>> {
        let mut all = self.episodes.iter().chain(&self.unfinished);
        let Some(first) = all.next() else { return Vec::new() };
        let has = |e: &Episode, name: &Arc<str>| e.columns.get(name).is_some_and(|c| c.extent.has_steps());
        let rest: Vec<&Episode> = all.collect();
        first.columns.keys().filter(|&n| has(first, n) && rest.iter().all(|e| has(e, n))).cloned().collect()
    }
}

/// One episode: which rows of which columns it has.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Episode {
    /// Its name in the file: a group, or a number.
    pub name: String,
    /// Its number, when the file gives one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub number: Option<u64>,
    /// Rows with an action, or rows of the states when there is no action.
    pub steps: u64,
    /// How it ends.
    pub end: EpisodeEnd,
    /// The group whose attributes describe it ([`Table::groups`]).
    #[serde(skip_serializing_if = "Option::is_none")]
    pub group: Option<String>,
    /// Columns by the name that a contract uses: the path without what names the episode.
    #[serde(serialize_with = "by_name")]
    pub columns: BTreeMap<Arc<str>, ColumnRows>,
}

fn by_name<S: serde::Serializer>(columns: &BTreeMap<Arc<str>, ColumnRows>, s: S) -> Result<S::Ok, S::Error> {
    s.collect_map(columns.iter().map(|(name, rows)| (&**name, rows)))
}

fn as_str<S: serde::Serializer>(text: &Arc<str>, s: S) -> Result<S::Ok, S::Error> {
    s.serialize_str(text)
}

/// How an episode ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum EpisodeEnd {
    /// The file lists its length, or holds it as an array of its own.
    Listed,
    /// The row is marked as terminal.
    Terminal,
    /// The row is marked as stopped.
    Timeout,
    /// The rows end without a mark.
    Open,
    /// Later rows are not in the file.
    Cut,
}

/// The rows of one column that belong to an episode.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct ColumnRows {
    /// The column in the file.
    #[serde(serialize_with = "as_str")]
    pub path: Arc<str>,
    /// First row.
    pub start: u64,
    /// Rows, the final observation included.
    pub rows: u64,
    /// How the rows relate to the steps.
    pub extent: Extent,
}

/// How the rows of a column relate to the steps of its episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Extent {
    /// One row per step.
    Steps,
    /// One row per step, and one after the last step.
    StepsAndFinal,
    /// One value for the whole episode (a scalar, or one row).
    Constant,
    /// A length that fits neither.
    Unmatched,
}

impl Extent {
    /// Returns whether every step has a row.
    pub fn has_steps(self) -> bool {
        matches!(self, Self::Steps | Self::StepsAndFinal)
    }
}

/// Why no episodes were found.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum LayoutError {
    /// No column can be read.
    #[error("no column can be read; the first: {first}")]
    NothingReadable {
        /// Why the first one cannot.
        first: ReadError,
    },
    /// The file has no columns.
    #[error("the file has no arrays")]
    NoColumns,
    /// All arrays are empty.
    #[error("the arrays have no rows")]
    NoRows,
    /// No layout fits.
    #[error(
        "no episode layout fits: expected flat, groups, suffixed, terminals or single, got the columns {columns}"
    )]
    Unknown {
        /// The columns there are, shortened.
        columns: String,
    },
    /// The stated layout does not fit.
    #[error("layout {layout:?} does not fit: {detail}")]
    DoesNotFit {
        /// The layout's name.
        layout: &'static str,
        /// What was expected and found.
        detail: String,
    },
    /// More episodes than a recording has.
    #[error("too many episodes: expected at most {limit} episodes times columns, got {got}")]
    TooMany {
        /// The limit.
        limit: u64,
        /// What the file says.
        got: u64,
    },
    /// A column that says where episodes begin cannot be read.
    #[error(transparent)]
    Read(#[from] ReadError),
}

impl LayoutError {
    /// Says what the user can do about it, if anything.
    pub fn hint(&self) -> Option<&'static str> {
        match self {
            Self::NothingReadable { first } => first.hint(),
            Self::Read(e) => e.hint(),
            Self::Unknown { .. } => Some(
                "state the layout in the contract, for example layout = { kind = \"single\", steps = \"actions\" }",
            ),
            Self::NoColumns | Self::NoRows | Self::DoesNotFit { .. } | Self::TooMany { .. } => None,
        }
    }
}

/// Finds the episodes of a table.
pub(crate) fn episodes(table: &Table, stated: Option<&Layout>) -> Result<Episodes, LayoutError> {
    if readable(table).next().is_none() {
        return Err(match table.columns().iter().find_map(|c| c.problem.clone()) {
            Some(first) => LayoutError::NothingReadable { first },
            None => LayoutError::NoColumns,
        });
    }
    if readable(table).all(|column| column.rows() == Some(0)) {
        return Err(LayoutError::NoRows);
    }
    let layout = match stated {
        Some(layout) => layout.clone(),
        None => detect::layout(table)?,
    };
    let mut found = Episodes {
        layout: layout.clone(),
        episodes: Vec::new(),
        unfinished: Vec::new(),
        findings: Vec::new(),
    };
    match &layout {
        Layout::Flat { lengths, offsets, episode, step } => {
            let index =
                flat::IndexColumns { lengths, offsets, episode: episode.as_deref(), step: step.as_deref() };
            flat::find(table, &index, &mut found)?;
        }
        Layout::Groups { parent, prefix } => named::groups(table, parent, prefix, &mut found)?,
        Layout::Suffixed { separator } => named::suffixed(table, separator, &mut found)?,
        Layout::Terminals { terminals, timeouts } => {
            terminals::find(table, terminals, timeouts.as_deref(), &mut found)?
        }
        Layout::Single { steps } => named::single(table, steps.as_deref(), &mut found)?,
    }
    Ok(found)
}

/// Columns whose values can be read.
fn readable(table: &Table) -> impl Iterator<Item = &Column> {
    table.columns().iter().filter(|c| c.problem.is_none())
}

/// Refuses an index of more episodes than memory should be spent on; a tiny file can claim billions.
fn check_count(episodes: usize, columns: usize) -> Result<(), LayoutError> {
    const LIMIT: u64 = 16 << 20;
    let got = (episodes as u64).saturating_mul(columns.max(1) as u64);
    if got > LIMIT { Err(LayoutError::TooMany { limit: LIMIT, got }) } else { Ok(()) }
}

/// Returns whether a column's last name says that it holds actions.
fn is_action(path: &str) -> bool {
    let name = path.rsplit('/').next().unwrap_or(path);
    matches!(name.to_ascii_lowercase().as_str(), "action" | "actions" | "act" | "acts")
}

/// Reads an index column of whole numbers or truth values, one per row, in pieces.
fn read_integers(table: &Table, path: &str) -> Result<Vec<i64>, ReadError> {
    const PIECE_ROWS: u64 = 1 << 20;
    /// 2^28 rows are 2 GiB of index; no recording is that long.
    const MAX_ROWS: u64 = 1 << 28;
    let Some(column) = table.column(path) else { return table.read_rows(path, 0..0).map(|_| Vec::new()) };
    let (wanted, limit) = ("one whole number per row", MAX_ROWS.saturating_mul(8));
    if column.row_elements() != 1 {
        let got = format!("{} of extent {:?}", column.dtype.name(), column.shape);
        return Err(ReadError::WrongKind { column: path.to_owned(), wanted, got });
    }
    if column.readable_rows > MAX_ROWS {
        let got = column.readable_rows.saturating_mul(8);
        return Err(ReadError::TooLarge { column: path.to_owned(), what: "index", limit, got });
    }
    let mut out = Vec::new();
    let mut start = 0;
    while start < column.readable_rows {
        let end = (start + PIECE_ROWS).min(column.readable_rows);
        let values = table.read_rows(path, start..end)?.values;
        let integers = values.to_i64().or_else(|| whole_numbers(&values));
        let got = || format!("{} values", column.dtype.name());
        out.extend(integers.ok_or_else(|| ReadError::WrongKind {
            column: path.to_owned(),
            wanted,
            got: got(),
        })?);
        start = end;
    }
    Ok(out)
}

/// Some recorders store marks and indices as floating point.
fn whole_numbers(values: &Values) -> Option<Vec<i64>> {
    const EXACT: f64 = 9_007_199_254_740_992.0;
    values.to_f64()?.into_iter().map(|v| (v.fract() == 0.0 && v.abs() < EXACT).then_some(v as i64)).collect()
}

/// Sorts the columns of one episode by how their lengths relate to its steps, and says what does not fit.
fn classify(
    place: &str,
    steps: u64,
    columns: impl IntoIterator<Item = (Arc<str>, Arc<str>, Option<u64>)>,
    findings: &mut Vec<Finding>,
) -> BTreeMap<Arc<str>, ColumnRows> {
    let mut out = BTreeMap::new();
    for (name, path, rows) in columns {
        let extent = match rows {
            Some(n) if n == steps => Extent::Steps,
            Some(n) if n == steps.saturating_add(1) && steps > 0 => Extent::StepsAndFinal,
            None | Some(1) => Extent::Constant,
            Some(_) => Extent::Unmatched,
        };
        let rows = rows.unwrap_or(1);
        let at = || if place.is_empty() { path.to_string() } else { format!("{place}: {name}") };
        match extent {
            Extent::StepsAndFinal => {
                let detail = format!(
                    "{rows} rows for {steps} steps: the last one is the final observation and is kept"
                );
                findings.push(Finding::new(FindingKind::ExtraRows, at(), detail));
            }
            Extent::Unmatched => {
                let detail = format!("expected {steps} or {} rows, got {rows}", steps.saturating_add(1));
                findings.push(Finding::new(FindingKind::LengthMismatch, at(), detail));
            }
            Extent::Steps | Extent::Constant => {}
        }
        out.insert(name, ColumnRows { path, start: 0, rows, extent });
    }
    out
}
