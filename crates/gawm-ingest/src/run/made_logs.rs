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

#[test]
fn truth_values_other_than_0_and_1_are_not_valid_and_do_not_end_the_run() {
    let dir = tempfile::tempdir().unwrap();
    let mut log = LogWriter::new(dir.path());
    for (i, text) in ["true", "1", "2", "0.5", "0", "false"].iter().enumerate() {
        log.write("/b", i as u64 * 100, format!("{{\"b\": {text}}}").as_bytes());
    }
    let stream = |feature: &str, more: &str| {
        format!(
            "[[stream]]\nname = \"{feature}\"\ntopic = \"/b\"\nfields = [\"b\"]\nfeature = \"{feature}\"\n\
            tolerance_ms = 150\nkind = \"bool\"\n{more}\n"
        )
    };
    let text =
        format!("[ticks]\nrate_hz = 10\n{}{}", stream("observation.state", ""), stream("annotation.b", ""));
    let (path, out) = (log.finish(), dir.path().join("out"));
    let outcome = run_over(&text, &path, &out, 2).unwrap();
    for column in ["observation.state", "annotation.b"] {
        let values = scalars(&out, column);
        assert!(values[2].is_nan() && values[3].is_nan(), "{values:?}");
        assert_eq!((values[0], values[1], values[4], values[5]), (1.0, 1.0, 0.0, 0.0));
        assert_eq!(scalars(&out, &format!("gawm.valid.{column}")), [1.0, 1.0, 0.0, 0.0, 1.0, 1.0]);
    }
    let said = outcome.report.warnings.join("\n");
    assert!(said.contains("2 samples hold truth values other than 0 and 1"), "{said}");
}

/// Two stretches of `recording`, said in each message, tasks and outcomes beside them.
fn two_stretches(folder: &Path) -> PathBuf {
    let mut log = LogWriter::new(folder);
    for i in 0..60_u64 {
        let is_on = (10..30).contains(&i) || i >= 40;
        log.write("/state", i * 100, format!("{{\"x\": {i}, \"recording\": {is_on}}}").as_bytes());
        match i {
            15 => log.write("/note", i * 100, b"{\"task\": \"push\", \"outcome\": \"maybe\"}"),
            45 => log.write("/note", i * 100, b"{\"task\": \"pull\", \"outcome\": \"yes\"}"),
            _ => {}
        }
    }
    log.finish()
}

/// Returns the episodes (rows), and the warnings or the error, of a contract over [`two_stretches`].
fn stretches(more: &str) -> (Vec<u64>, String) {
    let dir = tempfile::tempdir().unwrap();
    let text = format!(
        "[ticks]\nrate_hz = 10\n[[stream]]\ntopic = \"/state\"\nfields = [\"x\"]\nfeature = \"observation.state\"\n\
        tolerance_ms = 150\n{more}"
    );
    let (path, out) = (two_stretches(dir.path()), dir.path().join("out"));
    match run_over(&text, &path, &out, 2) {
        Ok(outcome) => {
            let dataset = Dataset::open(&out, ReadLimits::default()).unwrap();
            let lengths = dataset.episodes.iter().filter_map(|episode| episode.length).collect();
            (lengths, outcome.report.warnings.join("\n"))
        }
        Err(error) => (Vec::new(), error.to_string()),
    }
}

const MARKED: &str = "[episodes]\nfrom = \"marker\"\ntopic = \"/state\"\nfield = \"recording\"\n";

#[test]
fn a_truth_value_in_every_message_is_a_state_and_no_row_of_marks() {
    let (lengths, said) = stretches(&format!("{MARKED}[labels]\ntask = \"t\"\n"));
    assert_eq!(lengths, [21, 20]);
    assert!(
        said.ends_with("1 episodes have no end mark; closed at the next start or at the end of the log"),
        "{said}"
    );
}

#[test]
fn labels_that_are_not_there_are_named() {
    let check = |labels: &str, expected: &str| {
        let (lengths, said) = stretches(&format!("{MARKED}[labels]\n{labels}\n"));
        assert_eq!(lengths, [21, 20]);
        assert!(said.contains(expected), "{expected}: {said}");
    };
    check("task = { topic = \"/note\", field = \"task\" }\nsuccess = true", "");
    check("task = { topic = \"/none\", field = \"task\" }", "labels.task: no message of /none by the end");
    check("task = { topic = \"/note\", field = \"goal\" }", "messages of /note, none with \"goal\"");
    check(
        "success = { topic = \"/note\", field = \"outcome\" }",
        "\"maybe\" is not known to be true or false",
    );
    check(
        "robot = { metadata = \"about\", key = \"robot\" }",
        "no metadata record \"about\", there are {} (2 episodes)",
    );
    check("path_pattern = \"(?P<robot>r2d[0-9])\"", "labels.path_pattern does not match the path");
}

