//! Files and folders as recordings.

use std::fs;
use std::path::{Path, PathBuf};

use crate::log::{Foreign, OpenLogError, discover};

fn folder(files: &[(&str, &str)]) -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    for (name, text) in files {
        let path = folder.path().join(name);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
    }
    folder
}

fn bag(parts: &[&str]) -> String {
    let parts: String = parts.iter().map(|part| format!("  - {part}\n")).collect();
    format!(
        "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  message_count: 7\n  compression_mode: MESSAGE\n  relative_file_paths:\n{parts}"
    )
}

/// Lists recordings as `name: part part`.
fn recordings(inputs: &[PathBuf]) -> Vec<String> {
    let name = |path: &PathBuf| path.file_name().unwrap().to_string_lossy().into_owned();
    let line = |recording: &crate::log::Recording| {
        let parts: Vec<String> = recording.parts.iter().map(name).collect();
        format!("{}: {}", recording.name, parts.join(" "))
    };
    discover(inputs).recordings.iter().map(line).collect()
}

#[test]
fn a_folder_without_metadata_is_grouped_by_part_numbers() {
    let folder = folder(&[
        ("x_0.mcap", ""),
        ("x_1.mcap", ""),
        ("x_2.mcap", ""),
        ("x_10.mcap", ""),
        ("y_0.mcap", ""),
        ("y_1.mcap", ""),
        ("z.mcap", ""),
        ("notes.txt", ""),
        ("below/w.mcap", ""),
    ]);
    let expected = [
        "x_0.mcap: x_0.mcap",
        "x_1.mcap: x_1.mcap",
        "x_10.mcap: x_10.mcap",
        "x_2.mcap: x_2.mcap",
        "y: y_0.mcap y_1.mcap",
        "z.mcap: z.mcap",
        "w.mcap: w.mcap",
    ];
    assert_eq!(recordings(&[folder.path().into()]), expected);
    fs::remove_file(folder.path().join("x_10.mcap")).unwrap();
    assert_eq!(recordings(&[folder.path().into()])[0], "x: x_0.mcap x_1.mcap x_2.mcap");
}

/// Writes a log of two messages, at the seconds given.
fn timed(path: &std::path::Path, seconds: [u64; 2]) {
    let mut writer = mcap::Writer::new(std::io::BufWriter::new(fs::File::create(path).unwrap())).unwrap();
    let channel_id = writer.add_channel(0, "/x", "json", &std::collections::BTreeMap::new()).unwrap();
    for (sequence, second) in (0..).zip(seconds) {
        let time = second * 1_000_000_000;
        let header =
            mcap::records::MessageHeader { channel_id, sequence, log_time: time, publish_time: time };
        writer.write_to_known_channel(&header, b"{}").unwrap();
    }
    writer.finish().unwrap();
}

#[test]
fn numbered_files_are_parts_only_where_one_goes_on_where_the_other_ends() {
    let check = |spans: [[u64; 2]; 3], expected: &[&str]| {
        let folder = tempfile::tempdir().unwrap();
        for (number, span) in spans.into_iter().enumerate() {
            timed(&folder.path().join(format!("x_{number}.mcap")), span);
        }
        assert_eq!(recordings(&[folder.path().into()]), expected, "{spans:?}");
    };
    let apart = ["x_0.mcap: x_0.mcap", "x_1.mcap: x_1.mcap", "x_2.mcap: x_2.mcap"];
    check([[10, 20], [20, 30], [31, 40]], &["x: x_0.mcap x_1.mcap x_2.mcap"]);
    // One file per episode: with breaks, out of order, or each from the beginning of a simulation.
    check([[10, 20], [20, 30], [60, 70]], &apart);
    check([[40, 50], [20, 30], [10, 20]], &apart);
    check([[0, 20], [0, 20], [0, 20]], &apart);
}

#[test]
fn a_folder_with_metadata_is_one_recording_in_its_order() {
    let text = bag(&["b.mcap", "run/a.mcap"]);
    let folder = folder(&[
        ("run/metadata.yaml", &text),
        ("run/a.mcap", ""),
        ("run/b.mcap", ""),
        ("run/other.mcap", ""),
    ]);
    let run = folder.path().join("run");
    assert_eq!(recordings(std::slice::from_ref(&run)), ["run: b.mcap a.mcap"]);
    assert_eq!(recordings(&[folder.path().into()]), ["run: b.mcap a.mcap"]);
    assert_eq!(recordings(&[run.join("metadata.yaml")]), ["run: b.mcap a.mcap"]);
    // All parts by name are the recording again, one part is a file.
    assert_eq!(recordings(&[run.join("a.mcap"), run.join("b.mcap")]), ["run: b.mcap a.mcap"]);
    assert_eq!(recordings(&[run.join("a.mcap")]), ["a.mcap: a.mcap"]);
    assert_eq!(recordings(&[run.join("a.mcap"), run.join("a.mcap")]), ["a.mcap: a.mcap"]);
    let found = discover(&[run]).recordings.remove(0).rosbag2.unwrap();
    assert_eq!((found.message_count, found.has_compressed_messages()), (Some(7), true));
}

#[test]
fn what_is_named_twice_counts_once() {
    let folder = folder(&[("a.mcap", ""), ("below/b.mcap", ""), ("none/notes.txt", "")]);
    let (all, below) = (folder.path().to_owned(), folder.path().join("below"));
    for inputs in [
        vec![all.clone(), all.clone()],
        vec![all.clone(), below.clone()],
        vec![all.clone(), all.join("a.mcap")],
    ] {
        let found = discover(&inputs);
        assert_eq!((found.recordings.len(), found.refused.len()), (2, 0), "{inputs:?}: {:?}", found.refused);
    }
    // A folder without logs is still named.
    assert_eq!(discover(&[all.clone(), all.join("none")]).refused.len(), 1);
}

fn check_refused(files: &[(&str, &str)], expected: fn(&OpenLogError) -> bool) {
    let folder = folder(files);
    let found = discover(&[folder.path().into()]);
    assert_eq!(found.recordings, []);
    assert!(found.refused.len() == 1 && expected(&found.refused[0]), "{:?}", found.refused);
}

#[test]
fn what_is_no_recording_is_refused_by_name() {
    check_refused(&[("notes.txt", "")], |error| matches!(error, OpenLogError::EmptyFolder { .. }));
    check_refused(&[("a.bag", "")], |error| {
        matches!(error, OpenLogError::NotMcap { found: Foreign::RosBag1, .. })
    });
    check_refused(&[("a_0.db3", "")], |error| {
        matches!(error, OpenLogError::NotMcap { found: Foreign::Sqlite, .. })
    });
    check_refused(&[("a.mcap.gz", "")], |error| {
        matches!(error, OpenLogError::NotMcap { found: Foreign::Compressed { name: "gzip" }, .. })
    });
    check_refused(&[("metadata.yaml", &bag(&["gone.mcap"])), ("x.mcap", "")], |error| {
        matches!(error, OpenLogError::MissingPart { .. })
    });
    check_refused(&[("metadata.yaml", &bag(&["../../../etc/passwd"]))], |error| {
        matches!(error, OpenLogError::MissingPart { .. })
    });
    check_refused(&[("metadata.yaml", "[")], |error| {
        matches!(error, OpenLogError::BadRosbag2Metadata { .. })
    });
    let missing = Path::new("not/there.mcap").to_owned();
    assert_eq!(recordings(&[missing]), ["there.mcap: there.mcap"]);
}
