//! Camera frames, in the data files and in videos beside them: one pass over all of them, or single ones by position.

use std::sync::Mutex;

use arrow::{
    array::{Array, ArrayRef, AsArray},
    datatypes::DataType,
};
use bytes::Bytes;
use gawm_image::{ImageError, Limits, Thumbnail, decode_thumbnail};
use gawm_video::{RgbFrame, VideoError, VideoLanes};
use parquet::{
    arrow::{
        ProjectionMask,
        arrow_reader::{
            ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder, RowSelection,
            RowSelector,
        },
    },
    file::metadata::PageIndexPolicy,
};
use rayon::prelude::*;

use super::{DType, Dataset, Defect, DefectKind, Run, declared, files, scan::Unit};

/// Frames per record batch: images are large.
const BATCH_FRAMES: usize = 32;

/// One frame as it lies in the file, or as it comes out of a video.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum FrameBytes {
    /// JPEG, PNG or TIFF bytes.
    Encoded(Bytes),
    /// A frame of a video: rows of 8-bit RGB.
    Video(RgbFrame),
    /// A frame of a video that cannot be decoded, and why.
    Undecodable(String),
    /// Null, a struct without bytes, or no frame of a video at the row's time.
    Absent,
    /// More bytes than are permitted.
    TooLarge(usize),
}

/// Why there is no picture of a frame.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum NoPicture {
    /// There is no frame.
    Absent,
    /// Depth in floats.
    Depth,
    /// More bytes than are permitted.
    TooLarge(usize),
    /// It cannot be decoded.
    Damaged(String),
}

impl FrameBytes {
    /// Returns height, width and channels of the frame, and a small picture of it whose sides have at least `min_side`
    /// pixels if its own have.
    pub(crate) fn thumbnail(
        &self,
        min_side: usize,
        limits: &Limits,
    ) -> Result<([u32; 3], Thumbnail), NoPicture> {
        match self {
            FrameBytes::Encoded(bytes) => match decode_thumbnail(bytes, min_side, limits) {
                Ok((header, picture)) => {
                    Ok(([header.height, header.width, u32::from(header.channels)], picture))
                }
                Err(ImageError::Unsuitable { .. }) => Err(NoPicture::Depth),
                Err(error) => Err(NoPicture::Damaged(error.to_string())),
            },
            FrameBytes::Video(frame) => {
                let (width, height) = (frame.width as usize, frame.height as usize);
                let whole = Thumbnail { width, height, rgb: frame.data.to_vec() };
                let is_enough = |parts: &usize| width.min(height) / parts >= min_side;
                let picture = match [8, 4, 2].into_iter().find(is_enough) {
                    Some(parts) => whole.shrunk(width / parts, height / parts),
                    None => whole,
                };
                Ok(([frame.height, frame.width, 3], picture))
            }
            FrameBytes::Undecodable(reason) => Err(NoPicture::Damaged(reason.clone())),
            FrameBytes::Absent => Err(NoPicture::Absent),
            FrameBytes::TooLarge(bytes) => Err(NoPicture::TooLarge(*bytes)),
        }
    }

    /// Returns the bytes that tell frames apart.
    pub(crate) fn bytes(&self) -> Option<&[u8]> {
        match self {
            FrameBytes::Encoded(bytes) | FrameBytes::Video(RgbFrame { data: bytes, .. }) => Some(bytes),
            _ => None,
        }
    }

    fn of_video(frame: Result<RgbFrame, VideoError>) -> FrameBytes {
        match frame {
            Ok(frame) => FrameBytes::Video(frame),
            Err(error) if error.is_no_frame() => FrameBytes::Absent,
            Err(error) => FrameBytes::Undecodable(error.to_string()),
        }
    }
}

/// What is called with the frames of one run.
pub trait FrameReader: Send {
    /// What is kept of a run.
    type Output: Send;
    /// Takes the frame of `row` (within the run) of camera `camera` (position in the list of cameras).
    fn frame(&mut self, camera: usize, row: usize, frame: FrameBytes);
    /// Ends the run.
    fn finish(self) -> Self::Output;
}

impl Dataset {
    /// Returns the cameras whose frames lie in the data files.
    pub fn image_columns(&self) -> Vec<String> {
        let has = |name: &str| self.files.iter().any(|f| f.schema.field_with_name(name).is_ok());
        let images = self.info.features.iter().filter(|f| f.dtype == DType::Image && has(&f.name));
        images.map(|f| f.name.clone()).collect()
    }

