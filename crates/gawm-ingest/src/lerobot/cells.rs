//! Cells of Arrow columns as CDR messages.

use std::fs::File;
use std::io::Read as _;
use std::ops::Range;
use std::path::{Component, Path};

use arrow::array::{Array, AsArray};
use arrow::datatypes::{
    DataType, Float32Type, Float64Type, Int8Type, Int16Type, Int32Type, Int64Type, UInt8Type, UInt16Type,
    UInt32Type, UInt64Type,
};

use crate::log::Channel;
use crate::rows::{CDR_HEADER, HEADER_TEXT, align, channel, push_bytes, push_header, push_text};
use gawm_video::RgbFrame;

/// Largest image file that is read by a path in a cell.
const MAX_IMAGE_BYTES: u64 = 256 << 20;

/// What the cells of a column are.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum CellKind {
    /// One number.
    Number(Leaf),
    /// Lists of numbers, to any depth.
    Numbers(Leaf),
    /// Text.
    Text,
    /// An image file: `struct<bytes, path>` or bytes.
    Image,
}

/// Type of a number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leaf {
    Bool,
    I8,
    I16,
    I32,
    I64,
    U8,
    U16,
    U32,
    U64,
    F32,
    F64,
}

impl Leaf {
    fn of(data_type: &DataType) -> Option<Leaf> {
        Some(match data_type {
            DataType::Boolean => Leaf::Bool,
            DataType::Int8 => Leaf::I8,
            DataType::Int16 => Leaf::I16,
            DataType::Int32 => Leaf::I32,
            DataType::Int64 => Leaf::I64,
            DataType::UInt8 => Leaf::U8,
            DataType::UInt16 => Leaf::U16,
            DataType::UInt32 => Leaf::U32,
            DataType::UInt64 => Leaf::U64,
            DataType::Float32 => Leaf::F32,
            DataType::Float64 => Leaf::F64,
            _ => return None,
        })
    }

    fn ros_name(self) -> &'static str {
        match self {
            Leaf::Bool => "bool",
            Leaf::I8 => "int8",
            Leaf::I16 => "int16",
            Leaf::I32 => "int32",
            Leaf::I64 => "int64",
            Leaf::U8 => "uint8",
            Leaf::U16 => "uint16",
            Leaf::U32 => "uint32",
            Leaf::U64 => "uint64",
            Leaf::F32 => "float32",
            Leaf::F64 => "float64",
        }
    }

    fn size(self) -> usize {
        match self {
            Leaf::Bool | Leaf::I8 | Leaf::U8 => 1,
            Leaf::I16 | Leaf::U16 => 2,
            Leaf::I32 | Leaf::U32 | Leaf::F32 => 4,
            Leaf::I64 | Leaf::U64 | Leaf::F64 => 8,
        }
    }
}

impl CellKind {
    /// Tells what the cells of a column are; `None` when they are nothing that a contract can use.
    pub(super) fn of(data_type: &DataType) -> Option<CellKind> {
        if let Some(leaf) = Leaf::of(data_type) {
            return Some(CellKind::Number(leaf));
        }
        match data_type {
            DataType::Utf8 | DataType::LargeUtf8 => Some(CellKind::Text),
            DataType::Binary | DataType::LargeBinary => Some(CellKind::Image),
            DataType::Struct(fields) => {
                let has_bytes = fields.iter().any(|field| {
                    field.name() == "bytes"
                        && matches!(field.data_type(), DataType::Binary | DataType::LargeBinary)
                });
                has_bytes.then_some(CellKind::Image)
            }
            _ => {
                let mut inner = data_type;
                while let DataType::List(item)
                | DataType::LargeList(item)
                | DataType::FixedSizeList(item, _) = inner
                {
                    inner = item.data_type();
                }
                (inner != data_type).then(|| Leaf::of(inner)).flatten().map(CellKind::Numbers)
            }
        }
    }

