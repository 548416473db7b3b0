//! A Python environment of our own, made once under `target/`.

use std::path::{Path, PathBuf};
use std::process::Command;

use anyhow::Context;

use crate::process::run;

/// Returns the interpreter of an environment with the packages of `requirements`, making it if needed.
///
/// `bare` are packages that come without their dependencies; `size` says what the packages take.
pub(super) fn environment(
    folder: &Path,
    requirements: &Path,
    bare: &[&str],
    size: &str,
) -> anyhow::Result<PathBuf> {
    let python = folder.join("bin/python");
    let done = folder.join("complete");
    if done.exists() {
        return Ok(python);
    }
    eprintln!("making a Python environment in {} ({size})", folder.display());
    run(Command::new("python3").args(["-m", "venv"]).arg(folder))?;
    let pip = |arguments: &mut Command| run(arguments).map(|_| ());
    pip(Command::new(&python).args(["-m", "pip", "install", "--quiet", "-r"]).arg(requirements))?;
    if !bare.is_empty() {
        pip(Command::new(&python).args(["-m", "pip", "install", "--quiet", "--no-deps"]).args(bare))?;
    }
    std::fs::write(&done, "").with_context(|| format!("cannot write {}", done.display()))?;
    Ok(python)
}
