//! `gawm-data split`.

use std::path::PathBuf;

use clap::{Args, ValueEnum};
use serde_json::json;

use super::Failure;
use super::edit::EditArguments;
use crate::edit::{EditError, SplitBy, parse_part, split};

/// Write several datasets of the episodes of one: OUT/NAME for each --into
///
///   gawm-data split DIR --out PARTS --by session --into train=0.8 --into val=0.2
///   gawm-data split DIR --out PARTS --by episode --into train=0:80 --into val=80:90,95
///
/// Shares are met as closely as whole sessions (or episodes) allow, and every part gets at least one.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
pub(super) struct SplitArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// Folder of the new datasets; absent or empty
    #[arg(short, long, required_unless_present = "dry_run")]
    out: Option<PathBuf>,
    /// What is never cut in two
    #[arg(long, value_enum)]
    by: By,
    /// A part: NAME=SHARE or NAME=EPISODES, once for each
    #[arg(long, required = true)]
    into: Vec<String>,
    /// Another seed gives another choice
    #[arg(long, default_value_t = 0)]
    seed: u64,
    #[command(flatten)]
    edit: EditArguments,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum By {
    Episode,
    Session,
}

pub(super) fn run(arguments: &SplitArguments, quiet: bool) -> Result<u8, Failure> {
    let parts: Result<Vec<_>, EditError> = arguments.into.iter().map(|text| parse_part(text)).collect();
    let parts = parts?;
    let by = match arguments.by {
        By::Episode => SplitBy::Episode,
        By::Session => SplitBy::Session,
    };
    let inputs = [arguments.edit.open(&arguments.dir)?];
    let plans = split(&inputs[0], by, &parts, arguments.seed)?;
    let out = arguments.out.clone().unwrap_or_else(|| PathBuf::from("(nothing)"));
    if !arguments.edit.dry_run {
        crate::edit::check_output(&out, &inputs)?;
    }
    let mut written = Vec::new();
    for (name, plan) in &plans {
        written.push(arguments.edit.write(&inputs, plan, &out.join(name), quiet)?);
    }
    let details: serde_json::Map<String, serde_json::Value> = plans
        .iter()
        .map(|(name, plan)| {
            let episodes: Vec<i64> =
                plan.pieces.iter().map(|p| inputs[0].dataset.runs[p.run].episode_index).collect();
            (name.clone(), json!(episodes))
        })
        .collect();
    arguments.edit.report(&inputs, &written, json!({"episodes": details}), quiet)
}
