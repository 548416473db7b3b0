//! Turns payloads of some encodings into those of another, which the decoders read: XCDR2 into XCDR1, CBOR and
//! FlatBuffers into JSON.
//!
//! This costs a pass more than decoding directly; these encodings are rare in logs of robots.

mod cbor;
mod cdr2;
pub(crate) mod flatbuffer;

use std::borrow::Cow;
use std::sync::Arc;

use super::error::DecodeError;
use super::schema::TypeTable;

/// How the payloads of one channel are turned into what its decoder reads.
#[derive(Clone, Debug)]
pub(crate) enum Transcoder {
    /// CDR: messages whose header says XCDR2 become XCDR1, the others stay.
    Cdr2(Arc<TypeTable>),
    /// CBOR becomes JSON.
    Cbor,
    /// FlatBuffers of a type become JSON.
    Flatbuffer(Arc<flatbuffer::Reflection>),
}

impl Transcoder {
    /// Turns one payload.
    pub(crate) fn apply<'a>(&self, payload: &'a [u8]) -> Result<Cow<'a, [u8]>, DecodeError> {
        match self {
            Self::Cdr2(types) => match cdr2::Encapsulation::of(payload) {
                None => Ok(Cow::Borrowed(payload)),
                Some(encapsulation) => cdr2::to_xcdr1(types, encapsulation, payload).map(Cow::Owned),
            },
            Self::Cbor => cbor::to_json(payload).map(Cow::Owned),
            Self::Flatbuffer(reflection) => flatbuffer::to_json(reflection, payload).map(Cow::Owned),
        }
    }
}

/// Appends bytes as base64 in quotes, as JSON has them.
fn push_base64(bytes: &[u8], out: &mut Vec<u8>) {
    use base64::Engine as _;
    out.push(b'"');
    out.extend_from_slice(base64::engine::general_purpose::STANDARD.encode(bytes).as_bytes());
    out.push(b'"');
}

/// Appends a text as JSON has it.
fn push_json_text(text: &str, out: &mut Vec<u8>) {
    out.push(b'"');
    for char in text.chars() {
        match char {
            '"' => out.extend_from_slice(b"\\\""),
            '\\' => out.extend_from_slice(b"\\\\"),
            control if (control as u32) < 0x20 => {
                out.extend_from_slice(format!("\\u{:04x}", control as u32).as_bytes());
            }
            other => out.extend_from_slice(other.encode_utf8(&mut [0; 4]).as_bytes()),
        }
    }
    out.push(b'"');
}

/// Appends a float; the decoder knows `NaN` and `Infinity`.
fn push_json_float(value: f64, out: &mut Vec<u8>) {
    let text = if value.is_nan() {
        "NaN".to_owned()
    } else if value.is_infinite() {
        if value > 0.0 { "Infinity".to_owned() } else { "-Infinity".to_owned() }
    } else {
        // The shortest text that reads back as the same number.
        format!("{value:?}")
    };
    out.extend_from_slice(text.as_bytes());
}
