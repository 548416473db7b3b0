//! `gawm-ingest` from the outside: what a user types, what comes back, what lies on disk.

#![expect(clippy::unwrap_used, reason = "a test that lacks what it needs has failed")]

mod support;

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use serde_json::Value;
use support::{
    Dataset, check_same, code, demo_contract, demo_log, files, ingest, lost, program, run, stderr, stdout,
    suggest, text,
};

/// Logs that differ in the name of the library that wrote them, hence in their hash, and in nothing else.
fn variants(folder: &Path, n: usize) -> Vec<PathBuf> {
    let bytes = std::fs::read(demo_log()).unwrap();
    let name = b"mcap-explorer demo";
    let at = bytes.windows(name.len()).position(|window| window == name).unwrap();
    (0..n)
        .map(|k| {
            let mut bytes = bytes.clone();
            bytes[at + name.len() - 1] = b'0' + k as u8;
            let path = folder.join(format!("log{k}.mcap"));
            std::fs::write(&path, bytes).unwrap();
            path
        })
        .collect()
}

fn refs(paths: &[PathBuf]) -> Vec<&Path> {
    paths.iter().map(PathBuf::as_path).collect()
}

#[test]
fn the_first_command_of_the_readme() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("demo");
    let output = ingest(&[
        "run",
        "--config",
        "pipelines/demo.toml",
        "--out",
        text(&out),
        "fixtures/mcap-explorer-demo/demo.mcap",
    ]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let said = stdout(&output);
    assert!(said.contains("1 episodes, 30 frames at 10 Hz"), "{said}");
    assert!(said.contains("observation.images.front") && said.contains("160x120"), "{said}");
    let info: Value = serde_json::from_slice(&std::fs::read(out.join("meta/info.json")).unwrap()).unwrap();
    assert_eq!((&info["total_frames"], &info["fps"]), (&Value::from(30), &Value::from(10)));
    let dataset = Dataset::open(&out);
    assert_eq!(dataset.images("observation.images.front").len(), 30);
    assert_eq!(dataset.episode_column("operator"), ["mcap-explorer"]);
    let x = dataset.values("observation.state", "position_x");
    let action = dataset.values("action", "position_x");
    assert_eq!(action[..29], x[1..], "the derived action is the next state");
    let valid = dataset.bools("gawm.valid.action");
    assert!(valid[..29].iter().all(|valid| *valid) && !valid[29]);
}

#[test]
fn what_suggest_writes_runs_unedited() {
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("suggested.toml");
    suggest(&[&demo_log()], &contract);
    let report = run(&contract, &folder.path().join("out"), &[&demo_log()], &[], 0);
    assert_eq!((report["episodes"].as_u64(), report["frames"].as_u64()), (Some(1), Some(30)));
}

#[test]
fn the_bytes_are_the_same_at_any_number_of_jobs() {
    let folder = tempfile::tempdir().unwrap();
    let (a, b) = (folder.path().join("a"), folder.path().join("b"));
    run(&demo_contract(), &a, &[&demo_log()], &["--jobs", "1"], 0);
    run(&demo_contract(), &b, &[&demo_log()], &["--jobs", "3"], 0);
    check_same(&a, &b);
}

#[test]
fn appending_one_by_one_is_the_same_as_all_at_once() {
    let folder = tempfile::tempdir().unwrap();
    let logs = variants(folder.path(), 3);
    let (once, appended) = (folder.path().join("once"), folder.path().join("appended"));
    run(&demo_contract(), &once, &refs(&logs), &[], 0);
    run(&demo_contract(), &appended, &[&logs[0]], &[], 0);
    run(&demo_contract(), &appended, &[&logs[1]], &["--append"], 0);
    let report = run(&demo_contract(), &appended, &refs(&logs), &["--append"], 0);
    check_same(&once, &appended);
    let status: Vec<&str> =
        report["files"].as_array().unwrap().iter().map(|file| file["status"].as_str().unwrap()).collect();
    assert_eq!(status, ["already_there", "already_there", "ok"]);
}

