//! Task, success, operator, robot and session of episodes.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use regex::Regex;
use thiserror::Error;

use super::SideFile;
use super::value::{text_of, value_at};
use crate::contract::{LabelSource, LabelsSpec, MetadataLabel, TopicLabel};

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
    /// A label comes from a side file, and none is named.
    #[error("labels.{label}: expected labels.side_file, whose column {column:?} is meant, got none")]
    NoSideFile {
        /// The label.
        label: &'static str,
        /// The column.
        column: String,
    },
    /// A label comes from a group that the path pattern lacks.
    #[error("labels.{label}: labels.path_pattern has no group {group:?}, it has {present:?}")]
    Group {
        /// The label.
        label: &'static str,
        /// The group.
        group: String,
        /// The named groups that are there.
        present: Vec<String>,
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
    /// Messages of label topics without the field.
    without: BTreeMap<(String, String), u64>,
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
            Some(path) => {
                let keys = (spec.side_key.as_deref(), spec.side_episode.as_deref());
                Some(SideFile::read(&folder.join(path), keys)?)
            }
        };
        let labels = Labels { spec: spec.clone(), pattern, side_file };
        labels.check()?;
        Ok(labels)
    }

    /// Refuses labels that no log can have.
    fn check(&self) -> Result<(), LabelError> {
        for label in LABELS {
            match self.source(label) {
                Some(LabelSource::Capture(source)) => {
                    let names = self.pattern.iter().flat_map(Regex::capture_names).flatten();
                    let present: Vec<String> = names.map(str::to_owned).collect();
                    if !present.contains(&source.capture) {
                        return Err(LabelError::Group { label, group: source.capture.clone(), present });
                    }
                }
                Some(LabelSource::Column(source)) => self.check_column(label, &source.column)?,
                _ => {}
            }
        }
        for (label, column) in [("side_key", &self.spec.side_key), ("side_episode", &self.spec.side_episode)]
        {
            if let Some(column) = column {
                self.check_column(label, column)?;
            }
        }
        Ok(())
    }

    fn check_column(&self, label: &'static str, column: &str) -> Result<(), LabelError> {
        let Some(file) = &self.side_file else {
            return Err(LabelError::NoSideFile { label, column: column.to_owned() });
        };
        match file.rows.first() {
            Some(first) if !first.contains_key(column) => Err(LabelError::Column {
                label,
                column: column.to_owned(),
                present: first.keys().cloned().collect(),
            }),
            _ => Ok(()),
        }
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

    /// Returns the labels of an episode, and why some are not known although the contract says where they come from.
    pub(crate) fn of(
        &self,
        recording: &RecordingLabels,
        asked: Asked<'_>,
    ) -> (EpisodeLabels, BTreeSet<String>) {
        let mut reasons = BTreeSet::new();
        let mut text = |label: &'static str| match self.text(label, recording, asked) {
            Ok(text) => text.unwrap_or_default(),
            Err(reason) => {
                reasons.insert(reason);
                String::new()
            }
        };
        let (task, said) = (text("task"), text("success"));
        let (operator, robot, session) = (text("operator"), text("robot"), text("session"));
        let success = self.truth(&said);
        if success.is_none() && !said.trim().is_empty() {
            reasons.insert(format!(
                "labels.success: {said:?} is not known to be true or false; labels.success_values can say it"
            ));
        }
        (EpisodeLabels { task, success, operator, robot, session }, reasons)
    }

    /// Returns what is said; nothing where the source says nothing, an error where the source is not there.
    fn text(
        &self,
        label: &'static str,
        recording: &RecordingLabels,
        asked: Asked<'_>,
    ) -> Result<Option<String>, String> {
        match self.source(label) {
            None => {
                let mut names = self.pattern.iter().flat_map(Regex::capture_names).flatten();
                if names.any(|name| name == label) { self.capture(label, &recording.path) } else { Ok(None) }
            }
            Some(LabelSource::Constant(text)) => Ok(Some(text.clone())),
            Some(LabelSource::Flag(flag)) => Ok(Some(flag.to_string())),
            Some(LabelSource::Capture(source)) => self.capture(&source.capture, &recording.path),
            Some(LabelSource::Column(source)) => {
                let Some(file) = &self.side_file else { return Ok(None) };
                let row = file.find(&recording.path, asked.number).ok_or_else(|| {
                    let name = recording.path.file_name().unwrap_or_default().to_string_lossy().into_owned();
                    let episode =
                        self.spec.side_episode.as_ref().map(|_| format!(", episode {}", asked.number));
                    format!("labels.side_file has no row of {name:?}{}", episode.unwrap_or_default())
                })?;
                Ok(row.get(&source.column).cloned())
            }
            Some(LabelSource::Metadata(source)) => recording.in_metadata(label, source, asked.record),
            Some(LabelSource::Topic(source)) => recording.in_topic(label, source, asked),
        }
    }

    fn capture(&self, name: &str, path: &Path) -> Result<Option<String>, String> {
        let path = path.to_string_lossy();
        let Some(pattern) = &self.pattern else { return Ok(None) };
        match pattern.captures(&path) {
            None => Err(format!("labels.path_pattern does not match the path {path:?}")),
            Some(found) => Ok(found.name(name).map(|text| text.as_str().to_owned())),
        }
    }

    fn truth(&self, text: &str) -> Option<bool> {
        let lower = text.trim().to_lowercase();
        let own = self.spec.success_values.iter().find(|(value, _)| value.to_lowercase() == lower);
        match (own, lower.as_str()) {
            (Some((_, truth)), _) => Some(*truth),
            (None, "true" | "1" | "1.0" | "yes" | "success" | "successful" | "succeeded" | "ok" | "pass") => {
                Some(true)
            }
            (None, "false" | "0" | "0.0" | "no" | "failure" | "fail" | "failed") => Some(false),
            _ => None,
        }
    }
}

