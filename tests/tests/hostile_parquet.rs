//! LeRobot folders whose Parquet files declare what they do not hold: an answer in bounded memory from `gawm-ingest`, too.
//!
//! The files are those of `crates/gawm-dataset/tests/hostile_parquet`.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use support::{program, root, stderr, stdout, text};

/// Address space of the program in KiB: several times what it takes for the sound folder.
const LIMIT_KIB: u32 = 1_500_000;

fn fixtures() -> PathBuf {
    root().join("crates/gawm-dataset/tests/hostile_parquet")
}

fn copy(from: &Path, to: &Path) {
    fs::create_dir_all(to).unwrap();
    for entry in fs::read_dir(from).unwrap() {
        let path = entry.unwrap().path();
        let target = to.join(path.file_name().unwrap());
        if path.is_dir() {
            copy(&path, &target);
        } else {
            fs::copy(path, target).unwrap();
        }
    }
}

/// Runs the program with little memory where the system can limit it.
fn ingest(arguments: &[&str]) -> Output {
    let limit = if cfg!(target_os = "linux") { format!("ulimit -v {LIMIT_KIB}; ") } else { String::new() };
    let mut command = Command::new("sh");
    command.args(["-c", &format!("{limit}exec \"$0\" \"$@\""), text(program())]);
    command.args(arguments).output().unwrap()
}

/// Ingests the sound folder with one data file replaced; returns the exit code and what was said.
fn ingested(file: &Path, contract: &Path, folder: &Path) -> (Option<i32>, String) {
    let (input, out) = (folder.join("in"), folder.join("out"));
    copy(&fixtures().join("sound"), &input);
    fs::copy(file, input.join("data/chunk-000/file-000.parquet")).unwrap();
    let arguments = ["run", "--config", text(contract), "--out", text(&out), "--jobs", "2", text(&input)];
    let output = ingest(&arguments);
    (output.status.code(), format!("{}{}", stdout(&output), stderr(&output)))
}

#[test]
fn lies_are_answered_with_bounded_memory() {
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("contract.toml");
    let suggested = ingest(&["suggest", text(&fixtures().join("sound"))]);
    fs::write(&contract, stdout(&suggested)).unwrap();
    let entries = fs::read_dir(fixtures()).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        entries.filter(|path| path.to_str().is_some_and(|path| path.ends_with(".data.parquet"))).collect();
    files.sort();
    assert!(files.len() > 40);
    for file in &files {
        let name = file.file_name().unwrap().to_str().unwrap();
        let (code, said) = ingested(file, &contract, &folder.path().join(name));
        assert!(matches!(code, Some(0..=3)), "{name}: {code:?}: {said}");
        assert!(!said.contains("panicked"), "{name}: {said}");
        let is_sound = name == "unchanged.data.parquet";
        assert!(!is_sound || code == Some(0), "{name}: {code:?}: {said}");
        if name == "vector_page_declares_2gb.data.parquet" {
            assert!(said.contains("a page that declares 2147483647 bytes"), "{said}");
        }
    }
}
