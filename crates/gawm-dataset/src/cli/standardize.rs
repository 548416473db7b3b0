//! `gawm-data standardize`.

use std::path::PathBuf;

use clap::Args;

use super::{Failure, open};

/// Write the standardised states and actions of a gawm dataset again (gawm/encoded/)
#[derive(Debug, Args)]
pub(super) struct StandardizeArguments {
    /// Dataset folder written by gawm
    dir: PathBuf,
}

pub(super) fn run(arguments: &StandardizeArguments, quiet: bool) -> Result<u8, Failure> {
    let dataset = open(&arguments.dir)?;
    if dataset.gawm.is_none() {
        let error = anyhow::anyhow!(
            "expected a dataset with meta/gawm.json, got none in {}",
            arguments.dir.display()
        );
        return Err(Failure::from(error).hint("only datasets written by gawm have a standardisation"));
    }
    crate::standardize(&arguments.dir)?;
    if !quiet {
        say!("wrote {}", arguments.dir.join(crate::layout::ENCODED).display());
    }
    Ok(0)
}
