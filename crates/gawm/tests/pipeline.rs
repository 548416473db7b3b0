//! A pipeline through the real program: logs of the simulator to a checked dataset, and what a second run does.

#![expect(clippy::unwrap_used, reason = "a test that cannot read what it made has failed")]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap().parent().unwrap().to_owned()
}

fn gawm(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_gawm")).args(arguments).output().unwrap()
}

fn check_run(pipeline: &Path, out: &Path, more: &[&str]) -> String {
    let mut arguments = vec!["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()];
    arguments.extend(more);
    let output = gawm(&arguments);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(0), "{stderr}");
    stderr
}

fn write_pipeline(folder: &Path) -> PathBuf {
    let contract = std::fs::read_to_string(root().join("pipelines/tworoom-ingest.toml")).unwrap();
    let sim = "[sim]\nenv = \"two-room\"\nepisodes = 4\nseed = 5\nsize = 32\nmax_steps = 12\n";
    let path = folder.join("p.toml");
    std::fs::write(&path, format!("{sim}\n{contract}")).unwrap();
    path
}

#[test]
fn logs_become_a_dataset_once() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let out = folder.path().join("out");

    let first = check_run(&pipeline, &out, &[]);
    assert!(first.contains("[4/4] describe: done"), "{first}");
    let info = std::fs::read_to_string(out.join("dataset/meta/info.json")).unwrap();
    let info: serde_json::Value = serde_json::from_str(&info).unwrap();
    assert_eq!(info["total_episodes"], 4);
    let validation = std::fs::read_to_string(out.join("validation.json")).unwrap();
    assert!(serde_json::from_str::<serde_json::Value>(&validation).is_ok(), "{validation}");

    let second = check_run(&pipeline, &out, &[]);
    assert_eq!(second.matches("up to date").count(), 4, "{second}");

    let third = check_run(&pipeline, &out, &["--set", "ingest.robot_type=other"]);
    assert_eq!(third.matches("up to date").count(), 1, "{third}");

    std::fs::remove_file(out.join("dataset.html")).unwrap();
    let fourth = check_run(&pipeline, &out, &["--set", "ingest.robot_type=other"]);
    assert_eq!(fourth.matches("up to date").count(), 3, "{fourth}");
}

#[test]
fn what_is_not_ours_is_not_removed() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let out = folder.path().join("out");
    std::fs::create_dir_all(out.join("logs")).unwrap();
    std::fs::write(out.join("logs/precious"), "data").unwrap();
    let output = gawm(&["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("no step of this pipeline made it"), "{stderr}");
    assert_eq!(std::fs::read_to_string(out.join("logs/precious")).unwrap(), "data");
}

#[test]
fn a_section_is_checked_by_the_program_that_reads_it() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let out = folder.path().join("out");
    // Before any step runs: what a later step would refuse costs no training.
    for (wrong, section) in [
        ("sim.sede=1", "[sim]"),
        ("ingest.stream.0.topics=x", "[ingest]"),
        ("loader.bach=1", "[loader]"),
        ("train.stpes=1", "train]"),
        ("model.preset=huge", "train]"),
        ("eval.plan.smaples=3", "[eval]"),
    ] {
        let output =
            gawm(&["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap(), "--set", wrong]);
        let stderr = String::from_utf8(output.stderr).unwrap();
        assert_eq!(output.status.code(), Some(2), "{wrong}: {stderr}");
        let key = wrong.split('=').next().unwrap().rsplit('.').next().unwrap();
        assert!(stderr.contains(section), "{wrong}: {stderr}");
        assert!(stderr.contains(key) || wrong.contains("huge"), "{wrong}: {stderr}");
        assert!(!out.exists(), "{wrong}");
    }
}

#[test]
fn a_folder_in_which_something_works_is_not_touched() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let out = folder.path().join("out");
    std::fs::create_dir_all(&out).unwrap();
    let lock = std::fs::File::create(out.join("pipeline.lock")).unwrap();
    rustix::fs::flock(&lock, rustix::fs::FlockOperation::LockExclusive).unwrap();
    let output = gawm(&["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    let stderr = String::from_utf8(output.stderr).unwrap();
    assert_eq!(output.status.code(), Some(1), "{stderr}");
    assert!(stderr.contains("still works in this folder"), "{stderr}");
    drop(lock);
    check_run(&pipeline, &out, &["--until", "collect"]);
}

#[test]
fn what_a_contract_names_lies_beside_the_pipeline() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let labels = folder.path().join("labels.csv");
    std::fs::write(&labels, "log,operator\n").unwrap();
    let out = folder.path().join("out");
    let named = ["--set", "ingest.labels.side_file=labels.csv", "--until", "ingest"];
    check_run(&pipeline, &out, &named);
    let text = std::fs::read_to_string(out.join("pipeline.toml")).unwrap();
    assert!(text.contains(labels.to_str().unwrap()), "{text}");
    let again = check_run(&pipeline, &out, &named);
    assert_eq!(again.matches("up to date").count(), 2, "{again}");
    std::fs::write(&labels, "log,operator\ntwo-room-000000.mcap,ada\n").unwrap();
    let changed = check_run(&pipeline, &out, &named);
    assert_eq!(changed.matches("up to date").count(), 1, "{changed}");
}

#[test]
fn a_step_that_fails_ends_the_pipeline_and_can_be_repeated() {
    let folder = tempfile::tempdir().unwrap();
    let pipeline = write_pipeline(folder.path());
    let out = folder.path().join("out");
    let arguments = ["run", pipeline.to_str().unwrap(), "--out", out.to_str().unwrap()];
    let broken = gawm(&[&arguments[..], &["--set", "ingest.ticks.stream=nowhere"]].concat());
    let stderr = String::from_utf8(broken.stderr).unwrap();
    assert_eq!(broken.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("step ingest"), "{stderr}");
    let repaired = check_run(&pipeline, &out, &[]);
    assert!(repaired.contains("collect: a simulator's episodes to logs: up to date"), "{repaired}");
}

#[test]
fn a_verb_is_the_program_of_that_name() {
    for verb in ["ingest", "data", "sim"] {
        let output = gawm(&[verb, "--help"]);
        let stdout = String::from_utf8(output.stdout).unwrap();
        assert_eq!(output.status.code(), Some(0), "{stdout}");
        assert!(stdout.contains("Usage: gawm"), "{verb}: {stdout}");
    }
}
