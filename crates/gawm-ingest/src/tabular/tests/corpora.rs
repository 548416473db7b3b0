//! Files that others wrote, against what the catalogue says of them.

use sha2::{Digest, Sha256};

use super::*;

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|b| format!("{b:02x}")).collect()
}

/// The truth files hold bare NaN, which strict JSON does not know; no text in them has these letters.
fn read_truth(path: &Path) -> serde_json::Value {
    let text = std::fs::read_to_string(path).unwrap();
    serde_json::from_str(
        &text.replace("-Infinity", "null").replace("Infinity", "null").replace("NaN", "null"),
    )
    .unwrap()
}

/// Compares every column of a recording with its truth; returns how many columns and single rows were compared.
fn check_swm(name: &str, episodes: &[u64]) -> (usize, usize) {
    let Some(path) = corpus(&format!("swm_h5/{name}.h5")) else { return (0, 0) };
    let truth = read_truth(&path.with_extension("truth.json"));
    let table = open(&path, &Limits::default()).unwrap();
    assert_eq!(table.findings(), [], "{name}");
    let truth = truth.as_object().unwrap();
    assert_eq!(
        table.columns().iter().map(|c| c.path.clone()).collect::<Vec<_>>(),
        sorted_keys(truth),
        "{name}"
    );
    let (mut n_columns, mut n_rows) = (0, 0);
    for (path, of) in truth {
        let column = table.column(path).unwrap();
        assert_eq!(serde_json::json!(column.shape), of["shape"], "{name} {path}");
        match of["sha256_le"].as_str() {
            Some(sha) => {
                let mut hasher = Sha256::new();
                table.visit_bytes(path, &mut |bytes| hasher.update(bytes)).unwrap();
                assert_eq!(hex(&hasher.finalize()), sha, "{name} {path}");
            }
            None => check_text(&table, path, of),
        }
        n_columns += 1;
        n_rows += check_images(&table, column, of);
    }
    let found = table.episodes(None).unwrap();
    assert_eq!((found.layout.name(), kinds(&found.findings)), ("flat", vec![]), "{name}");
    assert_eq!(found.episodes.iter().map(|e| e.steps).collect::<Vec<_>>(), episodes, "{name}");
    check_last_actions(&table, &found);
    (n_columns, n_rows)
}

fn sorted_keys(truth: &serde_json::Map<String, serde_json::Value>) -> Vec<String> {
    let mut keys: Vec<String> = truth.keys().cloned().collect();
    keys.sort();
    keys
}

fn check_text(table: &Table, path: &str, of: &serde_json::Value) {
    let Values::Text(texts) = table.read_all(path).unwrap().values else { panic!("{path}: expected text") };
    let first = of["first"].as_str().unwrap();
    assert!(first == texts[0] || first == format!("b'{}'", texts[0]), "{path}: {first} {}", texts[0]);
}

/// Every row through the row path equals the whole read, and the listed rows equal their checksums.
fn check_images(table: &Table, column: &Column, of: &serde_json::Value) -> usize {
    let Some([h, w, c]) = column.image_shape() else { return 0 };
    let listed = of["frame_sha256"].as_object().unwrap();
    let row_bytes = (h * w * c) as usize;
    let (mut image, mut whole) = (Vec::new(), Sha256::new());
    // In reverse order, so that nothing is left over from the row before.
    let mut rows = vec![Vec::new(); column.readable_rows as usize];
    for row in (0..column.readable_rows).rev() {
        assert_eq!(table.read_image(&column.path, row, &mut image).unwrap(), [h, w, c]);
        assert_eq!(image.len(), row_bytes);
        if let Some(sha) = listed.get(&row.to_string()) {
            assert_eq!(hex(&Sha256::digest(&image)), sha.as_str().unwrap(), "{} row {row}", column.path);
        }
        rows[row as usize].clone_from(&image);
    }
    rows.iter().for_each(|row| whole.update(row));
    assert_eq!(hex(&whole.finalize()), of["sha256_le"].as_str().unwrap(), "{}", column.path);
    listed.len()
}

/// The action that ends an episode is NaN, and is kept as such.
fn check_last_actions(table: &Table, found: &Episodes) {
    for episode in &found.episodes {
        let rows = &episode.columns["action"];
        let last = rows.start + rows.rows - 1;
        let action = table.read_rows(&rows.path, last..last + 1).unwrap().values.to_f64().unwrap();
        assert!(action.iter().all(|v| v.is_nan()), "episode {}: {action:?}", episode.name);
    }
}

#[test]
fn stable_worldmodel_recordings_equal_their_truth() {
    let mut n = (0, 0);
    for (name, episodes) in [
        ("tworoom", &[11, 61, 52, 31][..]),
        ("pusht", &[61, 61, 61, 61]),
        ("reacher", &[61, 61, 61]),
        ("cube", &[61, 61, 61]),
    ] {
        let (columns, rows) = check_swm(name, episodes);
        n = (n.0 + columns, n.1 + rows);
    }
    assert!(n == (0, 0) || n.0 == 93, "{n:?} columns and rows");
}

/// What a corpus file must give: layout, finished episodes, their rows, unfinished rows, a step column with its width.
type Expected = (&'static str, usize, u64, u64, &'static str, u64);

