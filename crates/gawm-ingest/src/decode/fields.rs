//! The fields of a channel as a list of leaves, for suggestions and errors.

use std::borrow::Cow;

use super::channel::{ChannelSchema, Encoding, SchemaLibrary};
use super::error::{CompileError, DecodeError};
use super::json::scan::Scan;
use super::path::{FieldPath, Segment};
use super::row::{Number, Scalar};
use super::schema::{Base, Many, Prim, TypeTable};

/// Most leaves that are listed.
const MAX_FIELDS: usize = 4096;

/// Deepest nesting that is listed; recursive protobuf types end here.
const MAX_DEPTH: usize = 12;

/// One leaf of a channel's type.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FieldInfo {
    /// Path with empty brackets for each array on the way: `transforms[].transform.translation.x`, `position[]`.
    pub path: String,
    /// What it decodes to; `None` for bytes.
    pub scalar: Option<Scalar>,
    /// Name of the type as the schema has it: `float64`, `string`, `bytes`.
    pub type_name: &'static str,
    /// The arrays on the way, outermost first: a length where the schema fixes it.
    pub arrays: Vec<Option<usize>>,
    /// Name of the struct that the leaf belongs to: `geometry_msgs/Vector3`; empty in JSON.
    pub owner: String,
}

/// Lists the leaves of a channel's type, in declaration order.
///
/// A JSON channel lists what its schema declares, nothing without one: see [`sample_fields`].
///
/// # Errors
/// [`CompileError`] if the channel cannot be decoded.
pub fn channel_fields(
    channel: &ChannelSchema<'_>,
    library: &SchemaLibrary,
) -> Result<Vec<FieldInfo>, CompileError> {
    let types = library.types(channel)?;
    let mut out = Vec::new();
    let mut way = Way { table: &types.table, segments: Vec::new(), arrays: Vec::new(), out: &mut out };
    way.structure(types.table.root, 0);
    Ok(out)
}

/// Lists the leaves of a channel's type and, for JSON and what is read as JSON (CBOR, FlatBuffers), those of one message that the schema does not declare.
///
/// # Errors
/// [`DecodeError`] if the channel cannot be decoded or the message is damaged.
pub fn sample_fields(
    channel: &ChannelSchema<'_>,
    payload: &[u8],
    library: &SchemaLibrary,
) -> Result<Vec<FieldInfo>, DecodeError> {
    let mut out = channel_fields(channel, library)?;
    let types = library.types(channel)?;
    if types.encoding == Encoding::Json {
        let mut seen = Vec::new();
        let payload = types.transcoder.as_ref().map_or(Ok(Cow::Borrowed(payload)), |t| t.apply(payload))?;
        let mut scan = Scan::new(&payload);
        sample(&mut scan, &mut Vec::new(), &mut seen, 0)?;
        for field in seen {
            if !out.iter().any(|known| known.path == field.path) {
                out.push(field);
            }
        }
    }
    Ok(out)
}

struct Way<'t, 'o> {
    table: &'t TypeTable,
    segments: Vec<String>,
    arrays: Vec<Option<usize>>,
    out: &'o mut Vec<FieldInfo>,
}

impl Way<'_, '_> {
    fn structure(&mut self, index: usize, depth: usize) {
        if depth > MAX_DEPTH {
            return;
        }
        let table = self.table;
        let item = &table.structs[index];
        for field in &item.fields {
            if self.out.len() >= MAX_FIELDS {
                return;
            }
            let mut segment = FieldPath::from_members([field.name.clone()]).to_string();
            match field.many {
                Many::One => {}
                Many::Fixed(n) => self.arrays.push(Some(n)),
                Many::Dynamic => self.arrays.push(None),
            }
            if field.many != Many::One {
                segment.push_str("[]");
            }
            self.segments.push(segment);
            match field.base {
                Base::Struct(inner) => self.structure(inner, depth + 1),
                Base::Prim(prim) => self.out.push(FieldInfo {
                    path: self.segments.join("."),
                    scalar: scalar(prim),
                    type_name: prim.name(),
                    arrays: self.arrays.clone(),
                    owner: item.name.clone(),
                }),
            }
            self.segments.pop();
            if field.many != Many::One {
                self.arrays.pop();
            }
        }
    }
}

fn scalar(prim: Prim) -> Option<Scalar> {
    Some(match prim {
        Prim::Bool => Scalar::Bool,
        Prim::I8 | Prim::I16 | Prim::I32 | Prim::I64 => Scalar::I64,
        Prim::U8 | Prim::U16 | Prim::U32 | Prim::U64 => Scalar::U64,
        Prim::F32 | Prim::F64 => Scalar::F64,
        Prim::Text | Prim::WideText => Scalar::Text,
        Prim::Bytes => return None,
    })
}

/// Lists the leaves of one JSON value; of an array it looks at the first element.
fn sample(
    scan: &mut Scan<'_>,
    way: &mut Vec<String>,
    out: &mut Vec<FieldInfo>,
    depth: usize,
) -> Result<(), DecodeError> {
    let mut leaf = |scalar: Scalar, type_name: &'static str| {
        let arrays = way.iter().flat_map(|s| s.matches("[]")).map(|_| None).collect();
        out.push(FieldInfo {
            path: way.join("."),
            scalar: Some(scalar),
            type_name,
            arrays,
            owner: String::new(),
        });
    };
    match scan.peek() {
        _ if depth > MAX_DEPTH => scan.skip(),
        b'{' => {
            let mut more = scan.open(b'{', b'}', "an object")?;
            while more {
                let key = scan.key()?.into_owned();
                if out.len() < MAX_FIELDS {
                    way.push(FieldPath::from_segments(vec![Segment::Field(key)]).to_string());
                    sample(scan, way, out, depth + 1)?;
                    way.pop();
                } else {
                    scan.skip()?;
                }
                more = scan.more(b'}')?;
            }
            Ok(())
        }
        b'[' => {
            let mut more = scan.open(b'[', b']', "an array")?;
            let mut is_first = !way.is_empty();
            while more {
                if is_first {
                    if let Some(last) = way.last_mut() {
                        last.push_str("[]");
                    }
                    sample(scan, way, out, depth + 1)?;
                    if let Some(last) = way.last_mut() {
                        last.truncate(last.len().saturating_sub(2));
                    }
                    is_first = false;
                } else {
                    scan.skip()?;
                }
                more = scan.more(b']')?;
            }
            Ok(())
        }
        b'"' => {
            leaf(Scalar::Text, "string");
            scan.skip()
        }
        b't' | b'f' => {
            leaf(Scalar::Bool, "bool");
            scan.skip()
        }
        b'n' => scan.skip(),
        _ => {
            match scan.number()? {
                Number::F64(_) => leaf(Scalar::F64, "float64"),
                _ => leaf(Scalar::F64, "number"),
            }
            Ok(())
        }
    }
}
