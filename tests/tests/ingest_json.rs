//! The JSON that other programs rely on: every key that the documentation names, by name and type, and its enums.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use serde_json::Value;
use support::{code, demo_contract, demo_log, files, ingest, root, shared, stderr, suggest, text};

/// What a key holds.
#[derive(Debug, Clone, Copy)]
enum Holds {
    Text,
    Count,
    Truth,
    List,
    TimeOrNull,
}

use Holds::{Count, List, Text, TimeOrNull, Truth};

const FILE: &[(&str, Holds)] = &[
    ("path", Text),
    ("profile", Text),
    ("library", Text),
    ("messages", Count),
    ("attachments", Count),
    ("metadata", Count),
    ("start_ns", TimeOrNull),
    ("end_ns", TimeOrNull),
    ("channels", List),
    ("damage", List),
];

const CHANNEL: &[(&str, Holds)] = &[
    ("topic", Text),
    ("schema_name", Text),
    ("schema_encoding", Text),
    ("message_encoding", Text),
    ("messages", Count),
    ("decodable", Truth),
];

const DAMAGE: &[(&str, Holds)] = &[("kind", Text), ("offset", Count), ("detail", Text)];

const REPORT: &[(&str, Holds)] =
    &[("files", List), ("episodes", Count), ("frames", Count), ("warnings", List)];

const REPORT_FILE: &[(&str, Holds)] = &[("path", Text), ("status", Text), ("topics", List)];

const TOPIC: &[(&str, Holds)] = &[("topic", Text), ("read", Count), ("kept", Count), ("lost", List)];

const LOST: &[(&str, Holds)] = &[("reason", Text), ("count", Count)];

fn check_keys(value: &Value, keys: &[(&str, Holds)], place: &str) {
    for (key, holds) in keys {
        let found = value.get(key).unwrap_or_else(|| panic!("{place}: no {key:?} in {value}"));
        let is_good = match holds {
            Text => found.is_string(),
            Count => found.is_u64(),
            Truth => found.is_boolean(),
            List => found.is_array(),
            TimeOrNull => found.is_u64() || found.is_null(),
        };
        assert!(is_good, "{place}: {key:?} is {found}, expected {holds:?}");
    }
}

fn list<'a>(value: &'a Value, key: &str) -> &'a [Value] {
    value[key].as_array().unwrap()
}

fn count(value: &Value, key: &str) -> u64 {
    value[key].as_u64().unwrap()
}

/// The names in the first column of a document's tables.
fn documented(document: &str) -> BTreeSet<String> {
    let text = std::fs::read_to_string(root().join(document)).unwrap();
    let cells = text.lines().filter_map(|line| line.strip_prefix("| `")?.split_once("` |"));
    cells.flat_map(|(names, _)| names.split("`, `")).map(str::to_owned).collect()
}

/// Inspects a log and returns the entry of its file, or none when it was refused.
fn check_inspect(log: &Path, kinds: &BTreeSet<String>) -> Option<Value> {
    let output = ingest(&["inspect", "--format", "json", text(log)]);
    let place = text(log);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{place}: {e}"));
    let mut found = None;
    for file in list(&report, "files") {
        check_keys(file, FILE, place);
        let channels = list(file, "channels");
        channels.iter().for_each(|channel| check_keys(channel, CHANNEL, place));
        let sum: u64 = channels.iter().map(|channel| count(channel, "messages")).sum();
        assert_eq!(count(file, "messages"), sum, "{place}");
        for damage in list(file, "damage") {
            check_keys(damage, DAMAGE, place);
            let kind = damage["kind"].as_str().unwrap();
            assert!(kinds.contains(kind), "{place}: damage kind {kind:?} is not documented");
        }
        assert!(file["start_ns"].as_u64() <= file["end_ns"].as_u64(), "{place}");
        assert_ne!(file["start_ns"].as_u64(), Some(0), "{place}: log time 0 is left out of the span");
        found = Some(file.clone());
    }
    found
}

