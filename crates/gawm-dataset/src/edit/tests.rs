use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use arrow::array::{AsArray, RecordBatch};
use arrow::compute::concat_batches;
use arrow::datatypes::Int64Type;
use tempfile::TempDir;

use super::*;
use crate::read::{Dataset, FrameBytes, ReadLimits};
use crate::spec::WriteMode;
use crate::stats::dataset_stats;
use crate::validate::{Severity, ValidateOptions, validate};
use crate::writer::tests::{tree, write_all};

/// Two recordings of three episodes each.
pub(super) fn dataset() -> (TempDir, PathBuf) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("in");
    write_all(&dir, WriteMode::New, &[0, 1], 500);
    (folder, dir)
}

/// The same rows as a LeRobot folder that knows nothing of gawm.
pub(super) fn lerobot() -> (TempDir, PathBuf) {
    let (folder, dir) = dataset();
    fs::remove_file(dir.join("meta/gawm.json")).unwrap();
    (folder, dir)
}

pub(super) fn open(dir: &Path) -> Input {
    Input::open(dir, InputOptions::default()).unwrap()
}

pub(super) fn run(inputs: &[Input], plan: &Plan, out: &Path) -> EditSummary {
    write(inputs, plan, out, &|_| {}).unwrap()
}

/// Returns the rows of an episode, all columns.
pub(super) fn rows(dir: &Path, episode: usize) -> RecordBatch {
    let input = open(dir);
    let mut batches = Vec::new();
    piece_rows::for_each_batch(&input, &input.pieces(0)[episode], |batch| {
        batches.push(batch);
        Ok(())
    })
    .unwrap();
    concat_batches(&batches[0].schema(), &batches).unwrap()
}

/// Returns the frames of an episode, found by the offset index of their column.
pub(super) fn frames(dir: &Path, episode: usize) -> Vec<FrameBytes> {
    let input = open(dir);
    let camera = input.dataset.image_columns().remove(0);
    let rows: Vec<usize> = (0..input.dataset.runs[episode].n_rows as usize).collect();
    input.dataset.read_frames(episode, &camera, &rows).unwrap()
}

/// Checks that columns are those of rows of another dataset, but for those in `but` and the numbers of LeRobot.
#[track_caller]
pub(super) fn check_rows(got: &RecordBatch, expected: &RecordBatch, but: &[&str]) {
    let numbers = ["timestamp", "frame_index", "episode_index", "index", "task_index"];
    assert_eq!(got.num_rows(), expected.num_rows());
    let names = |batch: &RecordBatch| -> Vec<String> {
        batch.schema().fields().iter().map(|f| f.name().clone()).collect()
    };
    assert_eq!(names(got), names(expected));
    for name in names(got).iter().filter(|n| !numbers.contains(&n.as_str()) && !but.contains(&n.as_str())) {
        assert!(got.column_by_name(name) == expected.column_by_name(name), "{name} differs");
    }
}

/// Checks numbers, counts and tables with the validator itself: nothing of level error, nothing about structure.
#[track_caller]
pub(super) fn check_valid(dir: &Path, n_episodes: usize) {
    let dataset = Dataset::open(dir, ReadLimits::default()).unwrap();
    assert_eq!(dataset.runs.len(), n_episodes);
    let report = validate(&dataset, &ValidateOptions::default()).unwrap();
    let bad: Vec<_> = report
        .findings
        .iter()
        .filter(|f| {
            f.severity == Severity::Error || (f.code.starts_with("STRUCT") && f.severity > Severity::Info)
        })
        .collect();
    assert!(bad.is_empty(), "{bad:#?}");
}

