//! The command line of a loader.

use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use crate::config::TrainConfig;

/// Where the loader program is.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub enum LoaderProgram {
    /// A program `gawm-loader` beside this one.
    #[default]
    Beside,
    /// This very program with these arguments before those of `gawm-loader`: how a program that holds all of them
    /// starts the loader in itself.
    Itself(Vec<OsString>),
    /// A program of the user's choice.
    At(PathBuf),
}

/// How loaders of a run are started.
#[derive(Debug, Clone)]
pub struct LoaderCommand {
    program: PathBuf,
    arguments: Vec<OsString>,
}

impl LoaderCommand {
    /// Finds the program and fixes what is common to all loaders of a run: the resolved configuration, the data, the
    /// length.
    ///
    /// # Errors
    ///
    /// - if the path of this program cannot be found out.
    pub fn new(
        program: &LoaderProgram,
        config: &Path,
        data: &[PathBuf],
        train: &TrainConfig,
    ) -> std::io::Result<LoaderCommand> {
        let (program, mut arguments) = match program {
            LoaderProgram::Beside => {
                let own = std::env::current_exe()?;
                (own.with_file_name(format!("gawm-loader{}", std::env::consts::EXE_SUFFIX)), Vec::new())
            }
            LoaderProgram::Itself(arguments) => (std::env::current_exe()?, arguments.clone()),
            LoaderProgram::At(path) => (path.clone(), Vec::new()),
        };
        arguments.push("run".into());
        arguments.extend(["--config".into(), config.as_os_str().to_owned()]);
        for folder in data {
            arguments.extend(["--data".into(), folder.as_os_str().to_owned()]);
        }
        for (flag, number) in [
            ("--total-steps", train.steps),
            ("--validate-every", train.validate_every),
            ("--validation-batches", train.validation_batches),
        ] {
            arguments.extend([flag.into(), number.to_string().into()]);
        }
        Ok(LoaderCommand { program, arguments })
    }

    /// The command of one loader, for batches from `start` on.
    pub(super) fn of(&self, service: &str, loader: u32, loaders: u32, start: u64) -> Command {
        let mut command = Command::new(&self.program);
        command.args(&self.arguments).args(["--service", service]);
        for (flag, number) in
            [("--loader", u64::from(loader)), ("--loaders", u64::from(loaders)), ("--start", start)]
        {
            command.arg(flag).arg(number.to_string());
        }
        // Its own group: Ctrl-C reaches the trainer alone, which saves first and ends its loaders then.
        command.stdin(Stdio::null()).stdout(Stdio::null()).process_group(0);
        command
    }
}
