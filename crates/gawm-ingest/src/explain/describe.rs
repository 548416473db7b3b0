//! The words for rules, kinds and encodings.

use std::fmt::Write as _;

use gawm_schema::{Encoding, Kind};
use serde::Serialize;

use crate::align::{ActionTiming, Derivation, Reduction};
use crate::contract::{CheckedStream, Clock, ImageSpec, StreamData};

/// Returns the word that contracts have for a value.
fn word(value: &impl Serialize) -> String {
    serde_json::to_value(value).ok().and_then(|value| value.as_str().map(str::to_owned)).unwrap_or_default()
}

/// Writes the rule of a stream.
pub(crate) fn rule(text: &mut String, stream: &CheckedStream, name: &str, topic: &str) -> std::fmt::Result {
    let clock = match &stream.clock {
        Clock::Stamp => "header stamp (publish time where there is none)".to_owned(),
        Clock::Publish => "publish time".to_owned(),
        Clock::Log => "log time".to_owned(),
        Clock::Field(path) => format!("field {path}"),
    };
    let offset_ms = stream.offset_ns as f64 / 1e6;
    writeln!(text, "  stream: {name:?}, topic {topic}, clock: {clock}, offset {offset_ms} ms")?;
    let how = match &stream.data {
        StreamData::Vector(rule) => rule.timing.map_or_else(|| word(&stream.align), timing),
        StreamData::Image(_) => word(&stream.align),
        StreamData::Derived { from, derivation: how } => {
            return writeln!(text, "  rule: derived from {from}: {}", derivation(*how));
        }
    };
    let tolerance = stream
        .tolerance_ns
        .map_or("no tolerance".to_owned(), |ns| format!("tolerance {} ms", ns as f64 / 1e6));
    writeln!(text, "  rule: {how}; {tolerance}; a gap: {}", word(&stream.gap))?;
    match &stream.data {
        StreamData::Vector(rule) if !rule.unit.is_identity() => writeln!(
            text,
            "  conversion: recorded * {} + {} = {}",
            rule.unit.factor, rule.unit.offset, rule.unit.si.0
        ),
        StreamData::Image(rule) => writeln!(text, "  image: {}", image(&rule.spec)),
        _ => Ok(()),
    }
}

fn image(rule: &ImageSpec) -> String {
    let mut words = Vec::new();
    if let Some([x, y, width, height]) = rule.crop {
        words.push(format!("cropped to {width}x{height} at ({x}, {y})"));
    }
    if let Some([width, height]) = rule.resize {
        words.push(format!("resized to {width}x{height}"));
    }
    words.push(match rule.quality {
        Some(quality) => format!("format {}, quality {quality}", word(&rule.format)),
        None => format!("format {}", word(&rule.format)),
    });
    words.join(", ")
}

fn timing(timing: ActionTiming) -> String {
    match timing {
        ActionTiming::InForce => "in-force, the last command at or before the tick".to_owned(),
        ActionTiming::Next => "next, the first command after the tick, up to the next one".to_owned(),
        ActionTiming::Resample(n) => format!("window, the commands up to the next tick resampled to {n}"),
        ActionTiming::Reduce(reduction) => {
            let how = match reduction {
                Reduction::Last => "the last of them",
                Reduction::Mean => "their mean",
                Reduction::Sum => "their sum",
                Reduction::Compose { in_body_frame: false } => "composed, rotations in the base frame",
                Reduction::Compose { in_body_frame: true } => "composed, rotations in the body frame",
            };
            format!("window, of the commands after the tick and up to the next {how}")
        }
    }
}

/// Returns how an action is made from a state.
pub(crate) fn derivation(derivation: Derivation) -> &'static str {
    match derivation {
        Derivation::Next => "next, its value in the next row",
        Derivation::Difference => {
            "difference, the next row minus this one (angles the short way, rotations as the rotation vector between)"
        }
    }
}

/// Returns the words for a kind.
pub(crate) fn kind(kind: Kind) -> String {
    let value = serde_json::to_value(kind).unwrap_or_default();
    match value {
        serde_json::Value::String(text) => text,
        serde_json::Value::Object(members) => members
            .iter()
            .map(|(key, value)| match value {
                serde_json::Value::String(text) if key == "kind" => text.clone(),
                serde_json::Value::String(text) => format!("{key} {text}"),
                other => format!("{key} {other}"),
            })
            .collect::<Vec<_>>()
            .join(", "),
        other => other.to_string(),
    }
}

/// Returns the words for an encoding.
pub(crate) fn encoding(encoding: Encoding) -> String {
    word(&encoding)
}
