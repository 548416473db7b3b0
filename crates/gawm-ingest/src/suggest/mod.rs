//! Writes a first contract from logs, every guess with its reason.
//!
//! [`suggest`] looks at the logs (`survey`), decides what each topic is (`guess`), measures how commands and
//! states hang together (`measure`, `lag`) and writes the contract with comments (`render`).

mod clock;
mod commands;
mod episodes;
mod fields;
mod guess;
mod lag;
mod measure;
mod names;
mod render;
mod rows;
mod stream_names;
mod survey;
mod transforms;
mod urdf;

use std::collections::{BTreeMap, BTreeSet};
use std::path::PathBuf;

use thiserror::Error;

use crate::contract::{Contract, LabelSource};
use crate::decode::{FieldInfo, FieldPath, Scalar, SchemaLibrary, Segment};
use crate::lerobot::{self, LerobotRecording};
use crate::log::{OpenLogError, OpenOptions, discover};
use crate::tabular;

pub use survey::DecodingProbe;

/// Other fields of a mapped topic that are named.
const MAX_OTHERS: usize = 12;

/// Why no contract can be suggested.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SuggestError {
    /// No log can be read.
    #[error("no log can be read: {}", reasons.join("; "))]
    NoLog {
        /// Why, one per input.
        reasons: Vec<String>,
        /// What to do about the first.
        hint: Option<String>,
    },
    /// No topic holds numbers or images that can be decoded.
    #[error("no topic holds numbers or images that can be mapped; the log has {}", topics.join(", "))]
    NothingToMap {
        /// Topics, each with what keeps it from being mapped.
        topics: Vec<String>,
    },
    /// A log cannot be opened again.
    #[error(transparent)]
    Open(#[from] OpenLogError),
}

impl SuggestError {
    /// Returns what the reader can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            SuggestError::NoLog { hint, .. } => hint.clone(),
            SuggestError::NothingToMap { .. } => {
                Some("`gawm-ingest inspect LOG` says why topics cannot be decoded; `schemas = [folder]` gives types that the log lacks".to_owned())
            }
            SuggestError::Open(error) => error.hint(),
        }
    }
}

/// A contract with its reasons.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Suggestion {
    /// The contract.
    pub contract: Contract,
    /// Reasons for each stream.
    pub stream_reasons: Vec<Vec<String>>,
    /// Reasons for other keys: section to lines.
    pub reasons: BTreeMap<&'static str, Vec<String>>,
    /// Topics that are not mapped, and why.
    pub unmapped: Vec<String>,
}

/// Suggests a contract for logs.
///
/// # Errors
/// No log can be read, or none of their topics can be mapped.
pub fn suggest(
    inputs: &[PathBuf],
    library: &SchemaLibrary,
    options: &OpenOptions,
) -> Result<Suggestion, SuggestError> {
    if let Some(suggestion) = of_rows(inputs) {
        return suggestion;
    }
    let survey = survey::survey(inputs, library, options)?;
    let mut suggestion = guess::guess(&survey, library);
    if suggestion.contract.stream.is_empty() {
        return Err(SuggestError::NothingToMap { topics: suggestion.unmapped });
    }
    measure::refine(&mut suggestion, &survey, library);
    episodes::guess(&mut suggestion, &survey);
    stream_names::name_streams(&mut suggestion.contract);
    remove_used(&mut suggestion);
    name_other_fields(&mut suggestion, &survey);
    Ok(suggestion)
}

/// Topics that labels, episodes or calibrations come from are used, though they are no columns.
fn remove_used(suggestion: &mut Suggestion) {
    let contract = &suggestion.contract;
    let labels = &contract.labels;
    let of_labels = [&labels.task, &labels.success, &labels.operator, &labels.robot, &labels.session];
    let of_labels = of_labels.into_iter().flatten().filter_map(|source| match source {
        LabelSource::Topic(label) => Some(&label.topic),
        _ => None,
    });
    let infos = contract.stream.iter().filter_map(|stream| stream.image.as_ref()?.camera_info.as_ref());
    let used: Vec<String> =
        of_labels.chain(&contract.episodes.topic).chain(infos).map(|topic| format!("{topic} (")).collect();
    suggestion.unmapped.retain(|line| !used.iter().any(|topic| line.starts_with(topic)));
}

