//! What is decoded of each message: compiled once per channel, shared by all threads.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::sync::{Arc, Mutex, PoisonError};

use super::bind::{Binding, BoundStream};
use crate::contract::{Clock, StreamData};
use crate::decode::{
    ChannelSchema, CompileError, DecodeError, DecodePlan, Decoded, FieldPath, ImagePlan, RowSink,
    SchemaLibrary, Segment, StampSource, StampUnit, Value,
};
use crate::log::Channel;

/// Errors list at most this many names of a message.
const MAX_LISTED_NAMES: usize = 64;

/// Returns what decoding needs to know of a channel.
pub(crate) fn schema_of(channel: &Channel) -> ChannelSchema<'_> {
    let schema = channel.schema.as_deref();
    ChannelSchema {
        topic: &channel.topic,
        message_encoding: &channel.message_encoding,
        schema_name: schema.map_or("", |schema| &schema.name),
        schema_encoding: schema.map_or("", |schema| &schema.encoding),
        schema_data: schema.map_or(&[], |schema| &schema.data),
    }
}

/// Decodes the values of a group of streams.
#[derive(Debug)]
pub(crate) enum VectorDecoder {
    /// The message itself holds them.
    Direct(Box<DecodePlan>),
    /// A text of the message holds them as JSON, as `std_msgs/String` often does.
    Text {
        /// Takes the text.
        text: Box<DecodePlan>,
        /// Decodes it.
        inner: Box<DecodePlan>,
        /// Where the text is.
        prefix: String,
    },
}

/// The sinks that a decoder needs; one per thread.
#[derive(Debug, Default)]
pub(crate) struct Sinks {
    pub(crate) rows: RowSink,
    text: RowSink,
}

/// Compiles a decoder for paths; those that go on below a text are looked for in the JSON that it holds.
pub(crate) fn compile_vector(
    channel: &ChannelSchema<'_>,
    fields: &[FieldPath],
    clock: &Clock,
    library: &SchemaLibrary,
) -> Result<VectorDecoder, CompileError> {
    let stamp = match clock {
        Clock::Stamp => StampSource::Auto,
        Clock::Publish | Clock::Log => StampSource::None,
        Clock::Field(path) => StampSource::Path { path: path.parse()?, unit: StampUnit::Auto },
    };
    match DecodePlan::compile_with(channel, fields, &stamp, library) {
        Ok(plan) => Ok(VectorDecoder::Direct(Box::new(plan))),
        Err(error) => compile_text(channel, fields, &stamp, library).unwrap_or(Err(error)),
    }
}

fn compile_text(
    channel: &ChannelSchema<'_>,
    fields: &[FieldPath],
    stamp: &StampSource,
    library: &SchemaLibrary,
) -> Option<Result<VectorDecoder, CompileError>> {
    let Segment::Field(first) = fields.first()?.segments().first()? else { return None };
    let prefix = FieldPath::from_members([first.clone()]);
    let text = DecodePlan::compile_with(channel, &[prefix], &StampSource::None, library).ok()?;
    if text.columns().first()?.scalar != crate::decode::Scalar::Text {
        return None;
    }
    let rest: Option<Vec<FieldPath>> = fields
        .iter()
        .map(|path| path.to_string().strip_prefix(&format!("{first}."))?.parse::<FieldPath>().ok())
        .collect();
    let json = ChannelSchema { topic: channel.topic, message_encoding: "json", ..ChannelSchema::default() };
    let stamp = match stamp {
        StampSource::Path { path, unit } => StampSource::Path {
            path: path.to_string().strip_prefix(&format!("{first}."))?.parse().ok()?,
            unit: *unit,
        },
        other => other.clone(),
    };
    let inner = DecodePlan::compile_with(&json, &rest?, &stamp, library);
    Some(inner.map(|inner| VectorDecoder::Text {
        text: Box::new(text),
        inner: Box::new(inner),
        prefix: first.clone(),
    }))
}

impl VectorDecoder {
    /// Returns the path of each value.
    pub(crate) fn columns(&self) -> Vec<String> {
        let (plan, prefix) = match self {
            VectorDecoder::Direct(plan) => (plan, String::new()),
            VectorDecoder::Text { inner, prefix, .. } => (inner, format!("{prefix}.")),
        };
        plan.columns().iter().map(|column| format!("{prefix}{}", column.path)).collect()
    }

