//! What a table holds, for `inspect` and error messages: one line per column of an episode.

use std::collections::BTreeSet;
use std::fmt;

use serde::Serialize;

use super::column::{Column, Dtype};
use super::error::ReadError;
use super::finding::{Finding, FindingKind};
use super::{Extent, Format, Layout, Table};

/// A summary of a file, in JSON by serde and as text by `Display`.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct TableReport {
    /// Name of the file, without its folder.
    pub file: String,
    /// Format.
    pub format: Format,
    /// The layout that fits.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub layout: Option<Layout>,
    /// Why none fits, and what to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub no_layout: Option<String>,
    /// Finished episodes.
    pub episodes: usize,
    /// Their steps.
    pub steps: u64,
    /// Shortest and longest finished episode.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub steps_range: Option<[u64; 2]>,
    /// Unfinished episodes.
    pub unfinished: usize,
    /// Their steps.
    pub unfinished_steps: u64,
    /// Columns of the first episode, under the names that a contract uses; else all columns.
    pub columns: Vec<ColumnReport>,
    /// Columns of no episode, or that cannot be read.
    pub others: Vec<ColumnReport>,
    /// What was noticed.
    pub findings: Vec<Finding>,
}

/// One column.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct ColumnReport {
    /// Name.
    pub name: String,
    /// Type of an element.
    pub dtype: Dtype,
    /// Extent of one row.
    pub row_shape: Vec<u64>,
    /// Rows in the file; of the first episode's array where every episode has its own.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rows: Option<u64>,
    /// How rows relate to steps.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub extent: Option<Extent>,
    /// Chunking and filters.
    pub storage: String,
    /// Why it cannot be read.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub problem: Option<String>,
    /// What can be done about it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub hint: Option<&'static str>,
}

impl ColumnReport {
    fn new(name: &str, column: &Column, extent: Option<Extent>) -> Self {
        let filters: Vec<&str> = column.filters.iter().map(|f| f.name.as_str()).collect();
        let mut storage = match &column.chunk_shape {
            Some(chunk) => format!("chunks of {chunk:?}"),
            None => "whole".to_owned(),
        };
        if !filters.is_empty() {
            storage = format!("{storage}, {}", filters.join(" + "));
        }
        Self {
            name: name.to_owned(),
            dtype: column.dtype,
            row_shape: column.shape.iter().skip(1).copied().collect(),
            rows: column.rows(),
            extent,
            storage,
            problem: column.problem.as_ref().map(ToString::to_string),
            hint: column.problem.as_ref().and_then(ReadError::hint),
        }
    }
}

/// Summarises a table; a stated layout is used instead of the one that fits.
pub fn report(table: &Table, layout: Option<&Layout>) -> TableReport {
    let file = table.path().file_name().map_or_else(String::new, |n| n.to_string_lossy().into_owned());
    let mut report = TableReport {
        file,
        format: table.format(),
        layout: None,
        no_layout: None,
        episodes: 0,
        steps: 0,
        steps_range: None,
        unfinished: 0,
        unfinished_steps: 0,
        columns: Vec::new(),
        others: Vec::new(),
        findings: table.findings().to_vec(),
    };
    match table.episodes(layout) {
        Ok(found) => {
            let lengths = found.episodes.iter().map(|e| e.steps);
            report.steps_range = lengths.clone().min().zip(lengths.max()).map(|(low, high)| [low, high]);
            report.episodes = found.episodes.len();
            report.steps = found.rows();
            report.unfinished = found.unfinished.len();
            report.unfinished_steps = found.unfinished.iter().map(|e| e.steps).sum();
            let all = || found.episodes.iter().chain(&found.unfinished);
            if let Some(first) = all().next() {
                let columns =
                    first.columns.iter().filter_map(|(name, at)| Some((name, at, table.column(&at.path)?)));
                report.columns =
                    columns.map(|(n, at, column)| ColumnReport::new(n, column, Some(at.extent))).collect();
            }
            let used: BTreeSet<&str> = all().flat_map(|e| e.columns.values().map(|at| &*at.path)).collect();
            let others = table.columns().iter().filter(|c| !used.contains(c.path.as_str()));
            report.others = others.map(|c| ColumnReport::new(&c.path, c, None)).collect();
            report.findings.extend(found.findings);
            report.layout = Some(found.layout);
        }
        Err(error) => {
            let hint = error.hint().map(|hint| format!("; hint: {hint}")).unwrap_or_default();
            report.no_layout = Some(format!("{error}{hint}"));
            report.others = table.columns().iter().map(|c| ColumnReport::new(&c.path, c, None)).collect();
        }
    }
    report
}

