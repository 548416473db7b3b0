//! The command line of `gawm-train`.
//!
//! Results go to stdout, everything else to stderr. Exit codes: 0 all steps taken; 1 failed; 2 bad arguments,
//! configuration or data that does not fit it; 130 interrupted (and saved).

mod bench;
mod failure;
mod train;

use std::ffi::OsString;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Args, CommandFactory, Parser, Subcommand};
use gawm_schema::pipeline::Override;

use crate::config::ConfigError;
use crate::loaders::LoaderProgram;
use crate::output::Talk;
use failure::Failure;

/// Train a world model on a dataset, with loaders in processes of their own
#[derive(Debug, Parser)]
#[command(name = "gawm-train", version, max_term_width = 120, args_conflicts_with_subcommands = true)]
struct Cli {
    #[command(subcommand)]
    command: Option<Command>,
    #[command(flatten)]
    train: TrainArgs,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Measure the time of a step, with loaders and on one resident batch
    Bench(BenchArgs),
    /// Show the validations of a run beside their baselines, and what did not learn
    Report {
        /// The run folder
        run: PathBuf,
    },
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// What every command that trains is told.
#[derive(Debug, Args)]
struct Common {
    /// Pipeline file; sections [model], [objectives] and [train] are read here, [loader] by the loaders
    #[arg(long, value_name = "P.toml")]
    config: Option<PathBuf>,
    /// Dataset, as gawm-ingest writes it; several are a mix
    #[arg(long, value_name = "DIR")]
    data: Vec<PathBuf>,
    /// Set a field of the pipeline file; the value is TOML, or a text where it is none
    #[arg(long, value_name = "SECTION.FIELD=VALUE")]
    set: Vec<String>,
    /// The loader program; without it, `gawm-loader` beside this program
    #[arg(long, value_name = "PATH")]
    loader_program: Option<PathBuf>,
    /// Threads of the trainer; all cores by default
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Say every step and every save on stderr
    #[arg(short, long)]
    verbose: bool,
    /// Say nothing on stderr but errors and alarms
    #[arg(short, long, conflicts_with = "verbose")]
    quiet: bool,
}

#[derive(Debug, Args)]
struct TrainArgs {
    #[command(flatten)]
    common: Common,
    /// Folder of the run, new or empty; with --resume the folder of a run that goes on
    #[arg(long, value_name = "RUN")]
    out: Option<PathBuf>,
    /// Go on where the run in --out was saved last; its configuration and data are taken unless given
    #[arg(long)]
    resume: bool,
    /// Name of the service that joins loaders and trainer; made from the run folder by default
    #[arg(long, value_name = "NAME")]
    service: Option<String>,
    /// Start no loaders: they are started by hand, with the same --service
    #[arg(long, requires = "service")]
    attach: bool,
    /// Print the configuration with overrides and defaults, and stop
    #[arg(long)]
    print_config: bool,
}

#[derive(Debug, Args)]
struct BenchArgs {
    #[command(flatten)]
    common: Common,
    /// Steps that are timed each way
    #[arg(long, default_value_t = 60, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    steps: u64,
    /// Turns in which they are taken, with loaders and without
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rounds: u64,
}

impl Common {
    fn talk(&self) -> Talk {
        match (self.quiet, self.verbose) {
            (true, _) => Talk::Quiet,
            (_, true) => Talk::Verbose,
            _ => Talk::Normal,
        }
    }

    fn overrides(&self) -> Result<Vec<Override>, Failure> {
        let read =
            |text: &String| Override::of_pipeline(text).map_err(|error| ConfigError::from(error).into());
        self.set.iter().map(read).collect()
    }

    /// Limits the threads of this process.
    fn limit_threads(&self) -> Result<(), Failure> {
        let Some(threads) = self.threads else { return Ok(()) };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(usize::from(threads));
        pool.build_global().map_err(|error| Failure::failed(error.into()))
    }
}

/// How a command ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Exit {
    /// 0.
    Clean,
    /// 130.
    Interrupted,
}

/// Runs the program with its arguments (the first is its name) and returns its exit code.
///
/// `loader_program` is where loaders are, unless the user says otherwise: a program that holds the loader, too, starts
/// itself with [`LoaderProgram::Itself`].
pub fn run(arguments: impl IntoIterator<Item = OsString>, loader_program: LoaderProgram) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are results; wrong usage is not. A closed pipe is nobody's fault.
            error.print().ok();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    let result = match &cli.command {
        None => train::run(&cli.train, loader_program),
        Some(Command::Bench(arguments)) => bench::run(arguments, loader_program),
        Some(Command::Report { run }) => train::report(run),
        Some(Command::Completions { shell }) => {
            clap_complete::generate(*shell, &mut Cli::command(), "gawm-train", &mut std::io::stdout());
            Ok(Exit::Clean)
        }
    };
    match result {
        Ok(Exit::Clean) => ExitCode::SUCCESS,
        Ok(Exit::Interrupted) => ExitCode::from(130),
        Err(failure) => {
            failure.print();
            ExitCode::from(failure.code)
        }
    }
}

/// Writes a result to stdout; a reader that has gone away (`| head`) is no error.
fn print(text: &str) {
    std::io::stdout().lock().write_all(text.as_bytes()).ok();
}
