//! The command line of `gawm-ingest`.
//!
//! Results go to stdout, everything else to stderr. Exit codes: 0 clean; 1 failed, nothing usable; 2 bad arguments or
//! contract; 3 finished, but a mapped stream lost data or an input was refused; 130 interrupted.

mod explain;
mod inspect;
mod run;
mod suggest;
mod summary;

use std::ffi::OsString;
use std::io::Write as _;
use std::process::ExitCode;

use clap::{Args, CommandFactory, Parser, Subcommand};

/// Turn robot and simulator logs into datasets that can be trained on
#[derive(Debug, Parser)]
#[command(
    name = "gawm-ingest",
    version,
    propagate_version = true,
    arg_required_else_help = true,
    max_term_width = 120
)]
pub struct Cli {
    /// What to do.
    #[command(subcommand)]
    command: Command,
    #[command(flatten)]
    global: Global,
}

/// Options of all commands.
#[derive(Debug, Args)]
pub(crate) struct Global {
    /// Say more on stderr
    #[arg(short, long, global = true)]
    pub(crate) verbose: bool,
    /// Say less: no progress, no warnings
    #[arg(short, long, global = true, conflicts_with = "verbose")]
    pub(crate) quiet: bool,
    /// Threads that read, decode and encode; all cores by default
    #[arg(long, visible_alias = "jobs", global = true, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    pub(crate) threads: Option<u16>,
}

impl Global {
    /// Returns the number of threads to use.
    pub(crate) fn jobs(&self) -> usize {
        match self.threads {
            Some(n) => usize::from(n),
            None => std::thread::available_parallelism().map_or(1, usize::from),
        }
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Show what logs hold: channels, rates, clocks, gaps, damage
    Inspect(inspect::InspectArgs),
    /// Write a first contract for logs, every guess with its reason
    Suggest(suggest::SuggestArgs),
    /// Make a dataset of logs
    Run(run::RunArgs),
    /// Show the raw messages, the rule and the encoding behind one number of a dataset
    Explain(explain::ExplainArgs),
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// How a command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Exit {
    /// 0.
    Clean,
    /// 3.
    Loss,
}

/// A failure with its exit code and what to do about it.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: u8,
    pub(crate) error: anyhow::Error,
    pub(crate) hint: Option<String>,
}

/// Runs the program with its arguments (the first is its name).
pub fn main(args: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(args) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are results; wrong usage is not. A closed pipe is nobody's fault.
            error.print().ok();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let result = match &cli.command {
        Command::Inspect(args) => inspect::run(args, &cli.global),
        Command::Suggest(args) => suggest::run(args, &cli.global),
        Command::Run(args) => run::run(args, &cli.global),
        Command::Explain(args) => explain::run(args, &cli.global),
        Command::Completions { shell } => {
            clap_complete::generate(*shell, &mut Cli::command(), "gawm-ingest", &mut std::io::stdout());
            Ok(Exit::Clean)
        }
    };
    match result {
        Ok(Exit::Clean) => ExitCode::SUCCESS,
        Ok(Exit::Loss) => ExitCode::from(3),
        Err(failure) => {
            let mut stderr = std::io::stderr().lock();
            // Nothing can be done when stderr is closed.
            writeln!(stderr, "error: {}", chain(&failure.error)).ok();
            if let Some(hint) = &failure.hint {
                writeln!(stderr, "\nhint: {hint}").ok();
            }
            ExitCode::from(failure.code)
        }
    }
}

/// Returns an error and its causes, as far as they say more.
fn chain(error: &anyhow::Error) -> String {
    let mut text = String::new();
    for cause in error.chain() {
        let cause = cause.to_string();
        if text.is_empty() {
            text = cause;
        } else if !text.contains(&cause) {
            text.push_str("\n  because: ");
            text.push_str(&cause);
        }
    }
    text
}

/// Writes a result to stdout; a reader that has gone away (`| head`) is no error, a full disk is.
pub(crate) fn print(text: &str) -> Result<(), Failure> {
    let mut stdout = std::io::stdout().lock();
    match stdout.write_all(text.as_bytes()).and_then(|()| stdout.flush()) {
        Err(error) if error.kind() != std::io::ErrorKind::BrokenPipe => Err(Failure {
            code: 1,
            error: anyhow::Error::new(error).context("cannot write the result to stdout"),
            hint: None,
        }),
        _ => Ok(()),
    }
}
