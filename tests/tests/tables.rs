//! HDF5, npz and LeRobot folders through `gawm-ingest`: rows and pixels equal to what the files hold.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::path::{Path, PathBuf};

use gawm_image::{Limits as ImageLimits, Pixels, decode};
use gawm_ingest::tabular::{Limits, Table, open};
use support::{Dataset, code, ingest, lost, run, shared, stderr, stdout, suggest, text};

fn fixture(name: &str) -> PathBuf {
    support::root().join("fixtures/hdf5").join(name)
}

fn written(folder: &Path, name: &str, contract: &str) -> PathBuf {
    let path = folder.join(name);
    std::fs::write(&path, contract).unwrap();
    path
}

/// Images, state and action of columns, rows as they are.
fn contract(image: &str, state: &str, action: &str) -> String {
    let stream = |topic: &str, feature: &str, more: &str| {
        format!("[[stream]]\ntopic = \"{topic}\"\nfeature = \"{feature}\"\ntolerance_ms = 150\n{more}\n")
    };
    let fields = "fields = [\"data[0:2]\"]";
    [
        "[ticks]\nmode = \"native\"\nfps = 10\n".to_owned(),
        stream(state, "observation.state", fields),
        stream(image, "observation.images.camera", ""),
        stream(action, "action", &format!("{fields}\naction = {{ timing = \"in-force\" }}")),
    ]
    .concat()
}

/// Every image of the dataset is the row of the table that stands at its place.
fn check_pixels(dataset: &Dataset, table: &Table, column: &str, rows: &[u64]) {
    let images = dataset.images("observation.images.camera");
    assert_eq!(images.len(), rows.len());
    let mut expected = Vec::new();
    for (image, &row) in images.iter().zip(rows) {
        let [height, width, _] = table.read_image(column, row, &mut expected).unwrap();
        let image = decode(image, &ImageLimits::default()).unwrap();
        assert_eq!((u64::from(image.width()), u64::from(image.height())), (width, height));
        assert!(matches!(image.pixels(), Pixels::Rgb8(pixels) if *pixels == expected), "row {row}");
    }
}

fn columns(dataset: &Dataset, feature: &str) -> Vec<[f64; 2]> {
    let [x, y] = ["data_0", "data_1"].map(|dim| dataset.values(feature, dim));
    x.into_iter().zip(y).map(|(x, y)| [x, y]).collect()
}

#[test]
fn images_of_a_killed_recording_are_its_finished_rows() {
    let folder = tempfile::tempdir().unwrap();
    let contract = written(folder.path(), "c.toml", &contract("pixels", "proprio", "action"));
    let out = folder.path().join("out");
    let report = run(&contract, &out, &[&fixture("killed.h5")], &[], 0);
    assert_eq!(report["frames"].as_u64(), Some(21));
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("did not close the file") && !warnings.contains("jump forward"), "{warnings}");
    let dataset = Dataset::open(&out);
    let table = open(&fixture("killed.h5"), &Limits::default()).unwrap();
    check_pixels(&dataset, &table, "pixels", &(0..21).collect::<Vec<_>>());
    let notes = &dataset.meta["recordings"][0]["source"]["notes"];
    let hash = blake3_hex(table.content_hash("pixels").unwrap());
    assert_eq!(notes["column pixels"], hash, "{notes}");
    assert_eq!(notes["layout"], "flat");
}

fn blake3_hex(hash: [u8; 32]) -> String {
    hash.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[test]
fn a_published_recording_keeps_every_row_and_pixel() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let contract = written(folder.path(), "c.toml", &contract("pixels", "proprio", "action"));
    let out = folder.path().join("out");
    let path = corpora.join("swm_h5/tworoom.h5");
    let report = run(&contract, &out, &[&path], &[], 0);
    assert_eq!((report["episodes"].as_u64(), report["frames"].as_u64()), (Some(4), Some(155)));
    assert_eq!(report["warnings"].as_array().unwrap().len(), 0, "{report}");
    let dataset = Dataset::open(&out);
    let table = open(&path, &Limits::default()).unwrap();
    check_pixels(&dataset, &table, "pixels", &(0..155).collect::<Vec<_>>());
    let read = |column: &str| -> Vec<[f64; 2]> {
        let values = table.read_all(column).unwrap().values.to_f64().unwrap();
        values.as_chunks::<2>().0.to_vec()
    };
    assert_eq!(columns(&dataset, "observation.state"), read("proprio"));
    let (action, valid, is_last) =
        (columns(&dataset, "action"), dataset.bools("gawm.valid.action"), dataset.is_last());
    for (row, recorded) in read("action").iter().enumerate() {
        assert_eq!(recorded[0].is_nan(), is_last[row], "the last action of an episode is NaN in the file");
        assert_eq!(valid[row], !is_last[row]);
        if valid[row] {
            assert_eq!(action[row], *recorded, "row {row}");
        }
    }
}

