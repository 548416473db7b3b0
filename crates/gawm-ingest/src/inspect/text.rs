//! An inspection as text: damage first, then one aligned line per channel.

use std::fmt::Write as _;

use super::clocks::ClockOffset;
use super::report::{ChannelReport, FileReport, InspectReport};
use crate::log::Severity;

/// Findings of one kind that are printed before the rest is only counted.
const MAX_LINES_PER_KIND: usize = 8;
/// Widest schema name or topic before it is cut in the middle.
const MAX_NAME: usize = 48;

/// Renders a report for people.
pub fn render_text(report: &InspectReport) -> String {
    let mut out = String::new();
    for refusal in &report.refused {
        line(&mut out, format_args!("REFUSED {}", refusal.error));
        refusal.hint.iter().for_each(|hint| line(&mut out, format_args!("  hint: {hint}")));
    }
    for recording in &report.recordings {
        line(
            &mut out,
            format_args!("recording {:?}: {} parts, read as one", recording.name, recording.parts.len()),
        );
    }
    for file in &report.files {
        if !out.is_empty() {
            out.push('\n');
        }
        render_file(&mut out, file);
    }
    let tables = report.tables.iter().map(ToString::to_string);
    for text in tables.chain(report.datasets.iter().map(ToString::to_string)) {
        if !out.is_empty() {
            out.push('\n');
        }
        out.push_str(&text);
    }
    out
}

fn line(out: &mut String, text: std::fmt::Arguments<'_>) {
    // Writing to a string cannot fail.
    writeln!(out, "{text}").ok();
}

fn render_file(out: &mut String, file: &FileReport) {
    line(out, format_args!("{}", file.path));
    render_damage(out, file);
    let span = match (file.start_ns, file.end_ns) {
        (Some(start), Some(end)) => format!("{} from {}", seconds(end - start), instant(start)),
        _ => "no messages".to_owned(),
    };
    line(out, format_args!("  {}, {}, {span}", bytes(file.bytes), plural(file.messages, "message")));
    let profile = if file.profile.is_empty() { "none" } else { &file.profile };
    line(out, format_args!("  profile {profile}, library {:?}, {}", file.library, storage(file)));
    for attachment in &file.attachment_list {
        line(
            out,
            format_args!(
                "  attachment {:?} ({}, {})",
                attachment.name,
                attachment.media_type,
                bytes(attachment.bytes)
            ),
        );
    }
    for record in &file.metadata_list {
        let values: Vec<String> =
            record.values.iter().map(|(key, value)| format!("{key}={}", shorten(value, 60))).collect();
        line(out, format_args!("  metadata {:?}: {}", record.name, shorten(&values.join(" "), 160)));
    }
    render_channels(out, &file.channels);
    let mut last = None;
    for notice in &file.notices {
        if last != Some(notice.kind) {
            line(out, format_args!("  {}", heading(notice.kind)));
            last = Some(notice.kind);
        }
        match &notice.topic {
            Some(topic) => line(out, format_args!("    {topic}: {}", notice.detail)),
            None => line(out, format_args!("    {}", notice.detail)),
        }
    }
}

fn heading(kind: super::NoticeKind) -> &'static str {
    use super::NoticeKind::*;
    match kind {
        NoPublishClock => "no publish clock",
        Gap => "gaps",
        Bunching => "bunching",
        BackwardSteps => "backward steps",
        Duplicates => "duplicates",
        MissingBySequence => "missing by sequence number",
        EndsEarly => "ends early",
        ClockDrift => "clock drift",
        CompressedMessages => "compressed messages",
        SeveralChannels => "several channels on one topic",
        NotDecodable => "not decodable",
    }
}

fn render_damage(out: &mut String, file: &FileReport) {
    let worst_first =
        |severity: Severity| file.damage.iter().filter(move |damage| damage.kind.severity() == severity);
    for (severity, label) in
        [(Severity::Loss, "LOSS"), (Severity::Doubt, "DOUBT"), (Severity::Notice, "note")]
    {
        let mut shown: Vec<(&str, usize)> = Vec::new();
        for damage in worst_first(severity) {
            let kind = damage.kind.as_str();
            let n_shown = match shown.iter_mut().find(|(other, _)| *other == kind) {
                Some((_, n)) => {
                    *n += 1;
                    *n
                }
                None => {
                    shown.push((kind, 1));
                    1
                }
            };
            if n_shown <= MAX_LINES_PER_KIND {
                line(out, format_args!("  {label:<5} {kind} at byte {}: {}", damage.offset, damage.detail));
            }
        }
        for (kind, n) in shown.into_iter().filter(|(_, n)| *n > MAX_LINES_PER_KIND) {
            line(out, format_args!("  {label:<5} {kind}: {} more", n - MAX_LINES_PER_KIND));
        }
    }
}

