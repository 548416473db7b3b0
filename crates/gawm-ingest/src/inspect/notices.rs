//! What is odd about the contents of a log, from its numbers.

use super::clocks::ClockOffset;
use super::report::{ChannelReport, FileReport, Notice, NoticeKind};
use super::shared_topics;
use super::statistics::CLOCK_RESET_NS;
use super::text::plural;

/// A gap shorter than this is jitter whatever the rate.
const GAP_MIN_MS: f64 = 50.0;
/// A regular channel must have this many messages before its gaps mean something.
const GAP_MIN_MESSAGES: u64 = 20;
/// A channel is irregular, and its gaps mean nothing, when its jitter is this share of its period.
const IRREGULAR: f64 = 1.0;
/// A drift is worth a notice from this many parts per million on.
const DRIFT_MIN_PPM: f64 = 5.0;
/// A channel ends early when it is silent for this share of the file's span and for many of its periods.
const ENDS_EARLY_SHARE: f64 = 0.1;
const ENDS_EARLY_PERIODS: f64 = 10.0;

/// Returns the notices of a file, by kind, then topic.
pub(super) fn notices(file: &FileReport) -> Vec<Notice> {
    let mut notices = Vec::new();
    let mut add = |kind, topic: Option<&str>, detail: String| {
        notices.push(Notice { kind, topic: topic.map(str::to_owned), detail });
    };
    let with_messages = || file.channels.iter().filter(|channel| channel.messages > 0);
    if with_messages().next().is_some() && !with_messages().any(|channel| channel.has_publish_clock) {
        add(
            NoticeKind::NoPublishClock,
            None,
            "publish times equal log times: delays between them are unknown, not zero".to_owned(),
        );
    }
    if let Some(compression) = &file.message_compression {
        let detail = format!(
            "message bodies are compressed with {compression} one by one (rosbag2 compression mode MESSAGE)"
        );
        add(NoticeKind::CompressedMessages, None, detail);
    }
    for topic in shared_topics(&file.channels) {
        let ids: Vec<String> =
            file.channels.iter().filter(|c| c.topic == topic).map(|c| c.id.to_string()).collect();
        add(NoticeKind::SeveralChannels, Some(topic), format!("channels {}", ids.join(", ")));
    }
    if let Some((channel, offset, ppm, error)) = drift(file) {
        let to = if channel.stamp_to_publish.as_ref() == Some(offset) { "publish" } else { "log" };
        let detail = format!("header stamps run {:+.1} ppm (+-{error:.1}) against the {to} clock", -ppm);
        add(NoticeKind::ClockDrift, Some(&channel.topic), detail);
    }
    for channel in with_messages() {
        channel_notices(file, channel, &mut add);
    }
    notices.sort_by(|a, b| (a.kind, &a.topic).cmp(&(b.kind, &b.topic)));
    notices
}

fn channel_notices(
    file: &FileReport,
    channel: &ChannelReport,
    add: &mut impl FnMut(NoticeKind, Option<&str>, String),
) {
    let topic = Some(channel.topic.as_str());
    if let Some(obstacle) = &channel.obstacle {
        add(NoticeKind::NotDecodable, topic, obstacle.clone());
    }
    if channel.backward_steps > 0 {
        let detail = format!(
            "{} steps back of the log time, the largest {:.1} ms",
            channel.backward_steps, channel.largest_backward_ms
        );
        add(NoticeKind::BackwardSteps, topic, detail);
    }
    if channel.duplicates > 0 {
        add(
            NoticeKind::Duplicates,
            topic,
            format!("{} repeating an earlier one exactly", plural(channel.duplicates, "message")),
        );
    }
    if let Some(missing) = channel.missing_by_sequence.filter(|&missing| missing > 0) {
        add(NoticeKind::MissingBySequence, topic, format!("{} skipped", plural(missing, "sequence number")));
    }
    if let Some(detail) = gaps(channel, channel.rate.as_ref()) {
        match &channel.publish_rate {
            Some(publish) if gaps(channel, Some(publish)).is_none() => {
                let detail = format!(
                    "{detail} by log time, none by publish time: the recorder stalled and then caught up"
                );
                add(NoticeKind::Bunching, topic, detail);
            }
            _ => add(NoticeKind::Gap, topic, detail),
        }
    }
    if let Some(detail) = ends_early(file, channel) {
        add(NoticeKind::EndsEarly, topic, detail);
    }
}

fn is_regular(rate: &super::Rate) -> bool {
    rate.jitter_ms * rate.median_hz / 1e3 < IRREGULAR
}

/// Describes the gaps of a regular channel.
fn gaps(channel: &ChannelReport, rate: Option<&super::Rate>) -> Option<String> {
    let rate = rate.filter(|rate| channel.messages >= GAP_MIN_MESSAGES && is_regular(rate))?;
    let longest = rate.longest_gaps.first().filter(|gap| gap.ms >= GAP_MIN_MS)?;
    let start = channel.start_ns.map_or(0.0, |start| longest.start_ns.saturating_sub(start) as f64 / 1e9);
    let n_long = rate.longest_gaps.iter().filter(|gap| gap.ms >= GAP_MIN_MS).count() as u64;
    let count =
        if n_long == 1 { "a gap".to_owned() } else { format!("{} gaps, the longest", rate.gaps.max(n_long)) };
    Some(format!("{count} of {:.0} ms at {start:.3} s (period {:.1} ms)", longest.ms, 1e3 / rate.median_hz))
}

/// Tells whether a regular channel stops long before the file does.
fn ends_early(file: &FileReport, channel: &ChannelReport) -> Option<String> {
    let rate =
        channel.rate.as_ref().filter(|rate| channel.messages >= GAP_MIN_MESSAGES && is_regular(rate))?;
    if channel.largest_backward_ms * 1e6 >= CLOCK_RESET_NS as f64 {
        return None;
    }
    let (start, end, last) = (file.start_ns?, file.end_ns?, channel.end_ns?);
    let silent_s = end.saturating_sub(last) as f64 / 1e9;
    let span_s = end.saturating_sub(start) as f64 / 1e9;
    let is_early = silent_s > ENDS_EARLY_SHARE * span_s && silent_s * rate.median_hz > ENDS_EARLY_PERIODS;
    is_early.then(|| {
        format!(
            "silent from {:.3} s on, {silent_s:.3} s before the end of the file",
            last.saturating_sub(start) as f64 / 1e9
        )
    })
}

/// The best known drift of header stamps, when it is both large and sure enough.
fn drift<'a>(file: &'a FileReport) -> Option<(&'a ChannelReport, &'a ClockOffset, f64, f64)> {
    let best = |channel: &'a ChannelReport| {
        let ChannelReport { stamp_to_publish, stamp_to_log, .. } = channel;
        let offset = stamp_to_publish.as_ref().or(stamp_to_log.as_ref())?;
        Some((channel, offset, offset.drift_ppm?, offset.drift_error_ppm?))
    };
    let found = file.channels.iter().filter_map(best).min_by(|a, b| a.3.total_cmp(&b.3))?;
    (found.2.abs() >= DRIFT_MIN_PPM && found.2.abs() > 4.0 * found.3).then_some(found)
}
