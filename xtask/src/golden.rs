//! `xtask golden FILE...`: parity with the published PyTorch modules, tensor by tensor.

use std::path::PathBuf;
use std::process::ExitCode;

use anyhow::Context;
use clap::ValueEnum;
use gawm_model::golden::{Golden, Report, compare};
use gawm_model::{Device, Precision};

/// Arguments of `xtask golden`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Golden files, made by `fixtures/golden/golden.py`; a folder stands for the JSON files in it.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Print one line per group of tensors instead of one per tensor.
    #[arg(long)]
    summary: bool,
    /// Where to compute.
    #[arg(long, value_enum, default_value_t = On::Cpu)]
    device: On,
    /// Operands of matrix products; bf16 widens the tolerances 64 times and leaves out searches and optimiser steps.
    #[arg(long, value_enum, default_value_t = In::F32)]
    precision: In,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum On {
    Cpu,
    Cuda,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum In {
    F32,
    Bf16,
}

/// Groups of tensors in summaries, by the beginning of their names.
const GROUPS: [&str; 11] = [
    "eval.",
    "regularisers.",
    "diagnostics.",
    "rollout_history_1.",
    "rollout_history_3.",
    "cem.",
    "train.",
    "grad_norm",
    "grad.",
    "after_step.",
    "losses_step_",
];

/// Compares every file; exit code 3 if a tensor is beyond its tolerance.
pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let device = match arguments.device {
        On::Cpu => Device::Cpu,
        On::Cuda => Device::new_cuda(0).context("no CUDA device")?,
    };
    let precision = match arguments.precision {
        In::F32 => Precision::F32,
        In::Bf16 => Precision::Bf16,
    };
    let mut failed = 0;
    for file in expand(&arguments.files)? {
        let text =
            std::fs::read_to_string(&file).with_context(|| format!("cannot read {}", file.display()))?;
        let golden = Golden::parse(&text).with_context(|| file.display().to_string())?;
        let report = compare(&golden, &device, precision).with_context(|| file.display().to_string())?;
        println!("{}", file.display());
        print(&report, arguments.summary);
        failed += report.failures().count();
    }
    if failed > 0 {
        println!("{failed} tensors are beyond their tolerance");
        return Ok(ExitCode::from(3));
    }
    Ok(ExitCode::SUCCESS)
}

/// Replaces folders by the JSON files in them, sorted.
fn expand(paths: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let entries = path.read_dir().with_context(|| format!("cannot list {}", path.display()))?;
        let mut found = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        found.retain(|file| file.extension().is_some_and(|extension| extension == "json"));
        anyhow::ensure!(!found.is_empty(), "{} holds no golden files (*.json)", path.display());
        found.sort();
        files.extend(found);
    }
    Ok(files)
}

fn print(report: &Report, summary: bool) {
    if !summary {
        report.lines().iter().for_each(|line| println!("  {line}"));
    }
    for group in GROUPS {
        if let Some(line) = report.worst(group) {
            let count = report.lines().iter().filter(|line| line.name.starts_with(group)).count();
            println!("  {:19} {count:4} compared, worst: {line}", group.trim_end_matches(['.', '_']));
        }
    }
    for line in report.failures().filter(|_| summary) {
        println!("  {line}");
    }
}
