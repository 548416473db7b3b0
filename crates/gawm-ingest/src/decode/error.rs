//! What can go wrong when a schema is compiled and when a message is decoded.

use super::path::PathError;

/// Why a channel cannot be decoded, or a field of it not be mapped.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum CompileError {
    /// The pair of message and schema encoding is one that gawm does not decode.
    #[error(
        "cannot decode {topic:?}: message encoding {message_encoding:?} with schema encoding {schema_encoding:?} is not supported yet (supported: cdr with ros2msg, ros2idl or omgidl, ros1 with ros1msg, protobuf, json, cbor, flatbuffer with its reflection schema)"
    )]
    UnsupportedEncoding {
        /// Topic of the channel.
        topic: String,
        /// The channel's message encoding.
        message_encoding: String,
        /// The schema's encoding, empty without a schema.
        schema_encoding: String,
    },
    /// The channel needs a schema, has none, and its type is not known.
    #[error(
        "cannot decode {topic:?}: the channel has no schema text and type {schema_name:?} is not built in; give a folder of .msg files as `schemas`"
    )]
    NoSchema {
        /// Topic of the channel.
        topic: String,
        /// Name of the type, empty if the channel names none.
        schema_name: String,
    },
    /// The schema's bytes are not what its encoding says.
    #[error("schema {schema_name:?} of {topic:?} is not valid {schema_encoding}: {detail}")]
    BadSchema {
        /// Topic of the channel.
        topic: String,
        /// Name of the schema.
        schema_name: String,
        /// Encoding of the schema.
        schema_encoding: String,
        /// What is wrong with it, and where.
        detail: String,
    },
    /// The schema is the text of a service or an action, which does not describe the recorded event message.
    #[error(
        "schema {schema_name:?} of {topic:?} is a service or action definition (it holds \"---\"): it does not describe the recorded messages"
    )]
    ServiceSchema {
        /// Topic of the channel.
        topic: String,
        /// Name of the schema.
        schema_name: String,
    },
    /// The schema names a type that it does not define and that is not built in.
    #[error("schema {schema_name:?} of {topic:?}: field {field:?} has the unknown type {type_name:?}")]
    UnknownType {
        /// Topic of the channel.
        topic: String,
        /// Name of the schema.
        schema_name: String,
        /// Struct and field that use it.
        field: String,
        /// The type that is not defined.
        type_name: String,
    },
    /// The text of a path does not parse.
    #[error(transparent)]
    Path(#[from] PathError),
    /// A path names a field that the type does not have.
    #[error("{topic:?} has no field {path:?}: {type_name} has no {name:?}, it has {}", list(.present))]
    UnknownField {
        /// Topic of the channel.
        topic: String,
        /// The whole path.
        path: String,
        /// The type that was searched.
        type_name: String,
        /// The name that it does not have.
        name: String,
        /// The names that it has, closest first.
        present: Vec<String>,
    },
    /// A path fits the names but not the shape of the type.
    #[error("path {path:?} does not fit {topic:?}: expected {expected}, got {got}")]
    WrongShape {
        /// Topic of the channel.
        topic: String,
        /// The whole path.
        path: String,
        /// What could stand there, with an example.
        expected: String,
        /// What the path has there.
        got: String,
    },
    /// A path stands for more values than the cap.
    #[error("path {path:?} of {topic:?} stands for more than {limit} values")]
    TooWide {
        /// Topic of the channel.
        topic: String,
        /// The whole path.
        path: String,
        /// The cap.
        limit: usize,
    },
    /// The channel's type is no image that gawm knows.
    #[error("{topic:?} is no image: {detail}")]
    NotAnImage {
        /// Topic of the channel.
        topic: String,
        /// What its type lacks.
        detail: String,
    },
}

