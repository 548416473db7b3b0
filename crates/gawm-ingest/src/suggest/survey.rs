//! What logs hold, as far as a contract needs it.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

use bytes::Bytes;

use super::SuggestError;
use crate::decode::{DecodePlan, Decoded, FieldInfo, RowSink, SchemaLibrary, StampSource, sample_fields};
use crate::inspect::{ChannelProbe, ChannelReport, MessageProbe, inspect_log};
use crate::log::{Channel, OpenOptions, decompress_message, discover, looks_like_zstd};
use crate::run::{OpenRecording, Source, schema_of};

/// Payloads that are kept per topic.
const SAMPLES: usize = 48;
/// Times per topic that are looked at.
const MAX_TIMES: usize = 400_000;
/// Largest message body that is unpacked.
const MAX_BODY_BYTES: u64 = 256 << 20;
/// An interval of more than this many median ones, and of more than [`PAUSE_MS`], is a pause.
const PAUSE_PERIODS: f64 = 20.0;
/// The shortest pause.
const PAUSE_MS: f64 = 1000.0;
/// Where one interval in this many is a pause, they are the nature of the topic.
const PAUSE_EVERY: usize = 20;
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
    /// Median interval by publish time, in order of time, in ms; 0 when there is none.
    pub(crate) period_ms: f64,
    /// The interval that one percent of the messages exceed, in ms.
    pub(crate) slow_ms: f64,
}

impl Topic {
    /// Returns messages per second, 0 when that cannot be told.
    pub(crate) fn rate_hz(&self) -> f64 {
        if self.period_ms > 0.0 { 1e3 / self.period_ms } else { 0.0 }
    }

    pub(crate) fn type_name(&self) -> &str {
        self.channel.schema.as_deref().map_or("", |schema| &schema.name)
    }
}

/// Looks at all logs.
pub(crate) fn survey(
    inputs: &[PathBuf],
    library: &SchemaLibrary,
    options: &OpenOptions,
) -> Result<Survey, SuggestError> {
    let found = discover(inputs);
    let mut reasons: Vec<String> = found.refused.iter().map(ToString::to_string).collect();
    let mut hint = found.refused.first().and_then(|error| error.hint());
    let probe = DecodingProbe { library: library.clone() };
    let mut topics: BTreeMap<String, Topic> = BTreeMap::new();
    let mut first = None;
    let mut recordings = 0;
    let mut steps = Steps::default();
    for recording in &found.recordings {
        let sources: Result<Vec<Source>, _> =
            recording.parts.iter().map(|path| Source::open_log(path, options)).collect();
        let sources = match sources {
            Ok(sources) => sources,
            Err(error) => {
                hint = hint.or(error.hint());
                reasons.push(error.to_string());
                continue;
            }
        };
        recordings += 1;
        let open = OpenRecording::of(recording.name.clone(), sources);
        let mut seen: BTreeMap<String, Topic> = BTreeMap::new();
        for log in open.logs.iter().filter_map(Source::as_log) {
            for report in inspect_log(log, log.path(), &probe).channels {
                add_report(&mut seen, report, &open);
            }
        }
        for (name, (period_ms, slow_ms)) in steps.look(&open) {
            if let Some(topic) = seen.get_mut(&name) {
                (topic.period_ms, topic.slow_ms) = (period_ms, slow_ms);
            }
        }
        for (name, topic) in seen {
            topics
                .entry(name)
                .and_modify(|known| {
                    known.messages += topic.messages;
                    known.recordings += 1;
                })
                .or_insert(topic);
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
    let channel =
        open.channels.iter().find(|channel| channel.topic == report.topic && channel.id == report.id);
    let Some(channel) = channel.or(open.channels.iter().find(|channel| channel.topic == report.topic)) else {
        return;
    };
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
                period_ms: 0.0,
                slow_ms: 0.0,
                report,
            };
            seen.insert(topic.report.topic.clone(), topic);
        }
    }
}

/// Keeps some payloads of each topic, spread over the recording: of n messages one in each n/[`SAMPLES`], at another place
/// each time, so that publishers who take turns are all met.
fn collect_samples(open: &OpenRecording, topics: &mut BTreeMap<String, Topic>, library: &SchemaLibrary) {
    let mut counts: BTreeMap<String, u64> = BTreeMap::new();
    for (part, block) in &open.blocks {
        let block = open.logs[*part].read_block(block);
        for message in &block.messages {
            let channel = block.channel(message);
            let Some(topic) = topics.get_mut(&channel.topic) else { continue };
            let count = counts.entry(channel.topic.clone()).or_default();
            let every = (topic.messages / SAMPLES as u64).max(1);
            let taken = topic.samples.len() as u64;
            let is_wanted = *count == taken * every + taken % every && topic.samples.len() < SAMPLES;
            *count += 1;
            let payload = unpacked(channel, block.payload(message));
            if is_wanted && (payload.len() < LARGE_BYTES || topic.samples.len() < 2) {
                topic.samples.push(Bytes::from(payload.into_owned()));
            }
        }
    }
    for topic in topics.values_mut() {
        let schema = schema_of(&topic.channel);
        let mut found = topic.samples.iter().map(|sample| sample_fields(&schema, sample, library));
        topic.fields = found.find_map(Result::ok).unwrap_or_default();
    }
}

