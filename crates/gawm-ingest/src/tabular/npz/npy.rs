//! The header of an `.npy` array, parsed strictly.
//!
//! ```text
//! 0  "\x93NUMPY"   6  u8 major (1, 2, 3)   7  u8 minor   8  u16 (u32 from version 2) header bytes, then the header:
//! {'descr': '<f4', 'fortran_order': False, 'shape': (155, 2), }
//! ```
//! Only this dictionary of three keys is taken. Nothing is evaluated, and nothing recurses.

use crate::tabular::column::Dtype;
use crate::tabular::raw::{RawForm, RawType};

/// First bytes of every `.npy` array.
pub(crate) const MAGIC: &[u8; 6] = b"\x93NUMPY";

/// numpy refuses longer headers too (`max_header_size`).
const MAX_HEADER_BYTES: usize = 10_000;
/// numpy's largest rank.
const MAX_RANK: usize = 64;

/// What a header says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct NpyHeader {
    /// How elements are stored, or what they are if they are no column here.
    pub(crate) raw: Result<RawType, Unsupported>,
    /// Extent of every axis.
    pub(crate) shape: Vec<u64>,
    /// First axis varies fastest.
    pub(crate) is_fortran: bool,
    /// Bytes before the data.
    pub(crate) data_offset: u64,
}

/// Elements that are no column here.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Unsupported {
    /// Python objects, pickled.
    Pickled,
    /// Something else, described.
    Type(String),
}

/// Reads the header from the start of an array.
pub(crate) fn read_header(reader: &mut impl std::io::Read) -> Result<NpyHeader, String> {
    let mut prefix = [0; 8];
    reader.read_exact(&mut prefix).map_err(|e| format!("npy header: {e}"))?;
    if !prefix.starts_with(MAGIC) {
        return Err("expected the npy magic, got other bytes".to_owned());
    }
    let len_bytes = match prefix[6] {
        1 => 2,
        2 | 3 => 4,
        major => return Err(format!("npy version {major}: expected 1, 2 or 3")),
    };
    let mut len = [0; 4];
    reader.read_exact(&mut len[..len_bytes]).map_err(|e| format!("npy header: {e}"))?;
    let len = u32::from_le_bytes(len) as usize;
    if len > MAX_HEADER_BYTES {
        return Err(format!("npy header of {len} bytes: expected at most {MAX_HEADER_BYTES}"));
    }
    let mut text = vec![0; len];
    reader.read_exact(&mut text).map_err(|e| format!("npy header: {e}"))?;
    let text = String::from_utf8(text).map_err(|e| format!("npy header: {e}"))?;
    let (descr, is_fortran, shape) = parse_dictionary(&text)?;
    Ok(NpyHeader { raw: raw_type(&descr), shape, is_fortran, data_offset: (8 + len_bytes + len) as u64 })
}

enum Descr {
    Plain(String),
    Structured,
}

fn parse_dictionary(text: &str) -> Result<(Descr, bool, Vec<u64>), String> {
    let (mut descr, mut is_fortran, mut shape) = (None, None, None);
    let mut rest = expect(text.trim(), '{')?;
    loop {
        rest = rest.trim_start();
        if let Some(after) = rest.strip_prefix('}') {
            if !after.trim().is_empty() {
                return Err(format!("npy header: expected its end, got {after:?}"));
            }
            break;
        }
        let (key, after) = quoted(rest)?;
        rest = expect(after, ':')?.trim_start();
        rest = match key {
            "descr" if rest.starts_with('[') => {
                descr = Some(Descr::Structured);
                skip_list(rest)?
            }
            "descr" => {
                let (value, after) = quoted(rest)?;
                descr = Some(Descr::Plain(value.to_owned()));
                after
            }
            "fortran_order" => {
                let (value, after) = boolean(rest)?;
                is_fortran = Some(value);
                after
            }
            "shape" => {
                let (value, after) = tuple(rest)?;
                shape = Some(value);
                after
            }
            key => return Err(format!("npy header: expected descr, fortran_order or shape, got {key:?}")),
        };
        rest = rest.trim_start();
        rest = rest.strip_prefix(',').unwrap_or(rest);
    }
    match (descr, is_fortran, shape) {
        (Some(descr), Some(is_fortran), Some(shape)) => Ok((descr, is_fortran, shape)),
        _ => Err("npy header: expected descr, fortran_order and shape, got fewer keys".to_owned()),
    }
}

fn expect(text: &str, c: char) -> Result<&str, String> {
    let text = text.trim_start();
    text.strip_prefix(c).ok_or_else(|| format!("npy header: expected {c:?}, got {:?}", head(text)))
}

fn head(text: &str) -> String {
    text.chars().take(16).collect()
}

fn quoted(text: &str) -> Result<(&str, &str), String> {
    let quote = text.chars().next().filter(|c| matches!(c, '\'' | '"'));
    let found = quote.and_then(|q| text[1..].split_once(q));
    found.ok_or_else(|| format!("npy header: expected a quoted text, got {:?}", head(text)))
}

fn boolean(text: &str) -> Result<(bool, &str), String> {
    match (text.strip_prefix("True"), text.strip_prefix("False")) {
        (Some(rest), _) => Ok((true, rest)),
        (_, Some(rest)) => Ok((false, rest)),
        _ => Err(format!("npy header: expected True or False, got {:?}", head(text))),
    }
}

