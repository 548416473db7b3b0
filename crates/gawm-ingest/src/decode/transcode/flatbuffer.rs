//! FlatBuffers into JSON, by the reflection schema (`.bfbs`) that a channel carries.

use super::super::error::DecodeError;
use super::super::schema::{Base, Field as SchemaField, Many, Prim, StructType, TypeTable, Wire};
use super::{push_base64, push_json_float, push_json_text};

/// Most tables, structs and fields of a schema.
const MAX_FIELDS: usize = 50_000;
/// Deepest nesting of a message.
const MAX_DEPTH: usize = 64;
/// A message may not become more than this many times its own size, and this much besides: tables can be shared.
const MAX_GROWTH: usize = 64;

/// The types of a reflection schema.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Reflection {
    objects: Vec<Object>,
    root: usize,
}

#[derive(Clone, Debug, PartialEq)]
struct Object {
    name: String,
    is_struct: bool,
    fields: Vec<Field>,
}

#[derive(Clone, Debug, PartialEq)]
struct Field {
    name: String,
    kind: Kind,
    /// Offset in the vtable, or within a struct.
    offset: u16,
    default_integer: i64,
    default_real: f64,
    /// Absence is no value.
    is_optional: bool,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Kind {
    Scalar(Scalar),
    Text,
    Object(usize),
    Scalars(Scalar),
    Texts,
    Objects(usize),
    /// An array of scalars within a struct.
    FixedScalars(Scalar, u16),
    /// Unions, arrays of structs and the like, which are left out.
    Other,
}

#[derive(Clone, Copy, Debug, PartialEq)]
enum Scalar {
    Bool,
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    I64,
    U64,
    F32,
    F64,
}

impl Scalar {
    fn of(base_type: u8) -> Option<Scalar> {
        Some(match base_type {
            1 | 4 => Scalar::U8,
            2 => Scalar::Bool,
            3 => Scalar::I8,
            5 => Scalar::I16,
            6 => Scalar::U16,
            7 => Scalar::I32,
            8 => Scalar::U32,
            9 => Scalar::I64,
            10 => Scalar::U64,
            11 => Scalar::F32,
            12 => Scalar::F64,
            _ => return None,
        })
    }

    fn prim(self) -> Prim {
        match self {
            Scalar::Bool => Prim::Bool,
            Scalar::I8 => Prim::I8,
            Scalar::U8 => Prim::U8,
            Scalar::I16 => Prim::I16,
            Scalar::U16 => Prim::U16,
            Scalar::I32 => Prim::I32,
            Scalar::U32 => Prim::U32,
            Scalar::I64 => Prim::I64,
            Scalar::U64 => Prim::U64,
            Scalar::F32 => Prim::F32,
            Scalar::F64 => Prim::F64,
        }
    }

    fn size(self) -> usize {
        match self {
            Scalar::Bool | Scalar::I8 | Scalar::U8 => 1,
            Scalar::I16 | Scalar::U16 => 2,
            Scalar::I32 | Scalar::U32 | Scalar::F32 => 4,
            Scalar::I64 | Scalar::U64 | Scalar::F64 => 8,
        }
    }
}

/// Bytes that are read by checked offsets.
#[derive(Clone, Copy)]
struct Buffer<'a>(&'a [u8]);

impl<'a> Buffer<'a> {
    fn array<const N: usize>(self, at: usize) -> Option<[u8; N]> {
        self.0.get(at..)?.first_chunk::<N>().copied()
    }

    fn u16(self, at: usize) -> Option<u16> {
        self.array(at).map(u16::from_le_bytes)
    }

    fn u32(self, at: usize) -> Option<u32> {
        self.array(at).map(u32::from_le_bytes)
    }

    /// Follows the offset at a place.
    fn follow(self, at: usize) -> Option<usize> {
        let to = at.checked_add(usize::try_from(self.u32(at)?).ok()?)?;
        (to < self.0.len()).then_some(to)
    }

