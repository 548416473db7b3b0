//! Parquet files that declare what is not there: an answer with bounded memory, and nothing written.
//!
//! The files were made by `xtask/interop/hostile_parquet.py`.

#![expect(clippy::unwrap_used, reason = "a test stops where its set-up fails")]

use std::fs;
use std::path::{Path, PathBuf};
use std::process::{Command, Output};

/// Address space of the program in KiB: several times what it takes for the sound folder.
const LIMIT_KIB: u32 = 1_500_000;

/// What is said of some of them.
const SAID: [(&str, &str); 11] = [
    ("page_declares_2gb", "a page that declares 2147483647 bytes"),
    ("vector_page_declares_2gb", "a page that declares 2147483647 bytes"),
    ("page_stored_2gb", "a page of 2147483647 bytes where"),
    ("dictionary_of_2g_values", "a dictionary of 2147483647 entries"),
    ("bomb_1gb", "a page that declares 1073741824 bytes"),
    ("rows_2e31", "2147483647 rows in a file of"),
    ("schema_of_2g_children", "2147483647 children"),
    ("schema_5000_deep", "more than 64 levels"),
    ("footer_of_4gb", "a footer of 4294967295 bytes"),
    ("footer_encrypted", "no Parquet footer"),
    ("episodes_dictionary_of_2g", "a dictionary of 2147483647 entries"),
];

fn fixtures() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/hostile_parquet")
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

/// Runs the program in `folder`, with little memory where the system can limit it.
fn gawm_data(folder: &Path, arguments: &[&str]) -> Output {
    let limit = if cfg!(target_os = "linux") { format!("ulimit -v {LIMIT_KIB}; ") } else { String::new() };
    let mut command = Command::new("sh");
    command.args(["-c", &format!("{limit}exec \"$0\" \"$@\""), env!("CARGO_BIN_EXE_gawm-data")]);
    command.args(["--threads", "2"]).args(arguments).current_dir(folder).output().unwrap()
}

/// Puts a file into the sound folder, runs some verbs, and returns what they said.
fn answers(file: &Path) -> String {
    let name = file.file_stem().unwrap().to_str().unwrap();
    let place = match name.rsplit_once('.').unwrap().1 {
        "data" => "data/chunk-000/file-000.parquet",
        "episodes" => "meta/episodes/chunk-000/file-000.parquet",
        _ => "meta/tasks.parquet",
    };
    let folder = tempfile::tempdir().unwrap();
    copy(&fixtures().join("sound"), &folder.path().join("in"));
    fs::copy(file, folder.path().join("in").join(place)).unwrap();
    fs::write(folder.path().join("labels.csv"), "episode,task\n0,put the cup down\n").unwrap();
    let mut said = String::new();
    for arguments in [
        &["validate", "in", "--fail-on", "never"][..],
        &["stats", "in"],
        &["filter", "in", "--out", "out", "--where", "mean(action[0]) < 1e9", "--skip-damaged"],
        &["label", "in", "--out", "out", "--labels", "labels.csv"],
    ] {
        let output = gawm_data(folder.path(), arguments);
        let text =
            format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
        let code = output.status.code();
        assert!(matches!(code, Some(0..=3)), "{name}: {arguments:?} ended with {:?}: {text}", output.status);
        assert!(!text.contains("panicked"), "{name}: {arguments:?}: {text}");
        assert!(code == Some(0) || !output.stderr.is_empty(), "{name}: {arguments:?} failed without a word");
        fs::remove_dir_all(folder.path().join("out")).ok();
        said += &text;
    }
    let mut left: Vec<_> =
        fs::read_dir(folder.path()).unwrap().map(|entry| entry.unwrap().file_name()).collect();
    left.sort();
    assert_eq!(left, ["in", "labels.csv"], "{name}");
    said
}

#[test]
fn lies_are_answered_with_bounded_memory() {
    let entries = fs::read_dir(fixtures()).unwrap().map(|entry| entry.unwrap().path());
    let files: Vec<PathBuf> = entries.filter(|path| path.is_file()).collect();
    assert!(files.len() > 40);
    let check = |file: &PathBuf| {
        let said = answers(file);
        let name = file.file_name().unwrap().to_str().unwrap();
        for (_, part) in SAID.iter().filter(|(wanted, _)| name.split('.').next() == Some(wanted)) {
            assert!(said.contains(part), "{name}: expected {part:?} in {said}");
        }
    };
    std::thread::scope(|scope| {
        for share in files.chunks(files.len().div_ceil(4)) {
            scope.spawn(move || share.iter().for_each(check));
        }
    });
}

#[test]
fn a_file_that_tells_the_truth_is_read() {
    let said = answers(&fixtures().join("unchanged.data.parquet"));
    assert!(said.contains("2 episodes, 40 rows: 0 errors"), "{said}");
    assert!(said.contains("wrote out: 2 of 2 episodes"), "{said}");
}
