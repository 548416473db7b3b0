//! Shows where one number of a dataset comes from: the raw messages, the rule and the encoding behind it.

mod dataset;
mod messages;

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use gawm_schema::{Feature, FeatureData, Kind};
use thiserror::Error;

use crate::contract::{CheckedContract, CheckedStream, Clock, ContractError, StreamData, check, parse};
use crate::run::{BindError, Binding, BoundStream, RunError};
use dataset::RowOrigin;

/// Why a number cannot be explained.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ExplainError {
    /// A file of the dataset cannot be read.
    #[error("cannot read {path:?}: {detail}")]
    Dataset {
        /// The file.
        path: PathBuf,
        /// Why.
        detail: String,
    },
    /// There is no such episode.
    #[error("no episode {episode}: the dataset has episodes 0 to {}", episodes.saturating_sub(1))]
    Episode {
        /// The number asked for.
        episode: u64,
        /// Number of episodes.
        episodes: u64,
    },
    /// There is no such frame.
    #[error("no frame {frame} in episode {episode}, which has {length}")]
    Frame {
        /// The episode.
        episode: u64,
        /// The number asked for.
        frame: u64,
        /// Its length.
        length: u64,
    },
    /// There is no such dimension.
    #[error("no dimension {dim:?}: the dataset has {}", known.join(", "))]
    Dim {
        /// The name asked for.
        dim: String,
        /// Those that are there.
        known: Vec<String>,
    },
    /// The contract in the dataset cannot be read.
    #[error(transparent)]
    Contract(#[from] ContractError),
    /// The contract does not fit the log.
    #[error(transparent)]
    Run(#[from] RunError),
    /// A log cannot be read.
    #[error("cannot read {path:?}: {detail}")]
    Log {
        /// The file.
        path: PathBuf,
        /// Why.
        detail: String,
    },
}

impl ExplainError {
    /// Returns the exit code: 2 when the question is wrong, else 1.
    pub fn exit_code(&self) -> u8 {
        match self {
            ExplainError::Episode { .. } | ExplainError::Frame { .. } | ExplainError::Dim { .. } => 2,
            _ => 1,
        }
    }
}

/// What is asked.
#[derive(Debug, Clone)]
pub struct Question<'a> {
    /// Folder of the dataset.
    pub dir: &'a Path,
    /// Number of the episode.
    pub episode: u64,
    /// Number of the frame in it.
    pub frame: u64,
    /// Name of the value (`joint_1`), `feature[3]`, `feature.name`, or the name of an image feature.
    pub dim: &'a str,
    /// Files and folders in which the sources are looked for, by their hash.
    pub logs: &'a [PathBuf],
}

/// A value of the dataset: a dim of a vector feature, or an image.
struct Target<'a> {
    feature: &'a Feature,
    /// Position within the feature; none for images.
    index: Option<usize>,
}

impl Target<'_> {
    fn name(&self) -> String {
        match (&self.feature.data, self.index) {
            (FeatureData::Vector { parts, .. }, Some(index)) => {
                let dim = parts.iter().flat_map(|part| &part.dims).nth(index);
                format!("{}[{index}] {:?}", self.feature.name, dim.map(|dim| dim.name.as_str()).unwrap_or_default())
            }
            _ => self.feature.name.clone(),
        }
    }
}

