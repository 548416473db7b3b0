//! `gawm-data validate`.

use std::path::PathBuf;

use anyhow::Context;
use clap::{Args, ValueEnum};

use super::progress::watch;
use super::{EXIT_CHECK_FAILED, Failure, open, print_result};
use crate::validate::{
    DemoReport, Severity, Thresholds, ValidateOptions, render_markdown, render_text, run_demo, validate,
};

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
    /// Plant defects in clean synthetic data, one at a time, and report which are found
    #[arg(long)]
    demo: bool,
    /// Test with a linear probe whether the pictures show each state (SEMANTIC-012)
    #[arg(long)]
    probe: bool,
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
    if arguments.demo {
        return run_self_test(arguments.format);
    }
    let Some(dir) = &arguments.dir else {
        return Err(Failure::usage(anyhow::anyhow!("expected a dataset folder, got none")));
    };
    let dataset = open(dir)?;
    let watch = watch(quiet, "checking", &dataset.rows_read);
    let options = ValidateOptions {
        thresholds,
        window_rows: arguments.window.max(1),
        checks_images: !arguments.no_images,
        probes_targets: arguments.probe,
        ..ValidateOptions::default()
    };
    let report = validate(&dataset, &options)?;
    drop(watch);
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

/// Runs the self-test: exit code 0 only if all defects at full strength were found and nothing on clean data.
fn run_self_test(format: Format) -> Result<u8, Failure> {
    let report = run_demo()?;
    let text = if format == Format::Json {
        serde_json::to_string_pretty(&report)? + "\n"
    } else {
        demo_table(&report)
    };
    print_result(&text)?;
    Ok(if report.is_perfect() { 0 } else { EXIT_CHECK_FAILED })
}

fn demo_table(report: &DemoReport) -> String {
    let mut out = format!("{:<34} {:<14} found at strength 0.3, 0.6, 1.0\n", "defect", "rule");
    for rule in &report.rules {
        let marks = rule.found.map(|f| if f { "yes" } else { "no" }).join(" ");
        out += &format!("{:<34} {:<14} {marks}\n", rule.defect, rule.code);
    }
    out += &format!(
        "\n{} of {} planted defects found, {} of {} at full strength; {} false alarms on {} clean datasets\n",
        report.found,
        report.planted,
        report.found_at_full_strength,
        report.planted_at_full_strength,
        report.false_alarms,
        report.clean_twins
    );
    report.false_alarm_texts.iter().for_each(|text| out += &format!("false alarm: {text}\n"));
    out
}
