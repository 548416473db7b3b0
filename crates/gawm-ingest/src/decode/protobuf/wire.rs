//! The protobuf wire format: tags, varints, lengths.

use std::borrow::Cow;

use super::super::error::DecodeError;
use super::super::row::{Held, Number};
use super::super::schema::{Prim, Wire};

/// Deepest nesting of groups that is stepped over.
const MAX_GROUP_DEPTH: usize = 64;

pub(crate) const VARINT: u8 = 0;
pub(crate) const FIXED64: u8 = 1;
pub(crate) const LEN: u8 = 2;
pub(crate) const FIXED32: u8 = 5;
const GROUP_START: u8 = 3;
const GROUP_END: u8 = 4;

/// A place in a message.
#[derive(Clone, Debug)]
pub(crate) struct Wires<'a> {
    data: &'a [u8],
    pos: usize,
    /// Offset of `data` in the payload, for errors.
    before: usize,
}

impl<'a> Wires<'a> {
    pub(crate) fn new(data: &'a [u8], before: usize) -> Self {
        Self { data, pos: 0, before }
    }

    pub(crate) fn is_done(&self) -> bool {
        self.pos >= self.data.len()
    }

    pub(crate) fn offset(&self) -> usize {
        self.before + self.pos
    }

    #[cold]
    pub(crate) fn malformed(&self, detail: impl Into<String>) -> DecodeError {
        DecodeError::Malformed { encoding: "protobuf", offset: self.before + self.pos, detail: detail.into() }
    }

    #[cold]
    fn truncated(&self, needed: u64) -> DecodeError {
        let available = self.data.len() - self.pos;
        DecodeError::Truncated { offset: self.before + self.pos, needed, available }
    }

    /// Reads a field's number and wire type.
    #[inline]
    pub(crate) fn tag(&mut self) -> Result<(u32, u8), DecodeError> {
        let tag = self.varint()?;
        let number = u32::try_from(tag >> 3).ok().filter(|n| *n != 0);
        let Some(number) = number else { return Err(self.malformed("a field number out of range")) };
        Ok((number, (tag & 7) as u8))
    }

    #[inline]
    pub(crate) fn varint(&mut self) -> Result<u64, DecodeError> {
        let mut value = 0_u64;
        for shift in (0..64).step_by(7) {
            let Some(&byte) = self.data.get(self.pos) else { return Err(self.truncated(1)) };
            self.pos += 1;
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                return Ok(value);
            }
        }
        Err(self.malformed("a varint of more than ten bytes"))
    }

    /// Reads a length and the bytes it spans; also returns their offset in the payload.
    #[inline]
    pub(crate) fn bytes(&mut self) -> Result<(&'a [u8], usize), DecodeError> {
        let n = self.varint()?;
        let left = self.data.len() - self.pos;
        let n = match usize::try_from(n) {
            Ok(n) if n <= left => n,
            _ => return Err(self.truncated(n)),
        };
        let start = self.pos;
        self.pos += n;
        Ok((&self.data[start..self.pos], self.before + start))
    }

    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        let chunk = self.data[self.pos..].first_chunk::<N>();
        let Some(chunk) = chunk else { return Err(self.truncated(N as u64)) };
        self.pos += N;
        Ok(*chunk)
    }

    /// Steps over a field.
    pub(crate) fn skip(&mut self, number: u32, wire_type: u8) -> Result<(), DecodeError> {
        match wire_type {
            VARINT => self.varint().map(|_| ()),
            FIXED64 => self.array::<8>().map(|_| ()),
            LEN => self.bytes().map(|_| ()),
            FIXED32 => self.array::<4>().map(|_| ()),
            GROUP_START => self.skip_group(number),
            other => Err(self.malformed(format!("wire type {other}"))),
        }
    }

    fn skip_group(&mut self, number: u32) -> Result<(), DecodeError> {
        let mut open = vec![number];
        while let Some(&innermost) = open.last() {
            let (number, wire_type) = self.tag()?;
            match wire_type {
                GROUP_START if open.len() < MAX_GROUP_DEPTH => open.push(number),
                GROUP_START => return Err(self.malformed("groups nested more than 64 deep")),
                GROUP_END if number == innermost => {
                    open.pop();
                }
                GROUP_END => return Err(self.malformed("the end of a group that is not open")),
                other => self.skip(number, other)?,
            }
        }
        Ok(())
    }

    /// Reads one number as its type says.
    #[inline]
    pub(crate) fn number(&mut self, prim: Prim, wire: Wire) -> Result<Number, DecodeError> {
        Ok(match (prim, wire.fixed) {
            (Prim::F64, _) => Number::F64(f64::from_le_bytes(self.array()?)),
            (Prim::F32, _) => Number::F64(f64::from(f32::from_le_bytes(self.array()?))),
            (Prim::U32, true) => Number::U64(u64::from(u32::from_le_bytes(self.array()?))),
            (Prim::I32, true) => Number::I64(i64::from(i32::from_le_bytes(self.array()?))),
            (Prim::U64, true) => Number::U64(u64::from_le_bytes(self.array()?)),
            (Prim::I64, true) => Number::I64(i64::from_le_bytes(self.array()?)),
            _ => {
                let raw = self.varint()?;
                varint_number(raw, prim, wire)
            }
        })
    }

    /// Reads one value that is no message, whatever it is.
    pub(crate) fn held(&mut self, prim: Prim, wire: Wire) -> Result<Held<'a>, DecodeError> {
        Ok(match prim {
            Prim::Text | Prim::WideText => Held::Text(String::from_utf8_lossy(self.bytes()?.0)),
            Prim::Bytes => Held::Bytes(Cow::Borrowed(self.bytes()?.0)),
            _ => Held::Number(self.number(prim, wire)?),
        })
    }
}

/// Returns the wire type of an element that is not packed.
pub(crate) fn wire_type(prim: Prim, wire: Wire) -> u8 {
    match (prim, wire.fixed) {
        (Prim::Text | Prim::WideText | Prim::Bytes, _) => LEN,
        (Prim::F64 | Prim::U64 | Prim::I64, true) => FIXED64,
        (_, true) => FIXED32,
        _ => VARINT,
    }
}

/// Returns the size of an element whose size is fixed.
pub(crate) fn fixed_size(prim: Prim, wire: Wire) -> Option<usize> {
    match wire_type(prim, wire) {
        FIXED64 => Some(8),
        FIXED32 => Some(4),
        _ => None,
    }
}

#[expect(
    clippy::cast_possible_wrap,
    clippy::cast_possible_truncation,
    reason = "protobuf reads narrower integers from the low bits of a varint"
)]
fn varint_number(raw: u64, prim: Prim, wire: Wire) -> Number {
    let unzigzag = |v: u64| (v >> 1) as i64 ^ -((v & 1) as i64);
    match prim {
        Prim::Bool => Number::Bool(raw != 0),
        Prim::I32 if wire.zigzag => Number::I64(i64::from(unzigzag(raw & 0xffff_ffff) as i32)),
        Prim::I32 => Number::I64(i64::from(raw as i32)),
        Prim::U32 => Number::U64(u64::from(raw as u32)),
        Prim::I64 if wire.zigzag => Number::I64(unzigzag(raw)),
        Prim::I64 => Number::I64(raw as i64),
        _ => Number::U64(raw),
    }
}