/// Runs a contract and checks its report, whatever came of it; none where the contract does not fit the log.
fn check_run(contract: &Path, log: &Path, reasons: &BTreeSet<String>) -> Option<Value> {
    let folder = tempfile::tempdir().unwrap();
    let (out, path) = (folder.path().join("out"), folder.path().join("r.json"));
    let output =
        ingest(&["run", "--config", text(contract), "--out", text(&out), "--report", text(&path), text(log)]);
    let place = text(log);
    if code(&output) == 2 {
        assert!(!out.join("meta/info.json").exists(), "{place}");
        return None;
    }
    assert!(matches!(code(&output), 0 | 1 | 3), "{place}: {}", stderr(&output));
    let report: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    check_keys(&report, REPORT, place);
    let mut has_loss = false;
    for file in list(&report, "files") {
        check_keys(file, REPORT_FILE, place);
        let status = file["status"].as_str().unwrap();
        assert!(["ok", "loss", "refused", "already_there"].contains(&status), "{place}: {status}");
        has_loss |= matches!(status, "loss" | "refused");
        for topic in list(file, "topics") {
            check_keys(topic, TOPIC, place);
            let lost = list(topic, "lost");
            for found in lost {
                check_keys(found, LOST, place);
                let reason = found["reason"].as_str().unwrap();
                assert!(reasons.contains(reason), "{place}: reason {reason:?} is not documented");
                assert!(count(found, "count") > 0);
            }
            let sum: u64 = lost.iter().map(|found| count(found, "count")).sum();
            assert_eq!(count(topic, "read"), count(topic, "kept") + sum, "{place}: {topic}");
        }
    }
    assert_eq!(code(&output) == 0, !has_loss, "{place}: the exit code says what the report says");
    assert!(list(&report, "warnings").iter().all(Value::is_string));
    Some(report)
}

#[test]
fn the_demo_log_has_every_key() {
    let file = check_inspect(&demo_log(), &documented("docs/formats/inspect.md")).unwrap();
    assert_eq!((count(&file, "messages"), count(&file, "metadata")), (330, 1));
    let report = check_run(&demo_contract(), &demo_log(), &documented("docs/contract.md")).unwrap();
    assert_eq!((count(&report, "episodes"), count(&report, "frames")), (1, 30));
    let output = ingest(&["inspect", "--records", text(&demo_log())]);
    let records: Value = serde_json::from_slice(&output.stdout).unwrap();
    let first = &list(&records, "records")[0];
    assert_eq!(first["type"], "Header");
    assert!(list(first, "fields").iter().all(|field| field.as_array().is_some_and(|pair| pair.len() == 2)));
}

#[test]
fn every_log_of_the_corpora_has_every_key() {
    let Some(corpora) = shared() else { return };
    let (kinds, reasons) = (documented("docs/formats/inspect.md"), documented("docs/contract.md"));
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("c.toml");
    suggest(&[&corpora.join("generated/base_short.mcap")], &contract);
    let is_log = |path: &PathBuf| {
        path.extension().is_some_and(|end| end == "mcap") && !path.starts_with("mcap_conformance")
    };
    let logs: Vec<PathBuf> = files(&corpora).into_keys().filter(is_log).collect();
    assert!(logs.len() > 60);
    let mut n_runs = 0;
    for log in logs {
        check_inspect(&corpora.join(&log), &kinds);
        if log.starts_with("generated") {
            n_runs += usize::from(check_run(&contract, &corpora.join(&log), &reasons).is_some());
        }
    }
    assert!(n_runs > 10, "{n_runs}");
}

/// A message with log time 0 is counted, and does not stretch the span of its file to decades.
#[test]
fn log_time_zero_is_reported() {
    let Some(corpora) = shared() else { return };
    let log = corpora.join("franka_teach/trajectory_20250527_002946_00m00s.mcap");
    let file = check_inspect(&log, &documented("docs/formats/inspect.md")).unwrap();
    assert_eq!((count(&file, "messages"), count(&file, "attachments"), count(&file, "metadata")), (27, 1, 3));
    let span_ns = file["end_ns"].as_u64().unwrap() - file["start_ns"].as_u64().unwrap();
    assert!(span_ns < 3_600_000_000_000, "{span_ns}");
    let damage = list(&file, "damage").iter().chain(list(&file, "notices"));
    assert!(damage.into_iter().any(|found| found["kind"] == "log_time_zero"), "{file}");
}
