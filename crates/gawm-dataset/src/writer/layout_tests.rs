//! What other readers find in the files.

use arrow::array::{Array, BinaryArray, ListArray, StructArray};
use parquet::arrow::arrow_reader::{
    ArrowReaderMetadata, ArrowReaderOptions, ParquetRecordBatchReaderBuilder,
};
use parquet::basic::Compression;
use parquet::file::metadata::PageIndexPolicy;
use serde_json::Value;

use super::tests::{recording, rows, schema, spec, tree, write_all};
use super::*;

fn one_dataset() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    write_all(dir.path(), WriteMode::New, &[0], 300);
    dir
}

#[test]
fn each_frame_is_a_page_of_plain_bytes() {
    let dir = one_dataset();
    let path = dir.path().join(data_path(0));
    let bytes = fs::read(&path).unwrap();
    let options = ArrowReaderOptions::new().with_page_index_policy(PageIndexPolicy::Required);
    let metadata = ArrowReaderMetadata::load(&fs::File::open(&path).unwrap(), options).unwrap();
    let metadata = metadata.metadata();
    let row_groups: Vec<i64> = metadata.row_groups().iter().map(|group| group.num_rows()).collect();
    assert_eq!(row_groups, [30, 1100, 20], "a row group per episode");
    let column = metadata
        .row_group(0)
        .columns()
        .iter()
        .position(|c| c.column_path().string() == "observation.images.front.bytes")
        .unwrap();
    let offsets = metadata.offset_index().unwrap();
    for (group, n_rows) in row_groups.iter().enumerate() {
        let chunk = metadata.row_group(group).column(column);
        assert_eq!(chunk.compression(), Compression::UNCOMPRESSED);
        assert!(chunk.dictionary_page_offset().is_none());
        let pages = offsets[group][column].page_locations();
        assert_eq!(pages.len() as i64, *n_rows, "a page per frame");
        let first_frame = super::tests::png(group as u8);
        let page = &bytes[pages[0].offset as usize..][..pages[0].compressed_page_size as usize];
        assert!(page.ends_with(&first_frame), "the page of a frame ends with its bytes");
    }
}

#[test]
fn columns_hold_what_was_written() {
    let dir = one_dataset();
    let file = fs::File::open(dir.path().join(data_path(0))).unwrap();
    let builder = ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    assert!(builder.schema().metadata()["huggingface"].contains("observation.images.front"));
    let batch =
        builder.with_batch_size(4096).with_row_groups(vec![0]).build().unwrap().next().unwrap().unwrap();
    let written = rows(0, 0..30, 30);
    let list = |name: &str| {
        let column = batch.column_by_name(name).unwrap();
        let list = column.as_any().downcast_ref::<ListArray>().unwrap().clone();
        list.values().clone()
    };
    let state = list("observation.state");
    let state = state.as_any().downcast_ref::<arrow::array::Float32Array>().unwrap();
    let expected: Vec<f32> = written.vectors[0].values.iter().map(|&v| v as f32).collect();
    assert_eq!(state.values(), &expected[..]);
    let action = list("action");
    let action = action.as_any().downcast_ref::<arrow::array::Float64Array>().unwrap();
    assert_eq!(action.values(), &written.vectors[1].values[..]);
    let encoded = list("gawm.state");
    let encoded = encoded.as_any().downcast_ref::<arrow::array::Float32Array>().unwrap();
    let (j1, j2) = (written.vectors[0].values[0], written.vectors[0].values[1]);
    let expected = [j1.sin(), j1.cos(), j2.sin(), j2.cos(), 0.04].map(|v| v as f32);
    assert_eq!(&encoded.values()[..5], &expected);
    let images = batch.column_by_name("observation.images.front").unwrap();
    let images = images.as_any().downcast_ref::<StructArray>().unwrap();
    let frames = images.column(0).as_any().downcast_ref::<BinaryArray>().unwrap();
    assert!((0..30).all(|row| frames.value(row) == &written.images[0].frames[row][..]));
    assert_eq!(images.column(1).null_count(), 30, "path is null");
    for (name, column) in batch.schema().fields().iter().zip(batch.columns()) {
        assert_eq!(column.null_count(), 0, "{name}");
    }
    let intervention = batch.column_by_name("intervention").unwrap();
    assert_eq!(*intervention.data_type(), arrow::datatypes::DataType::Float32, "a width of 1 is a scalar");
}

