//! CBOR into JSON.

use ciborium::Value;

use super::super::error::DecodeError;
use super::{push_base64, push_json_float, push_json_text};

/// Deepest nesting.
const MAX_DEPTH: usize = 100;

/// Turns one CBOR item into JSON: byte strings into base64, tags into what they tag.
pub(super) fn to_json(payload: &[u8]) -> Result<Vec<u8>, DecodeError> {
    let mut rest = payload;
    let value: Value = ciborium::de::from_reader_with_recursion_limit(&mut rest, MAX_DEPTH)
        .map_err(|error| malformed(payload.len() - rest.len(), error.to_string()))?;
    if !rest.is_empty() {
        return Err(DecodeError::TrailingBytes { offset: payload.len() - rest.len(), surplus: rest.len() });
    }
    let mut out = Vec::with_capacity(payload.len() * 2);
    push(&value, &mut out)?;
    Ok(out)
}

fn malformed(offset: usize, detail: String) -> DecodeError {
    DecodeError::Malformed { encoding: "cbor", offset, detail }
}

fn push(value: &Value, out: &mut Vec<u8>) -> Result<(), DecodeError> {
    match value {
        Value::Null => out.extend_from_slice(b"null"),
        Value::Bool(flag) => out.extend_from_slice(if *flag { b"true" } else { b"false" }),
        Value::Integer(number) => out.extend_from_slice(i128::from(*number).to_string().as_bytes()),
        Value::Float(number) => push_json_float(*number, out),
        Value::Text(text) => push_json_text(text, out),
        Value::Bytes(bytes) => push_base64(bytes, out),
        Value::Tag(_, tagged) => push(tagged, out)?,
        Value::Array(items) => {
            out.push(b'[');
            for (index, item) in items.iter().enumerate() {
                if index > 0 {
                    out.push(b',');
                }
                push(item, out)?;
            }
            out.push(b']');
        }
        Value::Map(entries) => {
            out.push(b'{');
            for (index, (key, item)) in entries.iter().enumerate() {
                if index > 0 {
                    out.push(b',');
                }
                match key {
                    Value::Text(text) => push_json_text(text, out),
                    Value::Integer(number) => push_json_text(&i128::from(*number).to_string(), out),
                    _ => {
                        return Err(malformed(
                            0,
                            "expected text or an integer as the key of a map".to_owned(),
                        ));
                    }
                }
                out.push(b':');
                push(item, out)?;
            }
            out.push(b'}');
        }
        _ => return Err(malformed(0, "an item of an unknown kind".to_owned())),
    }
    Ok(())
}
