//! Names of streams that share a topic.

use std::collections::{BTreeMap, BTreeSet};

use super::names;
use crate::contract::{Contract, StreamSpec};
use crate::decode::{FieldPath, Segment};

/// Names the streams of topics that have several, so that reports tell them apart.
pub(crate) fn name_streams(contract: &mut Contract) {
    let mut counts: BTreeMap<String, usize> = BTreeMap::new();
    for topic in contract.stream.iter().filter_map(|stream| stream.topic.clone()) {
        *counts.entry(topic).or_default() += 1;
    }
    let mut taken = BTreeSet::new();
    for stream in &mut contract.stream {
        let Some(topic) = stream.topic.clone().filter(|topic| counts[topic] > 1) else { continue };
        let base = format!("{}_{}", names::words(&topic).join("_"), label(stream));
        let mut name = base.clone();
        let mut number = 1;
        while !taken.insert(name.clone()) {
            number += 1;
            name = format!("{base}_{number}");
        }
        stream.name = Some(name);
    }
}

/// Returns what the fields of a stream have in common.
fn label(stream: &StreamSpec) -> String {
    let paths: Vec<FieldPath> = stream.fields.iter().filter_map(|field| field.parse().ok()).collect();
    let words = match paths.as_slice() {
        [] => Vec::new(),
        [only] => match only.segments().last() {
            Some(Segment::Key { value, .. }) => vec![value.clone()],
            _ => names::words(&only.to_string()),
        },
        [first, rest @ ..] => first
            .segments()
            .iter()
            .enumerate()
            .take_while(|(at, segment)| rest.iter().all(|path| path.segments().get(*at) == Some(*segment)))
            .filter_map(|(_, segment)| match segment {
                Segment::Field(name) => Some(name.clone()),
                _ => None,
            })
            .collect(),
    };
    if words.is_empty() { format!("{:?}", stream.kind).to_lowercase() } else { words.join("_") }
}
