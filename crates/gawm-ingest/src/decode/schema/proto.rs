//! Protobuf descriptor sets as [`TypeTable`]s.

use std::collections::HashMap;

use prost_reflect::prost::Message as _;
use prost_reflect::prost_types::FileDescriptorSet;
use prost_reflect::{Cardinality, DescriptorPool, FieldDescriptor, Kind, MessageDescriptor, Value};

use super::{Base, Field, Many, Prim, StructType, TypeTable, Wire};

/// Most messages of one schema.
const MAX_MESSAGES: usize = 10_000;

/// Finds the message `name` in a serialized `FileDescriptorSet`.
pub(crate) fn message_descriptor(name: &str, data: &[u8]) -> Result<MessageDescriptor, String> {
    let pool = open_pool(data)?;
    let wanted = name.trim_start_matches('.');
    if let Some(found) = pool.get_message_by_name(wanted) {
        return Ok(found);
    }
    let mut names: Vec<String> = pool.all_messages().map(|m| m.full_name().to_owned()).collect();
    names.sort();
    Err(format!("it does not define message {wanted:?}; it defines {}", names.join(", ")))
}

/// Opens a descriptor set. The library has checks of its own that index out of bounds on some damaged sets (0.16.5, when it
/// reports a fault of a file that it has not stored yet): the common case is met before it, the others are caught.
fn open_pool(data: &[u8]) -> Result<DescriptorPool, String> {
    let wrap = |e: &dyn std::fmt::Display| format!("not a usable FileDescriptorSet: {e}");
    let set = FileDescriptorSet::decode(data).map_err(|e| wrap(&e))?;
    for file in &set.file {
        if !matches!(file.syntax(), "" | "proto2" | "proto3") {
            return Err(format!(
                "{:?} has syntax {:?}: expected proto2 or proto3",
                file.name(),
                file.syntax()
            ));
        }
    }
    match std::panic::catch_unwind(|| DescriptorPool::decode(data)) {
        Ok(pool) => pool.map_err(|e| wrap(&e)),
        Err(_) => Err(wrap(&"it contradicts itself")),
    }
}

/// Turns a message and all that it refers to into a type table.
pub(crate) fn type_table(root: &MessageDescriptor) -> Result<TypeTable, String> {
    let mut table = TypeTable::default();
    let mut known: HashMap<String, usize> = HashMap::new();
    let mut open = vec![root.clone()];
    known.insert(root.full_name().to_owned(), 0);
    table.structs.push(StructType {
        name: root.full_name().to_owned(),
        fields: Vec::new(),
        ..StructType::default()
    });
    while let Some(message) = open.pop() {
        let mut fields = Vec::new();
        for field in message.fields() {
            let base = match field.kind() {
                Kind::Message(inner) => {
                    let next = table.structs.len();
                    let index = *known.entry(inner.full_name().to_owned()).or_insert(next);
                    if index == next {
                        table.structs.push(StructType {
                            name: inner.full_name().to_owned(),
                            fields: Vec::new(),
                            ..StructType::default()
                        });
                        open.push(inner);
                    }
                    Base::Struct(index)
                }
                kind => Base::Prim(prim(&kind)),
            };
            fields.push(table_field(&field, base));
        }
        if table.structs.len() > MAX_MESSAGES {
            return Err(format!("expected at most {MAX_MESSAGES} messages"));
        }
        let index = known[message.full_name()];
        table.structs[index].fields = fields;
    }
    Ok(table)
}

fn table_field(field: &FieldDescriptor, base: Base) -> Field {
    let many = if field.cardinality() == Cardinality::Repeated { Many::Dynamic } else { Many::One };
    let kind = field.kind();
    let wire = Wire {
        number: field.number(),
        zigzag: matches!(kind, Kind::Sint32 | Kind::Sint64),
        fixed: matches!(
            kind,
            Kind::Fixed32 | Kind::Fixed64 | Kind::Sfixed32 | Kind::Sfixed64 | Kind::Float | Kind::Double
        ),
        default: absent_value(field),
    };
    Field { name: field.name().to_owned(), base, many, wire }
}

/// Returns what an absent scalar means: proto3 without `optional` leaves defaults out, proto2 may declare one.
fn absent_value(field: &FieldDescriptor) -> Option<f64> {
    let declared = field.field_descriptor_proto().default_value.is_some();
    if matches!(field.kind(), Kind::Message(_)) || (field.supports_presence() && !declared) {
        return None;
    }
    Some(match field.default_value() {
        Value::Bool(v) => f64::from(u8::from(v)),
        Value::I32(v) | Value::EnumNumber(v) => f64::from(v),
        Value::U32(v) => f64::from(v),
        Value::F32(v) => f64::from(v),
        Value::F64(v) => v,
        Value::I64(v) => v as f64,
        Value::U64(v) => v as f64,
        _ => 0.0,
    })
}

fn prim(kind: &Kind) -> Prim {
    match kind {
        Kind::Double => Prim::F64,
        Kind::Float => Prim::F32,
        Kind::Int32 | Kind::Sint32 | Kind::Sfixed32 | Kind::Enum(_) => Prim::I32,
        Kind::Int64 | Kind::Sint64 | Kind::Sfixed64 => Prim::I64,
        Kind::Uint32 | Kind::Fixed32 => Prim::U32,
        Kind::Uint64 | Kind::Fixed64 => Prim::U64,
        Kind::Bool => Prim::Bool,
        Kind::String => Prim::Text,
        Kind::Bytes | Kind::Message(_) => Prim::Bytes,
    }
}
