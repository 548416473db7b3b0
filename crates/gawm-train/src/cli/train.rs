//! `gawm-train --config P.toml --data DIR --out RUN`.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::anyhow;
use gawm_schema::ContentHash;
use gawm_schema::batch::Hello;

use super::failure::Failure;
use super::{Exit, TrainArgs};
use crate::config::Config;
use crate::interrupt::Interrupt;
use crate::loaders::{LoaderCommand, LoaderError, LoaderOptions, LoaderProgram, Loaders};
use crate::metrics::{Record, read};
use crate::output::{Talk, summary};
use crate::run_folder::RunFolder;
use crate::state::{Resumed, TrainState};
use crate::trainer::{Outcome, Trainer};

pub(super) fn run(arguments: &TrainArgs, program: LoaderProgram) -> Result<Exit, Failure> {
    let config = config(arguments)?;
    if arguments.print_config {
        super::print(&config.to_toml());
        return Ok(Exit::Clean);
    }
    let out = arguments.out.as_deref().ok_or_else(|| {
        Failure::usage(anyhow!("expected --out RUN, got none"), "a run is kept in a folder")
    })?;
    arguments.common.limit_threads()?;
    let device = config.train.open_device()?;
    let interrupt = Interrupt::on_signals().map_err(|error| Failure::failed(error.into()))?;

    let folder =
        if arguments.resume { RunFolder::resume(out, &config) } else { RunFolder::create(out, &config) }?;
    let resumed: Option<Resumed> = match arguments.resume && folder.last().exists() {
        true => {
            Some(TrainState::load(&folder.last(), &device).map_err(|error| Failure::failed(error.into()))?)
        }
        false => None,
    };
    let start = resumed.as_ref().map_or(0, |resumed| resumed.state.resume_at);
    let options = loader_options(arguments, &config, &folder, program)?;
    let mut loaders = match Loaders::start(options, start, &interrupt) {
        Err(LoaderError::Interrupted) => return Ok(Exit::Interrupted),
        loaders => loaders?,
    };
    let hello = loaders.hello().clone();
    let mut trainer = Trainer::new(config, hello, &device, folder, resumed, arguments.common.talk())?;
    let outcome = trainer.run(&mut loaders, &interrupt)?;
    drop(loaders);
    match outcome {
        Outcome::Finished => {
            report(out)?;
            Ok(Exit::Clean)
        }
        Outcome::Interrupted { steps } => {
            eprintln!("interrupted: saved after {steps} steps; --resume goes on from there");
            Ok(Exit::Interrupted)
        }
    }
}

/// Prints what a run learned so far.
pub(super) fn report(run: &Path) -> Result<Exit, Failure> {
    let records = read(&run.join("metrics.jsonl")).map_err(|error| Failure::failed(error.into()))?;
    let best = records.iter().rev().find_map(|record| match record {
        Record::Validation(validation) if validation.is_best => Some(validation.step),
        _ => None,
    });
    super::print(&summary(&records, best));
    Ok(Exit::Clean)
}

/// Reads the configuration: the given one, or that of the run which goes on.
fn config(arguments: &TrainArgs) -> Result<Config, Failure> {
    let overrides = arguments.common.overrides()?;
    let path = match (&arguments.common.config, &arguments.out) {
        (Some(path), _) => path.clone(),
        (None, Some(out)) if arguments.resume => out.join("config.toml"),
        (None, _) => {
            let hint = "pipelines/ holds examples; --resume takes the configuration of the run";
            return Err(Failure::usage(anyhow!("expected --config P.toml, got none"), hint));
        }
    };
    Ok(Config::read(&path, &overrides)?)
}

fn loader_options(
    arguments: &TrainArgs,
    config: &Config,
    folder: &RunFolder,
    program: LoaderProgram,
) -> Result<LoaderOptions, Failure> {
    let command = match arguments.attach {
        true => None,
        false => {
            let program = arguments.common.loader_program.clone().map_or(program, LoaderProgram::At);
            let data = data(arguments, config, folder)?;
            let command = LoaderCommand::new(&program, &folder.config(), &data, &config.train);
            Some(command.map_err(|error| Failure::failed(error.into()))?)
        }
    };
    let service = match &arguments.service {
        Some(name) => name.clone(),
        None => service_of(folder.path()),
    };
    let talk = arguments.common.talk();
    Ok(LoaderOptions {
        command,
        service,
        loaders: u32::from(config.loaders),
        patience: Duration::from_secs(config.train.deadline_s),
        say: if talk == Talk::Verbose { |text| eprintln!("{text}") } else { |_| {} },
    })
}

/// How many datasets were given on the command line: those that [loader] mix does not name.
fn data_count(config: &Config, hello: &Hello) -> usize {
    let mix = config.table.get("loader").and_then(|loader| loader.get("mix")).and_then(toml::Value::as_array);
    hello.datasets.len().saturating_sub(mix.map_or(0, Vec::len))
}

/// The datasets: as given, or as the run that goes on was told.
fn data(arguments: &TrainArgs, config: &Config, folder: &RunFolder) -> Result<Vec<PathBuf>, Failure> {
    if !arguments.common.data.is_empty() {
        return Ok(arguments.common.data.clone());
    }
    let text = std::fs::read(folder.path().join("hello.json")).ok().filter(|_| arguments.resume);
    let hello = text.and_then(|text| Hello::from_json(&text).ok());
    match hello {
        // The others of a mix are named in [loader].
        Some(hello) => Ok(hello
            .datasets
            .iter()
            .take(data_count(config, &hello))
            .map(|dataset| PathBuf::from(&dataset.path))
            .collect()),
        None => Err(Failure::usage(
            anyhow!("expected --data DIR, got none"),
            "a dataset as gawm-ingest writes it; --resume remembers where it was",
        )),
    }
}

/// A name that the same folder always has, so that what a killed run left behind is found by its next start.
fn service_of(folder: &Path) -> String {
    let canonical = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let hash = ContentHash::of(canonical.as_os_str().as_encoded_bytes()).to_string();
    format!("train-{}", &hash[..16])
}