/// Starts a run, kills it as soon as `is_time` says so, resumes it, and expects the bytes of an undisturbed one.
fn check_killed(logs: &[PathBuf], whole: &Path, resumed: &Path, is_time: impl Fn() -> bool) {
    let mut args = vec!["run", "--config", "pipelines/demo.toml", "--out", text(resumed)];
    args.extend(logs.iter().map(|log| text(log)));
    let mut child = Command::new(program())
        .args(&args)
        .current_dir(support::root())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .unwrap();
    // The run may be over before the kill comes: that must resume, too.
    while child.try_wait().unwrap().is_none() && !is_time() {
        std::thread::yield_now();
    }
    child.kill().ok();
    child.wait().unwrap();
    run(&demo_contract(), resumed, &refs(logs), &["--resume"], 0);
    check_same(whole, resumed);
}

#[test]
fn a_killed_run_resumes_to_the_same_bytes() {
    let folder = tempfile::tempdir().unwrap();
    let logs = variants(folder.path(), 6);
    let whole = folder.path().join("whole");
    run(&demo_contract(), &whole, &refs(&logs), &[], 0);
    // At the first, the third and the last data file, and when the meta files are written.
    for (n, wanted) in [
        "data/chunk-000/file-000.parquet.tmp",
        "data/chunk-000/file-002.parquet.tmp",
        "data/chunk-000/file-005.parquet.tmp",
        "meta/tasks.parquet",
        "gawm/encoded",
    ]
    .into_iter()
    .enumerate()
    {
        let resumed = folder.path().join(format!("resumed-{n}"));
        check_killed(&logs, &whole, &resumed, || resumed.join(wanted).exists());
    }
}

/// Asks a running program to stop.
#[cfg(unix)]
fn interrupt(child: &std::process::Child) {
    let status = Command::new("kill").args(["-INT", &child.id().to_string()]).status().unwrap();
    assert!(status.success());
}

#[cfg(unix)]
#[test]
fn an_interrupted_run_says_so_and_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let logs = variants(folder.path(), 10);
    let (whole, out) = (folder.path().join("whole"), folder.path().join("out"));
    run(&demo_contract(), &whole, &refs(&logs), &[], 0);
    let mut args = vec!["run", "--config", "pipelines/demo.toml", "--out", text(&out)];
    args.extend(logs.iter().map(|log| text(log)));
    let child = Command::new(program())
        .args(&args)
        .current_dir(support::root())
        .stdout(Stdio::null())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    while !out.join("data/chunk-000/file-001.parquet.tmp").exists() {
        std::thread::yield_now();
    }
    interrupt(&child);
    let output = child.wait_with_output().unwrap();
    let said = stderr(&output);
    // Whoever is asked to stop when nothing is left to do has finished.
    if code(&output) != 0 {
        assert_eq!(code(&output), 130, "{said}");
        assert!(said.contains("--resume"), "{said}");
        assert!(!out.join("meta/info.json").exists());
    }
    run(&demo_contract(), &out, &refs(&logs), &["--resume"], 0);
    check_same(&whole, &out);
}

/// A limit on the size of files stands for a full disk.
#[cfg(unix)]
#[test]
fn a_full_disk_is_an_error_and_resumes() {
    let folder = tempfile::tempdir().unwrap();
    let logs = variants(folder.path(), 2);
    let (whole, out) = (folder.path().join("whole"), folder.path().join("out"));
    run(&demo_contract(), &whole, &refs(&logs), &[], 0);
    let limited = "trap '' XFSZ; ulimit -f 24; exec \"$0\" \"$@\"";
    let output = Command::new("sh")
        .args(["-c", limited, text(program()), "run", "--config", "pipelines/demo.toml", "--out", text(&out)])
        .args(logs.iter().map(|log| text(log)))
        .current_dir(support::root())
        .output()
        .unwrap();
    let said = stderr(&output);
    assert_eq!(code(&output), 1, "{said}");
    assert!(said.contains("File too large") && said.contains("file-000.parquet"), "{said}");
    assert!(said.contains("--resume") && !said.contains("panicked"), "{said}");
    run(&demo_contract(), &out, &refs(&logs), &["--resume"], 0);
    check_same(&whole, &out);
}

