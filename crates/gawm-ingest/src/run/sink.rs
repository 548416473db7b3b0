//! Takes aligned rows and writes episodes.

use std::collections::{BTreeMap, BTreeSet};

use bytes::Bytes;
use gawm_dataset::{AgeColumns, DatasetWriter, EpisodeInfo, ImageColumn, Rows, Trajectory, VectorColumn};
use gawm_schema::{ImageSpec, Role, Schema};
use rayon::prelude::*;

use super::RunError;
use super::picture::Picture;
use super::report::AgeCounts;
use crate::align::{EndReason, EpisodeStart, GapEvent, Row, RowSink};
use crate::contract;
use crate::episodes::{EpisodeLabels, Labels, RecordingLabels};

/// Rows that are handed to the writer at once.
const PIECE_ROWS: usize = 64;
/// Image bytes that may wait in such a piece.
const PIECE_BYTES: usize = 32 << 20;

/// What is fixed for a run.
pub(crate) struct SinkRules<'a> {
    pub(crate) schema: &'a Schema,
    /// Image rules in the order of the image features.
    pub(crate) images: Vec<contract::ImageSpec>,
    pub(crate) labels: &'a Labels,
    pub(crate) min_frames: usize,
    pub(crate) min_length_ns: i64,
    pub(crate) pool: &'a rayon::ThreadPool,
    /// Streams of each feature, to count rows that are not valid.
    pub(crate) feature_streams: Vec<Vec<usize>>,
}

impl SinkRules<'_> {
    /// Returns the size of the frames of a camera.
    fn image_spec(&self, index: usize) -> Option<ImageSpec> {
        self.schema.images().nth(index).map(|(_, spec)| spec.clone())
    }
}

/// Writes the episodes of one recording; errors are kept for the caller.
pub(crate) struct EpisodeSink<'a> {
    rules: &'a SinkRules<'a>,
    writer: Option<&'a mut DatasetWriter>,
    pub(crate) recording: RecordingLabels,
    /// Name of the log, for errors.
    pub(crate) log: String,
    /// What is known of each interval: its metadata record and its end.
    pub(crate) intervals: BTreeMap<u64, IntervalInfo>,
    /// Intervals to leave out, found by an earlier pass.
    pub(crate) discarded: BTreeSet<u64>,
    /// Number added to the aligner's interval numbers: those of earlier clock segments.
    pub(crate) interval_base: u64,
    open: Option<OpenEpisode>,
    pub(crate) outcome: SinkOutcome,
    pub(crate) error: Option<RunError>,
}

/// What is known of an interval.
#[derive(Debug, Default, Clone)]
pub(crate) struct IntervalInfo {
    /// Its metadata record.
    pub(crate) record: Option<(String, BTreeMap<String, String>)>,
    /// Its end, if marked.
    pub(crate) end_ns: Option<i64>,
}

/// What came of the rows.
#[derive(Debug, Default)]
pub(crate) struct SinkOutcome {
    pub(crate) episodes: u64,
    pub(crate) frames: u64,
    /// Episodes that were too short, and their rows.
    pub(crate) short_episodes: u64,
    pub(crate) short_frames: u64,
    pub(crate) dropped_intervals: BTreeSet<u64>,
    pub(crate) gaps: Vec<GapEvent>,
    pub(crate) ages: Vec<AgeCounts>,
    pub(crate) failed_pictures: u64,
    /// Why labels are not known, and of how many episodes.
    pub(crate) unlabelled: BTreeMap<String, u64>,
}

struct OpenEpisode {
    start: EpisodeStart,
    info: Option<EpisodeInfo>,
    /// Why labels are not known.
    unlabelled: BTreeSet<String>,
    is_skipped: bool,
    rows: PendingRows,
    /// The newest frame of each camera that was written.
    last_frames: BTreeMap<usize, Bytes>,
    first_ns: i64,
    last_ns: i64,
    length: u64,
    ages: Vec<AgeCounts>,
}

#[derive(Default)]
struct PendingRows {
    time_ns: Vec<i64>,
    vectors: Vec<VectorColumn>,
    pictures: Vec<Vec<Picture>>,
    picture_valid: Vec<Vec<bool>>,
    picture_bytes: usize,
    ages: AgeColumns,
}

impl<'a> EpisodeSink<'a> {
    /// Makes a sink; without a writer it only finds out what would be written.
    pub(crate) fn new(
        rules: &'a SinkRules<'a>,
        writer: Option<&'a mut DatasetWriter>,
        recording: RecordingLabels,
        log: String,
    ) -> Self {
        let ages = vec![AgeCounts::default(); rules.schema.streams.len()];
        Self {
            rules,
            writer,
            recording,
            log,
            intervals: BTreeMap::new(),
            discarded: BTreeSet::new(),
            interval_base: 0,
            open: None,
            outcome: SinkOutcome { ages, ..SinkOutcome::default() },
            error: None,
        }
    }

