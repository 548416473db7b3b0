//! A dataset folder in the form of a log.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::io;
use std::ops::Range;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use arrow::array::RecordBatch;
use bytes::Bytes;
use gawm_dataset::read::{DType, Dataset, FeatureDecl, ReadLimits, check_pages};
use parquet::arrow::ProjectionMask;
use parquet::arrow::arrow_reader::ParquetRecordBatchReaderBuilder;
use parquet::file::metadata::ParquetMetaData;

use super::cells::{CellKind, NoMessage, push_cell, push_raw_image, raw_image_channel};
use super::damage::damage_of;
use super::{LerobotError, LerobotError as Error};
use crate::log::{Block, BlockRef, Channel, Damage, DamageKind, Message, MetadataRecord};
use crate::rows::{BLOCK_BYTES, EPISODE_GAP_NS, RowRecording, Unavailable};
use gawm_video::VideoLanes;

/// Columns that say which row it is, and nothing of the robot.
const INDEX_COLUMNS: [&str; 4] = ["episode_index", "frame_index", "index", "timestamp"];
/// Times of rows may differ from the grid by this share of a period before that is said.
const GRID_TOLERANCE: f64 = 0.1;
/// Times of rows that differ less from the grid are those of the grid, rounded to 32 bits.
const GRID_ROUNDING_SECS: f64 = 5e-5;
/// Rows of one batch of a reader.
const BATCH_ROWS: usize = 1024;

/// A LeRobot dataset folder in the form of a log.
pub struct LerobotRecording {
    dataset: Dataset,
    episodes: Vec<Episode>,
    channels: Vec<Arc<Channel>>,
    kinds: BTreeMap<String, CellKind>,
    metadata: Vec<MetadataRecord>,
    damage: Vec<Damage>,
    unavailable: Vec<Unavailable>,
    /// Cameras whose frames are in video files.
    cameras: BTreeSet<String>,
    videos: VideoLanes,
    selected: BTreeSet<String>,
    spans: Vec<Span>,
    blocks: Vec<BlockRef>,
    /// How many rows a batch may have at most in files and row groups whose pages were checked.
    checked: Mutex<BTreeMap<(usize, usize), usize>>,
}

/// The rows of one episode: of one run of the data.
struct Episode {
    index: i64,
    /// Position in [`Dataset::runs`].
    run: usize,
    start_ns: i64,
    /// Frame number of each row, where they do not simply count from 0.
    frames: Option<Vec<i64>>,
    /// `timestamp` of each row, where it is not that of the grid.
    times: Option<Vec<f64>>,
}

/// Rows of one episode within one row group.
struct Span {
    episode: usize,
    /// Rows within the episode.
    rows: Range<u64>,
    row_group: usize,
    /// First row within the row group.
    offset: u64,
}

impl LerobotRecording {
    /// Opens a folder.
    ///
    /// # Errors
    /// - `meta/info.json` cannot be used, or no data file can be read
    /// - no episode has rows, or the rate is no usable number
    pub fn open(path: &Path) -> Result<Self, LerobotError> {
        let dataset = Dataset::open(path, ReadLimits::default())?;
        let fps = dataset.info.fps;
        if !(0.001..=1e6).contains(&fps) {
            return Err(Error::Rate { path: path.to_owned(), fps });
        }
        let damage = dataset.defects.iter().map(damage_of).collect();
        let mut recording = Self {
            dataset,
            episodes: Vec::new(),
            channels: Vec::new(),
            kinds: BTreeMap::new(),
            metadata: Vec::new(),
            damage,
            unavailable: Vec::new(),
            cameras: BTreeSet::new(),
            videos: VideoLanes::default(),
            selected: BTreeSet::new(),
            spans: Vec::new(),
            blocks: Vec::new(),
            checked: Mutex::default(),
        };
        recording.find_columns()?;
        recording.find_episodes()?;
        recording.selected = recording.channels.iter().map(|channel| channel.topic.clone()).collect();
        recording.list_blocks();
        Ok(recording)
    }

    /// Returns the dataset.
    pub fn dataset(&self) -> &Dataset {
        &self.dataset
    }

    /// Returns the number of episodes and their rows.
    pub fn counts(&self) -> (usize, u64) {
        let rows = self.episodes.iter().map(|episode| self.dataset.runs[episode.run].n_rows).sum();
        (self.episodes.len(), rows)
    }