#[test]
fn shards_divide_the_recordings() {
    let folder = tempfile::tempdir().unwrap();
    let logs = variants(folder.path(), 3);
    let mut taken = Vec::new();
    for (shard, expected) in [("0/2", 2), ("1/2", 1)] {
        let report = run(
            &demo_contract(),
            &folder.path().join(shard.replace('/', "-")),
            &refs(&logs),
            &["--shard", shard],
            0,
        );
        assert_eq!(report["episodes"].as_u64(), Some(expected));
        taken.extend(
            report["files"].as_array().unwrap().iter().map(|file| file["path"].as_str().unwrap().to_owned()),
        );
    }
    taken.sort();
    assert_eq!(taken.len(), 3);
    taken.dedup();
    assert_eq!(taken.len(), 3);
}

#[test]
fn an_output_that_exists_is_not_touched() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    run(&demo_contract(), &out, &[&demo_log()], &[], 0);
    let before = files(&out);
    let output = ingest(&["run", "--config", "pipelines/demo.toml", "--out", text(&out), text(&demo_log())]);
    assert_eq!(code(&output), 2, "{}", stderr(&output));
    assert!(stderr(&output).contains("--append"), "{}", stderr(&output));
    assert!(before == files(&out));
}

#[test]
fn nothing_remains_of_a_run_that_made_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let contract = folder.path().join("c.toml");
    let written = std::fs::read_to_string(demo_contract()).unwrap();
    std::fs::write(&contract, written.replace("/odom", "/none")).unwrap();
    let output = ingest(&["run", "--config", text(&contract), "--out", text(&out), text(&demo_log())]);
    assert_eq!(code(&output), 1);
    let said = stderr(&output);
    assert!(said.contains("/none") && said.contains("/imu/front") && said.contains("hint:"), "{said}");
    assert!(!out.exists());
}

/// A contract, made from the demo's by replacing a text, fails with a code and says certain words.
fn check_contract(from: &str, to: &str, expected: i32, words: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let contract = folder.path().join("c.toml");
    let written = std::fs::read_to_string(demo_contract()).unwrap();
    assert!(written.contains(from), "{from}");
    std::fs::write(&contract, written.replacen(from, to, 1)).unwrap();
    let out = folder.path().join("out");
    let output = ingest(&["run", "--config", text(&contract), "--out", text(&out), text(&demo_log())]);
    let said = stderr(&output);
    assert_eq!(code(&output), expected, "{from} -> {to}: {said}");
    for word in words {
        assert!(said.contains(word), "{from} -> {to}: expected {word:?} in: {said}");
    }
    assert!(!said.contains("panicked"), "{said}");
}

#[test]
fn contracts_that_cannot_be_used() {
    check_contract("rate_hz = 10", "rate_hz = -1", 2, &["ticks.rate_hz", "0.01", "-1"]);
    check_contract("rate_hz = 10", "rate = 10", 2, &["unknown field `rate`", "rate_hz"]);
    check_contract("rate_hz = 10", "rate_hz = 12.5", 2, &["ticks.fps"]);
    check_contract("rate_hz = 10", "rate_hz = \"x\"", 2, &["invalid type", "expected f64"]);
    check_contract("topic = \"/imu/front\"", "topic = \"/imu/*/x\"", 2, &["/imu/*/x", "/imu/front"]);
    check_contract("linear_acceleration.x", "linear_acc.x", 1, &["linear_acc", "linear_acceleration"]);
    check_contract("linear_acceleration.x", "a[", 2, &["bad field path", "character 2"]);
    check_contract("tolerance_ms = 300", "", 2, &["stream[3] (front).tolerance_ms", "hold"]);
    check_contract("name = \"velocity\"", "name = \"position\"", 2, &["unique name"]);
    check_contract("from = \"observation.state\"", "from = \"observation.x\"", 2, &["observation.state"]);
    check_contract("unit = \"m\"", "kind = \"quaternion\"", 2, &["order"]);
    check_contract("unit = \"m\"", "kind = \"quaternion\"\norder = \"xyzw\"", 2, &["multiple of 4"]);
    check_contract("resize = [160, 120]", "resize = [0, 120]", 2, &["image.resize"]);
    check_contract("version = 1", "version = 2", 2, &["version"]);
    check_contract("feature = \"observation.imu\"", "feature = \"a/b\"", 2, &["a/b"]);
    check_contract(
        "[ingest.labels]",
        "[ingest.episodes]\nfrom = \"marker\"\n[ingest.labels]",
        2,
        &["episodes.topic"],
    );
    check_contract("task = \"drive", "path_pattern = \"(\"\ntask = \"drive", 2, &["path_pattern"]);
}

