//! One recording: opened, hashed, read in order, written.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::Ordering;

use gawm_dataset::{DatasetWriter, RecordingInfo, RecordingState, SourceFile};
use gawm_schema::{ContentHash, Schema};

use super::bind::{Binding, FeatureSource};
use super::block::{DecodedBlock, decode_block};
use super::plan::Plans;
use super::prefetch::in_order;
use super::report::{AgeCounts, FileReport, FileStatus};
use super::session::{Session, SessionRules};
use super::sink::{EpisodeSink, SinkRules};
use super::source::{OpenError, Source};
use super::{Refusal, RunError, RunOptions, calibration, gaps, publishers, with_hint};
use crate::align::Stop;
use crate::contract::{CheckedContract, EpisodeRule, GapRule, StreamData};
use crate::decode::SchemaLibrary;
use crate::episodes::{Labels, RecordingLabels};
use crate::log::{BlockRef, Channel, Damage, Recording, Severity};

/// Decoded blocks that may wait at a time, in bytes.
const PREFETCH_BYTES: u64 = 96 << 20;

/// Reasons for labels that are not known that are listed.
const MAX_UNLABELLED: usize = 10;

/// What is needed to write recordings.
pub(crate) struct Context<'a> {
    pub(crate) options: &'a RunOptions<'a>,
    pub(crate) library: &'a SchemaLibrary,
    pub(crate) labels: &'a Labels,
    pub(crate) pool: &'a rayon::ThreadPool,
    pub(crate) schema: &'a Schema,
    pub(crate) binding: &'a Binding,
}

/// What came of a recording.
pub(crate) struct RecordingOutcome {
    pub(crate) file: FileReport,
    pub(crate) warnings: Vec<String>,
    pub(crate) ages: Vec<AgeCounts>,
}

/// A recording whose files are open.
pub(crate) struct OpenRecording {
    pub(crate) name: String,
    pub(crate) logs: Vec<Source>,
    /// Channels of all parts.
    pub(crate) channels: Vec<Arc<Channel>>,
    /// Blocks of all parts in reading order.
    pub(crate) blocks: Vec<(usize, BlockRef)>,
}

impl OpenRecording {
    /// Opens all parts.
    pub(crate) fn open(
        recording: &Recording,
        contract: &crate::contract::CheckedContract,
    ) -> Result<OpenRecording, OpenError> {
        let logs: Vec<Source> =
            recording.parts.iter().map(|path| Source::open(path, contract)).collect::<Result<_, _>>()?;
        Ok(OpenRecording::of(recording.name.clone(), logs))
    }

    /// Joins open parts.
    pub(crate) fn of(name: String, logs: Vec<Source>) -> OpenRecording {
        let mut channels: Vec<Arc<Channel>> = Vec::new();
        for log in &logs {
            for channel in log.channels() {
                if !channels.iter().any(|known| **known == *channel) {
                    channels.push(channel);
                }
            }
        }
        let mut open = OpenRecording { name, logs, channels, blocks: Vec::new() };
        open.list_blocks();
        open
    }

    fn list_blocks(&mut self) {
        let parts = self.logs.iter().enumerate();
        self.blocks =
            parts.flat_map(|(part, log)| log.blocks().iter().map(move |b| (part, b.clone()))).collect();
    }

    /// Reads only these topics from now on, where what is not asked for need not be read.
    pub(crate) fn select(&mut self, topics: &[String]) {
        self.logs.iter_mut().for_each(|log| log.select(topics));
        self.list_blocks();
    }

    /// Returns whether the parts list their episodes themselves.
    fn has_episodes(&self) -> bool {
        self.logs.iter().any(Source::has_episodes)
    }

    /// Calls `consume` with all decoded blocks in order.
    pub(crate) fn read<E>(
        &self,
        plans: &Plans,
        jobs: usize,
        mut consume: impl FnMut(usize, DecodedBlock) -> ControlFlow<E>,
    ) -> ControlFlow<E> {
        let costs: Vec<u64> = self.blocks.iter().map(|(_, block)| block.uncompressed_bytes.max(1)).collect();
        let work = |index: usize| {
            let (part, block) = &self.blocks[index];
            decode_block(self.logs[*part].read_block(block), plans)
        };
        in_order(&costs, jobs, PREFETCH_BYTES, work, &mut consume)
    }

