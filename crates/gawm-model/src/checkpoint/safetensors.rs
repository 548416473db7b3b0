//! The safetensors container, read with suspicion and written deterministically.
//!
//! ```text
//! 0   u64 little-endian   n, length of the header
//! 8   n bytes             JSON: {"__metadata__": {..}, NAME: {"dtype", "shape", "data_offsets": [begin, end]}}
//! 8+n                     data; offsets count from here, tensors follow each other without gap
//! ```
//!
//! Written here and not by the `safetensors` crate because that one orders the metadata by a random hash, so that equal
//! checkpoints would differ; and read here to name the tensor and the numbers in every error.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};

use candle_core::{DType, Device, Tensor};
use serde::Deserialize;
use serde::de::{Deserializer, MapAccess, Visitor};
use thiserror::Error;

use super::CheckpointError;

/// Longest header that is read. A model of a thousand tensors needs 150 kB, with an optimiser three times that.
const MAX_HEADER_BYTES: u64 = 16 << 20;

/// Why bytes are no safetensors file.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum FormatError {
    /// The file ends before the header does.
    #[error("truncated header: expected {expected} bytes in all, got {got}")]
    Truncated {
        /// Bytes up to the end of the header.
        expected: u64,
        /// Bytes of the file.
        got: u64,
    },
    /// The header is absurdly long.
    #[error("header too long: expected at most {MAX_HEADER_BYTES} bytes, got {got}")]
    HeaderTooLong {
        /// The length it states.
        got: u64,
    },
    /// The header is not the JSON it must be.
    #[error("malformed header: {message}")]
    Header {
        /// What the parser says.
        message: String,
    },
    /// A name occurs twice.
    #[error("malformed header: {name:?} occurs twice")]
    Duplicate {
        /// The name.
        name: String,
    },
    /// A tensor's numbers do not have a type that weights have.
    #[error("unsupported dtype of {name:?}: expected F64, F32, F16, BF16, I64, I32 or U8, got {got:?}")]
    Dtype {
        /// The tensor.
        name: String,
        /// Its type.
        got: String,
    },
    /// Shape, type and offsets of a tensor contradict each other.
    #[error(
        "size mismatch on {name:?}: expected {expected} bytes for shape {shape:?}, got offsets {offsets:?}"
    )]
    Size {
        /// The tensor.
        name: String,
        /// Its shape.
        shape: Box<[usize]>,
        /// Bytes that shape and type need; `None` beyond 64 bits.
        expected: MaybeBytes,
        /// Where it states to be.
        offsets: [u64; 2],
    },
    /// Tensors overlap, or leave bytes that belong to none.
    #[error("misplaced tensor {name:?}: expected to begin at byte {expected} of the data, got {got}")]
    Misplaced {
        /// The tensor.
        name: String,
        /// Where the one before it ends.
        expected: u64,
        /// Where it begins.
        got: u64,
    },
    /// The data is longer or shorter than the tensors.
    #[error("wrong length of the data: expected {expected} bytes for the tensors, got {got}")]
    Length {
        /// Where the last tensor ends.
        expected: u64,
        /// Bytes after the header.
        got: u64,
    },
}

/// A number of bytes, or more than can be counted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct MaybeBytes(pub Option<u64>);

impl std::fmt::Display for MaybeBytes {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.0 {
            Some(bytes) => write!(f, "{bytes}"),
            None => write!(f, "more than 2^64"),
        }
    }
}

/// An open file whose header has been checked; tensors are read one by one.
pub(super) struct TensorFile {
    path: PathBuf,
    file: File,
    data_start: u64,
    metadata: Metadata,
    entries: Entries,
}

type Metadata = BTreeMap<String, String>;
type Entries = BTreeMap<String, Entry>;