/// Why one message cannot be decoded. Costs that message alone.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum DecodeError {
    /// The payload ends before the value that the schema says comes next.
    #[error("message ends too early: expected {needed} bytes at offset {offset}, got {available}")]
    Truncated {
        /// Offset in the payload.
        offset: usize,
        /// Bytes that were needed there.
        needed: u64,
        /// Bytes that were left.
        available: usize,
    },
    /// The payload goes on, with content, after all that the schema describes.
    #[error("message does not fit its schema: {surplus} bytes follow its end at offset {offset}")]
    TrailingBytes {
        /// Offset in the payload at which the schema's last field ends.
        offset: usize,
        /// Bytes after it.
        surplus: usize,
    },
    /// The CDR encapsulation header names a representation that is not XCDR1.
    #[error("unsupported CDR encapsulation {id:#06x} ({name}): expected 0x0000 or 0x0001 (XCDR1)")]
    UnsupportedCdr {
        /// Representation identifier.
        id: u16,
        /// Its name in the DDS standard.
        name: &'static str,
    },
    /// Bytes that the encoding does not allow.
    #[error("invalid {encoding} at offset {offset}: {detail}")]
    Malformed {
        /// The message encoding.
        encoding: &'static str,
        /// Offset in the payload.
        offset: usize,
        /// What is wrong.
        detail: String,
    },
    /// A mapped field is not in this message.
    #[error("{path:?} is not set in this message{}", present_list(.present))]
    FieldAbsent {
        /// Path of the field.
        path: String,
        /// Names that are there in its place, where that is known.
        present: Vec<String>,
    },
    /// A value is of another type than the mapping needs.
    #[error("{path:?}: expected {expected}, got {got}")]
    WrongType {
        /// Path of the field.
        path: String,
        /// What was needed.
        expected: &'static str,
        /// What is there.
        got: String,
    },
    /// An element is asked for that this message's array does not have.
    #[error("{path:?}: the array has {length} elements")]
    IndexOutOfRange {
        /// Path of the element.
        path: String,
        /// Length of the array in this message.
        length: usize,
    },
    /// A name that picks from parallel arrays is not in this message.
    #[error("{path:?}: no {name:?} in this message, which has {}", list(.present))]
    NameAbsent {
        /// Path of the element.
        path: String,
        /// The name that was looked for.
        name: String,
        /// The names in this message (the first 64).
        present: Vec<String>,
    },
    /// A message holds some of the structs that paths pick by name, and lacks others.
    #[error(
        "{path:?}: {found} of the {wanted} elements that the stream picks are in this message (those that come apart need streams of their own)"
    )]
    ElementsAbsent {
        /// The first of the paths.
        path: String,
        /// Elements that are there.
        found: u32,
        /// Elements that are picked.
        wanted: u32,
    },
    /// Parallel arrays differ in length.
    #[error("{path:?}: the array has {values} elements, its names {names}")]
    LengthMismatch {
        /// Path of the element.
        path: String,
        /// Elements of the array of names.
        names: usize,
        /// Elements of the array of values.
        values: usize,
    },
    /// A text was mapped to a numeric feature.
    #[error("{path:?} is text: expected a number")]
    NotNumeric {
        /// Path of the field.
        path: String,
    },
    /// The schema cannot be compiled (only from the functions that take a channel).
    #[error(transparent)]
    Compile(#[from] CompileError),
}

impl DecodeError {
    /// Returns a short stable name of the reason, as reports list it.
    pub fn reason(&self) -> &'static str {
        match self {
            Self::Truncated { .. } => "message_truncated",
            Self::TrailingBytes { .. } => "message_longer_than_schema",
            Self::UnsupportedCdr { .. } => "unsupported_cdr_encapsulation",
            Self::Malformed { .. } => "malformed_message",
            Self::FieldAbsent { .. } => "field_absent",
            Self::WrongType { .. } => "wrong_type",
            Self::IndexOutOfRange { .. } => "index_out_of_range",
            Self::NameAbsent { .. } | Self::ElementsAbsent { .. } => "name_absent",
            Self::LengthMismatch { .. } => "array_length_mismatch",
            Self::NotNumeric { .. } => "not_numeric",
            Self::Compile(_) => "schema_not_decodable",
        }
    }
}

/// Joins names for a message, at most 40 of them.
fn list(names: &[String]) -> String {
    const MOST: usize = 40;
    if names.is_empty() {
        return "none".to_owned();
    }
    let shown: Vec<String> = names.iter().take(MOST).map(|n| format!("{n:?}")).collect();
    let rest = names.len().saturating_sub(MOST);
    let more = if rest > 0 { format!(" and {rest} more") } else { String::new() };
    format!("{}{more}", shown.join(", "))
}

fn present_list(names: &[String]) -> String {
    if names.is_empty() { String::new() } else { format!(", which has {}", list(names)) }
}