    /// Appends the values of a message to `sinks.rows`.
    pub(crate) fn decode(&self, payload: &[u8], sinks: &mut Sinks) -> Result<Decoded, DecodeError> {
        match self {
            VectorDecoder::Direct(plan) => plan.decode(payload, &mut sinks.rows),
            VectorDecoder::Text { text, inner, .. } => {
                let (_, values) = text.decode_values(payload, &mut sinks.text)?;
                let text = values.first().and_then(Value::as_text).unwrap_or_default();
                inner.decode(text.as_bytes(), &mut sinks.rows)
            }
        }
    }
}

/// Decodes a group of streams: all at once, or one by one where a message holds the elements of some of them only.
///
/// Several publishers may share a topic, each with joints or frames of its own.
#[derive(Debug)]
pub(crate) struct GroupDecoder {
    whole: VectorDecoder,
    /// One per stream of the group; none when there is one stream.
    parts: Vec<VectorDecoder>,
    /// The names that each stream picks elements by.
    names: Vec<BTreeSet<String>>,
}

/// The sinks of a [`GroupDecoder`].
#[derive(Debug, Default)]
pub(crate) struct GroupSinks {
    whole: Sinks,
    parts: Vec<Sinks>,
}

/// The values of a group, or of one of its streams, in a message.
#[derive(Debug, Clone)]
pub(crate) struct Row {
    /// Index of the group in its topic.
    group: u32,
    /// The stream of the group that they are of; all of them without.
    part: Option<u32>,
    values: Range<usize>,
    pub(crate) stamp_ns: Option<i64>,
}

impl GroupDecoder {
    /// Appends the values of a message, and a row for each range of them.
    pub(crate) fn decode(
        &self,
        group: usize,
        payload: &[u8],
        sinks: &mut GroupSinks,
        (values, rows): (&mut Vec<f64>, &mut Vec<Row>),
    ) -> Result<(), DecodeError> {
        let mut take = |decoder: &VectorDecoder, sinks: &mut Sinks, part: Option<usize>| {
            sinks.rows.clear();
            let outcome = decoder.decode(payload, sinks)?;
            if let Decoded::Row { stamp_ns } = outcome {
                let start = values.len();
                values.extend_from_slice(sinks.rows.values());
                let part = part.map(|part| part as u32);
                rows.push(Row { group: group as u32, part, values: start..values.len(), stamp_ns });
            }
            match outcome {
                Decoded::Row { .. } => Ok(true),
                Decoded::NotInMessage { found: 0, .. } => Ok(false),
                Decoded::NotInMessage { found, missing } => Err(DecodeError::ElementsAbsent {
                    path: decoder.columns().into_iter().next().unwrap_or_default(),
                    found,
                    wanted: found + missing,
                }),
            }
        };
        let has_all = match take(&self.whole, &mut sinks.whole, None) {
            Err(DecodeError::ElementsAbsent { .. }) if !self.parts.is_empty() => false,
            Err(error) if self.parts.is_empty() && is_of_others(&error, &self.names[0]) => return Ok(()),
            Err(error @ DecodeError::NameAbsent { .. }) if self.parts.is_empty() => return Err(error),
            Err(DecodeError::NameAbsent { .. }) => false,
            other => other?,
        };
        if has_all {
            return Ok(());
        }
        sinks.parts.resize_with(self.parts.len(), Sinks::default);
        for (part, ((decoder, names), sinks)) in
            self.parts.iter().zip(&self.names).zip(&mut sinks.parts).enumerate()
        {
            match take(decoder, sinks, Some(part)) {
                Err(error) if is_of_others(&error, names) => {}
                other => drop(other?),
            }
        }
        Ok(())
    }
}

/// Returns whether a message holds none of the names that are asked for, but others.
fn is_of_others(error: &DecodeError, names: &BTreeSet<String>) -> bool {
    match error {
        DecodeError::NameAbsent { present, .. } => {
            (1..MAX_LISTED_NAMES).contains(&present.len()) && !present.iter().any(|name| names.contains(name))
        }
        _ => false,
    }
}

