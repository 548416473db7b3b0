//! The columns of a data file: Arrow schema, LeRobot features, Parquet properties.

use std::collections::HashMap;
use std::sync::Arc;

use arrow::datatypes::{DataType, Field, Fields, Schema as ArrowSchema, SchemaRef};
use gawm_schema::{Encoder, FeatureData, FloatType, ImageSpec, Kind, Role, Schema};
use parquet::basic::{Compression, Encoding as ParquetEncoding, ZstdLevel};
use parquet::file::properties::{EnabledStatistics, WriterProperties};
use parquet::schema::types::ColumnPath;
use serde_json::{Value, json};

use crate::layout::{ACTION, AGE_MS, ARRIVAL_AGE_MS, STATE, TIME_NS, VALID};
use crate::trajectory::vector_positions;

/// Writer named in each Parquet file; fixed, so that bytes do not change with a release that changes nothing else.
pub(crate) const CREATED_BY: &str = "gawm-dataset version 1.0.0 (build 1)";

/// What the columns of a dataset are, derived once from its schema.
#[derive(Debug)]
pub(crate) struct Columns {
    pub(crate) vectors: Vec<VectorPlan>,
    pub(crate) images: Vec<ImagePlan>,
    /// `gawm.state` and `gawm.action`, as far as there are such features.
    pub(crate) encoded: Vec<EncodedPlan>,
    /// Names of features with a validity column: vectors, then images.
    pub(crate) valid_names: Vec<String>,
    pub(crate) n_streams: usize,
    pub(crate) fps: u32,
    pub(crate) arrow: SchemaRef,
}

#[derive(Debug)]
pub(crate) struct VectorPlan {
    pub(crate) name: String,
    pub(crate) role: Role,
    pub(crate) dtype: FloatType,
    pub(crate) dim_names: Vec<String>,
    pub(crate) is_angle: Vec<bool>,
}

#[derive(Debug)]
pub(crate) struct ImagePlan {
    pub(crate) name: String,
    pub(crate) spec: ImageSpec,
}

#[derive(Debug)]
pub(crate) struct EncodedPlan {
    pub(crate) name: &'static str,
    pub(crate) encoder: Encoder,
    /// Position among the vectors and width of each feature that is read.
    pub(crate) inputs: Vec<(usize, usize)>,
    /// Per dim the vector and dim that store the same bits: a float32 value that is encoded as it is.
    pub(crate) same_as: Vec<Option<(usize, usize)>>,
}

impl VectorPlan {
    pub(crate) fn width(&self) -> usize {
        self.dim_names.len()
    }
}

impl Columns {
    pub(crate) fn new(schema: &Schema) -> Columns {
        let vectors: Vec<VectorPlan> = schema.vectors().map(vector_plan).collect();
        let images: Vec<ImagePlan> = schema
            .images()
            .map(|(feature, spec)| ImagePlan { name: feature.name.clone(), spec: spec.clone() })
            .collect();
        let encoded: Vec<EncodedPlan> = [(STATE, Role::State), (ACTION, Role::Action)]
            .into_iter()
            .filter_map(|(name, role)| {
                let encoder = Encoder::new(schema, role)?;
                let inputs = vector_positions(schema, &encoder);
                let same_as = same_dims(&vectors, &encoder, &inputs);
                Some(EncodedPlan { name, encoder, inputs, same_as })
            })
            .collect();
        let valid_names =
            vectors.iter().map(|v| &v.name).chain(images.iter().map(|i| &i.name)).cloned().collect();
        let mut columns = Columns {
            vectors,
            images,
            encoded,
            valid_names,
            n_streams: schema.streams.len(),
            fps: fps(schema.rate_hz),
            arrow: Arc::new(ArrowSchema::empty()),
        };
        columns.arrow = Arc::new(columns.arrow_schema());
        columns
    }