#[test]
fn wrong_arguments_are_exit_code_2() {
    for args in [
        &["run"][..],
        &["run", "--config", "none.toml", "--out", "x", "y.mcap"],
        &["run", "--config", "pipelines/demo.toml", "--out", "x", "--shard", "2/2", "y.mcap"],
        &["run", "--config", "pipelines/demo.toml", "--out", "x", "--jobs", "0", "y.mcap"],
        &["run", "--config", "pipelines/demo.toml", "--out", "x", "--resume", "--append", "y.mcap"],
        &["run", "--config", "pipelines/demo.toml", "--out", "x", "--set", "ticks", "y.mcap"],
        &["run", "--config", "pipelines/demo.toml", "--out", "x", "--set", "tick.rate_hz=3", "y.mcap"],
        &["frobnicate"],
    ] {
        let output = ingest(args);
        assert_eq!(code(&output), 2, "{args:?}: {}", stderr(&output));
    }
}

/// Bytes that are no usable log: refused with exit code 1, saying certain words.
fn check_refused(bytes: &[u8], words: &[&str]) {
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("x.mcap");
    std::fs::write(&log, bytes).unwrap();
    let out = folder.path().join("out");
    let output = ingest(&["run", "--config", "pipelines/demo.toml", "--out", text(&out), text(&log)]);
    let said = stderr(&output);
    assert_eq!(code(&output), 1, "{said}");
    for word in words {
        assert!(said.contains(word), "expected {word:?} in: {said}");
    }
    assert!(!out.exists());
}

#[test]
fn files_that_are_no_logs() {
    check_refused(b"", &["empty"]);
    check_refused(b"hello, world: this is no log", &["not an MCAP file"]);
    check_refused(b"SQLite format 3\0 and so on, as a bag of the older kind begins", &["sqlite"]);
    check_refused(b"\x89MCAP0\n and what follows went through a text-mode copy", &["CR LF"]);
    let output = ingest(&["run", "--config", "pipelines/demo.toml", "--out", "never", "no-such-file.mcap"]);
    assert_eq!(code(&output), 1, "{}", stderr(&output));
}

#[test]
fn a_cut_log_gives_what_is_left_and_says_so() {
    let folder = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(demo_log()).unwrap();
    let log = folder.path().join("cut.mcap");
    std::fs::write(&log, &bytes[..bytes.len() / 2]).unwrap();
    let report = run(&demo_contract(), &folder.path().join("out"), &[&log], &[], 3);
    assert_eq!(report["files"][0]["status"], "loss");
    let frames = report["frames"].as_u64().unwrap();
    assert!((8..30).contains(&frames), "{frames}");
    let output = ingest(&[
        "run",
        "--config",
        "pipelines/demo.toml",
        "--out",
        text(&folder.path().join("strict")),
        "--strict",
        text(&log),
    ]);
    assert_eq!(code(&output), 1);
}

#[test]
fn one_refused_input_does_not_stop_the_others() {
    let folder = tempfile::tempdir().unwrap();
    let bad = folder.path().join("bad.mcap");
    std::fs::write(&bad, b"").unwrap();
    let report = run(&demo_contract(), &folder.path().join("out"), &[&bad, &demo_log()], &[], 3);
    let status: Vec<&Value> =
        report["files"].as_array().unwrap().iter().map(|file| &file["status"]).collect();
    assert_eq!(status, ["refused", "ok"]);
    assert_eq!(lost(&report, "/odom", "duplicate"), 0);
}

#[test]
fn the_resolved_contract_runs_like_the_written_one() {
    let folder = tempfile::tempdir().unwrap();
    let output =
        ingest(&["run", "--config", "pipelines/demo.toml", "--print-config", "--set", "ticks.rate_hz=5"]);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let contract = folder.path().join("resolved.toml");
    std::fs::write(&contract, &output.stdout).unwrap();
    let report = run(&contract, &folder.path().join("a"), &[&demo_log()], &[], 0);
    assert_eq!(report["frames"].as_u64(), Some(15));
    run(&demo_contract(), &folder.path().join("b"), &[&demo_log()], &["--set", "ticks.rate_hz=5"], 0);
    let (a, b) = (files(&folder.path().join("a")), files(&folder.path().join("b")));
    assert!(a == b);
}

