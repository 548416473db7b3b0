//! What a run learns, and that it says what it did not.

use std::path::Path;

use gawm_train::metrics::{Record, ValidationRecord, read};

use crate::memory::{World, config, finish, hello};

fn validations(folder: &Path) -> Vec<ValidationRecord> {
    let records = read(&folder.join("metrics.jsonl")).unwrap();
    let validation = |record| match record {
        Record::Validation(validation) => Some(validation),
        Record::Train(_) => None,
    };
    records.into_iter().filter_map(validation).collect()
}

fn skill(record: &ValidationRecord, term: &str) -> f64 {
    let term = record.terms.iter().find(|found| found.term == term).unwrap();
    term.baseline.as_ref().unwrap().skill
}

#[test]
fn a_small_world_is_learned_and_its_shuffled_states_are_not() {
    let mut skills = Vec::new();
    let mut texts = Vec::new();
    for preset in ["sa-idm", "sa-shuffled"] {
        let folder = tempfile::tempdir().unwrap();
        let mut config = config(&format!("[objectives]\npreset = {preset:?}"));
        config.train.steps = 600;
        config.train.validate_every = 200;
        let hello = hello(&config);
        finish(folder.path(), &config, &mut World::new(&hello));
        let records = validations(folder.path());
        assert_eq!(records.iter().map(|record| record.step).collect::<Vec<_>>(), [200, 400, 600]);
        let last = records.last().unwrap();
        assert!(last.states.len() == 2 && last.actions.len() == 2 && last.clips == 16, "{last:?}");
        skills.push((skill(last, "state-alignment"), last.skill_drop));
        texts.push(std::fs::read_to_string(folder.path().join("summary.txt")).unwrap());
        assert!(folder.path().join("checkpoints/best.safetensors").exists());
    }
    let [(states, drop), (shuffled_states, _)] = skills[..] else { unreachable!() };
    assert!(states > 0.3, "skill of states {states}\n{}", texts[0]);
    assert!(drop > 0.0, "actions do not matter: {drop}\n{}", texts[0]);
    assert!(shuffled_states < 0.1, "skill of shuffled states {shuffled_states}\n{}", texts[1]);
    let verdict =
        |text: &str| text.lines().find(|line| line.starts_with("  state-alignment ")).unwrap().to_owned();
    assert!(verdict(&texts[0]).ends_with(" learned"), "{}", texts[0]);
    assert!(!verdict(&texts[1]).ends_with(" learned"), "{}", texts[1]);
}

#[test]
fn latents_of_equal_frames_raise_the_alarm() {
    let folder = tempfile::tempdir().unwrap();
    let config = config("");
    let mut world = World::new(&hello(&config));
    world.change = |_, sections| sections.frames.fill(7);
    finish(folder.path(), &config, &mut world);
    let records = validations(folder.path());
    assert!(records.iter().all(|record| record.collapse.is_some()), "{records:?}");
    let summary = std::fs::read_to_string(folder.path().join("summary.txt")).unwrap();
    assert!(summary.contains("ALARM") && summary.contains("NOT LEARNED"), "{summary}");
}

#[test]
fn the_run_folder_holds_what_it_must() {
    let folder = tempfile::tempdir().unwrap();
    let config = config("");
    finish(folder.path(), &config, &mut World::new(&hello(&config)));
    let text = |name: &str| std::fs::read_to_string(folder.path().join(name)).unwrap();
    assert!(text("config.toml").contains("steps = 12"));
    assert!(text("hello.json").contains("fitted_on"));
    let run: serde_json::Value = serde_json::from_str(&text("run.json")).unwrap();
    assert_eq!(run["format_version"], 1);
    assert!(run["git"].as_str().unwrap().len() >= 7 && run["parameters"].as_u64().unwrap() > 1000);
    let steps = text("metrics.jsonl").lines().filter(|line| line.contains("\"kind\":\"train\"")).count();
    assert_eq!(steps, 12);
    for curves in ["model", "constant", "identity"] {
        let files = folder.path().join("tensorboard").join(curves).read_dir().unwrap().count();
        assert_eq!(files, 1, "{curves}");
    }
    let path = folder.path().join("checkpoints/last.safetensors");
    let checkpoint = gawm_model::checkpoint::load(&path, &gawm_model::Device::Cpu).unwrap();
    let statistics: serde_json::Value = serde_json::from_str(&checkpoint.about.statistics.unwrap()).unwrap();
    assert_eq!(statistics["action"]["dims"][0]["name"], "vx");
    assert_eq!(checkpoint.optimizer.unwrap().step_count(), 12);
    assert!(checkpoint.about.notes["config"].contains("steps = 12"));
}