    fn arrow_schema(&self) -> ArrowSchema {
        let mut fields = vec![
            Field::new("timestamp", DataType::Float32, false),
            Field::new("frame_index", DataType::Int64, false),
            Field::new("episode_index", DataType::Int64, false),
            Field::new("index", DataType::Int64, false),
            Field::new("task_index", DataType::Int64, false),
        ];
        fields.extend(self.vectors.iter().map(|v| vector_field(&v.name, float_type(v.dtype), v.width())));
        fields
            .extend(self.encoded.iter().map(|e| vector_field(e.name, DataType::Float32, e.encoder.width())));
        fields.push(Field::new(TIME_NS, DataType::Int64, false));
        fields.extend(
            self.valid_names.iter().map(|n| Field::new(format!("{VALID}{n}"), DataType::Boolean, false)),
        );
        if self.n_streams > 0 {
            fields.push(vector_field(AGE_MS, DataType::Float32, self.n_streams));
            fields.push(vector_field(ARRIVAL_AGE_MS, DataType::Float32, self.n_streams));
        }
        fields
            .extend(self.images.iter().map(|i| Field::new(&i.name, DataType::Struct(image_fields()), true)));
        ArrowSchema::new_with_metadata(fields, self.arrow_metadata())
    }

    /// The `datasets` package reads this to turn structs into images.
    fn arrow_metadata(&self) -> HashMap<String, String> {
        let images: serde_json::Map<String, Value> =
            self.images.iter().map(|image| (image.name.clone(), json!({"_type": "Image"}))).collect();
        if images.is_empty() {
            return HashMap::new();
        }
        let text = json!({"info": {"features": images}}).to_string();
        HashMap::from([("huggingface".to_owned(), text)])
    }

    /// Returns the `features` of info.json, in column order.
    pub(crate) fn lerobot_features(&self, schema: &Schema) -> Value {
        let mut features = serde_json::Map::new();
        let mut add = |name: &str, dtype: &str, shape: Value, names: Value| {
            features.insert(name.to_owned(), json!({"dtype": dtype, "shape": shape, "names": names}));
        };
        add("timestamp", "float32", json!([1]), Value::Null);
        for name in ["frame_index", "episode_index", "index", "task_index"] {
            add(name, "int64", json!([1]), Value::Null);
        }
        for vector in &self.vectors {
            let dtype = match vector.dtype {
                FloatType::Float32 => "float32",
                FloatType::Float64 => "float64",
            };
            add(&vector.name, dtype, json!([vector.width()]), json!(vector.dim_names));
        }
        for encoded in &self.encoded {
            let names: Vec<&str> = encoded.encoder.dims().iter().map(|dim| dim.name.as_str()).collect();
            add(encoded.name, "float32", json!([names.len()]), json!(names));
        }
        add(TIME_NS, "int64", json!([1]), Value::Null);
        for name in &self.valid_names {
            add(&format!("{VALID}{name}"), "bool", json!([1]), Value::Null);
        }
        if self.n_streams > 0 {
            let names: Vec<&str> = schema.streams.iter().map(|stream| stream.name.as_str()).collect();
            add(AGE_MS, "float32", json!([names.len()]), json!(names));
            add(ARRIVAL_AGE_MS, "float32", json!([names.len()]), json!(names));
        }
        for image in &self.images {
            let spec = &image.spec;
            let shape = json!([spec.height, spec.width, spec.channels]);
            add(&image.name, "image", shape, json!(["height", "width", "channels"]));
        }
        Value::Object(features)
    }

    /// Returns how data files are written.
    ///
    /// Image bytes are PLAIN and uncompressed with one page per frame, so that the offset index gives the position of
    /// each frame in the file.
    pub(crate) fn writer_properties(&self) -> WriterProperties {
        let mut builder = image_properties(self.images.iter().map(|image| image.name.as_str()));
        for name in ["index", "frame_index", TIME_NS] {
            let path = ColumnPath::new(vec![name.to_owned()]);
            builder = builder
                .set_column_dictionary_enabled(path.clone(), false)
                .set_column_encoding(path, ParquetEncoding::DELTA_BINARY_PACKED);
        }
        for name in ["episode_index", "task_index"] {
            builder = builder.set_column_dictionary_enabled(ColumnPath::new(vec![name.to_owned()]), true);
        }
        builder.build()
    }
}

