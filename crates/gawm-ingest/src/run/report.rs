//! What a run did, for people and for programs.

use std::collections::BTreeMap;

use serde::Serialize;

use crate::log::Damage;

/// The report of `run --report`; docs/formats/report.md says what each key means.
#[derive(Debug, Default, Serialize)]
pub struct Report {
    /// One entry per input, in order; the parts of a split recording are one input.
    pub files: Vec<FileReport>,
    /// Episodes in the dataset that this run added.
    pub episodes: u64,
    /// Rows that this run added.
    pub frames: u64,
    /// What is odd, but lost nothing.
    pub warnings: Vec<String>,
    /// Sample ages per stream over all rows.
    pub streams: Vec<StreamReport>,
}

/// What became of one input.
#[derive(Debug, Serialize)]
pub struct FileReport {
    /// As named on the command line.
    pub path: String,
    /// Outcome.
    pub status: FileStatus,
    /// What became of the messages of each topic.
    pub topics: Vec<TopicReport>,
    /// Damage of the container.
    pub damage: Vec<Damage>,
    /// Episodes made of it.
    pub episodes: u64,
    /// Rows made of it.
    pub frames: u64,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<String>,
}

impl FileReport {
    /// Returns the report of an input that was not used.
    pub(crate) fn refused(path: &std::path::Path, error: String) -> FileReport {
        FileReport {
            path: path.display().to_string(),
            status: FileStatus::Refused,
            topics: Vec::new(),
            damage: Vec::new(),
            episodes: 0,
            frames: 0,
            error: Some(error),
        }
    }
}

/// The outcome for one input.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum FileStatus {
    /// All of it was used.
    Ok,
    /// It was used; messages of mapped topics were lost.
    Loss,
    /// None of it was used.
    Refused,
    /// The dataset had it already.
    AlreadyThere,
}

/// What became of the messages of a topic; `read` = `kept` + the sum of `lost`.
#[derive(Debug, Serialize)]
pub struct TopicReport {
    /// The topic.
    pub topic: String,
    /// Whether the contract uses it.
    pub mapped: bool,
    /// Messages that the log holds, as far as that is known.
    pub read: u64,
    /// Messages that were decoded and available to alignment; of a topic that is not mapped: that were there.
    pub kept: u64,
    /// The others, by reason.
    pub lost: Vec<LostReport>,
}

/// Messages lost for one reason.
#[derive(Debug, Serialize)]
pub struct LostReport {
    /// Why.
    pub reason: String,
    /// How many.
    pub count: u64,
    /// The first of them: file offset and what was wrong.
    pub first: String,
}

/// Sample ages of one stream over all rows.
#[derive(Debug, Serialize)]
pub struct StreamReport {
    /// Name of the stream.
    pub stream: String,
    /// Its topic.
    pub topic: String,
    /// Median age in ms.
    pub age_ms_p50: f64,
    /// 95th percentile.
    pub age_ms_p95: f64,
    /// Largest.
    pub age_ms_max: f64,
    /// Rows in which its feature was not valid.
    pub invalid_rows: u64,
}

/// Reasons for losing a message that are no loss of data: they do not change the exit code.
const HARMLESS: [&str; 1] = ["duplicate"];

/// Counts of one recording, by topic.
#[derive(Debug, Default)]
pub(crate) struct Counts {
    topics: BTreeMap<String, TopicCount>,
}

#[derive(Debug, Default)]
struct TopicCount {
    is_mapped: bool,
    read: u64,
    lost: BTreeMap<String, (u64, String)>,
}

impl Counts {
    pub(crate) fn add_mapped(&mut self, topic: &str) {
        self.topics.entry(topic.to_owned()).or_default().is_mapped = true;
    }

    pub(crate) fn read(&mut self, topic: &str, count: u64) {
        match self.topics.get_mut(topic) {
            Some(counts) => counts.read += count,
            None => self.topics.entry(topic.to_owned()).or_default().read = count,
        }
    }

    pub(crate) fn lost(&mut self, topic: &str, reason: &str, count: u64, first: impl FnOnce() -> String) {
        let entry = self.topics.entry(topic.to_owned()).or_default();
        match entry.lost.get_mut(reason) {
            Some((n, _)) => *n += count,
            None => {
                entry.lost.insert(reason.to_owned(), (count, first()));
            }
        }
    }

    /// Returns how many messages of a topic were read.
    pub(crate) fn read_of(&self, topic: &str) -> u64 {
        self.topics.get(topic).map_or(0, |count| count.read)
    }

    /// Returns what became of the lost messages of a topic, in words.
    pub(crate) fn losses_of(&self, topic: &str) -> Vec<String> {
        let lost = self.topics.get(topic).map(|count| &count.lost);
        lost.into_iter()
            .flatten()
            .map(|(reason, (n, first))| format!("{n} lost as {reason} (first: {first})"))
            .collect()
    }

    /// Returns whether messages of mapped topics were lost.
    pub(crate) fn has_loss(&self) -> bool {
        self.topics.values().any(|count| {
            count.is_mapped
                && count.lost.iter().any(|(reason, (n, _))| *n > 0 && !HARMLESS.contains(&reason.as_str()))
        })
    }

    pub(crate) fn into_reports(self) -> Vec<TopicReport> {
        let report = |(topic, count): (String, TopicCount)| {
            let lost: u64 = count.lost.values().map(|(n, _)| n).sum();
            TopicReport {
                topic,
                mapped: count.is_mapped,
                read: count.read,
                kept: count.read - lost,
                lost: count
                    .lost
                    .into_iter()
                    .map(|(reason, (count, first))| LostReport { reason, count, first })
                    .collect(),
            }
        };
        self.topics.into_iter().map(report).collect()
    }
}

/// Ages of the samples of one stream, in steps of 0.1 ms.
#[derive(Debug, Default, Clone)]
pub(crate) struct AgeCounts {
    counts: BTreeMap<i64, u64>,
    pub(crate) invalid_rows: u64,
}

impl AgeCounts {
    pub(crate) fn add(&mut self, age_ms: f32) {
        if age_ms.is_finite() {
            *self.counts.entry((f64::from(age_ms) * 10.0).round() as i64).or_default() += 1;
        }
    }

    pub(crate) fn merge(&mut self, other: &AgeCounts) {
        for (&age, &count) in &other.counts {
            *self.counts.entry(age).or_default() += count;
        }
        self.invalid_rows += other.invalid_rows;
    }

    fn quantile(&self, fraction: f64) -> f64 {
        let total: u64 = self.counts.values().sum();
        let rank = ((total.saturating_sub(1)) as f64 * fraction).round() as u64;
        let mut end = 0;
        let found = self.counts.iter().find(|(_, count)| {
            end += **count;
            rank < end
        });
        found.map_or(f64::NAN, |(age, _)| *age as f64 / 10.0)
    }

    pub(crate) fn report(&self, stream: &str, topic: &str) -> StreamReport {
        StreamReport {
            stream: stream.to_owned(),
            topic: topic.to_owned(),
            age_ms_p50: self.quantile(0.5),
            age_ms_p95: self.quantile(0.95),
            age_ms_max: self.quantile(1.0),
            invalid_rows: self.invalid_rows,
        }
    }
}
