//! Finds the raw messages behind a row.

use std::fmt::Write as _;
use std::path::PathBuf;

use gawm_dataset::RecordingRecord;
use gawm_schema::Role;

use super::ExplainError;
use super::dataset::RowOrigin;
use crate::align::{ActionTiming, Method};
use crate::contract::{AlignSpec, CheckedContract, Clock, StreamData};
use crate::decode::SchemaLibrary;
use crate::log::discover;
use crate::run::{Binding, BoundStream, OpenRecording, Plans, Source, defect_of};

/// Ages are stored in ms as 32-bit floats: a sample is recognised within this of where its age says.
const AGE_SLACK_NS: i64 = 50_000;
/// Messages that are listed at most.
const LISTED: usize = 12;

/// One message near a row.
pub(crate) struct Found {
    topic: String,
    file: String,
    offset: u64,
    sequence: u32,
    log_ns: i64,
    publish_ns: i64,
    stamp_ns: Option<i64>,
    /// Time by the contract's clock, offset included.
    time_ns: i64,
    values: Vec<f64>,
    is_used: bool,
    is_after: bool,
}

/// Opens the files of a recording, found by their hashes among files and folders.
pub(crate) fn sources(
    recording: &RecordingRecord,
    inputs: &[PathBuf],
    contract: &CheckedContract,
) -> Result<Option<OpenRecording>, ExplainError> {
    let mut logs = Vec::new();
    let found = discover(inputs);
    let candidates: Vec<PathBuf> =
        found.recordings.into_iter().flat_map(|recording| recording.parts).collect();
    for file in &recording.source.files {
        for path in &candidates {
            let is_length = std::fs::metadata(path).is_ok_and(|meta| meta.len() == file.length_bytes);
            if !is_length {
                continue;
            }
            let fail = |detail: String| ExplainError::Log { path: path.clone(), detail };
            let log = Source::open(path, contract).map_err(|error| fail(error.to_string()))?;
            let hash = log.content_hash().map_err(|error| fail(error.to_string()))?;
            if hash == file.content_hash.0 {
                logs.push(log);
                break;
            }
        }
    }
    if logs.len() < recording.source.files.len() {
        return Ok(None);
    }
    let name = recording.source.files.first().map(|file| file.name.clone()).unwrap_or_default();
    Ok(Some(OpenRecording::of(name, logs)))
}

/// Returns the messages of a stream around a tick, in order of time: those used, and the neighbours.
pub(crate) fn around(
    open: &OpenRecording,
    binding: &Binding,
    stream: usize,
    contract: &CheckedContract,
    origin: &RowOrigin,
    library: &SchemaLibrary,
) -> Vec<Found> {
    let rule = &binding.streams[stream].rule;
    let reach = rule.tolerance_ns.unwrap_or(contract.max_gap_ns).max(1_000_000_000);
    let age_ns = origin.age_ms.get(stream).map(|age| (f64::from(*age) * 1e6) as i64);
    let low = origin.time_ns.saturating_sub(age_ns.unwrap_or(0).abs().saturating_add(reach));
    let high = origin.next_ns.unwrap_or(origin.time_ns).saturating_add(reach);
    let plans = Plans::new(binding, &[], &[], library);
    let mut found = Vec::new();
    for (part, block) in &open.blocks {
        let slack = contract.disorder_window_ns.saturating_add(reach).saturating_add(rule.offset_ns.abs());
        let begins = block.start_ns.and_then(|ns| i64::try_from(ns).ok()).unwrap_or(i64::MIN);
        let ends = block.end_ns.and_then(|ns| i64::try_from(ns).ok()).unwrap_or(i64::MAX);
        if begins > high.saturating_add(slack) || ends < low.saturating_sub(slack) {
            continue;
        }
        let log = &open.logs[*part];
        let decoded = crate::run::decode_block(log.read_block(block), &plans);
        let file = log.path().file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        for message in &decoded.messages {
            let topic = &plans.topics[message.topic];
            let mut take = |stamp_ns: Option<i64>, values: Vec<f64>| {
                let time_ns = match rule.clock {
                    Clock::Log => message.log_ns,
                    Clock::Publish => message.publish_ns,
                    _ => stamp_ns.unwrap_or(message.publish_ns),
                };
                let time_ns = time_ns.saturating_add(rule.offset_ns);
                if time_ns < low || time_ns > high {
                    return;
                }
                found.push(Found {
                    topic: topic.topic.clone(),
                    file: file.clone(),
                    offset: message.offset,
                    sequence: message.sequence,
                    log_ns: message.log_ns,
                    publish_ns: message.publish_ns,
                    stamp_ns,
                    time_ns,
                    values,
                    is_used: false,
                    is_after: false,
                });
            };
            for (at, stamp_ns, values) in topic.samples(message.rows(&decoded.rows), &decoded.values) {
                if at == stream {
                    take(stamp_ns, values.to_vec());
                }
            }
            if let Some((_, stamp_ns)) = message.picture().filter(|_| topic.images.contains(&stream)) {
                take(*stamp_ns, Vec::new());
            }
        }
    }
    found.sort_by_key(|message| (message.time_ns, message.log_ns));
    mark(&mut found, rule, origin, age_ns);
    neighbours(found)
}

