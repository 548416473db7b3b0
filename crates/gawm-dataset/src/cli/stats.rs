//! `gawm-data stats`.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, ValueEnum};

use super::progress::watch;
use super::{EXIT_CHECK_FAILED, Failure, open, print_result};
use crate::stats::{camera_summaries, dataset_stats, lerobot_stats, render_text, to_json};

/// Measure every dim: moments, quantiles, histograms, motion
#[derive(Debug, Args)]
pub(super) struct StatsArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// Form of the output
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
    /// Write LeRobot's meta/stats.json into the folder
    #[arg(long)]
    write: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Text,
    Json,
}

pub(super) fn run(arguments: &StatsArguments, quiet: bool) -> Result<u8, Failure> {
    let dataset = open(&arguments.dir)?;
    let watch = watch(quiet, "measuring", &dataset.rows_read);
    let stats = dataset_stats(&dataset)?;
    let needs_cameras = arguments.write || arguments.format == Format::Json;
    let cameras = if needs_cameras { camera_summaries(&dataset) } else { Default::default() };
    drop(watch);
    let text = match arguments.format {
        Format::Text => render_text(&stats),
        Format::Json => serde_json::to_string_pretty(&to_json(&stats, &cameras))? + "\n",
    };
    print_result(&text)?;
    if arguments.write {
        let text = serde_json::to_string_pretty(&lerobot_stats(&dataset, &stats, &cameras))? + "\n";
        let path = arguments.dir.join("meta/stats.json");
        super::write_replacing(&path, text.as_bytes())
            .with_context(|| format!("cannot write {}", path.display()))?;
        say!("wrote {}", path.display());
    }
    for defect in &stats.defects {
        say!("error: {}: expected {}, got {}", defect.place, defect.expected, defect.got);
    }
    Ok(if stats.defects.is_empty() { 0 } else { EXIT_CHECK_FAILED })
}