    fn flush(&mut self, is_end: bool) -> Result<(), RunError> {
        let Some(open) = self.open.as_mut().filter(|open| !open.is_skipped && !open.rows.time_ns.is_empty())
        else {
            return Ok(());
        };
        if open.info.is_none() {
            let is_long = open.length as usize >= self.rules.min_frames
                && open.last_ns.saturating_sub(open.first_ns) >= self.rules.min_length_ns;
            if !is_long {
                return Ok(());
            }
        }
        let (info, unlabelled) = self.episode_info();
        let Some(open) = self.open.as_mut() else { return Ok(()) };
        open.unlabelled = unlabelled;
        let Some(writer) = self.writer.as_deref_mut() else {
            open.info = Some(info);
            open.rows = PendingRows::default();
            return Ok(());
        };
        let failed = |source| RunError::Write { dir: std::path::PathBuf::new(), source };
        if open.info.is_none() {
            writer.begin_episode(info.clone()).map_err(failed)?;
            open.info = Some(info);
        } else if is_end {
            writer.amend_episode(info).map_err(failed)?;
        }
        let mut pending = std::mem::take(&mut open.rows);
        // The last row is held back, so that there is one to end the episode with.
        self.outcome.failed_pictures +=
            pending.write(&self.log, self.rules, &mut open.last_frames, writer)?;
        Ok(())
    }

    fn episode_info(&self) -> (EpisodeInfo, BTreeSet<String>) {
        let Some(open) = &self.open else { return Default::default() };
        let interval = self.intervals.get(&(open.start.interval + self.interval_base));
        let end_ns = interval.and_then(|interval| interval.end_ns).unwrap_or(open.last_ns).max(open.last_ns);
        let asked = crate::episodes::Asked {
            number: open.start.interval + self.interval_base,
            start_ns: open.first_ns,
            end_ns,
            record: interval.and_then(|interval| interval.record.as_ref()),
        };
        let (labels, unlabelled) = self.rules.labels.of(&self.recording, asked);
        let EpisodeLabels { task, success, operator, robot, session } = labels;
        let mut tags = BTreeMap::new();
        if open.start.part > 0 {
            tags.insert("part".to_owned(), open.start.part.to_string());
        }
        if let Some((_, values)) = interval.and_then(|interval| interval.record.as_ref()) {
            for (key, value) in values {
                tags.insert(format!("metadata.{key}"), value.clone());
            }
        }
        let info = EpisodeInfo {
            id: String::new(),
            task,
            success,
            operator,
            robot,
            session,
            split: None,
            start_ns: open.first_ns,
            end_ns: open.last_ns,
            source_file: String::new(),
            tags,
        };
        (info, unlabelled)
    }

    fn keep_error(&mut self, result: Result<(), RunError>) {
        if let (None, Err(error)) = (&self.error, result) {
            self.error = Some(error);
        }
    }

    fn finish_episode(&mut self) -> Result<(), RunError> {
        self.flush(true)?;
        let Some(open) = self.open.take() else { return Ok(()) };
        if open.is_skipped {
            return Ok(());
        }
        if open.info.is_none() {
            self.outcome.short_episodes += 1;
            self.outcome.short_frames += open.length;
            return Ok(());
        }
        if let Some(writer) = self.writer.as_deref_mut() {
            writer
                .end_episode()
                .map_err(|source| RunError::Write { dir: std::path::PathBuf::new(), source })?;
        }
        self.outcome.episodes += 1;
        self.outcome.frames += open.length;
        for reason in open.unlabelled {
            *self.outcome.unlabelled.entry(reason).or_default() += 1;
        }
        for (total, ages) in self.outcome.ages.iter_mut().zip(&open.ages) {
            total.merge(ages);
        }
        Ok(())
    }
}

impl RowSink<Picture> for EpisodeSink<'_> {
    fn begin(&mut self, start: EpisodeStart) {
        let schema = self.rules.schema;
        let n_images = schema.images().count();
        let rows = PendingRows {
            vectors: vec![VectorColumn::default(); schema.vectors().count()],
            pictures: vec![Vec::new(); n_images],
            picture_valid: vec![Vec::new(); n_images],
            ..PendingRows::default()
        };
        self.open = Some(OpenEpisode {
            is_skipped: self.discarded.contains(&(start.interval + self.interval_base)),
            start,
            info: None,
            unlabelled: BTreeSet::new(),
            rows,
            last_frames: BTreeMap::new(),
            first_ns: start.start_ns,
            last_ns: start.start_ns,
            length: 0,
            ages: vec![AgeCounts::default(); schema.streams.len()],
        });
    }

    fn row(&mut self, row: &Row<Picture>) {
        let rules = self.rules;
        let Some(open) = self.open.as_mut().filter(|open| !open.is_skipped) else { return };
        open.last_ns = row.time_ns;
        open.length += 1;
        for (stream, ages) in open.ages.iter_mut().enumerate() {
            ages.add(row.age_ms[stream]);
        }
        for (feature, _) in row.valid.iter().enumerate().filter(|(_, valid)| !**valid) {
            for &stream in &rules.feature_streams[feature] {
                open.ages[stream].invalid_rows += 1;
            }
        }
        open.rows.push(row, rules.schema);
        if (open.rows.time_ns.len() >= PIECE_ROWS || open.rows.picture_bytes >= PIECE_BYTES)
            && self.error.is_none()
        {
            let result = self.flush(false);
            self.keep_error(result);
        }
    }

    fn end(&mut self, _reason: EndReason) {
        if self.error.is_none() {
            let result = self.finish_episode();
            self.keep_error(result);
        }
        self.open = None;
    }

    fn discard(&mut self, interval: u64) {
        self.outcome.dropped_intervals.insert(interval + self.interval_base);
    }

    fn gap(&mut self, event: GapEvent) {
        self.outcome.gaps.push(event);
    }
}