    /// Makes one channel per column; features without one are unavailable.
    fn find_columns(&mut self) -> Result<(), LerobotError> {
        let mut named: BTreeMap<String, Option<CellKind>> = BTreeMap::new();
        for file in &self.dataset.files {
            for field in file.schema.fields() {
                named.entry(field.name().clone()).or_insert_with(|| CellKind::of(field.data_type()));
            }
        }
        let n_rows = self.dataset.n_rows();
        for (name, kind) in named.iter().filter(|(name, _)| !INDEX_COLUMNS.contains(&name.as_str())) {
            let id = u16::try_from(self.channels.len() + 1).map_err(|_beyond| Error::TooMany {
                path: self.dataset.root.clone(),
                what: "columns",
                limit: u64::from(u16::MAX),
            })?;
            match kind {
                Some(kind) => {
                    self.channels.push(Arc::new(kind.channel(name, id)));
                    self.kinds.insert(name.clone(), *kind);
                }
                None => self.damage.push(Damage {
                    kind: DamageKind::UnknownSchema,
                    offset: 0,
                    detail: format!("column {name}: expected numbers, text or images; it is not offered"),
                }),
            }
        }
        let features = self.dataset.info.features.iter();
        let (videos, absent): (Vec<&FeatureDecl>, Vec<&FeatureDecl>) = features
            .filter(|feature| !named.contains_key(&feature.name))
            .partition(|f| gawm_video::IS_BUILT && f.dtype == DType::Video && self.has_video(&f.name));
        for feature in videos {
            let id = u16::try_from(self.channels.len() + 1).map_err(|_beyond| Error::TooMany {
                path: self.dataset.root.clone(),
                what: "columns",
                limit: u64::from(u16::MAX),
            })?;
            self.channels.push(Arc::new(raw_image_channel(&feature.name, id)));
            self.cameras.insert(feature.name.clone());
        }
        let absent = absent.into_iter();
        let unavailable: Vec<Unavailable> =
            absent.map(|feature| self.unavailable_feature(&feature.name, &feature.dtype, n_rows)).collect();
        for found in &unavailable {
            let detail = format!("feature {}: {}", found.topic, found.detail);
            self.damage.push(Damage { kind: DamageKind::IndexMismatch, offset: 0, detail });
        }
        self.unavailable = unavailable;
        Ok(())
    }

    /// Returns whether any episode has a video file of a camera.
    fn has_video(&self, name: &str) -> bool {
        let paths = self.dataset.episodes.iter().filter_map(|entry| self.dataset.video_path(entry, name));
        paths.flatten().any(|path| self.dataset.root.join(path).is_file())
    }

    fn unavailable_feature(&self, name: &str, dtype: &DType, rows: u64) -> Unavailable {
        let (reason, detail, hint) = if *dtype != DType::Video {
            ("column_missing", "declared in meta/info.json, but no data file has it", "remove its stream")
        } else if self.has_video(name) {
            (
                "video_not_decoded",
                "its frames are in video files, which this build does not decode",
                crate::VIDEO_HINT,
            )
        } else {
            (
                "video_missing",
                "declared in meta/info.json, but there is no video file",
                "copy the folder `videos/` too, or remove its stream",
            )
        };
        Unavailable { topic: name.to_owned(), reason, detail: detail.to_owned(), hint, rows }
    }

