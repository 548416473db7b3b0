use std::fs;
use std::path::{Path, PathBuf};

use arrow::array::AsArray;
use arrow::datatypes::Int64Type;

use super::*;
use crate::edit::tests::{check_rows, check_valid, dataset, lerobot, open, rows, run};
use crate::read::{Dataset, ReadLimits};
use crate::spec::WriteMode;
use crate::writer::tests::{tree, write_all};

fn parse(text: &str) -> Result<LabelTable, LabelError> {
    LabelTable::parse(Path::new("labels"), text.as_bytes())
}

/// Labels a dataset and returns the folder of the result.
fn labelled(dir: &Path, text: &str, name: &str) -> PathBuf {
    let inputs = [open(dir)];
    let plan = label(&inputs[0], &parse(text).unwrap()).unwrap();
    let out = dir.parent().unwrap().join(name);
    run(&inputs, &plan, &out);
    out
}

fn labels_of(dir: &Path, episode: usize) -> EpisodeLabels {
    current_labels(&open(dir), episode)
}

/// Returns the task of each row of an episode, by its text.
fn task_of_rows(dir: &Path, episode: usize) -> Vec<String> {
    let rows = rows(dir, episode);
    let numbers = rows.column_by_name("task_index").unwrap().as_primitive::<Int64Type>().clone();
    let tasks = Dataset::open(dir, ReadLimits::default()).unwrap().tasks;
    let mut texts: Vec<String> = numbers.values().iter().map(|n| tasks[*n as usize].clone()).collect();
    texts.dedup();
    texts
}

const TABLE: &str = "episode,task,success,operator,split,tags.light\n\
    0,,unknown,,val,\n\
    1,fold the towel,true,ben,val,\"dim, warm\"\n\
    2,,,,val,\n\
    4,pick the red cube,,,train,\n";

#[test]
fn labels_are_said_and_rows_stay() {
    for make in [dataset, lerobot] {
        let (_folder, dir) = make();
        let out = labelled(&dir, TABLE, "out");
        check_valid(&out, 6);
        (0..6).for_each(|episode| check_rows(&rows(&out, episode), &rows(&dir, episode), &[]));
        let text = |text: &str| LabelValue::Text(text.to_owned());
        let labels = labels_of(&out, 1);
        assert_eq!(labels[&Label::Task], text("fold the towel"));
        assert_eq!(labels[&Label::Success], LabelValue::Bool(true));
        assert_eq!(labels[&Label::Operator], text("ben"));
        assert_eq!(labels[&Label::Split], LabelValue::Split(Split::Validation));
        assert_eq!(labels[&Label::Tag("light".to_owned())], text("dim, warm"));
        assert_eq!(labels_of(&out, 0).get(&Label::Success), None);
        assert_eq!(labels_of(&out, 4)[&Label::Split], LabelValue::Split(Split::Train));
        assert_eq!(task_of_rows(&out, 1), ["fold the towel"]);
        assert_eq!(task_of_rows(&out, 4), ["pick the red cube"]);
        for episode in [0, 2, 3, 5] {
            let others = |dir: &Path| {
                let mut labels = labels_of(dir, episode);
                labels.retain(|label, _| !matches!(label, Label::Success | Label::Split));
                labels
            };
            assert_eq!(others(&out), others(&dir), "episode {episode}");
            assert_eq!(task_of_rows(&out, episode), task_of_rows(&dir, episode));
        }
        // What the table says is so now: the same table changes nothing more.
        let again = label(&open(&out), &parse(TABLE).unwrap()).unwrap();
        assert!(again.labels.unwrap().episodes.is_empty());
    }
}

