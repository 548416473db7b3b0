//! Fits a contract to the topics of a log: which message gives which values of which stream.

use std::collections::BTreeMap;

use gawm_schema::{
    Dim, Feature, FeatureData, FloatType, ImageSpec, Kind, Part, Role, Schema, StreamInfo, Unit,
};

use super::{Refusal, RunError};
use crate::align::{AlignRule, Derivation, FeatureRule, GapAction, Method, PartKind, StreamRule, Ticks};
use crate::contract::{
    AlignSpec, CheckedContract, CheckedStream, Clock, GapRule, ImageRule, NonFiniteRule, StreamData,
    TickRule, VectorRule,
};
use crate::decode::{CompileError, FieldPath, SchemaLibrary, Segment};
use crate::log::Channel;
use crate::run::plan::{compile_vector, schema_of};

/// A contract with the topics of one log filled in.
#[derive(Debug)]
pub struct Binding {
    /// The streams; derived actions have none.
    pub streams: Vec<BoundStream>,
    /// The features, in column order.
    pub features: Vec<BoundFeature>,
}

/// A stream of one topic.
#[derive(Debug, Clone, PartialEq)]
pub struct BoundStream {
    /// Unique name.
    pub name: String,
    /// Its topic.
    pub topic: String,
    /// Its column.
    pub feature: String,
    /// The rules of the contract.
    pub rule: CheckedStream,
    /// Parsed paths; empty for images.
    pub fields: Vec<FieldPath>,
    /// Path of each value, slices written out; empty for images.
    pub columns: Vec<String>,
}

/// A column of the dataset.
#[derive(Debug, Clone, PartialEq)]
pub struct BoundFeature {
    /// Its name.
    pub name: String,
    /// What it is for.
    pub role: Role,
    /// What it is made of.
    pub source: FeatureSource,
}

/// What a column is made of.
#[derive(Debug, Clone, PartialEq)]
pub enum FeatureSource {
    /// Values of streams, in order.
    Streams(Vec<usize>),
    /// Images of a stream.
    Image(usize),
    /// Another feature.
    Derived {
        /// Index of the feature.
        from: usize,
        /// How.
        derivation: Derivation,
    },
}

/// Why a contract does not fit a log: the run stops, or the recording is refused.
#[derive(Debug)]
pub enum BindError {
    /// The run stops.
    Run(RunError),
    /// The recording is refused.
    Refused(Refusal),
}

impl From<RunError> for BindError {
    fn from(error: RunError) -> Self {
        BindError::Run(error)
    }
}

impl Binding {
    /// Fits a contract to the channels of a log, which is only named in errors.
    pub fn new(
        contract: &CheckedContract,
        log: &str,
        channels: &[std::sync::Arc<Channel>],
        library: &SchemaLibrary,
    ) -> Result<Binding, BindError> {
        let mut topics: BTreeMap<&str, Vec<&Channel>> = BTreeMap::new();
        for channel in channels {
            topics.entry(&channel.topic).or_default().push(channel);
        }
        let mut binding = Binding { streams: Vec::new(), features: Vec::new() };
        for rule in &contract.streams {
            let context = Context { contract, log, topics: &topics, library };
            context.add(rule, &mut binding)?;
        }
        binding.derive(contract)?;
        Ok(binding)
    }

    /// Adds the derived actions, once all features they can be made from are known.
    fn derive(&mut self, contract: &CheckedContract) -> Result<(), RunError> {
        for rule in &contract.streams {
            let StreamData::Derived { from, derivation } = &rule.data else { continue };
            let wrong = |detail: String| RunError::Feature {
                file: contract.file.clone(),
                feature: rule.feature.clone(),
                detail,
            };
            let Some(at) = self.features.iter().position(|feature| feature.name == *from) else {
                return Err(wrong(format!("made from {from:?}, which is no feature")));
            };
            if self.features.iter().any(|feature| feature.name == rule.feature) {
                return Err(wrong("a derived action cannot share a feature with other streams".to_owned()));
            }
            self.features.push(BoundFeature {
                name: rule.feature.clone(),
                role: Role::Action,
                source: FeatureSource::Derived { from: at, derivation: *derivation },
            });
        }
        Ok(())
    }

