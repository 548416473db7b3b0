//! Runs that are interrupted, and runs with other threads, give the same bytes.

use std::path::Path;

use gawm_train::interrupt::Interrupt;
use gawm_train::trainer::Outcome;

use crate::memory::{World, config, finish, hello, train};

/// Metrics and both checkpoints.
fn bytes(folder: &Path) -> [Vec<u8>; 3] {
    ["metrics.jsonl", "checkpoints/last.safetensors", "checkpoints/best.safetensors"]
        .map(|name| std::fs::read(folder.join(name)).unwrap())
}

#[test]
fn a_run_that_is_interrupted_anywhere_goes_on_to_the_bit() {
    let config = config("");
    let hello = hello(&config);
    let whole = tempfile::tempdir().unwrap();
    finish(whole.path(), &config, &mut World::new(&hello));
    let expected = bytes(whole.path());
    let folder = tempfile::tempdir().unwrap();
    // Before the first step, after one, at and within validations, in the last one.
    for (index, at) in [0, 1, 4, 5, 6, 7, 12, 13, 14, 17].into_iter().enumerate() {
        let path = folder.path().join(index.to_string());
        let interrupt = Interrupt::default();
        let mut world = World::new(&hello);
        world.interrupt_at = Some((at, interrupt.clone()));
        let (outcome, trainer) = train(&path, &config, &mut world, &interrupt).unwrap();
        assert!(matches!(outcome, Outcome::Interrupted { .. }), "batch {at}: {outcome:?}");
        assert!(trainer.state().resume_at <= at);
        drop(trainer);
        finish(&path, &config, &mut World::new(&hello));
        let got = bytes(&path);
        assert!(got == expected, "interrupted at batch {at}: metrics\n{}", String::from_utf8_lossy(&got[0]));
    }
}

#[test]
fn half_a_line_and_a_stale_file_of_a_killed_process_are_no_harm() {
    let config = config("");
    let hello = hello(&config);
    let (whole, folder) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    finish(whole.path(), &config, &mut World::new(&hello));
    let interrupt = Interrupt::default();
    let mut world = World::new(&hello);
    world.interrupt_at = Some((8, interrupt.clone()));
    train(folder.path(), &config, &mut world, &interrupt).unwrap();
    // As a kill at a later step leaves it: records behind the checkpoint, half a line, half a checkpoint.
    let metrics = folder.path().join("metrics.jsonl");
    let later = std::fs::read(whole.path().join("metrics.jsonl")).unwrap();
    std::fs::write(&metrics, &later[..later.len() - 40]).unwrap();
    let stale = folder.path().join("checkpoints/last.safetensors.tmp-12345");
    std::fs::write(&stale, b"half").unwrap();
    finish(folder.path(), &config, &mut World::new(&hello));
    assert!(!stale.exists());
    assert!(bytes(folder.path()) == bytes(whole.path()));
}

/// Runs in a process of its own for [`threads_do_not_change_a_run`].
#[test]
fn prints_the_hash_of_a_run() {
    let config = config("");
    let folder = tempfile::tempdir().unwrap();
    finish(folder.path(), &config, &mut World::new(&hello(&config)));
    let hash = |bytes: Vec<u8>| gawm_schema::ContentHash::of(&bytes).to_string();
    println!("hashes: {:?}", bytes(folder.path()).map(hash));
}

#[test]
fn threads_do_not_change_a_run() {
    let with_threads = |count: &str| {
        let mut command = std::process::Command::new(std::env::current_exe().unwrap());
        command
            .args(["--exact", "determinism::prints_the_hash_of_a_run", "--nocapture"])
            .env("RAYON_NUM_THREADS", count);
        let output = String::from_utf8(command.output().unwrap().stdout).unwrap();
        let line =
            output.lines().find(|line| line.contains("hashes: ")).unwrap_or_else(|| panic!("{output}"));
        line[line.find("hashes: ").unwrap()..].to_owned()
    };
    let one = with_threads("1");
    assert_eq!(with_threads("3"), one);
}
