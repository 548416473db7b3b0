//! A table in the form of a log, so that a contract, the decoder and the aligner take it as it is.
//!
//! Every column of an episode is a topic; every row a message, with its values as stored:
//!
//! | column | message | field |
//! |---|---|---|
//! | one number per row | `float64 data` (or the type it has) | `data` |
//! | several numbers | `float64[7] data`, rows flattened | `data[3]`, `data[0:7]` |
//! | text | `string data` | `data` |
//! | u8 images | `sensor_msgs/msg/Image`, `mono8`, `rgb8` or `rgba8` | |
//!
//! Row t of an episode has the time `start + t / rate`, as stamp, log and publish time. Episodes lie
//! [`EPISODE_GAP_NS`] apart, longer than any gap that a contract allows, and each has a metadata record
//! `episode` with `start_ns`, `end_ns`, its name and what its group's attributes say.
//! A row of nothing but NaN has no message, as the action of the last observation.

use std::collections::{BTreeMap, BTreeSet};
use std::ops::Range;
use std::path::Path;
use std::sync::Arc;

use bytes::Bytes;

use super::column::{AttributeValue, Column, Dtype, Values};
use super::error::ReadError;
use super::finding::{Finding, FindingKind};
use super::raw;
use super::{Episode, Episodes, Extent, LayoutError, Table};
use crate::log::{Block, BlockRef, Channel, Damage, DamageKind, Message, MetadataRecord};
use crate::rows::{
    self, BLOCK_BYTES, CDR_HEADER, EPISODE_GAP_NS, HEADER_TEXT, RowRecording, align, push_bytes, push_header,
    push_text,
};

/// Why a table cannot be taken as a log.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
#[non_exhaustive]
pub enum RecordingError {
    /// No episodes were found.
    #[error(transparent)]
    Layout(#[from] LayoutError),
    /// Rows have no times without a rate.
    #[error("rate of rows: expected a number from 0.001 to 1e6 Hz, got {rate_hz}")]
    Rate {
        /// What was given.
        rate_hz: f64,
    },
    /// More columns or longer times than a log can have.
    #[error("too many {what}: expected at most {limit}")]
    TooMany {
        /// What there is too much of.
        what: &'static str,
        /// The limit.
        limit: u64,
    },
}

/// A table in the form of a log.
pub struct TableRecording {
    table: Table,
    found: Episodes,
    rate_hz: f64,
    starts_ns: Vec<i64>,
    channels: Vec<Arc<Channel>>,
    metadata: Vec<MetadataRecord>,
    damage: Vec<Damage>,
    selected: BTreeSet<String>,
    spans: Vec<Span>,
    blocks: Vec<BlockRef>,
}

/// Rows of one episode: what a block holds.
#[derive(Debug, Clone, PartialEq, Eq)]
struct Span {
    /// Index of the episode.
    episode: usize,
    /// Its rows.
    rows: Range<u64>,
}

impl TableRecording {
    /// Takes the episodes of a table; `rate_hz` says how many rows a second has.
    ///
    /// Unfinished episodes are left out; [`TableRecording::episodes`] tells of them.
    ///
    /// # Errors
    /// - no episodes are found, or the stated layout does not fit
    /// - the rate is not a usable number
    /// - there are more than 65 535 columns, or the times do not fit 64 bits
    pub fn try_new(
        table: Table,
        layout: Option<&super::Layout>,
        rate_hz: f64,
    ) -> Result<Self, RecordingError> {
        if !(0.001..=1e6).contains(&rate_hz) {
            return Err(RecordingError::Rate { rate_hz });
        }
        let found = table.episodes(layout)?;
        let channels = channels(&table, &found)?;
        let mut recording = Self {
            table,
            found,
            rate_hz,
            starts_ns: Vec::new(),
            selected: channels.iter().map(|c| c.topic.clone()).collect(),
            channels,
            metadata: Vec::new(),
            damage: Vec::new(),
            spans: Vec::new(),
            blocks: Vec::new(),
        };
        recording.damage = recording.findings().filter_map(damage_of).collect();
        recording.place_episodes()?;
        recording.list_blocks();
        Ok(recording)
    }