    /// Returns what the aligner needs to know.
    pub fn align_rule(&self, contract: &CheckedContract) -> Result<AlignRule, RunError> {
        let streams: Vec<StreamRule> = self.streams.iter().map(stream_rule).collect();
        let features = self
            .features
            .iter()
            .map(|feature| match &feature.source {
                FeatureSource::Streams(streams) => FeatureRule::Vector { streams: streams.clone() },
                FeatureSource::Image(stream) => FeatureRule::Image { stream: *stream },
                FeatureSource::Derived { from, derivation } => FeatureRule::Derived {
                    from: *from,
                    derivation: *derivation,
                    parts: self.part_kinds(*from),
                },
            })
            .collect();
        let ticks = match &contract.ticks {
            TickRule::Fixed { rate_hz } => Ticks::Fixed { rate_hz: *rate_hz },
            TickRule::Reference { stream } => {
                let found = self.streams.iter().position(|bound| bound.name == *stream);
                let Some(stream) = found else {
                    return Err(RunError::Feature {
                        file: contract.file.clone(),
                        feature: stream.clone(),
                        detail: "the reference stream of the ticks is not in the log".to_owned(),
                    });
                };
                Ticks::Reference { stream }
            }
        };
        let max_gap_ns = match contract.episodes {
            crate::contract::EpisodeRule::Gap { gap_ns } => gap_ns,
            _ => contract.max_gap_ns,
        };
        Ok(AlignRule { streams, features, ticks, max_gap_ns })
    }

    fn part_kinds(&self, feature: usize) -> Vec<PartKind> {
        match &self.features[feature].source {
            FeatureSource::Streams(streams) => {
                streams.iter().flat_map(|&stream| stream_rule(&self.streams[stream]).parts).collect()
            }
            _ => Vec::new(),
        }
    }

    /// Returns the schema of the dataset; `sizes` are those of the images of each stream, in the dataset.
    pub fn schema(
        &self,
        contract: &CheckedContract,
        rate_hz: f64,
        sizes: &BTreeMap<usize, ImageSpec>,
    ) -> Result<Schema, RunError> {
        let mut features = Vec::new();
        for feature in &self.features {
            let data = match &feature.source {
                FeatureSource::Streams(streams) => FeatureData::Vector {
                    dtype: float_type(contract),
                    parts: self.parts(contract, &feature.name, streams)?,
                },
                FeatureSource::Image(stream) => {
                    let size = sizes.get(stream).cloned();
                    FeatureData::Image(size.unwrap_or(ImageSpec {
                        height: 0,
                        width: 0,
                        channels: 3,
                        depth: false,
                    }))
                }
                FeatureSource::Derived { from, derivation } => {
                    let FeatureSource::Streams(streams) = &self.features[*from].source else { continue };
                    let parts = self.parts(contract, &feature.name, streams)?;
                    FeatureData::Vector {
                        dtype: float_type(contract),
                        parts: derived_parts(parts, *derivation),
                    }
                }
            };
            features.push(Feature { name: feature.name.clone(), role: feature.role, data });
        }
        let streams = self
            .streams
            .iter()
            .map(|stream| StreamInfo {
                name: stream.name.clone(),
                source: stream.topic.clone(),
                role: Some(stream.rule.role),
            })
            .collect();
        Ok(Schema { robot_type: contract.written.robot_type.clone(), rate_hz, features, streams })
    }