/// Marks the messages that make the value.
fn mark(found: &mut [Found], rule: &crate::contract::CheckedStream, origin: &RowOrigin, age_ns: Option<i64>) {
    let timing = match &rule.data {
        StreamData::Vector(vector) => vector.timing,
        _ => None,
    };
    let method = match rule.align {
        AlignSpec::Linear | AlignSpec::Slerp => Method::Interpolate,
        AlignSpec::Nearest => Method::Nearest,
        _ => Method::Asof,
    };
    let sample_ns = age_ns.map(|age| origin.time_ns - age);
    let next_ns = origin.next_ns.unwrap_or(origin.time_ns);
    let is_window = matches!(timing, Some(ActionTiming::Resample(_) | ActionTiming::Reduce(_)));
    let has_window =
        found.iter().any(|message| message.time_ns > origin.time_ns && message.time_ns <= next_ns);
    let mut was_used = false;
    for message in found.iter_mut() {
        message.is_after = message.time_ns > origin.time_ns;
        let is_sample = sample_ns.is_some_and(|ns| (message.time_ns - ns).abs() <= AGE_SLACK_NS);
        message.is_used = if is_window && has_window {
            message.time_ns > origin.time_ns && message.time_ns <= next_ns
        } else {
            is_sample || (method == Method::Interpolate && was_used && message.is_after)
        };
        was_used = is_sample;
    }
}

/// Keeps what is used, one message before and one after.
fn neighbours(found: Vec<Found>) -> Vec<Found> {
    let Some(first) = found.iter().position(|message| message.is_used) else {
        return found.into_iter().take(LISTED).collect();
    };
    let last = found.iter().rposition(|message| message.is_used).unwrap_or(first);
    found
        .into_iter()
        .enumerate()
        .filter(|(at, _)| at + 1 >= first && *at <= last + 1)
        .map(|(_, message)| message)
        .collect()
}

/// Writes the messages.
pub(crate) fn describe(
    text: &mut String,
    stream: &BoundStream,
    columns: &[usize],
    found: &[Found],
) -> std::fmt::Result {
    let paths: Vec<&str> =
        columns.iter().filter_map(|column| stream.columns.get(*column)).map(String::as_str).collect();
    if !paths.is_empty() {
        writeln!(text, "  field: {}", paths.join(", "))?;
    }
    writeln!(text, "  messages (> marks those behind the value):")?;
    if found.is_empty() {
        return writeln!(text, "    none near this row");
    }
    let n_used = found.iter().filter(|message| message.is_used).count();
    for message in found.iter().take(LISTED.max(n_used.min(2 * LISTED))) {
        let mark = if message.is_used { '>' } else { ' ' };
        let values: Vec<String> = columns
            .iter()
            .filter_map(|column| message.values.get(*column))
            .map(|value| format!("{value:?}"))
            .collect();
        let value = if values.is_empty() { "image".to_owned() } else { values.join(", ") };
        let stamp = message.stamp_ns.map_or("none".to_owned(), |ns| ns.to_string());
        let when = if message.is_after { "after the tick" } else { "at or before the tick" };
        writeln!(
            text,
            "  {mark} {value}  {} in {} at offset {}, sequence {}",
            message.topic, message.file, message.offset, message.sequence
        )?;
        writeln!(
            text,
            "      time {} ({when})  stamp {stamp}  publish {}  log {}",
            message.time_ns, message.publish_ns, message.log_ns
        )?;
    }
    Ok(())
}

/// Writes how far the tick lies between two samples, and why a value is not valid.
pub(crate) fn arithmetic(
    text: &mut String,
    stream: &BoundStream,
    found: &[Found],
    origin: &RowOrigin,
) -> std::fmt::Result {
    let rule = &stream.rule;
    let used: Vec<&Found> = found.iter().filter(|message| message.is_used).collect();
    if let (AlignSpec::Linear | AlignSpec::Slerp, [first, second]) = (rule.align, used.as_slice()) {
        let (part, whole) = (origin.time_ns - first.time_ns, second.time_ns - first.time_ns);
        let share = part as f64 / whole as f64;
        writeln!(text, "  share: {part} ns of {whole} ns between them = {share:.6}")?;
    }
    if origin.is_valid {
        return Ok(());
    }
    let defect = used.iter().find_map(|message| match &rule.data {
        StreamData::Vector(vector) => {
            let mut values: Vec<f64> = message.values.iter().map(|&value| vector.unit.apply(value)).collect();
            defect_of(&mut values, vector.kind, (is_encoded(rule.role), true))
        }
        _ => None,
    });
    match (defect, used.is_empty()) {
        (Some(defect), _) => writeln!(text, "  not valid: the message holds {defect}"),
        (None, true) => writeln!(text, "  not valid: no message is near enough to be used"),
        (None, false) => Ok(()),
    }
}

fn is_encoded(role: Role) -> bool {
    matches!(role, Role::State | Role::Action)
}