/// Returns a message body; rosbag2 may have compressed each by itself.
fn unpacked<'a>(channel: &Channel, payload: &'a [u8]) -> Cow<'a, [u8]> {
    if channel.message_encoding == "cdr"
        && looks_like_zstd(payload)
        && let Ok(bytes) = decompress_message(payload, MAX_BODY_BYTES)
    {
        return Cow::Owned(bytes);
    }
    Cow::Borrowed(payload)
}

/// Steps back in the log times of single topics.
#[derive(Default)]
struct Steps {
    smallest_reset_ms: Option<f64>,
    largest_disorder_ms: f64,
}

/// Times of one message: log and publish.
type Times = (i64, i64);

/// Messages after a step back that must go on from there for it to be a reset.
const RESET_RUN: usize = 8;

impl Steps {
    /// Looks at the times of a recording in the order of the file; returns period and slow interval of each topic.
    fn look(&mut self, open: &OpenRecording) -> BTreeMap<String, (f64, f64)> {
        let mut times: BTreeMap<String, Vec<Times>> = BTreeMap::new();
        for log in open.logs.iter().filter_map(Source::as_log) {
            for block in log.blocks_in_file_order() {
                let block = log.read_block(&block);
                for message in &block.messages {
                    let topic = &block.channel(message).topic;
                    let ns = |time: u64| i64::try_from(time).unwrap_or(i64::MAX);
                    let publish = if message.publish_time_ns == 0 {
                        message.log_time_ns
                    } else {
                        message.publish_time_ns
                    };
                    let pair = (ns(message.log_time_ns), ns(publish));
                    match times.get_mut(topic) {
                        Some(times) if times.len() < MAX_TIMES => times.push(pair),
                        Some(_) => {}
                        None => {
                            times.insert(topic.clone(), vec![pair]);
                        }
                    }
                }
            }
        }
        times.into_iter().map(|(topic, times)| (topic, self.look_at(&times))).collect()
    }

    /// A step back is a reset when the topic then goes on from there, over times that it has been through before; or
    /// when it goes back to where an earlier reset went.
    fn look_at(&mut self, times: &[Times]) -> (f64, f64) {
        let log = |index: usize| times[index].0;
        let mut steps = Vec::new();
        let mut newest = i64::MIN;
        for index in 0..times.len() {
            if log(index) < newest {
                let run = (index + 1..times.len())
                    .take_while(|&at| log(at) >= log(at - 1) && log(at) < newest)
                    .count();
                steps.push((index, newest.saturating_sub(log(index)) as f64 / 1e6, run));
                if run >= RESET_RUN {
                    newest = log(index);
                }
            }
            newest = newest.max(log(index));
        }
        let restarts: Vec<i64> =
            steps.iter().filter(|step| step.2 >= RESET_RUN).map(|step| log(step.0)).collect();
        let mut resets = Vec::new();
        for &(index, back_ms, run) in &steps {
            let is_known = restarts.iter().any(|&ns| (log(index) - ns).abs() < 1_000_000);
            if run >= RESET_RUN || is_known {
                self.smallest_reset_ms = Some(self.smallest_reset_ms.map_or(back_ms, |ms| ms.min(back_ms)));
                resets.push(index);
            } else {
                self.largest_disorder_ms = self.largest_disorder_ms.max(back_ms);
            }
        }
        intervals(times, &resets)
    }
}

/// Returns the median interval and the one that a percent exceed, in ms, by publish time and within clock segments.
///
/// Pauses of the recorder, between episodes for one, say nothing of the rate.
fn intervals(times: &[Times], resets: &[usize]) -> (f64, f64) {
    let mut all = Vec::new();
    let mut ends = resets.to_vec();
    ends.push(times.len());
    let mut start = 0;
    for end in ends {
        let mut publish: Vec<i64> = times[start..end].iter().map(|pair| pair.1).collect();
        publish.sort_unstable();
        publish.dedup();
        all.extend(publish.windows(2).map(|pair| (pair[1] - pair[0]) as f64 / 1e6));
        start = end;
    }
    all.sort_by(f64::total_cmp);
    let at = |all: &[f64], share: f64| {
        all.get(((all.len().saturating_sub(1)) as f64 * share).round() as usize).copied().unwrap_or(0.0)
    };
    let median = at(&all, 0.5);
    let n_steady = all.partition_point(|ms| *ms <= (PAUSE_PERIODS * median).max(PAUSE_MS));
    let has_few_pauses = (all.len() - n_steady) * PAUSE_EVERY <= all.len();
    let steady = if has_few_pauses { &all[..n_steady] } else { &all };
    (median, at(steady, 0.99))
}