    /// Makes the channel of a column.
    pub(super) fn channel(self, topic: &str, id: u16) -> Channel {
        match self {
            CellKind::Number(leaf) => row_channel(topic, format!("{} data\n", leaf.ros_name()), id),
            CellKind::Numbers(leaf) => row_channel(topic, format!("{}[] data\n", leaf.ros_name()), id),
            CellKind::Text => row_channel(topic, "string data\n".to_owned(), id),
            CellKind::Image => channel(
                topic,
                "sensor_msgs/msg/CompressedImage",
                format!("std_msgs/Header header\nstring format\nuint8[] data\n{HEADER_TEXT}"),
                id,
            ),
        }
    }
}

fn row_channel(topic: &str, text: String, id: u16) -> Channel {
    channel(topic, "gawm_msgs/msg/Row", text, id)
}

/// Makes the channel of a camera whose frames come out of a video file.
pub(super) fn raw_image_channel(topic: &str, id: u16) -> Channel {
    let fields = "std_msgs/Header header\nuint32 height\nuint32 width\nstring encoding\nuint8 is_bigendian\nuint32 step\nuint8[] data\n";
    channel(topic, "sensor_msgs/msg/Image", format!("{fields}{HEADER_TEXT}"), id)
}

/// Appends the message of a video frame.
pub(super) fn push_raw_image(frame: &RgbFrame, time_ns: i64, data: &mut Vec<u8>) -> Range<usize> {
    let begin = data.len();
    let start = push_header(time_ns, data);
    align(start, 4, data);
    data.extend_from_slice(&frame.height.to_le_bytes());
    data.extend_from_slice(&frame.width.to_le_bytes());
    push_text("rgb8", start, data);
    data.push(0);
    align(start, 4, data);
    data.extend_from_slice(&frame.width.saturating_mul(3).to_le_bytes());
    push_bytes(&frame.data, start, data);
    begin..data.len()
}

/// Why a cell has no message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum NoMessage {
    /// It is null, or a number in it is.
    Null,
    /// It cannot be read.
    Unreadable(String),
}

/// Appends the message of one cell; `root` is the folder that paths of images start from.
pub(super) fn push_cell(
    kind: CellKind,
    array: &dyn Array,
    row: usize,
    time_ns: i64,
    root: &Path,
    data: &mut Vec<u8>,
) -> Result<Range<usize>, NoMessage> {
    if array.is_null(row) {
        return Err(NoMessage::Null);
    }
    let start = data.len();
    let result = match kind {
        CellKind::Number(leaf) => {
            data.extend_from_slice(&CDR_HEADER);
            push_numbers(leaf, array, row..row + 1, data)
        }
        CellKind::Numbers(leaf) => push_list(leaf, array, row, start, data),
        CellKind::Text => {
            let text = match array.data_type() {
                DataType::LargeUtf8 => array.as_string::<i64>().value(row),
                _ => array.as_string::<i32>().value(row),
            };
            data.extend_from_slice(&CDR_HEADER);
            push_text(text, start, data);
            Ok(())
        }
        CellKind::Image => push_image(array, row, time_ns, root, data),
    };
    match result {
        Ok(()) => Ok(start..data.len()),
        Err(why) => {
            data.truncate(start);
            Err(why)
        }
    }
}

fn push_list(
    leaf: Leaf,
    array: &dyn Array,
    row: usize,
    start: usize,
    data: &mut Vec<u8>,
) -> Result<(), NoMessage> {
    let mut inner = array;
    let mut range = row..row + 1;
    loop {
        if matches!(
            inner.data_type(),
            DataType::List(_) | DataType::LargeList(_) | DataType::FixedSizeList(..)
        ) && range.clone().any(|i| inner.is_null(i))
        {
            return Err(NoMessage::Null);
        }
        let (values, from, to) = match inner.data_type() {
            DataType::List(_) => {
                let list = inner.as_list::<i32>();
                let offsets = list.value_offsets();
                (list.values(), offsets[range.start] as usize, offsets[range.end] as usize)
            }
            DataType::LargeList(_) => {
                let list = inner.as_list::<i64>();
                let offsets = list.value_offsets();
                (list.values(), offsets[range.start] as usize, offsets[range.end] as usize)
            }
            DataType::FixedSizeList(_, width) => {
                let list = inner.as_fixed_size_list();
                // Offsets of a slice begin where the slice does.
                let first = list.value_offset(0) as usize;
                let width = usize::try_from(*width).unwrap_or(0);
                (list.values(), first + range.start * width, first + range.end * width)
            }
            _ => break,
        };
        inner = values.as_ref();
        range = from..to;
    }
    data.extend_from_slice(&CDR_HEADER);
    let count =
        u32::try_from(range.len()).map_err(|_beyond| NoMessage::Unreadable("too long a list".to_owned()))?;
    data.extend_from_slice(&count.to_le_bytes());
    if !range.is_empty() {
        align(start, leaf.size(), data);
    }
    push_numbers(leaf, inner, range, data)
}