#[derive(Debug, Clone)]
struct Entry {
    dtype: DType,
    shape: Vec<usize>,
    begin: u64,
    end: u64,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct RawEntry {
    dtype: String,
    shape: Vec<usize>,
    data_offsets: [u64; 2],
}

/// The header in the order it is written, so that a name that occurs twice is noticed.
struct RawHeader {
    metadata: BTreeMap<String, String>,
    entries: Vec<(String, RawEntry)>,
}

impl<'de> Deserialize<'de> for RawHeader {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<RawHeader, D::Error> {
        struct HeaderVisitor;
        impl<'de> Visitor<'de> for HeaderVisitor {
            type Value = RawHeader;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object of tensors")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<RawHeader, A::Error> {
                let mut header = RawHeader { metadata: BTreeMap::new(), entries: Vec::new() };
                while let Some(name) = map.next_key::<String>()? {
                    if name == "__metadata__" {
                        header.metadata = map.next_value()?;
                    } else {
                        header.entries.push((name, map.next_value()?));
                    }
                }
                Ok(header)
            }
        }
        deserializer.deserialize_map(HeaderVisitor)
    }
}

impl TensorFile {
    /// Opens a file and checks its header against its length.
    pub(super) fn open(path: &Path) -> Result<TensorFile, CheckpointError> {
        let io = |cause| CheckpointError::Io { verb: "read", path: path.to_owned(), cause };
        let format = |cause| CheckpointError::Format { path: path.to_owned(), cause };
        let mut file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        if length < 8 {
            return Err(format(FormatError::Truncated { expected: 8, got: length }));
        }
        let mut prefix = [0; 8];
        file.read_exact(&mut prefix).map_err(io)?;
        let header_bytes = u64::from_le_bytes(prefix);
        if header_bytes > MAX_HEADER_BYTES {
            return Err(format(FormatError::HeaderTooLong { got: header_bytes }));
        }
        let data_start = 8 + header_bytes;
        if data_start > length {
            return Err(format(FormatError::Truncated { expected: data_start, got: length }));
        }
        let mut header = vec![0; header_bytes as usize];
        file.read_exact(&mut header).map_err(io)?;
        let (metadata, entries) = parse_header(&header, length - data_start).map_err(format)?;
        Ok(TensorFile { path: path.to_owned(), file, data_start, metadata, entries })
    }

    pub(super) fn metadata(&self) -> &BTreeMap<String, String> {
        &self.metadata
    }

    /// Names and shapes, sorted by name.
    pub(super) fn shapes(&self) -> impl Iterator<Item = (String, Vec<usize>)> {
        self.entries.iter().map(|(name, entry)| (name.clone(), entry.shape.clone()))
    }

    /// Reads one tensor to the CPU.
    pub(super) fn read(&mut self, name: &str) -> Result<Tensor, CheckpointError> {
        let io = |cause| CheckpointError::Io { verb: "read", path: self.path.clone(), cause };
        let missing = || candle_core::Error::CannotFindTensor { path: name.to_owned() };
        let entry = self.entries.get(name).ok_or_else(missing)?;
        let mut bytes = vec![0; (entry.end - entry.begin) as usize];
        self.file.seek(SeekFrom::Start(self.data_start + entry.begin)).map_err(io)?;
        self.file.read_exact(&mut bytes).map_err(io)?;
        Ok(Tensor::from_raw_buffer(&bytes, entry.dtype, &entry.shape, &Device::Cpu)?)
    }
}

fn parse_header(header: &[u8], data_bytes: u64) -> Result<(Metadata, Entries), FormatError> {
    let malformed = |error: serde_json::Error| FormatError::Header { message: error.to_string() };
    let raw: RawHeader = serde_json::from_slice(header).map_err(malformed)?;
    let mut entries = BTreeMap::new();
    for (name, raw) in raw.entries {
        let entry = check_entry(&name, raw)?;
        if entries.insert(name.clone(), entry).is_some() {
            return Err(FormatError::Duplicate { name });
        }
    }
    let mut in_file_order: Vec<(&String, &Entry)> = entries.iter().collect();
    in_file_order.sort_by_key(|(name, entry)| (entry.begin, entry.end, *name));
    let mut end = 0;
    for (name, entry) in in_file_order {
        if entry.begin != end {
            return Err(FormatError::Misplaced { name: name.clone(), expected: end, got: entry.begin });
        }
        end = entry.end;
    }
    if end != data_bytes {
        return Err(FormatError::Length { expected: end, got: data_bytes });
    }
    Ok((raw.metadata, entries))
}