fn tuple(text: &str) -> Result<(Vec<u64>, &str), String> {
    let (inside, rest) = expect(text, '(')?.split_once(')').ok_or("npy header: the shape is not closed")?;
    let mut shape = Vec::new();
    let items: Vec<&str> = inside.split(',').map(str::trim).collect();
    for (i, item) in items.iter().enumerate() {
        if item.is_empty() && i + 1 == items.len() {
            break;
        }
        // Python 2 wrote long integers with an L.
        let digits = item.strip_suffix('L').unwrap_or(item);
        shape.push(digits.parse().map_err(|e| format!("npy header: axis length {:?}: {e}", head(item)))?);
    }
    if shape.len() > MAX_RANK {
        return Err(format!("npy header: {} axes, expected at most {MAX_RANK}", shape.len()));
    }
    Ok((shape, rest))
}

/// Skips the list of fields of a structured type; quoted texts may hold brackets.
fn skip_list(text: &str) -> Result<&str, String> {
    let (mut depth, mut quote) = (0u32, None);
    for (at, c) in text.char_indices() {
        match (quote, c) {
            (Some(q), c) if c == q => quote = None,
            (Some(_), _) => {}
            (None, '\'' | '"') => quote = Some(c),
            (None, '[' | '(') => depth += 1,
            (None, ']' | ')') => {
                depth -= 1;
                if depth == 0 {
                    return Ok(&text[at + 1..]);
                }
            }
            (None, _) => {}
        }
    }
    Err("npy header: the list of fields is not closed".to_owned())
}

/// Reads a type code such as `<f4`, `|u1`, `<U12`, `|O`.
fn raw_type(descr: &Descr) -> Result<RawType, Unsupported> {
    let Descr::Plain(code) = descr else {
        return Err(Unsupported::Type("records with several fields".to_owned()));
    };
    let unsupported = || Unsupported::Type(format!("elements of the numpy type {code:?}"));
    let (order, rest) = match code.chars().next() {
        Some(c @ ('<' | '>' | '|' | '=')) => (c, &code[1..]),
        _ => ('|', code.as_str()),
    };
    let Some(kind) = rest.chars().next() else { return Err(unsupported()) };
    if kind == 'O' {
        return Err(Unsupported::Pickled);
    }
    let size: usize = rest[kind.len_utf8()..].parse().map_err(|_e| unsupported())?;
    let number = |dtype| RawType { dtype, item_bytes: size, big_endian: order == '>', form: RawForm::Number };
    Ok(match (kind, size) {
        ('b', 1) => number(Dtype::Bool),
        ('u', 1) => number(Dtype::U8),
        ('i', 1) => number(Dtype::I8),
        ('u', 2) => number(Dtype::U16),
        ('i', 2) => number(Dtype::I16),
        ('u', 4) => number(Dtype::U32),
        ('i', 4) => number(Dtype::I32),
        ('u', 8) => number(Dtype::U64),
        ('i', 8) => number(Dtype::I64),
        ('f', 2) => number(Dtype::F16),
        ('f', 4) => number(Dtype::F32),
        ('f', 8) => number(Dtype::F64),
        ('S', n) if n > 0 => RawType { form: RawForm::NulPadded, ..number(Dtype::Text) },
        ('U', n) if n > 0 => {
            let item_bytes = n.checked_mul(4).ok_or_else(unsupported)?;
            RawType { form: RawForm::Ucs4, item_bytes, ..number(Dtype::Text) }
        }
        _ => return Err(unsupported()),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<NpyHeader, String> {
        let mut bytes = b"\x93NUMPY\x01\x00".to_vec();
        bytes.extend_from_slice(&(text.len() as u16).to_le_bytes());
        bytes.extend_from_slice(text.as_bytes());
        read_header(&mut &bytes[..])
    }

    fn check(descr: &str, shape: &str, expected: (Dtype, usize, bool, &[u64])) {
        let header =
            parse(&format!("{{'descr': {descr}, 'fortran_order': False, 'shape': {shape}, }}  \n")).unwrap();
        let raw = header.raw.unwrap();
        assert_eq!((raw.dtype, raw.item_bytes, raw.big_endian, &header.shape[..]), expected);
    }

    #[test]
    fn headers_that_numpy_writes() {
        check("'<f4'", "(155, 2)", (Dtype::F32, 4, false, &[155, 2]));
        check("'>i8'", "(3,)", (Dtype::I64, 8, true, &[3]));
        check("'|b1'", "()", (Dtype::Bool, 1, false, &[]));
        check("'<U12'", "(2L,)", (Dtype::Text, 48, false, &[2]));
        check("'<f2'", "(0, 4)", (Dtype::F16, 2, false, &[0, 4]));
    }

    #[test]
    fn what_is_no_column_is_named() {
        let header = parse("{'descr': '|O', 'fortran_order': False, 'shape': (3,), }").unwrap();
        assert_eq!(header.raw, Err(Unsupported::Pickled));
        let header =
            parse("{'descr': [('x', '<f4'), ('y]', '<f4')], 'fortran_order': True, 'shape': (3,), }")
                .unwrap();
        assert!(matches!(header.raw, Err(Unsupported::Type(_))));
        let header = parse("{'descr': '<c8', 'fortran_order': False, 'shape': (3,), }").unwrap();
        assert!(matches!(header.raw, Err(Unsupported::Type(_))));
    }

    #[test]
    fn headers_that_no_writer_makes_are_refused() {
        let nested = "(".repeat(9_000);
        for text in [
            "",
            "{",
            "{'descr': '<f4'}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (-1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (99999999999999999999,), }",
            "{'descr': '<f4', 'fortran_order': 1, 'shape': (1,), }",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), 'x': 1}",
            "{'descr': '<f4', 'fortran_order': False, 'shape': (1,), } import os",
            &format!("{{'descr': [{nested}, 'fortran_order': False, 'shape': (1,)}}"),
            &format!("{{'descr': '<f4', 'fortran_order': False, 'shape': {nested}1)}}"),
        ] {
            assert!(parse(text).is_err(), "{text:?}");
        }
    }
}