/// Returns the names that paths pick elements by.
pub(crate) fn picked_names(fields: &[FieldPath]) -> BTreeSet<String> {
    let segments = fields.iter().flat_map(FieldPath::segments);
    let name = |segment: &Segment| match segment {
        Segment::Key { value, .. } => Some(value.clone()),
        _ => None,
    };
    segments.filter_map(name).collect()
}

/// What is wanted of a topic.
#[derive(Debug, Default)]
pub(crate) struct MappedTopic {
    /// Its name.
    pub(crate) topic: String,
    /// Groups of values with one stamp each.
    groups: Vec<Group>,
    /// Streams of images.
    pub(crate) images: Vec<usize>,
    /// Whether whole messages are wanted, for markers and labels.
    pub(crate) is_event: bool,
    /// Whether it holds calibrations.
    pub(crate) is_camera_info: bool,
}

/// Streams of a topic whose samples have the same stamp.
#[derive(Debug)]
pub(crate) struct Group {
    clock: Clock,
    fields: Vec<FieldPath>,
    /// Streams and where their values lie in the row.
    streams: Vec<(usize, Range<usize>)>,
    /// Where the paths of each stream lie in `fields`.
    paths: Vec<Range<usize>>,
    width: usize,
}

/// The topics of a binding, and their plans per channel.
#[derive(Debug)]
pub(crate) struct Plans {
    /// By topic.
    pub(crate) topics: Vec<MappedTopic>,
    index: BTreeMap<String, usize>,
    library: SchemaLibrary,
    compiled: Mutex<Vec<(Arc<Channel>, Arc<ChannelPlan>)>>,
}

/// How the messages of one channel are decoded.
#[derive(Debug)]
pub(crate) struct ChannelPlan {
    /// Index of the topic; none when it is not mapped.
    pub(crate) topic: Option<usize>,
    /// One decoder per group.
    pub(crate) vectors: Vec<GroupDecoder>,
    /// Values that a message gives.
    pub(crate) width: usize,
    /// Takes images out.
    pub(crate) image: Option<ImagePlan>,
    /// Why the channel cannot be decoded.
    pub(crate) error: Option<CompileError>,
}

impl Plans {
    /// Collects what a binding wants; `events` and `infos` are topics of markers and labels, and of calibrations.
    pub(crate) fn new(
        binding: &Binding,
        events: &[String],
        infos: &[String],
        library: &SchemaLibrary,
    ) -> Plans {
        let mut topics: Vec<MappedTopic> = Vec::new();
        let mut index = BTreeMap::new();
        let mut at = |name: &str, topics: &mut Vec<MappedTopic>| -> usize {
            *index.entry(name.to_owned()).or_insert_with(|| {
                topics.push(MappedTopic { topic: name.to_owned(), ..MappedTopic::default() });
                topics.len() - 1
            })
        };
        for (stream, bound) in binding.streams.iter().enumerate() {
            let topic = at(&bound.topic, &mut topics);
            match &bound.rule.data {
                StreamData::Vector(_) => topics[topic].add(stream, bound),
                _ => topics[topic].images.push(stream),
            }
        }
        for name in events {
            let topic = at(name, &mut topics);
            topics[topic].is_event = true;
        }
        for name in infos {
            let topic = at(name, &mut topics);
            topics[topic].is_camera_info = true;
        }
        Plans { topics, index, library: library.clone(), compiled: Mutex::default() }
    }

    pub(crate) fn library(&self) -> &SchemaLibrary {
        &self.library
    }

    /// Returns the plan of a channel, compiled when it is met first.
    pub(crate) fn of(&self, channel: &Arc<Channel>) -> Arc<ChannelPlan> {
        let mut compiled = self.compiled.lock().unwrap_or_else(PoisonError::into_inner);
        let known = compiled.iter().find(|(known, _)| Arc::ptr_eq(known, channel) || **known == **channel);
        if let Some((_, plan)) = known {
            return Arc::clone(plan);
        }
        let plan = Arc::new(self.compile(channel));
        compiled.push((Arc::clone(channel), Arc::clone(&plan)));
        plan
    }

