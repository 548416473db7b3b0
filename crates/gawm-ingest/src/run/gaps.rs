//! Gaps in words.

use std::collections::BTreeMap;

use super::RunError;
use super::bind::Binding;
use crate::align::{GapAction, GapEvent, Stop};
use crate::rows::EPISODE_GAP_NS;

/// Gaps of a stream that are described one by one.
const LISTED: usize = 5;

/// Returns a line per gap, of each stream the first few; times are seconds after the start of the log.
///
/// Files of rows have no times of their own (`has_own_episodes`): a gap as long as their episodes are apart is the rest of
/// an episode.
pub(crate) fn describe(
    binding: &Binding,
    gaps: &[GapEvent],
    start_ns: i64,
    has_own_episodes: bool,
) -> Vec<String> {
    let mut counts: BTreeMap<Option<usize>, usize> = BTreeMap::new();
    let mut lines = Vec::new();
    for gap in gaps {
        let count = counts.entry(gap.stream).or_default();
        *count += 1;
        if *count <= LISTED {
            lines.push(line(binding, gap, start_ns, has_own_episodes));
        }
    }
    for (stream, count) in counts.into_iter().filter(|(_, count)| *count > LISTED) {
        lines.push(format!("{}: {} gaps in all, the rest not listed", name_of(binding, stream), count));
    }
    lines
}

fn name_of(binding: &Binding, stream: Option<usize>) -> String {
    match stream {
        Some(stream) => {
            format!("stream {:?} ({})", binding.streams[stream].name, binding.streams[stream].topic)
        }
        None => "all streams".to_owned(),
    }
}

fn line(binding: &Binding, gap: &GapEvent, start_ns: i64, has_own_episodes: bool) -> String {
    let seconds = |ns: i64| ns.saturating_sub(start_ns) as f64 / 1e9;
    let who = name_of(binding, gap.stream);
    let rule = match gap.rule {
        GapAction::Split => "the episode is split",
        GapAction::Mask => "rows are masked",
        GapAction::DropEpisode => "the episode is left out",
        GapAction::Fail => "the run fails",
    };
    match (gap.last_ns, gap.resumed_ns) {
        (Some(last), Some(resumed)) if has_own_episodes && resumed.saturating_sub(last) >= EPISODE_GAP_NS => {
            format!("{who}: the last rows of an episode have no value; {rule}")
        }
        (Some(last), Some(resumed)) => format!(
            "{who}: gap of {:.1} ms from {:.3} s to {:.3} s; {rule}",
            resumed.saturating_sub(last) as f64 / 1e6,
            seconds(last),
            seconds(resumed)
        ),
        (Some(last), None) => format!("{who}: silent from {:.3} s on; {rule}", seconds(last)),
        (None, Some(resumed)) => format!("{who}: no sample before {:.3} s; {rule}", seconds(resumed)),
        (None, None) => format!("{who}: no usable sample; {rule}"),
    }
}

pub(crate) fn stop_error(binding: &Binding, log: &str, stop: Stop) -> RunError {
    let stream = &binding.streams[stop.stream];
    RunError::Gap {
        log: log.to_owned(),
        stream: stream.name.clone(),
        topic: stream.topic.clone(),
        tick_ns: stop.tick_ns,
        age_ms: stop.last_ns.map_or(f64::NAN, |last| stop.tick_ns.saturating_sub(last) as f64 / 1e6),
    }
}