#[test]
fn info_declares_exactly_the_columns() {
    let dir = one_dataset();
    let files = tree(dir.path());
    let info: Value = serde_json::from_slice(&files["meta/info.json"]).unwrap();
    let file = fs::File::open(dir.path().join(data_path(0))).unwrap();
    let builder = ParquetRecordBatchReaderBuilder::try_new(file).unwrap();
    let columns: Vec<&String> = builder.schema().fields().iter().map(|field| field.name()).collect();
    let declared: Vec<&String> = info["features"].as_object().unwrap().keys().collect();
    assert_eq!(columns, declared);
    assert_eq!((&info["fps"], &info["total_frames"]), (&Value::from(10), &Value::from(1150)));
    let meta: GawmMeta = serde_json::from_slice(&files["meta/gawm.json"]).unwrap();
    assert_eq!((meta.rate_hz, meta.schema_hash), (9.99, schema().hash()));
    assert_eq!(meta.contracts[0].text, spec().contract);
    assert_eq!(meta.recordings[0].source, recording(0));
    let stats: Value = serde_json::from_slice(&files["meta/stats.json"]).unwrap();
    assert_eq!(stats["observation.images.front"]["mean"].as_array().unwrap().len(), 3);
    assert_eq!(stats["action"]["count"], serde_json::json!([1150]));
}

/// Two passes over what the files hold, as numpy would.
#[test]
fn standardised_columns_have_mean_0_and_std_1_on_training_data() {
    let dir = tempfile::tempdir().unwrap();
    write_all(dir.path(), WriteMode::New, &[0, 1, 2], 300);
    let meta: GawmMeta = serde_json::from_slice(&tree(dir.path())["meta/gawm.json"]).unwrap();
    let action = meta.standardisation.iter().find(|s| s.column == "gawm.action").unwrap();
    let episodes = crate::tables::read_episodes(&dir.path().join(crate::layout::EPISODES), 9).unwrap();
    let training: Vec<bool> = episodes.iter().map(|episode| episode.is_training).collect();
    assert_eq!(action.fitted_on.episodes_of, "train");
    let mut values: Vec<f64> = Vec::new();
    for number in 0..3 {
        let file = fs::File::open(dir.path().join(crate::layout::encoded_path(number))).unwrap();
        let reader = ParquetRecordBatchReaderBuilder::try_new(file).unwrap().with_batch_size(4096);
        for batch in reader.build().unwrap() {
            let batch = batch.unwrap();
            let episode: &arrow::array::Int64Array = crate::scan::column(&batch, "episode_index").unwrap();
            let mut column = Vec::new();
            crate::scan::vector_values(&batch, "gawm.action", 2).unwrap().copy_dim(0, 2, &mut column);
            for (row, value) in column.into_iter().enumerate() {
                let number = episode.value(row);
                let is_last = row + 1 == batch.num_rows() || episode.value(row + 1) != number;
                // The held action of the last row is not valid and not fitted.
                if training[number as usize] && !is_last {
                    values.push(value);
                }
            }
        }
    }
    assert_eq!(values.len() as u64, action.fitted_on.frames);
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let std = (values.iter().map(|v| (v - mean).powi(2)).sum::<f64>() / values.len() as f64).sqrt();
    assert!(mean.abs() < 1e-6 && (std - 1.0).abs() < 1e-6, "{mean} {std}");
    // The columns can be made again.
    let before = tree(dir.path());
    fs::remove_dir_all(dir.path().join(crate::layout::ENCODED)).unwrap();
    crate::standardize(dir.path()).unwrap();
    assert!(tree(dir.path()) == before);
}
