//! Task, success, operator, robot and session of episodes.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use regex::Regex;
use thiserror::Error;

use super::SideFile;
use super::value::{text_of, value_at};
use crate::contract::{LabelSource, LabelsSpec};

/// Why labels cannot be read.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum LabelError {
    /// The path pattern is no regular expression.
    #[error("labels.path_pattern: expected a regular expression, got {pattern:?}: {detail}")]
    Pattern {
        /// The pattern.
        pattern: String,
        /// What is wrong with it.
        detail: String,
    },
    /// The side file cannot be used.
    #[error("labels.side_file {path:?}: {detail}")]
    SideFile {
        /// The file.
        path: PathBuf,
        /// Why.
        detail: String,
    },
    /// A column of the side file does not exist.
    #[error("labels.{label}: the side file has no column {column:?}, it has {present:?}")]
    Column {
        /// The label.
        label: &'static str,
        /// The column.
        column: String,
        /// The columns that are there.
        present: Vec<String>,
    },
}

/// Where the labels of all logs come from.
#[derive(Debug, Clone)]
pub struct Labels {
    spec: LabelsSpec,
    pattern: Option<Regex>,
    side_file: Option<SideFile>,
}

/// The labels of one episode.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct EpisodeLabels {
    /// What the robot was asked to do; empty when nobody said.
    pub task: String,
    /// Whether it succeeded.
    pub success: Option<bool>,
    /// Who operated it.
    pub operator: String,
    /// Which robot.
    pub robot: String,
    /// Which session.
    pub session: String,
}

/// What one recording says.
#[derive(Debug, Clone, Default)]
pub struct RecordingLabels {
    /// Path as given on the command line.
    pub path: PathBuf,
    /// Metadata records by name, in file order.
    pub metadata: Vec<(String, BTreeMap<String, String>)>,
    /// Messages of label topics: (topic, field) to (time, text), in time order.
    values: BTreeMap<(String, String), Vec<(i64, String)>>,
}

/// The episode that is asked about.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Asked<'a> {
    /// Number within the recording.
    pub(crate) number: u64,
    /// First tick.
    pub(crate) start_ns: i64,
    /// Last known time that belongs to it.
    pub(crate) end_ns: i64,
    /// Its own metadata record, for episodes from metadata.
    pub(crate) record: Option<&'a (String, BTreeMap<String, String>)>,
}

const LABELS: [&str; 5] = ["task", "success", "operator", "robot", "session"];

impl Labels {
    /// Reads what is needed; paths are relative to the folder of the contract.
    ///
    /// # Errors
    /// The pattern is no expression, or the side file cannot be used.
    pub fn new(spec: &LabelsSpec, folder: &Path) -> Result<Labels, LabelError> {
        let pattern = match &spec.path_pattern {
            None => None,
            Some(pattern) => Some(Regex::new(pattern).map_err(|error| LabelError::Pattern {
                pattern: pattern.clone(),
                detail: error.to_string(),
            })?),
        };
        let side_file = match &spec.side_file {
            None => None,
            Some(path) => Some(SideFile::read(&folder.join(path), spec.side_key.as_deref())?),
        };
        let labels = Labels { spec: spec.clone(), pattern, side_file };
        for label in LABELS {
            if let (Some(LabelSource::Column(column)), Some(file)) = (labels.source(label), &labels.side_file)
                && let Some(first) = file.rows.first()
                && !first.contains_key(&column.column)
            {
                let present = first.keys().cloned().collect();
                return Err(LabelError::Column { label, column: column.column.clone(), present });
            }
        }
        Ok(labels)
    }

    /// Returns the topics and fields that labels come from.
    pub fn topics(&self) -> Vec<(String, String)> {
        let sources = LABELS.iter().filter_map(|label| self.source(label));
        sources
            .filter_map(|source| match source {
                LabelSource::Topic(topic) => Some((topic.topic.clone(), topic.field.clone())),
                _ => None,
            })
            .collect()
    }