fn storage(file: &FileReport) -> String {
    let mut parts: Vec<String> = file
        .compression
        .iter()
        .map(|(name, n)| match name.as_str() {
            "none" => plural(*n, "uncompressed chunk"),
            name => format!(
                "{} ({} uncompressed)",
                plural(*n, &format!("{name} chunk")),
                bytes(file.uncompressed_bytes)
            ),
        })
        .collect();
    if file.loose_blocks > 0 {
        parts.push("messages outside chunks".to_owned());
    }
    if parts.is_empty() {
        parts.push("no chunks".to_owned());
    }
    if !file.has_summary {
        parts.push("no summary".to_owned());
    }
    parts.join(", ")
}

/// A column of a table: heading, alignment, and the cell of a channel.
struct Column {
    heading: &'static str,
    is_number: bool,
    cell: fn(&ChannelReport) -> String,
}

const COLUMNS: &[Column] = &[
    Column { heading: "topic", is_number: false, cell: |c| shorten(&c.topic, MAX_NAME) },
    Column {
        heading: "schema",
        is_number: false,
        cell: |c| shorten(if c.schema_name.is_empty() { "-" } else { &c.schema_name }, MAX_NAME),
    },
    Column { heading: "encoding", is_number: false, cell: encoding },
    Column { heading: "messages", is_number: true, cell: |c| count(c.messages) },
    Column { heading: "size", is_number: true, cell: |c| bytes(c.bytes) },
    Column {
        heading: "Hz",
        is_number: true,
        cell: |c| c.rate.as_ref().map_or("-".to_owned(), |rate| hertz(rate.median_hz)),
    },
    Column { heading: "min..max Hz", is_number: true, cell: rate_band },
    Column {
        heading: "jitter ms",
        is_number: true,
        cell: |c| c.rate.as_ref().map_or("-".to_owned(), |rate| format!("{:.1}", rate.jitter_ms)),
    },
    Column { heading: "log-publish ms", is_number: true, cell: |c| offset(c.publish_to_log.as_ref()) },
    Column { heading: "log-stamp ms", is_number: true, cell: |c| offset(c.stamp_to_log.as_ref()) },
    Column { heading: "drift ppm", is_number: true, cell: drift },
];

fn encoding(channel: &ChannelReport) -> String {
    let schema = if channel.schema_encoding.is_empty() { "no schema" } else { &channel.schema_encoding };
    let mark = if channel.decodable { "" } else { " (!)" };
    format!("{}/{schema}{mark}", channel.message_encoding)
}

fn rate_band(channel: &ChannelReport) -> String {
    let Some(rate) = &channel.rate else { return "-".to_owned() };
    format!("{}..{}", hertz(rate.min_hz), rate.max_hz.map_or("inf".to_owned(), hertz))
}

fn hertz(value: f64) -> String {
    match value {
        value if value >= 99.95 => format!("{value:.0}"),
        value if value >= 9.995 => format!("{value:.1}"),
        value => format!("{value:.2}"),
    }
}

fn offset(offset: Option<&ClockOffset>) -> String {
    offset.map_or("-".to_owned(), |offset| {
        let large = offset.median_ms.abs() >= 1e5;
        if large { seconds_signed(offset.median_ms / 1e3) } else { format!("{:.1}", offset.median_ms) }
    })
}

fn seconds_signed(value: f64) -> String {
    format!("{value:.1} s")
}

fn drift(channel: &ChannelReport) -> String {
    let offset = channel.stamp_to_publish.as_ref().or(channel.stamp_to_log.as_ref());
    match offset.and_then(|offset| Some((offset.drift_ppm?, offset.drift_error_ppm?))) {
        // The offset shrinks when the stamps' clock is the faster one.
        Some((ppm, error)) if error < 100.0 => format!("{:+.1}+-{error:.1}", 0.0 - ppm),
        _ => "-".to_owned(),
    }
}

fn render_channels(out: &mut String, channels: &[ChannelReport]) {
    if channels.is_empty() {
        return;
    }
    let mut columns: Vec<(&Column, Vec<String>)> =
        COLUMNS.iter().map(|column| (column, channels.iter().map(column.cell).collect())).collect();
    // A column in which nothing is known says nothing.
    columns.retain(|(_, cells)| cells.iter().any(|cell| cell != "-"));
    let widths: Vec<usize> = columns
        .iter()
        .map(|(column, cells)| {
            cells.iter().map(|cell| cell.chars().count()).chain([column.heading.len()]).max().unwrap_or(0)
        })
        .collect();
    let mut row = |cells: Vec<&str>| {
        let mut text = String::from("  ");
        for ((cell, &width), (column, _)) in cells.iter().zip(&widths).zip(&columns) {
            if column.is_number {
                write!(text, "{cell:>width$}  ").ok();
            } else {
                write!(text, "{cell:<width$}  ").ok();
            }
        }
        line(out, format_args!("{}", text.trim_end()));
    };
    row(columns.iter().map(|(column, _)| column.heading).collect());
    for i in 0..channels.len() {
        row(columns.iter().map(|(_, cells)| cells[i].as_str()).collect());
    }
}