/// Names the numbers of mapped topics that are no columns.
fn name_other_fields(suggestion: &mut Suggestion, survey: &survey::Survey) {
    let mut taken: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    for stream in suggestion.contract.stream.iter().filter(|stream| !stream.fields.is_empty()) {
        if let Some(topic) = &stream.topic {
            taken.entry(topic).or_default().extend(stream.fields.iter().map(|field| leaf_of(field)));
        }
    }
    let mut lines = Vec::new();
    for (name, taken) in taken {
        let Some(topic) = survey.topics.get(name) else { continue };
        let is_taken = |path: &str| {
            taken.iter().any(|leaf| {
                path.strip_prefix(leaf.as_str())
                    .is_some_and(|rest| rest.is_empty() || rest.starts_with(['.', '[']))
            })
        };
        let is_number = |field: &&FieldInfo| field.scalar.is_some_and(|scalar| scalar != Scalar::Text);
        let others: Vec<&str> = topic
            .fields
            .iter()
            .filter(is_number)
            .map(|field| field.path.as_str())
            .filter(|path| !is_taken(path) && !names::is_bookkeeping(path))
            .filter(|path| !path.contains("stamp.") && !names::is_setting(topic.type_name(), path))
            .collect();
        if !others.is_empty() {
            let more = if others.len() > MAX_OTHERS { ", ..." } else { "" };
            let shown = others[..others.len().min(MAX_OTHERS)].join(", ");
            lines.push(format!("{name} also holds {shown}{more}"));
        }
    }
    suggestion.unmapped.extend(lines);
}

/// Returns a path as lists of fields have it: `joints[name="a"].q[0:3]` is `joints[].q[]`.
fn leaf_of(field: &str) -> String {
    let Ok(path) = field.parse::<FieldPath>() else { return field.to_owned() };
    let mut leaf = String::new();
    for segment in path.segments() {
        match segment {
            Segment::Field(name) if leaf.is_empty() => leaf.push_str(name),
            Segment::Field(name) => leaf.extend([".", name]),
            _ => leaf.push_str("[]"),
        }
    }
    leaf
}

/// Suggests from the first input, if that is a table or a LeRobot folder.
fn of_rows(inputs: &[PathBuf]) -> Option<Result<Suggestion, SuggestError>> {
    let found = discover(inputs);
    let path = found.recordings.first()?.parts.first()?;
    let unreadable = |error: String, hint: Option<&str>| SuggestError::NoLog {
        reasons: vec![error],
        hint: hint.map(Into::into),
    };
    let suggestion = if lerobot::is_dataset(path) {
        LerobotRecording::open(path)
            .map(|recording| rows::of_lerobot(&recording))
            .map_err(|error| unreadable(error.to_string(), error.hint()))
    } else if path.is_file() && tabular::sniff(path).is_ok_and(|format| format.is_some()) {
        tabular::open(path, &tabular::Limits::default())
            .map_err(|error| unreadable(error.to_string(), error.hint()))
            .and_then(|table| {
                let report = tabular::report(&table, None);
                match &report.no_layout {
                    Some(why) => Err(unreadable(format!("{why}: {}", path.display()), None)),
                    None => Ok(rows::of_table(&report)),
                }
            })
    } else {
        return None;
    };
    Some(suggestion.and_then(|suggestion| match suggestion.contract.stream.is_empty() {
        true => Err(SuggestError::NothingToMap { topics: suggestion.unmapped }),
        false => Ok(suggestion),
    }))
}

/// Returns the contract as TOML with comments.
pub fn to_toml(suggestion: &Suggestion) -> String {
    render::render(suggestion)
}