/// Answers a question in text.
///
/// # Errors
/// The dataset or a source cannot be read, or the question names something that is not there.
pub fn explain(question: &Question<'_>) -> Result<String, ExplainError> {
    let meta = dataset::meta(question.dir)?;
    let target = target(&meta.schema.features, question.dim)?;
    let origin = dataset::origin(question.dir, &meta, question, target.feature, target.index)?;
    let mut text = String::new();
    // Writing to a text cannot fail.
    row(&mut text, question, &target, &origin).ok();
    let contract_text = meta.contracts.iter().find(|contract| contract.hash == origin.recording.contract);
    let contract_text = contract_text.map(|contract| contract.text.as_str()).unwrap_or_default();
    let contract = check(&parse(contract_text, "meta/gawm.json", &[])?, "meta/gawm.json")?;
    let found = messages::sources(&origin.recording, question.logs)?;
    let Some(open) = found else {
        writeln!(text, "  source: {}", origin.files().join(", ")).ok();
        rules_without_log(&mut text, &contract, &target);
        encoding(&mut text, &meta, &target);
        text.push_str("\nthe raw messages are shown when the source files are given: --log FILE...\n");
        return Ok(text);
    };
    let mut library = crate::decode::SchemaLibrary::builtin();
    for folder in &contract.written.schemas {
        // Types that are missing now only keep their channels from being shown.
        library.add_folder(folder).ok();
    }
    let binding = Binding::new(&contract, &open.name, &open.channels, &library).map_err(|error| match error {
        BindError::Run(error) => ExplainError::Run(error),
        BindError::Refused(refusal) => ExplainError::Log { path: question.dir.to_owned(), detail: refusal.to_string() },
    })?;
    match stream_of(&binding, &target) {
        Some((stream, columns)) => {
            rule(&mut text, &binding.streams[stream].rule, &binding.streams[stream].topic).ok();
            ages(&mut text, &origin, stream).ok();
            let used = messages::around(&open, &binding, stream, &contract, &origin, &library);
            messages::describe(&mut text, &binding.streams[stream], columns, &used).ok();
        }
        None => text.push_str("  rule: derived from the state of this row and the next; there is no message behind it\n"),
    }
    encoding(&mut text, &meta, &target);
    Ok(text)
}

fn target<'a>(features: &'a [Feature], name: &str) -> Result<Target<'a>, ExplainError> {
    let mut known = Vec::new();
    let mut by_name = Vec::new();
    for feature in features {
        let FeatureData::Vector { parts, .. } = &feature.data else {
            if feature.name == name {
                return Ok(Target { feature, index: None });
            }
            known.push(feature.name.clone());
            continue;
        };
        for (index, dim) in parts.iter().flat_map(|part| &part.dims).enumerate() {
            let full = format!("{}.{}", feature.name, dim.name);
            if name == full || name == format!("{}[{index}]", feature.name) {
                return Ok(Target { feature, index: Some(index) });
            }
            if dim.name == name {
                by_name.push(Target { feature, index: Some(index) });
            }
            known.push(full);
        }
    }
    if by_name.len() == 1 {
        return by_name.pop().ok_or(ExplainError::Dim { dim: name.to_owned(), known });
    }
    Err(ExplainError::Dim { dim: name.to_owned(), known })
}

/// Returns the stream that a value comes from, and which of its values it is.
fn stream_of(binding: &Binding, target: &Target<'_>) -> Option<(usize, Option<usize>)> {
    let streams = (0..binding.streams.len()).filter(|&at| binding.streams[at].feature == target.feature.name);
    let Some(mut index) = target.index else { return streams.into_iter().next().map(|at| (at, None)) };
    for at in streams {
        let stream: &BoundStream = &binding.streams[at];
        let StreamData::Vector(rule) = &stream.rule.data else { continue };
        let width = stream.columns.len() * rule.timing.map_or(1, crate::align::ActionTiming::commands);
        if index < width {
            return Some((at, Some(index % stream.columns.len())));
        }
        index -= width;
    }
    None
}

fn row(text: &mut String, question: &Question<'_>, target: &Target<'_>, origin: &RowOrigin) -> std::fmt::Result {
    let value = match origin.value {
        Some(value) => format!("{value:?}{}", unit_of(target)),
        None => format!("an image of {} bytes", origin.image_bytes.unwrap_or_default()),
    };
    let valid = if origin.is_valid { "valid" } else { "not valid" };
    writeln!(text, "{} in episode {}, frame {}: {value}, {valid}", target.name(), question.episode, question.frame)?;
    writeln!(text, "  row: {} of {}, tick {} ns", origin.row, origin.file, origin.time_ns)
}

fn unit_of(target: &Target<'_>) -> String {
    let FeatureData::Vector { parts, .. } = &target.feature.data else { return String::new() };
    let dim = parts.iter().flat_map(|part| &part.dims).nth(target.index.unwrap_or_default());
    dim.map(|dim| format!(" {}", dim.unit.0)).filter(|unit| unit != " 1").unwrap_or_default()
}

