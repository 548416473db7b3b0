//! A contract over tables: source is a column instead of a topic.

use std::sync::atomic::AtomicBool;

use super::*;
use crate::contract;
use crate::run::{FileStatus, Report, RunError, RunOptions, RunOutcome, run};

/// Streams `state` and `action` of two columns.
fn contract_of(ticks: &str, state: &str, action: &str) -> contract::CheckedContract {
    let text = format!(
        "version = 1\n[ticks]\n{ticks}\n\
         [[stream]]\ntopic = \"{state}\"\nfields = [\"data[0:2]\"]\ntolerance_ms = 250\nfeature = \"observation.state\"\n\
         [[stream]]\ntopic = \"{action}\"\nfields = [\"data[0:2]\"]\ntolerance_ms = 250\nfeature = \"action\"\naction = {{ timing = \"in-force\" }}\n"
    );
    contract::check(&contract::parse(&text, "test.toml", &[]).unwrap(), "test.toml").unwrap()
}

fn run_over(
    contract: &contract::CheckedContract,
    out: &Path,
    file: &Path,
    jobs: usize,
) -> Result<RunOutcome, RunError> {
    let options = RunOptions {
        contract,
        contract_folder: Path::new(""),
        out,
        logs: &[file.to_owned()],
        mode: gawm_dataset::WriteMode::New,
        jobs,
        shard: None,
        interrupt: &AtomicBool::new(false),
        progress: &|_, _, _| {},
    };
    run(&options, &mut Report::default())
}

#[test]
fn a_killed_recording_gives_its_finished_episodes() {
    let dir = tempfile::tempdir().unwrap();
    let contract = contract_of("mode = \"native\"\nfps = 10", "proprio", "action");
    let outcome = run_over(&contract, &dir.path().join("a"), &fixture("killed.h5"), 1).unwrap();
    assert_eq!((outcome.report.episodes, outcome.report.frames), (2, 21), "{:#?}", outcome.report);
    assert_eq!(outcome.report.files[0].status, FileStatus::Ok);
    let text = format!("{:?}", outcome.report.warnings);
    assert!(text.contains("the writer did not close the file"), "{text}");
    let again = run_over(&contract, &dir.path().join("b"), &fixture("killed.h5"), 4).unwrap();
    assert_eq!(outcome.report.frames, again.report.frames);
    let data =
        |name: &str| std::fs::read(dir.path().join(name).join("data/chunk-000/file-000.parquet")).unwrap();
    assert_eq!(data("a"), data("b"));
}

#[test]
fn an_npz_file_is_one_episode() {
    let dir = tempfile::tempdir().unwrap();
    let contract = contract_of("mode = \"native\"\nfps = 20", "observations", "actions");
    let outcome = run_over(&contract, &dir.path().join("a"), &fixture("stored.npz"), 2).unwrap();
    assert_eq!((outcome.report.episodes, outcome.report.frames), (1, 300), "{:#?}", outcome.report);
}

#[test]
fn a_table_without_a_rate_or_a_column_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    let check = |contract: &contract::CheckedContract, expected: &str| {
        let error = run_over(contract, &dir.path().join("a"), &fixture("stored.npz"), 1).unwrap_err();
        assert!(error.to_string().contains(expected), "{error}");
    };
    check(&contract_of("mode = \"native\"", "observations", "actions"), "ticks.fps");
    check(&contract_of("mode = \"native\"\nfps = 10", "observation", "actions"), "observation");
}

#[test]
fn a_column_that_cannot_be_used_is_refused_with_the_reason() {
    let dir = tempfile::tempdir().unwrap();
    let check = |column: &str, expected: &str| {
        let contract = contract_of("mode = \"native\"\nfps = 10", column, "action");
        let error = run_over(&contract, &dir.path().join("a"), &fixture("foreign.h5"), 1).unwrap_err();
        assert!(error.to_string().contains(expected), "{column}: {error}");
    };
    check("zstd", "needs HDF5 filter 32015");
    check("virtual", "virtual");
    check("compound", "records");
    check("link_out", "link");
    check("link_to_nothing", "leads nowhere");
    check("nothing", "no topic \"nothing\"");
}

#[test]
fn published_recordings_keep_all_their_rows() {
    let Some(path) = corpus("swm_h5/tworoom.h5") else { return };
    let dir = tempfile::tempdir().unwrap();
    let contract = contract_of("mode = \"native\"\nfps = 10", "proprio", "action");
    let outcome = run_over(&contract, &dir.path().join("a"), &path, 2).unwrap();
    assert_eq!((outcome.report.episodes, outcome.report.frames), (4, 155), "{:#?}", outcome.report);
    assert_eq!(outcome.report.files[0].status, FileStatus::Ok);
}
