//! `gawm-ingest explain`.

use std::path::PathBuf;

use clap::Args;

use super::{Exit, Failure, Global, print};
use crate::explain::{Question, explain};

/// Arguments of `explain`.
#[derive(Debug, Args)]
#[command(after_long_help = "Example:
  gawm-ingest explain dataset 0 12 joint_3 --log logs/")]
pub(crate) struct ExplainArgs {
    /// Folder of the dataset
    #[arg(value_name = "DIR")]
    dir: PathBuf,
    /// Number of the episode, from 0
    #[arg(value_name = "EPISODE")]
    episode: u64,
    /// Number of the frame in the episode, from 0
    #[arg(value_name = "FRAME")]
    frame: u64,
    /// Name of the value: joint_1, action[3], observation.state.joint_1, joint_1.sin, gawm.state[3], or an image feature
    #[arg(value_name = "DIM")]
    dim: String,
    /// Files and folders in which the source logs are looked for, by their hash
    #[arg(long, value_name = "FILE", num_args = 1..)]
    log: Vec<PathBuf>,
}

/// Runs the command.
pub(crate) fn run(args: &ExplainArgs, _global: &Global) -> Result<Exit, Failure> {
    let question = Question {
        dir: &args.dir,
        episode: args.episode,
        frame: args.frame,
        dim: &args.dim,
        logs: &args.log,
    };
    let text = explain(&question).map_err(|error| Failure {
        code: error.exit_code(),
        error: anyhow::Error::new(error),
        hint: None,
    })?;
    print(&text)?;
    Ok(Exit::Clean)
}