    fn compile(&self, channel: &Channel) -> ChannelPlan {
        let topic = self.index.get(&channel.topic).copied();
        let mut plan = ChannelPlan { topic, vectors: Vec::new(), width: 0, image: None, error: None };
        let Some(mapped) = topic.map(|topic| &self.topics[topic]) else { return plan };
        let schema = schema_of(channel);
        plan.width = mapped.groups.iter().map(|group| group.width).sum();
        for group in &mapped.groups {
            match compile_vector(&schema, &group.fields, &group.clock, &self.library) {
                Ok(whole) if whole.columns().len() == group.width => {
                    plan.vectors.push(self.with_parts(whole, group, &schema));
                }
                Ok(decoder) => {
                    let got = decoder.columns().len();
                    plan.error = Some(CompileError::WrongShape {
                        topic: channel.topic.clone(),
                        path: group.fields.first().map(ToString::to_string).unwrap_or_default(),
                        expected: format!("{} values as in the first channel of this topic", group.width),
                        got: format!("{got} values"),
                    });
                }
                Err(error) => plan.error = Some(error),
            }
        }
        if !mapped.images.is_empty() {
            match ImagePlan::compile(&schema, &self.library) {
                Ok(image) => plan.image = Some(image),
                Err(error) => plan.error = Some(error),
            }
        }
        plan
    }

    /// Adds what is needed for messages that hold the elements of some streams of a group only.
    fn with_parts(&self, whole: VectorDecoder, group: &Group, schema: &ChannelSchema<'_>) -> GroupDecoder {
        let fields = || group.paths.iter().map(|paths| &group.fields[paths.clone()]);
        let names: Vec<BTreeSet<String>> = fields().map(picked_names).collect();
        let is_picked = group.streams.len() > 1 && names.iter().any(|names| !names.is_empty());
        let compile = |fields: &[FieldPath]| compile_vector(schema, fields, &group.clock, &self.library).ok();
        let parts: Option<Vec<VectorDecoder>> =
            if is_picked { fields().map(compile).collect() } else { None };
        match parts {
            Some(parts) => GroupDecoder { whole, parts, names },
            None => GroupDecoder { whole, parts: Vec::new(), names: vec![picked_names(&group.fields)] },
        }
    }
}

impl MappedTopic {
    /// Returns whether numbers are wanted of the topic.
    pub(crate) fn has_vectors(&self) -> bool {
        !self.groups.is_empty()
    }

    /// Returns the samples of a message: stream, stamp and values.
    pub(crate) fn samples<'a>(
        &'a self,
        rows: &'a [Row],
        values: &'a [f64],
    ) -> impl Iterator<Item = (usize, Option<i64>, &'a [f64])> {
        rows.iter().flat_map(move |row| {
            let values = values.get(row.values.clone()).unwrap_or_default();
            let streams = self.groups[row.group as usize].streams.iter().enumerate();
            let is_of = move |part: usize| row.part.is_none_or(|only| only as usize == part);
            streams.filter(move |(part, _)| is_of(*part)).map(move |(_, (stream, columns))| {
                let own = if row.part.is_some() { values } else { &values[columns.clone()] };
                (*stream, row.stamp_ns, own)
            })
        })
    }

    fn add(&mut self, stream: usize, bound: &BoundStream) {
        // Log and publish times need no stamp, so such streams share the group of those that do.
        let clock = match &bound.rule.clock {
            Clock::Field(path) => Clock::Field(path.clone()),
            _ => Clock::Stamp,
        };
        let at = self.groups.iter().position(|group| group.clock == clock);
        let at = at.unwrap_or_else(|| {
            self.groups.push(Group {
                clock,
                fields: Vec::new(),
                streams: Vec::new(),
                paths: Vec::new(),
                width: 0,
            });
            self.groups.len() - 1
        });
        let group = &mut self.groups[at];
        let range = group.width..group.width + bound.columns.len();
        group.width = range.end;
        group.paths.push(group.fields.len()..group.fields.len() + bound.fields.len());
        group.fields.extend(bound.fields.iter().cloned());
        group.streams.push((stream, range));
    }
}
