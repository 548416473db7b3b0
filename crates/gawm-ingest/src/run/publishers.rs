//! Topics with several publishers: a stream whose elements come in different messages becomes one stream for each.
//!
//! Two drivers that publish their joints on one `/joint_states` are common. A stream of all joints would find none of
//! its messages whole, so it is split into streams of the joints that come together, in the stated order.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::bind::{Binding, BoundStream, FeatureSource};
use super::block::body;
use super::plan::{Sinks, VectorDecoder, compile_vector, picked_names, schema_of};
use super::recording::OpenRecording;
use crate::contract::{Clock, StreamData};
use crate::decode::{Decoded, SchemaLibrary};
use crate::log::Channel;

/// Messages of a topic that are looked at.
const MESSAGES: usize = 256;
/// Bytes of the recording that are looked at, and blocks at least.
const BYTES: u64 = 64 << 20;
const BLOCKS: usize = 4;

/// Splits the streams of a binding where the recording asks for it.
pub(crate) fn split(binding: &mut Binding, open: &OpenRecording, library: &SchemaLibrary) {
    let mut candidates: Vec<Candidate> =
        (0..binding.streams.len()).filter_map(|at| Candidate::new(at, &binding.streams[at])).collect();
    let mut bytes = 0;
    for (at, (part, block)) in open.blocks.iter().enumerate() {
        if candidates.iter().all(Candidate::is_decided) || (at >= BLOCKS && bytes > BYTES) {
            break;
        }
        bytes += block.uncompressed_bytes;
        let block = open.logs[*part].read_block(block);
        for message in &block.messages {
            let channel = &block.channels[message.channel as usize];
            for candidate in candidates.iter_mut().filter(|candidate| !candidate.is_decided()) {
                let stream = &binding.streams[candidate.stream];
                if stream.topic == channel.topic {
                    candidate.look(stream, channel, block.payload(message), library);
                }
            }
        }
    }
    let mut parts: Vec<Vec<BoundStream>> =
        binding.streams.iter().map(|stream| vec![stream.clone()]).collect();
    for candidate in &candidates {
        if let Some(split) = candidate.split(&binding.streams[candidate.stream]) {
            parts[candidate.stream] = split;
        }
    }
    if parts.iter().any(|parts| parts.len() > 1) {
        rebuild(binding, parts);
    }
}

/// Returns why the first message of a stream's topic that holds none of its elements does not, with what it holds.
pub(crate) fn first_absence(
    stream: &BoundStream,
    open: &OpenRecording,
    library: &SchemaLibrary,
) -> Option<String> {
    let mut sinks = Sinks::default();
    for (part, block) in &open.blocks {
        let block = open.logs[*part].read_block(block);
        for message in &block.messages {
            let channel = &block.channels[message.channel as usize];
            if channel.topic != stream.topic {
                continue;
            }
            let payload = body(channel, block.payload(message)).ok()?;
            let decoder = compile_vector(&schema_of(channel), &stream.fields, &Clock::Log, library).ok()?;
            return match decoder.decode(&payload, &mut sinks) {
                Ok(Decoded::NotInMessage { .. }) => {
                    let names: Vec<String> =
                        picked_names(&stream.fields).iter().map(|name| format!("{name:?}")).collect();
                    Some(format!("no message holds {}", names.join(" and ")))
                }
                Ok(Decoded::Row { .. }) => None,
                Err(error) => Some(error.to_string()),
            };
        }
    }
    None
}

/// Puts several streams in the place of one, and gives them names of their own.
fn rebuild(binding: &mut Binding, parts: Vec<Vec<BoundStream>>) {
    let mut taken: BTreeSet<String> = binding.streams.iter().map(|stream| stream.name.clone()).collect();
    let mut places = Vec::with_capacity(parts.len());
    binding.streams.clear();
    for mut parts in parts {
        let first = binding.streams.len();
        for (number, stream) in parts.iter_mut().enumerate().skip(1) {
            let names = (number + 1..).map(|number| format!("{}_{number}", stream.name));
            if let Some(name) = names.into_iter().find(|name| !taken.contains(name)) {
                taken.insert(name.clone());
                stream.name = name;
            }
        }
        binding.streams.append(&mut parts);
        places.push(first..binding.streams.len());
    }
    for feature in &mut binding.features {
        match &mut feature.source {
            FeatureSource::Streams(streams) => {
                *streams = streams.iter().flat_map(|&stream| places[stream].clone()).collect();
            }
            FeatureSource::Image(stream) => *stream = places[*stream].start,
            FeatureSource::Derived { .. } => {}
        }
    }
}