#[test]
fn parts_that_come_together_are_the_whole() {
    for make in [dataset, lerobot] {
        let (folder, dir) = make();
        let parts: Vec<SplitPart> =
            ["a=0:3", "b=3:5", "c=5"].iter().map(|text| parse_part(text).unwrap()).collect();
        let input = [open(&dir)];
        let mut dirs = Vec::new();
        for (name, plan) in split(&input[0], SplitBy::Episode, &parts, 0).unwrap() {
            let out = folder.path().join(&name);
            assert_eq!(run(&input, &plan, &out).episodes as usize, plan.pieces.len());
            check_valid(&out, plan.pieces.len());
            dirs.push(out);
        }
        let inputs: Vec<Input> = dirs.iter().map(|dir| open(dir)).collect();
        let whole = folder.path().join("whole");
        run(&inputs, &merge(&inputs), &whole);
        check_valid(&whole, 6);
        let stats = |dir: &Path| dataset_stats(&Dataset::open(dir, ReadLimits::default()).unwrap()).unwrap();
        assert_eq!(stats(&whole).columns, stats(&dir).columns);
        (0..6).for_each(|episode| check_rows(&rows(&whole, episode), &rows(&dir, episode), &[]));
        let (got, expected) = (tree(&whole), tree(&dir));
        if input[0].gawm.is_some() {
            // But for the name of the program and the edits, it is the same dataset to the bit.
            let changed: Vec<&String> =
                got.iter().filter(|(n, b)| expected.get(*n) != Some(b)).map(|(n, _)| n).collect();
            assert_eq!(changed, ["meta/gawm-edits.json", "meta/gawm.json"]);
            let meta = |files: &BTreeMap<String, Vec<u8>>| -> serde_json::Value {
                let mut value: serde_json::Value = serde_json::from_slice(&files["meta/gawm.json"]).unwrap();
                value["software"] = "".into();
                value
            };
            assert_eq!(meta(&got), meta(&expected));
        }
        let edits: Vec<EditRecord> = serde_json::from_slice(&got["meta/gawm-edits.json"]).unwrap();
        assert_eq!(
            edits.iter().map(|e| e.verb.as_str()).collect::<Vec<_>>(),
            ["split", "split", "split", "merge"]
        );
        assert_eq!((edits[0].inputs[0].taken.as_str(), edits[3].inputs.len()), ("0..3", 3));
    }
}

fn check_filter(condition: &str, expected: &[usize]) {
    for make in [dataset, lerobot] {
        let (folder, dir) = make();
        let inputs = [open(&dir)];
        let plan = filter(&inputs[0], condition).unwrap();
        let episodes: Vec<usize> = plan.pieces.iter().map(|piece| piece.run).collect();
        assert_eq!(episodes, expected, "{condition}");
        let out = folder.path().join("out");
        run(&inputs, &plan, &out);
        check_valid(&out, expected.len());
        for (new, old) in expected.iter().enumerate() {
            check_rows(&rows(&out, new), &rows(&dir, *old), &[]);
        }
    }
}

#[test]
fn filters_keep_the_rows_of_what_they_take() {
    check_filter("length > 100", &[1, 4]);
    check_filter("session == 'day-1' and success", &[3]);
}

#[test]
fn conditions_see_tables_statistics_and_findings() {
    let (_folder, dir) = dataset();
    let input = open(&dir);
    let taken = |condition: &str| -> Vec<usize> {
        filter(&input, condition).unwrap().pieces.iter().map(|piece| piece.run).collect()
    };
    assert_eq!(taken("success == null"), [2, 5]);
    assert_eq!(taken("not success"), [1, 4]);
    assert_eq!(taken("task ~ 'DRAWER'"), [1, 4]);
    assert_eq!(taken("mean(observation.state.gripper) > 0.039 and max(action) <= 1.1"), [0, 1, 2, 3, 4, 5]);
    assert_eq!(taken("max(observation.state.j1) > 2.9999"), [1, 4]);
    assert_eq!(taken("errors == 0 and idle_share < 1").len(), 6);
    assert_eq!(taken("`gawm/recording` == 1"), [3, 4, 5]);
    let error = filter(&input, "mean(observation.state.j3) > 0").unwrap_err();
    assert!(error.to_string().contains("did you mean \"mean(observation.state.j1)\""), "{error}");
    assert!(matches!(filter(&input, "length > 1e9").map(|p| p.pieces.len()), Ok(0)));
}

#[test]
fn cut_episodes_keep_the_rows_that_stay() {
    for make in [dataset, lerobot] {
        let (folder, dir) = make();
        let inputs = [open(&dir)];
        let mut plan = merge(&inputs);
        plan.verb = "trim".to_owned();
        plan.pieces[1].rows = 40..900;
        let out = folder.path().join("out");
        run(&inputs, &plan, &out);
        check_valid(&out, 6);
        let (got, expected) = (rows(&out, 1), rows(&dir, 1).slice(40, 860));
        check_rows(&got, &expected, &["gawm.valid.action"]);
        let valid = got.column_by_name("gawm.valid.action").unwrap().as_boolean();
        // The action of the new last row leads out of the episode.
        assert_eq!(valid.value(859), inputs[0].gawm.is_none());
        assert!((0..859).all(|row| valid.value(row)));
        let numbers =
            |name: &str| got.column_by_name(name).unwrap().as_primitive::<Int64Type>().values().to_vec();
        assert_eq!(numbers("frame_index"), (0..860).collect::<Vec<i64>>());
        assert_eq!(numbers("index"), (30..890).collect::<Vec<i64>>());
    }
}

