//! `gawm-data preview`.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::progress::watch;
use super::{Failure, open};
use crate::preview::{PreviewError, PreviewOptions, preview_html, preview_png};

/// Write a contact sheet: labelled frames of some episodes over their states and actions
#[derive(Debug, Args)]
pub(super) struct PreviewArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// The sheet to write; .png for a picture, .html for a page
    #[arg(short, long, default_value = "preview.png")]
    out: PathBuf,
    /// Episodes by index, separated by commas; without this, some are chosen
    #[arg(short, long, value_delimiter = ',')]
    episodes: Vec<i64>,
    /// Number of episodes that are chosen
    #[arg(short = 'n', long, default_value_t = PreviewOptions::default().count, value_parser = count(100))]
    count: usize,
    /// Another seed gives another choice
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Frames of each camera and episode
    #[arg(long, default_value_t = PreviewOptions::default().frames, value_parser = count(64))]
    frames: usize,
    /// Only these cameras; may be given several times
    #[arg(long)]
    camera: Vec<String>,
}

fn count(max: usize) -> impl Fn(&str) -> Result<usize, String> + Clone + Send + Sync + 'static {
    move |text: &str| {
        let number = text.parse().ok().filter(|n| (1..=max).contains(n));
        number.ok_or_else(|| format!("expected a number from 1 to {max}"))
    }
}

pub(super) fn run(arguments: &PreviewArguments, quiet: bool) -> Result<u8, Failure> {
    let extension =
        arguments.out.extension().and_then(|e| e.to_str()).unwrap_or_default().to_ascii_lowercase();
    if !["png", "html", "htm"].contains(&extension.as_str()) {
        let error =
            anyhow::anyhow!("expected an --out ending in .png or .html, got {}", arguments.out.display());
        return Err(Failure::usage(error));
    }
    let dataset = open(&arguments.dir)?;
    if arguments.episodes.len() > 100 {
        return Err(Failure::usage(anyhow::anyhow!(
            "expected at most 100 episodes, got {}",
            arguments.episodes.len()
        )));
    }
    let options = PreviewOptions {
        episodes: arguments.episodes.clone(),
        count: arguments.count,
        seed: arguments.seed,
        frames: arguments.frames,
        cameras: arguments.camera.clone(),
    };
    let watch = watch(quiet, "reading", &dataset.rows_read);
    let bytes = if extension == "png" {
        preview_png(&dataset, &options)
    } else {
        preview_html(&dataset, &options).map(String::into_bytes)
    };
    drop(watch);
    let bytes = bytes.map_err(|error| match error {
        PreviewError::Unknown { .. } => Failure::usage(error),
        other => Failure::from(other),
    })?;
    super::write_replacing(&arguments.out, &bytes)
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    if !quiet {
        say!("wrote {} ({} kB)", arguments.out.display(), bytes.len().div_ceil(1024));
    }
    Ok(0)
}
