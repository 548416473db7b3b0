//! A run of rows as it will be stored: the unit that is encoded, counted and hashed.

use std::sync::Arc;

use arrow::array::{
    Array, ArrayRef, BinaryArray, BinaryBuilder, BooleanArray, Float32Array, Float64Array, Int64Array,
    ListArray, RecordBatch, StringArray, StructArray,
};
use arrow::buffer::{OffsetBuffer, ScalarBuffer};
use arrow::datatypes::DataType;
use arrow::error::ArrowError;
use bytes::Bytes;
use gawm_schema::{EncodeError, FloatType};

use crate::columns::{Columns, image_fields, item_field};
use crate::rows::Rows;

/// Numbers of a vector column as they are stored, row-major.
#[derive(Debug, Clone, PartialEq)]
pub(crate) enum StoredValues {
    F32(Vec<f32>),
    F64(Vec<f64>),
}

impl StoredValues {
    fn new(dtype: FloatType) -> StoredValues {
        match dtype {
            FloatType::Float32 => StoredValues::F32(Vec::new()),
            FloatType::Float64 => StoredValues::F64(Vec::new()),
        }
    }

    fn extend(&mut self, values: &[f64]) {
        match self {
            StoredValues::F32(stored) => stored.extend(values.iter().map(|&v| v as f32)),
            StoredValues::F64(stored) => stored.extend_from_slice(values),
        }
    }

    fn clear(&mut self) {
        match self {
            StoredValues::F32(stored) => stored.clear(),
            StoredValues::F64(stored) => stored.clear(),
        }
    }

    /// Appends one dim of all rows to `out`.
    pub(crate) fn copy_dim(&self, dim: usize, width: usize, out: &mut Vec<f64>) {
        match self {
            StoredValues::F32(v) => out.extend(v.iter().skip(dim).step_by(width).map(|&x| f64::from(x))),
            StoredValues::F64(v) => out.extend(v.iter().skip(dim).step_by(width)),
        }
    }

    /// Appends the bytes of one row, little-endian.
    pub(crate) fn row_bytes(&self, row: usize, width: usize, out: &mut Vec<u8>) {
        let range = row * width..(row + 1) * width;
        match self {
            StoredValues::F32(v) => v[range].iter().for_each(|x| out.extend(x.to_le_bytes())),
            StoredValues::F64(v) => v[range].iter().for_each(|x| out.extend(x.to_le_bytes())),
        }
    }
}

/// Rows of one episode as they are stored.
#[derive(Debug)]
pub(crate) struct RowBlock {
    pub(crate) time_ns: Vec<i64>,
    /// Per vector feature.
    pub(crate) vectors: Vec<StoredValues>,
    /// `gawm.state`, `gawm.action`.
    pub(crate) encoded: Vec<StoredValues>,
    /// Per validity column.
    pub(crate) valid: Vec<Vec<bool>>,
    pub(crate) age_ms: Vec<f32>,
    pub(crate) arrival_age_ms: Vec<f32>,
    /// Per image feature.
    pub(crate) images: Vec<Vec<Bytes>>,
    /// Bytes of all frames.
    pub(crate) image_bytes: u64,
}

/// Where a block lies in the dataset.
#[derive(Debug, Clone, Copy)]
pub(crate) struct BlockPosition {
    pub(crate) episode: i64,
    pub(crate) task: i64,
    /// Row within the episode of the block's first row.
    pub(crate) first_frame: i64,
    /// Row within the dataset of the block's first row.
    pub(crate) first_index: i64,
}

impl RowBlock {
    pub(crate) fn new(columns: &Columns) -> RowBlock {
        RowBlock {
            time_ns: Vec::new(),
            vectors: columns.vectors.iter().map(|v| StoredValues::new(v.dtype)).collect(),
            encoded: columns.encoded.iter().map(|_| StoredValues::F32(Vec::new())).collect(),
            valid: vec![Vec::new(); columns.valid_names.len()],
            age_ms: Vec::new(),
            arrival_age_ms: Vec::new(),
            images: vec![Vec::new(); columns.images.len()],
            image_bytes: 0,
        }
    }

    pub(crate) fn len(&self) -> usize {
        self.time_ns.len()
    }