fn rules_without_log(text: &mut String, contract: &CheckedContract, target: &Target<'_>) {
    for stream in contract.streams.iter().filter(|stream| stream.feature == target.feature.name) {
        let topic = stream.topic.as_ref().map(crate::contract::TopicPattern::as_str).unwrap_or_default();
        // Writing to a text cannot fail.
        rule(text, stream, topic).ok();
    }
}

fn rule(text: &mut String, stream: &CheckedStream, topic: &str) -> std::fmt::Result {
    let clock = match &stream.clock {
        Clock::Stamp => "header stamp (publish time where there is none)".to_owned(),
        Clock::Publish => "publish time".to_owned(),
        Clock::Log => "log time".to_owned(),
        Clock::Field(path) => format!("field {path}"),
    };
    let tolerance =
        stream.tolerance_ns.map_or("no tolerance".to_owned(), |ns| format!("tolerance {} ms", ns as f64 / 1e6));
    writeln!(
        text,
        "  stream: {:?}, topic {topic}, clock: {clock}, offset {} ms",
        stream.name.as_deref().unwrap_or_default(),
        stream.offset_ns as f64 / 1e6
    )?;
    let how = match &stream.data {
        StreamData::Vector(rule) => match rule.timing {
            Some(timing) => format!("action {timing:?}"),
            None => format!("{:?}", stream.align).to_lowercase(),
        },
        StreamData::Image(_) => format!("{:?}", stream.align).to_lowercase(),
        StreamData::Derived { from, derivation } => format!("derived from {from}: {derivation:?}"),
    };
    writeln!(text, "  rule: {how}, {tolerance}, gap {:?}", stream.gap)?;
    if let StreamData::Vector(rule) = &stream.data
        && !rule.unit.is_identity()
    {
        writeln!(text, "  conversion: recorded * {} + {} = {}", rule.unit.factor, rule.unit.offset, rule.unit.si.0)?;
    }
    Ok(())
}

fn ages(text: &mut String, origin: &RowOrigin, stream: usize) -> std::fmt::Result {
    let shown = |ages: &[f32]| match ages.get(stream) {
        Some(age) if age.is_finite() => format!("{age} ms"),
        _ => "unknown".to_owned(),
    };
    writeln!(
        text,
        "  age: {} by the contract's clock, {} by arrival",
        shown(&origin.age_ms),
        shown(&origin.arrival_age_ms)
    )
}

fn encoding(text: &mut String, meta: &gawm_dataset::GawmMeta, target: &Target<'_>) {
    let FeatureData::Vector { parts, .. } = &target.feature.data else { return };
    let Some(dim) = parts.iter().flat_map(|part| &part.dims).nth(target.index.unwrap_or_default()) else { return };
    let kind = parts.iter().find(|part| part.dims.iter().any(|other| other.name == dim.name)).map(|part| part.kind);
    writeln!(text, "  kind: {}", kind.map(shown_kind).unwrap_or_default()).ok();
    for (column, dims) in &meta.encodings {
        for (position, encoded) in dims.iter().enumerate() {
            if encoded.feature != target.feature.name || !encoded.raw_dims.contains(&dim.name) {
                continue;
            }
            let standard = meta.standardisation.iter().find(|fit| fit.column == *column);
            let fit = standard.and_then(|fit| fit.dims.get(position));
            let standardised = match fit {
                Some(fit) if fit.is_standardised && fit.is_constant => "constant in the training data: scale 1".to_owned(),
                Some(fit) if fit.is_standardised => format!("standardised as (x - {:?}) / {:?}", fit.mean, fit.scale),
                _ => "not standardised".to_owned(),
            };
            writeln!(
                text,
                "  encoding: {column}[{position}] {:?} ({:?} of {}), {standardised}",
                encoded.name,
                encoded.encoding,
                encoded.raw_dims.join(", ")
            )
            .ok();
        }
    }
}

fn shown_kind(kind: Kind) -> String {
    format!("{kind:?}")
}
