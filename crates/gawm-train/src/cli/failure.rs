//! Errors with their exit code and what to do about them.

use std::io::Write as _;

use crate::config::ConfigError;
use crate::loaders::LoaderError;
use crate::run_folder::RunFolderError;
use crate::source::SourceError;
use crate::state::ResumeError;
use crate::step::StepError;
use crate::trainer::TrainError;

/// A failure with its exit code and what to do about it.
#[derive(Debug)]
pub(super) struct Failure {
    pub(super) code: u8,
    error: anyhow::Error,
    hint: Option<String>,
}

impl Failure {
    /// Something did not work.
    pub(super) fn failed(error: anyhow::Error) -> Failure {
        Failure { code: 1, error, hint: None }
    }

    /// The user must change something.
    pub(super) fn usage(error: anyhow::Error, hint: &str) -> Failure {
        Failure { code: 2, error, hint: Some(hint.to_owned()) }
    }

    pub(super) fn print(&self) {
        let mut stderr = std::io::stderr().lock();
        let mut text = String::new();
        for cause in self.error.chain() {
            let cause = cause.to_string();
            if text.is_empty() {
                text = cause;
            } else if !text.contains(&cause) {
                text.push_str("\n  because: ");
                text.push_str(&cause);
            }
        }
        // Nothing can be done when stderr is closed.
        writeln!(stderr, "error: {text}").ok();
        if let Some(hint) = &self.hint {
            writeln!(stderr, "\nhint: {hint}").ok();
        }
    }
}

impl From<ConfigError> for Failure {
    fn from(error: ConfigError) -> Failure {
        let hint = match &error {
            ConfigError::Read { .. } => "give a pipeline file with --config".to_owned(),
            ConfigError::Device { .. } => {
                "device = \"cpu\" works everywhere; for a GPU see docs/cuda.md".to_owned()
            }
            _ => {
                "`--print-config` shows every field with its value; docs/training.md explains them".to_owned()
            }
        };
        Failure { code: 2, error: error.into(), hint: Some(hint) }
    }
}

impl From<RunFolderError> for Failure {
    fn from(error: RunFolderError) -> Failure {
        let (code, hint) = match &error {
            RunFolderError::Exists { .. } => (2, Some("--resume goes on with the run in that folder")),
            RunFolderError::NoRun { .. } => (2, Some("without --resume a new run starts")),
            RunFolderError::InUse { .. } => {
                (1, Some("one process at a time trains in a folder: stop the other, or take another --out"))
            }
            RunFolderError::ConfigDiffers { .. } => (
                2,
                Some(
                    "leave --config and --set away to go on with the configuration of the run, or start a new run in another folder",
                ),
            ),
            _ => (1, None),
        };
        Failure { code, error: error.into(), hint: hint.map(str::to_owned) }
    }
}

impl From<LoaderError> for Failure {
    fn from(error: LoaderError) -> Failure {
        let hint = match &error {
            LoaderError::Shm(cause) => cause.hint(),
            LoaderError::Start { .. } => Some(
                "--loader-program says where gawm-loader is; `cargo build --release -p gawm-loader` makes it"
                    .to_owned(),
            ),
            LoaderError::Ended { .. } => Some("its own message stands above".to_owned()),
            LoaderError::DiesAgain { .. } => {
                Some("something kills it: too little memory (dmesg), or a defect".to_owned())
            }
            _ => None,
        };
        // A loader that refuses its configuration ends with 2; that is what happened to the run, too.
        let code = match &error {
            LoaderError::Ended { status, .. } if status.code() == Some(2) => 2,
            _ => 1,
        };
        Failure { code, error: error.into(), hint }
    }
}

impl From<TrainError> for Failure {
    fn from(error: TrainError) -> Failure {
        let (code, hint) = match error {
            TrainError::Folder(error) => return error.into(),
            TrainError::Source(SourceError::Loader(error)) => return error.into(),
            TrainError::Model(_) | TrainError::Mismatch { .. } | TrainError::Upload(_) => (2, None),
            TrainError::Step(StepError::NonFinite { .. }) => (
                1,
                Some(
                    "the checkpoints in the run folder are from before; a lower train.rate or train.max_gradient_norm, or the clips named above, are the usual reasons",
                ),
            ),
            TrainError::Resume(ResumeError::OtherData { .. }) => {
                (2, Some("the dataset, [loader] or [train] is not what the run was started with"))
            }
            _ => (1, None),
        };
        Failure { code, error: error.into(), hint: hint.map(str::to_owned) }
    }
}
