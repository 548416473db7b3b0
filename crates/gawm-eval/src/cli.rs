//! The program: `gawm-eval plan | compare | diagnose | probe | export`.

use std::ffi::OsString;
use std::io::{IsTerminal, Write};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::{Args, CommandFactory, Parser, Subcommand, ValueEnum};
use gawm_model::Device;
use gawm_model::checkpoint::{KeyLayout, export};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::compare::{PlanFolder, compare};
use crate::config::{self, ConfigError, EvalConfig, Protocol};
use crate::data::DataError;
use crate::diagnose::{DiagnoseError, DiagnoseReport, diagnose};
use crate::planner::PlannerConfigError;
use crate::problem::ProblemError;
use crate::program::{self, ProgramError};
use crate::run::{Run, RunError};
use crate::suite::SuiteError;

/// Failed, nothing usable.
const EXIT_FAILED: u8 = 1;
/// Bad arguments or configuration.
const EXIT_USAGE: u8 = 2;
/// Finished, but an environment or a plan failed on a problem.
const EXIT_LOSS: u8 = 3;

/// Arguments that do not go together.
#[derive(Debug, thiserror::Error)]
#[error("{0}")]
struct UsageError(String);

/// Evaluate world models: plan, diagnose, probe, compare
#[derive(Debug, Parser)]
#[command(name = "gawm-eval", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Plan with a model and with all floors on the same problems
    Plan(PlanArgs),
    /// Put results of several runs side by side, with paired intervals
    Compare(CompareArgs),
    /// Measure how latents move, what they hold and how far they can be predicted
    Diagnose(DiagnoseArgs),
    /// Read states from latents, dimension by dimension; prints a table
    Probe(DiagnoseArgs),
    /// Write the weights of a run under the published names
    Export(ExportArgs),
    /// Print completions for a shell
    Completions {
        /// Shell
        shell: clap_complete::Shell,
    },
}

#[derive(Debug, Args)]
struct Common {
    /// Pipeline file; the section [eval] is read
    #[arg(long, value_name = "P.toml")]
    config: Option<PathBuf>,
    /// Override a field of [eval], such as plan.planner.samples=64
    #[arg(long = "set", value_name = "KEY=VALUE")]
    overrides: Vec<String>,
    /// Print the resolved [eval] and stop
    #[arg(long)]
    print_config: bool,
    /// Threads; all processors by default. Results do not depend on it
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    threads: Option<u16>,
    /// Where the model runs: cpu, cuda or cuda:N
    #[arg(long, default_value = "cpu")]
    device: String,
    /// No progress on stderr
    #[arg(short, long)]
    quiet: bool,
}

#[derive(Debug, Args)]
struct PlanArgs {
    /// Folder of the run; without it only floors and ceilings are run
    run: Option<PathBuf>,
    /// Whose problems, goals and rules (overrides plan.protocol)
    #[arg(long, value_enum)]
    protocol: Option<ProtocolName>,
    /// Dataset: the published protocol takes its episodes, plan.source = "dataset" its held-out ones
    #[arg(long, value_name = "DIR")]
    data: Option<PathBuf>,
    /// Run of the same model trained on shuffled actions: one more floor
    #[arg(long, value_name = "RUN")]
    shuffled: Option<PathBuf>,
    /// Folder of the results [default: RUN/plan-PROBLEMS or RUN/plan-reference]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum ProtocolName {
    /// Unseen problems, none trivial, and those that need the door
    Honest,
    /// As published: numpy's pairs, goal at +24
    Reference,
}

#[derive(Debug, Args)]
struct CompareArgs {
    /// Folders that `plan` wrote, as DIR or LABEL=DIR; folders of one method or label are its runs, and the first
    /// method is compared with the others
    #[arg(required = true, value_name = "[LABEL=]DIR")]
    results: Vec<String>,
    /// Folder for compare.json, compare.md and index.html
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
}

#[derive(Debug, Args)]
struct DiagnoseArgs {
    /// Folder of the run
    run: PathBuf,
    /// Dataset whose held-out episodes are looked at
    #[arg(long, value_name = "DIR")]
    data: PathBuf,
    /// Take the trajectories of an earlier diagnose.json
    #[arg(long, value_name = "FILE")]
    trajectories: Option<PathBuf>,
    /// Untrained weights of this seed instead of the run's: a floor
    #[arg(long, value_name = "SEED")]
    untrained: Option<u64>,
    /// Folder of the results [default: RUN/diagnose, RUN/probe]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    #[command(flatten)]
    common: Common,
}