    /// Returns whether a block begins a new clock segment, and up to which log time all is in before the block after it.
    fn order_of(&self, index: usize, newest_ns: Option<i64>, window_ns: i64) -> (bool, Option<i64>) {
        let start = |block: &BlockRef| block.start_ns.and_then(|ns| i64::try_from(ns).ok());
        let (part, block) = &self.blocks[index];
        let is_new_segment = index.checked_sub(1).is_some_and(|before| {
            let (part_before, before) = &self.blocks[before];
            if part == part_before {
                before.clock_segment != block.clock_segment
            } else {
                start(block)
                    .zip(newest_ns)
                    .is_some_and(|(start, newest)| start.saturating_add(window_ns) < newest)
            }
        });
        // Within a segment blocks are sorted by start, so the next one with messages tells.
        let next = self.blocks[index + 1..].iter().find_map(|(next_part, next)| {
            let is_same = next_part != part || next.clock_segment == block.clock_segment;
            start(next).map(|start| is_same.then_some(start))
        });
        (is_new_segment, next.unwrap_or(newest_ns).or(newest_ns))
    }
}

/// Returns the path that a recording is shown by: the file, or the folder of its parts.
pub(crate) fn path_of(recording: &Recording) -> PathBuf {
    match recording.parts.as_slice() {
        [only] if recording.rosbag2.is_none() => only.clone(),
        [first, ..] => match (recording.rosbag2.is_some(), first.parent()) {
            (true, Some(folder)) => folder.to_owned(),
            (_, Some(folder)) => folder.join(&recording.name),
            (_, None) => PathBuf::from(&recording.name),
        },
        [] => PathBuf::from(&recording.name),
    }
}

/// Writes the episodes of a recording.
pub(crate) fn write(
    context: &Context<'_>,
    open: &OpenRecording,
    path: &Path,
    writer: &mut DatasetWriter,
) -> Result<RecordingOutcome, RunError> {
    let info = recording_info(open)?;
    let to_dir = |source| RunError::Write { dir: context.options.out.to_owned(), source };
    if writer.begin_recording(info).map_err(to_dir)? == RecordingState::AlreadyThere {
        let mut file = FileReport::refused(path, String::new());
        file.status = FileStatus::AlreadyThere;
        file.error = None;
        return Ok(RecordingOutcome { file, warnings: Vec::new(), ages: Vec::new() });
    }
    let result = write_episodes(context, open, path, writer).map_err(|error| match error {
        RunError::Write { source, .. } => to_dir(source),
        other => other,
    });
    match &result {
        Ok(outcome) if outcome.file.status != FileStatus::Refused => {
            writer.end_recording().map_err(to_dir)?
        }
        Ok(_) => writer.abort_recording().map_err(to_dir)?,
        Err(_) => {}
    }
    result
}

fn recording_info(open: &OpenRecording) -> Result<RecordingInfo, RunError> {
    let mut files = Vec::new();
    let mut whole = blake3::Hasher::new();
    for log in &open.logs {
        let hash =
            log.content_hash().map_err(|source| RunError::Read { path: log.path().to_owned(), source })?;
        whole.update(&hash);
        files.push(SourceFile {
            name: log.path().file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
            content_hash: ContentHash(hash),
            length_bytes: log.file_bytes(),
        });
    }
    let content_hash = match files.as_slice() {
        [only] => only.content_hash,
        _ => ContentHash(*whole.finalize().as_bytes()),
    };
    let notes = open.logs.first().map(Source::notes);
    Ok(RecordingInfo { content_hash, files, notes: notes.unwrap_or_default() })
}