    fn find_episodes(&mut self) -> Result<(), LerobotError> {
        let fps = self.dataset.info.fps;
        let path = || self.dataset.root.clone();
        let names: Vec<String> = ["frame_index", "timestamp", "task_index"].map(str::to_owned).to_vec();
        let (found, defects) = self
            .dataset
            .scan(&names, |rows| {
                let frames = rows.ints("frame_index").map(<[i64]>::to_vec);
                let task = rows.ints("task_index").map(<[i64]>::to_vec);
                let times = rows.column("timestamp").and_then(|c| c.dims().first().cloned());
                (rows.run_index, frames, times, task)
            })
            .map_err(|source| Error::Scan { path: path(), source })?;
        let mut damage: Vec<Damage> = defects.iter().map(damage_of).collect();
        let mut start_ns = EPISODE_GAP_NS;
        let (mut episodes, mut metadata) = (Vec::new(), Vec::new());
        for (run, frames, times, task) in found {
            let rows = self.dataset.runs[run].n_rows;
            let index = self.dataset.runs[run].episode_index;
            let frames = frames.and_then(|frames| usual_frames(index, frames, &mut damage));
            let last = frames.as_ref().and_then(|f| f.last().copied()).unwrap_or(rows as i64 - 1).max(0);
            let length_ns = last as f64 * 1e9 / fps;
            let end_ns = (length_ns < 4e18).then(|| start_ns.checked_add(length_ns.round() as i64)).flatten();
            let next = end_ns.and_then(|end| end.checked_add(EPISODE_GAP_NS));
            let (Some(end_ns), Some(next)) = (end_ns, next) else {
                return Err(Error::TooMany { path: path(), what: "nanoseconds", limit: i64::MAX as u64 });
            };
            let off_secs = times.as_ref().map_or(0.0, |times| off_grid_secs(times, frames.as_deref(), fps));
            damage.extend(off_grid(index, off_secs, fps));
            let times = times.filter(|_| off_secs > GRID_ROUNDING_SECS);
            metadata.push(self.record(index, rows, task.as_deref().unwrap_or_default(), start_ns, end_ns));
            episodes.push(Episode { index, run, start_ns, frames, times });
            start_ns = next;
        }
        if episodes.is_empty() {
            return Err(Error::NoEpisode { path: path() });
        }
        self.damage.extend(damage);
        (self.episodes, self.metadata) = (episodes, metadata);
        Ok(())
    }

    fn record(&self, index: i64, rows: u64, task: &[i64], start_ns: i64, end_ns: i64) -> MetadataRecord {
        let mut values = BTreeMap::new();
        let entry = self.dataset.entry(index);
        for name in entry.iter().flat_map(|entry| entry.extras.keys()) {
            if let Some(text) = entry.and_then(|entry| entry.extra_text(name)) {
                values.insert(name.clone(), text);
            }
        }
        let of_rows = task.first().and_then(|&i| self.dataset.tasks.get(usize::try_from(i).ok()?)).cloned();
        let of_table = entry.and_then(|entry| entry.tasks.first()).cloned();
        if let Some(task) = of_rows.or(of_table) {
            values.insert("task".to_owned(), task);
        }
        values.insert("name".to_owned(), index.to_string());
        values.insert("index".to_owned(), index.to_string());
        values.insert("length".to_owned(), rows.to_string());
        values.insert("start_ns".to_owned(), start_ns.to_string());
        values.insert("end_ns".to_owned(), end_ns.to_string());
        MetadataRecord { name: "episode".to_owned(), values, offset: 0 }
    }

    fn list_blocks(&mut self) {
        let (mut spans, mut blocks) = (Vec::new(), Vec::new());
        for (number, episode) in self.episodes.iter().enumerate() {
            let run = self.dataset.runs[episode.run];
            let file = &self.dataset.files[run.file];
            let row_bytes = self.row_bytes(run.file).max(1);
            let step = (BLOCK_BYTES / row_bytes).clamp(1, 16_384);
            let (mut group_start, mut row_group) = (0, 0);
            let mut row = run.start;
            let end = run.start + run.n_rows;
            while row < end && row_group < file.row_groups.len() {
                let group_end = group_start + file.row_groups[row_group];
                if row >= group_end {
                    (group_start, row_group) = (group_end, row_group + 1);
                    continue;
                }
                let to = end.min(group_end).min(row + step);
                let rows = row - run.start..to - run.start;
                let time = |row: u64| u64::try_from(self.time_ns(number, row)).ok();
                let bytes = (to - row).saturating_mul(row_bytes);
                blocks.push(BlockRef::of_table(
                    blocks.len() as u64,
                    bytes,
                    time(rows.start),
                    time(rows.end - 1),
                ));
                spans.push(Span { episode: number, rows, row_group, offset: row - group_start });
                row = to;
            }
        }
        (self.spans, self.blocks) = (spans, blocks);
    }

    /// Estimates the bytes of a row: images cost what they are declared to at most.
    fn row_bytes(&self, file: usize) -> u64 {
        let fields = self.dataset.files[file].schema.fields().iter();
        let selected = fields.filter(|field| self.selected.contains(field.name()));
        let bytes = selected.fold(0, |bytes: u64, field| {
            let declared = self.dataset.info.feature(field.name());
            let width = declared.map_or(1, |feature| feature.width() as u64);
            bytes.saturating_add(width.saturating_mul(8).min(1 << 20))
        });
        let frames = self.cameras.iter().filter(|camera| self.selected.contains(*camera));
        frames.fold(bytes, |bytes, camera| {
            let declared = self.dataset.info.feature(camera);
            bytes.saturating_add(declared.map_or(1 << 20, |feature| feature.width() as u64))
        })
    }

