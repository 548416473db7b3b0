//! Looks at logs: channels, counts, rates, gaps, clocks and damage, without a contract.
//!
//! [`inspect`] reads every block once, in parallel and in bounded memory, and folds it into an [`InspectReport`]; [`render_text`]
//! prints that for people, serde for programs.

mod clocks;
mod histogram;
mod notices;
mod probe;
mod report;
mod statistics;
mod text;

#[cfg(test)]
mod tests;

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use rayon::prelude::*;

use crate::lerobot::{self, LerobotRecording};
use crate::log::{
    Block, BlockKind, Channel, Damage, DamageKind, Log, OpenLogError, OpenOptions, discover, looks_like_zstd,
};
use crate::run::{OpenError, Source};
use crate::tabular;
use statistics::{ChannelStatistics, Digest};

pub use clocks::ClockOffset;
pub use probe::{ChannelProbe, DecoderProbe, MessageProbe, StampReader};
pub use report::{
    AttachmentReport, ChannelReport, FileReport, InspectReport, MetadataReport, Notice, NoticeKind,
    RecordingReport, Refusal,
};
pub use statistics::{Gap, Rate};
pub use text::render_text;

/// Uncompressed bytes that are read before their results are folded in.
const BATCH_BYTES: u64 = 64 << 20;
/// Blocks that are read at once, at most: more do not help.
const BATCH_BLOCKS: usize = 64;

/// Inspects files and folders; what is no log is in [`InspectReport::refused`].
pub fn inspect(inputs: &[PathBuf], options: &OpenOptions, probe: &dyn MessageProbe) -> InspectReport {
    let found = discover(inputs);
    let mut report =
        InspectReport { refused: found.refused.iter().map(refusal).collect(), ..InspectReport::default() };
    for recording in found.recordings {
        if recording.parts.len() > 1 {
            report.recordings.push(RecordingReport {
                name: recording.name,
                parts: recording.parts.iter().map(|part| part.display().to_string()).collect(),
                stated_messages: recording.rosbag2.and_then(|metadata| metadata.message_count),
            });
        }
        for part in &recording.parts {
            if inspect_rows(part, &mut report) {
                continue;
            }
            match Source::open_log(part, options) {
                Ok(source) => {
                    report.files.extend(source.as_log().map(|log| inspect_log(log, part, probe)));
                }
                Err(OpenError::Log(error)) => report.refused.push(refusal(&error)),
                Err(error) => report.refused.push(Refusal {
                    path: part.display().to_string(),
                    error: error.to_string(),
                    hint: error.hint(),
                }),
            }
        }
    }
    report
}

/// Inspects a table or a LeRobot folder; returns whether it is one.
fn inspect_rows(path: &Path, report: &mut InspectReport) -> bool {
    let refused = |error: String, hint: Option<&str>| Refusal {
        path: path.display().to_string(),
        error,
        hint: hint.map(ToOwned::to_owned),
    };
    if lerobot::is_dataset(path) {
        match LerobotRecording::open(path) {
            Ok(recording) => report.datasets.push(recording.report()),
            Err(error) => report.refused.push(refused(error.to_string(), error.hint())),
        }
        return true;
    }
    if !path.is_file() || !tabular::sniff(path).is_ok_and(|format| format.is_some()) {
        return false;
    }
    match tabular::open(path, &tabular::Limits::default()) {
        Ok(table) => report.tables.push(tabular::report(&table, None)),
        Err(error) => report.refused.push(refused(error.to_string(), error.hint())),
    }
    true
}

fn refusal(error: &OpenLogError) -> Refusal {
    Refusal { path: error.path().display().to_string(), error: error.to_string(), hint: error.hint() }
}

/// Inspects one open log; `path` is how the report names it.
pub fn inspect_log(log: &Log, path: &Path, probe: &dyn MessageProbe) -> FileReport {
    let mut fold = Fold::new(log, probe);
    // The order of the file, so that backward steps and sequence numbers are those of the recorder.
    let blocks = log.blocks_in_file_order();
    let mut blocks = blocks.as_slice();
    while !blocks.is_empty() {
        let mut n_bytes = 0;
        let fits = |block: &&crate::log::BlockRef| {
            n_bytes += block.uncompressed_bytes;
            n_bytes <= BATCH_BYTES
        };
        let n_batch = blocks.iter().take(BATCH_BLOCKS).take_while(fits).count().max(1);
        let (batch, rest) = blocks.split_at(n_batch);
        // Probing needs every channel of the batch, so blocks are parsed first and digested then, both in parallel.
        let digests: Vec<BlockDigest> =
            batch.par_iter().map(|block| digest(&log.read_block(block), &fold.probes, probe)).collect();
        digests.into_iter().for_each(|digest| fold.add(digest));
        blocks = rest;
    }
    fold.finish(log, path)
}

