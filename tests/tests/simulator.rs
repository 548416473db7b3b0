//! Logs of `gawm-sim collect`, ingested, equal what the simulator did: positions, actions, pixels, episodes, labels.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::path::Path;
use std::process::Command;

use gawm_image::{Limits, Pixels, decode};
use gawm_sim::collect::{Episode, FIRST_ROW_NS};
use gawm_sim::two_room::ExpertConfig;
use gawm_sim::{Frame, TwoRoom, TwoRoomConfig};
use support::{Dataset, check_same, run, text};

const SEED: u64 = 11;
const EPISODES: u64 = 5;
const MAX_STEPS: u32 = 60;

fn collect(out: &Path, more: &[&str]) {
    let (seed, episodes, steps) = (SEED.to_string(), EPISODES.to_string(), MAX_STEPS.to_string());
    let output = Command::new(env!("CARGO_BIN_EXE_e2e-gawm-sim"))
        .args([
            "collect",
            "--env",
            "two-room",
            "--episodes",
            &episodes,
            "--seed",
            &seed,
            "--max-steps",
            &steps,
        ])
        .args(["--episodes-per-file", "2", "--out", text(out)])
        .args(more)
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// The episodes, simulated again.
fn truth() -> Vec<Episode> {
    let mut room = TwoRoom::new(TwoRoomConfig::default()).unwrap();
    let episode = |index| Episode::run(&mut room, ExpertConfig::default(), MAX_STEPS, SEED, index);
    (0..EPISODES).map(episode).collect()
}

fn check_labels(dataset: &Dataset, truth: &[Episode]) {
    let success: Vec<String> = truth.iter().map(|episode| episode.success.to_string()).collect();
    assert_eq!(dataset.episode_column("success"), success);
    assert!(success.contains(&"true".to_owned()) && success.contains(&"false".to_owned()), "both are met");
    assert!(dataset.episode_column("success_known").iter().all(|known| known == "true"));
    assert!(dataset.episode_column("robot").iter().all(|robot| robot == "two-room"));
    let tags: Vec<serde_json::Value> =
        dataset.episode_column("gawm/tags").iter().map(|tags| serde_json::from_str(tags).unwrap()).collect();
    for (episode, tags) in truth.iter().zip(&tags) {
        assert_eq!(tags["metadata.seed"], episode.seed.to_string());
        assert_eq!(tags["metadata.index"], episode.index.to_string());
        assert_eq!(tags["metadata.task"], "go to the target");
    }
}

fn check_rows(dataset: &Dataset, truth: &[Episode]) {
    let episode_index = dataset.integers("episode_index");
    let (time_ns, is_last) = (dataset.integers("gawm.time_ns"), dataset.is_last());
    let column = |feature: &str| ["x", "y"].map(|dim| dataset.values(feature, dim));
    let (state, target, action) =
        (column("observation.state"), column("observation.environment_state"), column("action"));
    let action_is_valid = dataset.bools("gawm.valid.action");
    let state_is_valid = dataset.bools("gawm.valid.observation.state");
    let image_is_valid = dataset.bools("gawm.valid.observation.images.camera");
    let images = dataset.images("observation.images.camera");
    let room = TwoRoom::new(TwoRoomConfig::default()).unwrap();
    let mut frame = Frame::default();
    let mut row = 0;
    for episode in truth {
        let start_ns = FIRST_ROW_NS + episode.index * u64::from(MAX_STEPS + 11) * 100_000_000;
        for (t, position) in episode.states.iter().enumerate() {
            let at = format!("episode {}, row {t}", episode.index);
            assert_eq!(episode_index[row] as u64, episode.index, "{at}");
            assert_eq!(time_ns[row] as u64, start_ns + t as u64 * 100_000_000, "{at}");
            assert_eq!(is_last[row], t + 1 == episode.states.len(), "{at}");
            assert!(state_is_valid[row] && image_is_valid[row], "{at}");
            let last = episode.actions.len() - 1;
            let command = episode.actions[t.min(last)];
            for axis in 0..2 {
                assert_eq!(state[axis][row], f64::from(position[axis]), "{at}");
                assert_eq!(target[axis][row], f64::from(episode.goal[axis]), "{at}");
                assert_eq!(action[axis][row], f64::from(command[axis]), "{at}");
            }
            assert_eq!(action_is_valid[row], !is_last[row], "{at}");
            room.renderer().render(*position, episode.goal, &mut frame);
            let image = decode(&images[row], &Limits::default()).unwrap();
            assert_eq!((image.width(), image.height()), (224, 224), "{at}");
            assert!(
                matches!(image.pixels(), Pixels::Rgb8(pixels) if *pixels == frame.rgb),
                "{at}: pixels differ"
            );
            row += 1;
        }
    }
    assert_eq!(row, images.len());
}

#[test]
fn a_dataset_of_simulated_logs_equals_the_simulation() {
    let dir = tempfile::tempdir().unwrap();
    let logs = dir.path().join("logs");
    collect(&logs, &[]);
    let out = dir.path().join("dataset");
    let contract = support::root().join("pipelines/tworoom-ingest.toml");
    let report = run(&contract, &out, &[&logs], &["--jobs", "2"], 0);
    let truth = truth();
    assert_eq!(report["episodes"].as_u64(), Some(EPISODES));
    assert_eq!(report["warnings"].as_array().unwrap().len(), 0, "{report}");
    let dataset = Dataset::open(&out);
    check_labels(&dataset, &truth);
    check_rows(&dataset, &truth);

    // What was recorded and ingested in another number of threads is the same, to the byte.
    let (logs_too, out_too) = (dir.path().join("logs-too"), dir.path().join("dataset-too"));
    collect(&logs_too, &["--jobs", "3"]);
    run(&contract, &out_too, &[&logs_too], &["--jobs", "1"], 0);
    check_same(&out, &out_too);
}
