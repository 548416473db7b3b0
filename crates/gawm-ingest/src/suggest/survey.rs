//! What logs hold, as far as a contract needs it.

use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use bytes::Bytes;

use super::SuggestError;
use crate::decode::{Decoded, DecodePlan, FieldInfo, RowSink, SchemaLibrary, StampSource, sample_fields};
use crate::inspect::{ChannelProbe, ChannelReport, MessageProbe, inspect_log};
use crate::log::{Channel, Log, OpenOptions, discover};
use crate::run::{OpenRecording, Source, schema_of};

/// Payloads that are kept per topic.
const SAMPLES: usize = 48;
/// Larger payloads are kept twice only.
const LARGE_BYTES: usize = 1 << 16;

/// Looks at channels with the decoders.
#[derive(Debug, Clone)]
pub struct DecodingProbe {
    /// Types for channels without a schema.
    pub library: SchemaLibrary,
}

impl MessageProbe for DecodingProbe {
    fn probe(&self, channel: &Channel) -> ChannelProbe {
        match DecodePlan::compile_with(&schema_of(channel), &[], &StampSource::Auto, &self.library) {
            Err(error) => ChannelProbe { obstacle: Some(error.to_string()), stamp: None },
            Ok(plan) if !plan.has_stamp() => ChannelProbe::default(),
            Ok(plan) => ChannelProbe {
                obstacle: None,
                stamp: Some(Box::new(move |payload| match plan.decode(payload, &mut RowSink::new()) {
                    Ok(Decoded::Row { stamp_ns }) => stamp_ns,
                    _ => None,
                })),
            },
        }
    }
}

/// All that is known of the logs.
pub(crate) struct Survey {
    /// The first recording that can be read: its values are looked at.
    pub(crate) first: OpenRecording,
    /// Topics, by name.
    pub(crate) topics: BTreeMap<String, Topic>,
    /// Number of recordings.
    pub(crate) recordings: usize,
    /// Metadata records of the first recording.
    pub(crate) metadata: Vec<(String, BTreeMap<String, String>)>,
    /// Earliest and latest log time of the first recording.
    pub(crate) span_ns: (i64, i64),
    /// Texts of URDF attachments and topics.
    pub(crate) urdf: Vec<String>,
    /// Steps back in log time of single topics that are no disorder: smallest one, in ms.
    pub(crate) smallest_reset_ms: Option<f64>,
    /// Largest step back that is disorder, in ms.
    pub(crate) largest_disorder_ms: f64,
}

/// One topic.
#[derive(Debug, Clone)]
pub(crate) struct Topic {
    pub(crate) channel: Arc<Channel>,
    /// What inspection found in the first recording that has it.
    pub(crate) report: ChannelReport,
    pub(crate) messages: u64,
    /// In how many recordings it is.
    pub(crate) recordings: usize,
    /// Leaves of its type.
    pub(crate) fields: Vec<FieldInfo>,
    /// Some payloads.
    pub(crate) samples: Vec<Bytes>,
    /// First and last log time in the first recording.
    pub(crate) span_ns: (i64, i64),
}

impl Topic {
    /// Returns messages per second.
    pub(crate) fn rate_hz(&self) -> f64 {
        let rate = self.report.publish_rate.as_ref().filter(|_| self.report.has_publish_clock);
        rate.or(self.report.rate.as_ref()).map_or(0.0, |rate| rate.median_hz)
    }

    /// Returns the interval that one percent of the messages exceed, in ms.
    pub(crate) fn slow_ms(&self) -> f64 {
        let rate = self.report.publish_rate.as_ref().filter(|_| self.report.has_publish_clock);
        rate.or(self.report.rate.as_ref()).map_or(0.0, |rate| if rate.min_hz > 0.0 { 1e3 / rate.min_hz } else { 0.0 })
    }

    pub(crate) fn type_name(&self) -> &str {
        self.channel.schema.as_deref().map_or("", |schema| &schema.name)
    }
}

/// Looks at all logs.
pub(crate) fn survey(inputs: &[PathBuf], library: &SchemaLibrary, options: &OpenOptions) -> Result<Survey, SuggestError> {
    let found = discover(inputs);
    let mut reasons: Vec<String> = found.refused.iter().map(ToString::to_string).collect();
    let mut hint = found.refused.first().and_then(|error| error.hint());
    let probe = DecodingProbe { library: library.clone() };
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    let mut first = None;
    let mut recordings = 0;
    let mut steps = Steps::default();
    for recording in &found.recordings {
        let logs: Result<Vec<Log>, _> = recording.parts.iter().map(|path| Log::open(path, options)).collect();
        let logs = match logs {
            Ok(logs) => logs,
            Err(error) => {
                hint = hint.or(error.hint());
                reasons.push(error.to_string());
                continue;
            }
        };
        recordings += 1;
        let sources = logs.into_iter().map(|log| Source::Log(Box::new(log))).collect();
        let open = OpenRecording::of(recording.name.clone(), sources);
        let mut seen: BTreeMap<String, Topic> = BTreeMap::new();
        for log in open.logs.iter().filter_map(Source::log) {
            for report in inspect_log(log, log.path(), &probe).channels {
                add_report(&mut seen, report, &open);
            }
        }
        steps.look(&open);
        for (name, topic) in seen {
            topics.entry(name).and_modify(|known| {
                known.messages += topic.messages;
                known.recordings += 1;
            }).or_insert(topic);
        }
        if first.is_none() {
            first = Some(open);
        }
    }
    let Some(first) = first else { return Err(SuggestError::NoLog { reasons, hint }) };
    collect_samples(&first, &mut topics, library);
    let spans = topics.values().filter(|topic| topic.span_ns.0 > 0).map(|topic| topic.span_ns);
    let span_ns = spans.fold((i64::MAX, i64::MIN), |all, span| (all.0.min(span.0), all.1.max(span.1)));
    let metadata = first.logs.iter().flat_map(Source::metadata);
    let metadata = metadata.map(|record| (record.name.clone(), record.values.clone())).collect();
    let urdf = super::urdf::texts(&first, &topics, library);
    Ok(Survey {
        first,
        topics,
        recordings,
        metadata,
        span_ns,
        urdf,
        smallest_reset_ms: steps.smallest_reset_ms,
        largest_disorder_ms: steps.largest_disorder_ms,
    })
}

