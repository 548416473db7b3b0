//! Writes a plan over gawm datasets as a gawm dataset.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::Path;

use arrow::array::{Array, AsArray, BinaryArray, BooleanArray, Int64Array, RecordBatch};
use bytes::Bytes;
use gawm_schema::batch::Split;
use gawm_schema::{ContentHash, Role, Schema, first_difference};

use super::input::GawmInput;
use super::piece_rows::for_each_batch;
use super::{EditError, EditSummary, Input, Piece, Plan, history};
use crate::block::StoredValues;
use crate::columns::Columns;
use crate::episode::EpisodeRecord;
use crate::layout::{AGE_MS, ARRIVAL_AGE_MS, CALIBRATION, TIME_NS, VALID};
use crate::provenance::{AttachmentRecord, RecordingRecord};
use crate::read::join_inside;
use crate::rows::{AgeColumns, ImageColumn, Rows, VectorColumn};
use crate::scan::{column, vector_values};
use crate::spec::{DatasetSpec, EpisodeInfo, RecordingState, WriteMode};
use crate::trajectory::Trajectory;
use crate::writer::DatasetWriter;

/// Columns of the episode table that the writer makes itself.
const KNOWN_COLUMNS: [&str; 13] = [
    "success",
    "success_known",
    "operator",
    "robot",
    "session",
    "split",
    "gawm/episode_id",
    "gawm/recording",
    "gawm/source_file",
    "gawm/source_hash",
    "gawm/start_ns",
    "gawm/end_ns",
    "gawm/content_hash",
];

/// An input with what it says of itself.
struct Source<'a> {
    input: &'a Input,
    gawm: &'a GawmInput,
}

/// Episodes of one recording, wherever they come from.
struct Group<'a> {
    record: &'a RecordingRecord,
    input: usize,
    pieces: Vec<&'a Piece>,
}