fn check_corpus(file: &str, expected: Expected, findings: &[FindingKind]) {
    let Some(path) = corpus(file) else { return };
    let table = open(&path, &Limits::default()).unwrap();
    let found = table.episodes(None).unwrap();
    let (layout, episodes, rows, unfinished, column, width) = expected;
    let tail: u64 = found.unfinished.iter().map(|e| e.steps).sum();
    let got = (found.layout.name(), found.episodes.len(), found.rows(), tail);
    assert_eq!(got, (layout, episodes, rows, unfinished), "{file}");
    for episode in &found.episodes {
        let at =
            episode.columns.get(column).unwrap_or_else(|| panic!("{file}: {:?}", episode.columns.keys()));
        assert!(at.extent.has_steps(), "{file} {}", episode.name);
        let values = table.read_rows(&at.path, at.start..at.start + at.rows).unwrap();
        assert_eq!(values.values.len() as u64, at.rows * width, "{file} {}", episode.name);
    }
    let mut kinds: Vec<FindingKind> =
        table.findings().iter().chain(&found.findings).map(|f| f.kind).collect();
    kinds.sort_unstable();
    kinds.dedup();
    assert_eq!(kinds, findings, "{file}: {:#?}", found.findings);
    for column in table.columns().iter().filter(|c| c.problem.is_none()) {
        table.content_hash(&column.path).unwrap_or_else(|e| panic!("{file}: {e}"));
    }
}

#[test]
fn recordings_of_others_open_as_the_catalogue_says() {
    use FindingKind::{ChunkedAction, ExtraRows, NoAction, UnfinishedTail};
    check_corpus("isaaclab_indy7/annotated_dataset.hdf5", ("groups", 8, 335, 0, "obs/joint_pos", 6), &[]);
    check_corpus("isaaclab_indy7/generated_dataset_small.hdf5", ("groups", 8, 281, 0, "actions", 6), &[]);
    check_corpus("cart_pendulum/demo.hdf5", ("groups", 100, 30_000, 0, "observation", 4), &[]);
    check_corpus("arm7dof/scripted_demos.hdf5", ("suffixed", 10, 1_500, 0, "states", 7), &[]);
    check_corpus("d4rl_style/physical_0.hdf5", ("terminals", 1, 2_000, 0, "next_observations", 8), &[]);
    check_corpus(
        "d4rl_style/maze2d-umaze-v1.hdf5",
        ("terminals", 136, 9_841, 159, "infos/qpos", 2),
        &[UnfinishedTail],
    );
    check_corpus(
        "mj_lift_npz/episode_000/trajectory.npz",
        ("single", 1, 79, 0, "obs_state", 9),
        &[ExtraRows],
    );
    check_corpus("mj_lift_npz/episode_001/trajectory.npz", ("single", 1, 77, 0, "actions", 4), &[ExtraRows]);
    check_corpus("g1_motion_npz/motion.npz", ("single", 1, 232, 0, "joint_pos", 29), &[NoAction]);
    check_corpus(
        "reach2d_npz/demos.npz",
        ("single", 1, 1_000, 0, "observation", 2),
        &[ChunkedAction, NoAction],
    );
}

/// The plain arrays are taken; the pickled one beside them is refused by name.
#[test]
fn a_pickled_array_does_not_hide_the_plain_ones() {
    let Some(path) = corpus("bc_npz/demos_fast.npz") else { return };
    let table = open(&path, &Limits::default()).unwrap();
    assert_eq!(kinds(table.findings()), [(FindingKind::UnreadableColumn, "metadata")]);
    assert_eq!(table.read_all("metadata"), Err(ReadError::Pickled { column: "metadata".to_owned() }));
    let found = table.episodes(None).unwrap();
    assert_eq!(
        (found.layout.name(), found.episodes.len(), found.rows(), found.findings.len()),
        ("flat", 30, 1_218, 0)
    );
}

/// Cut in the middle of the pixels: numbers stay whole, and what is lost is said.
#[test]
fn a_cut_recording_gives_the_episodes_that_are_whole() {
    let Some(path) = corpus("swm_h5/tworoom.h5") else { return };
    let bytes = std::fs::read(&path).unwrap();
    let whole = open(&path, &Limits::default()).unwrap();
    let dir = tempfile::tempdir().unwrap();
    let mut n_opened = 0;
    for keep in [bytes.len() - 1, bytes.len() * 3 / 4, bytes.len() / 2, bytes.len() / 8, 4096, 600] {
        let cut = dir.path().join("cut.h5");
        std::fs::write(&cut, &bytes[..keep]).unwrap();
        let Ok(table) = open(&cut, &Limits::default()) else { continue };
        n_opened += 1;
        assert!(table.findings().iter().any(|f| f.kind == FindingKind::Truncated), "{keep}");
        for column in table.columns() {
            let rows = column.readable_rows;
            if let Ok(values) = table.read_rows(&column.path, 0..rows.min(40)) {
                let truth = whole.read_rows(&column.path, 0..rows.min(40)).unwrap();
                assert_eq!(format!("{values:?}"), format!("{truth:?}"), "{keep} {}", column.path);
            }
        }
        if let Ok(found) = table.episodes(None) {
            for episode in &found.episodes {
                let at = &episode.columns["proprio"];
                table.read_rows(&at.path, at.start..at.start + at.rows).unwrap();
            }
        }
    }
    assert!(n_opened >= 3, "{n_opened} of 6 cut files opened");
}