impl PendingRows {
    fn push(&mut self, row: &Row<Picture>, schema: &Schema) {
        self.time_ns.push(row.time_ns);
        let (mut at, mut vector, mut image) = (0, 0, 0);
        if self.vectors.is_empty() && self.pictures.is_empty() {
            self.vectors = vec![VectorColumn::default(); schema.vectors().count()];
            self.pictures = vec![Vec::new(); schema.images().count()];
            self.picture_valid = vec![Vec::new(); schema.images().count()];
        }
        for (feature, &valid) in schema.features.iter().zip(&row.valid) {
            let width = feature.width();
            if feature.role == Role::Image || width == 0 {
                self.picture_bytes += row.images[image].held_bytes();
                self.pictures[image].push(row.images[image].clone());
                self.picture_valid[image].push(valid);
                image += 1;
                continue;
            }
            let column = &mut self.vectors[vector];
            let values = &row.values[at..at + width];
            // What is made of samples (steps, sums) may leave the range of the floats it is encoded as.
            let is_encoded = matches!(feature.role, Role::State | Role::Action);
            let is_usable = !is_encoded || values.iter().all(|value| (*value as f32).is_finite());
            let valid = valid && is_usable;
            let is_held = feature.role == Role::Action && is_usable;
            if valid || is_held {
                column.values.extend_from_slice(values);
            } else {
                column.values.extend(std::iter::repeat_n(f64::NAN, width));
            }
            column.valid.push(valid);
            at += width;
            vector += 1;
        }
        self.ages.age_ms.extend_from_slice(&row.age_ms);
        self.ages.arrival_age_ms.extend_from_slice(&row.arrival_age_ms);
    }

    /// Writes the rows; returns how many pictures could not be encoded.
    fn write(
        &mut self,
        log: &str,
        rules: &SinkRules<'_>,
        last_frames: &mut BTreeMap<usize, Bytes>,
        writer: &mut DatasetWriter,
    ) -> Result<u64, RunError> {
        let mut failed = 0;
        let mut images = Vec::new();
        for (index, (pictures, mut valid)) in std::mem::take(&mut self.pictures)
            .into_iter()
            .zip(std::mem::take(&mut self.picture_valid))
            .enumerate()
        {
            let rule = &rules.images[index];
            let encode = |picture: &Picture| picture.encoded(rule).ok();
            let encoded: Vec<Option<Bytes>> =
                rules.pool.install(|| pictures.par_iter().map(encode).collect());
            // Where nothing precedes a damaged one, one that follows stands in, or a black one: the row is not valid.
            let stand_in = last_frames.get(&index).or(encoded.iter().flatten().next()).cloned();
            let fallback =
                stand_in.or_else(|| rules.image_spec(index).as_ref().map(Picture::black)).unwrap_or_default();
            let mut frames: Vec<Bytes> = Vec::with_capacity(encoded.len());
            for (row, frame) in encoded.into_iter().enumerate() {
                frames.push(frame.unwrap_or_else(|| {
                    failed += 1;
                    valid[row] = false;
                    frames.last().cloned().unwrap_or_else(|| fallback.clone())
                }));
            }
            if let Some(last) = frames.last() {
                last_frames.insert(index, last.clone());
            }
            images.push(ImageColumn { frames, valid });
        }
        let time_ns = self.time_ns.first().copied().unwrap_or_default();
        let rows = Rows {
            time_ns: std::mem::take(&mut self.time_ns),
            vectors: std::mem::take(&mut self.vectors),
            images,
            ages: std::mem::take(&mut self.ages),
        };
        let trajectory = Trajectory::try_new(rules.schema, rows).map_err(|source| RunError::Rows {
            log: log.to_owned(),
            time_ns,
            source,
        })?;
        writer
            .write(trajectory)
            .map_err(|source| RunError::Write { dir: std::path::PathBuf::new(), source })?;
        Ok(failed)
    }
}
