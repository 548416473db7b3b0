//! `meta/info.json` and the other JSON files.

use std::{
    collections::BTreeSet,
    fs::File,
    io::{self, Read},
    path::Path,
};

use serde_json::Value;

use super::{Defect, DefectKind, OpenError, ReadLimits, paths};

/// The layout of a dataset folder.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum FormatVersion {
    /// LeRobot v2.0: one Parquet file per episode.
    V2_0,
    /// LeRobot v2.1: as v2.0, with statistics per episode.
    V2_1,
    /// LeRobot v3.0, and gawm: many episodes per file.
    V3_0,
}

impl FormatVersion {
    /// Returns whether each episode has its own file.
    pub fn is_v2(self) -> bool {
        self < FormatVersion::V3_0
    }

    /// Returns the text that `codebase_version` has.
    pub fn text(self) -> &'static str {
        match self {
            FormatVersion::V2_0 => "v2.0",
            FormatVersion::V2_1 => "v2.1",
            FormatVersion::V3_0 => "v3.0",
        }
    }
}

/// The declared type of a feature.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum DType {
    /// A floating-point number.
    Float,
    /// An integer.
    Int,
    /// A truth value.
    Bool,
    /// Text.
    Text,
    /// Images inside the Parquet file.
    Image,
    /// Images in video files.
    Video,
    /// Something else, by its name.
    Unknown(String),
}

/// A declared feature.
#[derive(Debug, Clone, PartialEq)]
pub struct FeatureDecl {
    /// Column name.
    pub name: String,
    /// Declared type.
    pub dtype: DType,
    /// The type's name as written.
    pub dtype_name: String,
    /// Declared shape; `[1]` is a scalar.
    pub shape: Vec<usize>,
    /// Names of the dims, flattened, if declared.
    pub names: Vec<String>,
    /// Unit per dim, or one for all, if declared.
    pub units: Vec<String>,
    /// Whether the declaration has a `names` key.
    pub has_names_key: bool,
}

impl FeatureDecl {
    /// Returns the number of values per row.
    pub fn width(&self) -> usize {
        self.shape.iter().product()
    }

    /// Returns whether the feature is a camera.
    pub fn is_camera(&self) -> bool {
        matches!(self.dtype, DType::Image | DType::Video)
    }

    /// Returns whether the feature is a column of numbers.
    pub fn is_numeric(&self) -> bool {
        matches!(self.dtype, DType::Float | DType::Int | DType::Bool)
    }

    /// Returns (height, width, channels) of a camera, by the names of the axes or by size.
    pub fn image_size(&self) -> Option<(usize, usize, usize)> {
        let [a, b, c] = *self.shape.as_slice() else { return None };
        let is_channels_first = match self.names.first() {
            Some(name) => name.starts_with("channel"),
            None => matches!(a, 1 | 3 | 4) && !matches!(c, 1 | 3 | 4),
        };
        Some(if is_channels_first { (b, c, a) } else { (a, b, c) })
    }

    /// Returns the name of dim `dim` for people.
    pub fn dim_name(&self, dim: usize) -> String {
        match self.names.get(dim) {
            Some(name) if self.names.len() == self.width() && !self.is_camera() => name.clone(),
            _ if self.width() == 1 => String::new(),
            _ => format!("{dim}"),
        }
    }
}

/// What `meta/info.json` says.
#[derive(Debug, Clone)]
pub struct Info {
    /// The layout.
    pub version: FormatVersion,
    /// Nominal frames per second.
    pub fps: f64,
    /// Kind of robot.
    pub robot_type: Option<String>,
    /// Declared number of episodes.
    pub total_episodes: Option<u64>,
    /// Declared number of frames.
    pub total_frames: Option<u64>,
    /// Declared number of tasks.
    pub total_tasks: Option<u64>,
    /// Files per chunk folder.
    pub chunks_size: u64,
    /// Named ranges of episodes, as written.
    pub splits: Vec<(String, String)>,
    /// Template of data paths.
    pub data_path: String,
    /// Template of video paths.
    pub video_path: Option<String>,
    /// The features in the order they are declared.
    pub features: Vec<FeatureDecl>,
    /// The whole file.
    pub raw: Value,
}

impl Info {
    /// Returns the declaration of feature `name`.
    pub fn feature(&self, name: &str) -> Option<&FeatureDecl> {
        self.features.iter().find(|f| f.name == name)
    }
}

