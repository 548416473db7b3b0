//! Reports as text and Markdown: one block per rule, with the first findings of each.

use std::fmt::Write;

use super::{Finding, Report, Severity, catalogue};

/// Findings shown per rule in texts for people; the rest is counted.
const SHOWN_PER_RULE: usize = 6;

/// Renders a report for a terminal.
pub fn render_text(report: &Report) -> String {
    let mut out = String::new();
    let counts = report.counts;
    writeln!(
        out,
        "{} ({}): {} episodes, {} rows: {} errors, {} warnings, {} notes",
        report.dataset,
        report.format,
        report.episodes,
        report.rows,
        counts.error,
        counts.warning,
        counts.info
    )
    .ok(); // Writing to a String cannot fail.
    let windows = report.windows;
    writeln!(
        out,
        "windows of {} rows: {} of {} survive ({:.1} % of the rows)",
        windows.rows_per_window,
        windows.surviving,
        windows.windows,
        100.0 * windows.share_of_rows
    )
    .ok();
    for group in by_rule(report) {
        let first = group[0];
        let title = catalogue::rule(first.code).map_or("", |r| r.title);
        writeln!(out, "\n{:<7} {}  {title}", first.severity.text(), first.code).ok();
        for finding in group.iter().take(SHOWN_PER_RULE) {
            writeln!(out, "  {}{}", place(finding), finding.message).ok();
        }
        if group.len() > SHOWN_PER_RULE {
            writeln!(out, "  ... and {} more", group.len() - SHOWN_PER_RULE).ok();
        }
        writeln!(out, "  hint: {}", first.hint).ok();
    }
    if report.findings.is_empty() {
        out.push_str("\nnothing found\n");
    }
    out
}

/// Renders a report as Markdown.
pub fn render_markdown(report: &Report) -> String {
    let mut out = String::new();
    let counts = report.counts;
    writeln!(out, "# Validation of {}\n", cell(&report.dataset)).ok();
    writeln!(
        out,
        "{} episodes, {} rows, {}: {} errors, {} warnings, {} notes. {:.1} % of the rows begin a window of {} rows that survives.\n",
        report.episodes,
        report.rows,
        report.format,
        counts.error,
        counts.warning,
        counts.info,
        100.0 * report.windows.share_of_rows,
        report.windows.rows_per_window
    )
    .ok();
    for group in by_rule(report) {
        let first = group[0];
        let title = catalogue::rule(first.code).map_or("", |r| r.title);
        writeln!(out, "## {} {}: {title}\n", first.severity.text(), first.code).ok();
        writeln!(
            out,
            "To do: {}.\n\n| place | finding | measured | threshold |\n| --- | --- | --- | --- |",
            first.hint
        )
        .ok();
        for finding in group.iter().take(4 * SHOWN_PER_RULE) {
            let number = |v: Option<f64>| v.map_or(String::new(), |v| format!("{v:.4}"));
            let place = place(finding);
            let place = place.trim_end_matches(": ");
            writeln!(
                out,
                "| {} | {} | {} | {} |",
                cell(place),
                cell(&finding.message),
                number(finding.measured),
                number(finding.threshold)
            )
            .ok();
        }
        if group.len() > 4 * SHOWN_PER_RULE {
            writeln!(out, "\n... and {} more.", group.len() - 4 * SHOWN_PER_RULE).ok();
        }
        out.push('\n');
    }
    out
}

fn cell(text: &str) -> String {
    text.replace('|', "\\|").replace(['\n', '\r'], " ")
}

fn by_rule(report: &Report) -> Vec<Vec<&Finding>> {
    let mut groups: Vec<Vec<&Finding>> = Vec::new();
    for finding in report.findings.iter().filter(|f| f.severity != Severity::Off) {
        match groups.last_mut() {
            Some(group) if group[0].code == finding.code && group[0].severity == finding.severity => {
                group.push(finding)
            }
            _ => groups.push(vec![finding]),
        }
    }
    groups
}

/// Says where a finding is: `episode 3 rows 10..20 action[gripper]: `.
fn place(finding: &Finding) -> String {
    let mut parts = Vec::new();
    if let Some(episode) = finding.episode {
        parts.push(format!("episode {episode}"));
    }
    match finding.rows {
        Some([first, end]) if end == first + 1 => parts.push(format!("row {first}")),
        Some([first, end]) => parts.push(format!("rows {first}..{end}")),
        None => {}
    }
    match (&finding.feature, &finding.dim) {
        (Some(feature), Some(dim)) => parts.push(format!("{feature}[{dim}]")),
        (Some(feature), None) => parts.push(feature.clone()),
        _ => {}
    }
    if parts.is_empty() { String::new() } else { format!("{}: ", parts.join(" ")) }
}