pub(super) fn write(
    inputs: &[Input],
    plan: &Plan,
    dir: &Path,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<EditSummary, EditError> {
    let sources: Vec<Source<'_>> =
        inputs.iter().filter_map(|input| Some(Source { input, gawm: input.gawm.as_ref()? })).collect();
    check_equal(&sources)?;
    let mut notes = Vec::new();
    let groups = groups(&sources, plan, &mut notes)?;
    let schema = &sources[0].gawm.meta.schema;
    let mut writer = begin(&sources, &groups, dir)?;
    for group in &groups {
        let contracts = &sources[group.input].gawm.meta.contracts;
        let text = contracts.iter().find(|c| c.hash == group.record.contract).map_or("", |c| &c.text);
        writer.use_contract(text);
        if writer.begin_recording(group.record.source.clone())? == RecordingState::AlreadyThere {
            continue;
        }
        copy_attachments(&mut writer, &sources[group.input], &group.record.attachments)?;
        for piece in &group.pieces {
            let source = &sources[piece.input];
            let (columns, mut copied) = (Columns::new(schema), EpisodeCopy::new(source, piece, schema));
            writer.begin_episode(copied.info(source)?)?;
            for_each_batch(source.input, piece, |batch| {
                progress(batch.num_rows() as u64);
                let rows = copied.rows(source, &columns, &batch)?;
                let trajectory = Trajectory::try_new(schema, rows).map_err(|error| {
                    copied.damaged(
                        source,
                        format!("rows {} and on: {error}", copied.n_rows - batch.num_rows() as u64),
                    )
                })?;
                Ok(writer.write(trajectory)?)
            })?;
            writer.amend_episode(copied.amended(source)?)?;
            writer.end_episode()?;
        }
        writer.end_recording()?;
    }
    let episodes: u64 = groups.iter().map(|group| group.pieces.len() as u64).sum();
    let rows = groups.iter().flat_map(|group| &group.pieces).map(|p| p.rows.end - p.rows.start).sum();
    history::write(dir, inputs, plan, (episodes, rows))?;
    let summary = writer.finish()?;
    Ok(EditSummary { episodes: summary.episodes, rows: summary.frames, notes })
}

/// Datasets are merged only when rows mean the same.
fn check_equal(sources: &[Source<'_>]) -> Result<(), EditError> {
    let Some((first, others)) = sources.split_first() else { return Ok(()) };
    let different =
        |other: &Source<'_>, (place, expected, got): (String, String, String)| EditError::Different {
            first: first.input.dataset.root.clone(),
            second: other.input.dataset.root.clone(),
            place,
            expected,
            got,
        };
    let json = |schema: &Schema| serde_json::to_value(schema).unwrap_or_default();
    for other in others {
        let (a, b) = (&first.gawm.meta, &other.gawm.meta);
        if let Some(difference) = first_difference("schema", &json(&a.schema), &json(&b.schema)) {
            return Err(different(other, difference));
        }
        if a.train_share != b.train_share {
            let values = (a.train_share.to_string(), b.train_share.to_string());
            return Err(different(other, ("train_share".to_owned(), values.0, values.1)));
        }
    }
    Ok(())
}

/// Gathers the episodes of each recording; equal episodes are taken once.
fn groups<'a>(
    sources: &[Source<'a>],
    plan: &'a Plan,
    notes: &mut Vec<String>,
) -> Result<Vec<Group<'a>>, EditError> {
    let mut groups: Vec<Group<'a>> = Vec::new();
    let mut position: BTreeMap<ContentHash, usize> = BTreeMap::new();
    let mut seen: BTreeMap<&str, &Piece> = BTreeMap::new();
    let mut n_equal = 0;
    for piece in &plan.pieces {
        let source = &sources[piece.input];
        let episode = record_of(source, piece)?;
        let recording =
            usize::try_from(episode.recording).ok().and_then(|i| source.gawm.meta.recordings.get(i));
        let recording = recording.ok_or_else(|| {
            damaged(source, piece, format!("gawm/recording {} is not in meta/gawm.json", episode.recording))
        })?;
        if let Some(earlier) = seen.insert(episode.id.as_str(), piece) {
            let other = record_of(&sources[earlier.input], earlier)?;
            if other.content_hash == episode.content_hash && earlier.rows == piece.rows {
                n_equal += 1;
                continue;
            }
            return Err(EditError::Conflicting {
                id: episode.id.clone(),
                first: sources[earlier.input].input.dataset.root.clone(),
                second: source.input.dataset.root.clone(),
            });
        }
        let slot = *position.entry(recording.source.content_hash).or_insert_with(|| {
            groups.push(Group { record: recording, input: piece.input, pieces: Vec::new() });
            groups.len() - 1
        });
        groups[slot].pieces.push(piece);
    }
    if n_equal > 0 {
        notes.push(format!("{n_equal} episodes were in several inputs and are taken once"));
    }
    // Parts of a recording come back together in the order of their time, those of one input in theirs.
    for group in &mut groups {
        let is_mixed = group.pieces.windows(2).any(|pair| pair[0].input != pair[1].input);
        if is_mixed {
            let start = |piece: &&Piece| record_of(&sources[piece.input], piece).map_or(0, |r| r.start_ns);
            group.pieces.sort_by_key(start);
        }
    }
    Ok(groups)
}

fn record_of<'a>(source: &Source<'a>, piece: &Piece) -> Result<&'a EpisodeRecord, EditError> {
    let record = source.input.record(piece.run);
    record.ok_or_else(|| damaged(source, piece, "it is not in the episode table".to_owned()))
}

fn damaged(source: &Source<'_>, piece: &Piece, got: String) -> EditError {
    let dataset = &source.input.dataset;
    EditError::Damaged {
        path: dataset.root.clone(),
        place: format!("episode {}", dataset.runs[piece.run].episode_index),
        expected: "rows that keep the data contract".to_owned(),
        got,
    }
}

fn begin(sources: &[Source<'_>], groups: &[Group<'_>], dir: &Path) -> Result<DatasetWriter, EditError> {
    let meta = &sources[0].gawm.meta;
    let contract = groups.first().and_then(|group| {
        let contracts = &sources[group.input].gawm.meta.contracts;
        contracts.iter().find(|contract| contract.hash == group.record.contract)
    });
    let spec = DatasetSpec {
        train_share: meta.train_share,
        max_file_bytes: meta.max_file_bytes,
        ..DatasetSpec::new(
            meta.schema.clone(),
            contract.map_or("", |contract| &contract.text),
            history::software(),
        )
    };
    Ok(DatasetWriter::create(dir, spec, WriteMode::New)?)
}

