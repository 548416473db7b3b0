//! The program: `gawm-sim collect` and `gawm-sim bench`.

mod config;

use std::ffi::OsString;
use std::io::{IsTerminal, Write as _};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Instant;

use anyhow::Context;
use clap::{Args, CommandFactory, Parser, Subcommand};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::collect::{CollectError, CollectSummary, collect_until};
use crate::environment::{Environment, Frame};
use crate::two_room::{TwoRoom, TwoRoomConfig};
pub use config::{EnvironmentName, ImageName, SimConfig, SimConfigError};

/// Failed, nothing usable.
const EXIT_FAILED: u8 = 1;
/// Bad arguments or configuration.
const EXIT_USAGE: u8 = 2;
/// Stopped by the user.
const EXIT_INTERRUPTED: u8 = 130;

/// The resolved configuration, beside the logs.
const CONFIG_FILE: &str = "sim.toml";

/// Run environments: collect logs of an expert, or measure speed
#[derive(Debug, Parser)]
#[command(name = "gawm-sim", version, max_term_width = 100)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Let an expert act and write what happens as MCAP logs
    Collect(CollectArgs),
    /// Measure how fast an environment steps and renders
    Bench(BenchArgs),
    /// Print a completion script for a shell
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
}

#[derive(Debug, Args)]
#[command(after_long_help = "Examples:
  gawm-sim collect --env two-room --episodes 100 --seed 7 --out LOGS/
  gawm-sim collect --config pipeline.toml --set max_steps=30 --out LOGS/
  gawm-sim collect --episodes 1 --seed 1 --print-config")]
struct CollectArgs {
    /// Configuration: the section [sim] of a pipeline, or a file with its keys
    #[arg(long, value_name = "P.toml")]
    config: Option<PathBuf>,
    /// Environment
    #[arg(long, value_enum)]
    env: Option<EnvironmentName>,
    /// Number of episodes
    #[arg(long)]
    episodes: Option<u64>,
    /// Seed: the same seed and options give the same bytes, whatever --jobs
    #[arg(long)]
    seed: Option<u64>,
    /// Folder of the logs, new or empty
    #[arg(long, value_name = "LOGS", required_unless_present = "print_config")]
    out: Option<PathBuf>,
    /// Episodes in a log; the last log may have fewer [default: 50]
    #[arg(long)]
    episodes_per_file: Option<u64>,
    /// Logs that are written at the same time; all processors by default
    #[arg(long, visible_alias = "threads", value_name = "N", value_parser = clap::value_parser!(u16).range(1..=1024))]
    jobs: Option<u16>,
    /// How frames are stored [default: png]
    #[arg(long, value_enum)]
    image: Option<ImageName>,
    /// JPEG quality, 1 to 100 [default: 95]
    #[arg(long)]
    quality: Option<u8>,
    /// Side of the stored frames in pixels; they are drawn at 224 and resized [default: 224]
    #[arg(long)]
    size: Option<u16>,
    /// Longest episode, in steps of 0.1 s [default: 100]
    #[arg(long)]
    max_steps: Option<u32>,
    /// Standard deviation of the expert's noise on each action component [default: 2]
    #[arg(long)]
    action_noise: Option<f64>,
    /// Probability that the expert repeats its last action [default: 0.05]
    #[arg(long)]
    action_repeat: Option<f64>,
    /// Override a value of the configuration, such as max_steps=30 or room.speed_px=4
    #[arg(long = "set", value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Print the configuration with all defaults and overrides, and do nothing
    #[arg(long)]
    print_config: bool,
    /// Say less: no progress
    #[arg(short, long)]
    quiet: bool,
}

impl CollectArgs {
    /// The configuration: file, then --set, then options.
    fn resolve(&self) -> Result<SimConfig, SimConfigError> {
        let mut config = SimConfig::load(self.config.as_deref(), &self.set)?;
        let chosen = &mut config;
        assign(&mut chosen.env, self.env);
        chosen.episodes = self.episodes.or(chosen.episodes);
        chosen.seed = self.seed.or(chosen.seed);
        assign(&mut chosen.episodes_per_file, self.episodes_per_file);
        assign(&mut chosen.image, self.image);
        assign(&mut chosen.quality, self.quality);
        assign(&mut chosen.size, self.size);
        assign(&mut chosen.max_steps, self.max_steps);
        assign(&mut chosen.action_noise, self.action_noise);
        assign(&mut chosen.action_repeat, self.action_repeat);
        Ok(config)
    }
}

