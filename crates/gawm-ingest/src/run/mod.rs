//! From logs and a contract to a dataset.
//!
//! Blocks of a log are read and decoded by worker threads (`block`, `prefetch`) and consumed in order by one
//! `session`, which sorts, counts and aligns; the `sink` writes episodes. Nothing depends on the number of threads.

mod bind;
mod block;
mod calibration;
mod error;
mod gaps;
mod picture;
mod plan;
mod prefetch;
mod probe;
mod publishers;
mod recording;
mod report;
mod session;
mod sink;
mod source;
#[cfg(test)]
mod tests;
mod unavailable;
mod unpack;
#[cfg(test)]
#[cfg(feature = "video")]
mod video_tests;

#[cfg(test)]
pub(crate) mod made_logs;

use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering};

use gawm_dataset::{DatasetSpec, DatasetSummary, DatasetWriter, WriteMode};
use gawm_schema::Schema;

pub use bind::{BindError, Binding, BoundFeature, BoundStream, FeatureSource};
pub(crate) use block::decode_block;
pub use error::{Refusal, RunError};
pub(crate) use picture::Picture;
pub(crate) use plan::{Plans, schema_of};
pub(crate) use publishers::split as split_by_publisher;
pub(crate) use recording::OpenRecording;
pub use report::{FileReport, FileStatus, LostReport, Report, StreamReport, TopicReport};
pub(crate) use session::defect_of;
pub(crate) use source::{OpenError, Source};

use crate::contract::{CheckedContract, to_toml};
use crate::decode::SchemaLibrary;
use crate::episodes::Labels;
use crate::log::{Discovery, OpenOptions, Recording, discover};
use recording::RecordingOutcome;
use report::AgeCounts;

/// What to do.
pub struct RunOptions<'a> {
    /// The contract.
    pub contract: &'a CheckedContract,
    /// Folder that the contract's relative paths start from.
    pub contract_folder: &'a Path,
    /// Folder of the dataset.
    pub out: &'a Path,
    /// Files and folders of logs.
    pub logs: &'a [PathBuf],
    /// New, resume or append.
    pub mode: WriteMode,
    /// Number of threads that read and decode.
    pub jobs: usize,
    /// Takes every n-th recording only: number and n.
    pub shard: Option<(u64, u64)>,
    /// Set when the user wants to stop.
    pub interrupt: &'a AtomicBool,
    /// Told about progress: name of the log, blocks done, blocks in all.
    pub progress: &'a dyn Fn(&str, usize, usize),
}

/// What came of a run.
#[derive(Debug)]
pub struct RunOutcome {
    /// For `--report`.
    pub report: Report,
    /// What the dataset holds now.
    pub summary: DatasetSummary,
    /// Schema of the dataset.
    pub schema: Schema,
}

impl RunOutcome {
    /// Returns whether a mapped stream lost data or an input was refused.
    pub fn has_loss(&self) -> bool {
        self.report.files.iter().any(|file| matches!(file.status, FileStatus::Loss | FileStatus::Refused))
    }
}

/// Runs a contract over logs.
///
/// # Errors
/// The contract does not fit, the dataset cannot be written, nothing usable came of any input, or the user interrupted.
/// What happened until then is in `report`.
pub fn run(options: &RunOptions<'_>, report: &mut Report) -> Result<RunOutcome, RunError> {
    let library = library(options)?;
    let labels = Labels::new(&options.contract.written.labels, options.contract_folder)
        .map_err(|source| RunError::Labels { file: options.contract.file.clone(), source })?;
    let pool = rayon::ThreadPoolBuilder::new()
        .num_threads(options.jobs.max(1))
        .build()
        .map_err(|error| RunError::Threads { detail: error.to_string() })?;
    let Discovery { recordings, refused } = discover(options.logs);
    for error in refused {
        report.files.push(FileReport::refused(error.path(), with_hint(&error.to_string(), error.hint())));
    }
    report.warnings.extend(options.contract.warnings.iter().cloned());
    let mut run = Run { options, library, labels, pool, writer: None, ages: Vec::new() };
    match run.recordings(&recordings, report) {
        Ok(()) => run.finish(report),
        Err(error) => {
            run.give_up(&error, report);
            Err(error)
        }
    }
}