#[test]
fn only_what_changes_is_written() {
    let (_folder, dir) = dataset();
    let out = labelled(&dir, "episode,task\n1,fold\n", "out");
    let (before, after) = (tree(&dir), tree(&out));
    let changed: Vec<&str> = after
        .iter()
        .filter(|(name, bytes)| before.get(*name) != Some(bytes))
        .map(|(name, _)| name.as_str())
        .collect();
    let expected = [
        "data/chunk-000/file-000.parquet",
        "meta/episodes/chunk-000/file-000.parquet",
        "meta/gawm-edits.json",
        "meta/gawm.json",
        "meta/info.json",
        "meta/tasks.parquet",
    ];
    assert_eq!(changed, expected);
    #[cfg(unix)]
    {
        use std::os::unix::fs::MetadataExt;
        let inode = |dir: &Path, name: &str| fs::metadata(dir.join(name)).unwrap().ino();
        let is_linked = |name: &str| inode(&dir, name) == inode(&out, name);
        assert!(is_linked("data/chunk-000/file-001.parquet"));
        assert!(!is_linked("data/chunk-000/file-000.parquet"));
        assert!(!is_linked("meta/stats.json"));
    }
    // Frames are found by their position in the file, as in the dataset before.
    let read = |dir: &Path| crate::edit::tests::frames(dir, 1);
    assert_eq!(read(&out), read(&dir));
}

#[test]
fn a_changed_split_is_fitted_on_and_kept_by_other_edits() {
    let (folder, dir) = dataset();
    let table = "episode,split\n0,val\n1,val\n2,val\n3,train\n4,train\n5,train\n";
    let out = labelled(&dir, table, "out");
    check_valid(&out, 6);
    let meta = |dir: &Path| -> crate::provenance::GawmMeta {
        serde_json::from_slice(&fs::read(dir.join("meta/gawm.json")).unwrap()).unwrap()
    };
    let other =
        labelled(&dir, &table.replace("val", "x").replace("train", "val").replace('x', "train"), "other");
    assert_eq!(meta(&out).standardisation[0].fitted_on.episodes, 3);
    assert_ne!(meta(&out).standardisation, meta(&other).standardisation);
    // The writer, told the same, makes the same of the rows.
    let inputs = [open(&out)];
    let merged = folder.path().join("merged");
    run(&inputs, &crate::edit::merge(&inputs), &merged);
    assert_eq!(meta(&merged).standardisation, meta(&out).standardisation);
    let split = |dir: &Path| -> Vec<LabelValue> {
        (0..6).map(|episode| labels_of(dir, episode)[&Label::Split].clone()).collect()
    };
    assert_eq!(split(&merged), split(&out));
    let encoded = "gawm/encoded/chunk-000/file-001.parquet";
    assert_eq!(tree(&merged)[encoded], tree(&out)[encoded]);
    // More recordings keep the labels of those that are there.
    write_all(&out, WriteMode::Append, &[2], 500);
    assert_eq!(split(&out), split(&merged));
}

#[test]
fn the_template_is_a_table_that_changes_nothing() {
    for make in [dataset, lerobot] {
        let (_folder, dir) = make();
        let out = labelled(&dir, TABLE, "out");
        let text = template(&open(&out));
        assert!(text.starts_with("episode,episode_id,source_file,task,success,operator,split,tags.light\n"));
        assert!(text.contains("\"dim, warm\""), "{text}");
        assert_eq!(text.lines().count(), 7);
        let plan = label(&open(&out), &parse(&text).unwrap()).unwrap();
        assert_eq!(plan.labels.unwrap().episodes, BTreeMap::new());
    }
}

#[test]
fn episodes_are_named_by_index_id_and_file() {
    let (_folder, dir) = dataset();
    let input = open(&dir);
    let id = input.dataset.entry(4).unwrap().extra_text("gawm/episode_id").unwrap();
    let changed = |text: &str| -> Vec<usize> {
        let labels = label(&input, &parse(text).unwrap()).unwrap().labels.unwrap();
        labels.episodes.into_keys().collect()
    };
    assert_eq!(changed(&format!("episode_id,operator\n{id},ben\n")), [4]);
    assert_eq!(changed("source_file,operator\n/logs/monday/log-0.mcap,ben\n"), [0, 1, 2]);
    assert_eq!(
        changed(&format!(
            "[{{\"source_file\": \"log-1.mcap\", \"episode_id\": {id:?}, \"operator\": null}}]"
        )),
        [4]
    );
    assert_eq!(
        changed("{\"episode\": 2, \"tags\": {\"a\": 1}}\n{\"episode\": 3, \"success\": false}\n"),
        [2, 3]
    );
}