    fn source(&self, label: &str) -> Option<&LabelSource> {
        match label {
            "task" => self.spec.task.as_ref(),
            "success" => self.spec.success.as_ref(),
            "operator" => self.spec.operator.as_ref(),
            "robot" => self.spec.robot.as_ref(),
            _ => self.spec.session.as_ref(),
        }
    }

    /// Returns the labels of an episode.
    pub(crate) fn of(&self, recording: &RecordingLabels, asked: Asked<'_>) -> EpisodeLabels {
        let text = |label: &str| self.text(label, recording, asked).unwrap_or_default();
        EpisodeLabels {
            task: text("task"),
            success: self.text("success", recording, asked).and_then(|text| self.truth(&text)),
            operator: text("operator"),
            robot: text("robot"),
            session: text("session"),
        }
    }

    fn text(&self, label: &str, recording: &RecordingLabels, asked: Asked<'_>) -> Option<String> {
        let capture = |name: &str| {
            let path = recording.path.to_string_lossy().into_owned();
            let found = self.pattern.as_ref()?.captures(&path)?.name(name)?.as_str().to_owned();
            Some(found)
        };
        let Some(source) = self.source(label) else { return capture(label) };
        match source {
            LabelSource::Constant(text) => Some(text.clone()),
            LabelSource::Flag(flag) => Some(flag.to_string()),
            LabelSource::Capture(source) => capture(&source.capture),
            LabelSource::Column(source) => {
                let episode = self.spec.side_episode.as_deref().map(|column| (column, asked.number));
                let row = self.side_file.as_ref()?.find(&recording.path, self.spec.side_key.as_deref(), episode)?;
                row.get(&source.column).cloned()
            }
            LabelSource::Metadata(source) => {
                let own = asked.record.filter(|(name, _)| *name == source.metadata);
                let any = recording.metadata.iter().find(|(name, values)| {
                    *name == source.metadata && values.contains_key(&source.key)
                });
                own.or(any)?.1.get(&source.key).cloned()
            }
            LabelSource::Topic(source) => {
                let key = (source.topic.clone(), source.field.clone());
                let values = recording.values.get(&key)?;
                let within = values.iter().filter(|(ns, _)| *ns > asked.start_ns && *ns <= asked.end_ns);
                let found = if label == "success" {
                    within.last()
                } else {
                    let before = values.iter().rev().find(|(ns, _)| *ns <= asked.start_ns);
                    before.filter(|(_, text)| !text.is_empty()).or(within.into_iter().find(|(_, t)| !t.is_empty()))
                };
                found.map(|(_, text)| text.clone())
            }
        }
    }

    fn truth(&self, text: &str) -> Option<bool> {
        let lower = text.trim().to_lowercase();
        let own = self.spec.success_values.iter().find(|(value, _)| value.to_lowercase() == lower);
        match (own, lower.as_str()) {
            (Some((_, truth)), _) => Some(*truth),
            (None, "true" | "1" | "1.0" | "yes" | "success" | "successful" | "succeeded" | "ok" | "pass") => Some(true),
            (None, "false" | "0" | "0.0" | "no" | "failure" | "fail" | "failed") => Some(false),
            _ => None,
        }
    }
}

impl RecordingLabels {
    /// Returns the labels of a recording of which no message has been read.
    pub fn new(path: PathBuf, metadata: Vec<(String, BTreeMap<String, String>)>) -> Self {
        Self { path, metadata, values: BTreeMap::new() }
    }

    /// Takes a message of a label topic.
    pub fn take(&mut self, topic: &str, fields: &[(String, String)], time_ns: i64, message: &serde_json::Value) {
        for (_, field) in fields.iter().filter(|(name, _)| name == topic) {
            if let Some(value) = value_at(message, field) {
                let values = self.values.entry((topic.to_owned(), field.clone())).or_default();
                let at = values.partition_point(|(ns, _)| *ns <= time_ns);
                values.insert(at, (time_ns, text_of(&value)));
            }
        }
    }
}