    fn parts(
        &self,
        contract: &CheckedContract,
        feature: &str,
        streams: &[usize],
    ) -> Result<Vec<Part>, RunError> {
        let mut parts = Vec::new();
        let mut names: BTreeMap<String, usize> = BTreeMap::new();
        for &index in streams {
            let stream = &self.streams[index];
            let StreamData::Vector(rule) = &stream.rule.data else { continue };
            let commands = rule.timing.map_or(1, crate::align::ActionTiming::commands);
            let mut dims = Vec::new();
            for command in 0..commands {
                for (column, path) in stream.columns.iter().enumerate() {
                    let mut name = dim_name(rule, &stream.fields, column, path);
                    if commands > 1 {
                        name = format!("{name}@{command}");
                    }
                    let count = names.entry(name.clone()).or_default();
                    *count += 1;
                    if *count > 1 {
                        name = format!("{}.{name}", stream.name);
                    }
                    dims.push(Dim {
                        name,
                        unit: rule.unit.si.clone(),
                        source: format!("{}:{path}", stream.topic),
                        limits: limits_of(rule, column),
                    });
                }
            }
            parts.push(Part { kind: rule.kind, frame: rule.frame.clone(), dims });
        }
        let mut seen = std::collections::BTreeSet::new();
        for dim in parts.iter().flat_map(|part| &part.dims) {
            if !seen.insert(&dim.name) {
                return Err(RunError::Feature {
                    file: contract.file.clone(),
                    feature: feature.to_owned(),
                    detail: format!("two values are named {:?}; give the streams `names`", dim.name),
                });
            }
        }
        Ok(parts)
    }
}

fn float_type(contract: &CheckedContract) -> FloatType {
    contract.written.float
}

fn derived_parts(parts: Vec<Part>, derivation: Derivation) -> Vec<Part> {
    if derivation == Derivation::Next {
        return parts;
    }
    let change = |part: Part| -> Part {
        let raw = part.kind.raw_width();
        if raw == 1 {
            return Part { kind: Kind::Linear, ..part };
        }
        let dims = part.dims.chunks(raw).flat_map(|dims| {
            ["rx", "ry", "rz"].map(|axis| Dim {
                name: format!("{}.{axis}", dims[0].name),
                unit: Unit("rad".to_owned()),
                source: dims[0].source.clone(),
                limits: None,
            })
        });
        Part { kind: Kind::Rotvec, frame: part.frame, dims: dims.collect() }
    };
    let without_limits = |mut part: Part| -> Part {
        part.dims.iter_mut().for_each(|dim| dim.limits = None);
        part
    };
    parts.into_iter().map(change).map(without_limits).collect()
}

fn limits_of(rule: &VectorRule, column: usize) -> Option<[f64; 2]> {
    let limits = if rule.limits.len() == 1 { rule.limits.first() } else { rule.limits.get(column) }?;
    let ends = limits.map(|limit| rule.unit.apply(limit));
    Some(if ends[0] <= ends[1] { ends } else { [ends[1], ends[0]] })
}

/// Returns the name of a value: as given, else the name that picks it, else the end of its path.
fn dim_name(rule: &VectorRule, fields: &[FieldPath], column: usize, path: &str) -> String {
    if let Some(name) = rule.names.get(column) {
        return name.clone();
    }
    let parsed = path.parse::<FieldPath>().ok();
    let segments = parsed.as_ref().or(fields.first()).map(FieldPath::segments).unwrap_or_default();
    let picked = segments.iter().rev().find_map(|segment| match segment {
        Segment::Key { value, .. } => Some(value.clone()),
        _ => None,
    });
    let mut tail: Vec<String> = Vec::new();
    for segment in segments.iter().rev() {
        match segment {
            Segment::Field(name) => {
                tail.push(name.clone());
                if tail.len() == 2 || picked.is_some() {
                    break;
                }
            }
            Segment::Index(index) => match tail.last_mut() {
                None => tail.push(format!("#{index}")),
                Some(last) => *last = format!("{index}.{last}"),
            },
            Segment::Key { .. } | Segment::Slice { .. } => break,
        }
    }
    tail.reverse();
    let tail = tail.join("_").replace("_#", "_").replace('#', "");
    match picked {
        Some(picked) if tail.is_empty() => format!("{picked}{}", array_suffix(segments)),
        Some(picked) if tail == "position" => picked,
        Some(picked) => format!("{picked}.{tail}"),
        None => tail,
    }
}

