//! Inputs of other shapes: interventions from a topic, bags compressed as a whole.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use gawm_ingest::tabular::{Limits, Values, open};
use support::{Dataset, demo_contract, demo_log, files, last_at, run, shared, suggest};

/// The flag in force is a column of its own; an operator who says nothing yet has not intervened, and that is not known.
const CONTRACT: &str = r#"
[ticks]
rate_hz = 20
[[stream]]
name = "joints"
topic = "/cell/joint_states"
fields = ["position[0]"]
feature = "observation.state"
tolerance_ms = 100
[[stream]]
topic = "/cell/intervention"
fields = ["data"]
feature = "annotation.intervention"
kind = "bool"
align = "hold"
clock = "log"
gap = "mask"
"#;

#[test]
fn interventions_are_a_column() {
    let Some(corpora) = shared() else { return };
    let folder = tempfile::tempdir().unwrap();
    let log = corpora.join("cell/cell_mixed_zstd.mcap");
    let topics = support::stdout(&support::ingest(&["inspect", support::text(&log)]));
    let joints = topics
        .lines()
        .find_map(|line| {
            line.split_whitespace()
                .next()
                .filter(|topic| line.contains("JointState") && topic.starts_with('/'))
        })
        .unwrap();
    let contract = folder.path().join("c.toml");
    std::fs::write(&contract, CONTRACT.replace("/cell/joint_states", joints)).unwrap();
    let out = folder.path().join("out");
    run(&contract, &out, &[&log], &[], 0);
    let truth = open(&corpora.join("cell/truth/cell.npz"), &Limits::default()).unwrap();
    let Values::I64(times) = truth.read_all("intervention_log").unwrap().values else { panic!("times") };
    let flags = truth.read_all("intervention").unwrap().values.to_f64().unwrap();
    let dataset = Dataset::open(&out);
    let got = dataset.values("annotation.intervention", "data");
    let valid = dataset.bools("gawm.valid.annotation.intervention");
    let mut seen = [0, 0];
    for ((&tick, got), valid) in dataset.integers("gawm.time_ns").iter().zip(got).zip(valid) {
        match last_at(&times, tick) {
            Some(at) => {
                assert!(valid && got == flags[at], "at {tick}: expected {}, got {got}", flags[at]);
                seen[usize::from(got != 0.0)] += 1;
            }
            None => assert!(!valid && got.is_nan(), "at {tick}"),
        }
    }
    assert!(seen[0] > 50 && seen[1] > 5, "{seen:?}");
}

#[test]
fn a_bag_that_was_compressed_as_a_whole_is_read() {
    let folder = tempfile::tempdir().unwrap();
    let bag = folder.path().join("bag");
    std::fs::create_dir(&bag).unwrap();
    let log = std::fs::read(demo_log()).unwrap();
    std::fs::write(bag.join("demo_0.mcap.zstd"), zstd::encode_all(log.as_slice(), 3).unwrap()).unwrap();
    let metadata = "rosbag2_bagfile_information:\n  version: 5\n  storage_identifier: mcap\n  compression_format: zstd\n  compression_mode: FILE\n  relative_file_paths:\n    - demo_0.mcap.zstd\n";
    std::fs::write(bag.join("metadata.yaml"), metadata).unwrap();
    let (plain, packed) = (folder.path().join("plain"), folder.path().join("packed"));
    run(&demo_contract(), &plain, &[&demo_log()], &[], 0);
    let report = run(&demo_contract(), &packed, &[&bag], &[], 0);
    assert!(report["frames"].as_u64().unwrap() > 0);
    let data = |dir: &std::path::Path| -> Vec<Vec<u8>> {
        files(dir).into_iter().filter(|(path, _)| path.starts_with("data")).map(|(_, bytes)| bytes).collect()
    };
    assert!(data(&plain) == data(&packed), "the same rows, to the byte");
    let contracts = [("plain.toml", demo_log()), ("packed.toml", bag.clone())].map(|(name, input)| {
        let contract = folder.path().join(name);
        suggest(&[&input], &contract);
        std::fs::read_to_string(contract).unwrap()
    });
    assert_eq!(contracts[0], contracts[1], "suggested from the log and from the packed one");

    // Half of the file: what cannot be unpacked is refused.
    let whole = std::fs::read(bag.join("demo_0.mcap.zstd")).unwrap();
    std::fs::write(bag.join("demo_0.mcap.zstd"), &whole[..whole.len() / 2]).unwrap();
    let report = run(&demo_contract(), &folder.path().join("half"), &[&bag], &[], 1);
    let error = report["files"][0]["error"].as_str().unwrap();
    assert!(error.contains("cannot unpack") && error.contains("demo_0.mcap.zstd"), "{error}");
}
