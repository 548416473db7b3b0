//! Reads scalars, text and array lengths of CDR and ROS 1 bodies.

use std::borrow::Cow;

use super::super::error::DecodeError;
use super::super::row::Number;
use super::super::schema::{Many, Prim};

/// A place in the body of a message. `ALIGN`: CDR pads values to their size; `BIG`: big-endian.
#[derive(Clone, Debug)]
pub(crate) struct Reader<'a, const ALIGN: bool, const BIG: bool> {
    /// The body: positions and alignment count from its start.
    data: &'a [u8],
    pos: usize,
    /// Bytes of the payload before the body, for offsets in errors.
    before: usize,
    /// Bytes of one character of a wide string.
    wide: usize,
}

impl<'a, const ALIGN: bool, const BIG: bool> Reader<'a, ALIGN, BIG> {
    pub(crate) fn new(data: &'a [u8], before: usize, wide: usize) -> Self {
        Self { data, pos: 0, before, wide }
    }

    pub(crate) fn pos(&self) -> usize {
        self.pos
    }

    pub(crate) fn seek(&mut self, pos: usize) {
        self.pos = pos;
    }

    pub(crate) fn remaining(&self) -> usize {
        self.data.len().saturating_sub(self.pos)
    }

    pub(crate) fn rest(&self) -> &'a [u8] {
        self.data.get(self.pos..).unwrap_or(&[])
    }

    pub(crate) fn between(&self, start: usize, end: usize) -> &'a [u8] {
        self.data.get(start..end).unwrap_or(&[])
    }

    pub(crate) fn offset(&self) -> usize {
        self.before + self.pos
    }

    #[inline]
    pub(crate) fn align(&mut self, size: usize) {
        if ALIGN {
            self.pos = (self.pos + size - 1) & !(size - 1);
        }
    }

    #[cold]
    pub(crate) fn truncated(&self, needed: u64) -> DecodeError {
        DecodeError::Truncated { offset: self.before + self.pos, needed, available: self.remaining() }
    }

    #[cold]
    pub(crate) fn malformed(&self, detail: String) -> DecodeError {
        let encoding = if ALIGN { "cdr" } else { "ros1" };
        DecodeError::Malformed { encoding, offset: self.before + self.pos, detail }
    }

    #[inline]
    pub(crate) fn skip(&mut self, n: u64) -> Result<(), DecodeError> {
        if n > self.remaining() as u64 {
            return Err(self.truncated(n));
        }
        // Fits, since it is not beyond the end of a slice.
        self.pos += n as usize;
        Ok(())
    }

    #[inline]
    pub(crate) fn take(&mut self, n: usize) -> Result<&'a [u8], DecodeError> {
        let bytes = self.data.get(self.pos..).and_then(|rest| rest.get(..n));
        let Some(bytes) = bytes else { return Err(self.truncated(n as u64)) };
        self.pos += n;
        Ok(bytes)
    }

    #[inline]
    fn array<const N: usize>(&mut self) -> Result<[u8; N], DecodeError> {
        self.align(N);
        let chunk = self.data.get(self.pos..).and_then(|rest| rest.first_chunk::<N>());
        let Some(chunk) = chunk else { return Err(self.truncated(N as u64)) };
        self.pos += N;
        Ok(*chunk)
    }

    #[inline]
    pub(crate) fn u32(&mut self) -> Result<u32, DecodeError> {
        let bytes = self.array()?;
        Ok(if BIG { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    #[inline]
    pub(crate) fn number(&mut self, prim: Prim) -> Result<Number, DecodeError> {
        macro_rules! read {
            ($type:ty) => {{
                let bytes = self.array()?;
                if BIG { <$type>::from_be_bytes(bytes) } else { <$type>::from_le_bytes(bytes) }
            }};
        }
        Ok(match prim {
            Prim::Bool => Number::Bool(read!(u8) != 0),
            Prim::I8 => Number::I64(i64::from(read!(i8))),
            Prim::U8 => Number::U64(u64::from(read!(u8))),
            Prim::I16 => Number::I64(i64::from(read!(i16))),
            Prim::U16 => Number::U64(u64::from(read!(u16))),
            Prim::I32 => Number::I64(i64::from(read!(i32))),
            Prim::U32 => Number::U64(u64::from(read!(u32))),
            Prim::I64 => Number::I64(read!(i64)),
            Prim::U64 => Number::U64(read!(u64)),
            Prim::F32 => Number::F64(f64::from(read!(f32))),
            Prim::F64 => Number::F64(read!(f64)),
            Prim::Text | Prim::WideText | Prim::Bytes => {
                return Err(self.malformed("text in place of a number".to_owned()));
            }
        })
    }

    /// Reads the length of an array and checks that the bytes left can hold it.
    #[inline]
    pub(crate) fn count(&mut self, many: Many, min_size: u64) -> Result<usize, DecodeError> {
        let n = match many {
            Many::One => 1,
            Many::Fixed(n) => n,
            Many::Dynamic => self.u32()? as usize,
        };
        let needed = (n as u64).saturating_mul(min_size);
        if needed > self.remaining() as u64 {
            return Err(self.truncated(needed));
        }
        Ok(n)
    }

    /// Returns the bytes of a text without its terminator.
    #[inline]
    pub(crate) fn text_bytes(&mut self) -> Result<&'a [u8], DecodeError> {
        let n = self.u32()? as usize;
        let bytes = self.take(n)?;
        // CDR counts a terminating zero byte; some writers leave it out.
        Ok(if ALIGN { bytes.strip_suffix(&[0]).unwrap_or(bytes) } else { bytes })
    }

    pub(crate) fn text(&mut self) -> Result<Cow<'a, str>, DecodeError> {
        Ok(String::from_utf8_lossy(self.text_bytes()?))
    }

    #[inline]
    pub(crate) fn skip_text(&mut self) -> Result<(), DecodeError> {
        let n = self.u32()?;
        self.skip(u64::from(n))
    }

    fn wide_units(&mut self) -> Result<&'a [u8], DecodeError> {
        let n = self.u32()? as usize;
        let size = n.saturating_mul(self.wide);
        self.take(size)
    }

    pub(crate) fn skip_wide(&mut self) -> Result<(), DecodeError> {
        self.wide_units().map(|_| ())
    }

    pub(crate) fn wide_text(&mut self) -> Result<String, DecodeError> {
        let wide = self.wide;
        let units = self.wide_units()?;
        let unit = |bytes: &[u8]| match (bytes, BIG) {
            (&[a, b], true) => u32::from(u16::from_be_bytes([a, b])),
            (&[a, b], false) => u32::from(u16::from_le_bytes([a, b])),
            (&[a, b, c, d], true) => u32::from_be_bytes([a, b, c, d]),
            (&[a, b, c, d], false) => u32::from_le_bytes([a, b, c, d]),
            _ => 0,
        };
        let mut codes = Vec::with_capacity(units.len() / wide);
        for bytes in units.chunks_exact(wide) {
            match u16::try_from(unit(bytes)) {
                Ok(code) => codes.push(code),
                Err(_) => {
                    return Err(self.malformed("a wide string with a code unit above 0xffff".to_owned()));
                }
            }
        }
        Ok(String::from_utf16_lossy(&codes).trim_end_matches('\0').to_owned())
    }
}