    fn place_episodes(&mut self) -> Result<(), RecordingError> {
        let too_long = RecordingError::TooMany { what: "nanoseconds", limit: i64::MAX as u64 };
        // Not at 0, which loggers write when they do not know the time.
        let mut start_ns = EPISODE_GAP_NS;
        for episode in &self.found.episodes {
            let last = rows_of(episode).saturating_sub(1);
            let length_ns = last as f64 * 1e9 / self.rate_hz;
            if length_ns > 4e18 {
                return Err(too_long);
            }
            let end_ns = start_ns.checked_add(length_ns.round() as i64);
            let next = end_ns.and_then(|end| end.checked_add(EPISODE_GAP_NS));
            let (Some(end_ns), Some(next)) = (end_ns, next) else { return Err(too_long) };
            self.starts_ns.push(start_ns);
            self.metadata.push(record(&self.table, episode, start_ns, end_ns));
            start_ns = next;
        }
        Ok(())
    }

    /// Returns the table.
    pub fn table(&self) -> &Table {
        &self.table
    }

    /// Returns the episodes, the unfinished ones too, and what was noticed about them.
    pub fn episodes(&self) -> &Episodes {
        &self.found
    }

    /// Returns what was noticed about the file and its episodes.
    pub fn findings(&self) -> impl Iterator<Item = &Finding> {
        self.table.findings().iter().chain(&self.found.findings)
    }

    fn list_blocks(&mut self) {
        let (mut spans, mut blocks) = (Vec::new(), Vec::new());
        for (index, episode) in self.found.episodes.iter().enumerate() {
            let row_bytes = self.row_bytes(episode).max(1);
            let step = (BLOCK_BYTES / row_bytes).clamp(1, 4096);
            let n_rows = rows_of(episode);
            let mut start = 0;
            while start < n_rows {
                let end = (start + step).min(n_rows);
                let time = |row| u64::try_from(self.time_ns(index, row)).ok();
                let bytes = (end - start).saturating_mul(row_bytes);
                blocks.push(BlockRef::of_table(blocks.len() as u64, bytes, time(start), time(end - 1)));
                spans.push(Span { episode: index, rows: start..end });
                start = end;
            }
        }
        (self.spans, self.blocks) = (spans, blocks);
    }

    fn row_bytes(&self, episode: &Episode) -> u64 {
        let selected = episode.columns.iter().filter(|(name, _)| self.selected.contains(&***name));
        let columns = selected.filter_map(|(_, at)| self.table.column(&at.path));
        columns.fold(0, |n, c| n.saturating_add(c.row_elements().saturating_mul(8)))
    }

    fn time_ns(&self, episode: usize, row: u64) -> i64 {
        let since = (row as f64 * 1e9 / self.rate_hz).round() as i64;
        self.starts_ns.get(episode).map_or(since, |start| start.saturating_add(since))
    }

    /// Hashes the columns that are used: HDF5 has no checksums of its own, so this shows later damage.
    ///
    /// A column that cannot be read has none; reading it for rows says why.
    fn column_hashes(&self) -> BTreeMap<String, String> {
        let mut notes = BTreeMap::new();
        for channel in self.channels.iter().filter(|channel| self.selected.contains(&channel.topic)) {
            let columns = self.found.episodes.iter().filter_map(|e| e.columns.get(channel.topic.as_str()));
            let mut paths: Vec<&str> = columns.map(|at| &*at.path).collect();
            paths.dedup();
            let hashes: Option<Vec<[u8; 32]>> =
                paths.iter().map(|path| self.table.content_hash(path).ok()).collect();
            let hash = match hashes.as_deref() {
                Some([only]) => blake3::Hash::from_bytes(*only),
                Some(several) => blake3::hash(several.as_flattened()),
                None => continue,
            };
            notes.insert(format!("column {}", channel.topic), hash.to_hex().to_string());
        }
        notes
    }
}

impl RowRecording for TableRecording {
    fn path(&self) -> &Path {
        self.table.path()
    }

    fn file_bytes(&self) -> u64 {
        // A file that is gone since has been hashed before, and then the run has failed.
        std::fs::metadata(self.table.path()).map_or(0, |about| about.len())
    }