#[test]
fn a_folder_of_tables_is_as_many_recordings() {
    let folder = tempfile::tempdir().unwrap();
    let tables = folder.path().join("tables");
    std::fs::create_dir(&tables).unwrap();
    for name in ["b.h5", "a.h5"] {
        std::fs::copy(fixture("killed.h5"), tables.join(name)).unwrap();
    }
    std::fs::write(tables.join("notes.txt"), "not a log").unwrap();
    let contract = written(folder.path(), "c.toml", &contract("pixels", "proprio", "action"));
    let report = run(&contract, &folder.path().join("out"), &[&tables], &[], 0);
    let status: Vec<&str> =
        report["files"].as_array().unwrap().iter().map(|file| file["status"].as_str().unwrap()).collect();
    assert_eq!(status, ["ok", "already_there"], "the same bytes under another name are taken once");
}

#[test]
fn a_layout_can_be_stated() {
    let folder = tempfile::tempdir().unwrap();
    let base = "[ticks]\nmode = \"native\"\nfps = 20\n[[stream]]\ntopic = \"observations\"\nfields = [\"data[0:2]\"]\ntolerance_ms = 100\nfeature = \"observation.state\"\n";
    let single = written(
        folder.path(),
        "a.toml",
        &format!("layout = {{ kind = \"single\", steps = \"actions\" }}\n{base}"),
    );
    let report = run(&single, &folder.path().join("a"), &[&fixture("stored.npz")], &[], 0);
    assert_eq!(report["frames"].as_u64(), Some(300));
    let flat = written(folder.path(), "b.toml", &format!("layout = {{ kind = \"flat\" }}\n{base}"));
    let report = run(&flat, &folder.path().join("b"), &[&fixture("stored.npz")], &[], 1);
    assert!(report["files"][0]["error"].as_str().unwrap().contains("no column \"ep_len\""), "{report}");
    let unknown = written(folder.path(), "c.toml", &format!("layout = {{ kind = \"flatt\" }}\n{base}"));
    let output = ingest(&["run", "--config", text(&unknown), "--out", "x", text(&fixture("stored.npz"))]);
    assert_eq!(code(&output), 2, "{}", stderr(&output));
    assert!(stderr(&output).contains("flatt"), "{}", stderr(&output));
    let printed = ingest(&["run", "--config", text(&single), "--print-config"]);
    assert!(stdout(&printed).contains("kind = \"single\""), "{}", stdout(&printed));
}

#[test]
fn tables_can_be_inspected_and_a_contract_suggested() {
    let folder = tempfile::tempdir().unwrap();
    let output = ingest(&["inspect", text(&fixture("killed.h5"))]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    assert!(stdout(&output).contains("2 episodes, 21 steps"), "{}", stdout(&output));
    let json = ingest(&["inspect", "--format", "json", text(&fixture("stored.npz"))]);
    assert_eq!(code(&json), 0, "{}", stderr(&json));
    let json: serde_json::Value = serde_json::from_slice(&json.stdout).unwrap();
    assert_eq!(json["tables"][0]["episodes"], 1);
    for (name, frames) in [("killed.h5", 21), ("stored.npz", 300)] {
        let suggested = folder.path().join(format!("{name}.toml"));
        suggest(&[&fixture(name)], &suggested);
        let report = run(&suggested, &folder.path().join(name), &[&fixture(name)], &[], 0);
        assert_eq!(report["frames"].as_u64(), Some(frames), "{name}");
    }
    let none = ingest(&["suggest", text(&fixture("pickled_only.npz"))]);
    assert_eq!(code(&none), 1, "{}", stderr(&none));
}

/// Tables of other people: frames that their suggested contract gives; none where nothing can be suggested.
const FOREIGN: &[(&str, Option<u64>)] = &[
    ("swm_h5/tworoom.h5", Some(155)),
    ("swm_h5/pusht.h5", Some(244)),
    ("swm_h5/reacher.h5", Some(183)),
    ("swm_h5/cube.h5", Some(183)),
    ("cart_pendulum/demo.hdf5", Some(30_000)),
    ("arm7dof/scripted_demos.hdf5", Some(1_500)),
    ("d4rl_style/physical_0.hdf5", Some(2_000)),
    ("g1_motion_npz/motion.npz", Some(232)),
    ("mj_lift_npz/episode_000/trajectory.npz", Some(80)),
    ("mj_lift_npz/episode_001/trajectory.npz", Some(78)),
    ("d4rl_style/maze2d-umaze-v1.hdf5", Some(9_822)),
    ("isaaclab_indy7/annotated_dataset.hdf5", Some(335)),
    ("isaaclab_indy7/generated_dataset_small.hdf5", Some(281)),
    ("reach2d_npz/demos.npz", Some(1_000)),
    // Its pickled column is passed over; the plain ones are whole.
    ("bc_npz/demos_fast.npz", Some(1_218)),
];

#[test]
fn tables_of_other_people_run_with_what_suggest_proposes() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    for (name, frames) in FOREIGN {
        let path = corpora.join(name);
        let output = ingest(&["suggest", text(&path)]);
        let Some(frames) = frames else {
            assert_eq!(code(&output), 1, "{name}: {}", stdout(&output));
            continue;
        };
        assert_eq!(code(&output), 0, "{name}: {}", stderr(&output));
        let contract = written(folder.path(), "c.toml", &stdout(&output));
        let report = run(&contract, &folder.path().join(name.replace('/', "_")), &[&path], &[], 0);
        assert_eq!(report["frames"].as_u64(), Some(*frames), "{name}");
    }
}

