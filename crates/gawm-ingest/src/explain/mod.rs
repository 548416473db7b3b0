//! Shows where one number of a dataset comes from: the raw messages, the rule and the encoding behind it.

mod dataset;
mod describe;
mod encoded;
mod messages;

use std::fmt::Write as _;
use std::ops::Range;
use std::path::{Path, PathBuf};

use gawm_schema::{Feature, FeatureData, Role};
use thiserror::Error;

use crate::align::Derivation;
use crate::contract::{CheckedContract, ContractError, StreamData, TopicPattern, check, parse};
use crate::decode::{SchemaLibrary, closest_first};
use crate::run::{BindError, Binding, BoundStream, OpenRecording, RunError, split_by_publisher};
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
    #[error("no dimension {dim:?}: the dataset has {}", shown(.known))]
    Dim {
        /// The name asked for.
        dim: String,
        /// Those that are there, the most alike first.
        known: Vec<String>,
    },
    /// Several features have a dimension of this name.
    #[error("dimension {dim:?} is in several features: expected one of {}", choices.join(", "))]
    Ambiguous {
        /// The name asked for.
        dim: String,
        /// The full names.
        choices: Vec<String>,
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
            ExplainError::Episode { .. }
            | ExplainError::Frame { .. }
            | ExplainError::Dim { .. }
            | ExplainError::Ambiguous { .. } => 2,
            _ => 1,
        }
    }
}

/// Names that an error lists.
const LISTED: usize = 40;

fn shown(names: &[String]) -> String {
    match names.len().checked_sub(LISTED) {
        None | Some(0) => names.join(", "),
        Some(more) => format!("{} and {more} more", names[..LISTED].join(", ")),
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
    /// Name of the value (`joint_1`), `feature[3]`, `feature.name`, `gawm.state[3]`, the name of an encoded value
    /// (`joint_1.sin`), or of an image feature.
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
                format!(
                    "{}[{index}] {:?}",
                    self.feature.name,
                    dim.map(|dim| dim.name.as_str()).unwrap_or_default()
                )
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
    let asked = encoded::asked(&meta, question.dim);
    let target = match &asked {
        Some(asked) => asked.target()?,
        None => target(&meta, question.dim)?,
    };
    let place = Place { dir: question.dir, meta: &meta, episode: question.episode };
    let origin = place.origin(question.frame, &target)?;
    let mut text = String::new();
    // Writing to a text cannot fail.
    if let Some(asked) = &asked {
        asked.head(&mut text, question, &origin).ok();
    }
    head(&mut text, question, &target, &origin).ok();
    let contract_text = meta.contracts.iter().find(|contract| contract.hash == origin.recording.contract);
    let contract_text = contract_text.map(|contract| contract.text.as_str()).unwrap_or_default();
    let contract = check(&parse(contract_text, "meta/gawm.json", &[])?, "meta/gawm.json")?;
    let log = OpenSources::open(question, &contract, &origin)?;
    if log.is_none() {
        writeln!(text, "  source: {}", origin.files().join(", ")).ok();
    }
    let explainer = Explainer { place, contract: &contract, log: log.as_ref() };
    // The last action of an episode repeats the one before, which is where its number comes from.
    let is_repeated = target.feature.role == Role::Action && origin.is_last() && !origin.is_valid;
    match question.frame.checked_sub(1).filter(|_| is_repeated) {
        Some(before) => {
            writeln!(
                text,
                "  last row of its episode: no action follows, the one of frame {before} is repeated"
            )
            .ok();
            let origin = place.origin(before, &target)?;
            explainer.value(&mut text, &target, &origin, before)?;
        }
        None => {
            explainer.value(&mut text, &target, &origin, question.frame)?;
            for other in asked.iter().flat_map(encoded::Asked::others) {
                let origin = place.origin(question.frame, &other)?;
                head(&mut text, question, &other, &origin).ok();
                explainer.value(&mut text, &other, &origin, question.frame)?;
            }
        }
    }
    encoded::describe(&mut text, question, &meta, &target, &origin).ok();
    if log.is_none() && !question.logs.is_empty() {
        text.push_str("\nnone of the files given with --log is the source (of the same name or not, its hash decides)\n");
    } else if log.is_none() {
        text.push_str("\nthe raw messages are shown when the source files are given: --log FILE...\n");
    }
    Ok(text)
}

/// An episode of a dataset.
#[derive(Clone, Copy)]
struct Place<'a> {
    dir: &'a Path,
    meta: &'a gawm_dataset::GawmMeta,
    episode: u64,
}