#[track_caller]
fn check_error(text: &str, part: &str) {
    let (_folder, dir) = dataset();
    let found = parse(text).map_err(EditError::from).and_then(|table| label(&open(&dir), &table));
    let error = found.unwrap_err();
    assert!(error.to_string().contains(part), "{text:?}: {error}");
    assert!(error.is_usage() && error.hint().is_some());
}

#[test]
fn bad_tables_are_refused_with_their_line() {
    check_error("", "empty: expected a header line");
    check_error(" \n\n", "empty: expected a header line");
    check_error("episode,task\n", "expected at least one row");
    check_error("[]", "expected at least one row");
    check_error("episode,colour\n0,red\n", "line 1: unknown column \"colour\", expected episode, episode_id");
    check_error("episode,task,task\n0,a,b\n", "line 1: column \"task\" is there twice");
    check_error("task,success\na,true\n", "line 1: expected a column that names the episode");
    check_error("episode,episode_id\n0,x\n", "line 1: expected a label");
    check_error(
        "episode,task\n0,a\n6,b\n",
        "line 3: unknown episode: expected an episode from 0 to 5, got episode 6",
    );
    check_error("episode,task\n-1,a\n", "line 2: episode: expected an episode's number, got \"-1\"");
    check_error("episode_id,task\nnobody,a\n", "line 2: unknown episode: expected one of");
    check_error("source_file,task\nlog-7.mcap,a\n", "expected one of \"log-0.mcap\", \"log-1.mcap\"");
    check_error(
        "episode,source_file,task\n0,log-1.mcap,a\n",
        "line 2: episode 0 and source_file \"log-1.mcap\"",
    );
    check_error("episode,task\n,a\n", "line 2: expected a name of the episode");
    check_error("episode,success\n\n0,maybe\n", "line 3: success: expected true, false, unknown");
    check_error("episode,split\n0,test\n", "line 2: split: expected train, val or nothing, got \"test\"");
    check_error(
        "episode,task\n0,a\n1,b\n0,c\n",
        "lines 2 and 4 disagree on task of episode 0: \"a\" and \"c\"",
    );
    check_error("episode,task\n0,a,b\n", "line 2: expected 2 cells as in the header, got 3");
    check_error(
        "[\n{\"episode\": 0, \"task\": \"a\"},\n{\"episode\": 0, \"task\": [1]}]",
        "line 3: task: expected text",
    );
    check_error("[{\"episode\": 0, \"success\": \"so so\"}]", "line 1: success");
    check_error("[{\"episode\": 0,\n \"success\": tru}]", "line 2:");
    check_error("{\"episode\": 0, \"task\": \"a\", \"task\": \"b\"}", "is there twice");
    check_error("{\"episode\": 0, \"task\": \"a\"}\n{\"episode\": 1,\n", "line 3:");
    check_error("[1]", "line 1:");
    let bytes = LabelTable::parse(Path::new("x"), b"episode,task\n0,\xff\n").unwrap_err();
    assert!(bytes.to_string().contains("line 2: expected UTF-8"), "{bytes}");
}

#[test]
fn damaged_datasets_and_places_are_refused() {
    let (folder, dir) = dataset();
    let inputs = [open(&dir)];
    let plan = label(&inputs[0], &parse("episode,task\n0,a\n").unwrap()).unwrap();
    let inside = crate::edit::write(&inputs, &plan, &dir.join("out"), &|_| {}).unwrap_err();
    assert!(matches!(inside, EditError::InsideInput { .. }));
    fs::remove_file(dir.join("data/chunk-000/file-001.parquet")).unwrap();
    let gone = crate::edit::write(&inputs, &plan, &folder.path().join("out"), &|_| {}).unwrap_err();
    assert!(gone.to_string().contains("file-001.parquet"), "{gone}");
    assert!(!folder.path().join("out").exists());
}