    fn table(self, at: usize) -> Option<Table<'a>> {
        let back = i32::from_le_bytes(self.array(at)?);
        let vtable = usize::try_from(i64::try_from(at).ok()?.checked_sub(i64::from(back))?).ok()?;
        let size = usize::from(self.u16(vtable)?);
        (size >= 4 && self.0.get(vtable..vtable.checked_add(size)?).is_some()).then_some(Table {
            buffer: self,
            at,
            vtable,
            size,
        })
    }

    fn text(self, at: usize) -> Option<&'a str> {
        std::str::from_utf8(self.vector(at, 1)?.1).ok()
    }

    /// Returns the number of elements of a vector, and its bytes.
    fn vector(self, at: usize, element: usize) -> Option<(usize, &'a [u8])> {
        let count = usize::try_from(self.u32(at)?).ok()?;
        let start = at.checked_add(4)?;
        let bytes = self.0.get(start..start.checked_add(count.checked_mul(element)?)?)?;
        Some((count, bytes))
    }
}

#[derive(Clone, Copy)]
struct Table<'a> {
    buffer: Buffer<'a>,
    at: usize,
    vtable: usize,
    size: usize,
}

impl<'a> Table<'a> {
    /// Returns where a field lies, by its offset in the vtable.
    fn slot(self, offset: usize) -> Option<usize> {
        if offset.checked_add(2)? > self.size {
            return None;
        }
        match self.buffer.u16(self.vtable + offset)? {
            0 => None,
            inside => self.at.checked_add(usize::from(inside)),
        }
    }

    /// Returns where field number `id` of a schema table lies.
    fn field(self, id: usize) -> Option<usize> {
        self.slot(4 + 2 * id)
    }

    fn text(self, id: usize) -> Option<&'a str> {
        self.buffer.text(self.buffer.follow(self.field(id)?)?)
    }

    fn byte(self, id: usize) -> u8 {
        self.field(id).and_then(|at| self.buffer.array::<1>(at)).map_or(0, |[byte]| byte)
    }

    /// Returns the tables of a vector.
    fn tables(self, id: usize) -> Option<Vec<Table<'a>>> {
        let Some(slot) = self.field(id) else { return Some(Vec::new()) };
        let at = self.buffer.follow(slot)?;
        let (count, _) = self.buffer.vector(at, 4)?;
        if count > MAX_FIELDS {
            return None;
        }
        (0..count).map(|index| self.buffer.table(self.buffer.follow(at + 4 + 4 * index)?)).collect()
    }
}

impl Reflection {
    /// Reads a reflection schema; `name` is the message's type.
    pub(crate) fn parse(name: &str, schema: &[u8]) -> Result<Self, String> {
        let bad =
            || "expected a FlatBuffers reflection schema (.bfbs), got other or damaged bytes".to_owned();
        if schema.get(4..8) != Some(b"BFBS") {
            return Err(bad());
        }
        let buffer = Buffer(schema);
        let table = buffer.follow(0).and_then(|at| buffer.table(at)).ok_or_else(bad)?;
        let tables = table.tables(0).ok_or_else(bad)?;
        let mut n_fields = 0;
        let mut objects = Vec::with_capacity(tables.len());
        for object in &tables {
            let fields = object.tables(1).ok_or_else(bad)?;
            n_fields += fields.len();
            if n_fields > MAX_FIELDS {
                return Err(format!("expected at most {MAX_FIELDS} fields, got more"));
            }
            let mut read: Vec<Field> = fields
                .iter()
                .map(|field| parse_field(*field, tables.len()).ok_or_else(bad))
                .collect::<Result<_, _>>()?;
            // The schema sorts by name; the order of declaration is that of the offsets.
            read.sort_by_key(|field| field.offset);
            objects.push(Object {
                name: object.text(0).ok_or_else(bad)?.to_owned(),
                is_struct: object.byte(2) != 0,
                fields: read,
            });
        }
        let root = objects.iter().position(|object| object.name == name).or_else(|| {
            let declared =
                table.field(4).and_then(|slot| buffer.follow(slot)).and_then(|at| buffer.table(at))?;
            let declared = declared.text(0)?;
            objects.iter().position(|object| object.name == declared)
        });
        let root = root.ok_or_else(|| format!("the schema has no table {name:?}"))?;
        Ok(Reflection { objects, root })
    }
}

/// Whether a type is in the table.
#[derive(Clone, Copy)]
enum Place {
    New,
    Open,
    Done(usize),
}