/// Cuts a long text in the middle and makes control characters visible.
fn shorten(text: &str, limit: usize) -> String {
    let clean: Vec<char> = text.chars().map(|c| if c.is_control() { ' ' } else { c }).collect();
    if clean.len() <= limit {
        return clean.into_iter().collect();
    }
    let half = (limit - 1) / 2;
    clean[..half].iter().chain(['…'].iter()).chain(&clean[clean.len() - half..]).collect()
}

fn count(n: u64) -> String {
    let digits = n.to_string();
    let mut out = String::new();
    for (i, digit) in digits.chars().enumerate() {
        if i > 0 && (digits.len() - i).is_multiple_of(3) {
            out.push(',');
        }
        out.push(digit);
    }
    out
}

/// Prints a number and its noun.
pub(super) fn plural(n: u64, noun: &str) -> String {
    format!("{} {noun}{}", count(n), if n == 1 { "" } else { "s" })
}

fn bytes(n: u64) -> String {
    const UNITS: [&str; 5] = ["B", "kB", "MB", "GB", "TB"];
    let mut value = n as f64;
    let mut unit = 0;
    while value >= 999.5 && unit + 1 < UNITS.len() {
        value /= 1000.0;
        unit += 1;
    }
    if unit == 0 { format!("{n} B") } else { format!("{value:.1} {}", UNITS[unit]) }
}

fn seconds(ns: u64) -> String {
    let total = ns as f64 / 1e9;
    if total < 120.0 {
        return format!("{total:.3} s");
    }
    let (minutes, rest) = ((total / 60.0).floor(), total % 60.0);
    if minutes < 60.0 {
        return format!("{minutes:.0} min {rest:.0} s");
    }
    format!("{:.0} h {:.0} min", (minutes / 60.0).floor(), minutes % 60.0)
}

/// Prints a log time as a date where it can be one, else as seconds.
fn instant(ns: u64) -> String {
    const YEAR_1990_NS: u64 = 631_152_000_000_000_000;
    const YEAR_2100_NS: u64 = 4_102_444_800_000_000_000;
    if !(YEAR_1990_NS..YEAR_2100_NS).contains(&ns) {
        return format!("{:.3} s (no wall clock)", ns as f64 / 1e9);
    }
    let seconds = ns / 1_000_000_000;
    let (year, month, day) = civil_date(seconds / 86_400);
    let (hour, minute, second) = (seconds / 3600 % 24, seconds / 60 % 60, seconds % 60);
    format!("{year}-{month:02}-{day:02} {hour:02}:{minute:02}:{second:02}.{:03} UTC", ns / 1_000_000 % 1000)
}

/// Gregorian date of a day since 1970-01-01; the algorithm of Howard Hinnant's `civil_from_days`.
fn civil_date(days: u64) -> (u64, u64, u64) {
    let z = days + 719_468;
    let (era, day_of_era) = (z / 146_097, z % 146_097);
    let year_of_era = (day_of_era - day_of_era / 1460 + day_of_era / 36_524 - day_of_era / 146_096) / 365;
    let day_of_year = day_of_era - (365 * year_of_era + year_of_era / 4 - year_of_era / 100);
    let month_index = (5 * day_of_year + 2) / 153;
    let day = day_of_year - (153 * month_index + 2) / 5 + 1;
    let month = if month_index < 10 { month_index + 3 } else { month_index - 9 };
    (year_of_era + era * 400 + u64::from(month <= 2), month, day)
}

#[cfg(test)]
mod tests {
    use super::{bytes, count, instant, seconds, shorten};

    #[test]
    fn numbers_read_like_numbers() {
        assert_eq!((count(0), count(999), count(1_234_567)), ("0".into(), "999".into(), "1,234,567".into()));
        assert_eq!(
            (bytes(12), bytes(1_500), bytes(10_400_000_000)),
            ("12 B".into(), "1.5 kB".into(), "10.4 GB".into())
        );
        assert_eq!(
            (seconds(12_029_132_515), seconds(3_725_000_000_000)),
            ("12.029 s".into(), "1 h 2 min".into())
        );
        assert_eq!(instant(1_760_000_000_364_845_000), "2025-10-09 08:53:20.364 UTC");
        assert_eq!(instant(1_709_164_800_000_000_000), "2024-02-29 00:00:00.000 UTC");
        assert_eq!(instant(2_500_000_000), "2.500 s (no wall clock)");
        assert_eq!(shorten("abcdefghij", 5), "ab…ij");
    }
}