#[derive(Debug, Args)]
struct ExportArgs {
    /// Folder of the run
    run: PathBuf,
    /// File to write
    #[arg(long, value_name = "FILE.safetensors")]
    out: PathBuf,
    /// Names of the encoder's tensors
    #[arg(long, value_enum, default_value = "transformers5")]
    layout: LayoutName,
}

#[derive(Debug, Clone, Copy, ValueEnum)]
enum LayoutName {
    /// As transformers 4 names them
    Transformers4,
    /// As transformers 5 names them
    Transformers5,
}

/// Runs the program with these arguments, the first being its name, and returns its exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) => {
            error.print().ok(); // help on a closed pipe is not worth a word
            return if error.use_stderr() { ExitCode::from(EXIT_USAGE) } else { ExitCode::SUCCESS };
        }
    };
    let outcome = match cli.command {
        Command::Plan(arguments) => run_plan(&arguments),
        Command::Compare(arguments) => run_compare(&arguments),
        Command::Diagnose(arguments) => run_diagnose(&arguments, false),
        Command::Probe(arguments) => run_diagnose(&arguments, true),
        Command::Export(arguments) => run_export(&arguments),
        Command::Completions { shell } => {
            clap_complete::generate(shell, &mut Cli::command(), "gawm-eval", &mut std::io::stdout());
            Ok(ExitCode::SUCCESS)
        }
    };
    outcome.unwrap_or_else(|error| {
        eprintln!("error: {error:#}");
        if let Some(hint) = hint(&error) {
            eprintln!("\nhint: {hint}");
        }
        ExitCode::from(if is_usage(&error) { EXIT_USAGE } else { EXIT_FAILED })
    })
}

fn is_usage(error: &anyhow::Error) -> bool {
    let is_planner = |error: &ProgramError| {
        matches!(
            error,
            ProgramError::NoData | ProgramError::Suite(SuiteError::Planner(_) | SuiteError::NoStateHead)
        )
    };
    error.is::<ConfigError>()
        || error.is::<UsageError>()
        || error.is::<PlannerConfigError>()
        || matches!(error.downcast_ref(), Some(DiagnoseError::Option { .. }))
        || error.downcast_ref().is_some_and(is_planner)
}

fn hint(error: &anyhow::Error) -> Option<&'static str> {
    if let Some(error) = error.downcast_ref::<RunError>() {
        return match error {
            RunError::NoCheckpoint { .. } => {
                Some("train longer: a checkpoint is written at the first validation")
            }
            RunError::Schema { .. } => Some("hello.json and the checkpoint come from different runs"),
            RunError::Io { .. } => Some("give the folder that gawm-train wrote"),
            _ => None,
        };
    }
    if let Some(ProgramError::NoData) = error.downcast_ref() {
        return Some("add --data DIR, or --set plan.source=simulator");
    }
    if let Some(ProgramError::Problems(ProblemError::TooFew { .. })) = error.downcast_ref() {
        return Some("--set plan.count=N asks for fewer; plan.source=simulator makes as many as are needed");
    }
    let is_missing = |error: &DataError| matches!(error, DataError::MissingFrame { .. });
    let data = error.downcast_ref::<DataError>().is_some_and(is_missing)
        || matches!(error.downcast_ref(), Some(ProgramError::Data(error)) if is_missing(error));
    data.then_some("gawm-data validate DIR lists all frames that are missing")
}

/// Reads the configuration, sets the threads, opens the device. `None` if the configuration was only printed.
fn prepare(
    common: &Common,
    adjust: impl FnOnce(&mut EvalConfig),
) -> anyhow::Result<Option<(EvalConfig, Device)>> {
    let mut config = config::read(common.config.as_deref(), &common.overrides)?;
    adjust(&mut config);
    if config.plan.planner.is_none() {
        config.plan.planner = Some(config.plan.planner());
    }
    if common.print_config {
        let table = toml::Table::from_iter([("eval".to_owned(), toml::Value::try_from(&config)?)]);
        writeln!(std::io::stdout(), "{}", toml::to_string(&table)?)?;
        return Ok(None);
    }
    if let Some(threads) = common.threads {
        rayon::ThreadPoolBuilder::new().num_threads(threads.into()).build_global()?;
    }
    let device = match common.device.as_str() {
        "cpu" => Device::Cpu,
        "cuda" => Device::new_cuda(0)?,
        name => match name.strip_prefix("cuda:").and_then(|number| number.parse().ok()) {
            Some(number) => Device::new_cuda(number)?,
            None => {
                return Err(
                    UsageError(format!("--device: expected cpu, cuda or cuda:N, got {name:?}")).into()
                );
            }
        },
    };
    Ok(Some((config, device)))
}

