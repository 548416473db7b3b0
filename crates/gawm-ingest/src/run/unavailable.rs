//! Topics that a source declares and has no values of: their streams are left out, and that is a loss.

use super::error::Refusal;
use super::recording::OpenRecording;
use super::report::{FileReport, FileStatus, LostReport, Report, TopicReport};
use crate::contract::{CheckedContract, TickRule};
use crate::rows::Unavailable;

/// A contract without the streams that have no values, and those that were left out.
pub(crate) struct Reduced {
    pub(crate) contract: CheckedContract,
    pub(crate) left_out: Vec<Unavailable>,
    /// The stream that ticks come from, if it is one of them.
    pub(crate) lost_ticks: Option<String>,
}

/// Leaves out the streams of topics without values; `None` when there is none.
pub(crate) fn reduce(contract: &CheckedContract, open: &OpenRecording) -> Option<Reduced> {
    let unavailable: Vec<&Unavailable> = open.logs.iter().flat_map(|log| log.unavailable()).collect();
    let mut reduced = Reduced { contract: contract.clone(), left_out: Vec::new(), lost_ticks: None };
    let left_out = &mut reduced.left_out;
    let mut lost_names = Vec::new();
    reduced.contract.streams.retain(|stream| {
        let Some(pattern) = &stream.topic else { return true };
        let absent: Vec<&&Unavailable> =
            unavailable.iter().filter(|found| pattern.captures(&found.topic).is_some()).collect();
        for found in &absent {
            if !left_out.contains(found) {
                left_out.push((**found).clone());
            }
        }
        let is_kept = absent.is_empty()
            || open.channels.iter().any(|channel| pattern.captures(&channel.topic).is_some());
        if !is_kept {
            lost_names.extend(stream.name.clone());
        }
        is_kept
    });
    if let TickRule::Reference { stream } = &contract.ticks
        && lost_names.contains(stream)
    {
        reduced.lost_ticks = Some(stream.clone());
    }
    (!reduced.left_out.is_empty()).then_some(reduced)
}

/// Says of a topic that is missing why, where the file holds it in a form that cannot be used.
pub(crate) fn explain(refusal: Refusal, open: &OpenRecording) -> Refusal {
    let Refusal::MissingTopic { stream, topic, topics } = refusal else { return refusal };
    match open.logs.iter().find_map(|log| log.why_not_offered(&topic)) {
        Some((why, hint)) => Refusal::UnusableColumn { stream, topic, why, hint },
        None => Refusal::MissingTopic { stream, topic, topics },
    }
}

/// Says what was left out.
pub(crate) fn account(left_out: &[Unavailable], file: &mut FileReport, report: &mut Report) {
    for found in left_out {
        report.warnings.push(format!(
            "{}: {} is left out: {}\nhint: {}",
            file.path, found.topic, found.detail, found.hint
        ));
        file.topics.push(TopicReport {
            topic: found.topic.clone(),
            mapped: true,
            read: found.rows,
            kept: 0,
            lost: vec![LostReport {
                reason: found.reason.to_owned(),
                count: found.rows,
                first: format!("{}; hint: {}", found.detail, found.hint),
            }],
        });
    }
    file.topics.sort_by(|a, b| a.topic.cmp(&b.topic));
    if !left_out.is_empty() && file.status == FileStatus::Ok {
        file.status = FileStatus::Loss;
    }
}