#[test]
fn episodes_that_never_begin_say_why() {
    let check = |from: &str, more: &str, expected: &str| {
        let (lengths, said) = stretches(&format!("[episodes]\nfrom = \"{from}\"\n{more}\n"));
        assert!(lengths.is_empty() && said.contains(expected), "{expected}: {said}");
    };
    check("marker", "topic = \"/none\"\nfield = \"x\"", "no message of /none that can be read");
    check("marker", "topic = \"/state\"\nfield = \"on\"", "no \"on\", they have [\"x\", \"recording\"]");
    check(
        "marker",
        "topic = \"/note\"\nfield = \"task\"\nstart = \"go\"",
        "has \"go\" in \"task\", they have \"pull\", \"push\"",
    );
    check(
        "metadata",
        "record = \"e\"\nstart_key = \"a\"\nend_key = \"b\"",
        "no metadata record \"e\", there are {}",
    );
}

#[test]
fn labels_that_no_log_can_have_are_errors_of_the_contract() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("side.csv"), "log,task\na,x\na,y\n").unwrap();
    let check = |labels: &str, expected: &str| {
        let text = format!(
            "[ticks]\nrate_hz = 10\n[[stream]]\ntopic = \"/x\"\nfields = [\"x\"]\nfeature = \"observation.state\"\ntolerance_ms = 9\n[labels]\n{labels}\n"
        );
        let contract =
            contract::check(&contract::parse(&text, "test.toml", &[]).unwrap(), "test.toml").unwrap();
        let error = crate::episodes::Labels::new(&contract.written.labels, dir.path()).unwrap_err();
        assert!(error.to_string().contains(expected), "{expected}: {error}");
    };
    check(
        "task = { capture = \"robot\" }",
        "labels.task: labels.path_pattern has no group \"robot\", it has []",
    );
    check("task = { column = \"task\" }", "labels.task: expected labels.side_file");
    check(
        "side_file = \"side.csv\"\nside_key = \"name\"",
        "labels.side_key: the side file has no column \"name\"",
    );
    check("side_file = \"side.csv\"\nside_key = \"log\"", "expected one row of a log, got two of \"a\"");
}

/// Frames of PNG whose headers are whole and whose pixels are not, before some that are whole.
#[test]
fn pictures_that_turn_out_to_be_damaged_cost_their_rows_and_not_the_run() {
    use base64::Engine as _;
    let pixels = gawm_image::Pixels::Rgb8((0..32 * 24 * 3).map(|i| (i * 7 % 251) as u8).collect());
    let image = gawm_image::Image::try_new(32, 24, pixels).unwrap();
    let whole = gawm_image::encode_png(&image).unwrap();
    // The checksum is right, the stream below it is not: only decoding tells.
    let mut damaged = whole.clone();
    let at = whole.windows(4).position(|name| name == b"IDAT").unwrap();
    let length = u32::from_be_bytes(whole[at - 4..at].try_into().unwrap()) as usize;
    damaged[at + 10..at + 4 + length].fill(0xff);
    let crc = crc32fast::hash(&damaged[at..at + 4 + length]);
    damaged[at + 4 + length..at + 8 + length].copy_from_slice(&crc.to_be_bytes());
    for n_damaged in [3, 8] {
        let dir = tempfile::tempdir().unwrap();
        let mut log = LogWriter::new(dir.path());
        for i in 0..8 {
            let data = if i < n_damaged { &damaged } else { &whole };
            let data = base64::engine::general_purpose::STANDARD.encode(data);
            log.write("/cam", i * 100, format!("{{\"format\": \"png\", \"data\": \"{data}\"}}").as_bytes());
        }
        let text = "[ticks]\nrate_hz = 10\n[[stream]]\ntopic = \"/cam\"\nfeature = \"observation.images.cam\"\n\
            tolerance_ms = 150\nimage = { resize = [16, 12] }\n";
        let (path, out) = (log.finish(), dir.path().join("out"));
        let outcome = run_over(text, &path, &out, 2).unwrap();
        assert_eq!((outcome.report.frames, outcome.has_loss()), (8, true));
        let expected: Vec<f64> = (0..8).map(|i| f64::from(u8::from(i >= n_damaged))).collect();
        assert_eq!(scalars(&out, "gawm.valid.observation.images.cam"), expected);
    }
}

#[test]
fn a_crop_that_does_not_fit_is_an_error_that_says_how_large_the_images_are() {
    let dir = tempfile::tempdir().unwrap();
    let mut log = LogWriter::new(dir.path());
    for i in 0..4_u64 {
        let message = r#"{"width":2,"height":1,"encoding":"rgb8","step":6,"data":[1,2,3,4,5,6]}"#;
        log.write("/cam", i * 100, message.as_bytes());
    }
    let text = "[ticks]\nrate_hz = 10\n[[stream]]\ntopic = \"/cam\"\nfeature = \"observation.images.cam\"\n\
        tolerance_ms = 150\nimage = { crop = [1, 0, 2, 1] }\n";
    let error = run_over(text, &log.finish(), &dir.path().join("out"), 2).unwrap_err();
    let said = "expected one within the images of /cam, 2x1, got [1, 0, 2, 1]";
    assert!(error.to_string().contains(said) && error.exit_code() == 2, "{error}");
}