impl Place<'_> {
    fn origin(&self, frame: u64, target: &Target<'_>) -> Result<RowOrigin, ExplainError> {
        dataset::origin(self.dir, self.meta, (self.episode, frame), target.feature, target.index)
    }
}

/// The logs of a recording, and what the contract takes from them.
struct OpenSources {
    open: OpenRecording,
    binding: Binding,
    library: SchemaLibrary,
}

impl OpenSources {
    /// Opens the logs that a row comes from; none when they are not among the files given.
    fn open(
        question: &Question<'_>,
        contract: &CheckedContract,
        origin: &RowOrigin,
    ) -> Result<Option<OpenSources>, ExplainError> {
        let Some(open) = messages::sources(&origin.recording, question.logs, contract)? else {
            return Ok(None);
        };
        let mut library = SchemaLibrary::builtin();
        for folder in &contract.written.schemas {
            // Types that are missing now only keep their channels from being shown.
            library.add_folder(folder).ok();
        }
        let mut binding =
            Binding::new(contract, &open.name, &open.channels, &library).map_err(|error| match error {
                BindError::Run(error) => ExplainError::Run(error),
                BindError::Refused(refusal) => {
                    ExplainError::Log { path: question.dir.to_owned(), detail: refusal.to_string() }
                }
            })?;
        split_by_publisher(&mut binding, &open, &library);
        Ok(Some(OpenSources { open, binding, library }))
    }
}

/// Everything that an answer is made from.
struct Explainer<'a> {
    place: Place<'a>,
    contract: &'a CheckedContract,
    log: Option<&'a OpenSources>,
}

impl Explainer<'_> {
    /// Writes the rule behind a value and the messages it was made from.
    fn value(
        &self,
        text: &mut String,
        target: &Target<'_>,
        origin: &RowOrigin,
        frame: u64,
    ) -> Result<(), ExplainError> {
        let derived = self.contract.streams.iter().find_map(|stream| match &stream.data {
            StreamData::Derived { from, derivation } if stream.feature == target.feature.name => {
                Some((from, *derivation))
            }
            _ => None,
        });
        match (derived, target.index) {
            (Some((from, derivation)), Some(index)) => {
                self.derived(text, (from, derivation), index, origin, frame)
            }
            _ => {
                let columns: Vec<usize> = target.index.into_iter().collect();
                self.measured(text, target.feature, &columns, origin);
                Ok(())
            }
        }
    }

    /// Writes what an action made from two rows of a state was made from.
    fn derived(
        &self,
        text: &mut String,
        (from, derivation): (&str, Derivation),
        index: usize,
        origin: &RowOrigin,
        frame: u64,
    ) -> Result<(), ExplainError> {
        writeln!(text, "  rule: derived from {from}: {}", describe::derivation(derivation)).ok();
        let Some(feature) = self.place.meta.schema.features.iter().find(|feature| feature.name == from)
        else {
            return Ok(());
        };
        let columns: Vec<usize> = source_columns(feature, derivation, index).collect();
        let next = frame + u64::from(!origin.is_last());
        let frames = match derivation {
            Derivation::Next => vec![next],
            Derivation::Difference => vec![frame, next],
        };
        for frame in frames {
            let mut inner = String::new();
            let mut origin = None;
            for &column in &columns {
                let target = Target { feature, index: Some(column) };
                let found = self.place.origin(frame, &target)?;
                let value = found.value.map_or("an image".to_owned(), |value| format!("{value:?}"));
                let valid = if found.is_valid { "valid" } else { "not valid" };
                writeln!(inner, "{} in frame {frame}: {value}{}, {valid}", target.name(), unit_of(&target))
                    .ok();
                origin = Some(found);
            }
            if let Some(origin) = origin {
                writeln!(inner, "  tick {} ns", origin.time_ns).ok();
                self.measured(&mut inner, feature, &columns, &origin);
            }
            inner.lines().for_each(|line| {
                writeln!(text, "  {line}").ok();
            });
        }
        Ok(())
    }

    /// Writes the rule of the stream behind values of a feature, and the messages; no columns for an image.
    fn measured(&self, text: &mut String, feature: &Feature, columns: &[usize], origin: &RowOrigin) {
        let Some(log) = self.log else {
            for stream in self.contract.streams.iter().filter(|stream| stream.feature == feature.name) {
                let topic = stream.topic.as_ref().map(TopicPattern::as_str).unwrap_or_default();
                describe::rule(text, stream, stream.name.as_deref().unwrap_or(topic), topic).ok();
            }
            return;
        };
        let Some((stream, columns)) = stream_of(&log.binding, &feature.name, columns) else { return };
        let bound = &log.binding.streams[stream];
        describe::rule(text, &bound.rule, &bound.name, &bound.topic).ok();
        ages(text, origin, stream).ok();
        let used = messages::around(&log.open, &log.binding, stream, self.contract, origin, &log.library);
        messages::describe(text, bound, &columns, &used).ok();
        messages::arithmetic(text, bound, &used, origin).ok();
    }
}

