//! Runs side by side: the table of methods and tasks, with paired intervals.
//!
//! Reads the folders that `gawm-eval plan` wrote. Runs of one method are its seeds; a cell is the mean over seeds with the
//! Wilson interval of all problems pooled; a floor that several runs bring for the same problems counts once. Methods are compared problem by problem where they had the same problems.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::evaluate::Outcome;
use crate::statistics::{PairedDifference, paired_difference};
use crate::suite::{PLAN_VERSION, PlanReport, Rate, SetResult, Solver, SolverResult};

/// Largest file of results that is read.
const MAX_BYTES: u64 = 1 << 30;

/// A line of an outcomes file.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct OutcomeLine {
    /// Who acted.
    pub solver: Solver,
    /// What happened.
    #[serde(flatten)]
    pub outcome: Outcome,
}

/// A folder of results.
#[derive(Debug, Clone, PartialEq)]
pub struct PlanFolder {
    /// Where it is.
    pub path: PathBuf,
    /// `plan.json`.
    pub report: PlanReport,
    /// Outcomes of the model per set: problem id to solved.
    pub outcomes: BTreeMap<String, BTreeMap<String, bool>>,
    /// What its row is called instead of the method.
    pub label: Option<String>,
}

/// Why results cannot be compared.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum CompareError {
    /// A file cannot be read.
    #[error("cannot read {path:?}: {cause}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The cause.
        cause: std::io::Error,
    },
    /// A file is not what `gawm-eval plan` writes.
    #[error("{path:?}: {message}")]
    Syntax {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
}

/// One cell of the table: a method on a set of a task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Task, protocol and set.
    pub column: String,
    /// Method, or floor.
    pub row: String,
    /// Success rate of each run, in the order given.
    pub seeds: Vec<f64>,
    /// All problems of all runs.
    pub pooled: Rate,
}

/// Two methods on the problems that both had, each problem once per pair of runs of equal position.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Duel {
    /// Task, protocol and set.
    pub column: String,
    /// The first method.
    pub first: String,
    /// The second method.
    pub second: String,
    /// Rate of the first minus rate of the second.
    pub difference: PairedDifference,
}

/// The table.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub struct CompareTable {
    /// Columns in the order of their names.
    pub columns: Vec<String>,
    /// Methods in the order of the runs, then floors.
    pub rows: Vec<String>,
    /// The cells that exist.
    pub cells: Vec<Cell>,
    /// The first method against all others.
    pub duels: Vec<Duel>,
}

impl PlanFolder {
    /// Reads `plan.json` and the outcomes beside it.
    ///
    /// # Errors
    /// - [`CompareError`] names the file and, for outcomes, the line.
    pub fn read(path: &Path) -> Result<PlanFolder, CompareError> {
        let file = path.join("plan.json");
        let syntax = |message: String| CompareError::Syntax { path: file.clone(), message };
        let report: PlanReport =
            serde_json::from_str(&read_text(&file)?).map_err(|error| syntax(error.to_string()))?;
        if report.format_version != PLAN_VERSION {
            let got = report.format_version;
            return Err(syntax(format!("expected format_version {PLAN_VERSION}, got {got}")));
        }
        let mut outcomes = BTreeMap::new();
        for set in &report.sets {
            let file = path.join(format!("outcomes-{}.jsonl", set.name));
            let mut solved = BTreeMap::new();
            for (number, line) in read_text(&file)?.lines().enumerate() {
                let parsed: OutcomeLine =
                    serde_json::from_str(line).map_err(|error| CompareError::Syntax {
                        path: file.clone(),
                        message: format!("line {}: {error}", number + 1),
                    })?;
                if parsed.solver == Solver::Model
                    && let Some(_) = solved.insert(parsed.outcome.id.clone(), parsed.outcome.success_any)
                {
                    let message = format!("line {}: a second outcome of {}", number + 1, parsed.outcome.id);
                    return Err(CompareError::Syntax { path: file, message });
                }
            }
            let got = (solved.len(), solved.values().filter(|is_solved| **is_solved).count());
            let expected =
                set.solver(Solver::Model).map_or((0, 0), |model| (model.any.n, model.any.successes));
            if got != expected {
                let message = format!(
                    "expected {} outcomes of the model as in plan.json, {} of them solved, got {} and {}",
                    expected.0, expected.1, got.0, got.1
                );
                return Err(CompareError::Syntax { path: file, message });
            }
            outcomes.insert(set.name.clone(), solved);
        }
        Ok(PlanFolder { path: path.to_owned(), report, outcomes, label: None })
    }

    fn method(&self) -> String {
        let method = || self.report.model.as_ref().map(|model| model.method.clone());
        self.label.clone().or_else(method).unwrap_or_else(|| "floors only".to_owned())
    }

    /// What tells a floor on these problems from the same floor on others.
    fn problems(&self, set: &SetResult, result: &SolverResult) -> String {
        serde_json::json!([set.spec, set.source, set.n, self.report.options, result.any, result.last])
            .to_string()
    }

    fn column(&self, set: &str) -> String {
        format!("{} {} {set}", self.report.task, self.report.protocol)
    }
}