fn push_numbers(
    leaf: Leaf,
    array: &dyn Array,
    range: Range<usize>,
    data: &mut Vec<u8>,
) -> Result<(), NoMessage> {
    macro_rules! push {
        ($type:ty) => {{
            let array = array.as_primitive::<$type>();
            for i in range {
                if array.is_null(i) {
                    return Err(NoMessage::Null);
                }
                data.extend_from_slice(&array.value(i).to_le_bytes());
            }
        }};
    }
    match leaf {
        Leaf::Bool => {
            let array = array.as_boolean();
            for i in range {
                if array.is_null(i) {
                    return Err(NoMessage::Null);
                }
                data.push(u8::from(array.value(i)));
            }
        }
        Leaf::I8 => push!(Int8Type),
        Leaf::I16 => push!(Int16Type),
        Leaf::I32 => push!(Int32Type),
        Leaf::I64 => push!(Int64Type),
        Leaf::U8 => push!(UInt8Type),
        Leaf::U16 => push!(UInt16Type),
        Leaf::U32 => push!(UInt32Type),
        Leaf::U64 => push!(UInt64Type),
        Leaf::F32 => push!(Float32Type),
        Leaf::F64 => push!(Float64Type),
    }
    Ok(())
}

fn push_image(
    array: &dyn Array,
    row: usize,
    time_ns: i64,
    root: &Path,
    data: &mut Vec<u8>,
) -> Result<(), NoMessage> {
    let (bytes, path) = match array.data_type() {
        DataType::Struct(_) => {
            let array = array.as_struct();
            (array.column_by_name("bytes").cloned(), array.column_by_name("path").cloned())
        }
        _ => (None, None),
    };
    let held = match &bytes {
        Some(bytes) => bytes.as_ref(),
        None => array,
    };
    let read;
    let image: &[u8] = if held.is_valid(row) {
        match held.data_type() {
            DataType::LargeBinary => held.as_binary::<i64>().value(row),
            _ => held.as_binary::<i32>().value(row),
        }
    } else {
        let path = path.filter(|path| path.is_valid(row)).ok_or(NoMessage::Null)?;
        let path = match path.data_type() {
            DataType::Utf8 => path.as_string::<i32>().value(row),
            DataType::LargeUtf8 => path.as_string::<i64>().value(row),
            _ => return Err(NoMessage::Null),
        };
        read = read_inside(root, path).map_err(NoMessage::Unreadable)?;
        &read
    };
    let start = push_header(time_ns, data);
    push_text("", start, data);
    push_bytes(image, start, data);
    Ok(())
}

/// Reads a file by a path that a cell names: inside the folder, or not at all.
fn read_inside(root: &Path, path: &str) -> Result<Vec<u8>, String> {
    let is_inside = Path::new(path).components().all(|part| matches!(part, Component::Normal(_)));
    if !is_inside {
        return Err(format!("image path {path:?}: expected a path inside the folder"));
    }
    let file = File::open(root.join(path)).map_err(|error| format!("image {path:?}: {error}"))?;
    let mut bytes = Vec::new();
    file.take(MAX_IMAGE_BYTES + 1)
        .read_to_end(&mut bytes)
        .map_err(|error| format!("image {path:?}: {error}"))?;
    if bytes.len() as u64 > MAX_IMAGE_BYTES {
        return Err(format!("image {path:?}: expected at most {MAX_IMAGE_BYTES} bytes"));
    }
    Ok(bytes)
}