    /// Returns the cameras whose frames can be had: those in the data files, and those in videos where this build decodes
    /// video.
    pub fn frame_columns(&self) -> Vec<String> {
        let mut columns = self.image_columns();
        if gawm_video::IS_BUILT {
            let is_there = |name: &str| {
                let mut paths = self.episodes.iter().filter_map(|entry| self.video_path(entry, name)?.ok());
                paths.any(|path| self.root.join(path).is_file())
            };
            let videos = self.info.features.iter().filter(|f| f.dtype == DType::Video && is_there(&f.name));
            columns.extend(videos.map(|f| f.name.clone()));
        }
        columns
    }

    /// Passes over all frames of the given cameras; results are in the order of [`Dataset::runs`].
    pub fn scan_frames<F: FrameReader>(
        &self,
        cameras: &[String],
        begin: impl Fn(usize, &Run) -> F + Sync,
        progress: impl Fn(usize) + Sync,
    ) -> (Vec<(usize, F::Output)>, Vec<Defect>) {
        let defects = Mutex::new(Vec::new());
        let lanes = VideoLanes::default();
        let read = |unit: &Unit| {
            let mut results = Vec::new();
            let outcome = files::guarded(|| {
                self.read_frames_of_unit(unit, (cameras, &lanes), &begin, &progress, &mut results)
            });
            if let Err(got) = outcome {
                let place = &self.files[unit.file].relative;
                let defect = Defect::new(DefectKind::UnreadableFile, place, "readable frames", got);
                defects
                    .lock()
                    .unwrap_or_else(std::sync::PoisonError::into_inner)
                    .push((unit.runs.start, defect));
            }
            results
        };
        let results: Vec<Vec<(usize, F::Output)>> = self.units(1).par_iter().map(read).collect();
        let mut defects = defects.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        defects.sort_by_key(|(run, _)| *run);
        (results.into_iter().flatten().collect(), defects.into_iter().map(|(_, d)| d).collect())
    }

    fn read_frames_of_unit<F: FrameReader>(
        &self,
        unit: &Unit,
        (cameras, lanes): (&[String], &VideoLanes),
        begin: &(impl Fn(usize, &Run) -> F + Sync),
        progress: &(impl Fn(usize) + Sync),
        results: &mut Vec<(usize, F::Output)>,
    ) -> Result<(), String> {
        let names: Vec<&str> = cameras.iter().map(String::as_str).collect();
        let mut runs = unit.runs.clone();
        let mut row = 0;
        let mut state: Option<F> = None;
        let schema = &self.files[unit.file].schema;
        let mut read = names.clone();
        if !names.iter().any(|name| schema.field_with_name(name).is_ok()) {
            // Something has to say how many rows there are.
            read.extend(schema.fields().first().map(|field| field.name().as_str()));
        }
        for batch in self.open_unit(unit, &read, BATCH_FRAMES)? {
            let batch = batch.map_err(|e| e.to_string())?;
            let arrays: Vec<Option<&ArrayRef>> =
                names.iter().map(|name| batch.column_by_name(name)).collect();
            for i in 0..batch.num_rows() {
                if runs.is_empty() {
                    break;
                }
                let run = &self.runs[runs.start];
                let reader = state.get_or_insert_with(|| begin(runs.start, run));
                for (camera, array) in arrays.iter().enumerate() {
                    if let Some(array) = array {
                        reader.frame(camera, row, self.frame_of(array, i));
                    }
                }
                row += 1;
                if row as u64 == run.n_rows {
                    if let Some(mut reader) = state.take() {
                        for (camera, name) in cameras.iter().enumerate().filter(|(c, _)| arrays[*c].is_none())
                        {
                            let rows: Vec<usize> = (0..row).collect();
                            self.video_frames(lanes, runs.start, name, &rows, |row, frame| {
                                reader.frame(camera, row, frame);
                            });
                        }
                        results.push((runs.start, reader.finish()));
                    }
                    runs.start += 1;
                    row = 0;
                }
            }
            progress(batch.num_rows());
        }
        Ok(())
    }

    /// Calls `take` with the frames of a camera whose frames lie in a video, at the times of rows of a run.
    ///
    /// Rows are `1 / fps` apart, whatever `timestamp` says: what it says is judged elsewhere.
    fn video_frames(
        &self,
        lanes: &VideoLanes,
        run_index: usize,
        camera: &str,
        rows: &[usize],
        mut take: impl FnMut(usize, FrameBytes),
    ) {
        let entry = self.entry(self.runs[run_index].episode_index);
        let span = entry.and_then(|entry| Some((entry, entry.videos.get(camera)?)));
        let Some((path, span)) =
            span.and_then(|(entry, span)| Some((self.video_path(entry, camera)?.ok()?, span)))
        else {
            return rows.iter().for_each(|row| take(*row, FrameBytes::Absent));
        };
        let secs = |row: &usize| span.from_timestamp_secs + *row as f64 / self.info.fps;
        let wanted: Vec<f64> = rows.iter().map(secs).collect();
        lanes.read(&self.root.join(path), &wanted, |at, frame| take(rows[at], FrameBytes::of_video(frame)));
    }

