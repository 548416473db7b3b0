//! Which clock a topic goes by, and how old its samples may be.

use super::survey::Topic;

/// A stamp whose offset to the log time is larger, or spreads more, is not trusted to be the same clock.
const MAX_STAMP_OFFSET_MS: f64 = 2_000.0;

/// Returns the clock of a topic and why.
pub(crate) fn clock_of(topic: &Topic) -> (String, String) {
    let report = &topic.report;
    if report.stamps == report.messages && report.messages > 0 {
        match &report.stamp_to_log {
            Some(offset) => {
                let spread = offset.p95_ms - offset.p05_ms;
                if offset.median_ms.abs() <= MAX_STAMP_OFFSET_MS && spread <= MAX_STAMP_OFFSET_MS {
                    let reason = format!(
                        "header stamps, {:.1} ms before the log time (5 % to 95 %: {:.1} to {:.1} ms)",
                        offset.median_ms, offset.p05_ms, offset.p95_ms
                    );
                    return ("stamp".to_owned(), reason);
                }
                let reason = format!(
                    "log time: header stamps are {:.0} ms off it (5 % to 95 %: {:.0} to {:.0} ms), so not of the same clock",
                    offset.median_ms, offset.p05_ms, offset.p95_ms
                );
                return publish_or_log(topic, reason);
            }
            None if report.messages == 1 => {
                return ("stamp".to_owned(), "one message, with a header stamp".to_owned());
            }
            None => {}
        }
    }
    publish_or_log(topic, "log time: no header stamp".to_owned())
}

fn publish_or_log(topic: &Topic, otherwise: String) -> (String, String) {
    match &topic.report.publish_to_log {
        Some(offset)
            if topic.report.has_publish_clock
                && offset.median_ms.abs() <= MAX_STAMP_OFFSET_MS
                && offset.p95_ms - offset.p05_ms <= MAX_STAMP_OFFSET_MS =>
        {
            let reason = format!(
                "publish time, {:.1} ms before the log time; no usable header stamp",
                offset.median_ms
            );
            ("publish".to_owned(), reason)
        }
        _ => ("log".to_owned(), otherwise),
    }
}

/// Returns a tolerance and why, or none for topics that speak when something happens.
pub(crate) fn tolerance_of(topic: &Topic) -> (Option<f64>, String) {
    let rate = topic.rate_hz();
    let period = if rate > 0.0 { 1e3 / rate } else { 0.0 };
    let is_regular = topic.messages >= 8 && period > 0.0 && topic.slow_ms <= 8.0 * period;
    if !is_regular {
        return (None, format!("{} messages at no steady rate: the last one holds", topic.messages));
    }
    let ms = (3.0 * period).max(2.0 * topic.slow_ms).max(20.0);
    let ms = if ms < 1000.0 { ms.ceil() } else { (ms / 100.0).ceil() * 100.0 };
    (Some(ms), format!("{rate:.2} Hz, 1 % of the intervals over {:.1} ms", topic.slow_ms))
}