    fn notes(&self) -> BTreeMap<String, String> {
        let mut notes = self.column_hashes();
        notes.insert("layout".to_owned(), self.found.layout.name().to_owned());
        notes
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

    fn content_hash(&self) -> std::io::Result<[u8; 32]> {
        let mut hasher = blake3::Hasher::new();
        std::io::copy(&mut std::fs::File::open(self.table.path())?, &mut hasher)?;
        Ok(*hasher.finalize().as_bytes())
    }

    fn blocks(&self) -> &[BlockRef] {
        &self.blocks
    }

    fn read_block(&self, block: &BlockRef) -> Block {
        let mut out = Block::default();
        let span = usize::try_from(block.offset).ok().and_then(|at| self.spans.get(at));
        let Some((block, episode)) = span.and_then(|s| Some((s, self.found.episodes.get(s.episode)?))) else {
            return out;
        };
        let (mut data, mut messages) = (Vec::new(), Vec::new());
        for channel in self.channels.iter().filter(|c| self.selected.contains(&c.topic)) {
            let Some(at) = episode.columns.get(channel.topic.as_str()).filter(|at| at.extent.has_steps())
            else {
                continue;
            };
            let index = out.channels.len() as u32;
            out.channels.push(Arc::clone(channel));
            let rows = block.rows.start.min(at.rows)..block.rows.end.min(at.rows);
            let writer = Writer { table: &self.table, path: &at.path, channel, first_row: at.start };
            let time_ns = |row| self.time_ns(block.episode, row);
            let written = writer.write(rows, &time_ns, &mut data, &mut |row, range| {
                let time_ns = u64::try_from(time_ns(row)).unwrap_or(0);
                let sequence = u32::try_from(row).unwrap_or(u32::MAX);
                let times = (time_ns, time_ns);
                messages.push(Message {
                    channel: index,
                    sequence,
                    log_time_ns: times.0,
                    publish_time_ns: times.1,
                    range,
                    offset: row.saturating_add(at.start),
                });
            });
            if let Err(error) = written {
                let detail = format!("episode {}, rows {:?}: {error}", episode.name, block.rows);
                out.damage.push(Damage {
                    kind: DamageKind::UnreadableBytes,
                    offset: block.rows.start,
                    detail,
                });
            }
        }
        messages.sort_by_key(|m| (m.log_time_ns, m.channel));
        out.messages = messages;
        out.data = Bytes::from(data);
        out
    }

    fn why_not_offered(&self, topic: &str) -> Option<(String, Option<&'static str>)> {
        let is_it = |path: &str| {
            path.strip_suffix(topic).is_some_and(|before| before.is_empty() || before.ends_with('/'))
        };
        let unreadable = self.table.columns().iter().filter(|column| is_it(&column.path));
        if let Some(problem) = unreadable.filter_map(|column| column.problem.as_ref()).next() {
            return Some((problem.to_string(), problem.hint()));
        }
        if let Some(finding) = self.findings().find(|finding| is_it(&finding.place)) {
            return Some((format!("{}: {}", finding.place, finding.detail), None));
        }
        let of_episode = self.found.episodes.iter().find_map(|episode| episode.columns.get(topic));
        let rows = of_episode.map(|at| at.rows).or_else(|| {
            self.table.columns().iter().find(|column| is_it(&column.path)).and_then(Column::rows)
        })?;
        Some((format!("it has {rows} rows, which are not those of the episodes"), None))
    }

    fn select(&mut self, topics: &[String]) {
        self.selected = topics.iter().cloned().collect();
        self.list_blocks();
    }
}

/// Says a finding in the terms of logs; what concerns columns that nobody may ask for is no damage of the file.
fn damage_of(finding: &Finding) -> Option<Damage> {
    let kind = match finding.kind {
        FindingKind::Truncated | FindingKind::UnflushedRows | FindingKind::EpisodeCut => {
            DamageKind::Truncated
        }
        FindingKind::UncleanClose => DamageKind::MissingFooter,
        FindingKind::BrokenObject => DamageKind::RecordMalformed,
        FindingKind::InconsistentIndex => DamageKind::IndexMismatch,
        FindingKind::UnfinishedTail => DamageKind::IndexIncomplete,
        _ => return None,
    };
    Some(Damage { kind, offset: 0, detail: format!("{}: {}", finding.place, finding.detail) })
}

/// The final observation is a row too.
fn rows_of(episode: &Episode) -> u64 {
    let rows = episode.columns.values().filter(|at| at.extent.has_steps()).map(|at| at.rows);
    rows.max().unwrap_or(episode.steps)
}

/// Makes one channel per name, as its column in the first episode that has it.
fn channels(table: &Table, found: &Episodes) -> Result<Vec<Arc<Channel>>, RecordingError> {
    let mut first: BTreeMap<&str, &Column> = BTreeMap::new();
    for episode in &found.episodes {
        for (name, at) in episode.columns.iter().filter(|(_, at)| at.extent.has_steps()) {
            if let (false, Some(column)) = (first.contains_key(&**name), table.column(&at.path)) {
                first.insert(name, column);
            }
        }
    }
    if first.len() > usize::from(u16::MAX) {
        return Err(RecordingError::TooMany { what: "columns", limit: u64::from(u16::MAX) });
    }
    Ok(first.into_iter().zip(1..).map(|((name, column), id)| Arc::new(channel(name, column, id))).collect())
}

fn channel(topic: &str, column: &Column, id: u16) -> Channel {
    let (name, text) = match image_encoding(column) {
        Some(_) => ("sensor_msgs/msg/Image".to_owned(), format!("{IMAGE_FIELDS}{HEADER_TEXT}")),
        None => {
            let element = ros_type(column.dtype);
            let text = match column.row_elements() {
                1 if column.shape.len() == 1 => format!("{element} data\n"),
                n => format!("{element}[{n}] data\n"),
            };
            ("gawm_msgs/msg/Row".to_owned(), text)
        }
    };
    rows::channel(topic, &name, text, id)
}

const IMAGE_FIELDS: &str = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n";

fn image_encoding(column: &Column) -> Option<&'static str> {
    column.image_shape().map(|[_, _, channels]| match channels {
        1 => "mono8",
        3 => "rgb8",
        _ => "rgba8",
    })
}

fn ros_type(dtype: Dtype) -> &'static str {
    match dtype {
        Dtype::Bool => "bool",
        Dtype::U8 => "uint8",
        Dtype::I8 => "int8",
        Dtype::U16 => "uint16",
        Dtype::I16 => "int16",
        Dtype::U32 => "uint32",
        Dtype::I32 => "int32",
        Dtype::U64 => "uint64",
        Dtype::I64 => "int64",
        Dtype::F16 | Dtype::F32 => "float32",
        Dtype::F64 => "float64",
        Dtype::Text | Dtype::Unsupported => "string",
    }
}