/// Returns the properties that all our Parquet files share.
pub(crate) fn numeric_properties() -> parquet::file::properties::WriterPropertiesBuilder {
    WriterProperties::builder()
        .set_created_by(CREATED_BY.to_owned())
        .set_compression(Compression::ZSTD(ZstdLevel::default()))
        .set_dictionary_enabled(false)
        .set_max_row_group_row_count(None)
        .set_statistics_enabled(EnabledStatistics::Chunk)
}

/// Returns [`numeric_properties`] with columns of images: PLAIN and uncompressed with one page per frame.
pub(crate) fn image_properties<'a>(
    images: impl Iterator<Item = &'a str>,
) -> parquet::file::properties::WriterPropertiesBuilder {
    let mut builder = numeric_properties();
    for image in images {
        let path = ColumnPath::new(vec![image.to_owned(), "bytes".to_owned()]);
        builder = builder
            .set_column_encoding(path.clone(), ParquetEncoding::PLAIN)
            .set_column_compression(path.clone(), Compression::UNCOMPRESSED)
            .set_column_dictionary_enabled(path.clone(), false)
            .set_column_statistics_enabled(path.clone(), EnabledStatistics::None)
            .set_column_data_page_size_limit(path, 1);
        let path = ColumnPath::new(vec![image.to_owned(), "path".to_owned()]);
        builder = builder
            .set_column_dictionary_enabled(path.clone(), false)
            .set_column_statistics_enabled(path, EnabledStatistics::None);
    }
    builder
}

/// Returns for each encoded dim the raw dim that stores the same bits.
fn same_dims(
    vectors: &[VectorPlan],
    encoder: &Encoder,
    inputs: &[(usize, usize)],
) -> Vec<Option<(usize, usize)>> {
    let same = |dim: &gawm_schema::EncodedDim| {
        let vector = inputs.iter().map(|&(vector, _)| vector).find(|&v| vectors[v].name == dim.feature)?;
        let plan = &vectors[vector];
        let is_same = dim.encoding == gawm_schema::Encoding::Identity && plan.dtype == FloatType::Float32;
        let position = plan.dim_names.iter().position(|name| Some(name) == dim.raw_dims.first())?;
        is_same.then_some((vector, position))
    };
    encoder.dims().iter().map(same).collect()
}

/// Returns the nearest whole number of frames per second, at least 1.
pub fn fps(rate_hz: f64) -> u32 {
    rate_hz.round().clamp(1.0, f64::from(u32::MAX)) as u32
}

fn vector_plan(feature: &gawm_schema::Feature) -> VectorPlan {
    let (dtype, parts) = match &feature.data {
        FeatureData::Vector { dtype, parts } => (*dtype, parts.as_slice()),
        FeatureData::Image(_) => (FloatType::Float32, [].as_slice()),
    };
    VectorPlan {
        name: feature.name.clone(),
        role: feature.role,
        dtype,
        dim_names: parts.iter().flat_map(|p| p.dims.iter().map(|dim| dim.name.clone())).collect(),
        is_angle: parts
            .iter()
            .flat_map(|p| p.dims.iter().map(|_| matches!(p.kind, Kind::Angle { .. })))
            .collect(),
    }
}

fn float_type(dtype: FloatType) -> DataType {
    match dtype {
        FloatType::Float32 => DataType::Float32,
        FloatType::Float64 => DataType::Float64,
    }
}

/// A vector of width 1 is a scalar column: LeRobot refuses lists of one.
fn vector_field(name: &str, item: DataType, width: usize) -> Field {
    if width == 1 {
        Field::new(name, item, false)
    } else {
        Field::new(name, DataType::List(item_field(item)), false)
    }
}

pub(crate) fn item_field(item: DataType) -> Arc<Field> {
    Arc::new(Field::new("element", item, false))
}

/// The exact type that LeRobot's streaming reader needs, nullable in all places.
pub(crate) fn image_fields() -> Fields {
    Fields::from(vec![Field::new("bytes", DataType::Binary, true), Field::new("path", DataType::Utf8, true)])
}