/// Tells velocities and efforts of a joint from its position, by the array that it is picked from.
fn array_suffix(segments: &[Segment]) -> String {
    let picked = segments.iter().rposition(|segment| matches!(segment, Segment::Key { .. }));
    match picked.and_then(|at| segments[..at].last()) {
        Some(Segment::Field(array)) if array != "position" && array != "positions" => format!(".{array}"),
        _ => String::new(),
    }
}

fn stream_rule(stream: &BoundStream) -> StreamRule {
    let rule = &stream.rule;
    let (parts, timing) = match &rule.data {
        StreamData::Vector(vector) => {
            (vec![PartKind { kind: vector.kind, width: stream.columns.len() }], vector.timing)
        }
        _ => (Vec::new(), None),
    };
    StreamRule {
        name: stream.name.clone(),
        width: stream.columns.len(),
        parts,
        method: match rule.align {
            _ if timing.is_some() => Method::Asof,
            AlignSpec::Asof | AlignSpec::Hold => Method::Asof,
            AlignSpec::Nearest => Method::Nearest,
            AlignSpec::Linear | AlignSpec::Slerp => Method::Interpolate,
        },
        tolerance_ns: rule.tolerance_ns,
        gap: match rule.gap {
            GapRule::Split => GapAction::Split,
            GapRule::Mask => GapAction::Mask,
            GapRule::DropEpisode => GapAction::DropEpisode,
            GapRule::Fail => GapAction::Fail,
        },
        timing,
        split_non_finite: rule.non_finite == NonFiniteRule::Gap,
    }
}

/// Returns whether no contract could map anything of such a channel.
fn is_fault_of_log(error: &CompileError) -> bool {
    matches!(
        error,
        CompileError::UnsupportedEncoding { .. }
            | CompileError::NoSchema { .. }
            | CompileError::BadSchema { .. }
            | CompileError::ServiceSchema { .. }
            | CompileError::UnknownType { .. }
    )
}

struct Context<'a> {
    contract: &'a CheckedContract,
    log: &'a str,
    topics: &'a BTreeMap<&'a str, Vec<&'a Channel>>,
    library: &'a SchemaLibrary,
}

