//! The rows of the open episode on their way into a data file.

use std::collections::BTreeMap;
use std::ops::Range;

use gawm_schema::batch::Split;
use gawm_schema::{ContentHash, DimStats, DimSummary, Role};

use crate::block::{BlockPosition, RowBlock};
use crate::camera::CameraStats;
use crate::columns::Columns;
use crate::data_file::{DataFile, FileMark};
use crate::episode::{EpisodeRecord, FeatureStats, is_policy_input};
use crate::error::WriteError;
use crate::rows::Rows;
use crate::spec::EpisodeInfo;
use crate::totals::Totals;

/// Rows are encoded, counted and hashed in blocks of at most this many rows.
const BLOCK_ROWS: usize = 1024;
/// A block is closed before its frames would take more bytes than this.
const BLOCK_BYTES: u64 = 4 << 20;

/// Bytes of rows without images that are hashed at once.
const HASHED_BYTES: usize = 1 << 16;

/// An episode that has begun and not ended.
pub(super) struct OpenEpisode {
    info: EpisodeInfo,
    /// Position in the dataset.
    number: u64,
    task: u64,
    first_index: u64,
    /// Where its first row is in the data file.
    beginning: Option<FileMark>,
    /// Rows that have left the block.
    n_written: u64,
    block: RowBlock,
    block_bytes: u64,
    last_time_ns: Option<i64>,
    /// The feature whose action of the last row holds numbers without being valid.
    held_action: Option<String>,
    totals: Totals,
    cameras: BTreeMap<String, CameraStats>,
    hasher: blake3::Hasher,
    numeric_row_bytes: u64,
}

/// What an ended episode gives.
pub(super) struct DoneEpisode {
    pub(super) record: EpisodeRecord,
    /// What the caller says of training and validation.
    pub(super) split: Option<Split>,
    pub(super) totals: Totals,
    pub(super) cameras: BTreeMap<String, CameraStats>,
}

impl OpenEpisode {
    pub(super) fn new(
        columns: &Columns,
        info: EpisodeInfo,
        number: u64,
        task: u64,
        first_index: u64,
        schema_hash: ContentHash,
    ) -> OpenEpisode {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&schema_hash.0);
        OpenEpisode {
            info,
            number,
            task,
            first_index,
            beginning: None,
            n_written: 0,
            block: RowBlock::new(columns),
            block_bytes: 0,
            last_time_ns: None,
            held_action: None,
            totals: Totals::new(columns),
            cameras: BTreeMap::new(),
            hasher,
            numeric_row_bytes: numeric_row_bytes(columns),
        }
    }

    /// Takes what is known at the end; id and task stay.
    pub(super) fn amend(&mut self, info: EpisodeInfo) {
        let EpisodeInfo { id, task, .. } = std::mem::take(&mut self.info);
        self.info = EpisodeInfo { id, task, ..info };
    }

    pub(super) fn id(&self) -> &str {
        &self.info.id
    }

    pub(super) fn task(&self) -> u64 {
        self.task
    }

    /// Notes where the episode begins in the data file; only the first call counts.
    pub(super) fn begin_in(&mut self, mark: FileMark) {
        self.beginning.get_or_insert(mark);
    }

    pub(super) fn beginning(&self) -> Option<FileMark> {
        self.beginning
    }

    pub(super) fn length(&self) -> u64 {
        self.n_written + self.block.len() as u64
    }

    /// Takes rows; full blocks go to the file.
    pub(super) fn write(
        &mut self,
        columns: &Columns,
        file: &mut DataFile,
        rows: Rows,
    ) -> Result<(), WriteError> {
        check_shape(columns, &rows)?;
        self.check_continuity(columns, &rows)?;
        let mut start = 0;
        for row in 0..rows.time_ns.len() {
            let bytes = self.numeric_row_bytes
                + rows.images.iter().map(|image| image.frames[row].len() as u64).sum::<u64>();
            let n_pending = self.block.len() + (row - start);
            let is_full = n_pending == BLOCK_ROWS || self.block_bytes + bytes > BLOCK_BYTES;
            if n_pending > 0 && (is_full || !file.has_room(self.block_bytes + bytes)) {
                self.take(columns, &rows, start..row)?;
                self.flush(columns, file)?;
                start = row;
            }
            if self.block_bytes == 0 && !file.has_room(bytes) {
                file.end_row_group().map_err(WriteError::parquet(file.path()))?;
            }
            self.block_bytes += bytes;
        }
        self.take(columns, &rows, start..rows.time_ns.len())
    }

    /// Writes what is left and closes the row group.
    pub(super) fn finish(
        mut self,
        columns: &Columns,
        file: &mut DataFile,
    ) -> Result<DoneEpisode, WriteError> {
        self.flush(columns, file)?;
        file.end_row_group().map_err(WriteError::parquet(file.path()))?;
        let info = self.info;
        let stats = episode_stats(columns, &self.totals, &self.cameras);
        let record = EpisodeRecord {
            id: info.id,
            task: info.task,
            length: self.n_written,
            file: 0,
            from_index: self.first_index,
            success: info.success,
            operator: info.operator,
            robot: info.robot,
            session: info.session,
            is_training: false,
            recording: 0,
            source_file: info.source_file,
            source_hash: ContentHash([0; 32]),
            start_ns: info.start_ns,
            end_ns: info.end_ns,
            content_hash: ContentHash(*self.hasher.finalize().as_bytes()),
            tags: info.tags,
            stats,
        };
        Ok(DoneEpisode { record, split: info.split, totals: self.totals, cameras: self.cameras })
    }

    /// Moves rows into the block.
    fn take(&mut self, columns: &Columns, rows: &Rows, range: Range<usize>) -> Result<(), WriteError> {
        self.block
            .push(columns, rows, range)
            .map_err(|source| WriteError::Encode { id: self.info.id.clone(), source })
    }

    /// Writes, counts and hashes the rows of the block.
    fn flush(&mut self, columns: &Columns, file: &mut DataFile) -> Result<(), WriteError> {
        if self.block.len() == 0 {
            return Ok(());
        }
        let position = BlockPosition {
            episode: self.number as i64,
            task: self.task as i64,
            first_frame: self.n_written as i64,
            first_index: (self.first_index + self.n_written) as i64,
        };
        file.write(columns, &self.block, position, self.block_bytes)
            .map_err(WriteError::parquet(file.path()))?;
        self.totals.update(columns, &self.block);
        crate::camera::count_frames(columns, &self.block, self.n_written, &mut self.cameras);
        self.hash_block(columns);
        self.n_written += self.block.len() as u64;
        self.block.clear();
        self.block_bytes = 0;
        Ok(())
    }

    /// Hashes row by row, so that the hash does not depend on where blocks end.
    fn hash_block(&mut self, columns: &Columns) {
        let mut bytes = Vec::with_capacity(2 * HASHED_BYTES);
        for row in 0..self.block.len() {
            bytes.extend(self.block.time_ns[row].to_le_bytes());
            for (plan, values) in columns.vectors.iter().zip(&self.block.vectors) {
                values.row_bytes(row, plan.width(), &mut bytes);
            }
            bytes.extend(self.block.valid.iter().map(|valid| u8::from(valid[row])));
            for frames in &self.block.images {
                bytes.extend((frames[row].len() as u64).to_le_bytes());
            }
            if !self.block.images.is_empty() || bytes.len() >= HASHED_BYTES {
                self.hasher.update(&bytes);
                bytes.clear();
            }
            for frames in &self.block.images {
                self.hasher.update(&frames[row]);
            }
        }
        self.hasher.update(&bytes);
    }

    fn check_continuity(&mut self, columns: &Columns, rows: &Rows) -> Result<(), WriteError> {
        let frame = self.length();
        if let (Some(previous_ns), Some(&time_ns)) = (self.last_time_ns, rows.time_ns.first())
            && time_ns <= previous_ns
        {
            return Err(WriteError::Time { id: self.info.id.clone(), frame, previous_ns, time_ns });
        }
        let error = |feature: &str, frame: u64| WriteError::HeldActionInside {
            id: self.info.id.clone(),
            feature: feature.to_owned(),
            frame,
        };
        if let Some(feature) = &self.held_action {
            return Err(error(feature, frame - 1));
        }
        let last = rows.time_ns.len() - 1;
        let mut held_action = None;
        for (plan, column) in columns.vectors.iter().zip(&rows.vectors) {
            if plan.role != Role::Action {
                continue;
            }
            let is_held = |row: usize| !column.valid[row] && !column.values[row * plan.width()].is_nan();
            if let Some(row) = (0..last).find(|&row| is_held(row)) {
                return Err(error(&plan.name, frame + row as u64));
            }
            if is_held(last) {
                held_action = Some(plan.name.clone());
            }
        }
        self.held_action = held_action;
        self.last_time_ns = rows.time_ns.last().copied();
        Ok(())
    }
}

