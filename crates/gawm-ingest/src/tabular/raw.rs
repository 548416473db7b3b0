//! From stored bytes to typed values.

use super::column::{Dtype, Values};

/// How one element lies in the file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct RawType {
    /// What it means.
    pub(crate) dtype: Dtype,
    /// Bytes per element, as stored.
    pub(crate) item_bytes: usize,
    /// Most significant byte first.
    pub(crate) big_endian: bool,
    /// How text is stored; `Number` for all else.
    pub(crate) form: RawForm,
}

/// How the bytes of an element are meant.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum RawForm {
    /// A number or truth value.
    Number,
    /// Bytes of UTF-8, padded with NUL.
    NulPadded,
    /// Bytes of UTF-8, padded with spaces.
    SpacePadded,
    /// Code points of four bytes, padded with NUL.
    Ucs4,
    /// A reference into the file's heap.
    HeapReference,
}

/// A value that contradicts its type: the element and what was found.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct BadValue {
    /// Position in the values read.
    pub(crate) element: usize,
    /// Expected and found.
    pub(crate) detail: String,
}

macro_rules! numbers {
    ($variant:ident, $t:ty, $bytes:expr, $big:expr) => {
        Values::$variant(
            $bytes
                .chunks_exact(size_of::<$t>())
                .map(|c| {
                    let mut a = [0; size_of::<$t>()];
                    a.copy_from_slice(c);
                    if $big { <$t>::from_be_bytes(a) } else { <$t>::from_le_bytes(a) }
                })
                .collect(),
        )
    };
}

/// Decodes `bytes`, which hold whole elements of `raw`; heap references are the caller's task.
pub(crate) fn decode(bytes: &[u8], raw: RawType) -> Result<Values, BadValue> {
    let big = raw.big_endian;
    Ok(match raw.dtype {
        Dtype::Bool => Values::Bool(bools(bytes)?),
        Dtype::U8 => Values::U8(bytes.to_vec()),
        Dtype::I8 => numbers!(I8, i8, bytes, big),
        Dtype::U16 => numbers!(U16, u16, bytes, big),
        Dtype::I16 => numbers!(I16, i16, bytes, big),
        Dtype::U32 => numbers!(U32, u32, bytes, big),
        Dtype::I32 => numbers!(I32, i32, bytes, big),
        Dtype::U64 => numbers!(U64, u64, bytes, big),
        Dtype::I64 => numbers!(I64, i64, bytes, big),
        Dtype::F16 => match numbers!(U16, u16, bytes, big) {
            Values::U16(halves) => Values::F32(halves.into_iter().map(f32_from_f16).collect()),
            other => other,
        },
        Dtype::F32 => numbers!(F32, f32, bytes, big),
        Dtype::F64 => numbers!(F64, f64, bytes, big),
        Dtype::Text | Dtype::Unsupported => Values::Text(texts(bytes, raw)?),
    })
}

/// Turns stored numbers into little-endian ones, the form that is hashed.
pub(crate) fn to_little_endian(bytes: &mut [u8], raw: RawType) {
    if raw.big_endian && raw.item_bytes > 1 {
        bytes.chunks_exact_mut(raw.item_bytes).for_each(<[u8]>::reverse);
    }
}

fn bools(bytes: &[u8]) -> Result<Vec<bool>, BadValue> {
    bytes
        .iter()
        .enumerate()
        .map(|(element, &b)| match b {
            0 => Ok(false),
            1 => Ok(true),
            got => Err(BadValue { element, detail: format!("expected a truth value of 0 or 1, got {got}") }),
        })
        .collect()
}

/// Widens an IEEE half; exact for every value.
pub(crate) fn f32_from_f16(half: u16) -> f32 {
    let sign = u32::from(half >> 15) << 31;
    let exponent = u32::from(half >> 10) & 0x1f;
    let fraction = u32::from(half) & 0x3ff;
    match (exponent, fraction) {
        (0, 0) => f32::from_bits(sign),
        // A subnormal half is fraction * 2^-24, which is a normal f32.
        (0, f) => f32::from_bits(sign | (f as f32 * 2f32.powi(-24)).to_bits()),
        (0x1f, f) => f32::from_bits(sign | 0x7f80_0000 | (f << 13)),
        (e, f) => f32::from_bits(sign | ((e + 112) << 23) | (f << 13)),
    }
}

fn texts(bytes: &[u8], raw: RawType) -> Result<Vec<String>, BadValue> {
    if raw.item_bytes == 0 {
        return Ok(Vec::new());
    }
    bytes.chunks_exact(raw.item_bytes).enumerate().map(|(element, item)| text(item, raw, element)).collect()
}

fn text(item: &[u8], raw: RawType, element: usize) -> Result<String, BadValue> {
    match raw.form {
        RawForm::Ucs4 => ucs4(item, raw.big_endian).ok_or_else(|| BadValue {
            element,
            detail: "expected UCS-4 text, got an invalid code point".to_owned(),
        }),
        RawForm::SpacePadded => utf8(item.trim_ascii_end(), element),
        RawForm::NulPadded | RawForm::Number | RawForm::HeapReference => {
            let end = item.iter().position(|&b| b == 0).unwrap_or(item.len());
            utf8(&item[..end], element)
        }
    }
}

/// Checks that bytes are UTF-8.
pub(crate) fn utf8(bytes: &[u8], element: usize) -> Result<String, BadValue> {
    String::from_utf8(bytes.to_vec())
        .map_err(|e| BadValue { element, detail: format!("expected UTF-8 text, got {}", e.utf8_error()) })
}

fn ucs4(item: &[u8], big_endian: bool) -> Option<String> {
    let mut text = String::new();
    for c in item.chunks_exact(4) {
        let bytes = [c[0], c[1], c[2], c[3]];
        let code = if big_endian { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) };
        text.push(char::from_u32(code)?);
    }
    text.truncate(text.trim_end_matches('\0').len());
    Some(text)
}