    fn frame_of(&self, array: &ArrayRef, i: usize) -> FrameBytes {
        if array.is_null(i) {
            return FrameBytes::Absent;
        }
        let array: &dyn Array = match array.data_type() {
            DataType::Struct(_) => match array.as_struct().column_by_name("bytes") {
                Some(bytes) if bytes.is_valid(i) => bytes.as_ref(),
                _ => return FrameBytes::Absent,
            },
            _ => array.as_ref(),
        };
        let bytes = match array.data_type() {
            DataType::Binary => array.as_binary::<i32>().value(i),
            DataType::LargeBinary => array.as_binary::<i64>().value(i),
            _ => return FrameBytes::Absent,
        };
        if bytes.is_empty() {
            FrameBytes::Absent
        } else if bytes.len() > self.limits.max_frame_bytes {
            FrameBytes::TooLarge(bytes.len())
        } else {
            FrameBytes::Encoded(Bytes::copy_from_slice(bytes))
        }
    }

    /// Reads single frames of one camera of run `run_index` by position; `rows` must be sorted.
    ///
    /// With a page index only the pages that hold them are read.
    ///
    /// # Errors
    /// The file cannot be read, or has no such column; the text says which.
    pub fn read_frames(
        &self,
        run_index: usize,
        camera: &str,
        rows: &[usize],
    ) -> Result<Vec<FrameBytes>, String> {
        let run = &self.runs[run_index];
        let file = &self.files[run.file];
        if gawm_video::IS_BUILT && file.schema.field_with_name(camera).is_err() {
            let mut frames = Vec::with_capacity(rows.len());
            let rows: Vec<usize> = rows.iter().copied().filter(|row| (*row as u64) < run.n_rows).collect();
            let lanes = VideoLanes::default();
            self.video_frames(&lanes, run_index, camera, &rows, |_, frame| frames.push(frame));
            return Ok(frames);
        }
        let (handle, _) = files::open_parquet(&file.path)?;
        files::guarded(|| {
            let options = ArrowReaderOptions::new().with_page_index_policy(PageIndexPolicy::Optional);
            let metadata = ArrowReaderMetadata::load(&handle, options).map_err(|e| e.to_string())?;
            let root = metadata.schema().index_of(camera).map_err(|e| e.to_string())?;
            let mask = ProjectionMask::roots(metadata.parquet_schema(), [root]);
            let (groups, skipped) = groups_of(&file.row_groups, run.start, run.start + run.n_rows);
            declared::check_pages(&handle, metadata.metadata(), groups.iter().copied(), &mask)?;
            let builder = ParquetRecordBatchReaderBuilder::new_with_metadata(handle, metadata);
            let mut selectors = Vec::new();
            let mut at = 0;
            for row in rows.iter().filter(|row| (**row as u64) < run.n_rows) {
                let position = (run.start - skipped) as usize + row;
                selectors.push(RowSelector::skip(position.saturating_sub(at)));
                selectors.push(RowSelector::select(1));
                at = position + 1;
            }
            let reader = builder
                .with_projection(mask)
                .with_row_groups(groups)
                .with_row_selection(RowSelection::from(selectors))
                .with_batch_size(BATCH_FRAMES)
                .build()
                .map_err(|e| e.to_string())?;
            let mut frames = Vec::with_capacity(rows.len());
            for batch in reader {
                let batch = batch.map_err(|e| e.to_string())?;
                frames.extend((0..batch.num_rows()).map(|i| self.frame_of(batch.column(0), i)));
            }
            Ok(frames)
        })
    }
}

/// Returns the row groups that hold rows `from..to`, and the number of rows before the first of them.
fn groups_of(row_groups: &[u64], from: u64, to: u64) -> (Vec<usize>, u64) {
    let (mut groups, mut skipped, mut start) = (Vec::new(), 0, 0);
    for (group, n_rows) in row_groups.iter().enumerate() {
        let end = start + n_rows;
        if end <= from {
            skipped = end;
        } else if start < to {
            groups.push(group);
        }
        start = end;
    }
    (groups, skipped)
}
