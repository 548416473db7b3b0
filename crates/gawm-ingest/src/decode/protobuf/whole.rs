//! Whole protobuf messages as JSON, for people.

use base64::Engine as _;
use prost_reflect::{DynamicMessage, Kind, MapKey, MessageDescriptor, ReflectMessage as _, Value};
use serde_json::{Map, Value as Json};

use super::super::error::DecodeError;
use super::super::row::Number;
use super::super::to_json::{float_to_json, number_to_json};

/// Decodes a message; of each repeated field at most `max_items` elements are kept. Field names are those of the schema.
pub(crate) fn to_json(
    descriptor: Option<&MessageDescriptor>,
    payload: &[u8],
    max_items: usize,
) -> Result<Json, DecodeError> {
    let malformed = |detail: String| DecodeError::Malformed { encoding: "protobuf", offset: 0, detail };
    let Some(descriptor) = descriptor else { return Err(malformed("the schema is missing".to_owned())) };
    let message =
        DynamicMessage::decode(descriptor.clone(), payload).map_err(|e| malformed(e.to_string()))?;
    Ok(message_to_json(&message, max_items))
}

fn message_to_json(message: &DynamicMessage, max_items: usize) -> Json {
    let mut object = Map::new();
    for field in message.descriptor().fields() {
        if field.supports_presence() && !message.has_field(&field) {
            continue; // Not set, and without a default to show.
        }
        let kind = field.kind();
        object.insert(field.name().to_owned(), value_to_json(&message.get_field(&field), &kind, max_items));
    }
    Json::Object(object)
}

fn value_to_json(value: &Value, kind: &Kind, max_items: usize) -> Json {
    match value {
        Value::Bool(v) => Json::Bool(*v),
        Value::I32(v) | Value::EnumNumber(v) => number_to_json(Number::I64(i64::from(*v))),
        Value::I64(v) => number_to_json(Number::I64(*v)),
        Value::U32(v) => number_to_json(Number::U64(u64::from(*v))),
        Value::U64(v) => number_to_json(Number::U64(*v)),
        Value::F32(v) => float_to_json(f64::from(*v)),
        Value::F64(v) => float_to_json(*v),
        Value::String(text) => Json::String(text.clone()),
        Value::Bytes(bytes) => Json::String(base64::engine::general_purpose::STANDARD.encode(bytes)),
        Value::Message(inner) => message_to_json(inner, max_items),
        Value::List(items) => {
            let mut out: Vec<Json> =
                items.iter().take(max_items).map(|item| value_to_json(item, kind, max_items)).collect();
            if items.len() > max_items {
                out.push(Json::String(format!("... {} more", items.len() - max_items)));
            }
            Json::Array(out)
        }
        Value::Map(entries) => {
            let mut sorted: Vec<(String, &Value)> =
                entries.iter().map(|(key, v)| (key_text(key), v)).collect();
            sorted.sort_by(|a, b| a.0.cmp(&b.0));
            let value_kind = match kind {
                Kind::Message(entry) if entry.is_map_entry() => entry.map_entry_value_field().kind(),
                other => other.clone(),
            };
            Json::Object(
                sorted.into_iter().map(|(k, v)| (k, value_to_json(v, &value_kind, max_items))).collect(),
            )
        }
    }
}

fn key_text(key: &MapKey) -> String {
    match key {
        MapKey::Bool(v) => v.to_string(),
        MapKey::I32(v) => v.to_string(),
        MapKey::I64(v) => v.to_string(),
        MapKey::U32(v) => v.to_string(),
        MapKey::U64(v) => v.to_string(),
        MapKey::String(v) => v.clone(),
    }
}
