//! Frames that move: what a log says of a robot that publishes transforms and no joint states.

use std::collections::BTreeMap;

use serde_json::Value;

use super::guess::Group;
use super::survey::Topic;
use crate::contract::KindSpec;

/// A frame is proposed when at least this part of the messages hold it.
const MIN_SHARE: f64 = 0.1;
const NS_PER_S: i64 = 1_000_000_000;
/// Stamps that lie further from the log times are not trusted to be of the same clock.
const SLACK_S: i64 = 2;
/// Frames that are proposed, at most.
const MAX_FRAMES: usize = 16;

/// Returns translation and rotation of each frame that moves, if the topic holds transforms by name.
pub(crate) fn transforms(topic: &Topic, messages: &[Value]) -> Option<Vec<Group>> {
    let has = |path: &str| topic.fields.iter().any(|field| field.path == path);
    if !has("transforms[].child_frame_id") {
        return None;
    }
    let inner =
        ["transform.", ""].into_iter().find(|inner| has(&format!("transforms[].{inner}translation.x")))?;
    let numbers = |value: &Value, path: &str, names: &[&str]| -> Option<Vec<f64>> {
        names
            .iter()
            .map(|name| crate::episodes::value_at(value, &format!("{path}.{name}"))?.as_f64())
            .collect()
    };
    let mut frames: BTreeMap<&str, Vec<Vec<f64>>> = BTreeMap::new();
    for item in messages.iter().filter_map(|message| message.get("transforms")?.as_array()).flatten() {
        let Some(name) = item.get("child_frame_id").and_then(Value::as_str) else { continue };
        let translation = numbers(item, &format!("{inner}translation"), &["x", "y", "z"]);
        let rotation = numbers(item, &format!("{inner}rotation"), &["x", "y", "z", "w"]);
        if let (Some(translation), Some(rotation)) = (translation, rotation) {
            frames.entry(name).or_default().push([translation, rotation].concat());
        }
    }
    let is_stamped = has_stamps(topic, messages);
    let mut groups: Vec<Group> = Vec::new();
    let mut left_out: Vec<&str> = Vec::new();
    for (name, poses) in frames {
        let share = poses.len() as f64 / messages.len() as f64;
        let is_moving = poses.windows(2).any(|pair| pair[0] != pair[1]);
        if !is_moving {
            continue;
        }
        if share < MIN_SHARE || groups.len() >= 2 * MAX_FRAMES {
            left_out.push(name);
            continue;
        }
        let quoted = name.replace('\\', "\\\\").replace('"', "\\\"");
        let paths = |part: &str, axes: &[&str]| -> Vec<String> {
            let path = |axis: &&str| format!("transforms[child_frame_id=\"{quoted}\"].{inner}{part}.{axis}");
            axes.iter().map(path).collect()
        };
        let group = |fields: Vec<String>, kind: KindSpec, unit: Option<&str>, axes: &[&str]| Group {
            fields,
            kind,
            unit: unit.map(str::to_owned),
            limits: Vec::new(),
            reason: format!("the frame {name:?} moves, relative to its parent"),
            is_joints: false,
            share: share.min(1.0),
            names: axes.iter().map(|axis| format!("{name}.{axis}")).collect(),
            is_stamped,
        };
        let translation = paths("translation", &["x", "y", "z"]);
        groups.push(group(translation, KindSpec::Linear, Some("m"), &["x", "y", "z"]));
        let rotation = paths("rotation", &["x", "y", "z", "w"]);
        groups.push(group(rotation, KindSpec::Quaternion, None, &["qx", "qy", "qz", "qw"]));
    }
    if let (Some(last), false) = (groups.last_mut(), left_out.is_empty()) {
        let what = format!(
            "; left out, as they are in under {:.0} % of the messages or more than {MAX_FRAMES}: {}",
            MIN_SHARE * 100.0,
            left_out.join(", ")
        );
        last.reason.push_str(&what);
    }
    (!groups.is_empty()).then_some(groups)
}

/// Returns whether the transforms have stamps of the clock that the log times are of.
fn has_stamps(topic: &Topic, messages: &[Value]) -> bool {
    let (start_ns, end_ns) = topic.span_ns;
    let seconds = |item: &Value| {
        let stamps = ["header.stamp.sec", "header.stamp.secs", "timestamp.sec", "timestamp.seconds"];
        stamps.iter().find_map(|path| crate::episodes::value_at(item, path)?.as_i64())
    };
    let items = messages.iter().filter_map(|message| message.get("transforms")?.as_array()).flatten();
    let mut items = items.peekable();
    let is_close = |item: &Value| {
        seconds(item).is_some_and(|s| s >= start_ns / NS_PER_S - SLACK_S && s <= end_ns / NS_PER_S + SLACK_S)
    };
    items.peek().is_some() && items.all(is_close)
}