/// Takes over the files that came with a recording.
fn copy_attachments(
    writer: &mut DatasetWriter,
    source: &Source<'_>,
    attachments: &[AttachmentRecord],
) -> Result<(), EditError> {
    let dataset = &source.input.dataset;
    for record in attachments {
        let damaged = |got: String| EditError::Damaged {
            path: dataset.root.clone(),
            place: record.path.clone(),
            expected: "the file that meta/gawm.json describes".to_owned(),
            got,
        };
        let path = join_inside(&dataset.root, &record.path).map_err(damaged)?;
        let file = File::open(&path).map_err(EditError::io("open", &path))?;
        let mut bytes = Vec::new();
        file.take(dataset.limits.max_json_bytes + 1)
            .read_to_end(&mut bytes)
            .map_err(EditError::io("read", &path))?;
        if ContentHash::of(&bytes) != record.content_hash {
            return Err(damaged("other bytes".to_owned()));
        }
        let folder = Path::new(&record.path).parent();
        if folder == Some(Path::new(CALIBRATION)) {
            let value: serde_json::Value =
                serde_json::from_slice(&bytes).map_err(|error| damaged(error.to_string()))?;
            writer.add_calibration(&record.name, &value)?;
        } else {
            writer.add_attachment(&record.name, &bytes)?;
        }
    }
    Ok(())
}

/// Takes columns of the episode table that gawm does not know as tags.
pub(super) fn add_foreign_columns(input: &Input, run: usize, tags: &mut BTreeMap<String, String>) {
    let entry = input.dataset.entry(input.dataset.runs[run].episode_index);
    for (name, value) in entry.into_iter().flat_map(|entry| &entry.extras) {
        if !KNOWN_COLUMNS.contains(&name.as_str()) && name != "gawm/tags" && !value.is_null() {
            let text = value.as_str().map_or_else(|| value.to_string(), str::to_owned);
            tags.entry(name.clone()).or_insert(text);
        }
    }
}

/// An episode on its way into the output.
struct EpisodeCopy<'a> {
    piece: &'a Piece,
    /// Columns of actions, and whether the last row is a new one whose action leads out of the episode.
    is_action: Vec<bool>,
    is_cut: bool,
    n_rows: u64,
    first_ns: Option<i64>,
    last_ns: i64,
}

