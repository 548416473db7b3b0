//! `gawm-data merge`.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::Failure;
use super::edit::EditArguments;
use crate::edit::{Input, merge};

/// Write one dataset of all episodes of several
///
/// The datasets must have the same columns, rate and robot. Episodes that are in several gawm datasets are taken once;
/// parts of one recording come together again.
#[derive(Debug, Args)]
pub(super) struct MergeArguments {
    /// Dataset folders, two or more (gawm, or LeRobot v2.0, v2.1 and v3.0 mixed)
    #[arg(required = true, num_args = 2..)]
    dirs: Vec<PathBuf>,
    /// Folder to write; absent or empty
    #[arg(short, long, required_unless_present = "dry_run")]
    out: Option<PathBuf>,
    #[command(flatten)]
    edit: EditArguments,
}

pub(super) fn run(arguments: &MergeArguments, quiet: bool) -> Result<u8, Failure> {
    let inputs: Result<Vec<Input>, Failure> =
        arguments.dirs.iter().map(|dir| arguments.edit.open(dir)).collect();
    let inputs = inputs?;
    let plan = merge(&inputs);
    let out = arguments.out.clone().unwrap_or_else(|| PathBuf::from("(nothing)"));
    let written = arguments.edit.write(&inputs, &plan, &out, quiet)?;
    arguments.edit.report(&inputs, &[written], json!({}), quiet)
}