fn library(options: &RunOptions<'_>) -> Result<SchemaLibrary, RunError> {
    let mut library = SchemaLibrary::builtin();
    for folder in &options.contract.written.schemas {
        library.add_folder(&options.contract_folder.join(folder)).map_err(|error| RunError::Schemas {
            file: options.contract.file.clone(),
            detail: error.to_string(),
        })?;
    }
    Ok(library)
}

pub(crate) fn with_hint(text: &str, hint: Option<String>) -> String {
    match hint {
        Some(hint) => format!("{text}\nhint: {hint}"),
        None => text.to_owned(),
    }
}

/// The state of a run.
struct Run<'a> {
    options: &'a RunOptions<'a>,
    library: SchemaLibrary,
    labels: Labels,
    pool: rayon::ThreadPool,
    writer: Option<DatasetWriter>,
    ages: Vec<AgeCounts>,
}

impl Run<'_> {
    fn recordings(&mut self, recordings: &[Recording], report: &mut Report) -> Result<(), RunError> {
        for (index, recording) in recordings.iter().enumerate() {
            if let Some((shard, n)) = self.options.shard
                && index as u64 % n != shard
            {
                continue;
            }
            let file = self.recording(recording, report)?;
            report.files.push(file);
        }
        Ok(())
    }

    /// Leaves nothing of a run that failed before its first recording was done, so that the corrected one can begin;
    /// what was interrupted or has recordings stays to be resumed.
    fn give_up(self, error: &RunError, report: &mut Report) {
        if matches!(error, RunError::Interrupted) {
            return;
        }
        if let Some(Err(error)) = self.writer.map(DatasetWriter::discard) {
            report.warnings.push(format!("cannot remove what was written: {error}"));
        }
    }

    fn recording(&mut self, recording: &Recording, report: &mut Report) -> Result<FileReport, RunError> {
        if self.options.interrupt.load(Ordering::Relaxed) {
            return Err(RunError::Interrupted);
        }
        let path = recording::path_of(recording);
        let mut open = match OpenRecording::open(recording, self.options.contract) {
            Ok(open) => open,
            Err(error) => return Ok(FileReport::refused(&path, with_hint(&error.to_string(), error.hint()))),
        };
        let reduced = unavailable::reduce(self.options.contract, &open);
        let left_out = reduced.as_ref().map(|reduced| reduced.left_out.clone()).unwrap_or_default();
        if let Some((stream, found)) =
            reduced.as_ref().and_then(|r| Some((r.lost_ticks.as_ref()?, r.left_out.first()?)))
        {
            let error = format!("stream {stream:?} gives the ticks, and has no values: {}", found.detail);
            let hint = Some("choose another ticks.stream, or ticks.mode = \"native\"".to_owned());
            return Ok(FileReport::refused(&path, with_hint(&error, hint)));
        }
        let contract = reduced.as_ref().map_or(self.options.contract, |reduced| &reduced.contract);
        let mut binding = match Binding::new(contract, &open.name, &open.channels, &self.library) {
            Ok(binding) => binding,
            Err(BindError::Run(error)) => return Err(error),
            Err(BindError::Refused(refusal)) => {
                let refusal = unavailable::explain(refusal, &open);
                return Ok(FileReport::refused(&path, with_hint(&refusal.to_string(), refusal.hint())));
            }
        };
        open.select(&self.topics_of(&binding));
        publishers::split(&mut binding, &open, &self.library);
        let probed = probe::probe(&open, &binding, self.options.contract, &self.library)?;
        let schema = binding.schema(self.options.contract, probed.rate_hz, &probed.sizes)?;
        if let Some(stream) = probed.without_size.first() {
            let refusal = Refusal::EmptyStream {
                stream: binding.streams[*stream].name.clone(),
                topic: binding.streams[*stream].topic.clone(),
                read: probed.read,
                detail: probed.first_loss.clone().unwrap_or_else(|| "none of them an image".to_owned()),
            };
            return Ok(FileReport::refused(&path, with_hint(&refusal.to_string(), refusal.hint())));
        }
        self.prepare_writer(&schema, report)?;
        let Some(writer) = self.writer.as_mut() else { return Ok(FileReport::refused(&path, String::new())) };
        if let Some((place, expected, got)) = writer.schema().difference(&schema) {
            let detail =
                format!("{place} differs from the recordings before: expected {expected}, got {got}");
            let refusal = Refusal::OtherSchema { detail };
            return Ok(FileReport::refused(&path, with_hint(&refusal.to_string(), refusal.hint())));
        }
        let context = recording::Context {
            options: self.options,
            library: &self.library,
            labels: &self.labels,
            pool: &self.pool,
            schema: &schema,
            binding: &binding,
        };
        let outcome = recording::write(&context, &open, &path, writer)?;
        let mut file = self.account(outcome, report);
        if file.status != FileStatus::AlreadyThere {
            unavailable::account(&left_out, &mut file, report);
        }
        Ok(file)
    }

    /// Returns every topic that a contract asks for: of streams, labels and markers.
    fn topics_of(&self, binding: &Binding) -> Vec<String> {
        let streams = binding.streams.iter().map(|stream| stream.topic.clone());
        let labels = self.labels.topics().into_iter().map(|(topic, _)| topic);
        let marker = match &self.options.contract.episodes {
            crate::contract::EpisodeRule::Marker { topic, .. } => Some(topic.clone()),
            _ => None,
        };
        streams.chain(labels).chain(marker).collect()
    }

    fn account(&mut self, outcome: RecordingOutcome, report: &mut Report) -> FileReport {
        for (total, ages) in self.ages.iter_mut().zip(&outcome.ages) {
            total.merge(ages);
        }
        let name = outcome.file.path.clone();
        report.warnings.extend(outcome.warnings.into_iter().map(|warning| format!("{name}: {warning}")));
        report.episodes += outcome.file.episodes;
        report.frames += outcome.file.frames;
        outcome.file
    }

    fn prepare_writer(&mut self, schema: &Schema, report: &mut Report) -> Result<(), RunError> {
        if self.writer.is_some() {
            return Ok(());
        }
        self.ages = vec![AgeCounts::default(); schema.streams.len()];
        let fps = gawm_dataset::fps(schema.rate_hz);
        let deviation = (f64::from(fps) / schema.rate_hz - 1.0) * 100.0;
        if deviation.abs() > 0.001 {
            report.warnings.push(format!(
                "fps in info.json is {fps}, the real rate is {:.4} Hz ({deviation:+.3} %)",
                schema.rate_hz
            ));
        }
        let contract = to_toml(&self.options.contract.written)?;
        let mut spec =
            DatasetSpec::new(schema.clone(), contract, concat!("gawm-ingest ", env!("CARGO_PKG_VERSION")));
        spec.train_share = 1.0 - self.options.contract.written.split.validation;
        let writer = DatasetWriter::create(self.options.out, spec, self.options.mode)
            .map_err(|source| RunError::Write { dir: self.options.out.to_owned(), source })?;
        self.writer = Some(writer);
        Ok(())
    }

    fn finish(self, report: &mut Report) -> Result<RunOutcome, RunError> {
        let nothing = |report: &Report| {
            let of_files = report
                .files
                .iter()
                .map(|file| format!("{}: {}", file.path, file.error.as_deref().unwrap_or("no episode")));
            let of_shard = self.options.shard.filter(|_| report.files.is_empty()).map(|(shard, n)| {
                format!(
                    "no recording falls to shard {shard}/{n}\nhint: there are fewer recordings than shards; merge the others without it"
                )
            });
            RunError::Nothing { reasons: of_files.chain(of_shard).collect() }
        };
        let Some(writer) = self.writer else { return Err(nothing(report)) };
        let schema = writer.schema().clone();
        let already = report.files.iter().any(|file| file.status == FileStatus::AlreadyThere);
        let to_dir = |source| RunError::Write { dir: self.options.out.to_owned(), source };
        if report.episodes == 0 && !already && !writer.has_episodes() {
            writer.discard().map_err(to_dir)?;
            return Err(nothing(report));
        }
        let summary = writer.finish().map_err(to_dir)?;
        report.streams = schema
            .streams
            .iter()
            .zip(&self.ages)
            .map(|(stream, ages)| ages.report(&stream.name, &stream.source))
            .collect();
        Ok(RunOutcome { report: std::mem::take(report), summary, schema })
    }
}

/// Returns how logs are opened under a contract.
pub(crate) fn open_options(contract: &CheckedContract) -> OpenOptions {
    OpenOptions {
        disorder_window_ns: u64::try_from(contract.disorder_window_ns).unwrap_or(0),
        ..OpenOptions::default()
    }
}
