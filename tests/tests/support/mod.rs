//! What the end-to-end tests share: the program, its outputs, the corpora.
#![allow(dead_code, unreachable_pub, reason = "each test program uses a part")]

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use arrow::array::{Array, AsArray, RecordBatch};
use arrow::datatypes::{Float64Type, Int64Type};
use gawm_ingest::tabular::{Limits, Values, open};
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use serde_json::Value;

/// Root of the workspace.
pub fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

/// The fixture that the README begins with.
pub fn demo_log() -> PathBuf {
    root().join("fixtures/mcap-explorer-demo/demo.mcap")
}

/// Its contract.
pub fn demo_contract() -> PathBuf {
    root().join("pipelines/demo.toml")
}

/// The folder of the corpora, if the environment names one.
pub fn shared() -> Option<PathBuf> {
    let Some(path) = std::env::var_os("GAWM_SHARED") else {
        println!("skipped: GAWM_SHARED is not set");
        return None;
    };
    let path = PathBuf::from(path);
    let path = if path.is_absolute() { path } else { root().join(path) };
    assert!(path.is_dir(), "GAWM_SHARED is set to {path:?}, which is no folder");
    Some(path.join("corpora"))
}

/// The program: a `main` of this package over the same `cli` module, so that cargo has built it with the tests.
pub fn program() -> &'static Path {
    Path::new(env!("CARGO_BIN_EXE_e2e-gawm-ingest"))
}

/// Runs the program.
pub fn ingest(args: &[&str]) -> Output {
    Command::new(program()).args(args).current_dir(root()).env("NO_COLOR", "1").output().unwrap()
}

pub fn code(output: &Output) -> i32 {
    output.status.code().unwrap_or(-1)
}

pub fn stderr(output: &Output) -> String {
    String::from_utf8_lossy(&output.stderr).into_owned()
}

pub fn stdout(output: &Output) -> String {
    String::from_utf8_lossy(&output.stdout).into_owned()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// Runs a contract over logs and expects an exit code; returns the report.
pub fn run(contract: &Path, out: &Path, logs: &[&Path], more: &[&str], expected: i32) -> Value {
    let report = out.with_extension("report.json");
    let mut args = vec!["run", "--config", text(contract), "--out", text(out), "--report", text(&report)];
    args.extend(more);
    args.extend(logs.iter().map(|log| text(log)));
    let output = ingest(&args);
    assert_eq!(code(&output), expected, "{args:?}\n{}\n{}", stdout(&output), stderr(&output));
    let report =
        std::fs::read_to_string(&report).map_or(Value::Null, |text| serde_json::from_str(&text).unwrap());
    check_report(&report);
    report
}

/// For every topic, what was read was kept or lost.
pub fn check_report(report: &Value) {
    for file in report["files"].as_array().into_iter().flatten() {
        for topic in file["topics"].as_array().unwrap() {
            let lost: u64 =
                topic["lost"].as_array().unwrap().iter().map(|lost| lost["count"].as_u64().unwrap()).sum();
            assert_eq!(topic["read"].as_u64().unwrap(), topic["kept"].as_u64().unwrap() + lost, "{topic}");
        }
    }
}

/// Messages of a topic lost for a reason.
pub fn lost(report: &Value, topic: &str, reason: &str) -> u64 {
    let files = report["files"].as_array().unwrap().iter();
    let topics =
        files.flat_map(|file| file["topics"].as_array().unwrap()).filter(|found| found["topic"] == topic);
    topics
        .flat_map(|topic| topic["lost"].as_array().unwrap())
        .filter(|lost| lost["reason"] == reason)
        .map(|lost| lost["count"].as_u64().unwrap())
        .sum()
}

/// Suggests a contract for logs into a file.
pub fn suggest(logs: &[&Path], to: &Path) {
    let mut args = vec!["suggest"];
    args.extend(logs.iter().map(|log| text(log)));
    let output = ingest(&args);
    assert_eq!(code(&output), 0, "{args:?}\n{}", stderr(&output));
    std::fs::write(to, output.stdout).unwrap();
}

/// The files of a folder by relative path.
pub fn files(dir: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![dir.to_owned()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).unwrap() {
            let path = entry.unwrap().path();
            if path.is_dir() {
                folders.push(path);
            } else {
                found.insert(path.strip_prefix(dir).unwrap().to_owned(), std::fs::read(&path).unwrap());
            }
        }
    }
    found
}

/// Two datasets hold the same files with the same bytes.
pub fn check_same(a: &Path, b: &Path) {
    let (a, b) = (files(a), files(b));
    assert_eq!(a.keys().collect::<Vec<_>>(), b.keys().collect::<Vec<_>>());
    for (path, bytes) in &a {
        assert!(*bytes == b[path], "{path:?} differs");
    }
}

/// The rows of a dataset.
pub struct Dataset {
    pub dir: PathBuf,
    pub batches: Vec<RecordBatch>,
    pub meta: Value,
}