fn assign<T>(to: &mut T, value: Option<T>) {
    if let Some(value) = value {
        *to = value;
    }
}

#[derive(Debug, Args)]
struct BenchArgs {
    /// Environment
    #[arg(long, value_enum, default_value = "two-room")]
    env: EnvironmentName,
    /// Steps that are rendered; a thousand times as many are taken without rendering
    #[arg(long, default_value_t = 20_000, value_parser = clap::value_parser!(u32).range(1..))]
    steps: u32,
}

/// Runs the program with these arguments, the first being its name, and returns its exit code.
pub fn main(arguments: impl IntoIterator<Item = OsString>) -> ExitCode {
    let cli = match Cli::try_parse_from(arguments) {
        Ok(cli) => cli,
        Err(error) => {
            // Help and version are printed on stdout and are no failure. A closed pipe is not worth a word.
            error.print().ok();
            return if error.use_stderr() { ExitCode::from(EXIT_USAGE) } else { ExitCode::SUCCESS };
        }
    };
    let outcome = match cli.command {
        Command::Collect(arguments) => run_collect(&arguments),
        Command::Bench(arguments) => run_bench(&arguments),
        Command::Completions { shell } => {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Cli::command(), "gawm-sim", &mut script);
            print(&String::from_utf8_lossy(&script)).map_err(Into::into)
        }
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            let mut stderr = std::io::stderr().lock();
            // Nothing can be done when stderr is closed.
            writeln!(stderr, "error: {error:#}").ok();
            let collect_error = error.downcast_ref::<CollectError>();
            if let Some(hint) = collect_error.and_then(hint) {
                writeln!(stderr, "\nhint: {hint}").ok();
            }
            let is_config = error.downcast_ref::<SimConfigError>().is_some();
            ExitCode::from(match collect_error {
                Some(CollectError::Interrupted) => EXIT_INTERRUPTED,
                Some(error) if is_usage(error) => EXIT_USAGE,
                _ if is_config => EXIT_USAGE,
                _ => EXIT_FAILED,
            })
        }
    }
}

/// Writes a result to stdout; a reader that has gone away (`| head`) is no error.
fn print(text: &str) -> std::io::Result<()> {
    match std::io::stdout().lock().write_all(text.as_bytes()) {
        Err(error) if error.kind() == std::io::ErrorKind::BrokenPipe => Ok(()),
        other => other,
    }
}

fn hint(error: &CollectError) -> Option<&'static str> {
    match error {
        CollectError::NotEmpty { .. } => Some("choose another --out, or remove what is there"),
        CollectError::TooMany { .. } => Some("collect several times, each with its own --seed and --out"),
        CollectError::Interrupted => {
            Some("logs that are complete stay; remove the folder and run again for all")
        }
        error if is_disk_full(error) => {
            Some("logs that are complete are usable; free space, remove the folder and run again")
        }
        _ => None,
    }
}

/// Whether there was no space left, at the bottom of an error.
fn is_disk_full(error: &CollectError) -> bool {
    let mut causes = std::iter::successors(Some(error as &dyn std::error::Error), |error| error.source());
    causes.any(|cause| {
        let io = cause.downcast_ref::<std::io::Error>();
        io.is_some_and(|io| io.kind() == std::io::ErrorKind::StorageFull)
    })
}

fn is_usage(error: &CollectError) -> bool {
    matches!(
        error,
        CollectError::NotEmpty { .. }
            | CollectError::Zero { .. }
            | CollectError::TooMany { .. }
            | CollectError::Config(_)
    )
}

