//! Running the steps that are not up to date, each as a process of this program.

use std::ffi::OsString;
use std::fs::File;
use std::os::unix::process::CommandExt as _;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use super::ledger::{Ledger, LedgerEntry, LedgerError};
use gawm_schema::pipeline::SECTIONS;

use super::steps::{Layout, Step, StepName, plan_steps};
use super::{Pipeline, PipelineError};

/// Exit code of a program that was interrupted.
const INTERRUPTED: u8 = 130;
/// Exit code of a program that was told something wrong.
const USAGE: u8 = 2;
/// Exit code of a program that finished with something to look at.
const WITH_LOSS: u8 = 3;
/// How often a running step is looked at.
const POLL: Duration = Duration::from_millis(20);

/// What to run.
#[derive(Debug, Clone)]
pub struct RunOptions<'a> {
    /// Folder of all results.
    pub out: &'a Path,
    /// Logs of a user; empty: those of the pipeline's simulator.
    pub logs: &'a [PathBuf],
    /// The last step to run.
    pub until: Option<StepName>,
    /// Run this step and those after it even if they are up to date.
    pub from: Option<StepName>,
    /// Only say what would be run.
    pub is_dry: bool,
    /// This program.
    pub program: &'a Path,
}

/// What became of a pipeline.
#[derive(Debug, Clone)]
pub struct Outcome {
    /// A line per step.
    pub steps: Vec<StepReport>,
}

/// What became of a step.
#[derive(Debug, Clone)]
pub struct StepReport {
    /// Which.
    pub name: StepName,
    /// Whether nothing had to be done.
    pub was_up_to_date: bool,
    /// Exit code: 0, or 3 with something to look at.
    pub exit: u8,
    /// Wall time, seconds; of the run that did it, when it was up to date.
    pub seconds: f64,
}

/// Why a pipeline stopped.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum RunError {
    /// The pipeline cannot be used.
    #[error(transparent)]
    Pipeline(#[from] PipelineError),
    /// The ledger cannot be used.
    #[error(transparent)]
    Ledger(#[from] LedgerError),
    /// A file or folder of the results cannot be made or removed.
    #[error("{path}")]
    Io {
        /// Which.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// Another pipeline, or a step of one that was killed, works in the folder.
    #[error(
        "{path} is locked: another pipeline, or a step of one that was killed, still works in this folder"
    )]
    InUse {
        /// The file that is locked.
        path: PathBuf,
    },
    /// There is something in the way that no step of this pipeline made.
    #[error("{path} is there, but no step of this pipeline made it")]
    Foreign {
        /// What is in the way.
        path: PathBuf,
    },
    /// A step cannot be started.
    #[error("cannot start step {name}")]
    Start {
        /// The step.
        name: &'static str,
        /// The cause.
        source: std::io::Error,
    },
    /// A step failed.
    #[error("step {name} ended with {status}; it can be repeated by\n  {command}")]
    Step {
        /// The step.
        name: &'static str,
        /// `exit code 1`, `signal 9`.
        status: String,
        /// Whether the step says that it was told something wrong (exit code 2).
        is_usage: bool,
        /// The command line.
        command: String,
    },
    /// The user interrupted.
    #[error("interrupted in step {name}; run the same command again to go on")]
    Interrupted {
        /// The step.
        name: &'static str,
    },
}

