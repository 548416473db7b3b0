//! The command line of `gawm-data`.

/// Writes a line to standard error, where one may be gone: `2>&1 | head` is no reason to panic.
macro_rules! say {
    ($($text:tt)*) => {{
        use std::io::Write;
        writeln!(std::io::stderr(), $($text)*).ok();
    }};
}

mod diff;
mod edit;
mod filter;
mod label;
mod merge;
mod preview;
mod progress;
mod report;
mod split;
mod standardize;
mod stats;
mod trim;
mod validate;

use std::process::ExitCode;

use clap::{CommandFactory, Parser, Subcommand};

use crate::edit::EditError;

/// Finished, but a check failed at the asked level, or input was refused.
pub(crate) const EXIT_CHECK_FAILED: u8 = 3;

/// Validate, measure, show and edit datasets of gawm and LeRobot
#[derive(Debug, Parser)]
#[command(name = "gawm-data", version)]
pub struct Arguments {
    /// Number of threads; default: all cores
    #[arg(long, global = true)]
    threads: Option<usize>,
    /// Say nothing on standard error but errors
    #[arg(short, long, global = true)]
    quiet: bool,
    #[command(subcommand)]
    verb: Verb,
}

#[derive(Debug, Subcommand)]
enum Verb {
    Validate(validate::ValidateArguments),
    Stats(stats::StatsArguments),
    Report(report::ReportArguments),
    Preview(preview::PreviewArguments),
    Label(label::LabelArguments),
    Filter(filter::FilterArguments),
    Trim(trim::TrimArguments),
    Merge(merge::MergeArguments),
    Split(split::SplitArguments),
    Diff(diff::DiffArguments),
    Standardize(standardize::StandardizeArguments),
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// Runs the program and returns its exit code.
///
/// `arguments` begin with the name of the program.
pub fn run(arguments: impl IntoIterator<Item = std::ffi::OsString>) -> ExitCode {
    let arguments = match Arguments::try_parse_from(arguments) {
        Ok(arguments) => arguments,
        Err(e) => {
            e.print().ok(); // Nobody is left to tell when the terminal is gone.
            return ExitCode::from(if e.use_stderr() { 2 } else { 0 });
        }
    };
    if let Some(n) = arguments.threads {
        // A pool that is already there, in tests, stays as it is.
        rayon::ThreadPoolBuilder::new().num_threads(n).build_global().ok();
    }
    let quiet = arguments.quiet;
    let outcome = match &arguments.verb {
        Verb::Validate(verb) => validate::run(verb, quiet),
        Verb::Stats(verb) => stats::run(verb, quiet),
        Verb::Report(verb) => report::run(verb, quiet),
        Verb::Preview(verb) => preview::run(verb, quiet),
        Verb::Label(verb) => label::run(verb, quiet),
        Verb::Filter(verb) => filter::run(verb, quiet),
        Verb::Trim(verb) => trim::run(verb, quiet),
        Verb::Merge(verb) => merge::run(verb, quiet),
        Verb::Split(verb) => split::run(verb, quiet),
        Verb::Diff(verb) => diff::run(verb, quiet),
        Verb::Standardize(verb) => standardize::run(verb, quiet),
        Verb::Completions { shell } => completions(*shell),
    };
    match outcome {
        Ok(code) => ExitCode::from(code),
        Err(failure) => {
            say!("error: {:#}", failure.error);
            if let Some(hint) = failure.hint {
                say!("\nhint: {hint}");
            }
            ExitCode::from(failure.code)
        }
    }
}

fn completions(shell: clap_complete::Shell) -> Result<u8, Failure> {
    let mut script = Vec::new();
    clap_complete::generate(shell, &mut Arguments::command(), "gawm-data", &mut script);
    print_result(&String::from_utf8_lossy(&script))?;
    Ok(0)
}

/// An error with its exit code and what to do.
#[derive(Debug)]
pub(crate) struct Failure {
    pub(crate) error: anyhow::Error,
    pub(crate) code: u8,
    pub(crate) hint: Option<&'static str>,
}

impl Failure {
    /// Returns a failure of the arguments: exit code 2.
    pub(crate) fn usage(error: impl Into<anyhow::Error>) -> Failure {
        Failure { error: error.into(), code: 2, hint: None }
    }

    /// Returns the failure with a hint.
    pub(crate) fn hint(mut self, hint: &'static str) -> Failure {
        self.hint = Some(hint);
        self
    }
}

impl<E: Into<anyhow::Error>> From<E> for Failure {
    fn from(error: E) -> Self {
        let error = error.into();
        let (hint, is_usage) =
            error.downcast_ref::<EditError>().map_or((None, false), |e| (e.hint(), e.is_usage()));
        Failure { error, code: if is_usage { 2 } else { 1 }, hint }
    }
}

/// Prints a result to standard output; a reader that has gone away is no error.
pub(crate) fn print_result(text: &str) -> Result<(), Failure> {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(e) if e.kind() != std::io::ErrorKind::BrokenPipe => Err(e.into()),
        _ => Ok(()),
    }
}

/// Opens a dataset for a verb.
pub(crate) fn open(dir: &std::path::Path) -> Result<crate::read::Dataset, Failure> {
    use crate::read::{Dataset, OpenError, ReadLimits};
    Dataset::open(dir, ReadLimits::default()).map_err(|e| {
        let hint = match &e {
            OpenError::NotAFolder { .. } => "give the folder that holds meta/ and data/",
            OpenError::Info { .. } | OpenError::BadInfo { .. } => {
                "a dataset needs meta/info.json; copy or write it again"
            }
            _ => "copy the dataset again",
        };
        Failure::from(e).hint(hint)
    })
}

/// Replaces a file as a whole: written beside it, synced, renamed.
pub(crate) fn write_replacing(path: &std::path::Path, bytes: &[u8]) -> std::io::Result<()> {
    use std::io::Write;
    // The parent of a bare name is empty.
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty());
    let folder = folder.unwrap_or_else(|| std::path::Path::new("."));
    let mut builder = tempfile::Builder::new();
    // Readable to whom other new files are: temporary ones are private.
    #[cfg(unix)]
    builder.permissions(std::os::unix::fs::PermissionsExt::from_mode(0o666));
    let mut file = builder.tempfile_in(folder)?;
    file.write_all(bytes)?;
    file.as_file().sync_all()?;
    file.persist(path)?;
    Ok(())
}