fn check_entry(name: &str, raw: RawEntry) -> Result<Entry, FormatError> {
    let dtype = match raw.dtype.as_str() {
        "F64" => DType::F64,
        "F32" => DType::F32,
        "F16" => DType::F16,
        "BF16" => DType::BF16,
        "I64" => DType::I64,
        "I32" => DType::I32,
        "U8" | "BOOL" => DType::U8,
        _ => return Err(FormatError::Dtype { name: name.to_owned(), got: raw.dtype }),
    };
    let [begin, end] = raw.data_offsets;
    let expected = byte_count(&raw.shape, dtype);
    if expected.is_none() || end.checked_sub(begin) != expected {
        return Err(FormatError::Size {
            name: name.to_owned(),
            shape: raw.shape.into(),
            expected: MaybeBytes(expected),
            offsets: raw.data_offsets,
        });
    }
    Ok(Entry { dtype, shape: raw.shape, begin, end })
}

/// Bytes of a tensor, unless they are beyond 64 bits.
fn byte_count(shape: &[usize], dtype: DType) -> Option<u64> {
    let elements = shape.iter().try_fold(1u64, |product, &dim| product.checked_mul(dim as u64))?;
    elements.checked_mul(dtype.size_in_bytes() as u64)
}

/// Writes a file next to `path` and renames it, so that no reader sees a part. f32 and i64 tensors only.
pub(super) fn write(
    path: &Path,
    metadata: &BTreeMap<String, String>,
    tensors: &BTreeMap<String, Tensor>,
) -> Result<(), CheckpointError> {
    let io = |cause| CheckpointError::Io { verb: "write", path: path.to_owned(), cause };
    let mut name = path.file_name().ok_or_else(|| io(std::io::ErrorKind::InvalidInput.into()))?.to_owned();
    name.push(format!(".tmp-{}", std::process::id()));
    let temporary = path.with_file_name(name);
    let result = write_to(&temporary, metadata, tensors)
        .and_then(|()| std::fs::rename(&temporary, path).map_err(io))
        .and_then(|()| sync_folder(path).map_err(io));
    if result.is_err() {
        std::fs::remove_file(&temporary).ok(); // it may never have been made; the first error is the one to report
    }
    result
}

fn write_to(
    path: &Path,
    metadata: &BTreeMap<String, String>,
    tensors: &BTreeMap<String, Tensor>,
) -> Result<(), CheckpointError> {
    let io = |cause| CheckpointError::Io { verb: "write", path: path.to_owned(), cause };
    let mut header = serde_json::Map::new();
    header.insert("__metadata__".to_owned(), serde_json::json!(metadata));
    let mut offset = 0;
    for (name, tensor) in tensors {
        let dtype = if tensor.dtype().is_int() { "I64" } else { "F32" };
        let end = offset + tensor.elem_count() * if dtype == "I64" { 8 } else { 4 };
        let entry =
            serde_json::json!({"dtype": dtype, "shape": tensor.dims(), "data_offsets": [offset, end]});
        header.insert(name.clone(), entry);
        offset = end;
    }
    let mut header = serde_json::Value::Object(header).to_string();
    while !header.len().is_multiple_of(8) {
        header.push(' '); // aligns the data, as the format allows
    }
    let mut file = std::io::BufWriter::new(File::create(path).map_err(io)?);
    file.write_all(&(header.len() as u64).to_le_bytes()).map_err(io)?;
    file.write_all(header.as_bytes()).map_err(io)?;
    for tensor in tensors.values() {
        file.write_all(&bytes(tensor)?).map_err(io)?;
    }
    let file = file.into_inner().map_err(|error| io(error.into_error()))?;
    file.sync_all().map_err(io)
}

/// Little-endian bytes of a tensor. Sync: waits for the device.
fn bytes(tensor: &Tensor) -> Result<Vec<u8>, CheckpointError> {
    if tensor.dtype().is_int() {
        let values = tensor.to_dtype(DType::I64)?.flatten_all()?.to_vec1::<i64>()?;
        return Ok(values.into_iter().flat_map(i64::to_le_bytes).collect());
    }
    let values = tensor.to_dtype(DType::F32)?.flatten_all()?.to_vec1::<f32>()?;
    Ok(values.into_iter().flat_map(f32::to_le_bytes).collect())
}

/// Makes the rename durable.
fn sync_folder(path: &Path) -> std::io::Result<()> {
    let folder = path.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    File::open(folder)?.sync_all()
}