#[test]
fn idle_ends_are_found_and_cut() {
    let (_folder, dir) = dataset();
    let input = open(&dir);
    // The arm of this dataset never rests.
    let (plan, trimmed) = trim(&input, &TrimOptions::default()).unwrap();
    assert!(trimmed.iter().all(|t| t.kept == (0..t.rows) && !t.is_idle));
    assert_eq!(plan.pieces, input.pieces(0));
    // With a threshold that nothing reaches nothing moves, and nothing is cut.
    let (_, still) = trim(&input, &TrimOptions { threshold: 1.0, ..TrimOptions::default() }).unwrap();
    assert!(still.iter().all(|t| t.is_idle && t.kept == (0..t.rows)));
}

#[test]
fn episodes_in_several_inputs_are_taken_once_or_refused() {
    let (folder, dir) = dataset();
    let inputs = [open(&dir), open(&dir)];
    let out = folder.path().join("twice");
    let summary = run(&inputs, &merge(&inputs), &out);
    assert_eq!(summary.episodes, 6);
    assert!(summary.notes.iter().any(|note| note.starts_with("6 episodes were in several inputs")));
    let mut plan = merge(&inputs);
    plan.pieces[7].rows = 10..50;
    let error = write(&inputs, &plan, &folder.path().join("other"), &|_| {}).unwrap_err();
    assert!(matches!(error, EditError::Conflicting { .. }), "{error}");
    assert!(!folder.path().join("other").exists());
    let left: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(left.len(), 2, "{left:?}");
}

#[test]
fn different_datasets_are_not_merged() {
    let (folder, dir) = lerobot();
    let other = folder.path().join("other");
    crate::writer::tests::write_all(&other, WriteMode::New, &[2], 500);
    let check = |a: &Path, b: &Path, part: &str| {
        let inputs = [open(a), open(b)];
        let error = write(&inputs, &merge(&inputs), &folder.path().join("out"), &|_| {}).unwrap_err();
        assert!(error.to_string().contains(part), "{error}");
        assert!(error.is_usage() && error.hint().is_some());
    };
    check(&dir, &other, "format");
    fs::remove_file(other.join("meta/gawm.json")).unwrap();
    let info = fs::read_to_string(other.join("meta/info.json")).unwrap();
    fs::write(other.join("meta/info.json"), info.replace("\"fps\": 10", "\"fps\": 11")).unwrap();
    check(&dir, &other, "fps");
    fs::write(other.join("meta/info.json"), info.replace("\"v1\"", "\"w1\"")).unwrap();
    check(&dir, &other, "feature \"action\"");
}

#[test]
fn splits_by_session_keep_sessions_whole() {
    let (_folder, dir) = dataset();
    let input = open(&dir);
    let parts = |texts: &[&str]| -> Vec<SplitPart> { texts.iter().map(|t| parse_part(t).unwrap()).collect() };
    let chosen = split(&input, SplitBy::Session, &parts(&["train=0.8", "val=0.2"]), 0).unwrap();
    for (_, plan) in &chosen {
        let mut sessions: Vec<usize> = plan.pieces.iter().map(|piece| piece.run / 3).collect();
        sessions.dedup();
        assert_eq!((sessions.len(), plan.pieces.len()), (1, 3));
    }
    let check_error = |by: SplitBy, texts: &[&str], part: &str| {
        let error = split(&input, by, &parts(texts), 0).unwrap_err();
        assert!(error.to_string().contains(part), "{error}");
    };
    check_error(SplitBy::Session, &["a=0.4", "b=0.3", "c=0.3"], "3 parts of 2 sessions");
    check_error(SplitBy::Session, &["a=0:3"], "shares such as");
    check_error(SplitBy::Episode, &["a=0.7", "b=0.7"], "add up to 1");
    check_error(SplitBy::Episode, &["a=0:3", "b=2:4"], "episode 2 in \"a\" and \"b\"");
    check_error(SplitBy::Episode, &["a=0:7"], "episodes 0 to 5");
    check_error(SplitBy::Episode, &["a=0:3", "b=0.5"], "both");
    check_error(SplitBy::Episode, &["a=0.5", "a=0.5"], "twice");
}