#[test]
fn explain_shows_the_messages_behind_a_number() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    run(&demo_contract(), &out, &[&demo_log()], &[], 0);
    let output = ingest(&["explain", text(&out), "0", "5", "position_x", "--log", text(&demo_log())]);
    assert_eq!(code(&output), 2, "the name stands for a state and an action: {}", stdout(&output));
    assert!(stderr(&output).contains("observation.state.position_x"), "{}", stderr(&output));
    let dim = "observation.state.position_x";
    let output = ingest(&["explain", text(&out), "0", "5", dim, "--log", text(&demo_log())]);
    let said = stdout(&output);
    assert_eq!(code(&output), 0, "{}", stderr(&output));
    let value = Dataset::open(&out).values("observation.state", "position_x")[5];
    assert!(said.contains(&format!("{value:?} m, valid")), "{said}");
    let used = said.lines().find(|line| line.trim_start().starts_with('>')).unwrap();
    assert!(used.contains(&format!("> {value:?}  /odom in demo.mcap")), "{said}");
    assert!(said.contains("encoding: gawm.state[0]"), "{said}");
    let without = stdout(&ingest(&["explain", text(&out), "0", "5", dim]));
    assert!(without.contains("--log"), "{without}");
    for (episode, frame, dim, words) in [
        ("1", "0", dim, "episodes 0 to 0"),
        ("0", "30", dim, "which has 30"),
        ("0", "0", "nothing", "position_y"),
    ] {
        let output = ingest(&["explain", text(&out), episode, frame, dim]);
        assert_eq!(code(&output), 2);
        assert!(stderr(&output).contains(words), "{}", stderr(&output));
    }
}

#[test]
fn explain_goes_into_derived_actions() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    run(&demo_contract(), &out, &[&demo_log()], &[], 0);
    let explain = |frame: &str| {
        let output =
            ingest(&["explain", text(&out), "0", frame, "action.position_x", "--log", text(&demo_log())]);
        assert_eq!(code(&output), 0, "{}", stderr(&output));
        stdout(&output)
    };
    let state = Dataset::open(&out).values("observation.state", "position_x");
    let said = explain("5");
    assert!(said.contains("derived from observation.state: next"), "{said}");
    assert!(said.contains("\"position_x\" in frame 6"), "{said}");
    assert!(said.contains(&format!("> {:?}  /odom in demo.mcap", state[6])), "{said}");
    assert!(said.contains("encoding: gawm.action[0] \"position_x\" (identity of position_x)"), "{said}");
    let said = explain("29");
    assert!(said.contains("not valid") && said.contains("the one of frame 28 is repeated"), "{said}");
    assert!(said.contains(&format!("> {:?}  /odom in demo.mcap", state[29])), "{said}");
}

#[cfg(target_os = "linux")]
#[test]
fn results_that_cannot_be_written_are_an_error() {
    let full = || std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    for args in [&["suggest", text(&demo_log())][..], &["inspect", text(&demo_log())]] {
        let output = Command::new(program())
            .args(args)
            .stdout(full())
            .stderr(Stdio::piped())
            .spawn()
            .unwrap()
            .wait_with_output()
            .unwrap();
        assert_eq!(code(&output), 1, "{args:?}");
        assert!(stderr(&output).contains("cannot write the result to stdout"), "{}", stderr(&output));
    }
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let args = ["run", "--config", "pipelines/demo.toml", "--report", "/no/such/folder/r.json", "--out"];
    let output = ingest(&[&args[..], &[text(&out), text(&demo_log())]].concat());
    assert_eq!(code(&output), 1);
    assert!(stderr(&output).contains("/no/such/folder/r.json"), "{}", stderr(&output));
    assert!(!out.exists(), "said before the work, not after it");
}

#[test]
fn inspect_and_completions_answer() {
    let output = ingest(&["inspect", "--format", "json", text(&demo_log())]);
    assert_eq!(code(&output), 0);
    let report: Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(report["files"][0]["messages"], 330);
    assert_eq!(report["files"][0]["channels"].as_array().unwrap().len(), 3);
    assert!(stdout(&ingest(&["completions", "bash"])).contains("gawm-ingest"));
}