/// Tells of an episode what the file tells: its place, its group's attributes, its constants.
fn record(table: &Table, episode: &Episode, start_ns: i64, end_ns: i64) -> MetadataRecord {
    let mut values = BTreeMap::new();
    let attributes = episode.group.as_ref().and_then(|g| table.groups().get(g)).into_iter().flatten();
    for attribute in attributes {
        if let Some(text) = attribute_text(&attribute.value) {
            values.insert(attribute.name.clone(), text);
        }
    }
    for (name, at) in episode.columns.iter().filter(|(_, at)| at.extent == Extent::Constant) {
        if let Some(text) = constant_text(table, &at.path, at.start) {
            values.insert(name.to_string(), text);
        }
    }
    values.insert("name".to_owned(), episode.name.clone());
    values.insert("steps".to_owned(), episode.steps.to_string());
    values.insert("start_ns".to_owned(), start_ns.to_string());
    values.insert("end_ns".to_owned(), end_ns.to_string());
    MetadataRecord { name: "episode".to_owned(), values, offset: 0 }
}

fn attribute_text(value: &AttributeValue) -> Option<String> {
    match value {
        AttributeValue::Text(text) => Some(text.clone()),
        AttributeValue::Number(number) => Some(number.to_string()),
        AttributeValue::Integer(number) => Some(number.to_string()),
        AttributeValue::Flag(flag) => Some(flag.to_string()),
        AttributeValue::Texts(_) | AttributeValue::Numbers(_) | AttributeValue::Unsupported(_) => None,
    }
}

fn constant_text(table: &Table, path: &str, row: u64) -> Option<String> {
    let column = table.column(path).filter(|c| c.row_elements() == 1 && c.readable_rows > row)?;
    Some(match table.read_rows(&column.path, row..row + 1).ok()?.values {
        Values::Text(texts) => texts.into_iter().next()?,
        Values::Bool(flags) => flags.first()?.to_string(),
        values => match (values.to_i64(), values.to_f64()) {
            (Some(integers), _) => integers.first()?.to_string(),
            (None, Some(numbers)) => numbers.first()?.to_string(),
            (None, None) => return None,
        },
    })
}

/// Writes rows of one column as messages.
struct Writer<'a> {
    table: &'a Table,
    path: &'a str,
    channel: &'a Channel,
    first_row: u64,
}

