//! CBOR into JSON.

use ciborium::Value;

use super::super::error::DecodeError;
use super::{push_base64, push_json_float, push_json_text};
use crate::tabular::f32_from_f16;

/// Deepest nesting.
const MAX_DEPTH: usize = 100;

/// Turns one CBOR item into JSON: byte strings into base64, typed arrays into arrays, other tags into what they tag.
pub(super) fn to_json(payload: &[u8]) -> Result<Vec<u8>, DecodeError> {
    let mut rest = payload;
    let read = ciborium::de::from_reader_with_recursion_limit(&mut rest, MAX_DEPTH);
    let value: Value = read.map_err(|error| {
        let offset = payload.len() - rest.len();
        match error {
            ciborium::de::Error::Io(_) => malformed(offset, "the message ends within an item".to_owned()),
            ciborium::de::Error::Syntax(at) => malformed(at, "expected a CBOR item".to_owned()),
            ciborium::de::Error::RecursionLimitExceeded => {
                malformed(offset, format!("expected at most {MAX_DEPTH} items in each other"))
            }
            other => malformed(offset, other.to_string()),
        }
    })?;
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

/// The numbers of a typed array (RFC 8746). Arrays of bytes stay byte strings, as images are.
#[derive(Clone, Copy)]
struct Element {
    is_float: bool,
    is_signed: bool,
    is_little: bool,
    size: usize,
}

impl Element {
    /// Tells the numbers that a tag stands for: its bits are `010`, float, signed, little-endian and the size.
    fn of(tag: u64) -> Option<Self> {
        const RESERVED: u64 = 76;
        if !(64..=87).contains(&tag) || tag == RESERVED {
            return None;
        }
        let is_float = tag & 16 != 0;
        let element = Self {
            is_float,
            is_signed: tag & 8 != 0,
            is_little: tag & 4 != 0,
            size: 1 << ((tag & 3) + u64::from(is_float)),
        };
        let is_bytes = element.size == 1 && !element.is_signed;
        (!is_bytes && element.size <= 8).then_some(element)
    }

    fn push(self, bytes: &[u8], out: &mut Vec<u8>) {
        let mut wide = [0; 8];
        for (to, from) in wide.iter_mut().zip(bytes) {
            *to = *from;
        }
        let bits = match self.is_little {
            true => u64::from_le_bytes(wide),
            false => u64::from_be_bytes(wide) >> (64 - 8 * self.size),
        };
        if self.is_float {
            let value = match self.size {
                2 => f64::from(f32_from_f16(bits as u16)),
                4 => f64::from(f32::from_bits(bits as u32)),
                _ => f64::from_bits(bits),
            };
            return push_json_float(value, out);
        }
        let unused = 64 - 8 * self.size;
        let text = match self.is_signed {
            true => ((bits << unused) as i64 >> unused).to_string(),
            false => bits.to_string(),
        };
        out.extend_from_slice(text.as_bytes());
    }
}

fn push_typed(element: Element, bytes: &[u8], out: &mut Vec<u8>) -> Result<(), DecodeError> {
    if !bytes.len().is_multiple_of(element.size) {
        let detail = format!("expected whole numbers of {} bytes, got {} bytes", element.size, bytes.len());
        return Err(malformed(0, detail));
    }
    out.push(b'[');
    for (index, number) in bytes.chunks_exact(element.size).enumerate() {
        if index > 0 {
            out.push(b',');
        }
        element.push(number, out);
    }
    out.push(b']');
    Ok(())
}

fn push(value: &Value, out: &mut Vec<u8>) -> Result<(), DecodeError> {
    match value {
        Value::Null => out.extend_from_slice(b"null"),
        Value::Bool(flag) => out.extend_from_slice(if *flag { b"true" } else { b"false" }),
        Value::Integer(number) => out.extend_from_slice(i128::from(*number).to_string().as_bytes()),
        Value::Float(number) => push_json_float(*number, out),
        Value::Text(text) => push_json_text(text, out),
        Value::Bytes(bytes) => push_base64(bytes, out),
        Value::Tag(tag, tagged) => match (Element::of(*tag), tagged.as_ref()) {
            (Some(element), Value::Bytes(bytes)) => push_typed(element, bytes, out)?,
            _ => push(tagged, out)?,
        },
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
