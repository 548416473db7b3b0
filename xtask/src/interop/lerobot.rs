//! `xtask interop lerobot`: the published `lerobot` opens our datasets and hands out what the files hold.

use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, ensure};

use super::{python, record, root};

/// Arguments of `xtask interop lerobot`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// An interpreter that has the packages of `xtask/interop/lerobot-requirements.txt`; without it an environment is made.
    #[arg(long)]
    python: Option<PathBuf>,
    /// Datasets to open; without any, the fixtures are ingested.
    datasets: Vec<PathBuf>,
}

/// The fixtures that are ingested: name, contract, log.
const FIXTURES: &[(&str, &str, &str)] =
    &[("demo", "pipelines/demo.toml", "fixtures/mcap-explorer-demo/demo.mcap")];

/// A log of the corpora that is ingested with the contract that `suggest` writes.
const ARM_LOG: &str = "generated/arm_ros2_zstd.mcap";

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let folder = root().join("target/interop-lerobot");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let interpreter = match &arguments.python {
        Some(python) => python.clone(),
        None => {
            let requirements = root().join("xtask/interop/lerobot-requirements.txt");
            let size = "lerobot with PyTorch: about 8 GB, up to 20 minutes";
            python::environment(&folder.join("venv"), &requirements, &[], size)?
        }
    };
    let mut datasets =
        if arguments.datasets.is_empty() { ingest_fixtures(&folder)? } else { arguments.datasets.clone() };
    let edited: Vec<Vec<PathBuf>> =
        datasets.iter().map(|dataset| edit(&folder, dataset)).collect::<anyhow::Result<_>>()?;
    datasets.extend(edited.into_iter().flatten());
    let mut text = String::from("Command: `cargo xtask interop lerobot`.\n");
    let mut is_good = true;
    for dataset in &datasets {
        let output = Command::new(&interpreter)
            .arg(root().join("xtask/interop/check_lerobot.py"))
            .arg(dataset)
            .output()
            .with_context(|| format!("cannot run {}", interpreter.display()))?;
        let answer = String::from_utf8_lossy(&output.stdout);
        print!("{answer}");
        is_good &= output.status.success();
        if !output.status.success() {
            eprintln!("{}", String::from_utf8_lossy(&output.stderr));
        }
        text.push_str(&format!("\n```text\n{answer}```\n"));
    }
    if arguments.datasets.is_empty() {
        record("lerobot", &text)?;
    }
    Ok(ExitCode::from(u8::from(!is_good)))
}

/// Runs every verb of `gawm-data` that writes datasets and returns what they wrote: half of the dataset twice, the whole
/// merged again, a filtered and a trimmed one.
fn edit(folder: &Path, dataset: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let name = dataset.file_name().context("a dataset has no name")?.to_string_lossy().into_owned();
    let out = folder.join(format!("{name}-edited"));
    if out.exists() {
        std::fs::remove_dir_all(&out).with_context(|| format!("cannot remove {}", out.display()))?;
    }
    let path = |name: &str| out.join(name);
    let text = |path: &Path| path.display().to_string();
    let (source, parts) = (text(dataset), path("parts"));
    let mut written = vec![path("filtered"), path("trimmed")];
    gawm_data(&[
        "filter",
        &source,
        "--out",
        &text(&written[0]),
        "--where",
        "length > 1 and episode_index < 1000",
    ])?;
    gawm_data(&["trim", &source, "--out", &text(&written[1])])?;
    let n_episodes = episodes(dataset)?;
    if n_episodes > 1 {
        let first = format!("first=0:{}", n_episodes / 2);
        let rest = format!("rest={}:{n_episodes}", n_episodes / 2);
        let by = ["--by", "episode", "--into", &first, "--into", &rest];
        gawm_data(&[&["split", &source, "--out", &text(&parts)], &by[..]].concat())?;
        let merged = path("merged");
        gawm_data(&[
            "merge",
            &text(&parts.join("first")),
            &text(&parts.join("rest")),
            "--out",
            &text(&merged),
        ])?;
        written.extend([parts.join("rest"), merged]);
    }
    Ok(written)
}

fn episodes(dataset: &Path) -> anyhow::Result<u64> {
    let path = dataset.join("meta/info.json");
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let info: serde_json::Value = serde_json::from_str(&text)?;
    info["total_episodes"].as_u64().context("info.json has no total_episodes")
}

fn gawm_data(arguments: &[&str]) -> anyhow::Result<()> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned());
    let status = Command::new(&cargo)
        .args(["run", "--release", "--quiet", "-p", "gawm-dataset", "--bin", "gawm-data", "--"])
        .args(arguments)
        .current_dir(root())
        .status()
        .with_context(|| format!("cannot run {cargo}"))?;
    // 3: something damaged was left out, as the program says itself.
    ensure!(matches!(status.code(), Some(0 | 3)), "gawm-data {} failed ({status})", arguments.join(" "));
    Ok(())
}

/// Ingests the fixtures, and an arm's log where the corpora are there, with the real program; returns the datasets.
fn ingest_fixtures(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let mut datasets = Vec::new();
    for (name, contract, log) in FIXTURES {
        datasets.push(ingest(&folder.join(name), Path::new(contract), Path::new(log))?);
    }
    match std::env::var_os("GAWM_SHARED") {
        None => println!("skipped: GAWM_SHARED is not set, so only the fixtures are opened"),
        Some(shared) => {
            let log = root().join(shared).join("corpora").join(ARM_LOG);
            // Without an edit, as a newcomer would.
            let contract = folder.join("arm.toml");
            let suggested = program(&[Path::new("suggest"), &log])?;
            std::fs::write(&contract, suggested)
                .with_context(|| format!("cannot write {}", contract.display()))?;
            datasets.push(ingest(&folder.join("arm"), &contract, &log)?);
        }
    }
    Ok(datasets)
}

/// Makes a dataset of a log.
fn ingest(out: &Path, contract: &Path, log: &Path) -> anyhow::Result<PathBuf> {
    if out.exists() {
        std::fs::remove_dir_all(out).with_context(|| format!("cannot remove {}", out.display()))?;
    }
    program(&[Path::new("run"), Path::new("--config"), contract, Path::new("--out"), out, log])?;
    Ok(out.to_owned())
}

/// Runs `gawm-ingest` and returns what it printed.
fn program(arguments: &[&Path]) -> anyhow::Result<Vec<u8>> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned());
    let output = Command::new(&cargo)
        .args(["run", "--release", "--quiet", "-p", "gawm-ingest", "--"])
        .args(arguments)
        .current_dir(root())
        .output()
        .with_context(|| format!("cannot run {cargo}"))?;
    ensure!(
        output.status.success(),
        "gawm-ingest {arguments:?} failed ({}): {}",
        output.status,
        String::from_utf8_lossy(&output.stderr)
    );
    Ok(output.stdout)
}