fn write_episodes(
    context: &Context<'_>,
    open: &OpenRecording,
    path: &Path,
    writer: &mut DatasetWriter,
) -> Result<RecordingOutcome, RunError> {
    let own_episodes = open.has_episodes().then(|| episodes_of_records(context.options.contract));
    let contract = own_episodes.as_ref().unwrap_or(context.options.contract);
    let label_fields = context.labels.topics();
    let mut events: Vec<String> = label_fields.iter().map(|(topic, _)| topic.clone()).collect();
    if let EpisodeRule::Marker { topic, .. } = &contract.episodes {
        events.push(topic.clone());
    }
    let infos: Vec<String> = context
        .binding
        .streams
        .iter()
        .filter_map(|stream| match &stream.rule.data {
            StreamData::Image(rule) => rule.spec.camera_info.clone(),
            _ => None,
        })
        .collect();
    let plans = Plans::new(context.binding, &events, &infos, context.library);
    let rule = context.binding.align_rule(contract)?;
    let rules = SessionRules {
        contract,
        binding: context.binding,
        plans: &plans,
        rule: &rule,
        label_fields,
        is_listed: matches!(contract.episodes, EpisodeRule::Metadata { .. }),
    };
    let sink_rules = SinkRules {
        schema: context.schema,
        images: image_rules(context.binding),
        labels: context.labels,
        min_frames: contract.written.episodes.min_frames.max(1) as usize,
        min_length_ns: (contract.written.episodes.min_length_s * 1e9) as i64,
        pool: context.pool,
        feature_streams: feature_streams(context.binding),
    };
    let metadata = open.logs.iter().flat_map(Source::metadata);
    let recording = RecordingLabels::new(
        path.to_owned(),
        metadata.map(|record| (record.name.clone(), record.values.clone())).collect(),
    );
    let log = path.display().to_string();
    let mut discarded = std::collections::BTreeSet::new();
    if contract.streams.iter().any(|stream| stream.gap == GapRule::DropEpisode) {
        let sink = EpisodeSink::new(&sink_rules, None, recording.clone(), log.clone());
        let mut session = Session::new(&rules, sink);
        pass(context, open, &log, &mut session)?;
        discarded = std::mem::take(&mut session.sink.outcome.dropped_intervals);
    }
    let mut sink = EpisodeSink::new(&sink_rules, Some(writer), recording, log.clone());
    sink.discarded = discarded;
    let mut session = Session::new(&rules, sink);
    pass(context, open, &log, &mut session)?;
    let camera_infos = std::mem::take(&mut session.camera_infos);
    let mut outcome = outcome(context, open, path, session);
    if outcome.file.status != FileStatus::Refused {
        let kept = calibration::keep(contract, context.binding, open, &camera_infos, writer);
        outcome.warnings.extend(kept.map_err(|source| RunError::Write { dir: PathBuf::new(), source })?);
    }
    Ok(outcome)
}

/// A table lists its episodes; `from = "file"` means those and not the whole file as one.
fn episodes_of_records(contract: &CheckedContract) -> CheckedContract {
    let mut contract = contract.clone();
    if contract.episodes == EpisodeRule::File {
        contract.episodes = EpisodeRule::Metadata {
            record: "episode".to_owned(),
            start_key: "start_ns".to_owned(),
            end_key: "end_ns".to_owned(),
            scale_ns: 1.0,
        };
    }
    contract
}

fn image_rules(binding: &Binding) -> Vec<crate::contract::ImageSpec> {
    let images = binding.features.iter().filter_map(|feature| match feature.source {
        FeatureSource::Image(stream) => Some(stream),
        _ => None,
    });
    images
        .map(|stream| match &binding.streams[stream].rule.data {
            StreamData::Image(rule) => rule.spec.clone(),
            _ => crate::contract::ImageSpec::default(),
        })
        .collect()
}

fn feature_streams(binding: &Binding) -> Vec<Vec<usize>> {
    binding
        .features
        .iter()
        .map(|feature| match &feature.source {
            FeatureSource::Streams(streams) => streams.clone(),
            FeatureSource::Image(stream) => vec![*stream],
            FeatureSource::Derived { .. } => Vec::new(),
        })
        .collect()
}

/// Reads the whole recording through a session.
fn pass(
    context: &Context<'_>,
    open: &OpenRecording,
    log: &str,
    session: &mut Session<'_, '_>,
) -> Result<(), RunError> {
    let window = context.options.contract.disorder_window_ns;
    let stopped = |stop: Stop| gaps::stop_error(context.binding, log, stop);
    let n_blocks = open.blocks.len();
    let flow = open.read(session.plans(), context.options.jobs, |index, block| {
        if context.options.interrupt.load(Ordering::Relaxed) {
            return ControlFlow::Break(RunError::Interrupted);
        }
        (context.options.progress)(log, index, n_blocks);
        let newest_before = session.newest_log_ns();
        let (is_new_segment, _) = open.order_of(index, newest_before, window);
        let newest = block.messages.iter().map(|message| message.log_ns).max().max(newest_before);
        let (_, complete) = open.order_of(index, newest, window);
        if let Err(stop) = session.take(block, is_new_segment, complete) {
            return ControlFlow::Break(stopped(stop));
        }
        match session.sink.error.take() {
            Some(error) => ControlFlow::Break(error),
            None => ControlFlow::Continue(()),
        }
    });
    if let ControlFlow::Break(error) = flow {
        return Err(error);
    }
    session.finish().map_err(stopped)?;
    (context.options.progress)(log, n_blocks, n_blocks);
    session.sink.error.take().map_or(Ok(()), Err)
}