#[test]
fn a_video_dataset_comes_in_without_its_video() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = corpora.join("lerobot_v2_gr1_picknplace");
    let suggested = folder.path().join("c.toml");
    suggest(&[&path], &suggested);
    let report = run(&suggested, &folder.path().join("video"), &[&path], &[], 3);
    assert_eq!((report["episodes"].as_u64(), report["frames"].as_u64()), (Some(5), Some(2096)));
    assert_eq!(lost(&report, "observation.images.ego_view", "video_not_decoded"), 2096);
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("egoview") && warnings.contains("no video file"), "{warnings}");
    assert!(warnings.contains("hint"), "{warnings}");
    let dataset = Dataset::open(&folder.path().join("video"));
    assert_eq!(dataset.names("observation.state")[0], "motor_0");
    assert!(dataset.task_of(0).starts_with("pick the "), "{}", dataset.task_of(0));
}

#[test]
fn data_decide_where_metadata_disagree() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let path = corpora.join("lerobot_v3_apple_storage");
    let suggested = folder.path().join("c.toml");
    suggest(&[&path], &suggested);
    let report = run(&suggested, &folder.path().join("out"), &[&path], &[], 0);
    assert_eq!((report["episodes"].as_u64(), report["frames"].as_u64()), (Some(3), Some(899)));
    let warnings = report["warnings"].to_string();
    assert!(warnings.contains("14983") && warnings.contains("no video file"), "{warnings}");
    let dataset = Dataset::open(&folder.path().join("out"));
    assert_eq!(dataset.task_of(0), "place the apple in the plate");

    let broken = corpora.join("lerobot_broken_carla");
    let report = run(&suggested, &folder.path().join("broken"), &[&broken], &[], 1);
    let error = report["files"][0]["error"].as_str().unwrap();
    assert!(error.contains("meta/info.json") && error.contains("hint"), "{error}");
}

#[test]
fn a_gawm_dataset_comes_in_again_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let table = written(folder.path(), "c.toml", &contract("pixels", "proprio", "action"));
    let (first, second) = (folder.path().join("first"), folder.path().join("second"));
    run(&table, &first, &[&fixture("killed.h5")], &[], 0);
    let suggested = folder.path().join("again.toml");
    suggest(&[&first], &suggested);
    let report = run(&suggested, &second, &[&first], &[], 0);
    assert_eq!((report["episodes"].as_u64(), report["frames"].as_u64()), (Some(2), Some(21)));
    let (a, b) = (Dataset::open(&first), Dataset::open(&second));
    for feature in ["observation.state", "action"] {
        assert_eq!(columns(&a, feature), columns(&b, feature), "{feature}");
    }
    assert_eq!(a.images("observation.images.camera"), b.images("observation.images.camera"));
    let output = ingest(&["inspect", text(&first)]);
    assert_eq!(code(&output), 0, "{}", stdout(&output));
    assert!(stdout(&output).contains("2 episodes, 21 frames"), "{}", stdout(&output));
}