    /// Returns when each row of a span is in the videos of its episode, which begins at `from_secs` in them.
    fn video_times(&self, span: &Span, from_secs: f64) -> Vec<f64> {
        let episode = &self.episodes[span.episode];
        let row_secs = |row: u64| {
            let at = usize::try_from(row).unwrap_or(usize::MAX);
            if let Some(secs) = episode.times.as_ref().and_then(|times| times.get(at)) {
                return *secs;
            }
            let frame = episode.frames.as_ref().and_then(|frames| frames.get(at).copied());
            frame.map_or(row as f64, |frame| frame as f64) / self.dataset.info.fps
        };
        span.rows.clone().map(|row| from_secs + row_secs(row)).collect()
    }

    fn time_ns(&self, episode: usize, row: u64) -> i64 {
        let Some(episode) = self.episodes.get(episode) else { return 0 };
        let frame =
            episode.frames.as_ref().and_then(|frames| frames.get(usize::try_from(row).ok()?).copied());
        let frame = frame.map_or(row as f64, |frame| frame as f64);
        episode.start_ns.saturating_add((frame * 1e9 / self.dataset.info.fps).round() as i64)
    }

    /// Checks once what the pages of the selected columns declare; returns how many rows a batch may have.
    fn check_row_group(
        &self,
        (file, opened): (usize, &File),
        row_group: usize,
        metadata: &ParquetMetaData,
        mask: &ProjectionMask,
    ) -> Result<usize, String> {
        let mut checked = self.checked.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(most_rows) = checked.get(&(file, row_group)) {
            return Ok(*most_rows);
        }
        let most_rows = check_pages(opened, metadata, [row_group], mask)?;
        checked.insert((file, row_group), most_rows);
        Ok(most_rows)
    }

    fn read_span(&self, span: &Span, out: &mut Block) -> Result<(), String> {
        let run = self.dataset.runs[self.episodes[span.episode].run];
        let (opened, footer) = self.dataset.open_file(run.file)?;
        let shared = opened.try_clone().map_err(|error| error.to_string())?;
        let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(shared, footer);
        let schema = Arc::clone(builder.schema());
        let columns: Vec<(usize, &Arc<Channel>)> = self
            .channels
            .iter()
            .filter(|channel| self.selected.contains(&channel.topic))
            .filter_map(|channel| Some((schema.index_of(&channel.topic).ok()?, channel)))
            .collect();
        let mask = ProjectionMask::roots(builder.parquet_schema(), columns.iter().map(|(index, _)| *index));
        let most_rows =
            self.check_row_group((run.file, &opened), span.row_group, builder.metadata(), &mask)?;
        let n_rows = usize::try_from(span.rows.end - span.rows.start).map_err(|error| error.to_string())?;
        let offset = usize::try_from(span.offset).map_err(|error| error.to_string())?;
        let reader = builder
            .with_projection(mask)
            .with_row_groups(vec![span.row_group])
            .with_offset(offset)
            .with_limit(n_rows)
            .with_batch_size(BATCH_ROWS.min(n_rows.max(1)).min(most_rows))
            .build()
            .map_err(|error| error.to_string())?;
        let mut messages = Messages { recording: self, span, out, data: Vec::new(), nulls: BTreeMap::new() };
        let mut row = span.rows.start;
        for batch in reader {
            let batch = batch.map_err(|error| error.to_string())?;
            messages.take(&batch, row);
            row += batch.num_rows() as u64;
        }
        for camera in self.cameras.iter().filter(|camera| self.selected.contains(*camera)) {
            messages.take_video(camera);
        }
        messages.finish();
        if row == span.rows.end {
            Ok(())
        } else {
            Err(format!("expected {n_rows} rows, got {}", row - span.rows.start))
        }
    }
}

/// Frame numbers that are used: those that rise; others are said and passed over.
fn usual_frames(episode: i64, frames: Vec<i64>, damage: &mut Vec<Damage>) -> Option<Vec<i64>> {
    if frames.iter().enumerate().all(|(row, &frame)| frame == row as i64) {
        return None;
    }
    let rises = frames.first().is_some_and(|&first| first >= 0)
        && frames.windows(2).all(|pair| pair[0] < pair[1])
        && frames.last().is_some_and(|&last| last < 1 << 40);
    let detail = if rises {
        format!("episode {episode}: frame_index has holes or does not begin at 0; times follow it")
    } else {
        format!("episode {episode}: frame_index does not rise; rows are taken in the order they have")
    };
    damage.push(Damage { kind: DamageKind::IndexMismatch, offset: 0, detail });
    rises.then_some(frames)
}

