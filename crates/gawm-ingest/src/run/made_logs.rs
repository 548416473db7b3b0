//! Contracts over small logs made here.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufWriter;
use std::path::{Path, PathBuf};
use std::sync::atomic::AtomicBool;

use gawm_dataset::read::{Dataset, ReadLimits};

use super::*;
use crate::contract;

/// A log that is being written.
pub(crate) struct LogWriter {
    writer: mcap::Writer<BufWriter<File>>,
    channels: BTreeMap<String, u16>,
    pub(crate) path: PathBuf,
}

impl LogWriter {
    pub(crate) fn new(folder: &Path) -> LogWriter {
        let path = folder.join("log.mcap");
        let writer = mcap::Writer::new(BufWriter::new(File::create(&path).unwrap())).unwrap();
        LogWriter { writer, channels: BTreeMap::new(), path }
    }

    /// Adds a channel; `schema` is its name, encoding and text.
    pub(crate) fn channel(&mut self, topic: &str, encoding: &str, schema: Option<(&str, &str, &str)>) {
        let schema = schema.map_or(0, |(name, encoding, text)| {
            self.writer.add_schema(name, encoding, text.as_bytes()).unwrap()
        });
        let id = self.writer.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap();
        self.channels.insert(topic.to_owned(), id);
    }

    /// Writes a message; a topic that is new is one of JSON.
    pub(crate) fn write(&mut self, topic: &str, time_ms: u64, payload: &[u8]) {
        if !self.channels.contains_key(topic) {
            self.channel(topic, "json", None);
        }
        let time = 1_000_000_000 + time_ms * 1_000_000;
        let header = mcap::records::MessageHeader {
            channel_id: self.channels[topic],
            sequence: time_ms as u32,
            log_time: time,
            publish_time: time,
        };
        self.writer.write_to_known_channel(&header, payload).unwrap();
    }

    pub(crate) fn finish(mut self) -> PathBuf {
        self.writer.finish().unwrap();
        self.path
    }
}

pub(crate) fn run_over(text: &str, log: &Path, out: &Path, jobs: usize) -> Result<RunOutcome, RunError> {
    let contract = contract::check(&contract::parse(text, "test.toml", &[]).unwrap(), "test.toml").unwrap();
    let options = RunOptions {
        contract: &contract,
        contract_folder: Path::new(""),
        out,
        logs: &[log.to_owned()],
        mode: WriteMode::New,
        jobs,
        shard: None,
        interrupt: &AtomicBool::new(false),
        progress: &|_, _, _| {},
    };
    run(&options, &mut Report::default())
}

/// Returns a column of one value per row.
fn scalars(out: &Path, name: &str) -> Vec<f64> {
    let dataset = Dataset::open(out, ReadLimits::default()).unwrap();
    let take = |rows: &gawm_dataset::read::EpisodeRows| rows.column(name).unwrap().dims()[0].clone();
    let (columns, defects) = dataset.scan(&[name.to_owned()], |rows| take(&rows)).unwrap();
    assert!(defects.is_empty(), "{defects:?}");
    columns.into_iter().flatten().collect()
}

#[test]
fn interventions_are_a_column_from_a_topic() {
    let dir = tempfile::tempdir().unwrap();
    let mut log = LogWriter::new(dir.path());
    for i in 0..20 {
        log.write("/state", i * 100, format!("{{\"x\": {i}}}").as_bytes());
        // Said only when it changes, as a foot pedal does.
        match i {
            0 => log.write("/pedal", 0, b"{\"data\": false}"),
            4 => log.write("/pedal", 430, b"{\"data\": true}"),
            9 => log.write("/pedal", 970, b"{\"data\": false}"),
            _ => {}
        }
    }
    let text = "version = 1\n[ticks]\nrate_hz = 10\n\
        [[stream]]\ntopic = \"/state\"\nfields = [\"x\"]\nfeature = \"observation.state\"\ntolerance_ms = 150\n\
        [[stream]]\ntopic = \"/pedal\"\nfields = [\"data\"]\nfeature = \"annotation.intervention\"\nkind = \"bool\"\nalign = \"hold\"\n";
    let (path, out) = (log.finish(), dir.path().join("out"));
    let outcome = run_over(text, &path, &out, 2).unwrap();
    assert!(!outcome.has_loss(), "{:#?}", outcome.report);
    let state = scalars(&out, "observation.state");
    let expected: Vec<f64> = state.iter().map(|x| f64::from(u8::from((5.0..10.0).contains(x)))).collect();
    assert_eq!(state.len(), 20);
    assert_eq!(scalars(&out, "annotation.intervention"), expected);
}
