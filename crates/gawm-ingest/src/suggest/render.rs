//! Writes a suggestion as TOML with comments.

use std::fmt::Write as _;

use serde::Serialize;

use super::Suggestion;
use crate::contract::Contract;

/// Returns the contract as TOML; every guess carries its reason.
pub(crate) fn render(suggestion: &Suggestion) -> String {
    let mut text = String::new();
    write(&mut text, suggestion).ok();
    text
}

fn write(text: &mut String, suggestion: &Suggestion) -> std::fmt::Result {
    let contract = &suggestion.contract;
    let defaults = Contract::default();
    writeln!(
        text,
        "# A first contract, guessed from the logs: every comment is the reason of the guess below it."
    )?;
    writeln!(text, "# Read it, correct it, then: gawm-ingest run --config THIS.toml --out DATASET LOG...")?;
    writeln!(text, "# docs/contract.md says what every key means.\n")?;
    writeln!(text, "version = 1")?;
    if let Some(robot_type) = &contract.robot_type {
        writeln!(text, "robot_type = {}", toml::Value::String(robot_type.clone()))?;
    }
    if contract.disorder_window_ms != defaults.disorder_window_ms
        || suggestion.reasons.contains_key("disorder_window_ms")
    {
        comments(text, suggestion.reasons.get("disorder_window_ms"))?;
        writeln!(text, "disorder_window_ms = {:?}", contract.disorder_window_ms)?;
    }
    writeln!(text)?;
    comments(text, suggestion.reasons.get("ticks"))?;
    section(text, "ticks", &contract.ticks)?;
    let mut before: Option<(&Option<String>, &Vec<String>)> = None;
    for (stream, reasons) in contract.stream.iter().zip(&suggestion.stream_reasons) {
        writeln!(text)?;
        // What was said of the topic just above is not said again.
        let is_known = |line: &&String| {
            before.is_some_and(|(topic, said)| *topic == stream.topic && said.contains(line))
        };
        let fresh = reasons.iter().filter(|line| !is_known(line)).cloned().collect();
        comments(text, Some(&fresh))?;
        before = Some((&stream.topic, reasons));
        writeln!(text, "[[stream]]")?;
        body(text, stream)?;
    }
    writeln!(text)?;
    comments(text, suggestion.reasons.get("episodes"))?;
    section(text, "episodes", &contract.episodes)?;
    writeln!(text)?;
    comments(text, suggestion.reasons.get("labels"))?;
    section(text, "labels", &contract.labels)?;
    if !suggestion.unmapped.is_empty() {
        writeln!(text, "\n# Not mapped:")?;
        for line in &suggestion.unmapped {
            writeln!(text, "#   {}", one_line(line))?;
        }
    }
    Ok(())
}

fn comments(text: &mut String, lines: Option<&Vec<String>>) -> std::fmt::Result {
    lines.into_iter().flatten().try_for_each(|line| writeln!(text, "# {}", one_line(line)))
}

/// Topics and schema names come from the log: no line break may end a comment.
fn one_line(line: &str) -> String {
    line.chars().map(|char| if char.is_control() { ' ' } else { char }).collect()
}

fn section(text: &mut String, name: &str, value: &impl Serialize) -> std::fmt::Result {
    writeln!(text, "[{name}]")?;
    body(text, value)
}

/// Writes the keys of a table, nested tables inline so that they stay below their header.
fn body(text: &mut String, value: &impl Serialize) -> std::fmt::Result {
    let Ok(toml::Value::Table(table)) = toml::Value::try_from(value) else { return Ok(()) };
    for (key, value) in table {
        if is_default(&key, &value) {
            continue;
        }
        match &value {
            toml::Value::Table(inner) => {
                let kept: toml::Table = inner
                    .iter()
                    .filter(|(key, value)| !is_default(key, value))
                    .map(|(k, v)| (k.clone(), v.clone()))
                    .collect();
                if !kept.is_empty() {
                    writeln!(text, "{key} = {}", toml::Value::Table(kept))?;
                }
            }
            toml::Value::Array(items) if items.len() > 2 && items.iter().all(toml::Value::is_str) => {
                writeln!(text, "{key} = [")?;
                items.iter().try_for_each(|item| writeln!(text, "    {item},"))?;
                writeln!(text, "]")?;
            }
            _ => writeln!(text, "{key} = {value}")?,
        }
    }
    Ok(())
}

/// Values that say nothing: what every contract has unless it says otherwise.
fn is_default(key: &str, value: &toml::Value) -> bool {
    match value {
        toml::Value::String(text) => matches!(
            (key, text.as_str()),
            ("non_finite", "mask")
                | ("kind", "linear")
                | ("delta_frame", "base")
                | ("format", "passthrough")
                | ("time_unit", "ns")
        ),
        toml::Value::Float(number) => key == "min_length_s" && *number == 0.0,
        toml::Value::Integer(number) => key == "min_frames" && *number == 2,
        _ => false,
    }
}
