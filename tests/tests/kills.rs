//! Training through real processes: what kills, Ctrl-C and other numbers of loaders change (nothing).
//!
//! The number of kills is `GAWM_KILLS` (6 without it), their seed `GAWM_KILL_SEED`; docs/training.md has the command for
//! a hundred.
#![expect(clippy::unwrap_used, reason = "a test that cannot run its programs has failed")]

use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, ChildStderr, Command, Output, Stdio};
use std::sync::OnceLock;

/// Sections for runs of a second: the micro model, two loaders, saves and validations every few steps.
const PIPELINE: &str = r#"
[loader]
batch = 4
image_size = [16, 16]
loaders = 2
slots = 2

[model]
preset = "micro"

[train]
steps = 16
rate = 1e-3
validate_every = 6
validation_batches = 2
checkpoint_every = 2
log_every = 1
device = "cpu"
"#;

/// A dataset, a pipeline, and what an undisturbed run made of them.
struct World {
    folder: tempfile::TempDir,
    expected: Products,
    /// Lines that an undisturbed run says.
    lines: usize,
}

/// What must not depend on what happened to the processes.
#[derive(PartialEq)]
struct Products {
    metrics: String,
    last: Vec<u8>,
    best: Vec<u8>,
}

impl Products {
    fn of(run: &Path) -> Products {
        let checkpoint = |name: &str| std::fs::read(run.join("checkpoints").join(name)).unwrap();
        Products {
            metrics: std::fs::read_to_string(run.join("metrics.jsonl")).unwrap(),
            last: checkpoint("last.safetensors"),
            best: checkpoint("best.safetensors"),
        }
    }
}

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn check_program(program: &str, arguments: &[&str]) {
    let output = Command::new(program).args(arguments).current_dir(root()).output().unwrap();
    assert!(output.status.success(), "{program} {arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
}

/// Logs of the simulator, ingested, trained on without disturbance: once for all tests.
fn world() -> &'static World {
    static WORLD: OnceLock<World> = OnceLock::new();
    WORLD.get_or_init(|| {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
        let (logs, data) = (path("logs"), path("data"));
        let sim =
            ["--env", "two-room", "--episodes", "12", "--seed", "3", "--size", "16", "--max-steps", "30"];
        check_program(
            env!("CARGO_BIN_EXE_e2e-gawm-sim"),
            &[&["collect"], &sim[..], &["--out", &logs]].concat(),
        );
        let mut ingest = vec!["run", "--config", "pipelines/tworoom-ingest.toml", "--out", &data];
        // With the usual tenth, none of so few episodes would be held out.
        ingest.extend(["--set", "split.validation=0.3"]);
        let mut files: Vec<String> = Path::new(&logs)
            .read_dir()
            .unwrap()
            .map(|entry| entry.unwrap().path().to_str().unwrap().to_owned())
            .filter(|path| path.ends_with(".mcap"))
            .collect();
        files.sort();
        ingest.extend(files.iter().map(String::as_str));
        check_program(env!("CARGO_BIN_EXE_e2e-gawm-ingest"), &ingest);
        std::fs::write(folder.path().join("p.toml"), PIPELINE).unwrap();

        let run = folder.path().join("undisturbed");
        let lines = lines_of(start(folder.path(), &run, &[])).1;
        World { expected: Products::of(&run), lines: lines.len(), folder }
    })
}

