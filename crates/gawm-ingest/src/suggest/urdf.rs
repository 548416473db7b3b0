//! Joints of a robot description: types and limits.

use std::collections::BTreeMap;

use regex::Regex;

use super::survey::Topic;
use crate::decode::{SchemaLibrary, decode_to_json};
use crate::log::Log;
use crate::run::{OpenRecording, Source, schema_of};

/// Largest description that is read.
const MAX_BYTES: u64 = 16 << 20;

/// A joint of a robot description.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct Joint {
    /// `revolute`, `continuous`, `prismatic` or another type of URDF.
    pub(crate) kind: String,
    /// Lower and upper limit.
    pub(crate) limits: Option<[f64; 2]>,
}

/// Returns the texts of robot descriptions in attachments and topics.
pub(crate) fn texts(open: &OpenRecording, topics: &BTreeMap<String, Topic>, library: &SchemaLibrary) -> Vec<String> {
    let mut texts = Vec::new();
    for log in open.logs.iter().filter_map(Source::log) {
        texts.extend(of_log(log));
    }
    for topic in topics.values().filter(|topic| topic.channel.topic.ends_with("robot_description")) {
        let message = topic.samples.first().and_then(|s| decode_to_json(&schema_of(&topic.channel), s, library).ok());
        let text = message.as_ref().and_then(|message| message.get("data")).and_then(serde_json::Value::as_str);
        texts.extend(text.map(str::to_owned));
    }
    texts.retain(|text| text.contains("<robot"));
    texts
}

fn of_log(log: &Log) -> Vec<String> {
    let attachments = log.attachments().iter().enumerate();
    attachments
        .filter(|(_, attachment)| attachment.data_size <= MAX_BYTES)
        .filter_map(|(index, _)| String::from_utf8(log.read_attachment(index).ok()?).ok())
        .collect()
}

/// Returns the joints of robot descriptions, by name, and their order.
pub(crate) fn joints(texts: &[String]) -> (BTreeMap<String, Joint>, Vec<String>) {
    let (mut joints, mut order) = (BTreeMap::new(), Vec::new());
    let joint = Regex::new(r#"(?s)<joint\b([^>]*)>(.*?)</joint>"#).expect("a valid expression");
    let limit = Regex::new(r#"<limit\b([^>]*)/?>"#).expect("a valid expression");
    for text in texts {
        for found in joint.captures_iter(text) {
            let (Some(name), Some(kind)) = (attribute(&found[1], "name"), attribute(&found[1], "type")) else {
                continue;
            };
            let ends = limit.captures(&found[2]).and_then(|limit| {
                let end = |name: &str| attribute(&limit[1], name)?.trim().parse::<f64>().ok();
                Some([end("lower")?, end("upper")?]).filter(|[low, high]| low < high)
            });
            let limits = ends.filter(|_| kind == "revolute" || kind == "prismatic");
            if joints.insert(name.clone(), Joint { kind, limits }).is_none() {
                order.push(name);
            }
        }
    }
    (joints, order)
}

fn attribute(tag: &str, name: &str) -> Option<String> {
    let mut rest = tag;
    while let Some(at) = rest.find(name) {
        let is_start = rest[..at].chars().next_back().is_none_or(char::is_whitespace);
        let after = rest[at + name.len()..].trim_start();
        if let (true, Some(value)) = (is_start, after.strip_prefix('=')) {
            let value = value.trim_start();
            let quote = value.chars().next().filter(|c| matches!(c, '"' | '\''))?;
            let value = &value[1..];
            return value.find(quote).map(|end| value[..end].to_owned());
        }
        rest = &rest[at + name.len()..];
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_types_and_limits() {
        let text = r#"<robot name="r"><joint name="a" type="revolute"><limit effort="1" lower="-1.5" upper='2'/></joint>
            <joint type="continuous" name='b'><axis xyz="0 0 1"/></joint></robot>"#;
        let (joints, order) = joints(&[text.to_owned()]);
        assert_eq!(order, ["a", "b"]);
        assert_eq!(joints["a"], Joint { kind: "revolute".to_owned(), limits: Some([-1.5, 2.0]) });
        assert_eq!(joints["b"], Joint { kind: "continuous".to_owned(), limits: None });
    }
}
