//! `xtask interop tensorboard`: the real `tensorboard` reads the event files of a run.

use std::path::PathBuf;
use std::process::{Command, ExitCode};

use anyhow::{Context, ensure};

use super::{python, record, root};

/// Arguments of `xtask interop tensorboard`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// An interpreter that has the packages of `xtask/interop/tensorboard-requirements.txt`; without it an environment is made.
    #[arg(long)]
    python: Option<PathBuf>,
    /// Folder of a finished run (`gawm-train --out RUN`).
    run: PathBuf,
}

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let interpreter = match &arguments.python {
        Some(python) => python.clone(),
        None => {
            let folder = root().join("target/interop-tensorboard");
            std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
            python::environment(
                &folder.join("venv"),
                &root().join("xtask/interop/tensorboard-requirements.txt"),
                &[],
                "tensorboard without TensorFlow: about 200 MB, a minute",
            )?
        }
    };
    let output = Command::new(&interpreter)
        .arg(root().join("xtask/interop/check_tensorboard.py"))
        .arg(&arguments.run)
        .output()
        .with_context(|| format!("cannot run {}", interpreter.display()))?;
    let answer = String::from_utf8_lossy(&output.stdout);
    print!("{answer}");
    ensure!(output.status.success(), "tensorboard disagrees:\n{}", String::from_utf8_lossy(&output.stderr));
    record(
        "TensorBoard",
        &format!("Command: `cargo xtask interop tensorboard RUN`.\n\n```text\n{answer}```\n"),
    )?;
    Ok(ExitCode::SUCCESS)
}