impl fmt::Display for TableReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let format = match self.format {
            Format::Hdf5 => "HDF5",
            Format::Npz => "npz",
        };
        writeln!(f, "{}: {format}", self.file)?;
        match (&self.layout, self.steps_range) {
            (Some(layout), Some([low, high])) => {
                let lengths =
                    if low == high { format!("{low} each") } else { format!("{low} to {high} each") };
                let name = layout.name();
                let plural = if self.episodes == 1 { "" } else { "s" };
                let (episodes, steps) = (self.episodes, self.steps);
                writeln!(f, "  {episodes} episode{plural}, {steps} steps ({lengths}); layout {name:?}")?;
            }
            (Some(layout), None) => writeln!(f, "  no finished episode; layout {:?}", layout.name())?,
            (None, _) => writeln!(f, "  no episodes: {}", self.no_layout.as_deref().unwrap_or("unknown"))?,
        }
        if self.unfinished > 0 {
            writeln!(f, "  {} unfinished, {} steps", self.unfinished, self.unfinished_steps)?;
        }
        section(f, "columns of an episode", &self.columns)?;
        section(f, "other columns", &self.others)?;
        // What cannot be read stands beside its column already.
        let noticed = self.findings.iter().filter(|n| n.kind != FindingKind::UnreadableColumn);
        lines(f, "noticed", &noticed.map(ToString::to_string).collect::<Vec<_>>())?;
        let hints: BTreeSet<&str> = self.others.iter().filter_map(|c| c.hint).collect();
        lines(f, "hints", &hints.into_iter().map(ToOwned::to_owned).collect::<Vec<_>>())
    }
}

/// Lists print this many lines at most; JSON has all.
const SHOWN: usize = 40;

fn section(f: &mut fmt::Formatter<'_>, title: &str, columns: &[ColumnReport]) -> fmt::Result {
    let width = columns.iter().take(SHOWN).map(|c| c.name.len()).max().unwrap_or(0);
    let line = |c: &ColumnReport| {
        let rows = match (c.extent, c.rows) {
            (Some(Extent::Steps), _) => "per step".to_owned(),
            (Some(Extent::StepsAndFinal), _) => "per step, and the final one".to_owned(),
            (Some(Extent::Constant), _) => "constant".to_owned(),
            (_, Some(rows)) => format!("{rows} rows"),
            (_, None) => "scalar".to_owned(),
        };
        let what = c.problem.clone().unwrap_or_else(|| format!("{rows}; {}", c.storage));
        format!("{:<width$}  {:<4} {:?}  {what}", c.name, c.dtype.name(), c.row_shape)
    };
    lines(f, title, &columns.iter().map(line).collect::<Vec<_>>())
}

fn lines(f: &mut fmt::Formatter<'_>, title: &str, lines: &[String]) -> fmt::Result {
    if lines.is_empty() {
        return Ok(());
    }
    writeln!(f, "  {title}")?;
    for line in lines.iter().take(SHOWN) {
        writeln!(f, "    {line}")?;
    }
    match lines.len().saturating_sub(SHOWN) {
        0 => Ok(()),
        more => writeln!(f, "    and {more} more"),
    }
}