fn read_text(path: &Path) -> Result<String, CompareError> {
    let io = |cause| CompareError::Io { path: path.to_owned(), cause };
    let size = std::fs::metadata(path).map_err(io)?.len();
    if size > MAX_BYTES {
        let message = format!("expected at most {MAX_BYTES} bytes, got {size}");
        return Err(CompareError::Syntax { path: path.to_owned(), message });
    }
    std::fs::read_to_string(path).map_err(io)
}

/// Makes the table of several folders.
pub fn compare(folders: &[PlanFolder]) -> CompareTable {
    let mut methods: Vec<String> = Vec::new();
    for folder in folders {
        let method = folder.method();
        if !methods.contains(&method) {
            methods.push(method);
        }
    }
    let mut cells: BTreeMap<(String, String), (Vec<f64>, usize, usize)> = BTreeMap::new();
    let mut floors: Vec<String> = Vec::new();
    let mut seen = BTreeSet::new();
    for folder in folders {
        for set in &folder.report.sets {
            for result in &set.solvers {
                let row = match result.solver {
                    Solver::Model => folder.method(),
                    other => other.name().to_owned(),
                };
                if result.solver != Solver::Model {
                    // Two models on the same problems bring the same floors: counted twice, intervals would lie.
                    if !seen.insert((folder.column(&set.name), row.clone(), folder.problems(set, result))) {
                        continue;
                    }
                    if !floors.contains(&row) {
                        floors.push(row.clone());
                    }
                }
                let cell = cells.entry((folder.column(&set.name), row)).or_default();
                cell.0.push(result.any.rate);
                cell.1 += result.any.successes;
                cell.2 += result.any.n;
            }
        }
    }
    let mut columns: Vec<String> = cells.keys().map(|(column, _)| column.clone()).collect();
    columns.dedup();
    let cells = cells.into_iter().map(|((column, row), (seeds, successes, n))| {
        let pooled = Rate::of((0..n).map(|index| index < successes));
        Cell { column, row, seeds, pooled }
    });
    let cells = cells.collect();
    let duels = duels(folders, &methods);
    let rows = methods.into_iter().chain(floors).collect();
    CompareTable { columns, rows, cells, duels }
}

/// The first method against each other one, wherever both had the same problems.
fn duels(folders: &[PlanFolder], methods: &[String]) -> Vec<Duel> {
    let Some((first, others)) = methods.split_first() else { return Vec::new() };
    let of =
        |method: &str| folders.iter().filter(move |folder| folder.method() == *method).collect::<Vec<_>>();
    let mut pairs: BTreeMap<(String, String), Vec<(bool, bool)>> = BTreeMap::new();
    for second in others {
        for (a, b) in of(first).into_iter().zip(of(second)) {
            for (set, outcomes) in &a.outcomes {
                let Some(theirs) = b.outcomes.get(set).filter(|_| a.column(set) == b.column(set)) else {
                    continue;
                };
                let shared = outcomes.iter().filter_map(|(id, ours)| Some((*ours, *theirs.get(id)?)));
                pairs.entry((a.column(set), second.clone())).or_default().extend(shared);
            }
        }
    }
    let duel = |((column, second), pairs): ((String, String), Vec<(bool, bool)>)| Duel {
        column,
        first: first.clone(),
        second,
        difference: paired_difference(pairs),
    };
    pairs.into_iter().filter(|(_, pairs)| !pairs.is_empty()).map(duel).collect()
}

impl CompareTable {
    /// Returns the table as Markdown, percent.
    pub fn to_markdown(&self) -> String {
        let mut text = format!(
            "| percent | {} |\n|---|{}\n",
            self.columns.join(" | "),
            "---|".repeat(self.columns.len())
        );
        for row in &self.rows {
            let cell = |column: &String| {
                let found = self.cells.iter().find(|cell| cell.column == *column && cell.row == *row);
                found.map_or_else(String::new, Cell::text)
            };
            let cells: Vec<String> = self.columns.iter().map(cell).collect();
            text += &format!("| {row} | {} |\n", cells.join(" | "));
        }
        if !self.duels.is_empty() {
            text += "\n| same problems | set | difference | 95 % | only first / only second | p (McNemar) |\n|---|---|---|---|---|---|\n";
        }
        for Duel { column, first, second, difference } in &self.duels {
            let PairedDifference { pairs, difference, interval, p_value } = difference;
            text += &format!(
                "| {first} - {second} | {column} | {:+.1} | {:+.1} to {:+.1} | {} / {} | {p_value:.3} |\n",
                100.0 * difference,
                100.0 * interval.low,
                100.0 * interval.high,
                pairs.only_first,
                pairs.only_second
            );
        }
        text
    }
}

impl Cell {
    /// Mean over seeds, their range where there are several, and the pooled interval.
    fn text(&self) -> String {
        let mean = self.seeds.iter().sum::<f64>() / self.seeds.len().max(1) as f64;
        let Rate { interval, n, .. } = self.pooled;
        let seeds = match self.seeds.len() {
            0 | 1 => String::new(),
            many => format!(", {many} runs"),
        };
        format!(
            "{:.1} [{:.1}, {:.1}] (n {n}{seeds})",
            100.0 * mean,
            100.0 * interval.low,
            100.0 * interval.high
        )
    }
}

#[cfg(test)]
mod tests;