impl Reflection {
    /// Returns the types that it declares, as far as they do not hold themselves.
    pub(crate) fn type_table(&self) -> TypeTable {
        let mut table = TypeTable::default();
        let mut places = vec![Place::New; self.objects.len()];
        table.root = self.add_type(self.root, &mut table.structs, &mut places, 0).unwrap_or_default();
        if table.structs.is_empty() {
            table.structs.push(StructType::default());
        }
        table
    }

    /// Adds a type after those it uses; a type that holds itself, or is too much, is left out.
    fn add_type(
        &self,
        index: usize,
        out: &mut Vec<StructType>,
        places: &mut [Place],
        depth: usize,
    ) -> Option<usize> {
        match places[index] {
            Place::Done(at) => return Some(at),
            Place::Open => return None,
            Place::New if depth > MAX_DEPTH => return None,
            Place::New => places[index] = Place::Open,
        }
        let mut fields = Vec::new();
        for field in &self.objects[index].fields {
            let (base, many) = match field.kind {
                Kind::Scalar(scalar) => (Some(Base::Prim(scalar.prim())), Many::One),
                Kind::Text => (Some(Base::Prim(Prim::Text)), Many::One),
                Kind::Object(inner) => {
                    (self.add_type(inner, out, places, depth + 1).map(Base::Struct), Many::One)
                }
                Kind::Scalars(Scalar::U8) => (Some(Base::Prim(Prim::Bytes)), Many::One),
                Kind::Scalars(scalar) => (Some(Base::Prim(scalar.prim())), Many::Dynamic),
                Kind::Texts => (Some(Base::Prim(Prim::Text)), Many::Dynamic),
                Kind::Objects(inner) => {
                    (self.add_type(inner, out, places, depth + 1).map(Base::Struct), Many::Dynamic)
                }
                Kind::FixedScalars(scalar, n) => {
                    (Some(Base::Prim(scalar.prim())), Many::Fixed(usize::from(n)))
                }
                Kind::Other => (None, Many::One),
            };
            if let Some(base) = base {
                fields.push(SchemaField { name: field.name.clone(), base, many, wire: Wire::default() });
            }
        }
        places[index] = Place::Done(out.len());
        out.push(StructType { name: self.objects[index].name.clone(), fields, ..StructType::default() });
        Some(out.len() - 1)
    }
}

fn parse_field(field: Table<'_>, n_objects: usize) -> Option<Field> {
    let buffer = field.buffer;
    let kind = buffer.table(buffer.follow(field.field(1)?)?)?;
    let (base, element) = (kind.byte(0), kind.byte(1));
    let index = kind.field(2).and_then(|at| buffer.array(at)).map_or(-1, i32::from_le_bytes);
    let object = usize::try_from(index).ok().filter(|index| *index < n_objects);
    let fixed = kind.field(3).and_then(|at| buffer.u16(at)).unwrap_or(0);
    let kind = match base {
        13 => Kind::Text,
        15 => object.map_or(Kind::Other, Kind::Object),
        14 => match (element, Scalar::of(element), object) {
            (13, ..) => Kind::Texts,
            (15, _, Some(object)) => Kind::Objects(object),
            (_, Some(scalar), _) => Kind::Scalars(scalar),
            _ => Kind::Other,
        },
        17 => Scalar::of(element).map_or(Kind::Other, |scalar| Kind::FixedScalars(scalar, fixed)),
        _ => Scalar::of(base).map_or(Kind::Other, Kind::Scalar),
    };
    let real = field.field(5).and_then(|at| buffer.array(at)).map_or(0.0, f64::from_le_bytes);
    Some(Field {
        name: field.text(0)?.to_owned(),
        kind,
        offset: field.field(3).and_then(|at| buffer.u16(at)).unwrap_or(0),
        default_integer: field.field(4).and_then(|at| buffer.array(at)).map_or(0, i64::from_le_bytes),
        default_real: real,
        is_optional: field.byte(11) != 0,
    })
}