    /// Appends the rows `range` of checked rows.
    pub(crate) fn push(
        &mut self,
        columns: &Columns,
        rows: &Rows,
        range: std::ops::Range<usize>,
    ) -> Result<(), EncodeError> {
        let (mut raw, mut row_out, mut encoded) = (Vec::new(), Vec::new(), Vec::new());
        for (plan, stored) in columns.encoded.iter().zip(&mut self.encoded) {
            encoded.clear();
            for row in range.clone() {
                raw.clear();
                row_out.clear();
                for &(vector, width) in &plan.inputs {
                    let values = &rows.vectors[vector].values[row * width..(row + 1) * width];
                    match columns.vectors[vector].dtype {
                        // From what is stored, so that anyone who reads it gets the same bits.
                        FloatType::Float32 => raw.extend(values.iter().map(|&v| f64::from(v as f32))),
                        FloatType::Float64 => raw.extend_from_slice(values),
                    }
                }
                plan.encoder.encode(&raw, &mut row_out)?;
                encoded.extend_from_slice(&row_out);
            }
            stored.extend(&encoded);
        }
        self.time_ns.extend_from_slice(&rows.time_ns[range.clone()]);
        for ((plan, stored), column) in columns.vectors.iter().zip(&mut self.vectors).zip(&rows.vectors) {
            let width = plan.width();
            stored.extend(&column.values[range.start * width..range.end * width]);
        }
        let valid = rows.vectors.iter().map(|v| &v.valid).chain(rows.images.iter().map(|i| &i.valid));
        for (stored, column) in self.valid.iter_mut().zip(valid) {
            stored.extend_from_slice(&column[range.clone()]);
        }
        let ages = range.start * columns.n_streams..range.end * columns.n_streams;
        self.age_ms.extend_from_slice(&rows.ages.age_ms[ages.clone()]);
        self.arrival_age_ms.extend_from_slice(&rows.ages.arrival_age_ms[ages]);
        for (stored, column) in self.images.iter_mut().zip(&rows.images) {
            let frames = &column.frames[range.clone()];
            self.image_bytes += frames.iter().map(|frame| frame.len() as u64).sum::<u64>();
            stored.extend_from_slice(frames);
        }
        Ok(())
    }

    pub(crate) fn clear(&mut self) {
        self.time_ns.clear();
        self.vectors.iter_mut().chain(&mut self.encoded).for_each(StoredValues::clear);
        self.valid.iter_mut().for_each(Vec::clear);
        self.age_ms.clear();
        self.arrival_age_ms.clear();
        self.images.iter_mut().for_each(Vec::clear);
        self.image_bytes = 0;
    }

    /// Returns the rows as Arrow columns.
    pub(crate) fn to_arrow(
        &self,
        columns: &Columns,
        position: BlockPosition,
    ) -> Result<RecordBatch, ArrowError> {
        let n_rows = self.len() as i64;
        let frames = position.first_frame..position.first_frame + n_rows;
        let fps = f64::from(columns.fps);
        let timestamps: Vec<f32> = frames.clone().map(|frame| (frame as f64 / fps) as f32).collect();
        let constant = |value: i64| Arc::new(Int64Array::from(vec![value; self.len()])) as ArrayRef;
        let mut arrays: Vec<ArrayRef> = vec![
            Arc::new(Float32Array::from(timestamps)),
            Arc::new(Int64Array::from_iter_values(frames)),
            constant(position.episode),
            Arc::new(Int64Array::from_iter_values(position.first_index..position.first_index + n_rows)),
            constant(position.task),
        ];
        for (plan, stored) in columns.vectors.iter().zip(&self.vectors) {
            arrays.push(vector_array(stored, plan.width())?);
        }
        for (plan, stored) in columns.encoded.iter().zip(&self.encoded) {
            arrays.push(vector_array(stored, plan.encoder.width())?);
        }
        arrays.push(Arc::new(Int64Array::from(self.time_ns.clone())));
        arrays.extend(self.valid.iter().map(|valid| Arc::new(BooleanArray::from(valid.clone())) as ArrayRef));
        if columns.n_streams > 0 {
            for ages in [&self.age_ms, &self.arrival_age_ms] {
                arrays.push(vector_array(&StoredValues::F32(ages.clone()), columns.n_streams)?);
            }
        }
        for frames in &self.images {
            arrays.push(image_array(frames)?);
        }
        RecordBatch::try_new(columns.arrow.clone(), arrays)
    }
}

/// Returns a list column of constant width, or the bare values when the width is 1.
pub(crate) fn vector_array(values: &StoredValues, width: usize) -> Result<ArrayRef, ArrowError> {
    let (items, item_type): (ArrayRef, DataType) = match values {
        StoredValues::F32(v) => (Arc::new(Float32Array::from(v.clone())), DataType::Float32),
        StoredValues::F64(v) => (Arc::new(Float64Array::from(v.clone())), DataType::Float64),
    };
    if width == 1 {
        return Ok(items);
    }
    let n_rows = items.len() / width;
    let offsets = OffsetBuffer::from_repeated_length(width, n_rows);
    Ok(Arc::new(ListArray::try_new(item_field(item_type), offsets, items, None)?))
}

fn image_array(frames: &[Bytes]) -> Result<ArrayRef, ArrowError> {
    let total: usize = frames.iter().map(Bytes::len).sum();
    let bytes: BinaryArray = if i32::try_from(total).is_ok() {
        let mut builder = BinaryBuilder::with_capacity(frames.len(), total);
        frames.iter().for_each(|frame| builder.append_value(frame));
        builder.finish()
    } else {
        return Err(ArrowError::OffsetOverflowError(total));
    };
    let path = StringArray::new_null(frames.len());
    Ok(Arc::new(StructArray::try_new(image_fields(), vec![Arc::new(bytes), Arc::new(path)], None)?))
}

/// Returns an i64 column.
pub(crate) fn int_array(values: impl IntoIterator<Item = i64>) -> ArrayRef {
    Arc::new(Int64Array::new(ScalarBuffer::from_iter(values), None))
}
