//! The command line of `gawm-loader`.
//!
//! Results go to stdout, everything else to stderr. Exit codes: 0 clean (also when the trainer is gone); 1 failed; 2 bad
//! arguments or configuration; 130 interrupted. A trainer starts a loader again that was killed by a signal; one that
//! ends with 1 or 2 would only fail again.

mod bench;
mod cache;
mod clean;
mod run;

use std::ffi::OsString;
use std::io::Write as _;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use anyhow::Context as _;
use clap::{Args, CommandFactory, Parser, Subcommand};
use gawm_shm::{Place, ShmError};

use crate::config::{ConfigError, LoaderConfig};
use crate::error::LoadError;
use crate::serve::ServeError;

/// Make batches of clips and hand them to a trainer through shared memory
#[derive(Debug, Parser)]
#[command(
    name = "gawm-loader",
    version,
    propagate_version = true,
    arg_required_else_help = true,
    max_term_width = 120
)]
pub struct Cli {
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
    /// Folder for the locks of services; all processes of a run must use the same one. Default: gawm-UID in the folder for
    /// temporary files
    #[arg(long, global = true, value_name = "DIR")]
    pub(crate) shm_root: Option<PathBuf>,
}

impl Global {
    pub(crate) fn place(&self) -> Place {
        self.shm_root.as_deref().map_or_else(Place::of_user, Place::at)
    }
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make the batches of one loader of a trainer
    Run(run::RunArgs),
    /// Measure clips per second, the decode-only rate beside it, and the time from slot to view
    Bench(bench::BenchArgs),
    /// Decode all frames into the cache file now, so that loaders start at once
    Cache(cache::CacheArgs),
    /// Remove what killed loaders and trainers left in shared memory
    Clean(clean::CleanArgs),
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// Which data, and how.
#[derive(Debug, Args)]
pub(crate) struct DataArgs {
    /// Pipeline whose section [loader] says how clips are made; without it all defaults apply
    #[arg(long, value_name = "PIPELINE.toml")]
    pub(crate) config: Option<PathBuf>,
    /// Dataset folder; several are a mix
    #[arg(long, value_name = "DIR")]
    pub(crate) data: Vec<PathBuf>,
    /// Set a field of the configuration, such as loader.batch=32
    #[arg(long, value_name = "KEY=VALUE")]
    pub(crate) set: Vec<String>,
    /// Print the configuration with all defaults and end
    #[arg(long)]
    pub(crate) print_config: bool,
}

impl DataArgs {
    /// Reads the configuration; `None` when it was only to be printed.
    pub(crate) fn load(&self) -> Result<Option<LoaderConfig>, Failure> {
        let text = match &self.config {
            None => String::new(),
            Some(path) => std::fs::read_to_string(path)
                .with_context(|| format!("cannot read {}", path.display()))
                .map_err(|error| Failure { code: 2, error, hint: None })?,
        };
        let config = LoaderConfig::from_pipeline(&text, &self.set).map_err(|error: ConfigError| {
            let place = self.config.as_ref().map_or(String::new(), |path| format!("{}: ", path.display()));
            let hint =
                Some("`gawm-loader run --print-config` prints all fields with their defaults".to_owned());
            Failure { code: 2, error: anyhow::anyhow!("{place}{error}"), hint }
        })?;
        if self.print_config {
            print(&config.to_toml());
            return Ok(None);
        }
        if self.data.is_empty() {
            let error = anyhow::anyhow!("no dataset: expected --data DIR");
            return Err(Failure { code: 2, error, hint: None });
        }
        Ok(Some(config))
    }
}

/// A failure with its exit code and what to do about it.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) code: u8,
    pub(crate) error: anyhow::Error,
    pub(crate) hint: Option<String>,
}

impl From<LoadError> for Failure {
    fn from(error: LoadError) -> Failure {
        let code = match error {
            LoadError::Interrupted => 130,
            _ if error.is_misfit() => 2,
            _ => 1,
        };
        Failure { code, hint: error.hint(), error: error.into() }
    }
}

impl From<ShmError> for Failure {
    fn from(error: ShmError) -> Failure {
        let code = if matches!(error, ShmError::BadName { .. }) { 2 } else { 1 };
        Failure { code, hint: error.hint(), error: error.into() }
    }
}

impl From<ServeError> for Failure {
    fn from(error: ServeError) -> Failure {
        match error {
            ServeError::Load(error) => error.into(),
            ServeError::Shm(error) => error.into(),
        }
    }
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
        Command::Run(args) => run::run(args, &cli.global),
        Command::Bench(args) => bench::run(args, &cli.global),
        Command::Cache(args) => cache::run(args, &cli.global),
        Command::Clean(args) => clean::run(args, &cli.global),
        Command::Completions { shell } => {
            clap_complete::generate(*shell, &mut Cli::command(), "gawm-loader", &mut std::io::stdout());
            Ok(())
        }
    };
    let Err(failure) = result else { return ExitCode::SUCCESS };
    // Nothing can be done when stderr is closed.
    writeln!(std::io::stderr(), "error: {:#}", failure.error).ok();
    if let Some(hint) = &failure.hint {
        writeln!(std::io::stderr(), "\nhint: {hint}").ok();
    }
    ExitCode::from(failure.code)
}

/// Writes a result to stdout; a reader that has gone away (`| head`) is no error.
pub(crate) fn print(text: &str) {
    std::io::stdout().lock().write_all(text.as_bytes()).ok();
}

/// Writes a diagnostic to stderr.
pub(crate) fn say(text: &str) {
    writeln!(std::io::stderr(), "{text}").ok();
}

/// Returns a flag that Ctrl-C and SIGTERM set.
pub(crate) fn stop_flag() -> Arc<AtomicBool> {
    let stop = Arc::new(AtomicBool::new(false));
    let flag = stop.clone();
    // Only the first program of a process can set a handler; without one, signals end it at once, which is survived too.
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).ok();
    stop
}