/// Turns one message into JSON: vectors of bytes into base64.
pub(super) fn to_json(reflection: &Reflection, payload: &[u8]) -> Result<Vec<u8>, DecodeError> {
    let buffer = Buffer(payload);
    let mut writer = Writer {
        reflection,
        buffer,
        out: Vec::new(),
        most: payload.len().saturating_mul(MAX_GROWTH).saturating_add(1 << 20),
    };
    let root = buffer.follow(0).ok_or_else(|| writer.malformed(0, "expected an offset to the root table"))?;
    writer.object(reflection.root, root, 0)?;
    Ok(writer.out)
}

struct Writer<'a> {
    reflection: &'a Reflection,
    buffer: Buffer<'a>,
    out: Vec<u8>,
    most: usize,
}

impl Writer<'_> {
    fn malformed(&self, offset: usize, detail: &str) -> DecodeError {
        DecodeError::Malformed { encoding: "flatbuffer", offset, detail: detail.to_owned() }
    }

    fn object(&mut self, index: usize, at: usize, depth: usize) -> Result<(), DecodeError> {
        if depth > MAX_DEPTH {
            return Err(self.malformed(at, "expected at most 64 levels of nesting"));
        }
        if self.out.len() > self.most {
            return Err(
                self.malformed(at, "its tables are shared so often that it would grow without bounds")
            );
        }
        let object = &self.reflection.objects[index];
        let table = match object.is_struct {
            true => None,
            false => {
                let table = self.buffer.table(at);
                Some(table.ok_or_else(|| self.malformed(at, &format!("expected a table {}", object.name)))?)
            }
        };
        self.out.push(b'{');
        let mut is_first = true;
        for field in &object.fields {
            let place = match table {
                None => Some(at + usize::from(field.offset)),
                Some(table) => table.slot(usize::from(field.offset)),
            };
            let start = self.out.len();
            if !std::mem::take(&mut is_first) {
                self.out.push(b',');
            }
            push_json_text(&field.name, &mut self.out);
            self.out.push(b':');
            let is_written = match place {
                Some(place) => self.value(field, place, depth)?,
                None => self.default(field),
            };
            if !is_written {
                self.out.truncate(start);
                is_first = self.out.last() == Some(&b'{');
            }
        }
        self.out.push(b'}');
        Ok(())
    }

    /// Writes what holds when a field is not there; returns whether that is a value.
    fn default(&mut self, field: &Field) -> bool {
        let Kind::Scalar(scalar) = field.kind else { return false };
        if field.is_optional {
            return false;
        }
        match scalar {
            Scalar::F32 | Scalar::F64 => push_json_float(field.default_real, &mut self.out),
            Scalar::Bool => {
                let text: &[u8] = if field.default_integer != 0 { b"true" } else { b"false" };
                self.out.extend_from_slice(text);
            }
            _ => self.out.extend_from_slice(field.default_integer.to_string().as_bytes()),
        }
        true
    }

    fn value(&mut self, field: &Field, at: usize, depth: usize) -> Result<bool, DecodeError> {
        let outside =
            |this: &Self| this.malformed(at, &format!("{} points outside of the message", field.name));
        match field.kind {
            Kind::Scalar(scalar) => self.scalar(scalar, at)?,
            Kind::Text => {
                let text = self.buffer.follow(at).and_then(|at| self.buffer.text(at));
                let text = text.ok_or_else(|| outside(self))?;
                push_json_text(text, &mut self.out);
            }
            Kind::Object(index) => {
                let is_struct = self.reflection.objects[index].is_struct;
                let at = if is_struct { Some(at) } else { self.buffer.follow(at) };
                let at = at.ok_or_else(|| outside(self))?;
                self.object(index, at, depth + 1)?;
            }
            Kind::Scalars(scalar) => {
                let to = self.buffer.follow(at).ok_or_else(|| outside(self))?;
                let (count, bytes) = self.buffer.vector(to, scalar.size()).ok_or_else(|| outside(self))?;
                if scalar == Scalar::U8 {
                    push_base64(bytes, &mut self.out);
                } else {
                    self.scalars(scalar, to + 4, count)?;
                }
            }
            Kind::FixedScalars(scalar, count) => self.scalars(scalar, at, usize::from(count))?,
            Kind::Texts | Kind::Objects(_) => {
                let to = self.buffer.follow(at).ok_or_else(|| outside(self))?;
                self.elements(field.kind, to, depth)
                    .map_err(|error| error.unwrap_or_else(|| outside(self)))?;
            }
            Kind::Other => return Ok(false),
        }
        Ok(true)
    }

    /// Writes a vector of texts, tables or structs; no error to tell: it points outside.
    fn elements(&mut self, kind: Kind, at: usize, depth: usize) -> Result<(), Option<DecodeError>> {
        let struct_size = match kind {
            Kind::Objects(index) if self.reflection.objects[index].is_struct => {
                Some(self.struct_size(index, 0).ok_or(None)?)
            }
            _ => None,
        };
        let (count, _) = self.buffer.vector(at, struct_size.unwrap_or(4).max(1)).ok_or(None)?;
        self.out.push(b'[');
        for index in 0..count {
            if index > 0 {
                self.out.push(b',');
            }
            let place = at + 4 + index * struct_size.unwrap_or(4);
            match (kind, struct_size) {
                (Kind::Objects(object), Some(_)) => self.object(object, place, depth + 1).map_err(Some)?,
                (Kind::Objects(object), None) => {
                    let to = self.buffer.follow(place).ok_or(None)?;
                    self.object(object, to, depth + 1).map_err(Some)?;
                }
                _ => {
                    let text = self.buffer.follow(place).and_then(|at| self.buffer.text(at)).ok_or(None)?;
                    push_json_text(text, &mut self.out);
                }
            }
        }
        self.out.push(b']');
        Ok(())
    }

    /// Returns the size of a struct: up to the end of its last member, padded to its widest.
    fn struct_size(&self, index: usize, depth: usize) -> Option<usize> {
        if depth > MAX_DEPTH {
            return None;
        }
        let (mut end, mut widest) = (0, 1);
        for field in &self.reflection.objects[index].fields {
            let (size, align) = match field.kind {
                Kind::Scalar(scalar) => (scalar.size(), scalar.size()),
                Kind::FixedScalars(scalar, count) => (scalar.size() * usize::from(count), scalar.size()),
                Kind::Object(inner) => {
                    let size = self.struct_size(inner, depth + 1)?;
                    (size, 8.min(size.next_power_of_two()))
                }
                _ => return None,
            };
            end = end.max(usize::from(field.offset) + size);
            widest = widest.max(align.min(8));
        }
        Some(end.next_multiple_of(widest))
    }

    fn scalars(&mut self, scalar: Scalar, at: usize, count: usize) -> Result<(), DecodeError> {
        self.out.push(b'[');
        for index in 0..count {
            if index > 0 {
                self.out.push(b',');
            }
            self.scalar(scalar, at + index * scalar.size())?;
        }
        self.out.push(b']');
        Ok(())
    }

    fn scalar(&mut self, scalar: Scalar, at: usize) -> Result<(), DecodeError> {
        let buffer = self.buffer;
        let out = &mut self.out;
        let mut integer = |value: i128| out.extend_from_slice(value.to_string().as_bytes());
        let written = match scalar {
            Scalar::I8 => buffer.array(at).map(|b| integer(i8::from_le_bytes(b).into())),
            Scalar::U8 => buffer.array(at).map(|b| integer(u8::from_le_bytes(b).into())),
            Scalar::I16 => buffer.array(at).map(|b| integer(i16::from_le_bytes(b).into())),
            Scalar::U16 => buffer.array(at).map(|b| integer(u16::from_le_bytes(b).into())),
            Scalar::I32 => buffer.array(at).map(|b| integer(i32::from_le_bytes(b).into())),
            Scalar::U32 => buffer.array(at).map(|b| integer(u32::from_le_bytes(b).into())),
            Scalar::I64 => buffer.array(at).map(|b| integer(i64::from_le_bytes(b).into())),
            Scalar::U64 => buffer.array(at).map(|b| integer(u64::from_le_bytes(b).into())),
            Scalar::F32 => buffer.array(at).map(|b| push_json_float(f32::from_le_bytes(b).into(), out)),
            Scalar::F64 => buffer.array(at).map(|b| push_json_float(f64::from_le_bytes(b), out)),
            Scalar::Bool => buffer.array::<1>(at).map(|[b]| {
                out.extend_from_slice(if b != 0 { b"true" } else { b"false" });
            }),
        };
        written.ok_or_else(|| self.malformed(at, "a value points outside of the message"))
    }
}
