//! `label`: what is said of episodes, from a table, without touching their rows.
//!
//! Of a gawm dataset only what changes is written anew: the tables, and the column `task_index` of files with another
//! task. All other bytes are linked, or copied; images are never encoded again. A LeRobot folder goes the way of the
//! other verbs and becomes LeRobot v3.0.

mod error;
mod rewrite;
mod splice;
mod table;
mod template;

use std::collections::BTreeMap;

use gawm_schema::batch::Split;

pub use error::LabelError;
pub(super) use rewrite::{take_over, write};
pub use table::{EpisodeKey, LabelRow, LabelTable};
pub use template::template;

use super::{EditError, Input, Plan};

/// What can be said of an episode.
#[derive(Debug, Clone, PartialEq, Eq, PartialOrd, Ord)]
pub enum Label {
    /// What was to be done, in words.
    Task,
    /// Whether it was done.
    Success,
    /// Who operated the robot.
    Operator,
    /// Training or validation data.
    Split,
    /// Anything else, by name.
    Tag(String),
}

/// The value of a label.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum LabelValue {
    /// Nobody says.
    Unknown,
    /// A task, an operator, a tag.
    Text(String),
    /// Success.
    Bool(bool),
    /// Training or validation data.
    Split(Split),
}

/// Labels of one episode that become other ones.
pub type EpisodeLabels = BTreeMap<Label, LabelValue>;

/// What an edit says of episodes.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Relabelling {
    /// By position in [`Plan::pieces`].
    pub episodes: BTreeMap<usize, EpisodeLabels>,
    /// Copies files that stay as they are, instead of linking them.
    pub copies: bool,
}

impl Label {
    /// Returns the name of its column in a table of labels.
    pub fn column(&self) -> String {
        match self {
            Label::Task => "task".to_owned(),
            Label::Success => "success".to_owned(),
            Label::Operator => "operator".to_owned(),
            Label::Split => "split".to_owned(),
            Label::Tag(name) => format!("tags.{name}"),
        }
    }
}

impl std::fmt::Display for LabelValue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            LabelValue::Unknown => f.write_str("unknown"),
            LabelValue::Text(text) => write!(f, "{text:?}"),
            LabelValue::Bool(value) => value.fmt(f),
            LabelValue::Split(split) => f.write_str(split_name(*split)),
        }
    }
}

/// Returns the name of a split in the episode table.
pub(super) fn split_name(split: Split) -> &'static str {
    match split {
        Split::Train => "train",
        Split::Validation => "val",
    }
}

/// Plans to label the episodes of an input; only labels that change are in the plan.
///
/// # Errors
/// - a row names an episode that the dataset does not have, or several columns of it name different ones;
/// - two rows say different things of one episode.
pub fn label(input: &Input, table: &LabelTable) -> Result<Plan, EditError> {
    let mut plan = Plan { verb: "label".to_owned(), pieces: input.pieces(0), ..Plan::default() };
    plan.arguments.insert("labels".to_owned(), table.name.clone());
    plan.arguments.insert("labels_hash".to_owned(), table.hash.to_string());
    let position: BTreeMap<usize, usize> =
        plan.pieces.iter().enumerate().map(|(position, piece)| (piece.run, position)).collect();
    let index = EpisodeIndex::new(input);
    // Of each label the row that said it.
    let mut said: BTreeMap<(usize, &Label), (&LabelRow, &LabelValue)> = BTreeMap::new();
    let mut changes = Relabelling::default();
    for row in &table.rows {
        for run in index.runs_of(input, table, row)? {
            let Some(&position) = position.get(&run) else { continue };
            let current = current_labels(input, run);
            for (label, value) in &row.labels {
                if let Some((other, before)) = said.insert((run, label), (row, value))
                    && before != value
                {
                    return Err(LabelError::Conflict {
                        path: table.path.clone(),
                        line: row.line,
                        other: other.line,
                        episode: input.dataset.runs[run].episode_index,
                        column: label.column(),
                        first: before.to_string(),
                        second: value.to_string(),
                    }
                    .into());
                }
                if current.get(label).unwrap_or(&LabelValue::Unknown) != value {
                    let labels: &mut EpisodeLabels = changes.episodes.entry(position).or_default();
                    labels.insert(label.clone(), value.clone());
                }
            }
        }
    }
    plan.labels = Some(changes);
    Ok(plan)
}