impl World {
    fn run(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    fn check_equal(&self, run: &Path, what: &str) {
        let got = Products::of(run);
        assert_eq!(got.metrics, self.expected.metrics, "{what}: other metrics");
        assert!(got == self.expected, "{what}: other checkpoints");
    }

    /// Nobody is alive and nothing is left.
    fn check_clean(&self, run: &Path) {
        let output = Command::new(env!("CARGO_BIN_EXE_e2e-gawm-loader"))
            .args(["clean", "--format", "json"])
            .env("TMPDIR", place(run))
            .output()
            .unwrap();
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert_eq!((&report["files"], &report["alive"]), (&0.into(), &serde_json::json!([])), "{report}");
    }
}

/// The folder for temporary files of a run: its locks and names in shared memory are its own.
fn place(run: &Path) -> PathBuf {
    let place = run.with_extension("tmp");
    std::fs::create_dir_all(&place).unwrap();
    place
}

fn command(folder: &Path, run: &Path, more: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_e2e-gawm-train"));
    command
        .args(["--verbose", "--loader-program", env!("CARGO_BIN_EXE_e2e-gawm-loader")])
        .args(["--config", folder.join("p.toml").to_str().unwrap()])
        .args(["--data", folder.join("data").to_str().unwrap()])
        .args(["--out", run.to_str().unwrap()])
        .args(more)
        .env("TMPDIR", place(run));
    if run.join("config.toml").exists() {
        command.arg("--resume");
    }
    command
}

fn start(folder: &Path, run: &Path, more: &[&str]) -> Child {
    command(folder, run, more).stdout(Stdio::null()).stderr(Stdio::piped()).spawn().unwrap()
}

fn lines(child: &mut Child) -> std::io::Lines<BufReader<ChildStderr>> {
    BufReader::new(child.stderr.take().unwrap()).lines()
}

/// Waits for the end of a run and returns its exit code and what it said. The loaders write to the same pipe, so that
/// this returns when they have ended, too.
fn lines_of(mut child: Child) -> (Option<i32>, Vec<String>) {
    let lines: Vec<String> = lines(&mut child).map(Result::unwrap).collect();
    let code = child.wait().unwrap().code();
    (code, lines)
}

fn finish(world: &World, run: &Path) {
    let (code, lines) = lines_of(start(world.folder.path(), run, &[]));
    assert_eq!(code, Some(0), "{}", lines.join("\n"));
}

fn signal(name: &str, process: &str) {
    // It may have ended by itself in the meantime.
    Command::new("kill").args([name, process]).stderr(Stdio::null()).status().unwrap();
}

/// splitmix64, so that the draws are the same everywhere.
struct Random(u64);

impl Random {
    fn below(&mut self, bound: u64) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.0 ^ self.0 >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ z >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        (z ^ z >> 31) % bound
    }
}

/// Where a kill strikes.
#[derive(Debug, Clone, Copy)]
enum Target {
    Trainer,
    Loader(usize),
}

/// Starts or goes on with a run, kills the target when the run says its `line`-th line, and sees what comes of it.
/// Returns whether the run is complete.
fn run_with_kill(world: &World, run: &Path, target: Target, line: u64, spins: u64) -> bool {
    let mut child = start(world.folder.path(), run, &[]);
    let trainer = child.id().to_string();
    let mut loaders = [const { String::new() }; 2];
    let mut said = Vec::new();
    for text in lines(&mut child).map(Result::unwrap) {
        // loader K started at batch N (process P)
        if let Some(rest) = text.strip_prefix("loader ")
            && let Some((_, process)) = rest.split_once("(process ")
        {
            loaders[rest[..1].parse::<usize>().unwrap()] = process.trim_end_matches(')').to_owned();
        }
        said.push(text);
        if said.len() as u64 == line + 1 {
            // A drawn moment after the line: inside the save or the step that it announces.
            (0..spins).for_each(|_| std::hint::spin_loop());
            let process = match target {
                Target::Trainer => &trainer,
                Target::Loader(loader) => &loaders[loader],
            };
            if !process.is_empty() {
                signal("-KILL", process);
            }
        }
    }
    let status = child.wait().unwrap();
    let is_killed = matches!(target, Target::Trainer) && status.code().is_none();
    assert!(is_killed || status.success(), "{target:?} at line {line}: {status}\n{}", said.join("\n"));
    !is_killed
}

#[test]
fn kills_at_any_moment_change_no_bit() {
    let number = |name: &str, default: u64| {
        std::env::var(name).map_or(default, |text| text.parse().unwrap_or_else(|_| panic!("{name}={text}")))
    };
    let (kills, seed) = (number("GAWM_KILLS", 6), number("GAWM_KILL_SEED", 7));
    let world = world();
    let mut random = Random(seed);
    let mut done = 0;
    let mut counts = [0u64; 2];
    for index in 0.. {
        let run = world.run(&format!("killed-{index}"));
        let mut is_complete = false;
        while !is_complete && done < kills {
            let target = match random.below(4) {
                0 => Target::Loader(0),
                1 => Target::Loader(1),
                _ => Target::Trainer,
            };
            let line = random.below(world.lines as u64);
            is_complete = run_with_kill(world, &run, target, line, random.below(200_000));
            counts[usize::from(matches!(target, Target::Trainer))] += 1;
            done += 1;
        }
        if !is_complete {
            finish(world, &run);
        }
        world.check_equal(&run, &format!("seed {seed}, after {done} kills"));
        world.check_clean(&run);
        if done == kills {
            break;
        }
    }
    println!("{} kills of trainers, {} of loaders: no bit differs", counts[1], counts[0]);
}