fn progress(quiet: bool, total: u64) -> ProgressBar {
    let is_shown = !quiet && std::io::stderr().is_terminal();
    let target = if is_shown { ProgressDrawTarget::stderr() } else { ProgressDrawTarget::hidden() };
    let style = ProgressStyle::with_template("{msg:32} {bar:30} {pos}/{len}");
    ProgressBar::with_draw_target(Some(total), target)
        .with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()))
}

fn run_plan(arguments: &PlanArgs) -> anyhow::Result<ExitCode> {
    let protocol = arguments.protocol.map(|name| match name {
        ProtocolName::Honest => Protocol::Honest,
        ProtocolName::Reference => Protocol::Reference,
    });
    let adjust = |config: &mut EvalConfig| config.plan.protocol = protocol.unwrap_or(config.plan.protocol);
    let Some((config, device)) = prepare(&arguments.common, adjust)? else { return Ok(ExitCode::SUCCESS) };
    let plan = &config.plan;
    let open = |path: &PathBuf| Run::open(path, &device);
    let run = arguments.run.as_ref().map(open).transpose()?;
    let shuffled = arguments.shuffled.as_ref().map(open).transpose()?;
    let data = match (&run, &arguments.data) {
        (Some(run), Some(path)) => Some(program::open_data(run, path, &plan.system_feature)?),
        (None, Some(_)) => {
            return Err(UsageError("--data needs a RUN, which says what its columns mean".to_owned()).into());
        }
        _ => None,
    };
    let folder = match (&arguments.out, &arguments.run) {
        (Some(out), _) => out.clone(),
        (None, Some(run)) => program::plan_folder(run, plan),
        (None, None) => return Err(UsageError("--out is needed where no RUN is given".to_owned()).into()),
    };
    let bar = progress(arguments.common.quiet, plan.budget_steps as u64);
    let result =
        program::plan(run.as_ref(), shuffled.as_ref(), data.as_ref(), plan, &|set, solver, step| {
            bar.set_message(format!("{set}, {}", solver.name()));
            bar.set_position(step as u64);
        })?;
    bar.finish_and_clear();
    program::write_plan(&folder, &result, plan.sheet_rows)?;
    let text =
        toml::to_string(&toml::Table::from_iter([("eval".to_owned(), toml::Value::try_from(&config)?)]))?;
    crate::output::write(&folder.join("config.toml"), text.as_bytes())?;
    print_plan(&result.report, &folder, arguments.common.quiet)?;
    if program::is_whole(&result.report) {
        return Ok(ExitCode::SUCCESS);
    }
    eprintln!("warning: some problems ended early; outcomes-*.jsonl say which and why");
    Ok(ExitCode::from(EXIT_LOSS))
}

fn print_plan(
    report: &crate::suite::PlanReport,
    folder: &std::path::Path,
    is_quiet: bool,
) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    for set in &report.sets {
        writeln!(out, "{} ({} problems, {})", set.name, set.n, set.source)?;
        for solver in &set.solvers {
            let rate = &solver.any;
            writeln!(
                out,
                "  {:17} {:5.1} %  [{:4.1}, {:5.1}]  last step {:5.1} %  failed {}",
                solver.solver.name(),
                100.0 * rate.rate,
                100.0 * rate.interval.low,
                100.0 * rate.interval.high,
                100.0 * solver.last.rate,
                solver.failed
            )?;
        }
    }
    writeln!(out, "{}", folder.join("index.html").display())?;
    for set in report.sets.iter().filter(|_| !is_quiet) {
        for solver in &set.solvers {
            eprintln!("{} {}: {:.1} s", set.name, solver.solver.name(), solver.seconds);
        }
    }
    Ok(())
}

fn run_compare(arguments: &CompareArgs) -> anyhow::Result<ExitCode> {
    let read = |text: &String| {
        // A folder that is there is meant, whatever its name.
        let (label, path) = match text.split_once('=') {
            Some((label, path)) if !Path::new(text).exists() => (Some(label.to_owned()), path),
            _ => (None, text.as_str()),
        };
        PlanFolder::read(Path::new(path)).map(|folder| PlanFolder { label, ..folder })
    };
    let folders = arguments.results.iter().map(read).collect::<Result<Vec<_>, _>>()?;
    let mut seen = std::collections::BTreeSet::new();
    for folder in &folders {
        if !seen.insert(folder.path.canonicalize().unwrap_or_else(|_| folder.path.clone())) {
            let path = folder.path.display();
            return Err(UsageError(format!("{path} is named twice: one run would count as two")).into());
        }
    }
    let table = compare(&folders);
    if let Some(out) = &arguments.out {
        program::write_comparison(out, &table)?;
    }
    write!(std::io::stdout(), "{}", table.to_markdown())?;
    Ok(ExitCode::SUCCESS)
}