/// Returns how far `timestamp` is from the grid at most.
fn off_grid_secs(times: &[f64], frames: Option<&[i64]>, fps: f64) -> f64 {
    let expected = |row: usize| frames.map_or(row as f64, |frames| frames[row] as f64) / fps;
    times.iter().enumerate().map(|(row, time)| (time - expected(row)).abs()).fold(0.0, f64::max)
}

fn off_grid(episode: i64, largest: f64, fps: f64) -> Option<Damage> {
    (largest > GRID_TOLERANCE / fps).then(|| Damage {
        kind: DamageKind::IndexMismatch,
        offset: 0,
        detail: format!(
            "episode {episode}: timestamp is up to {largest:.3} s from frame_index / fps; rows keep the grid, frames of videos follow timestamp"
        ),
    })
}

/// Collects the messages of one block.
struct Messages<'a> {
    recording: &'a LerobotRecording,
    span: &'a Span,
    out: &'a mut Block,
    data: Vec<u8>,
    /// Rows of each column without a value, and why the first has none.
    nulls: BTreeMap<String, (u64, String)>,
}

impl Messages<'_> {
    fn take(&mut self, batch: &RecordBatch, first_row: u64) {
        let recording = self.recording;
        for channel in &recording.channels {
            let column = batch.column_by_name(&channel.topic);
            let (Some(array), Some(&kind)) = (column, recording.kinds.get(&channel.topic)) else { continue };
            if CellKind::of(array.data_type()) != Some(kind) {
                let why = format!("{} is not the type it has in the first file", array.data_type());
                self.nulls.insert(channel.topic.clone(), (batch.num_rows() as u64, why));
                continue;
            }
            let known = self.out.channels.iter().position(|known| Arc::ptr_eq(known, channel));
            let index = known.unwrap_or_else(|| {
                self.out.channels.push(Arc::clone(channel));
                self.out.channels.len() - 1
            });
            for at in 0..array.len() {
                let row = first_row + at as u64;
                let time_ns = recording.time_ns(self.span.episode, row);
                let root = &recording.dataset.root;
                match push_cell(kind, array.as_ref(), at, time_ns, root, &mut self.data) {
                    Ok(range) => {
                        let log_time_ns = u64::try_from(time_ns).unwrap_or(0);
                        self.out.messages.push(Message {
                            channel: index as u32,
                            sequence: u32::try_from(row).unwrap_or(u32::MAX),
                            log_time_ns,
                            publish_time_ns: log_time_ns,
                            range,
                            offset: row,
                        });
                    }
                    Err(why) => {
                        let text = match why {
                            NoMessage::Null => "null".to_owned(),
                            NoMessage::Unreadable(why) => why,
                        };
                        let entry = self.nulls.entry(channel.topic.clone()).or_insert((0, text));
                        entry.0 += 1;
                    }
                }
            }
        }
    }

    /// Takes the frames of a camera from its video file.
    fn take_video(&mut self, camera: &str) {
        let recording = self.recording;
        let Some(channel) = recording.channels.iter().find(|channel| channel.topic == camera) else { return };
        let dataset = &recording.dataset;
        let entry = dataset.entry(recording.episodes[self.span.episode].index);
        let path = entry.and_then(|entry| dataset.video_path(entry, camera));
        let path = match path.unwrap_or_else(|| Err("no video file is named for it".to_owned())) {
            Ok(path) => dataset.root.join(path),
            Err(why) => {
                let n_rows = self.span.rows.end - self.span.rows.start;
                self.nulls.insert(camera.to_owned(), (n_rows, why));
                return;
            }
        };
        let start = entry.and_then(|entry| entry.videos.get(camera)).map_or(0.0, |v| v.from_timestamp_secs);
        let wanted = recording.video_times(self.span, start);
        self.out.channels.push(Arc::clone(channel));
        let index = (self.out.channels.len() - 1) as u32;
        recording.videos.read(&path, &wanted, |at, frame| {
            let row = self.span.rows.start + at as u64;
            let time_ns = recording.time_ns(self.span.episode, row);
            match frame {
                Ok(frame) => {
                    let range = push_raw_image(&frame, time_ns, &mut self.data);
                    let log_time_ns = u64::try_from(time_ns).unwrap_or(0);
                    self.out.messages.push(Message {
                        channel: index,
                        sequence: u32::try_from(row).unwrap_or(u32::MAX),
                        log_time_ns,
                        publish_time_ns: log_time_ns,
                        range,
                        offset: row,
                    });
                }
                Err(error) => {
                    let lost = self.nulls.entry(camera.to_owned());
                    lost.or_insert_with(|| (0, error.to_string())).0 += 1;
                }
            }
        });
    }

    fn finish(self) {
        let episode = self.recording.episodes[self.span.episode].index;
        for (column, (count, why)) in self.nulls {
            self.out.damage.push(Damage {
                kind: DamageKind::RecordMalformed,
                offset: self.span.rows.start,
                detail: format!("episode {episode}, {column}: {count} rows have no value ({why})"),
            });
        }
        self.out.messages.sort_by_key(|message| (message.log_time_ns, message.channel));
        self.out.data = Bytes::from(self.data);
    }
}

