//! `xtask interop ...`: what other people's software makes of our files, and we of theirs.

mod lerobot;
mod python;
mod tensorboard;
mod torch;

use std::io::Write;
use std::process::ExitCode;

use anyhow::Context;
use clap::Subcommand;

use crate::process::root;

/// Arguments of `xtask interop`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    with: With,
}

#[derive(Debug, Subcommand)]
enum With {
    /// Open our datasets with the published `lerobot`.
    Lerobot(lerobot::Arguments),
    /// Read the event files of a run with the real `tensorboard`.
    Tensorboard(tensorboard::Arguments),
    /// Exchange weights with the published PyTorch modules, both ways.
    Torch(torch::Arguments),
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    match &arguments.with {
        With::Lerobot(arguments) => lerobot::run(arguments),
        With::Tensorboard(arguments) => tensorboard::run(arguments),
        With::Torch(arguments) => torch::run(arguments),
    }
}

/// Appends a section to `docs/interop.md`, replacing the one of the same title.
fn record(title: &str, body: &str) -> anyhow::Result<()> {
    let path = root().join("docs/interop.md");
    let old = match std::fs::read_to_string(&path) {
        Ok(text) => text,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
            "# Interoperability\n\nOutcomes of `cargo run --release -p xtask -- interop ...`, written by that command.\n".to_owned()
        }
        Err(error) => return Err(error).context("cannot read docs/interop.md"),
    };
    let heading = format!("\n## {title}\n");
    let kept = match old.split_once(&heading) {
        None => old,
        Some((before, after)) => {
            let rest = after.find("\n## ").map_or("", |next| &after[next..]);
            format!("{before}{rest}")
        }
    };
    std::fs::create_dir_all(root().join("docs")).context("cannot make docs")?;
    let mut file = std::fs::File::create(&path).context("cannot write docs/interop.md")?;
    write!(file, "{}\n{heading}\n{body}", kept.trim_end()).context("cannot write docs/interop.md")
}