#[test]
fn ctrl_c_saves_and_the_run_goes_on_to_the_bit() {
    let world = world();
    let run = world.run("interrupted");
    let mut child = start(world.folder.path(), &run, &[]);
    let process = child.id().to_string();
    let mut said = Vec::new();
    for line in lines(&mut child).map(Result::unwrap) {
        if line.starts_with("step 4 ") {
            signal("-INT", &process);
        }
        said.push(line);
    }
    assert_eq!(child.wait().unwrap().code(), Some(130), "{}", said.join("\n"));
    assert!(said.iter().any(|line| line.starts_with("interrupted: saved after")), "{}", said.join("\n"));
    finish(world, &run);
    world.check_equal(&run, "interrupted");
    world.check_clean(&run);
}

#[test]
fn loaders_and_threads_change_no_bit() {
    let world = world();
    for (loaders, threads) in [("1", "1"), ("3", "4")] {
        let run = world.run(&format!("loaders-{loaders}"));
        let set = format!("loader.loaders={loaders}");
        let child = start(world.folder.path(), &run, &["--set", &set, "--threads", threads]);
        let (code, lines) = lines_of(child);
        assert_eq!(code, Some(0), "{}", lines.join("\n"));
        let got = Products::of(&run);
        assert_eq!(got.metrics, world.expected.metrics, "{loaders} loaders, {threads} threads");
        // The configuration in the metadata says how many loaders there were; the tensors behind it do not.
        let tensors = |bytes: &[u8]| {
            let length = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
            bytes[8 + length..].to_vec()
        };
        assert!(tensors(&got.last) == tensors(&world.expected.last), "{loaders} loaders: other tensors");
    }
}

fn check_refused(more: &[&str], code: i32, expected: &str) {
    let world = world();
    let run = world.run(&format!("refused-{}", expected.replace(|c: char| !c.is_alphanumeric(), "-")));
    let output: Output = command(world.folder.path(), &run, more).output().unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(code), "{more:?}: {stderr}");
    assert!(stderr.contains(expected), "{more:?}: {stderr}");
}

#[test]
fn what_cannot_run_says_why() {
    check_refused(&["--set", "train.steps=0"], 2, "train.steps: expected 1 to 10^12, got 0");
    check_refused(&["--set", "loader.batch=0"], 2, "loader 0 ended before batch 0");
    check_refused(&["--set", "loader.history=4"], 2, "frames of a clip: expected 2 to 4");
    check_refused(&["--set", "train.device=gpu"], 2, "train.device");
    check_refused(&["--set", "model.encoder.depth=0"], 2, "encoder.depth");
}

#[test]
fn a_finished_run_is_not_trained_again_and_not_written_over() {
    let world = world();
    let run = world.run("undisturbed");
    let before = std::fs::metadata(run.join("checkpoints/best.safetensors")).unwrap().modified().unwrap();
    finish(world, &run);
    world.check_equal(&run, "resumed at the end");
    let after = std::fs::metadata(run.join("checkpoints/best.safetensors")).unwrap().modified().unwrap();
    assert_eq!(before, after);
    let output = Command::new(env!("CARGO_BIN_EXE_e2e-gawm-train"))
        .args(["--config", world.run("p.toml").to_str().unwrap(), "--out", run.to_str().unwrap()])
        .output()
        .unwrap();
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(2), "{stderr}");
    assert!(stderr.contains("not empty") && stderr.contains("--resume"), "{stderr}");
}

#[test]
fn loaders_started_by_hand_give_the_same_run() {
    let world = world();
    let run = world.run("by-hand");
    let child =
        start(world.folder.path(), &run, &["--service", "by-hand", "--attach", "--set", "loader.loaders=1"]);
    let length = ["--total-steps", "16", "--validate-every", "6", "--validation-batches", "2"];
    let loader = Command::new(env!("CARGO_BIN_EXE_e2e-gawm-loader"))
        .args(["run", "--quiet", "--service", "by-hand", "--loader", "0", "--loaders", "1"])
        .args(["--config", world.run("p.toml").to_str().unwrap()])
        .args(["--data", world.run("data").to_str().unwrap()])
        .args(length)
        .env("TMPDIR", place(&run))
        .output()
        .unwrap();
    assert!(loader.status.success(), "{}", String::from_utf8_lossy(&loader.stderr));
    let (code, lines) = lines_of(child);
    assert_eq!(code, Some(0), "{}", lines.join("\n"));
    assert_eq!(Products::of(&run).metrics, world.expected.metrics);
    world.check_clean(&run);
}
