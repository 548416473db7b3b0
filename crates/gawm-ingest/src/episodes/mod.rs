//! Where episodes begin and end, and what is said about them.
//!
//! [`Marks`] turns messages of a marker topic into begins and ends; [`Labels`] collects what topics, metadata, paths
//! and side files say, and answers for one episode.

mod labels;
mod side_file;
mod value;

pub(crate) use labels::Asked;
pub use labels::{EpisodeLabels, LabelError, Labels, RecordingLabels};
pub use side_file::SideFile;
pub use value::{matches, value_at};

use crate::contract::MarkerValue;

/// What a marker message says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Mark {
    /// An episode begins.
    Start,
    /// The open episode ends.
    Stop,
}

/// Reads the marks of a marker topic.
#[derive(Debug, Clone)]
pub struct Marks {
    /// Path of the value.
    pub field: String,
    /// Values that start an episode.
    pub start: MarkerValue,
    /// Values that end one.
    pub stop: Option<MarkerValue>,
}

impl Marks {
    /// Returns what a message says; other values say nothing.
    pub fn read(&self, message: &serde_json::Value) -> Option<Mark> {
        let value = value_at(message, &self.field)?;
        if matches(&self.start, &value) {
            Some(Mark::Start)
        } else if self.stop.as_ref().is_some_and(|stop| matches(stop, &value)) {
            Some(Mark::Stop)
        } else {
            None
        }
    }
}
