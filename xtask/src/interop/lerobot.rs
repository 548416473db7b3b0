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

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let folder = root().join("target/interop-lerobot");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let interpreter = match &arguments.python {
        Some(python) => python.clone(),
        None => {
            let requirements = root().join("xtask/interop/lerobot-requirements.txt");
            python::environment(&folder.join("venv"), &requirements, &[])?
        }
    };
    let datasets =
        if arguments.datasets.is_empty() { ingest_fixtures(&folder)? } else { arguments.datasets.clone() };
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

/// Ingests the fixtures with the real program and returns the datasets.
fn ingest_fixtures(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let cargo = std::env::var("CARGO").unwrap_or_else(|_| "cargo".to_owned());
    let mut datasets = Vec::new();
    for (name, contract, log) in FIXTURES {
        let out = folder.join(name);
        if out.exists() {
            std::fs::remove_dir_all(&out).with_context(|| format!("cannot remove {}", out.display()))?;
        }
        let status = Command::new(&cargo)
            .args([
                "run",
                "--release",
                "--quiet",
                "-p",
                "gawm-ingest",
                "--",
                "run",
                "--config",
                contract,
                "--out",
            ])
            .arg(&out)
            .arg(log)
            .current_dir(root())
            .status()
            .with_context(|| format!("cannot run {cargo}"))?;
        ensure!(status.success(), "gawm-ingest on {log} failed ({status})");
        datasets.push(out);
    }
    Ok(datasets)
}