fn outcome(
    context: &Context<'_>,
    open: &OpenRecording,
    path: &Path,
    session: Session<'_, '_>,
) -> RecordingOutcome {
    let (empty, empty_optional) = session.empty_streams();
    let Session { sink, mut counts, mut warnings, damage: block_damage, .. } = session;
    let result = sink.outcome;
    let mut damage: Vec<Damage> = open.logs.iter().flat_map(|log| log.damage().iter().cloned()).collect();
    damage.extend(block_damage);
    let has_lost_bytes = damage.iter().any(|found| found.kind.severity() == Severity::Loss);
    if has_lost_bytes {
        count_damaged(open, &mut counts);
    }
    warnings.extend(
        damage
            .iter()
            .map(|found| format!("{} at offset {}: {}", found.kind.as_str(), found.offset, found.detail)),
    );
    warnings.extend(gaps::describe(context.binding, &result.gaps, first_ns(open), open.has_episodes()));
    if result.failed_pictures > 0 {
        warnings.push(format!(
            "{} images turned out to be damaged when they were converted; their rows hold the image before, not valid",
            result.failed_pictures
        ));
    }
    if result.short_episodes > 0 {
        warnings.push(format!(
            "{} episodes with {} rows in all were shorter than min_frames or min_length_s and are left out",
            result.short_episodes, result.short_frames
        ));
    }
    warnings.extend(result.unlabelled.iter().take(MAX_UNLABELLED).map(|(reason, count)| {
        let noun = if *count == 1 { "episode" } else { "episodes" };
        format!("{reason} ({count} {noun})")
    }));
    if result.unlabelled.len() > MAX_UNLABELLED {
        warnings.push(format!("{} more labels that are not known", result.unlabelled.len() - MAX_UNLABELLED));
    }
    if !result.dropped_intervals.is_empty() {
        warnings.push(format!(
            "{} episodes were left out by gap = \"drop-episode\"",
            result.dropped_intervals.len()
        ));
    }
    let empty_stream = |stream: usize| {
        let bound = &context.binding.streams[stream];
        let losses = counts.losses_of(&bound.topic);
        let absence = || publishers::first_absence(bound, open, context.library);
        Refusal::EmptyStream {
            stream: bound.name.clone(),
            topic: bound.topic.clone(),
            read: counts.read_of(&bound.topic),
            detail: match losses.is_empty() {
                true => absence().unwrap_or_else(|| "none lost".to_owned()),
                false => losses.join("; "),
            },
        }
    };
    warnings.extend(empty_optional.into_iter().map(|stream| empty_stream(stream).to_string()));
    let mut error = None;
    if let Some(&stream) = empty.first() {
        let refusal = empty_stream(stream);
        error = Some(with_hint(&refusal.to_string(), refusal.hint()));
    } else if result.episodes == 0 {
        let refusal = Refusal::NoEpisode { detail: no_episode(&result, &warnings) };
        error = Some(with_hint(&refusal.to_string(), refusal.hint()));
    }
    let status = match &error {
        Some(_) => FileStatus::Refused,
        None if counts.has_loss() || has_lost_bytes || result.failed_pictures > 0 => FileStatus::Loss,
        None => FileStatus::Ok,
    };
    let file = FileReport {
        path: path.display().to_string(),
        status,
        topics: counts.into_reports(),
        damage,
        episodes: if error.is_some() { 0 } else { result.episodes },
        frames: if error.is_some() { 0 } else { result.frames },
        error,
    };
    RecordingOutcome { file, warnings, ages: result.ages }
}

fn no_episode(result: &super::sink::SinkOutcome, warnings: &[String]) -> String {
    if result.short_episodes > 0 {
        return format!(
            "too short: {} stretches with all required streams, {} rows in all; min_frames and min_length_s ask for more",
            result.short_episodes, result.short_frames
        );
    }
    match warnings.last() {
        Some(last) => format!(
            "at no tick all required streams had a usable sample within an episode; last finding: {last}"
        ),
        None => "at no tick all required streams had a usable sample within an episode".to_owned(),
    }
}

fn first_ns(open: &OpenRecording) -> i64 {
    let starts = open.blocks.iter().filter_map(|(_, block)| block.start_ns);
    starts.min().and_then(|ns| i64::try_from(ns).ok()).unwrap_or_default()
}

/// Counts the messages that the summary promises and that damage has taken.
fn count_damaged(open: &OpenRecording, counts: &mut super::report::Counts) {
    let mut promised: std::collections::BTreeMap<String, u64> = std::collections::BTreeMap::new();
    for log in &open.logs {
        let Some(summary) = log.summary_counts() else { return };
        for channel in log.channels() {
            if let Some(count) = summary.messages_by_channel.get(&channel.id) {
                *promised.entry(channel.topic.clone()).or_default() += count;
            }
        }
    }
    for (topic, count) in promised {
        let missing = count.saturating_sub(counts.read_of(&topic));
        if missing > 0 {
            counts.read(&topic, missing);
            counts.lost(&topic, "damaged", missing, || "in the damaged parts of the file".to_owned());
        }
    }
}
