//! Parity with the published PyTorch modules, on the fixtures and on every file in `GAWM_GOLDEN_DIR`.
#![expect(clippy::unwrap_used, reason = "a test ends where its helper does")]

use std::path::{Path, PathBuf};

use gawm_model::golden::{Golden, compare};
use gawm_model::{Device, Precision};

fn check_golden(file: &Path) {
    let golden = Golden::parse(&std::fs::read_to_string(file).unwrap()).unwrap();
    let report = compare(&golden, &Device::Cpu, Precision::F32).unwrap();
    let failures: Vec<String> = report.failures().map(ToString::to_string).collect();
    assert!(failures.is_empty(), "{}:\n{}", file.display(), failures.join("\n"));
    assert!(report.lines().len() > 300, "{}: only {} tensors", file.display(), report.lines().len());
}

fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/golden").join(name)
}

#[test]
fn small() {
    check_golden(&fixture("small.json"));
}

#[test]
fn pusht_56() {
    check_golden(&fixture("pusht_56.json"));
}

#[test]
fn tworoom_patch8() {
    check_golden(&fixture("tworoom_patch8.json"));
}

#[test]
fn interpolated() {
    check_golden(&fixture("interpolated.json"));
}

#[test]
fn folder_of_the_environment() {
    let Some(folder) = std::env::var_os("GAWM_GOLDEN_DIR") else {
        println!("skipped: GAWM_GOLDEN_DIR is not set");
        return;
    };
    let entries = Path::new(&folder).read_dir().unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<PathBuf> =
        entries.filter(|path| path.extension().is_some_and(|e| e == "json")).collect();
    files.sort();
    assert!(!files.is_empty(), "GAWM_GOLDEN_DIR holds no *.json");
    files.iter().for_each(|file| check_golden(file));
}