/// A stream that picks several elements by name.
struct Candidate {
    stream: usize,
    /// Decoders of all fields and of each, by channel.
    decoders: Vec<(Arc<Channel>, Option<FieldDecoders>)>,
    /// Sets of fields that came in one message.
    sets: BTreeSet<Vec<usize>>,
    n_messages: usize,
    /// Whether a message held everything.
    has_whole: bool,
}

struct FieldDecoders {
    whole: VectorDecoder,
    each: Vec<VectorDecoder>,
}

impl Candidate {
    fn new(at: usize, stream: &BoundStream) -> Option<Candidate> {
        let StreamData::Vector(rule) = &stream.rule.data else { return None };
        let is_single = rule.timing.is_none_or(|timing| timing.commands() == 1);
        (is_single && picked_names(&stream.fields).len() > 1).then(|| Candidate {
            stream: at,
            decoders: Vec::new(),
            sets: BTreeSet::new(),
            n_messages: 0,
            has_whole: false,
        })
    }

    fn is_decided(&self) -> bool {
        self.has_whole || self.n_messages >= MESSAGES
    }

    fn look(
        &mut self,
        stream: &BoundStream,
        channel: &Arc<Channel>,
        payload: &[u8],
        library: &SchemaLibrary,
    ) {
        let Ok(payload) = body(channel, payload) else { return };
        let at = self.decoders.iter().position(|(known, _)| **known == **channel).unwrap_or_else(|| {
            let compile =
                |fields: &[_]| compile_vector(&schema_of(channel), fields, &Clock::Log, library).ok();
            let each = stream.fields.iter().map(|field| compile(std::slice::from_ref(field))).collect();
            let decoders = compile(&stream.fields)
                .zip(each)
                .map(|(whole, each): (_, Vec<_>)| FieldDecoders { whole, each });
            self.decoders.push((Arc::clone(channel), decoders));
            self.decoders.len() - 1
        });
        let Some(decoders) = &self.decoders[at].1 else { return };
        self.n_messages += 1;
        let has = |decoder: &VectorDecoder| {
            matches!(decoder.decode(&payload, &mut Sinks::default()), Ok(Decoded::Row { .. }))
        };
        if has(&decoders.whole) {
            self.has_whole = true;
            return;
        }
        let found: Vec<usize> = (0..decoders.each.len()).filter(|&at| has(&decoders.each[at])).collect();
        if !found.is_empty() {
            self.sets.insert(found);
        }
    }

    /// Returns the streams to put in the place of one: none unless every field comes in one kind of message only.
    fn split(&self, stream: &BoundStream) -> Option<Vec<BoundStream>> {
        let StreamData::Vector(rule) = &stream.rule.data else { return None };
        let n_fields = stream.fields.len();
        let mut set_of = vec![None; n_fields];
        for (number, field) in
            self.sets.iter().enumerate().flat_map(|(n, set)| set.iter().map(move |f| (n, *f)))
        {
            if set_of[field].replace(number).is_some() {
                return None;
            }
        }
        let set_of: Vec<usize> = set_of.into_iter().collect::<Option<_>>()?;
        if self.has_whole || self.sets.len() < 2 {
            return None;
        }
        let widths: Vec<usize> = self
            .decoders
            .iter()
            .find_map(|(_, decoders)| decoders.as_ref())?
            .each
            .iter()
            .map(|decoder| decoder.columns().len())
            .collect();
        let mut out = Vec::new();
        let (mut field, mut column) = (0, 0);
        for run in set_of.chunk_by(|a, b| a == b) {
            let fields = field..field + run.len();
            let columns = column..column + widths[fields.clone()].iter().sum::<usize>();
            (field, column) = (fields.end, columns.end);
            if columns.len() % rule.kind.raw_width() != 0 {
                return None;
            }
            let mut part = stream.clone();
            part.fields = stream.fields[fields].to_vec();
            part.columns = stream.columns.get(columns.clone())?.to_vec();
            if let StreamData::Vector(rule) = &mut part.rule.data {
                if rule.names.len() == stream.columns.len() {
                    rule.names = rule.names[columns.clone()].to_vec();
                }
                if rule.limits.len() > 1 && rule.limits.len() == stream.columns.len() {
                    rule.limits = rule.limits[columns].to_vec();
                }
            }
            out.push(part);
        }
        Some(out)
    }
}