impl<'a> EpisodeCopy<'a> {
    fn new(source: &Source<'_>, piece: &'a Piece, schema: &Schema) -> EpisodeCopy<'a> {
        EpisodeCopy {
            piece,
            is_action: schema.vectors().map(|feature| feature.role == Role::Action).collect(),
            is_cut: piece.rows.end < source.input.dataset.runs[piece.run].n_rows,
            n_rows: 0,
            first_ns: None,
            last_ns: 0,
        }
    }

    fn damaged(&self, source: &Source<'_>, got: String) -> EditError {
        damaged(source, self.piece, got)
    }

    /// Returns what is said of the episode, with columns of the episode table that gawm does not know as tags.
    fn info(&self, source: &Source<'_>) -> Result<EpisodeInfo, EditError> {
        let record = record_of(source, self.piece)?.clone();
        let mut tags = record.tags;
        add_foreign_columns(source.input, self.piece.run, &mut tags);
        Ok(EpisodeInfo {
            id: record.id,
            task: record.task,
            success: record.success,
            operator: record.operator,
            robot: record.robot,
            session: record.session,
            // A label keeps its place, and so does what a hash chose.
            split: Some(if record.is_training { Split::Train } else { Split::Validation }),
            start_ns: record.start_ns,
            end_ns: record.end_ns,
            source_file: record.source_file,
            tags,
        })
    }

    /// Returns what is said of the episode once its rows are known: a cut one begins later and ends earlier.
    fn amended(&self, source: &Source<'_>) -> Result<EpisodeInfo, EditError> {
        let mut info = self.info(source)?;
        let n_rows = source.input.dataset.runs[self.piece.run].n_rows;
        let rows = &self.piece.rows;
        if rows.start > 0 || rows.end < n_rows {
            let text = format!("rows {}..{} of {n_rows}", rows.start, rows.end);
            let tag = info.tags.entry("gawm-data trim".to_owned()).or_default();
            *tag = if tag.is_empty() { text } else { format!("{tag}, then {text}") };
        }
        if rows.start > 0 {
            // Times of another clock than the episode's say nothing of its span.
            info.start_ns =
                self.first_ns.filter(|t| (info.start_ns..=info.end_ns).contains(t)).unwrap_or(info.start_ns);
        }
        if rows.end < n_rows {
            info.end_ns = Some(self.last_ns)
                .filter(|t| (info.start_ns..=info.end_ns).contains(t))
                .unwrap_or(info.end_ns);
        }
        Ok(info)
    }

    /// Returns the rows of a batch.
    fn rows(
        &mut self,
        source: &Source<'_>,
        columns: &Columns,
        batch: &RecordBatch,
    ) -> Result<Rows, EditError> {
        let n_rows = batch.num_rows();
        let end = self.n_rows + n_rows as u64;
        let is_last = end == self.piece.rows.end - self.piece.rows.start;
        let mut rows = rows_of(columns, batch).map_err(|got| self.damaged(source, got))?;
        if self.is_cut && is_last {
            // The action of the new last row leads out of the episode.
            let actions = rows.vectors.iter_mut().zip(&self.is_action).filter(|(_, is_action)| **is_action);
            actions.filter_map(|(vector, _)| vector.valid.last_mut()).for_each(|valid| *valid = false);
        }
        self.first_ns = self.first_ns.or(rows.time_ns.first().copied());
        self.last_ns = rows.time_ns.last().copied().unwrap_or(self.last_ns);
        self.n_rows = end;
        Ok(rows)
    }
}

fn rows_of(columns: &Columns, batch: &RecordBatch) -> Result<Rows, String> {
    let valid = |name: &str| -> Result<Vec<bool>, String> {
        Ok(column::<BooleanArray>(batch, &format!("{VALID}{name}"))?.values().iter().collect())
    };
    let time_ns = column::<Int64Array>(batch, TIME_NS)?.values().to_vec();
    let mut vectors = Vec::with_capacity(columns.vectors.len());
    for plan in &columns.vectors {
        let values = match vector_values(batch, &plan.name, plan.width())? {
            StoredValues::F32(values) => values.into_iter().map(f64::from).collect(),
            StoredValues::F64(values) => values,
        };
        vectors.push(VectorColumn { values, valid: valid(&plan.name)? });
    }
    let mut images = Vec::with_capacity(columns.images.len());
    for plan in &columns.images {
        images.push(ImageColumn { frames: frames_of(batch, &plan.name)?, valid: valid(&plan.name)? });
    }
    let ages = |name: &str| -> Result<Vec<f32>, String> {
        if columns.n_streams == 0 {
            return Ok(Vec::new());
        }
        Ok(match vector_values(batch, name, columns.n_streams)? {
            StoredValues::F32(values) => values,
            StoredValues::F64(values) => values.into_iter().map(|v| v as f32).collect(),
        })
    };
    let ages = AgeColumns { age_ms: ages(AGE_MS)?, arrival_age_ms: ages(ARRIVAL_AGE_MS)? };
    Ok(Rows { time_ns, vectors, images, ages })
}

fn frames_of(batch: &RecordBatch, name: &str) -> Result<Vec<Bytes>, String> {
    let array = batch.column_by_name(name).ok_or_else(|| format!("column {name:?} is missing"))?;
    let bytes = array.as_struct_opt().and_then(|s| s.column_by_name("bytes"));
    let bytes = bytes.and_then(|b| b.as_any().downcast_ref::<BinaryArray>());
    let bytes = bytes.filter(|b| b.null_count() == 0 && array.null_count() == 0);
    let bytes = bytes.ok_or_else(|| format!("column {name:?} is no struct of bytes, or has nulls"))?;
    Ok(bytes.iter().flatten().map(Bytes::copy_from_slice).collect())
}
