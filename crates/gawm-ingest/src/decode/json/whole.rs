//! Whole JSON messages, for people.

use serde_json::{Map, Value};

use super::super::error::DecodeError;
use super::super::to_json::number_to_json;
use super::scan::Scan;

/// Deepest nesting that is shown.
const MAX_DEPTH: usize = 100;

/// Reads a message; of each array at most `max_items` elements are kept.
pub(crate) fn to_json(payload: &[u8], max_items: usize) -> Result<Value, DecodeError> {
    let mut scan = Scan::new(payload);
    let value = value(&mut scan, max_items, 0)?;
    scan.end()?;
    Ok(value)
}

fn value(scan: &mut Scan<'_>, max_items: usize, depth: usize) -> Result<Value, DecodeError> {
    if depth > MAX_DEPTH {
        return Err(scan.malformed("at most 100 levels of nesting"));
    }
    match scan.peek() {
        b'{' => {
            let mut object = Map::new();
            let mut more = scan.open(b'{', b'}', "an object")?;
            while more {
                let key = scan.key()?.into_owned();
                object.insert(key, value(scan, max_items, depth + 1)?);
                more = scan.more(b'}')?;
            }
            Ok(Value::Object(object))
        }
        b'[' => {
            let mut items = Vec::new();
            let mut dropped = 0_usize;
            let mut more = scan.open(b'[', b']', "an array")?;
            while more {
                if items.len() < max_items {
                    items.push(value(scan, max_items, depth + 1)?);
                } else {
                    scan.skip()?;
                    dropped += 1;
                }
                more = scan.more(b']')?;
            }
            if dropped > 0 {
                items.push(Value::String(format!("... {dropped} more")));
            }
            Ok(Value::Array(items))
        }
        b'"' => Ok(Value::String(scan.string()?.into_owned())),
        b't' if scan.literal("true") => Ok(Value::Bool(true)),
        b'f' if scan.literal("false") => Ok(Value::Bool(false)),
        b'n' if scan.literal("null") => Ok(Value::Null),
        _ => Ok(number_to_json(scan.number()?)),
    }
}
