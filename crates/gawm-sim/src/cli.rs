//! The program: `gawm-sim collect` and `gawm-sim bench`.

use std::ffi::OsString;
use std::io::IsTerminal;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Instant;

use anyhow::Context;
use clap::{Args, Parser, Subcommand, ValueEnum};
use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

use crate::collect::{CollectError, CollectOptions, CollectSummary, ImageFormat, collect};
use crate::environment::{Environment, Frame};
use crate::two_room::{ExpertConfig, TwoRoom, TwoRoomConfig};

/// Failed, nothing usable.
const EXIT_FAILED: u8 = 1;
/// Bad arguments or configuration.
const EXIT_USAGE: u8 = 2;

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
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum EnvironmentName {
    /// A dot that goes to a target, through the door of a wall
    TwoRoom,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum ImageName {
    /// Lossless
    Png,
    /// Smaller; see --quality
    Jpeg,
}

#[derive(Debug, Args)]
struct CollectArgs {
    /// Environment
    #[arg(long, value_enum)]
    env: EnvironmentName,
    /// Number of episodes
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    episodes: u64,
    /// Seed: the same seed and options give the same bytes, whatever --jobs
    #[arg(long)]
    seed: u64,
    /// Folder of the logs, new or empty
    #[arg(long, value_name = "LOGS")]
    out: PathBuf,
    /// Episodes in a log; the last log may have fewer
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..))]
    episodes_per_file: u64,
    /// Logs that are written at the same time; all processors by default
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..))]
    jobs: Option<u16>,
    /// How frames are stored
    #[arg(long, value_enum, default_value = "png")]
    image: ImageName,
    /// JPEG quality
    #[arg(long, default_value_t = 95, value_parser = clap::value_parser!(u8).range(1..=100))]
    quality: u8,
    /// Side of the stored frames in pixels; they are drawn at 224 and resized
    #[arg(long, default_value_t = 224, value_parser = clap::value_parser!(u16).range(8..=4096))]
    size: u16,
    /// Longest episode, in steps of 0.1 s
    #[arg(long, default_value_t = 100, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    max_steps: u32,
    /// Standard deviation of the expert's noise on each action component
    #[arg(long, default_value_t = 2.0, value_parser = noise)]
    action_noise: f64,
    /// Probability that the expert repeats its last action
    #[arg(long, default_value_t = 0.05, value_parser = probability)]
    action_repeat: f64,
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

fn noise(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1e6)
}

fn probability(text: &str) -> Result<f64, String> {
    within(text, 0.0, 1.0)
}

fn within(text: &str, low: f64, high: f64) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(value) if (low..=high).contains(&value) => Ok(value),
        _ => Err(format!("expected a number from {low} to {high}")),
    }
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
    };
    match outcome {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let collect_error = error.downcast_ref::<CollectError>();
            if let Some(hint) = collect_error.and_then(hint) {
                eprintln!("\nhint: {hint}");
            }
            ExitCode::from(if collect_error.is_some_and(is_usage) { EXIT_USAGE } else { EXIT_FAILED })
        }
    }
}

fn hint(error: &CollectError) -> Option<&'static str> {
    match error {
        CollectError::NotEmpty { .. } => Some("choose another --out, or remove what is there"),
        CollectError::TooMany { .. } => Some("collect several times, each with its own --seed and --out"),
        CollectError::Io { source, .. } if source.kind() == std::io::ErrorKind::StorageFull => {
            Some("logs that are complete are usable; free space, remove the folder and run again")
        }
        _ => None,
    }
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
    let EnvironmentName::TwoRoom = arguments.env;
    let options = CollectOptions {
        room: TwoRoomConfig::default(),
        expert: ExpertConfig {
            action_noise: arguments.action_noise,
            action_repeat: arguments.action_repeat,
            ..ExpertConfig::default()
        },
        episodes: arguments.episodes,
        seed: arguments.seed,
        max_steps: arguments.max_steps,
        episodes_per_file: arguments.episodes_per_file,
        jobs: arguments.jobs.map_or_else(processors, usize::from),
        image: match arguments.image {
            ImageName::Png => ImageFormat::Png,
            ImageName::Jpeg => ImageFormat::Jpeg { quality: arguments.quality },
        },
        image_size: Some(arguments.size.into()),
    };
    let bar = progress_bar(arguments.episodes);
    let start = Instant::now();
    let summary = collect(&arguments.out, &options, &|episodes| bar.inc(episodes))?;
    bar.finish_and_clear();
    let seconds = start.elapsed().as_secs_f64();
    eprintln!("{seconds:.2} s, {:.0} rows/s", summary.rows as f64 / seconds);
    print_summary(&summary).context("failed to write the result")
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

fn print_summary(summary: &CollectSummary) -> std::io::Result<()> {
    use std::io::Write;
    let mut out = std::io::stdout().lock();
    for log in &summary.logs {
        writeln!(out, "{}", log.display())?;
    }
    writeln!(
        out,
        "{} logs, {} episodes ({} reached the target), {} rows, {:.1} MB",
        summary.logs.len(),
        summary.episodes,
        summary.successes,
        summary.rows,
        summary.bytes as f64 / 1e6
    )
}

/// How many steps without rendering are measured for each one with.
const STEPS_PER_RENDER: u64 = 1000;

fn run_bench(arguments: &BenchArgs) -> anyhow::Result<()> {
    use std::io::Write;
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
    let mut out = std::io::stdout().lock();
    writeln!(out, "step and render: {rendered_us:.2} us ({n_rendered} times, one thread)")?;
    writeln!(out, "step:            {stepped_us:.4} us ({n_stepped} times, one thread)")?;
    writeln!(out, "last frame:      {:?} of {} bytes", room.agent(), frame.rgb.len())?;
    Ok(())
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
