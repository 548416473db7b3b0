//! `gawm-train bench`: what loaders cost a step.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::anyhow;
use gawm_model::{AdamW, DataWidths, Device, Pass, WorldModel};
use gawm_schema::batch::Hello;
use gawm_schema::pipeline::Override;

use super::failure::Failure;
use super::{BenchArgs, Exit};
use crate::batch::{Batch, Uploader};
use crate::config::Config;
use crate::interrupt::Interrupt;
use crate::loaders::{LoaderCommand, LoaderOptions, LoaderProgram, Loaders};
use crate::source::{BatchSource, Expected};
use crate::step::train_step;
use crate::trainer::TrainError;

/// A folder that is removed at the end.
struct Scratch(PathBuf);

impl Drop for Scratch {
    fn drop(&mut self) {
        std::fs::remove_dir_all(&self.0).ok(); // a file that stays in the temporary folder harms nobody
    }
}

/// A model that is trained.
struct Bench {
    config: Config,
    model: WorldModel,
    optimizer: AdamW,
    uploader: Uploader,
    expected: Expected,
    loaders: Loaders,
    n: u64,
}

pub(super) fn run(arguments: &BenchArgs, program: LoaderProgram) -> Result<Exit, Failure> {
    let common = &arguments.common;
    common.limit_threads()?;
    let path = common.config.as_deref();
    let path =
        path.ok_or_else(|| Failure::usage(anyhow!("expected --config P.toml, got none"), "see pipelines/"))?;
    // What was queued while the resident batch was trained on costs a step nothing: these steps are not timed.
    let block = arguments.steps.div_ceil(arguments.rounds);
    let mut overrides = common.overrides()?;
    let slots = Config::read(path, &overrides)?.queued();
    let steps = 2 + arguments.rounds * (block + slots);
    let fields =
        [("steps", steps), ("validation_batches", 0), ("validate_every", steps), ("warmup_steps", 0)];
    overrides.extend(fields.map(|(field, value)| Override::new(&["train", field], value as i64)));
    let config = Config::read(path, &overrides)?;

    let failed = |error: std::io::Error| Failure::failed(error.into());
    let name = format!("bench-{}", std::process::id());
    let scratch = Scratch(std::env::temp_dir().join(format!("gawm-train-{name}")));
    std::fs::create_dir_all(&scratch.0).map_err(failed)?;
    let resolved = scratch.0.join("config.toml");
    std::fs::write(&resolved, config.to_toml()).map_err(failed)?;
    if common.data.is_empty() {
        return Err(Failure::usage(
            anyhow!("expected --data DIR, got none"),
            "a dataset as gawm-ingest writes it",
        ));
    }
    let program = common.loader_program.clone().map_or(program, LoaderProgram::At);
    let options = LoaderOptions {
        command: Some(LoaderCommand::new(&program, &resolved, &common.data, &config.train).map_err(failed)?),
        service: name,
        loaders: u32::from(config.loaders),
        patience: Duration::from_secs(config.train.deadline_s),
        say: |_| {},
    };
    let interrupt = Interrupt::on_signals().map_err(|error| Failure::failed(error.into()))?;
    let loaders = Loaders::start(options, 0, &interrupt)?;
    let mut bench = Bench::new(config, loaders)?;
    bench.measure(arguments.rounds, block, slots)?;
    Ok(Exit::Clean)
}

impl Bench {
    fn new(config: Config, loaders: Loaders) -> Result<Bench, Failure> {
        let device = config.train.open_device()?;
        let hello = loaders.hello();
        let (model, uploader) = prepare(&config, hello, &device)?;
        let expected = Expected::of(hello).map_err(TrainError::from)?;
        let optimizer = AdamW::new(config.train.optimizer());
        Ok(Bench { config, model, optimizer, uploader, expected, loaders, n: 0 })
    }

    /// Trains in turns on batches of the loaders and on a resident one.
    fn measure(&mut self, rounds: u64, block: u64, warm_up: u64) -> Result<(), TrainError> {
        let resident = self.receive()?;
        self.step(&resident)?;
        let first = self.receive()?;
        self.step(&first)?;
        let (mut with_loaders, mut waits, mut alone) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..rounds {
            for _ in 0..block {
                let start = Instant::now();
                self.step(&resident)?;
                alone.push(start.elapsed());
            }
            for index in 0..warm_up + block {
                let start = Instant::now();
                let batch = self.receive()?;
                let wait = start.elapsed();
                self.step(&batch)?;
                if index >= warm_up {
                    waits.push(wait);
                    with_loaders.push(start.elapsed());
                }
            }
        }
        let text = |name: &str, times: &mut Vec<Duration>| {
            times.sort();
            let mean = times.iter().sum::<Duration>() / u32::try_from(times.len()).unwrap_or(u32::MAX);
            let ms = |time: Duration| time.as_secs_f64() * 1e3;
            let (low, median) = (times[times.len() / 10], times[times.len() / 2]);
            super::print(&format!(
                "{name:<28} mean {:>9.3} ms  median {:>9.3} ms  10 % {:>9.3} ms\n",
                ms(mean),
                ms(median),
                ms(low)
            ));
            (mean.as_secs_f64(), median.as_secs_f64())
        };
        let (mean_alone, median_alone) = text("step on one resident batch", &mut alone);
        let (mean_loaders, median_loaders) = text("step with loaders", &mut with_loaders);
        text("  of it batch to device", &mut waits);
        super::print(&format!(
            "ratio                        mean {:.4}, median {:.4}\n",
            mean_loaders / mean_alone,
            median_loaders / median_alone
        ));
        Ok(())
    }

    fn receive(&mut self) -> Result<Batch, TrainError> {
        let slot = self.loaders.next(self.n)?;
        let batch = self.uploader.upload(&self.expected.view(self.n, &slot)?)?;
        self.n += 1;
        Ok(batch)
    }

    fn step(&mut self, batch: &Batch) -> Result<(), TrainError> {
        let train = &self.config.train;
        let pass = Pass::train(train.seed, self.optimizer.step_count());
        train_step(&self.model, &mut self.optimizer, batch, &self.config.objectives, train.rate, &pass)?;
        Ok(())
    }
}

fn prepare(config: &Config, hello: &Hello, device: &Device) -> Result<(WorldModel, Uploader), TrainError> {
    let widths = DataWidths { action: hello.shape.action_width, state: hello.shape.state_width };
    let architecture = config.model.clone().resolve(widths)?;
    let model = WorldModel::new(architecture, config.train.seed, device)?;
    let train = &config.train;
    let uploader = Uploader::new(device, hello, train.supervised.as_deref(), &train.velocity)?;
    Ok((model, uploader))
}