/// Runs the steps of a pipeline that are not up to date, in order.
///
/// `say` gets a line for people about each step as it begins and ends.
///
/// # Errors
///
/// The first step that fails ends the pipeline; what is done stays done.
pub fn run(
    pipeline: &Pipeline,
    options: &RunOptions,
    say: &mut dyn FnMut(&str),
) -> Result<Outcome, RunError> {
    pipeline.check()?;
    let steps = plan_steps(pipeline, options.out, options.logs)?;
    let layout = Layout::of(options.out);
    let mut _lock = None;
    if !options.is_dry {
        std::fs::create_dir_all(options.out)
            .map_err(|source| RunError::Io { path: options.out.to_owned(), source })?;
        _lock = Some(lock(&layout.lock)?);
    }
    let mut ledger = Ledger::load(&layout.ledger)?;
    if !options.is_dry {
        let moved =
            pipeline.moved().map_err(|source| RunError::Io { path: pipeline.path.clone(), source })?;
        let resolved = moved.text_of(&SECTIONS);
        std::fs::write(&layout.config, resolved)
            .map_err(|source| RunError::Io { path: layout.config.clone(), source })?;
    }
    let mut outcome = Outcome { steps: Vec::new() };
    let count = steps.iter().filter(|step| options.until.is_none_or(|until| step.name <= until)).count();
    for (i, step) in steps.iter().take(count).enumerate() {
        let head = format!("[{}/{count}] {}: {}", i + 1, step.name.as_str(), step.what);
        let entry = ledger.entry(step.name.as_str()).filter(|entry| entry.key == step.key);
        let is_forced = options.from.is_some_and(|from| step.name >= from);
        if let Some(entry) = entry.filter(|entry| entry.is_done && step.output.exists() && !is_forced) {
            say(&format!("{head}: up to date"));
            outcome.steps.push(report(step, entry, true));
            continue;
        }
        let can_resume = entry.is_some() && !is_forced && step.resume.is_some() && step.output.exists();
        if options.is_dry {
            say(&format!("{head}\n  {}", command_line(options.program, &step.arguments)));
            continue;
        }
        say(&head);
        let entry = run_step(step, can_resume, &mut ledger, &layout, options.program, say)?;
        let warning = if entry.exit == WITH_LOSS { ", with something to look at (exit code 3)" } else { "" };
        say(&format!("[{}/{count}] {}: done in {:.1} s{warning}", i + 1, step.name.as_str(), entry.seconds));
        outcome.steps.push(report(step, &entry, false));
    }
    Ok(outcome)
}

/// Takes the folder of the results for this process and the steps that it starts.
///
/// The steps inherit the lock: one that goes on after its pipeline was killed still holds the folder.
fn lock(path: &Path) -> Result<File, RunError> {
    let io = |source| RunError::Io { path: path.to_owned(), source };
    let file = File::options().create(true).append(true).open(path).map_err(io)?;
    match rustix::fs::flock(&file, rustix::fs::FlockOperation::NonBlockingLockExclusive) {
        Ok(()) => {}
        Err(rustix::io::Errno::WOULDBLOCK) => return Err(RunError::InUse { path: path.to_owned() }),
        Err(error) => return Err(io(error.into())),
    }
    rustix::io::fcntl_setfd(&file, rustix::io::FdFlags::empty()).map_err(|error| io(error.into()))?;
    Ok(file)
}

fn report(step: &Step, entry: &LedgerEntry, was_up_to_date: bool) -> StepReport {
    StepReport { name: step.name, was_up_to_date, exit: entry.exit, seconds: entry.seconds }
}

/// Runs one step and enters it into the ledger, before and after.
fn run_step(
    step: &Step,
    can_resume: bool,
    ledger: &mut Ledger,
    layout: &Layout,
    program: &Path,
    say: &mut dyn FnMut(&str),
) -> Result<LedgerEntry, RunError> {
    let name = step.name.as_str();
    let mut arguments = step.arguments.clone();
    if can_resume {
        arguments.extend(step.resume.clone().unwrap_or_default());
    } else {
        let earlier = ledger.entry(name);
        if step.name == StepName::Train && earlier.is_some_and(|entry| entry.is_done) {
            keep_model(&step.output, say)?;
        }
        clear(&step.output, earlier.is_some())?;
    }
    let command = command_line(program, &step.arguments);
    let mut entry = LedgerEntry {
        name: name.to_owned(),
        key: step.key.clone(),
        is_done: false,
        exit: 0,
        seconds: 0.0,
        command: command.clone(),
    };
    ledger.put(entry.clone());
    ledger.save(&layout.ledger)?;
    let start = Instant::now();
    let status = spawn_and_wait(program, &arguments, step)?;
    entry.seconds = start.elapsed().as_secs_f64();
    match status.code().and_then(|code| u8::try_from(code).ok()) {
        Some(code @ (0 | WITH_LOSS)) => {
            entry.exit = code;
            entry.is_done = true;
            ledger.put(entry.clone());
            ledger.save(&layout.ledger)?;
            Ok(entry)
        }
        Some(INTERRUPTED) => Err(RunError::Interrupted { name }),
        code => {
            Err(RunError::Step { name, status: status.to_string(), is_usage: code == Some(USAGE), command })
        }
    }
}

