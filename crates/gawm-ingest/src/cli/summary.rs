//! What a run made, for people.

use std::fmt::Write as _;
use std::path::Path;

use gawm_schema::FeatureData;

use crate::run::{FileStatus, RunOutcome};

/// Returns the summary that `run` prints.
pub(crate) fn text(outcome: &RunOutcome, out: &Path) -> String {
    let mut text = String::new();
    write(&mut text, outcome, out).ok();
    text
}

fn write(text: &mut String, outcome: &RunOutcome, out: &Path) -> std::fmt::Result {
    let (summary, report) = (&outcome.summary, &outcome.report);
    writeln!(
        text,
        "{}: {} episodes, {} frames at {} Hz, {}",
        out.display(),
        summary.episodes,
        summary.frames,
        trimmed(outcome.schema.rate_hz),
        bytes(summary.data_bytes)
    )?;
    if summary.new_episodes != summary.episodes {
        writeln!(text, "  new: {} episodes, {} frames", summary.new_episodes, summary.new_frames)?;
    }
    let already: Vec<&str> = report
        .files
        .iter()
        .filter(|file| file.status == FileStatus::AlreadyThere)
        .map(|file| file.path.as_str())
        .collect();
    if !already.is_empty() {
        let more = if already.len() > 8 { ", ..." } else { "" };
        writeln!(text, "  already there: {}{more}", already[..already.len().min(8)].join(", "))?;
    }
    writeln!(text, "\ncolumns")?;
    for feature in &outcome.schema.features {
        let what = match &feature.data {
            FeatureData::Vector { parts, .. } => {
                let names: Vec<&str> =
                    parts.iter().flat_map(|part| &part.dims).map(|dim| dim.name.as_str()).collect();
                let shown = names.iter().take(8).copied().collect::<Vec<_>>().join(", ");
                let more = if names.len() > 8 { ", ..." } else { "" };
                let noun = if names.len() == 1 { "value" } else { "values" };
                format!("{} {noun}: {shown}{more}", names.len())
            }
            FeatureData::Image(spec) => {
                format!("{}x{} {}", spec.width, spec.height, if spec.depth { "depth" } else { "image" })
            }
        };
        writeln!(text, "  {:<32} {what}", feature.name)?;
    }
    let width = report.streams.iter().map(|stream| stream.stream.len()).max().unwrap_or(0).max(28);
    writeln!(text, "\n{:<width$}   age ms: median      95 %       max   invalid rows", "streams")?;
    for stream in &report.streams {
        writeln!(
            text,
            "  {:<width$} {:>15} {:>9} {:>9}   {:>12}",
            stream.stream,
            age(stream.age_ms_p50),
            age(stream.age_ms_p95),
            age(stream.age_ms_max),
            stream.invalid_rows
        )?;
    }
    if report.streams.iter().any(|stream| stream.age_ms_p50 < 0.0) {
        writeln!(text, "  (an age below 0: the command comes after the row's tick, before the next)")?;
    }
    losses(text, outcome)?;
    writeln!(text, "\nnext\n  gawm-data validate {0}\n  gawm-data report {0}", out.display())
}

fn losses(text: &mut String, outcome: &RunOutcome) -> std::fmt::Result {
    let mut is_first = true;
    for file in &outcome.report.files {
        let lost = file.topics.iter().filter(|topic| topic.mapped).flat_map(|topic| {
            topic.lost.iter().map(|lost| {
                format!(
                    "{}: {} of {} messages, {} ({})",
                    topic.topic, lost.count, topic.read, lost.reason, lost.first
                )
            })
        });
        let mut lines: Vec<String> = lost.collect();
        if let (FileStatus::Refused, Some(error)) = (file.status, &file.error) {
            lines.insert(0, format!("refused: {}", error.replace('\n', "\n      ")));
        }
        if lines.is_empty() {
            continue;
        }
        if std::mem::take(&mut is_first) {
            writeln!(text, "\nlost")?;
        }
        writeln!(text, "  {}", file.path)?;
        for line in lines {
            writeln!(text, "    {line}")?;
        }
    }
    Ok(())
}

fn age(ms: f64) -> String {
    if ms.is_finite() { format!("{ms:.1}") } else { "-".to_owned() }
}

fn trimmed(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}

fn bytes(n: u64) -> String {
    match n {
        0..1_000_000 => format!("{:.1} kB", n as f64 / 1e3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", n as f64 / 1e6),
        _ => format!("{:.2} GB", n as f64 / 1e9),
    }
}
