//! Messages of a marker topic: what they mark, when, and what to say when they mark nothing.

use std::collections::BTreeSet;

use serde_json::Value;

use crate::contract::Clock;
use crate::decode::stamp_of_json;
use crate::episodes::{Mark, Marks, value_at};

/// Values that are named when none of them starts an episode.
const MAX_NAMED: usize = 8;

/// What the messages of the marker topic held.
#[derive(Debug, Default)]
pub(super) struct MarkCounts {
    messages: u64,
    starts: u64,
    /// Values that mark nothing.
    others: BTreeSet<String>,
    /// Members of a message that lacks the field.
    members: Option<Vec<String>>,
}

impl MarkCounts {
    /// Reads a message.
    pub(super) fn take(&mut self, marks: &Marks, event: &Value) -> Option<Mark> {
        self.messages += 1;
        let mark = marks.read(event);
        self.starts += u64::from(mark == Some(Mark::Start));
        match value_at(event, &marks.field) {
            Some(value) if mark.is_none() && self.others.len() < MAX_NAMED => {
                self.others.insert(value.to_string());
            }
            None if self.members.is_none() => {
                let members = event.as_object().map(|object| object.keys().cloned().collect());
                self.members = Some(members.unwrap_or_default());
            }
            _ => {}
        }
        mark
    }

    /// Says why no episode was started, if none was.
    pub(super) fn complaint(&self, topic: &str, marks: &Marks) -> Option<String> {
        if self.starts > 0 {
            return None;
        }
        let Marks { field, start, .. } = marks;
        Some(match &self.members {
            _ if self.messages == 0 => {
                format!(
                    "episodes.topic: the log has no message of {topic} that can be read: no episode starts"
                )
            }
            Some(members) if self.others.is_empty() => format!(
                "episodes.field: messages of {topic} have no {field:?}, they have {members:?}: no episode starts"
            ),
            _ => format!(
                "episodes.start: no message of {topic} has {} in {field:?}, they have {}: no episode starts",
                serde_json::to_string(start).unwrap_or_default(),
                self.others.iter().map(String::as_str).collect::<Vec<_>>().join(", ")
            ),
        })
    }
}

/// Returns the time of a mark.
pub(super) fn time_of(clock: &Clock, event: &Value, publish_ns: i64, log_ns: i64) -> i64 {
    let at = |path: &str| value_at(event, path).as_ref().and_then(stamp_of_json);
    match clock {
        Clock::Log => log_ns,
        Clock::Publish => publish_ns,
        Clock::Stamp => ["header.stamp", "stamp", "timestamp"].into_iter().find_map(at).unwrap_or(publish_ns),
        Clock::Field(path) => at(path).unwrap_or(log_ns),
    }
}
