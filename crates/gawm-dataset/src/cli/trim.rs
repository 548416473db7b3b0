//! `gawm-data trim`.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::Failure;
use super::edit::{EditArguments, Format};
use crate::edit::{TrimOptions, trim};

/// Write a dataset without the idle beginnings and ends of its episodes
///
/// A row is idle when no dim of the state (or of the action, where there is no state) covers more than --threshold of its
/// range over the dataset within 0.2 s, nor five times its noise. Nothing inside an episode is cut; an episode in which
/// nothing moves is kept whole and named.
#[derive(Debug, Args)]
pub(super) struct TrimArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// Folder to write; absent or empty
    #[arg(short, long, required_unless_present = "dry_run")]
    out: Option<PathBuf>,
    /// Share of a dim's range that is motion
    #[arg(long, default_value_t = TrimOptions::default().threshold)]
    threshold: f64,
    /// Seconds that stay of an idle end
    #[arg(long, default_value_t = TrimOptions::default().margin_secs)]
    margin_s: f64,
    /// Seconds below which an end is not cut
    #[arg(long, default_value_t = TrimOptions::default().min_cut_secs)]
    min_cut_s: f64,
    #[command(flatten)]
    edit: EditArguments,
}

pub(super) fn run(arguments: &TrimArguments, quiet: bool) -> Result<u8, Failure> {
    for (name, value, max) in [
        ("--threshold", arguments.threshold, 1.0),
        ("--margin-s", arguments.margin_s, f64::MAX),
        ("--min-cut-s", arguments.min_cut_s, f64::MAX),
    ] {
        if !(0.0..=max).contains(&value) {
            let expected = if max == 1.0 { "a share from 0 to 1" } else { "a number of 0 or more" };
            let error = anyhow::anyhow!("{name}: expected {expected}, got {value}");
            return Err(Failure::usage(error));
        }
    }
    let input = arguments.edit.open(&arguments.dir)?;
    let options = TrimOptions {
        threshold: arguments.threshold,
        margin_secs: arguments.margin_s,
        min_cut_secs: arguments.min_cut_s,
    };
    let (plan, trimmed) = trim(&input, &options)?;
    if arguments.edit.format == Format::Text && !quiet {
        let cut = trimmed.iter().filter(|t| t.kept.end - t.kept.start < t.rows);
        for t in cut.take(50) {
            say!("episode {}: keeps rows {} to {} of {}", t.episode, t.kept.start, t.kept.end, t.rows);
        }
        let n_cut = trimmed.iter().filter(|t| t.kept.end - t.kept.start < t.rows).count();
        if n_cut > 50 {
            say!("and {} more episodes", n_cut - 50);
        }
        say!("{n_cut} of {} episodes have idle ends", trimmed.len());
        for t in trimmed.iter().filter(|t| t.is_idle).take(20) {
            say!("note: nothing moves in episode {}: it is kept whole", t.episode);
        }
    }
    let out = arguments.out.clone().unwrap_or_else(|| PathBuf::from("(nothing)"));
    let inputs = [input];
    let written = arguments.edit.write(&inputs, &plan, &out, quiet)?;
    arguments.edit.report(&inputs, &[written], json!({"episodes": trimmed}), quiet)
}
