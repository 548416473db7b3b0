//! Whole messages as JSON: for `explain`, markers and task texts.

use std::borrow::Cow;

use serde_json::Value;

use super::channel::{ChannelSchema, Encoding, SchemaLibrary, Types};
use super::error::DecodeError;
use super::row::Number;
use super::{json, protobuf, ros};

/// Decodes a whole message.
///
/// Field order is the schema's. Bytes become arrays of numbers (ROS) or base64 text (protobuf). Numbers that JSON does not
/// have become the texts `"NaN"`, `"Infinity"` and `"-Infinity"`.
///
/// # Errors
/// A [`DecodeError`]; [`DecodeError::Compile`] if the channel cannot be decoded at all.
pub fn decode_to_json(
    channel: &ChannelSchema<'_>,
    payload: &[u8],
    library: &SchemaLibrary,
) -> Result<Value, DecodeError> {
    decode_to_json_limited(channel, payload, library, usize::MAX)
}

/// Decodes a whole message and keeps at most `max_items` elements of each array; a text tells how many more there were.
///
/// # Errors
/// As [`decode_to_json`].
pub fn decode_to_json_limited(
    channel: &ChannelSchema<'_>,
    payload: &[u8],
    library: &SchemaLibrary,
    max_items: usize,
) -> Result<Value, DecodeError> {
    let Types { encoding, table, descriptor, transcoder } = library.types(channel)?;
    let payload = match &transcoder {
        Some(transcoder) => transcoder.apply(payload)?,
        None => Cow::Borrowed(payload),
    };
    let payload = payload.as_ref();
    match encoding {
        Encoding::Cdr => ros::whole::cdr_to_json(&table, payload, max_items),
        Encoding::Ros1 => ros::whole::ros1_to_json(&table, payload, max_items),
        Encoding::Protobuf => protobuf::whole::to_json(descriptor.as_ref(), payload, max_items),
        Encoding::Json => json::whole::to_json(payload, max_items),
    }
}

/// Turns a number into JSON.
pub(crate) fn number_to_json(number: Number) -> Value {
    match number {
        Number::I64(v) => Value::from(v),
        Number::U64(v) => Value::from(v),
        Number::Bool(v) => Value::Bool(v),
        Number::F64(v) => float_to_json(v),
    }
}

/// Turns a float into JSON, which has no NaN and no infinities.
pub(crate) fn float_to_json(value: f64) -> Value {
    if let Some(number) = serde_json::Number::from_f64(value) {
        return Value::Number(number);
    }
    let text = if value.is_nan() {
        "NaN"
    } else if value > 0.0 {
        "Infinity"
    } else {
        "-Infinity"
    };
    Value::String(text.to_owned())
}