fn run_collect(arguments: &CollectArgs) -> anyhow::Result<()> {
    let config = arguments.resolve()?;
    if arguments.print_config {
        return print(&config.to_toml()?).context("failed to write the result");
    }
    let Some(out) = &arguments.out else { return Ok(()) };
    let EnvironmentName::TwoRoom = config.env;
    let options = config.options(arguments.jobs.map_or_else(processors, usize::from))?;
    let interrupt = Arc::new(AtomicBool::new(false));
    let flag = Arc::clone(&interrupt);
    ctrlc::set_handler(move || flag.store(true, Ordering::Relaxed)).context("cannot watch for Ctrl-C")?;
    let bar = if arguments.quiet { ProgressBar::hidden() } else { progress_bar(options.episodes) };
    let start = Instant::now();
    let summary = collect_until(out, &options, &|episodes| bar.inc(episodes), &interrupt);
    bar.finish_and_clear();
    let summary = summary?;
    let path = out.join(CONFIG_FILE);
    std::fs::write(&path, config.to_toml()?).map_err(|source| CollectError::Io {
        action: "write",
        path,
        source,
    })?;
    if !arguments.quiet {
        let seconds = start.elapsed().as_secs_f64();
        writeln!(std::io::stderr(), "{seconds:.2} s, {:.0} rows/s", summary.rows as f64 / seconds).ok();
    }
    print(&described(&summary)).context("failed to write the result")
}

fn processors() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

fn progress_bar(episodes: u64) -> ProgressBar {
    let target = if std::io::stderr().is_terminal() {
        ProgressDrawTarget::stderr()
    } else {
        ProgressDrawTarget::hidden()
    };
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} episodes, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::with_draw_target(Some(episodes), target).with_style(style)
}

fn described(summary: &CollectSummary) -> String {
    let mut text: String = summary.logs.iter().map(|log| format!("{}\n", log.display())).collect();
    text.push_str(&format!(
        "{} logs, {} episodes ({} reached the target), {} rows, {:.1} MB\n",
        summary.logs.len(),
        summary.episodes,
        summary.successes,
        summary.rows,
        summary.bytes as f64 / 1e6
    ));
    text
}

/// How many steps without rendering are measured for each one with.
const STEPS_PER_RENDER: u64 = 1000;

fn run_bench(arguments: &BenchArgs) -> anyhow::Result<()> {
    let EnvironmentName::TwoRoom = arguments.env;
    let mut room = TwoRoom::new(TwoRoomConfig::default())?;
    let mut frame = Frame::default();
    let actions = bench_actions();
    let n_rendered = u64::from(arguments.steps);
    let rendered_us = measure_us(n_rendered, &mut room, |room, i| {
        room.step(&actions[i % actions.len()])?;
        room.render(&mut frame);
        Ok(())
    })?;
    let n_stepped = n_rendered * STEPS_PER_RENDER;
    let stepped_us = measure_us(n_stepped, &mut room, |room, i| {
        room.step(&actions[i % actions.len()])?;
        Ok(())
    })?;
    print(&format!(
        "step and render: {rendered_us:.2} us ({n_rendered} times, one thread)\n\
         step:            {stepped_us:.4} us ({n_stepped} times, one thread)\n\
         last frame:      {:?} of {} bytes\n",
        room.agent(),
        frame.rgb.len()
    ))
    .context("failed to write the result")
}

/// Actions that send the agent about the room.
fn bench_actions() -> Vec<[f32; 2]> {
    (0..997_u32).map(|i| [(i as f32 * 0.7).sin() * 1.2, (i as f32 * 0.43).cos() * 1.2]).collect()
}

/// Microseconds per call.
fn measure_us(
    n: u64,
    room: &mut TwoRoom,
    mut call: impl FnMut(&mut TwoRoom, usize) -> anyhow::Result<()>,
) -> anyhow::Result<f64> {
    room.reset(0);
    let start = Instant::now();
    for i in 0..n {
        call(room, i as usize)?;
    }
    Ok(start.elapsed().as_secs_f64() * 1e6 / n as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_disk_is_seen_through_the_writer_of_logs() {
        let error = |kind: std::io::ErrorKind| CollectError::Mcap {
            path: PathBuf::from("a.mcap"),
            source: mcap::McapError::Io(kind.into()),
        };
        let text = hint(&error(std::io::ErrorKind::StorageFull)).unwrap_or_default();
        assert!(text.contains("free space"), "{text}");
        assert_eq!(hint(&error(std::io::ErrorKind::NotFound)), None);
    }
}