impl Context<'_> {
    fn names(&self) -> Vec<String> {
        self.topics.keys().map(|topic| (*topic).to_owned()).collect()
    }

    fn add(&self, rule: &CheckedStream, binding: &mut Binding) -> Result<(), BindError> {
        let Some(pattern) = &rule.topic else { return Ok(()) };
        let matches: Vec<(&str, Vec<String>)> =
            self.topics.keys().filter_map(|topic| Some((*topic, pattern.captures(topic)?))).collect();
        if matches.is_empty() && pattern.is_glob() {
            return Err(BindError::Run(RunError::NoMatch {
                file: self.contract.file.clone(),
                index: rule.index,
                log: self.log.to_owned(),
                pattern: pattern.as_str().to_owned(),
                topics: self.names(),
            }));
        }
        if matches.is_empty() {
            return Err(BindError::Refused(Refusal::MissingTopic {
                stream: rule.name.clone().unwrap_or_default(),
                topic: pattern.as_str().to_owned(),
                topics: self.names(),
            }));
        }
        for (topic, captures) in matches {
            self.add_topic(rule, topic, &captures, binding)?;
        }
        Ok(())
    }

    fn add_topic(
        &self,
        rule: &CheckedStream,
        topic: &str,
        captures: &[String],
        binding: &mut Binding,
    ) -> Result<(), BindError> {
        let is_glob = rule.topic.as_ref().is_some_and(crate::contract::TopicPattern::is_glob);
        let base = topic.trim_matches('/').replace('/', "_");
        let name = match &rule.name {
            Some(name) if is_glob => format!("{name}_{base}"),
            Some(name) => name.clone(),
            None => base,
        };
        let feature = captures.iter().enumerate().fold(rule.feature.clone(), |feature, (index, text)| {
            feature.replace(&format!("{{{}}}", index + 1), &text.replace('/', "_"))
        });
        let mut stream = BoundStream {
            name,
            topic: topic.to_owned(),
            feature: feature.clone(),
            rule: rule.clone(),
            fields: Vec::new(),
            columns: Vec::new(),
        };
        match &rule.data {
            StreamData::Vector(vector) => self.fill_columns(vector, &mut stream)?,
            StreamData::Image(ImageRule { .. }) | StreamData::Derived { .. } => {}
        }
        if binding.streams.iter().any(|other| other.name == stream.name) {
            stream.name = format!("{}_{}", stream.name, rule.index);
        }
        let index = binding.streams.len();
        self.add_feature(&feature, &stream, index, binding)?;
        binding.streams.push(stream);
        Ok(())
    }

    fn add_feature(
        &self,
        name: &str,
        stream: &BoundStream,
        index: usize,
        binding: &mut Binding,
    ) -> Result<(), BindError> {
        let is_image = matches!(stream.rule.data, StreamData::Image(_));
        let wrong = |detail: &str| {
            BindError::Run(RunError::Feature {
                file: self.contract.file.clone(),
                feature: name.to_owned(),
                detail: detail.to_owned(),
            })
        };
        match binding.features.iter_mut().find(|feature| feature.name == name) {
            None => binding.features.push(BoundFeature {
                name: name.to_owned(),
                role: stream.rule.role,
                source: if is_image {
                    FeatureSource::Image(index)
                } else {
                    FeatureSource::Streams(vec![index])
                },
            }),
            Some(feature) if feature.role != stream.rule.role => {
                return Err(wrong("its streams have different roles"));
            }
            Some(BoundFeature { source: FeatureSource::Streams(streams), .. }) if !is_image => {
                streams.push(index)
            }
            Some(_) => {
                return Err(wrong(
                    "an image feature has one stream; use {1} in the name where a pattern matches several topics",
                ));
            }
        }
        Ok(())
    }

    fn fill_columns(&self, rule: &VectorRule, stream: &mut BoundStream) -> Result<(), BindError> {
        let parsed: Result<Vec<FieldPath>, _> =
            rule.fields.iter().map(|text| text.parse::<FieldPath>()).collect();
        stream.fields = parsed.map_err(|source| RunError::Path {
            file: self.contract.file.clone(),
            stream: stream.name.clone(),
            source,
        })?;
        let channels = &self.topics[stream.topic.as_str()];
        // A topic may have channels of several types; the first that has the fields decides.
        let mut first_error = None;
        for channel in channels {
            match compile_vector(&schema_of(channel), &stream.fields, &Clock::Log, self.library) {
                Ok(plan) => {
                    stream.columns = plan.columns();
                    break;
                }
                Err(error) => first_error = first_error.or(Some(error)),
            }
        }
        if let (true, Some(source)) = (stream.columns.is_empty(), first_error) {
            if is_fault_of_log(&source) {
                return Err(BindError::Refused(Refusal::Undecodable { stream: stream.name.clone(), source }));
            }
            return Err(BindError::Run(RunError::Field {
                file: self.contract.file.clone(),
                stream: stream.name.clone(),
                log: self.log.to_owned(),
                source,
            }));
        }
        let (width, raw) = (stream.columns.len(), rule.kind.raw_width());
        let wrong = |detail: String| RunError::Feature {
            file: self.contract.file.clone(),
            feature: stream.feature.clone(),
            detail: format!("stream {:?}: {detail}", stream.name),
        };
        if width % raw != 0 {
            return Err(wrong(format!("its kind needs a multiple of {raw} values, got {width}")).into());
        }
        if !rule.names.is_empty() && rule.names.len() != width {
            return Err(wrong(format!("expected {width} names, got {}", rule.names.len())).into());
        }
        if rule.limits.len() > 1 && rule.limits.len() != width {
            return Err(wrong(format!("expected 1 or {width} limits, got {}", rule.limits.len())).into());
        }
        Ok(())
    }
}