/// Definitions of channels and what the decoders know of them.
type Probes = BTreeMap<Arc<Channel>, Arc<ChannelProbe>>;

/// What is kept of a block.
struct BlockDigest {
    /// Channels with the digests of their messages, in the order of the block.
    channels: Vec<(Arc<Channel>, Arc<ChannelProbe>, Vec<Digest>)>,
    n_zstd_bodies: u64,
    damage: Vec<Damage>,
}

fn digest(block: &Block, probes: &Probes, probe: &dyn MessageProbe) -> BlockDigest {
    let mut channels: Vec<(Arc<Channel>, Arc<ChannelProbe>, Vec<Digest>)> = block
        .channels
        .iter()
        .map(|channel| {
            let known = probes.get(channel).map(Arc::clone);
            (Arc::clone(channel), known.unwrap_or_else(|| Arc::new(probe.probe(channel))), Vec::new())
        })
        .collect();
    let mut n_zstd_bodies = 0;
    for message in &block.messages {
        let payload = block.payload(message);
        let (channel, probe, digests) = &mut channels[message.channel as usize];
        // A JSON or protobuf payload can start with these bytes only by an odd accident; CDR never does.
        n_zstd_bodies += u64::from(channel.message_encoding == "cdr" && looks_like_zstd(payload));
        digests.push(Digest {
            log_time_ns: message.log_time_ns,
            publish_time_ns: message.publish_time_ns,
            stamp_ns: probe.stamp.as_ref().and_then(|stamp| stamp(payload)),
            sequence: message.sequence,
            n_bytes: payload.len() as u64,
            payload_crc: crc32fast::hash(payload),
        });
    }
    BlockDigest { channels, n_zstd_bodies, damage: block.damage.clone() }
}

/// Takes digests in reading order.
struct Fold {
    probes: Probes,
    statistics: BTreeMap<Arc<Channel>, ChannelStatistics>,
    n_zstd_bodies: u64,
    damage: Vec<Damage>,
}

impl Fold {
    fn new(log: &Log, probe: &dyn MessageProbe) -> Self {
        let with_probe = |channel: &Arc<Channel>| (Arc::clone(channel), Arc::new(probe.probe(channel)));
        Self {
            probes: log.channels().values().map(with_probe).collect(),
            statistics: log
                .channels()
                .values()
                .map(|channel| (Arc::clone(channel), ChannelStatistics::default()))
                .collect(),
            n_zstd_bodies: 0,
            damage: log.damage().to_vec(),
        }
    }

    fn add(&mut self, digest: BlockDigest) {
        for (channel, probe, messages) in digest.channels {
            if !self.probes.contains_key(&channel) {
                self.probes.insert(Arc::clone(&channel), probe);
            }
            let statistics = self.statistics.entry(channel).or_default();
            messages.iter().for_each(|message| statistics.add(message));
        }
        self.n_zstd_bodies += digest.n_zstd_bodies;
        self.damage.extend(digest.damage);
    }