/// A trajectory carries no schema; its shape must at least be that of the dataset's.
fn check_shape(columns: &Columns, rows: &Rows) -> Result<(), WriteError> {
    let n_rows = rows.time_ns.len();
    let vectors = rows.vectors.len() == columns.vectors.len()
        && columns.vectors.iter().zip(&rows.vectors).all(|(plan, v)| v.values.len() == n_rows * plan.width());
    let images = rows.images.len() == columns.images.len();
    let ages = rows.ages.age_ms.len() == n_rows * columns.n_streams;
    if vectors && images && ages {
        return Ok(());
    }
    let reason = format!(
        "expected {} vector columns, {} cameras and {} streams of the dataset's widths",
        columns.vectors.len(),
        columns.images.len(),
        columns.n_streams
    );
    Err(WriteError::OtherSchema { reason })
}

fn numeric_row_bytes(columns: &Columns) -> u64 {
    let vectors: usize = columns.vectors.iter().map(|v| v.width() * 8).sum();
    let encoded: usize = columns.encoded.iter().map(|e| e.encoder.width() * 4).sum();
    (vectors + encoded + columns.valid_names.len() + columns.n_streams * 8 + 44) as u64
}

/// Returns LeRobot's statistics of an episode for the features that policies see.
fn episode_stats(
    columns: &Columns,
    totals: &Totals,
    cameras: &BTreeMap<String, CameraStats>,
) -> BTreeMap<String, FeatureStats> {
    let mut stats = BTreeMap::new();
    for (plan, dims) in columns.vectors.iter().zip(&totals.dims) {
        if is_policy_input(&plan.name) {
            let summaries: Vec<DimSummary> = dims.iter().map(DimStats::summary).collect();
            stats.insert(plan.name.clone(), FeatureStats::of(&summaries));
        }
    }
    for image in &columns.images {
        if is_policy_input(&image.name)
            && let Some(camera) = cameras.get(&image.name)
        {
            stats.insert(image.name.clone(), camera.feature_stats(crate::camera::pixel_unit(&image.spec)));
        }
    }
    stats
}
