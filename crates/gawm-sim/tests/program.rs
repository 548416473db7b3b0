//! The program from the outside: exit codes, configuration, interrupts, closed pipes.
#![expect(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::path::Path;
use std::process::{Command, Output, Stdio};

fn program() -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_gawm-sim"));
    command.env("NO_COLOR", "1");
    command
}

fn run(arguments: &[&str]) -> Output {
    program().args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Exit code, and words on stderr.
fn check_fails(arguments: &[&str], code: i32, words: &[&str]) {
    let output = run(arguments);
    let said = text(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{arguments:?}: {said}");
    for word in words {
        assert!(said.contains(word), "{arguments:?}: expected {word:?} in {said}");
    }
}

fn folder(dir: &Path, name: &str) -> String {
    dir.join(name).to_str().unwrap().to_owned()
}

#[test]
fn what_is_printed_collects_the_same_logs() {
    let dir = tempfile::tempdir().unwrap();
    let wanted = ["collect", "--episodes", "2", "--seed", "5", "--set", "max_steps=4", "--size", "32"];
    let printed = run(&[&wanted[..], &["--print-config"]].concat());
    assert_eq!(printed.status.code(), Some(0), "{}", text(&printed.stderr));
    assert!(text(&printed.stdout).contains("max_steps = 4"), "{}", text(&printed.stdout));
    let config = dir.path().join("p.toml");
    std::fs::write(&config, &printed.stdout).unwrap();
    let (a, b) = (folder(dir.path(), "a"), folder(dir.path(), "b"));
    let first = run(&[&wanted[..], &["--out", &a]].concat());
    let second = run(&["collect", "--config", config.to_str().unwrap(), "--out", &b, "--quiet"]);
    assert_eq!((first.status.code(), second.status.code()), (Some(0), Some(0)), "{}", text(&second.stderr));
    assert!(second.stderr.is_empty(), "{}", text(&second.stderr));
    assert!(text(&second.stdout).contains("1 logs, 2 episodes"), "{}", text(&second.stdout));
    for name in ["two-room-000000.mcap", "sim.toml"] {
        let of = |folder: &str| std::fs::read(Path::new(folder).join(name)).unwrap();
        assert!(of(&a) == of(&b), "{name}");
    }
}

#[test]
fn unusable_arguments_are_2_and_say_what_was_expected() {
    let dir = tempfile::tempdir().unwrap();
    let out = folder(dir.path(), "out");
    check_fails(&["collect", "--episodes", "1", "--out", &out], 2, &["seed: expected a number (--seed N)"]);
    check_fails(
        &["collect", "--episodes", "1", "--seed", "1", "--set", "sede=1", "--out", &out],
        2,
        &["sede"],
    );
    check_fails(&["collect", "--config", "absent.toml", "--out", &out], 2, &["cannot read absent.toml"]);
    check_fails(&["collect", "--episodes", "0", "--seed", "1", "--out", &out], 2, &["episodes"]);
    check_fails(&["collect", "--seed", "1"], 2, &["--out"]);
    let here = dir.path().to_str().unwrap();
    std::fs::write(dir.path().join("mine.txt"), "").unwrap();
    check_fails(&["collect", "--episodes", "1", "--seed", "1", "--out", here], 2, &["mine.txt", "hint:"]);
}

#[test]
fn completions_and_help_are_results() {
    for arguments in [["completions", "bash"].as_slice(), &["--help"], &["collect", "--help"]] {
        let output = run(arguments);
        assert_eq!(output.status.code(), Some(0), "{arguments:?}");
        assert!(text(&output.stdout).contains("gawm-sim"), "{arguments:?}");
    }
}

#[cfg(unix)]
#[test]
fn an_interrupt_is_130_and_a_closed_pipe_is_none() {
    let dir = tempfile::tempdir().unwrap();
    let out = folder(dir.path(), "long");
    // More episodes than can be done before the interrupt comes.
    let mut child = program()
        .args(["collect", "--episodes", "1000000", "--seed", "1", "--jobs", "1", "--out", &out])
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // The first log is begun after the handler is set.
    while !Path::new(&out).join("two-room-000000.mcap.partial").exists() {
        assert!(child.try_wait().unwrap().is_none(), "ended early");
        std::thread::yield_now();
    }
    assert!(Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap().success());
    assert_eq!(child.wait().unwrap().code(), Some(130));
    let left: Vec<_> = std::fs::read_dir(&out).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert!(left.iter().all(|path| path.extension().is_some_and(|ending| ending == "mcap")), "{left:?}");

    let out = folder(dir.path(), "closed");
    let mut child = program()
        .args(["collect", "--episodes", "1", "--seed", "1", "--set", "max_steps=2", "--out", &out])
        .stdout(Stdio::piped())
        .spawn()
        .unwrap();
    drop(child.stdout.take());
    assert_eq!(child.wait().unwrap().code(), Some(0), "a reader that has gone away is no error");
}
