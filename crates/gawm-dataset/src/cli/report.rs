//! `gawm-data report`.

use std::path::PathBuf;

use anyhow::Context;
use clap::Args;

use super::progress::watch;
use super::{Failure, open};
use crate::report::{ReportOptions, render_report};

/// Write one self-contained HTML page about a dataset
#[derive(Debug, Args)]
pub(super) struct ReportArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// The page to write
    #[arg(short, long, default_value = "report.html")]
    out: PathBuf,
    /// Leave out paths, host names, operators and sessions, so that the page can be passed on
    #[arg(long)]
    share: bool,
}

pub(super) fn run(arguments: &ReportArguments, quiet: bool) -> Result<u8, Failure> {
    let dataset = open(&arguments.dir)?;
    let watch = watch(quiet, "examining", &dataset.rows_read);
    let page = render_report(&dataset, ReportOptions { is_shared: arguments.share })?;
    drop(watch);
    super::write_replacing(&arguments.out, page.as_bytes())
        .with_context(|| format!("cannot write {}", arguments.out.display()))?;
    if !quiet {
        say!("wrote {} ({} kB)", arguments.out.display(), page.len() / 1024);
    }
    Ok(0)
}