/// Returns the values of a state that a value of an action derived from it is made of.
fn source_columns(feature: &Feature, derivation: Derivation, index: usize) -> Range<usize> {
    let FeatureData::Vector { parts, .. } = &feature.data else { return 0..0 };
    if derivation == Derivation::Next {
        return index..index + 1;
    }
    let (mut state, mut action) = (0, 0);
    for part in parts {
        let raw = part.kind.raw_width();
        for _ in 0..part.dims.len() / raw {
            let width = if raw > 1 { 3 } else { 1 };
            if index < action + width {
                return state..state + raw;
            }
            state += raw;
            action += width;
        }
    }
    0..0
}

fn target<'a>(meta: &'a gawm_dataset::GawmMeta, name: &str) -> Result<Target<'a>, ExplainError> {
    let features = &meta.schema.features;
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
    match (by_name.pop(), by_name.is_empty()) {
        (Some(only), true) => Ok(only),
        (Some(last), false) => {
            let features =
                by_name.iter().chain([&last]).map(|target| format!("{}.{name}", target.feature.name));
            Err(ExplainError::Ambiguous { dim: name.to_owned(), choices: features.collect() })
        }
        (None, _) => {
            known.extend(encoded::names(meta));
            closest_first(&mut known, name);
            Err(ExplainError::Dim { dim: name.to_owned(), known })
        }
    }
}

/// Returns the stream that values of a feature come from, and which of its values they are.
fn stream_of(binding: &Binding, feature: &str, columns: &[usize]) -> Option<(usize, Vec<usize>)> {
    let mut streams = (0..binding.streams.len()).filter(|&at| binding.streams[at].feature == feature);
    let Some(&first) = columns.first() else { return streams.next().map(|at| (at, Vec::new())) };
    let mut start = 0;
    for at in streams {
        let stream: &BoundStream = &binding.streams[at];
        let StreamData::Vector(rule) = &stream.rule.data else { continue };
        let width = stream.columns.len() * rule.timing.map_or(1, crate::align::ActionTiming::commands);
        if first < start + width {
            let columns = columns.iter().filter_map(|column| column.checked_sub(start));
            return Some((at, columns.map(|column| column % stream.columns.len()).collect()));
        }
        start += width;
    }
    None
}

fn head(
    text: &mut String,
    question: &Question<'_>,
    target: &Target<'_>,
    origin: &RowOrigin,
) -> std::fmt::Result {
    let value = match origin.value {
        Some(value) => format!("{value:?}{}", unit_of(target)),
        None => format!("an image of {} bytes", origin.image_bytes.unwrap_or_default()),
    };
    let valid = if origin.is_valid { "valid" } else { "not valid" };
    writeln!(
        text,
        "{} in episode {}, frame {}: {value}, {valid}",
        target.name(),
        question.episode,
        question.frame
    )?;
    writeln!(text, "  row: {} of {}, tick {} ns", origin.row, origin.file, origin.time_ns)
}

fn unit_of(target: &Target<'_>) -> String {
    let FeatureData::Vector { parts, .. } = &target.feature.data else { return String::new() };
    let dim = parts.iter().flat_map(|part| &part.dims).nth(target.index.unwrap_or_default());
    dim.map(|dim| format!(" {}", dim.unit.0)).filter(|unit| unit != " 1").unwrap_or_default()
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