    fn finish(mut self, log: &Log, path: &Path) -> FileReport {
        let mut channels: Vec<ChannelReport> =
            self.statistics.iter().map(|(channel, s)| self.channel(channel, s)).collect();
        channels.sort_by(|a, b| (&a.topic, a.id, &a.schema_name).cmp(&(&b.topic, b.id, &b.schema_name)));
        self.add_damage(log, &channels);
        let blocks = log.blocks_in_file_order();
        let chunks = || blocks.iter().filter(|block| block.kind == BlockKind::Chunk);
        let mut report = FileReport {
            path: path.display().to_string(),
            profile: log.profile().to_owned(),
            library: log.library().to_owned(),
            messages: channels.iter().map(|channel| channel.messages).sum(),
            attachments: log.attachments().len() as u64,
            metadata: log.metadata().len() as u64,
            start_ns: channels.iter().filter_map(|channel| channel.start_ns).min(),
            end_ns: channels.iter().filter_map(|channel| channel.end_ns).max(),
            channels,
            damage: self.damage,
            notices: Vec::new(),
            bytes: log.file_bytes(),
            has_summary: log.has_summary(),
            chunks: chunks().count() as u64,
            loose_blocks: (blocks.len() - chunks().count()) as u64,
            compression: log.compressions(),
            uncompressed_bytes: chunks().map(|block| block.uncompressed_bytes).fold(0, u64::saturating_add),
            message_compression: (self.n_zstd_bodies > 0).then(|| "zstd".to_owned()),
            attachment_list: Vec::new(),
            metadata_list: Vec::new(),
        };
        for about in log.attachments() {
            let (name, media_type) = (about.name.clone(), about.media_type.clone());
            report.attachment_list.push(AttachmentReport { name, media_type, bytes: about.data_size });
        }
        for record in log.metadata() {
            report
                .metadata_list
                .push(MetadataReport { name: record.name.clone(), values: record.values.clone() });
        }
        report.notices = notices::notices(&report);
        report
    }

    fn channel(&self, channel: &Arc<Channel>, statistics: &ChannelStatistics) -> ChannelReport {
        let schema = channel.schema.as_deref();
        let obstacle = self.probes.get(channel).and_then(|probe| probe.obstacle.clone());
        let (backward_steps, largest_backward_ms) = statistics.backward_steps();
        ChannelReport {
            topic: channel.topic.clone(),
            schema_name: schema.map(|schema| schema.name.clone()).unwrap_or_default(),
            schema_encoding: schema.map(|schema| schema.encoding.clone()).unwrap_or_default(),
            message_encoding: channel.message_encoding.clone(),
            messages: statistics.messages,
            decodable: obstacle.is_none(),
            obstacle,
            id: channel.id,
            bytes: statistics.bytes,
            start_ns: statistics.first_ns,
            end_ns: statistics.last_ns,
            rate: statistics.rate(),
            publish_rate: statistics.publish_rate(),
            has_publish_clock: statistics.has_publish_clock(),
            publish_to_log: statistics.publish_to_log(),
            stamps: statistics.stamps,
            stamp_to_log: statistics.stamp_to_log(),
            stamp_to_publish: statistics.stamp_to_publish(),
            missing_by_sequence: statistics.missing(),
            backward_steps,
            largest_backward_ms,
            duplicates: statistics.duplicates,
            log_time_zero: statistics.log_time_zero,
        }
    }

    /// Adds what only a whole pass over the file shows.
    fn add_damage(&mut self, log: &Log, channels: &[ChannelReport]) {
        match log.verify_data_section() {
            Ok(mismatch) => self.damage.extend(mismatch),
            Err(error) => self.damage.push(Damage {
                kind: DamageKind::ReadFailed,
                offset: 0,
                detail: error.to_string(),
            }),
        }
        for index in 0..log.attachments().len() {
            if let Err(error) = log.read_attachment(index) {
                let offset = log.attachments()[index].offset;
                self.damage.push(Damage {
                    kind: DamageKind::AttachmentCrcMismatch,
                    offset,
                    detail: error.to_string(),
                });
            }
        }
        for channel in channels.iter().filter(|channel| channel.log_time_zero > 0) {
            let detail = format!(
                "{} on {:?} at log time 0, left out of the time span",
                text::plural(channel.log_time_zero, "message"),
                channel.topic
            );
            self.damage.push(Damage { kind: DamageKind::LogTimeZero, offset: 0, detail });
        }
        let n_read: u64 = channels.iter().map(|channel| channel.messages).sum();
        if let Some(counts) = log.summary_counts().filter(|counts| counts.messages != n_read) {
            let detail = format!("the summary counts {} messages, {n_read} can be read", counts.messages);
            self.damage.push(Damage { kind: DamageKind::StatisticsMismatch, offset: 0, detail });
        }
        self.damage.sort_by(|a, b| (a.offset, a.kind, &a.detail).cmp(&(b.offset, b.kind, &b.detail)));
        self.damage.dedup();
    }
}

/// Topics that more than one channel has.
fn shared_topics(channels: &[ChannelReport]) -> BTreeSet<&str> {
    let mut seen = BTreeSet::new();
    channels.iter().map(|channel| channel.topic.as_str()).filter(|topic| !seen.insert(*topic)).collect()
}