/// Reads a text file of at most the permitted size.
pub(super) fn read_text(root: &Path, relative: &str, limits: &ReadLimits) -> io::Result<String> {
    let path = paths::join_inside(root, relative)
        .map_err(|got| io::Error::new(io::ErrorKind::PermissionDenied, got))?;
    let file = File::open(&path)?;
    if !file.metadata()?.is_file() {
        return Err(io::Error::new(io::ErrorKind::InvalidInput, "expected a regular file"));
    }
    let mut text = Vec::new();
    let n = file.take(limits.max_json_bytes + 1).read_to_end(&mut text)?;
    if n as u64 > limits.max_json_bytes {
        return Err(io::Error::new(
            io::ErrorKind::FileTooLarge,
            format!("expected at most {} bytes", limits.max_json_bytes),
        ));
    }
    let text =
        String::from_utf8(text).map_err(|e| io::Error::new(io::ErrorKind::InvalidData, e.to_string()))?;
    Ok(text.strip_prefix('\u{feff}').map(str::to_owned).unwrap_or(text))
}

/// Reads an optional JSON file; a broken one is a defect.
pub(crate) fn read_json(
    root: &Path,
    relative: &str,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Option<Value> {
    let text = match read_text(root, relative, limits) {
        Ok(text) => text,
        Err(e) if e.kind() == io::ErrorKind::NotFound => return None,
        Err(e) => {
            defects.push(Defect::new(
                DefectKind::BadMetadata,
                relative,
                "a readable JSON file",
                e.to_string(),
            ));
            return None;
        }
    };
    match serde_json::from_str(&text) {
        Ok(value) => Some(value),
        Err(e) => {
            defects.push(Defect::new(
                DefectKind::BadMetadata,
                relative,
                "JSON (NaN and Infinity are not)",
                e.to_string(),
            ));
            None
        }
    }
}

/// Returns the typed schema in `meta/gawm.json`.
pub(super) fn typed_schema(gawm: Option<&Value>, defects: &mut Vec<Defect>) -> Option<gawm_schema::Schema> {
    let schema = gawm?.get("schema")?;
    match serde_json::from_value(schema.clone()) {
        Ok(schema) => Some(schema),
        Err(e) => {
            defects.push(Defect::new(
                DefectKind::BadMetadata,
                "meta/gawm.json schema",
                "a gawm schema",
                e.to_string(),
            ));
            None
        }
    }
}

/// Reads `meta/info.json`.
pub(super) fn read_info(
    root: &Path,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Result<Info, OpenError> {
    let text = read_text(root, "meta/info.json", limits)
        .map_err(|source| OpenError::Info { path: root.to_owned(), source })?;
    let bad = |expected: &str, got: String| OpenError::BadInfo {
        path: root.to_owned(),
        expected: expected.to_owned(),
        got,
    };
    if text.trim().is_empty() {
        return Err(bad("a JSON object", "an empty file".to_owned()));
    }
    let raw: Value = serde_json::from_str(&text).map_err(|e| bad("a JSON object", e.to_string()))?;
    let object = raw.as_object().ok_or_else(|| bad("a JSON object", "another JSON value".to_owned()))?;
    let version = match object.get("codebase_version").and_then(Value::as_str) {
        Some(v) if v.starts_with("v3") => FormatVersion::V3_0,
        Some(v) if v.starts_with("v2.1") => FormatVersion::V2_1,
        Some(v) if v.starts_with("v2") => FormatVersion::V2_0,
        got => return Err(bad("codebase_version v2.0, v2.1 or v3.0", format!("{got:?}"))),
    };
    let fps = object.get("fps").and_then(Value::as_f64).filter(|f| f.is_finite() && *f > 0.0);
    let fps = fps.ok_or_else(|| bad("fps, a positive number", format!("{:?}", object.get("fps"))))?;
    if !object["fps"].is_u64() && version == FormatVersion::V3_0 {
        let got = object["fps"].to_string();
        defects.push(Defect::new(DefectKind::InfoKey, "meta/info.json fps", "a JSON integer", got));
    }
    let features = object
        .get("features")
        .and_then(Value::as_object)
        .ok_or_else(|| bad("features, an object", "none".to_owned()))?;
    let features =
        features.iter().filter_map(|(name, value)| feature_decl(name, value, limits, defects)).collect();
    let default_data_path = if version.is_v2() {
        "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet"
    } else {
        "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
    };
    let mut count = |key: &str| {
        let value = object.get(key).and_then(Value::as_u64);
        if value.is_none() {
            let got = object.get(key).map_or("nothing".to_owned(), Value::to_string);
            defects.push(Defect::new(DefectKind::InfoKey, format!("meta/info.json {key}"), "a count", got));
        }
        value
    };
    let (total_episodes, total_frames, total_tasks) =
        (count("total_episodes"), count("total_frames"), count("total_tasks"));
    let chunks_size = count("chunks_size").filter(|n| *n > 0).unwrap_or(1000);
    let text_of = |key: &str| object.get(key).and_then(Value::as_str).map(str::to_owned);
    if text_of("data_path").is_none() {
        defects.push(Defect::new(
            DefectKind::InfoKey,
            "meta/info.json data_path",
            "a path template",
            "nothing",
        ));
    }
    let splits = object.get("splits").and_then(Value::as_object).into_iter().flatten();
    Ok(Info {
        version,
        fps,
        robot_type: text_of("robot_type"),
        total_episodes,
        total_frames,
        total_tasks,
        chunks_size,
        splits: splits
            .map(|(k, v)| (k.clone(), v.as_str().map_or_else(|| v.to_string(), str::to_owned)))
            .collect(),
        data_path: text_of("data_path").unwrap_or_else(|| default_data_path.to_owned()),
        video_path: text_of("video_path"),
        features,
        raw,
    })
}

fn feature_decl(
    name: &str,
    value: &Value,
    limits: &ReadLimits,
    defects: &mut Vec<Defect>,
) -> Option<FeatureDecl> {
    let place = format!("meta/info.json features.{name}");
    let mut bad = |expected: &str, got: String| {
        defects.push(Defect::new(DefectKind::BadFeature, place.clone(), expected, got));
    };
    let dtype_name = value.get("dtype").and_then(Value::as_str).unwrap_or("").to_owned();
    let dtype = match dtype_name.as_str() {
        "float16" | "float32" | "float64" => DType::Float,
        "int8" | "int16" | "int32" | "int64" | "uint8" | "uint16" | "uint32" | "uint64" => DType::Int,
        "bool" => DType::Bool,
        "string" => DType::Text,
        "image" => DType::Image,
        "video" => DType::Video,
        other => {
            bad("a dtype that LeRobot knows", format!("{other:?}"));
            DType::Unknown(other.to_owned())
        }
    };
    let shape: Option<Vec<usize>> = value.get("shape").and_then(Value::as_array).and_then(|dims| {
        dims.iter()
            .map(|d| d.as_u64().and_then(|d| usize::try_from(d).ok()).filter(|d| *d > 0 && *d <= 1 << 20))
            .collect()
    });
    let shape = match shape {
        Some(shape) if !shape.is_empty() && shape.len() <= 5 => shape,
        _ => {
            bad(
                "a shape of one to five positive sizes",
                value.get("shape").map_or("nothing".to_owned(), Value::to_string),
            );
            return None;
        }
    };
    let is_camera = matches!(dtype, DType::Image | DType::Video);
    let width = shape.iter().try_fold(1usize, |a, b| a.checked_mul(*b));
    if !is_camera && width.is_none_or(|w| w > limits.max_width) {
        bad(&format!("at most {} values per row", limits.max_width), format!("shape {shape:?}"));
        return None;
    }
    if name.contains('/') {
        bad("a name without '/'", format!("{name:?}"));
    }
    let mut names = Vec::new();
    flatten_names(value.get("names").unwrap_or(&Value::Null), 0, &mut names);
    if !is_camera && !names.is_empty() && Some(names.len()) != width && shape.len() == 1 && names.len() > 1 {
        bad(&format!("{} names", shape[0]), format!("{}", names.len()));
    }
    if !is_camera {
        let unique: BTreeSet<&String> = names.iter().collect();
        if unique.len() < names.len() {
            let twice = names.iter().find(|n| names.iter().filter(|m| m == n).count() > 1);
            bad("unique names of dims", format!("{:?} more than once", twice.map_or("", String::as_str)));
        }
    }
    let mut units = Vec::new();
    flatten_names(value.get("units").or_else(|| value.get("unit")).unwrap_or(&Value::Null), 0, &mut units);
    Some(FeatureDecl {
        name: name.to_owned(),
        dtype,
        dtype_name,
        shape,
        names,
        units,
        has_names_key: value.get("names").is_some(),
    })
}

/// Collects texts from nested lists and objects (`names` is a list, a list of lists or an object of lists).
fn flatten_names(value: &Value, depth: usize, out: &mut Vec<String>) {
    if depth > 4 || out.len() > 1 << 16 {
        return;
    }
    match value {
        Value::String(text) => out.push(text.clone()),
        Value::Array(items) => items.iter().for_each(|item| flatten_names(item, depth + 1, out)),
        Value::Object(items) => items.values().for_each(|item| flatten_names(item, depth + 1, out)),
        _ => {}
    }
}
