//! `gawm-ingest suggest`.

use std::path::PathBuf;

use clap::Args;

use super::{Exit, Failure, Global, print};
use crate::decode::SchemaLibrary;
use crate::log::OpenOptions;
use crate::suggest;

/// Arguments of `suggest`.
#[derive(Debug, Args)]
#[command(after_long_help = "Example:
  gawm-ingest suggest run.mcap > contract.toml")]
pub(crate) struct SuggestArgs {
    /// MCAP, HDF5 and npz files, rosbag2 and LeRobot folders, or folders of them
    #[arg(value_name = "LOG", required = true)]
    logs: Vec<PathBuf>,
    /// Folder of .msg files for channels without a schema
    #[arg(long, value_name = "DIR")]
    schemas: Vec<PathBuf>,
}

/// Runs the command.
pub(crate) fn run(args: &SuggestArgs, _global: &Global) -> Result<Exit, Failure> {
    let library = library(&args.schemas)?;
    let mut suggestion = suggest::suggest(&args.logs, &library, &OpenOptions::default())
        .map_err(|error| Failure { code: 1, hint: error.hint(), error: anyhow::Error::new(error) })?;
    suggestion.contract.schemas.clone_from(&args.schemas);
    print(&suggest::to_toml(&suggestion))?;
    Ok(Exit::Clean)
}

/// Returns the built-in types and those of folders.
pub(crate) fn library(folders: &[PathBuf]) -> Result<SchemaLibrary, Failure> {
    let mut library = SchemaLibrary::builtin();
    for folder in folders {
        library.add_folder(folder).map_err(|error| Failure {
            code: 2,
            error: anyhow::Error::new(error),
            hint: None,
        })?;
    }
    Ok(library)
}