/// Returns what a dataset says of an episode now.
pub(super) fn current_labels(input: &Input, run: usize) -> EpisodeLabels {
    let entry = input.dataset.entry(input.dataset.runs[run].episode_index);
    let mut labels = EpisodeLabels::new();
    let Some(entry) = entry else { return labels };
    let text = |text: &str| (!text.is_empty()).then(|| LabelValue::Text(text.to_owned()));
    let bool_of = |name: &str| entry.extras.get(name).and_then(serde_json::Value::as_bool);
    let mut put = |label: Label, value: Option<LabelValue>| {
        labels.extend(value.map(|value| (label, value)));
    };
    put(Label::Task, entry.tasks.first().and_then(|task| text(task)));
    let success = bool_of("success").filter(|_| bool_of("success_known") != Some(false));
    put(Label::Success, success.map(LabelValue::Bool));
    put(Label::Operator, entry.extra_text("operator").and_then(|operator| text(&operator)));
    let split = match entry.extra_text("split").as_deref() {
        Some("train") => Some(Split::Train),
        Some("val") => Some(Split::Validation),
        _ => None,
    };
    put(Label::Split, split.map(LabelValue::Split));
    for (name, value) in &entry.extras {
        if let Some(tag) = name.strip_prefix("tags.") {
            put(Label::Tag(tag.to_owned()), value.as_str().and_then(text));
        } else if name == "gawm/tags" {
            let tags = value.as_str().and_then(|t| serde_json::from_str::<serde_json::Value>(t).ok());
            for (tag, value) in tags.as_ref().and_then(serde_json::Value::as_object).into_iter().flatten() {
                put(Label::Tag(tag.clone()), value.as_str().and_then(text));
            }
        }
    }
    labels
}

/// Where each name of an episode leads.
struct EpisodeIndex {
    by_number: BTreeMap<i64, usize>,
    by_id: BTreeMap<String, usize>,
    by_file: BTreeMap<String, Vec<usize>>,
}

impl EpisodeIndex {
    fn new(input: &Input) -> EpisodeIndex {
        let mut index =
            EpisodeIndex { by_number: BTreeMap::new(), by_id: BTreeMap::new(), by_file: BTreeMap::new() };
        for (run, found) in input.dataset.runs.iter().enumerate() {
            index.by_number.insert(found.episode_index, run);
            let Some(entry) = input.dataset.entry(found.episode_index) else { continue };
            if let Some(id) = entry.extra_text("gawm/episode_id") {
                index.by_id.insert(id, run);
            }
            if let Some(file) = entry.extra_text("gawm/source_file") {
                index.by_file.entry(file).or_default().push(run);
            }
        }
        index
    }

    /// Returns the runs that a row names: all its names lead to them.
    fn runs_of(&self, input: &Input, table: &LabelTable, row: &LabelRow) -> Result<Vec<usize>, LabelError> {
        let mut runs: Option<(Vec<usize>, &EpisodeKey)> = None;
        for key in &row.keys {
            let found = self.find(key).ok_or_else(|| self.unknown(input, table, row, key))?;
            runs = match runs {
                None => Some((found, key)),
                Some((before, first)) => {
                    let both: Vec<usize> = before.into_iter().filter(|run| found.contains(run)).collect();
                    if both.is_empty() {
                        return Err(LabelError::Names {
                            path: table.path.clone(),
                            line: row.line,
                            first: first.to_string(),
                            second: key.to_string(),
                        });
                    }
                    Some((both, first))
                }
            };
        }
        Ok(runs.map(|(runs, _)| runs).unwrap_or_default())
    }

    fn find(&self, key: &EpisodeKey) -> Option<Vec<usize>> {
        match key {
            EpisodeKey::Number(number) => self.by_number.get(number).map(|run| vec![*run]),
            EpisodeKey::Id(id) => self.by_id.get(id).map(|run| vec![*run]),
            EpisodeKey::SourceFile(name) => {
                // People name logs with the folders they lie in; datasets keep no folders.
                let bare = name.rsplit(['/', '\\']).next().unwrap_or(name);
                self.by_file.get(name).or_else(|| self.by_file.get(bare)).cloned()
            }
        }
    }

    fn unknown(&self, input: &Input, table: &LabelTable, row: &LabelRow, key: &EpisodeKey) -> LabelError {
        let some = |mut names: Vec<&String>| {
            let n = names.len();
            names.truncate(5);
            let rest = n - names.len();
            let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
            let names: Vec<String> = names.iter().map(|name| format!("{name:?}")).collect();
            match n {
                0 => "nothing: this dataset has no such names".to_owned(),
                _ => format!("one of {}{more}", names.join(", ")),
            }
        };
        let expected = match key {
            EpisodeKey::Number(_) => format!("an episode from 0 to {}", input.dataset.runs.len().max(1) - 1),
            EpisodeKey::Id(_) => some(self.by_id.keys().collect()),
            EpisodeKey::SourceFile(_) => some(self.by_file.keys().collect()),
        };
        LabelError::UnknownEpisode {
            path: table.path.clone(),
            line: row.line,
            expected,
            got: key.to_string(),
        }
    }
}

#[cfg(test)]
mod tests;