/// Moves a trained model aside: everything else is made again in minutes, a model in hours.
fn keep_model(output: &Path, say: &mut dyn FnMut(&str)) -> Result<(), RunError> {
    if !output.exists() {
        return Ok(());
    }
    let aside = (1..).map(|n| output.with_extension(n.to_string())).find(|path| !path.exists());
    let aside = aside.expect("some number is free");
    std::fs::rename(output, &aside).map_err(|source| RunError::Io { path: output.to_owned(), source })?;
    say(&format!("the model trained before is kept in {}", aside.display()));
    Ok(())
}

/// Removes what an earlier attempt left; what no step of ours made is not touched.
fn clear(output: &Path, is_ours: bool) -> Result<(), RunError> {
    let metadata = match std::fs::symlink_metadata(output) {
        Ok(metadata) => metadata,
        Err(error) if error.kind() == std::io::ErrorKind::NotFound => return Ok(()),
        Err(source) => return Err(RunError::Io { path: output.to_owned(), source }),
    };
    if !is_ours {
        return Err(RunError::Foreign { path: output.to_owned() });
    }
    let removed =
        if metadata.is_dir() { std::fs::remove_dir_all(output) } else { std::fs::remove_file(output) };
    removed.map_err(|source| RunError::Io { path: output.to_owned(), source })
}

/// How often Ctrl-C came.
static INTERRUPTS: AtomicU32 = AtomicU32::new(0);

/// Counts Ctrl-C and termination instead of ending: [`run`] passes them on to the step that runs, which saves what it
/// has and ends.
///
/// # Errors
///
/// Another handler is already there.
pub(crate) fn pass_interrupts_on() -> Result<(), ctrlc::Error> {
    ctrlc::set_handler(|| {
        INTERRUPTS.fetch_add(1, Ordering::Relaxed);
    })
}

/// Runs this program with `arguments` in a process group of its own, so that it gets each Ctrl-C once, from us.
fn spawn_and_wait(program: &Path, arguments: &[OsString], step: &Step) -> Result<ExitStatus, RunError> {
    let name = step.name.as_str();
    let start = |source| RunError::Start { name, source };
    let mut command = Command::new(program);
    command.args(arguments).stdin(Stdio::null()).process_group(0);
    let part = step.stdout.as_ref().map(|path| path.with_extension("part"));
    if let Some(part) = &part {
        command.stdout(File::create(part).map_err(|source| RunError::Io { path: part.clone(), source })?);
    }
    if INTERRUPTS.load(Ordering::Relaxed) > 0 {
        return Err(RunError::Interrupted { name });
    }
    let mut child = command.spawn().map_err(start)?;
    let status = wait(&mut child).map_err(start)?;
    if let (Some(part), Some(path)) = (&part, &step.stdout) {
        std::fs::rename(part, path).map_err(|source| RunError::Io { path: path.clone(), source })?;
    }
    if INTERRUPTS.load(Ordering::Relaxed) > 0 && !status.success() {
        return Err(RunError::Interrupted { name });
    }
    Ok(status)
}

/// Waits for a step and passes each interrupt on to it.
///
/// The same thread reaps and signals, so that a signal never meets another process under the number of one that ended.
fn wait(child: &mut Child) -> std::io::Result<ExitStatus> {
    let mut passed_on = 0;
    loop {
        if let Some(status) = child.try_wait()? {
            return Ok(status);
        }
        if INTERRUPTS.load(Ordering::Relaxed) > passed_on {
            passed_on += 1;
            if let Some(pid) = i32::try_from(child.id()).ok().and_then(rustix::process::Pid::from_raw) {
                rustix::process::kill_process(pid, rustix::process::Signal::INT)?;
            }
        }
        std::thread::sleep(POLL);
    }
}

/// Returns a command line that a shell understands.
fn command_line(program: &Path, arguments: &[OsString]) -> String {
    let name = program.file_name().map_or_else(|| "gawm".into(), |name| name.to_string_lossy());
    let mut line = name.into_owned();
    for argument in arguments {
        let argument = argument.to_string_lossy();
        line.push(' ');
        if argument.chars().all(|c| c.is_ascii_alphanumeric() || "-_./=:,@+".contains(c))
            && !argument.is_empty()
        {
            line.push_str(&argument);
        } else {
            line.push('\'');
            line.push_str(&argument.replace('\'', "'\\''"));
            line.push('\'');
        }
    }
    line
}