impl Dataset {
    pub fn open(dir: &Path) -> Dataset {
        let mut paths: Vec<PathBuf> =
            files(dir).into_keys().filter(|path| path.starts_with("data")).collect();
        paths.sort();
        let mut batches = Vec::new();
        for path in paths {
            let file = std::fs::File::open(dir.join(path)).unwrap();
            let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap();
            batches.extend(reader.map(Result::unwrap));
        }
        let meta = std::fs::read_to_string(dir.join("meta/gawm.json")).unwrap();
        Dataset { dir: dir.to_owned(), batches, meta: serde_json::from_str(&meta).unwrap() }
    }

    pub fn integers(&self, column: &str) -> Vec<i64> {
        let values = |batch: &RecordBatch| batch[column].as_primitive::<Int64Type>().values().to_vec();
        self.batches.iter().flat_map(values).collect()
    }

    pub fn bools(&self, column: &str) -> Vec<bool> {
        let values =
            |batch: &RecordBatch| batch[column].as_boolean().iter().map(Option::unwrap).collect::<Vec<_>>();
        self.batches.iter().flat_map(values).collect()
    }

    /// Values of one dim of a vector feature.
    pub fn values(&self, feature: &str, dim: &str) -> Vec<f64> {
        let names = self.names(feature);
        let at = names
            .iter()
            .position(|name| name == dim)
            // A joint picked by name from a list of structs is named after the list too: `joint_1.joints`.
            .or_else(|| names.iter().position(|name| name.split('.').next() == Some(dim)))
            .unwrap_or_else(|| panic!("{dim:?} is not in {names:?}"));
        let mut out = Vec::new();
        for batch in &self.batches {
            let column = &batch[feature];
            for row in 0..batch.num_rows() {
                let items = match column.as_list_opt::<i32>() {
                    Some(list) => list.value(row),
                    None => match column.as_fixed_size_list_opt() {
                        Some(list) => list.value(row),
                        None => column.slice(row, 1),
                    },
                };
                out.push(items.as_primitive::<Float64Type>().value(at));
            }
        }
        out
    }

    /// Names of the dims of a feature.
    pub fn names(&self, feature: &str) -> Vec<String> {
        let features = self.meta["schema"]["features"].as_array().unwrap();
        let found = features.iter().find(|found| found["name"] == feature).unwrap();
        let parts = found["data"]["parts"].as_array().unwrap();
        let dims = parts.iter().flat_map(|part| part["dims"].as_array().unwrap());
        dims.map(|dim| dim["name"].as_str().unwrap().to_owned()).collect()
    }

    /// The bytes of a camera's images.
    pub fn images(&self, feature: &str) -> Vec<Vec<u8>> {
        let mut out = Vec::new();
        for batch in &self.batches {
            let bytes = batch[feature].as_struct().column_by_name("bytes").unwrap().clone();
            let bytes = bytes.as_binary::<i32>();
            out.extend((0..batch.num_rows()).map(|row| bytes.value(row).to_vec()));
        }
        out
    }

    /// Whether each row is the last of its episode.
    pub fn is_last(&self) -> Vec<bool> {
        let episodes = self.integers("episode_index");
        (0..episodes.len()).map(|row| episodes.get(row + 1) != Some(&episodes[row])).collect()
    }

    /// The task of an episode.
    pub fn task_of(&self, episode: i64) -> String {
        let row = self.integers("episode_index").iter().position(|index| *index == episode).unwrap();
        let task = self.integers("task_index")[row];
        let file = std::fs::File::open(self.dir.join("meta/tasks.parquet")).unwrap();
        let mut reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap();
        let batch = reader.next().unwrap().unwrap();
        batch["task"].as_string::<i32>().value(usize::try_from(task).unwrap()).to_owned()
    }

    /// A column of meta/episodes as text.
    pub fn episode_column(&self, column: &str) -> Vec<String> {
        let file = std::fs::File::open(self.dir.join("meta/episodes/chunk-000/file-000.parquet")).unwrap();
        let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().build().unwrap();
        let mut out = Vec::new();
        for batch in reader.map(Result::unwrap) {
            let column = &batch[column];
            for row in 0..batch.num_rows() {
                out.push(match (column.as_string_opt::<i32>(), column.as_boolean_opt()) {
                    (Some(texts), _) => texts.value(row).to_owned(),
                    (_, Some(flags)) if flags.is_valid(row) => flags.value(row).to_string(),
                    _ => String::new(),
                });
            }
        }
        out
    }
}

/// Arrays of an .npz file as numbers.
pub struct Truth(gawm_ingest::tabular::Table);

impl Truth {
    pub fn open(path: &Path) -> Truth {
        Truth(open(path, &Limits::default()).unwrap())
    }

    pub fn times(&self, name: &str) -> Vec<i64> {
        match self.0.read_all(name).unwrap().values {
            Values::I64(values) => values,
            other => panic!("{name}: {other:?}"),
        }
    }

    /// Column `at` of an array.
    pub fn column(&self, name: &str, at: usize) -> Vec<f64> {
        let rows = self.0.read_all(name).unwrap();
        let width = rows.width();
        match rows.values {
            Values::F64(values) => values.chunks(width).map(|row| row[at]).collect(),
            other => panic!("{name}: {other:?}"),
        }
    }
}

/// The last index whose time is at or before `at_ns`.
pub fn last_at(times: &[i64], at_ns: i64) -> Option<usize> {
    times.partition_point(|&ns| ns <= at_ns).checked_sub(1)
}
