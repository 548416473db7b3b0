//! Columns of a tabular file: what they are and the typed values read from them.

use serde::Serialize;

use super::error::ReadError;

/// One array of the file.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Column {
    /// Path inside the file, without a leading slash: `data/demo_0/actions`.
    pub path: String,
    /// Type of one element.
    pub dtype: Dtype,
    /// Extent of every axis; empty for a scalar. The first axis is rows.
    pub shape: Vec<u64>,
    /// Extent of one chunk, when the data are stored in chunks.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chunk_shape: Option<Vec<u64>>,
    /// Filters in the order in which they were applied when written.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub filters: Vec<Filter>,
    /// Attributes in the order of their names.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub attributes: Vec<Attribute>,
    /// Rows from the first one on that can be read: all of them, unless the file is cut or its writer was killed.
    pub readable_rows: u64,
    /// Why no value can be read, if so.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "as_text")]
    pub problem: Option<ReadError>,
}

impl Column {
    /// Returns the length of the first axis; a scalar has none.
    pub fn rows(&self) -> Option<u64> {
        self.shape.first().copied()
    }

    /// Returns how many elements one row has, saturated.
    pub fn row_elements(&self) -> u64 {
        self.shape.iter().skip(1).fold(1, |n: u64, &d| n.saturating_mul(d))
    }

    /// Returns height, width and channels when a row looks like one image: u8, with 1, 3 or 4 channels last.
    pub fn image_shape(&self) -> Option<[u64; 3]> {
        match (self.dtype, &self.shape[..]) {
            (Dtype::U8, &[_, h, w, c]) if matches!(c, 1 | 3 | 4) && h > 1 && w > 1 => Some([h, w, c]),
            _ => None,
        }
    }
}

fn as_text<S: serde::Serializer>(problem: &Option<ReadError>, s: S) -> Result<S::Ok, S::Error> {
    s.collect_str(&problem.as_ref().map(ToString::to_string).unwrap_or_default())
}

/// Type of one element.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Dtype {
    /// True or false.
    Bool,
    /// Unsigned, 8 bits.
    U8,
    /// Signed, 8 bits.
    I8,
    /// Unsigned, 16 bits.
    U16,
    /// Signed, 16 bits.
    I16,
    /// Unsigned, 32 bits.
    U32,
    /// Signed, 32 bits.
    I32,
    /// Unsigned, 64 bits.
    U64,
    /// Signed, 64 bits.
    I64,
    /// IEEE half; its values are widened to `f32`, which holds them exactly.
    F16,
    /// IEEE single.
    F32,
    /// IEEE double.
    F64,
    /// Text.
    Text,
    /// Something that is no column here; the column's `problem` says what.
    Unsupported,
}

impl Dtype {
    /// Returns the name used in reports and hashes.
    pub fn name(self) -> &'static str {
        match self {
            Self::Bool => "bool",
            Self::U8 => "u8",
            Self::I8 => "i8",
            Self::U16 => "u16",
            Self::I16 => "i16",
            Self::U32 => "u32",
            Self::I32 => "i32",
            Self::U64 => "u64",
            Self::I64 => "i64",
            Self::F16 => "f16",
            Self::F32 => "f32",
            Self::F64 => "f64",
            Self::Text => "text",
            Self::Unsupported => "unsupported",
        }
    }

    /// Returns whether values widen to `f64` (`u64` and `i64` above 2^53 lose low bits).
    pub fn is_number(self) -> bool {
        !matches!(self, Self::Text | Self::Unsupported)
    }
}

/// One filter of a chunk's pipeline.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Filter {
    /// Registered id.
    pub id: u16,
    /// Name: ours for known ids, else the file's.
    pub name: String,
}

/// One attribute of a dataset or group.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Attribute {
    /// Name.
    pub name: String,
    /// Value.
    pub value: AttributeValue,
}

/// What an attribute holds.
#[derive(Debug, Clone, PartialEq, Serialize)]
#[serde(untagged)]
pub enum AttributeValue {
    /// One text.
    Text(String),
    /// Several texts.
    Texts(Vec<String>),
    /// One number, widened.
    Number(f64),
    /// One integer.
    Integer(i64),
    /// Several numbers, widened.
    Numbers(Vec<f64>),
    /// One truth value.
    Flag(bool),
    /// Something else, described.
    Unsupported(String),
}

/// Values of consecutive rows, row-major.
#[derive(Debug, Clone, PartialEq)]
pub struct Rows {
    /// The values, all rows one after another.
    pub values: Values,
    /// Rows read.
    pub rows: usize,
    /// Extent of one row; empty for one element per row.
    pub row_shape: Vec<usize>,
}

impl Rows {
    /// Returns the elements in one row.
    pub fn width(&self) -> usize {
        self.row_shape.iter().product()
    }
}

/// Typed values as stored, NaN included.
#[derive(Debug, Clone, PartialEq)]
pub enum Values {
    /// Truth values.
    Bool(Vec<bool>),
    /// Unsigned, 8 bits.
    U8(Vec<u8>),
    /// Signed, 8 bits.
    I8(Vec<i8>),
    /// Unsigned, 16 bits.
    U16(Vec<u16>),
    /// Signed, 16 bits.
    I16(Vec<i16>),
    /// Unsigned, 32 bits.
    U32(Vec<u32>),
    /// Signed, 32 bits.
    I32(Vec<i32>),
    /// Unsigned, 64 bits.
    U64(Vec<u64>),
    /// Signed, 64 bits.
    I64(Vec<i64>),
    /// Single precision (also half, widened).
    F32(Vec<f32>),
    /// Double precision.
    F64(Vec<f64>),
    /// Texts.
    Text(Vec<String>),
}

impl Values {
    /// Returns how many elements there are.
    pub fn len(&self) -> usize {
        match self {
            Self::Bool(v) => v.len(),
            Self::U8(v) => v.len(),
            Self::I8(v) => v.len(),
            Self::U16(v) => v.len(),
            Self::I16(v) => v.len(),
            Self::U32(v) => v.len(),
            Self::I32(v) => v.len(),
            Self::U64(v) => v.len(),
            Self::I64(v) => v.len(),
            Self::F32(v) => v.len(),
            Self::F64(v) => v.len(),
            Self::Text(v) => v.len(),
        }
    }

    /// Returns whether there is no element.
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Widens to `f64`; text gives `None`. Integers beyond 2^53 lose low bits.
    pub fn to_f64(&self) -> Option<Vec<f64>> {
        Some(match self {
            Self::Bool(v) => v.iter().map(|&x| f64::from(u8::from(x))).collect(),
            Self::U8(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::I8(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::U16(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::I16(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::U32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::I32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::U64(v) => v.iter().map(|&x| x as f64).collect(),
            Self::I64(v) => v.iter().map(|&x| x as f64).collect(),
            Self::F32(v) => v.iter().map(|&x| f64::from(x)).collect(),
            Self::F64(v) => v.clone(),
            Self::Text(_) => return None,
        })
    }

    /// Returns integers and truth values as `i64`; `None` for fractions, text, or what does not fit.
    pub fn to_i64(&self) -> Option<Vec<i64>> {
        match self {
            Self::Bool(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::U8(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::I8(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::U16(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::I16(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::U32(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::I32(v) => Some(v.iter().map(|&x| i64::from(x)).collect()),
            Self::U64(v) => v.iter().map(|&x| i64::try_from(x).ok()).collect(),
            Self::I64(v) => Some(v.clone()),
            Self::F32(_) | Self::F64(_) | Self::Text(_) => None,
        }
    }
}