impl Writer<'_> {
    fn write(
        &self,
        rows: Range<u64>,
        time_ns: &dyn Fn(u64) -> i64,
        data: &mut Vec<u8>,
        take: &mut dyn FnMut(u64, Range<usize>),
    ) -> Result<(), ReadError> {
        let (at, column, raw) = self.table.readable(self.path)?;
        // Another episode may hold another kind of values under this name.
        let is_same = self.channel.schema == channel(&self.channel.topic, column, self.channel.id).schema;
        if !is_same {
            let wanted = "the type and width that it has in the first episode";
            let got = format!("{} of extent {:?}", column.dtype.name(), column.shape);
            return Err(ReadError::WrongKind { column: self.path.to_owned(), wanted, got });
        }
        if let (Some(encoding), Some(shape)) = (image_encoding(column), column.image_shape()) {
            return self.write_images(rows, encoding, shape, time_ns, data, take);
        }
        let stored = self.first_row + rows.start..self.first_row + rows.end;
        if raw.dtype == Dtype::Text {
            let Values::Text(texts) = self.table.read_rows(self.path, stored)?.values else { return Ok(()) };
            return write_texts(&texts, column, rows, data, take);
        }
        let mut bytes = self.table.read_stored(at, column, stored)?;
        raw::to_little_endian(&mut bytes, raw);
        let item = raw.item_bytes * usize::try_from(column.row_elements()).unwrap_or(0);
        for (row, values) in rows.zip(bytes.chunks_exact(item.max(1))) {
            if !is_all_nan(values, raw.dtype) {
                let start = data.len();
                data.extend_from_slice(&CDR_HEADER);
                match raw.dtype {
                    Dtype::F16 => values.chunks_exact(2).for_each(|h| {
                        data.extend_from_slice(
                            &raw::f32_from_f16(u16::from_le_bytes([h[0], h[1]])).to_le_bytes(),
                        );
                    }),
                    _ => data.extend_from_slice(values),
                }
                take(row, start..data.len());
            }
        }
        Ok(())
    }

    fn write_images(
        &self,
        rows: Range<u64>,
        encoding: &str,
        [height, width, channels]: [u64; 3],
        time_ns: &dyn Fn(u64) -> i64,
        data: &mut Vec<u8>,
        take: &mut dyn FnMut(u64, Range<usize>),
    ) -> Result<(), ReadError> {
        let mut pixels = Vec::new();
        let u32_of = |n: u64| u32::try_from(n).unwrap_or(u32::MAX).to_le_bytes();
        for row in rows {
            self.table.read_image(self.path, self.first_row + row, &mut pixels)?;
            let start = push_header(time_ns(row), data);
            align(start, 4, data);
            data.extend_from_slice(&u32_of(height));
            data.extend_from_slice(&u32_of(width));
            push_text(encoding, start, data);
            data.push(0);
            align(start, 4, data);
            data.extend_from_slice(&u32_of(width.saturating_mul(channels)));
            push_bytes(&pixels, start, data);
            take(row, start..data.len());
        }
        Ok(())
    }
}

fn write_texts(
    texts: &[String],
    column: &Column,
    rows: Range<u64>,
    data: &mut Vec<u8>,
    take: &mut dyn FnMut(u64, Range<usize>),
) -> Result<(), ReadError> {
    let per_row = usize::try_from(column.row_elements()).unwrap_or(usize::MAX).max(1);
    for (row, texts) in rows.zip(texts.chunks_exact(per_row)) {
        let start = data.len();
        data.extend_from_slice(&CDR_HEADER);
        texts.iter().for_each(|text| push_text(text, start, data));
        take(row, start..data.len());
    }
    Ok(())
}

fn is_all_nan(values: &[u8], dtype: Dtype) -> bool {
    let is_nan = |item: &[u8]| match (dtype, item) {
        (Dtype::F16, &[a, b]) => raw::f32_from_f16(u16::from_le_bytes([a, b])).is_nan(),
        (Dtype::F32, &[a, b, c, d]) => f32::from_le_bytes([a, b, c, d]).is_nan(),
        (Dtype::F64, &[a, b, c, d, e, f, g, h]) => f64::from_le_bytes([a, b, c, d, e, f, g, h]).is_nan(),
        _ => false,
    };
    let size = match dtype {
        Dtype::F16 => 2,
        Dtype::F32 => 4,
        Dtype::F64 => 8,
        _ => return false,
    };
    !values.is_empty() && values.chunks_exact(size).all(is_nan)
}
