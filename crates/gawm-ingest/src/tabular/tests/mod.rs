mod corpora;
mod damage;
mod fixtures;
mod recording;
mod run;
mod samples;

use std::path::{Path, PathBuf};

use super::*;

/// A committed fixture.
fn fixture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/hdf5").join(name)
}

/// A file of the shared corpora; `None`, said aloud, when the folder is not there to be used.
fn corpus(name: &str) -> Option<PathBuf> {
    let Some(shared) = std::env::var_os("GAWM_SHARED") else {
        eprintln!("skipped: GAWM_SHARED is not set");
        return None;
    };
    let path = Path::new(&shared).join("corpora").join(name);
    assert!(path.exists(), "GAWM_SHARED is set, but {path:?} is missing");
    Some(path)
}

fn open_fixture(name: &str) -> Table {
    open(&fixture(name), &Limits::default()).unwrap()
}

fn kinds(findings: &[Finding]) -> Vec<(FindingKind, &str)> {
    findings.iter().map(|f| (f.kind, f.place.as_str())).collect()
}

/// `values()` of the fixtures' script: row r, column c of 3.
fn expected(rows: std::ops::Range<usize>) -> Vec<f64> {
    rows.flat_map(|r| (0..3).map(move |c| ((r % 16) * 7 + c * 3 + r / 50) as f64)).collect()
}