impl RecordingLabels {
    /// Returns the labels of a recording of which no message has been read.
    pub fn new(path: PathBuf, metadata: Vec<(String, BTreeMap<String, String>)>) -> Self {
        Self { path, metadata, ..Self::default() }
    }

    /// Takes a message of a label topic.
    pub fn take(
        &mut self,
        topic: &str,
        fields: &[(String, String)],
        time_ns: i64,
        message: &serde_json::Value,
    ) {
        for (_, field) in fields.iter().filter(|(name, _)| name == topic) {
            let key = (topic.to_owned(), field.clone());
            if let Some(value) = value_at(message, field) {
                let values = self.values.entry(key).or_default();
                let at = values.partition_point(|(ns, _)| *ns <= time_ns);
                values.insert(at, (time_ns, text_of(&value)));
            } else {
                *self.without.entry(key).or_default() += 1;
            }
        }
    }

    fn in_metadata(
        &self,
        label: &str,
        source: &MetadataLabel,
        own: Option<&(String, BTreeMap<String, String>)>,
    ) -> Result<Option<String>, String> {
        let MetadataLabel { metadata: name, key } = source;
        let mut named = own.into_iter().chain(&self.metadata).filter(|(other, _)| other == name).peekable();
        let Some((_, first)) = named.peek().copied() else {
            let names: BTreeSet<&String> = self.metadata.iter().map(|(name, _)| name).collect();
            return Err(format!("labels.{label}: there is no metadata record {name:?}, there are {names:?}"));
        };
        let value = named.find_map(|(_, values)| values.get(key));
        value.cloned().map(Some).ok_or_else(|| {
            let keys: Vec<&String> = first.keys().collect();
            format!("labels.{label}: metadata record {name:?} has no key {key:?}, it has {keys:?}")
        })
    }

    fn in_topic(&self, label: &str, source: &TopicLabel, asked: Asked<'_>) -> Result<Option<String>, String> {
        let key = (source.topic.clone(), source.field.clone());
        let TopicLabel { topic, field } = source;
        let Some(values) = self.values.get(&key) else {
            return Err(match self.without.get(&key) {
                None => format!("labels.{label}: no message of {topic} by the end of the episode"),
                Some(n) => format!("labels.{label}: {n} messages of {topic}, none with {field:?}"),
            });
        };
        let mut within = values.iter().filter(|(ns, _)| *ns > asked.start_ns && *ns <= asked.end_ns);
        let found = if label == "success" {
            within.next_back()
        } else {
            let before = values.iter().rev().find(|(ns, _)| *ns <= asked.start_ns);
            before
                .filter(|(_, text)| !text.is_empty())
                .or(within.into_iter().find(|(_, text)| !text.is_empty()))
        };
        let at = if label == "success" { "within the episode" } else { "at its start or within it" };
        let absent = || format!("labels.{label}: no message of {topic} {at}");
        found.map(|(_, text)| Some(text.clone())).ok_or_else(absent)
    }
}