fn add_report(seen: &mut BTreeMap<String, Topic>, report: ChannelReport, open: &OpenRecording) {
    let channel = open.channels.iter().find(|channel| channel.topic == report.topic && channel.id == report.id);
    let Some(channel) = channel.or(open.channels.iter().find(|channel| channel.topic == report.topic)) else { return };
    let ns = |time: Option<u64>| time.and_then(|ns| i64::try_from(ns).ok());
    let span_ns = (ns(report.start_ns).unwrap_or(0), ns(report.end_ns).unwrap_or(0));
    match seen.get_mut(&report.topic) {
        Some(topic) => {
            topic.messages += report.messages;
            topic.span_ns = (topic.span_ns.0.min(span_ns.0), topic.span_ns.1.max(span_ns.1));
        }
        None => {
            let topic = Topic {
                channel: Arc::clone(channel),
                messages: report.messages,
                recordings: 1,
                fields: Vec::new(),
                samples: Vec::new(),
                span_ns,
                report,
            };
            seen.insert(topic.report.topic.clone(), topic);
        }
    }
}

/// Keeps some payloads of each topic, spread over the recording: of n messages every n/[`SAMPLES`]-th.
fn collect_samples(open: &OpenRecording, topics: &mut BTreeMap<String, Topic>, library: &SchemaLibrary) {
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for (part, block) in &open.blocks {
        let block = open.logs[*part].read_block(block);
        for message in &block.messages {
            let channel = block.channel(message);
            let Some(topic) = topics.get_mut(&channel.topic) else { continue };
            let count = counts.entry(channel.topic.clone()).or_default();
            let every = (topic.messages / SAMPLES as u64).max(1);
            let is_wanted = count.is_multiple_of(every) && topic.samples.len() < SAMPLES;
            *count += 1;
            let payload = block.payload(message);
            if is_wanted && (payload.len() < LARGE_BYTES || topic.samples.len() < 2) {
                topic.samples.push(Bytes::copy_from_slice(payload));
            }
        }
    }
    for topic in topics.values_mut() {
        if let Some(sample) = topic.samples.first() {
            topic.fields = sample_fields(&schema_of(&topic.channel), sample, library).unwrap_or_default();
        }
    }
}

/// Steps back in the log times of single topics.
#[derive(Default)]
struct Steps {
    smallest_reset_ms: Option<f64>,
    largest_disorder_ms: f64,
}

impl Steps {
    /// A step back is a reset when the topic then goes on from there, over times that it has been through before.
    fn look(&mut self, open: &OpenRecording) {
        let mut times: BTreeMap<String, Vec<i64>> = BTreeMap::new();
        for (part, log) in open.logs.iter().filter_map(Source::log).enumerate() {
            if log.channels().len() > 10_000 || part > 64 {
                continue;
            }
            for block in log.blocks_in_file_order() {
                let block = log.read_block(&block);
                for message in &block.messages {
                    let topic = &block.channel(message).topic;
                    let ns = i64::try_from(message.log_time_ns).unwrap_or(i64::MAX);
                    match times.get_mut(topic) {
                        Some(times) if times.len() < 200_000 => times.push(ns),
                        Some(_) => {}
                        None => {
                            times.insert(topic.clone(), vec![ns]);
                        }
                    }
                }
            }
        }
        for times in times.values() {
            self.look_at(times);
        }
    }

    fn look_at(&mut self, times: &[i64]) {
        let mut newest = i64::MIN;
        for (index, &ns) in times.iter().enumerate() {
            if ns >= newest {
                newest = ns;
                continue;
            }
            let back_ms = newest.saturating_sub(ns) as f64 / 1e6;
            let after = &times[index..times.len().min(index + 4)];
            let goes_on = after.windows(2).all(|pair| pair[1] >= pair[0])
                && after.iter().all(|&ns| ns < newest)
                && after.len() >= 3;
            if goes_on {
                self.smallest_reset_ms = Some(self.smallest_reset_ms.map_or(back_ms, |ms| ms.min(back_ms)));
                newest = ns;
            } else {
                self.largest_disorder_ms = self.largest_disorder_ms.max(back_ms);
            }
        }
    }
}
