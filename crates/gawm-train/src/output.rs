//! Everything that a run says, in one place: metrics, event files, terminal.

mod summary;

use gawm_schema::batch::{BatchId, Hello, Split};

use crate::config::Config;
use crate::metrics::{
    EventFile, MetricsError, MetricsLog, Progress, Record, TermValue, TrainRecord, ValidationRecord, read,
    scalars_of,
};
use crate::run_folder::RunFolder;
use crate::state::{Best, TrainState};
use crate::step::Step;

pub use summary::summary;

/// How much is said on stderr.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Talk {
    /// Nothing but errors and alarms.
    Quiet,
    /// Progress and validations.
    #[default]
    Normal,
    /// Every step and every save, too.
    Verbose,
}

/// The open outputs of a run.
#[derive(Debug)]
pub struct Output {
    metrics: MetricsLog,
    metrics_path: std::path::PathBuf,
    /// Of the model, of the constant and of the identity baseline.
    events: [EventFile; 3],
    progress: Progress,
    talk: Talk,
    log_every: u64,
    total_steps: u64,
}

impl Output {
    /// Opens the outputs of a run at `state`; what lies behind it is removed.
    pub(crate) fn open(
        folder: &RunFolder,
        config: &Config,
        state: &TrainState,
        hello: &Hello,
        talk: Talk,
    ) -> Result<Output, MetricsError> {
        let steps = state.steps;
        let validates_next =
            hello.sequence.batch(state.resume_at).is_some_and(|id| id.split == Split::Validation);
        let keep = |record: &Record| match record {
            Record::Train(train) => train.step < steps,
            Record::Validation(validation) => {
                validation.step < steps || (validation.step == steps && steps > 0 && !validates_next)
            }
        };
        let mut events = [
            EventFile::create(&folder.events("model"), steps)?,
            EventFile::create(&folder.events("constant"), steps)?,
            EventFile::create(&folder.events("identity"), steps)?,
        ];
        events[0].text(steps, "config", &format!("```toml\n{}\n```", config.to_toml()))?;
        Ok(Output {
            metrics: MetricsLog::open(&folder.metrics(), keep)?,
            metrics_path: folder.metrics(),
            events,
            progress: Progress::new(steps, config.train.steps, talk == Talk::Quiet),
            talk,
            log_every: config.train.log_every,
            total_steps: config.train.steps,
        })
    }

    /// A training step was taken.
    pub(crate) fn step(&mut self, id: BatchId, step: &Step) -> Result<(), MetricsError> {
        self.progress.step(step.total);
        self.trace(&format!("step {} total {}", id.step, step.total));
        if !id.step.is_multiple_of(self.log_every) && id.step + 1 != self.total_steps {
            return Ok(());
        }
        let term = |(name, value): &(&'static str, f32)| TermValue {
            term: (*name).to_owned(),
            value: f64::from(*value),
            baseline: None,
        };
        self.record(&Record::Train(TrainRecord {
            step: id.step,
            epoch: id.epoch,
            rate: step.report.rate,
            gradient_norm: step.report.gradient_norm,
            total: step.total,
            terms: step.terms.iter().map(term).collect(),
        }))
    }

    /// A validation is complete.
    pub(crate) fn validation(&mut self, record: ValidationRecord) -> Result<(), MetricsError> {
        self.progress.say(&record.line());
        if let Some(reason) = &record.collapse {
            // An alarm is not progress: it is said even when quiet.
            eprintln!("warning: the latents have collapsed after {} steps: {reason}", record.step);
        }
        self.record(&Record::Validation(record))
    }

    fn record(&mut self, record: &Record) -> Result<(), MetricsError> {
        self.metrics.write(record)?;
        let step = match record {
            Record::Train(train) => train.step,
            Record::Validation(validation) => validation.step,
        };
        for (events, scalars) in self.events.iter_mut().zip(scalars_of(record)) {
            if !scalars.is_empty() {
                events.scalars(step, &scalars)?;
            }
        }
        Ok(())
    }

    /// Says a detail, if asked for.
    pub(crate) fn trace(&self, text: &str) {
        if self.talk == Talk::Verbose {
            self.progress.say(text);
        }
    }

    /// Makes the metrics durable.
    pub(crate) fn sync(&self) -> Result<(), MetricsError> {
        self.metrics.sync()
    }

    /// Ends the bar and sums the run up.
    pub(crate) fn summary(&self, best: Option<Best>) -> Result<String, MetricsError> {
        self.progress.finish();
        Ok(summary(&read(&self.metrics_path)?, best.map(|best| best.steps)))
    }
}