fn run_diagnose(arguments: &DiagnoseArgs, only_probe: bool) -> anyhow::Result<ExitCode> {
    let ids = match &arguments.trajectories {
        None => None,
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .map_err(|cause| ConfigError::Io { path: path.clone(), cause })?;
            let earlier: DiagnoseReport = serde_json::from_str(&text).map_err(|error| {
                ConfigError::Syntax { place: path.display().to_string(), message: error.to_string() }
            })?;
            Some(earlier.trajectory_ids)
        }
    };
    let adjust = |config: &mut EvalConfig| config.diagnose.ids = ids.or_else(|| config.diagnose.ids.take());
    let Some((config, device)) = prepare(&arguments.common, adjust)? else { return Ok(ExitCode::SUCCESS) };
    let mut run = Run::open(&arguments.run, &device)?;
    if let Some(seed) = arguments.untrained {
        run = run.untrained(seed)?;
    }
    let data = program::open_data(&run, &arguments.data, &config.plan.system_feature)?;
    let bar = progress(arguments.common.quiet, config.diagnose.trajectories as u64);
    bar.set_message("encoding trajectories");
    let diagnosis = diagnose(&run, &data, &config.diagnose, &|n| bar.set_position(n as u64))?;
    bar.finish_and_clear();
    if !arguments.common.quiet {
        eprintln!("{:.1} s beyond encoding", diagnosis.seconds);
    }
    let report = &diagnosis.report;
    if only_probe {
        let folder = arguments.out.clone().unwrap_or_else(|| arguments.run.join("probe"));
        let table = program::probe_table(&report.probe);
        table.write(&folder, "probes")?;
        crate::output::write_json(&folder.join("probe.json"), &report.probe)?;
        write!(std::io::stdout(), "{}", table.to_csv())?;
        return Ok(ExitCode::SUCCESS);
    }
    let folder = arguments.out.clone().unwrap_or_else(|| arguments.run.join("diagnose"));
    program::write_diagnosis(&folder, &diagnosis)?;
    print_diagnosis(report, &folder)?;
    Ok(ExitCode::SUCCESS)
}

fn print_diagnosis(report: &DiagnoseReport, folder: &std::path::Path) -> std::io::Result<()> {
    let mut out = std::io::stdout().lock();
    let n = report.trajectory_ids.len();
    writeln!(out, "{n} trajectories, {} frames, held out: {}", report.frames, report.is_held_out)?;
    if let Some(spread) = report.geometry.straightening {
        writeln!(out, "straightening          {:.3} +- {:.3}", spread.mean, spread.std)?;
    }
    if let Some(spread) = report.geometry.r95 {
        writeln!(out, "r95                    {:.1} +- {:.1}", spread.mean, spread.std)?;
    }
    writeln!(
        out,
        "effective rank         {:.1}, RankMe {:.1}",
        report.rank.effective_rank, report.rank.rankme
    )?;
    for h in &report.rollouts.horizons {
        let [ratio, sensitivity] =
            [h.against_identity, h.action_sensitivity].map(|value| value.unwrap_or(f64::NAN));
        let chunks = h.chunks;
        writeln!(
            out,
            "prediction +{chunks}          {ratio:.3} of identity, shuffled actions x {sensitivity:.2}"
        )?;
    }
    for score in report.probe.scores.iter().filter(|score| score.chunks == 0) {
        let (r2, rmse, unit) = (score.r2.unwrap_or(f64::NAN), score.rmse, &score.unit);
        let unit = if unit == "1" { String::new() } else { format!(" {unit}") };
        writeln!(out, "probe {:10} {:6} R2 {r2:.3}, RMSE {rmse:.3}{unit}", score.dim, score.probe)?;
    }
    if let Some(r) = &report.retrieval {
        writeln!(out, "goal retrieval         {:.3} (best {:.3}, random {:.3})", r.latent, r.best, r.random)?;
    }
    writeln!(out, "{}", folder.join("index.html").display())
}

fn run_export(arguments: &ExportArgs) -> anyhow::Result<ExitCode> {
    let run = Run::open(&arguments.run, &Device::Cpu)?;
    let layout = match arguments.layout {
        LayoutName::Transformers4 => KeyLayout::Transformers4,
        LayoutName::Transformers5 => KeyLayout::Transformers5,
    };
    export(&arguments.out, &run.model, layout)?;
    writeln!(std::io::stdout(), "{}", arguments.out.display())?;
    Ok(ExitCode::SUCCESS)
}
