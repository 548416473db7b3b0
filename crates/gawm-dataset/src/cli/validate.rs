//! `gawm-data validate`.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, ValueEnum};

use super::{EXIT_CHECK_FAILED, Failure, open, print_result};
use crate::validate::{Severity, Thresholds, ValidateOptions, render_markdown, render_text, validate};

/// Check a dataset and say what harms training
///
/// Exit code 3 if something at the level of --fail-on was found.
#[derive(Debug, Args)]
pub(super) struct ValidateArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: Option<PathBuf>,
    /// TOML file of thresholds and severities
    #[arg(long)]
    rules: Option<PathBuf>,
    /// Form of the report
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
    /// Lowest severity that makes the exit code 3
    #[arg(long, value_enum, default_value_t = FailOn::Error)]
    fail_on: FailOn,
    /// Rows of a training window
    #[arg(long, default_value_t = 16)]
    window: usize,
    /// Do not look at pictures
    #[arg(long)]
    no_images: bool,
    /// Print all thresholds as TOML and stop
    #[arg(long)]
    print_rules: bool,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Text,
    Json,
    Md,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum FailOn {
    Error,
    #[value(alias = "warn")]
    Warning,
    Info,
    Never,
}

pub(super) fn run(arguments: &ValidateArguments, quiet: bool) -> Result<u8, Failure> {
    let thresholds = match &arguments.rules {
        None => Thresholds::default(),
        Some(path) => {
            let text =
                std::fs::read_to_string(path).with_context(|| format!("cannot read {}", path.display()));
            let text = text.map_err(Failure::usage)?;
            Thresholds::from_toml(&text)
                .with_context(|| format!("in {}", path.display()))
                .map_err(Failure::usage)?
        }
    };
    if arguments.print_rules {
        print_result(&toml::to_string(&thresholds)?)?;
        return Ok(0);
    }
    let Some(dir) = &arguments.dir else {
        return Err(Failure::usage(anyhow::anyhow!("expected a dataset folder, got none")));
    };
    let dataset = open(dir)?;
    if !quiet && dataset.n_rows() > 2_000_000 {
        eprintln!("reading {} rows of {} episodes", dataset.n_rows(), dataset.runs.len());
    }
    let options = ValidateOptions {
        thresholds,
        window_rows: arguments.window.max(1),
        checks_images: !arguments.no_images,
    };
    let report = validate(&dataset, &options)?;
    let text = match arguments.format {
        Format::Text => render_text(&report),
        Format::Md => render_markdown(&report),
        Format::Json => serde_json::to_string_pretty(&report)? + "\n",
    };
    print_result(&text)?;
    let bound = match arguments.fail_on {
        FailOn::Error => Severity::Error,
        FailOn::Warning => Severity::Warning,
        FailOn::Info => Severity::Info,
        FailOn::Never => return Ok(0),
    };
    Ok(if report.findings.iter().any(|f| f.severity >= bound) { EXIT_CHECK_FAILED } else { 0 })
}