impl RowRecording for LerobotRecording {
    fn path(&self) -> &Path {
        &self.dataset.root
    }

    fn file_bytes(&self) -> u64 {
        files_of(&self.dataset.root)
            .iter()
            .map(|name| std::fs::metadata(self.dataset.root.join(name)).map_or(0, |about| about.len()))
            .sum()
    }

    fn content_hash(&self) -> io::Result<[u8; 32]> {
        let mut whole = blake3::Hasher::new();
        for name in files_of(&self.dataset.root) {
            let mut hasher = blake3::Hasher::new();
            io::copy(&mut File::open(self.dataset.root.join(&name))?, &mut hasher)?;
            whole.update(name.to_string_lossy().as_bytes());
            whole.update(&[0]);
            whole.update(hasher.finalize().as_bytes());
        }
        Ok(*whole.finalize().as_bytes())
    }

    fn notes(&self) -> BTreeMap<String, String> {
        let version = self.dataset.info.version.text().to_owned();
        [("format".to_owned(), "lerobot".to_owned()), ("codebase_version".to_owned(), version)].into()
    }

    fn channels(&self) -> &[Arc<Channel>] {
        &self.channels
    }

    fn metadata(&self) -> &[MetadataRecord] {
        &self.metadata
    }

    fn damage(&self) -> &[Damage] {
        &self.damage
    }

    fn blocks(&self) -> &[BlockRef] {
        &self.blocks
    }

    fn read_block(&self, block: &BlockRef) -> Block {
        let mut out = Block::default();
        let span = usize::try_from(block.offset).ok().and_then(|at| self.spans.get(at));
        let Some(span) = span else { return out };
        let mut lost = |detail: String| {
            let episode = self.episodes[span.episode].index;
            out = Block::default();
            out.damage.push(Damage {
                kind: DamageKind::ReadFailed,
                offset: span.rows.start,
                detail: format!("episode {episode}, rows {:?}: {detail}", span.rows),
            });
        };
        // The Parquet reader panics on some damaged files.
        let mut read = Block::default();
        match catch_unwind(AssertUnwindSafe(|| self.read_span(span, &mut read))) {
            Ok(Ok(())) => return read,
            Ok(Err(detail)) => lost(detail),
            Err(_) => lost("content that the Parquet reader cannot digest".to_owned()),
        }
        out
    }

    fn select(&mut self, topics: &[String]) {
        self.selected = topics.iter().cloned().collect();
        self.checked = Mutex::default();
        self.list_blocks();
    }

    fn unavailable(&self) -> &[Unavailable] {
        &self.unavailable
    }
}

/// The files that make the rows, sorted: metadata, data, images and videos beside them.
fn files_of(root: &Path) -> Vec<PathBuf> {
    let mut files = Vec::new();
    let mut folders: Vec<PathBuf> = ["meta", "data", "images", "videos"].map(PathBuf::from).to_vec();
    while let Some(folder) = folders.pop() {
        let Ok(entries) = std::fs::read_dir(root.join(&folder)) else { continue };
        for entry in entries.filter_map(Result::ok) {
            let name = folder.join(entry.file_name());
            match entry.file_type() {
                Ok(kind) if kind.is_dir() => folders.push(name),
                Ok(kind) if kind.is_file() => files.push(name),
                _ => {}
            }
        }
    }
    files.sort();
    files
}
