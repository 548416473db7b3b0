//! The command line of `gawm`.
//!
//! Exit codes are those of the program behind a verb; `run`: 0 clean; 1 a step failed; 2 bad arguments or pipeline;
//! 3 finished, but a step had something to look at; 130 interrupted.

use std::ffi::OsString;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, CommandFactory as _, Parser, Subcommand};
use gawm_train::loaders::LoaderProgram;

use crate::pipeline::{
    Outcome, Pipeline, PipelineError, RunError, RunOptions, StepName, pass_interrupts_on, run,
};
use crate::quickstart::{self, QuickstartError};

/// Raw robot and simulator logs to trajectories, world models, plans and honest numbers
#[derive(Debug, Parser)]
#[command(name = "gawm", version, arg_required_else_help = true, max_term_width = 110)]
struct Cli {
    #[command(subcommand)]
    command: Verb,
}

/// Arguments that another program of ours reads.
#[derive(Debug, Args)]
#[command(disable_help_flag = true, disable_version_flag = true)]
struct Rest {
    /// Arguments of that program
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENTS")]
    rest: Vec<OsString>,
}

#[derive(Debug, Subcommand)]
enum Verb {
    /// Logs to datasets: inspect, suggest, run, explain (gawm-ingest)
    Ingest(Rest),
    /// Datasets: validate, stats, report, preview, edit (gawm-data)
    Data(Rest),
    /// Clips from datasets into shared memory: run, bench, clean (gawm-loader)
    Loader(Rest),
    /// Train a world model on what loaders send (gawm-train)
    Train(Rest),
    /// Plan with a model, and examine it (gawm-eval)
    Eval(Rest),
    /// Environments: collect logs of an expert (gawm-sim)
    Sim(Rest),
    /// Run a pipeline: the steps from logs to a report that are not up to date
    Run(RunArgs),
    /// Make logs, a dataset, a model and plans from nothing, and one page about them
    Quickstart(QuickstartArgs),
    /// Print the JSON Schema of a file, for editors
    Schema {
        /// pipeline, contract or task
        #[arg(value_parser = clap::builder::PossibleValuesParser::new(crate::schemas::NAMES.map(|(name, _)| name)))]
        name: String,
    },
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

/// Arguments of `run`.
#[derive(Debug, Args)]
#[command(after_long_help = "Examples:
  gawm run pipelines/tworoom-nano.toml --out results/tworoom
  gawm run my-robot.toml --out results/arm logs/*.mcap
  gawm run my-robot.toml --out results/arm --until validate logs/*.mcap")]
struct RunArgs {
    /// Pipeline: sections [sim] [ingest] [loader] [model] [objectives] [train] [eval]
    #[arg(value_name = "PIPELINE.toml")]
    pipeline: PathBuf,
    /// Folder of all results; what is there and up to date is kept
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Logs; without them the pipeline's [sim] section records some
    #[arg(value_name = "LOG")]
    logs: Vec<PathBuf>,
    /// Stop after this step
    #[arg(long, value_enum, value_name = "STEP")]
    until: Option<StepName>,
    /// Run this step and all after it, also if they are up to date
    #[arg(long, value_enum, value_name = "STEP")]
    from: Option<StepName>,
    /// Say what would be run, and do nothing
    #[arg(long)]
    dry_run: bool,
    /// Override a value of the pipeline, such as train.steps=100
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Print the pipeline with overrides, and do nothing
    #[arg(long)]
    print_config: bool,
}

/// Arguments of `quickstart`.
#[derive(Debug, Args)]
#[command(after_long_help = "Look at DIR/report.html; DIR/summary.json has the numbers.
Run again, it does only what is not up to date.")]
struct QuickstartArgs {
    /// Folder of all results
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
    /// Override a value of the pipeline, such as train.seed=2
    #[arg(long = "set", value_name = "SECTION.KEY=VALUE")]
    set: Vec<String>,
    /// Print the pipeline with overrides, and do nothing
    #[arg(long)]
    print_config: bool,
}

/// Runs the program with its arguments, the first being its name, and returns its exit code.
///
/// Called as `gawm-data`, `gawm-ingest` and so on (a link by that name), it is that program.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let mut arguments: Vec<OsString> = arguments.into_iter().collect();
    if let Some(verb) = verb_of_name(arguments.first()) {
        arguments.insert(1, verb);
        arguments[0] = "gawm".into();
    }
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are results; wrong usage is not. A closed pipe is nobody's fault.
            error.print().ok();
            return ExitCode::from(u8::try_from(error.exit_code()).unwrap_or(2));
        }
    };
    match cli.command {
        Verb::Ingest(rest) => gawm_ingest::cli::main(named("gawm ingest", rest)),
        Verb::Data(rest) => gawm_dataset::cli::run(named("gawm data", rest)),
        Verb::Loader(rest) => gawm_loader::cli::main(named("gawm loader", rest)),
        Verb::Train(rest) => {
            gawm_train::cli::run(named("gawm train", rest), LoaderProgram::Itself(vec!["loader".into()]))
        }
        Verb::Eval(rest) => gawm_eval::cli::main(named("gawm eval", rest)),
        Verb::Sim(rest) => gawm_sim::cli::main(named("gawm sim", rest)),
        Verb::Run(arguments) => run_pipeline(&arguments),
        Verb::Quickstart(arguments) => run_quickstart(&arguments),
        Verb::Schema { name } => {
            let schema = crate::schemas::schema(&name).expect("clap takes known names alone");
            print(&format!("{schema:#}\n"));
            ExitCode::SUCCESS
        }
        Verb::Completions { shell } => {
            clap_complete::generate(shell, &mut Cli::command(), "gawm", &mut std::io::stdout());
            ExitCode::SUCCESS
        }
    }
}

/// Returns the verb of `gawm-VERB` in the name that the program was called by.
fn verb_of_name(name: Option<&OsString>) -> Option<OsString> {
    let name = Path::new(name?).file_stem()?.to_str()?;
    let verb = name.strip_prefix("gawm-")?;
    ["ingest", "data", "loader", "train", "sim", "eval"].contains(&verb).then(|| verb.into())
}

fn named(name: &str, rest: Rest) -> Vec<OsString> {
    std::iter::once(name.into()).chain(rest.rest).collect()
}

fn run_pipeline(arguments: &RunArgs) -> ExitCode {
    try_run_pipeline(arguments).unwrap_or_else(fail)
}

fn try_run_pipeline(arguments: &RunArgs) -> Result<ExitCode, RunError> {
    let pipeline = Pipeline::load(&arguments.pipeline, &arguments.set)?;
    if arguments.print_config {
        print(&pipeline.text_of(&gawm_schema::pipeline::SECTIONS));
        return Ok(ExitCode::SUCCESS);
    }
    let program = prepare()?;
    let options = RunOptions {
        out: &arguments.out,
        logs: &arguments.logs,
        until: arguments.until,
        from: arguments.from,
        is_dry: arguments.dry_run,
        program: &program,
    };
    let outcome = run(&pipeline, &options, &mut |line| eprintln!("{line}"))?;
    Ok(exit_of(&outcome))
}

fn run_quickstart(arguments: &QuickstartArgs) -> ExitCode {
    match try_run_quickstart(arguments) {
        Ok(code) => code,
        Err(QuickstartError::Run(error)) => fail(error),
        Err(error) => {
            eprintln!("error: {:#}", anyhow::Error::new(error));
            eprintln!("\nhint: `--out` of another folder begins anew");
            ExitCode::FAILURE
        }
    }
}

fn try_run_quickstart(arguments: &QuickstartArgs) -> Result<ExitCode, QuickstartError> {
    if arguments.print_config {
        let path = Path::new("quickstart");
        let pipeline =
            Pipeline::parse(path, quickstart::PIPELINE, &arguments.set).map_err(RunError::Pipeline)?;
        print(&pipeline.text_of(&gawm_schema::pipeline::SECTIONS));
        return Ok(ExitCode::SUCCESS);
    }
    let program = prepare()?;
    let done =
        quickstart::quickstart(&arguments.out, &arguments.set, &program, &mut |line| eprintln!("{line}"))?;
    let summary = &done.summary;
    let percent = |fraction: f64| 100.0 * fraction;
    print(&format!(
        "success      {:5.1} %   on problems whose start is no solution (nothing {:.1}, random {:.1}, straight line {:.1})\n\
         wall success {:5.1} %   on problems that need the door (search blind for the wall {:.1})\n\
         problems     {:5}\n\
         seconds      {:7.1}\n\n{}\n\nreport: {}\n",
        percent(summary.success),
        percent(summary.floor_noop),
        percent(summary.floor_random),
        percent(summary.floor_straight),
        percent(summary.wall_success),
        percent(summary.wall_floor_blind),
        summary.problems,
        summary.seconds,
        summary.verdict,
        done.report.display()
    ));
    Ok(exit_of(&done.outcome))
}

/// Returns this program, and makes it pass Ctrl-C on to its steps.
fn prepare() -> Result<PathBuf, RunError> {
    let start = |source| RunError::Start { name: "gawm", source };
    pass_interrupts_on().map_err(|error| start(std::io::Error::other(error)))?;
    std::env::current_exe().map_err(start)
}

fn exit_of(outcome: &Outcome) -> ExitCode {
    if outcome.steps.iter().any(|step| step.exit != 0) { ExitCode::from(3) } else { ExitCode::SUCCESS }
}

/// Writes a result to stdout; a reader that has gone away (`| head`) is no error.
fn print(text: &str) {
    std::io::stdout().lock().write_all(text.as_bytes()).ok();
}

fn fail(error: RunError) -> ExitCode {
    let mut stderr = std::io::stderr().lock();
    let (code, hint) = advice(&error);
    // Nothing can be done when stderr is closed.
    writeln!(stderr, "error: {:#}", anyhow::Error::new(error)).ok();
    if let Some(hint) = hint {
        writeln!(stderr, "\nhint: {hint}").ok();
    }
    ExitCode::from(code)
}

fn advice(error: &RunError) -> (u8, Option<String>) {
    match error {
        RunError::Pipeline(PipelineError::NoLogs { .. }) => {
            (2, Some("name logs at the end of the command, or give the pipeline a [sim] section".to_owned()))
        }
        RunError::Pipeline(PipelineError::MissingSection { name: "ingest", .. }) => {
            (2, Some("`gawm ingest suggest LOG` writes one from a log".to_owned()))
        }
        RunError::Pipeline(_) => (2, None),
        RunError::InUse { .. } => {
            (1, Some("wait until it has ended, or end it: `fuser` names its process".to_owned()))
        }
        RunError::Foreign { .. } => (2, Some("choose another folder with --out, or move it away".to_owned())),
        RunError::Interrupted { .. } => (130, None),
        RunError::Step { is_usage: true, .. } => (2, None),
        _ => (1, None),
    }
}
