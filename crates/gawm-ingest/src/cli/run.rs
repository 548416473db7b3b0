//! `gawm-ingest run`.

use std::cell::RefCell;
use std::io::{IsTerminal as _, Write as _};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::AtomicBool;

use clap::Args;
use gawm_dataset::{WriteError, WriteMode};
use indicatif::{ProgressBar, ProgressStyle};

use super::{Exit, Failure, Global, print, summary};
use crate::contract::{self, ContractError};
use crate::run::{Report, RunError, RunOptions, run as run_logs};

/// Arguments of `run`.
#[derive(Debug, Args)]
#[command(after_long_help = "Examples:
  gawm-ingest run --config contract.toml --out dataset logs/*.mcap
  gawm-ingest run --config contract.toml --out dataset --append new.mcap
  gawm-ingest run --config contract.toml --set ticks.rate_hz=10 --print-config")]
pub(crate) struct RunArgs {
    /// Contract: how topics become columns; `gawm-ingest suggest LOG` writes a first one
    #[arg(long, value_name = "C.toml")]
    config: PathBuf,
    /// Folder of the dataset; must be absent or empty unless --resume or --append is given
    #[arg(long, value_name = "DIR", required_unless_present = "print_config")]
    out: Option<PathBuf>,
    /// MCAP, HDF5 and npz files, rosbag2 and LeRobot folders, or folders of them
    #[arg(value_name = "LOG", required_unless_present = "print_config")]
    logs: Vec<PathBuf>,
    /// Write what became of every message as JSON
    #[arg(long, value_name = "R.json")]
    report: Option<PathBuf>,
    /// Exit with 1 instead of 3 when data of a mapped stream was lost
    #[arg(long)]
    strict: bool,
    /// Go on with an interrupted run
    #[arg(long, conflicts_with = "append")]
    resume: bool,
    /// Add logs to a finished dataset; those that it has are passed over
    #[arg(long)]
    append: bool,
    /// Take every n-th recording only, i from 0 to n-1; merge the datasets with `gawm-data merge`
    #[arg(long, value_name = "i/n", value_parser = shard)]
    shard: Option<(u64, u64)>,
    /// Override a value of the contract, such as ticks.rate_hz=10 or stream.0.gap="mask"
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print the contract with all defaults and overrides, and do nothing
    #[arg(long)]
    print_config: bool,
}

fn shard(text: &str) -> Result<(u64, u64), String> {
    let parts = text.split_once('/').and_then(|(i, n)| Some((i.parse().ok()?, n.parse().ok()?)));
    match parts {
        Some((i, n)) if i < n => Ok((i, n)),
        _ => Err("expected i/n with i from 0 to n-1, such as 0/4".to_owned()),
    }
}

/// Runs the command.
pub(crate) fn run(args: &RunArgs, global: &Global) -> Result<Exit, Failure> {
    let written = contract::load(&args.config, &args.set).map_err(from_contract)?;
    let checked = contract::check(&written, &args.config.display().to_string()).map_err(from_contract)?;
    if args.print_config {
        print(&contract::to_toml(&written).map_err(from_contract)?)?;
        return Ok(Exit::Clean);
    }
    let Some(out) = args.out.as_deref() else { return Ok(Exit::Clean) };
    if let Some(path) = &args.report {
        // What cannot be written is said before the work, not after it.
        let opened = std::fs::OpenOptions::new().create(true).append(true).open(path);
        opened.map_err(|source| failure(RunError::Report { path: path.to_owned(), source }))?;
    }
    // The writer's threads are the global ones; whoever embeds this module may have set them up before.
    rayon::ThreadPoolBuilder::new().num_threads(global.jobs()).build_global().ok();
    let interrupt = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&interrupt);
    ctrlc::set_handler(move || flag.store(true, std::sync::atomic::Ordering::Relaxed)).map_err(|error| {
        Failure { code: 1, error: anyhow::Error::new(error).context("cannot watch for Ctrl-C"), hint: None }
    })?;
    let bar = Bar::new(global);
    let options = RunOptions {
        contract: &checked,
        contract_folder: args.config.parent().unwrap_or(Path::new("")),
        out,
        logs: &args.logs,
        mode: match (args.resume, args.append) {
            (true, _) => WriteMode::Resume,
            (_, true) => WriteMode::Append,
            _ => WriteMode::New,
        },
        jobs: global.jobs(),
        shard: args.shard,
        interrupt: &interrupt,
        progress: &|log, done, all| bar.set(log, done, all),
    };
    let mut report = Report::default();
    let result = run_logs(&options, &mut report);
    bar.clear();
    match result {
        Ok(outcome) => {
            if let Some(path) = &args.report {
                write_report(path, &outcome.report)?;
            }
            warn(&outcome.report, global);
            print(&summary::text(&outcome, out))?;
            match (outcome.has_loss(), args.strict) {
                (false, _) => Ok(Exit::Clean),
                (true, false) => Ok(Exit::Loss),
                (true, true) => Err(Failure {
                    code: 1,
                    error: anyhow::anyhow!(
                        "data of mapped streams was lost, or an input was refused, and --strict was given"
                    ),
                    hint: Some(
                        "the report (--report R.json) names topic, reason and first example".to_owned(),
                    ),
                }),
            }
        }
        Err(error) => {
            if let Some(path) = &args.report {
                write_report(path, &report)?;
            }
            warn(&report, global);
            Err(failure(error))
        }
    }
}

fn warn(report: &Report, global: &Global) {
    if global.quiet {
        return;
    }
    let mut stderr = std::io::stderr().lock();
    let shown = if global.verbose { usize::MAX } else { 30 };
    for warning in report.warnings.iter().take(shown) {
        // Nothing can be done when stderr is closed.
        writeln!(stderr, "warning: {warning}").ok();
    }
    if report.warnings.len() > shown {
        writeln!(stderr, "warning: {} more; -v or --report shows all", report.warnings.len() - shown).ok();
    }
}

fn write_report(path: &Path, report: &Report) -> Result<(), Failure> {
    let text = serde_json::to_string_pretty(report).map_err(|error| Failure {
        code: 1,
        error: anyhow::Error::new(error).context("cannot make the report"),
        hint: None,
    })?;
    std::fs::write(path, text + "\n")
        .map_err(|source| failure(RunError::Report { path: path.to_owned(), source }))
}

pub(crate) fn from_contract(error: ContractError) -> Failure {
    Failure { code: 2, hint: error.hint(), error: anyhow::Error::new(error) }
}

pub(crate) fn failure(error: RunError) -> Failure {
    let (code, hint) = match &error {
        RunError::Write { source, .. } => match source {
            WriteError::NotEmpty { .. } => (
                2,
                Some("choose another --out, or give --append to add to it, or --resume to go on".to_owned()),
            ),
            WriteError::NoDataset { .. } | WriteError::Unfinished { .. } | WriteError::SpecChanged { .. } => {
                (2, source.hint().map(str::to_owned))
            }
            other => (1, error.hint().or(other.hint().map(str::to_owned))),
        },
        _ => (error.exit_code(), error.hint()),
    };
    Failure { code, error: anyhow::Error::new(error), hint }
}

/// A progress bar on stderr, when that is a terminal.
struct Bar {
    bar: ProgressBar,
    log: RefCell<String>,
}

impl Bar {
    fn new(global: &Global) -> Bar {
        let is_shown = !global.quiet && std::io::stderr().is_terminal();
        let bar = if is_shown { ProgressBar::new(0) } else { ProgressBar::hidden() };
        if let Ok(style) = ProgressStyle::with_template("{bar:30} {pos}/{len} blocks {elapsed} {msg}") {
            bar.set_style(style);
        }
        Bar { bar, log: RefCell::default() }
    }

    fn set(&self, log: &str, done: usize, all: usize) {
        if *self.log.borrow() != log {
            log.clone_into(&mut self.log.borrow_mut());
            self.bar.set_message(log.to_owned());
        }
        self.bar.set_length(all as u64);
        self.bar.set_position(done as u64);
    }

    fn clear(&self) {
        self.bar.finish_and_clear();
    }
}
