//! `gawm/encoded/`: standardised states and actions per row; can be made again at any time.

use std::fs::{self, File};
use std::path::Path;
use std::sync::Arc;

use arrow::array::{ArrayRef, Int64Array, RecordBatch};
use arrow::datatypes::{DataType, Field, Schema as ArrowSchema, SchemaRef};
use gawm_schema::Standardisation;
use parquet::arrow::ArrowWriter;

use crate::block::{StoredValues, vector_array};
use crate::columns::{item_field, numeric_properties};
use crate::durable::{Disk, remove_folder, temporary};
use crate::error::WriteError;
use crate::journal::load;
use crate::layout::{ENCODED, GAWM, data_path, encoded_path};
use crate::provenance::GawmMeta;
use crate::read::checked_builder;
use crate::scan::{column, vector_values};

/// Columns that say which row it is.
const KEYS: [&str; 3] = ["index", "episode_index", "frame_index"];

/// Rows that are standardised at once, and rows of a row group.
const BATCH_ROWS: usize = 1 << 16;

/// Writes `gawm/encoded/` of a finished dataset again, with the standardisation of its `meta/gawm.json`.
///
/// # Errors
/// - `meta/gawm.json` or a data file is missing or damaged;
/// - files cannot be written.
pub fn standardize(dir: &Path) -> Result<(), WriteError> {
    let meta: GawmMeta = load(&dir.join(GAWM))?;
    write_encoded(dir, &Disk::default(), &meta)
}

/// Writes one file per data file and removes all others.
pub(crate) fn write_encoded(dir: &Path, disk: &Disk, meta: &GawmMeta) -> Result<(), WriteError> {
    let root = dir.join(ENCODED);
    remove_folder(&root).map_err(WriteError::io("remove", &root))?;
    if meta.standardisation.is_empty() {
        return Ok(());
    }
    for file in meta.recordings.iter().flat_map(|recording| &recording.files) {
        let target = dir.join(encoded_path(file.number));
        if let Some(folder) = target.parent() {
            fs::create_dir_all(folder).map_err(WriteError::io("create", folder))?;
        }
        let unfinished = temporary(&target);
        encode_file(&dir.join(data_path(file.number)), &unfinished, disk, &meta.standardisation)?;
        fs::rename(&unfinished, &target).map_err(WriteError::io("rename", &target))?;
    }
    Ok(())
}

fn encode_file(
    source: &Path,
    target: &Path,
    disk: &Disk,
    standardisation: &[Standardisation],
) -> Result<(), WriteError> {
    File::open(source).map_err(WriteError::io("open", source))?;
    let is_wanted = |name: &str| KEYS.contains(&name) || standardisation.iter().any(|s| s.column == name);
    let reader = checked_builder(source, is_wanted)
        .and_then(|builder| builder.with_batch_size(BATCH_ROWS).build())
        .map_err(WriteError::parquet(source))?;
    let schema = encoded_schema(standardisation);
    let new = disk.create(target).map_err(WriteError::io("create", target))?;
    let mut writer = ArrowWriter::try_new(new, schema.clone(), Some(numeric_properties().build()))
        .map_err(WriteError::parquet(target))?;
    for batch in reader {
        let batch = batch.map_err(|error| WriteError::parquet(source)(error.into()))?;
        let rows = standardised(&batch, &schema, standardisation)
            .map_err(|reason| WriteError::Damaged { path: source.to_owned(), reason })?;
        writer.write(&rows).and_then(|()| writer.flush()).map_err(WriteError::parquet(target))?;
    }
    writer.finish().map_err(WriteError::parquet(target))?;
    let sync = writer.sync().and_then(|()| writer.inner_mut().sync());
    sync.map_err(WriteError::io("write", target))
}

fn encoded_schema(standardisation: &[Standardisation]) -> SchemaRef {
    let mut fields: Vec<Field> = KEYS.iter().map(|name| Field::new(*name, DataType::Int64, false)).collect();
    for column in standardisation {
        let item = DataType::Float32;
        let data_type = if column.dims.len() == 1 { item } else { DataType::List(item_field(item)) };
        fields.push(Field::new(&column.column, data_type, false));
    }
    Arc::new(ArrowSchema::new(fields))
}

fn standardised(
    batch: &RecordBatch,
    schema: &SchemaRef,
    standardisation: &[Standardisation],
) -> Result<RecordBatch, String> {
    let mut arrays: Vec<ArrayRef> = Vec::new();
    for name in KEYS {
        arrays.push(Arc::new(column::<Int64Array>(batch, name)?.clone()));
    }
    for affine in standardisation {
        let width = affine.dims.len();
        let mut values: Vec<f64> = match vector_values(batch, &affine.column, width)? {
            StoredValues::F32(values) => values.iter().map(|&v| f64::from(v)).collect(),
            StoredValues::F64(values) => values,
        };
        values.chunks_exact_mut(width).for_each(|row| affine.apply(row));
        let stored = StoredValues::F32(values.iter().map(|&v| v as f32).collect());
        arrays.push(vector_array(&stored, width).map_err(|error| error.to_string())?);
    }
    RecordBatch::try_new(schema.clone(), arrays).map_err(|error| error.to_string())
}
