//! XCDR2 into XCDR1 (DDS-XTypes 1.3, section 7.4.3): the same values, laid out as the CDR decoder reads them.
//!
//! XCDR2 aligns to four bytes at most, puts a length before collections of anything but numbers, and, by how a type may be
//! extended, before structs (appendable) and before each of their members (mutable).

use super::super::error::DecodeError;
use super::super::ros::run::check_rest;
use super::super::schema::{Base, Extensibility, Field, Many, Prim, TypeTable};

/// Bytes of the encapsulation header.
const HEADER: usize = 4;

/// What the header of a message says.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Encapsulation {
    is_big: bool,
    /// How the message's own type may be extended.
    top: Extensibility,
}

impl Encapsulation {
    /// Reads the header; `None` when it does not say XCDR2.
    pub(super) fn of(payload: &[u8]) -> Option<Self> {
        let id = u16::from_be_bytes([*payload.first()?, *payload.get(1)?]);
        let top = match id {
            0x0006 | 0x0007 => Extensibility::Final,
            0x0008 | 0x0009 => Extensibility::Appendable,
            0x000a | 0x000b => Extensibility::Mutable,
            _ => return None,
        };
        (payload.len() >= HEADER).then_some(Self { is_big: id % 2 == 0, top })
    }
}

/// Writes the message anew, in the same byte order.
pub(super) fn to_xcdr1(
    types: &TypeTable,
    encapsulation: Encapsulation,
    payload: &[u8],
) -> Result<Vec<u8>, DecodeError> {
    let mut out = Vec::with_capacity(payload.len() + payload.len() / 4);
    out.extend_from_slice(&[0, u8::from(!encapsulation.is_big), 0, 0]);
    let mut transcode = Transcode { types, encapsulation, data: payload, out };
    let mut at = HEADER;
    transcode.structure(types.root, encapsulation.top, &mut at, payload.len())?;
    // What a newer type appends lies within the length of its struct; what lies behind is of no type.
    check_rest(&payload[at..], at)?;
    Ok(transcode.out)
}

struct Transcode<'a> {
    types: &'a TypeTable,
    encapsulation: Encapsulation,
    data: &'a [u8],
    out: Vec<u8>,
}

impl Transcode<'_> {
    fn truncated(&self, at: usize, needed: u64, end: usize) -> DecodeError {
        DecodeError::Truncated { offset: at, needed, available: end.saturating_sub(at) }
    }

    fn malformed(&self, at: usize, detail: &str) -> DecodeError {
        DecodeError::Malformed { encoding: "cdr2", offset: at, detail: detail.to_owned() }
    }

    /// Moves to the next multiple of `size`, four at most, counted from the end of the header.
    fn align_in(at: &mut usize, size: usize) {
        *at = (*at - HEADER).next_multiple_of(size.clamp(1, 4)) + HEADER;
    }

    fn align_out(&mut self, size: usize) {
        let length = self.out.len() - HEADER;
        self.out.resize(HEADER + length.next_multiple_of(size.max(1)), 0);
    }

    fn take(&self, at: &mut usize, n: u64, end: usize) -> Result<&[u8], DecodeError> {
        let available = end.saturating_sub(*at) as u64;
        if n > available {
            return Err(self.truncated(*at, n, end));
        }
        let start = *at;
        // Fits, since it is not beyond the end of a slice.
        *at += n as usize;
        Ok(&self.data[start..*at])
    }

    fn u32_in(&self, at: &mut usize, end: usize) -> Result<u32, DecodeError> {
        Self::align_in(at, 4);
        let big = self.encapsulation.is_big;
        let bytes = self.take(at, 4, end)?;
        let bytes = [bytes[0], bytes[1], bytes[2], bytes[3]];
        Ok(if big { u32::from_be_bytes(bytes) } else { u32::from_le_bytes(bytes) })
    }

    fn u32_out(&mut self, value: u32) {
        self.align_out(4);
        let bytes = if self.encapsulation.is_big { value.to_be_bytes() } else { value.to_le_bytes() };
        self.out.extend_from_slice(&bytes);
    }

    /// Reads a length in bytes and returns the end it gives.
    fn delimited(&self, at: &mut usize, end: usize) -> Result<usize, DecodeError> {
        let length = self.u32_in(at, end)?;
        let inner = (*at as u64).saturating_add(u64::from(length));
        if inner > end as u64 {
            return Err(self.truncated(*at, u64::from(length), end));
        }
        Ok(inner as usize)
    }

    fn structure(
        &mut self,
        index: usize,
        extensibility: Extensibility,
        at: &mut usize,
        end: usize,
    ) -> Result<(), DecodeError> {
        let types = self.types;
        let fields = &types.structs[index].fields;
        match extensibility {
            Extensibility::Final => fields.iter().try_for_each(|field| self.field(field, at, end)),
            Extensibility::Appendable => {
                let inner = self.delimited(at, end)?;
                fields.iter().try_for_each(|field| self.field(field, at, inner))?;
                // What a newer type appended is not known here.
                *at = inner;
                Ok(())
            }
            Extensibility::Mutable => {
                let inner = self.delimited(at, end)?;
                let members = self.members(at, inner)?;
                for (position, field) in fields.iter().enumerate() {
                    let id = types.structs[index].member_ids.get(position).copied();
                    let id = id.unwrap_or(u32::try_from(position).unwrap_or(u32::MAX));
                    let found = members.iter().find(|member| member.id == id);
                    let Some(member) = found else {
                        return Err(self.malformed(*at, &format!("no member {:?} (id {id})", field.name)));
                    };
                    let mut start = member.start;
                    self.field(field, &mut start, member.end)?;
                }
                *at = inner;
                Ok(())
            }
        }
    }

    /// Lists the members of a mutable struct.
    fn members(&self, at: &mut usize, end: usize) -> Result<Vec<Member>, DecodeError> {
        let mut members = Vec::new();
        loop {
            Self::align_in(at, 4);
            if *at >= end {
                return Ok(members);
            }
            let header = self.u32_in(at, end)?;
            let (id, code) = (header & 0x0fff_ffff, (header >> 28) & 7);
            let (start, length) = match code {
                0..=3 => (*at, 1_u64 << code),
                4 => {
                    let length = self.u32_in(at, end)?;
                    (*at, u64::from(length))
                }
                // The length is also the first four bytes of the member itself.
                _ => {
                    let start = *at;
                    let unit = [1_u64, 4, 8][code as usize - 5];
                    let count = u64::from(self.u32_in(at, end)?);
                    (start, 4 + count.saturating_mul(unit))
                }
            };
            let stop = (start as u64).saturating_add(length);
            if stop > end as u64 {
                return Err(self.truncated(start, length, end));
            }
            *at = stop as usize;
            members.push(Member { id, start, end: stop as usize });
        }
    }

    fn field(&mut self, field: &Field, at: &mut usize, end: usize) -> Result<(), DecodeError> {
        if field.many == Many::One {
            return self.value(field.base, at, end);
        }
        let is_plain = matches!(field.base, Base::Prim(prim) if prim.is_number());
        let inner = if is_plain { end } else { self.delimited(at, end)? };
        let count = match field.many {
            Many::Dynamic => {
                let count = self.u32_in(at, inner)?;
                self.u32_out(count);
                u64::from(count)
            }
            Many::Fixed(count) => count as u64,
            Many::One => 1,
        };
        match field.base {
            Base::Prim(prim) if is_plain => self.numbers(prim, count, at, inner)?,
            Base::Struct(index) if self.types.structs[index].fields.is_empty() => {}
            base => {
                for _ in 0..count {
                    // Every element takes at least one byte, so that a huge count ends with the data.
                    if *at >= inner {
                        return Err(self.truncated(*at, 1, inner));
                    }
                    self.value(base, at, inner)?;
                }
            }
        }
        if !is_plain {
            *at = inner;
        }
        Ok(())
    }

    fn numbers(&mut self, prim: Prim, count: u64, at: &mut usize, end: usize) -> Result<(), DecodeError> {
        let size = prim.size().unwrap_or(1);
        if count == 0 {
            return Ok(());
        }
        Self::align_in(at, size);
        let start = *at;
        let length = self.take(at, count.saturating_mul(size as u64), end)?.len();
        self.align_out(size);
        self.out.extend_from_slice(&self.data[start..start + length]);
        Ok(())
    }

    fn value(&mut self, base: Base, at: &mut usize, end: usize) -> Result<(), DecodeError> {
        match base {
            Base::Struct(index) => {
                // A type that says nothing is extended as the message's own is.
                let own = self.types.structs[index].extensibility.unwrap_or(self.encapsulation.top);
                self.structure(index, own, at, end)
            }
            Base::Prim(Prim::Text) => {
                let length = self.u32_in(at, end)?;
                self.u32_out(length);
                let start = *at;
                self.take(at, u64::from(length), end)?;
                self.out.extend_from_slice(&self.data[start..*at]);
                Ok(())
            }
            Base::Prim(Prim::WideText) => {
                // Bytes here, characters of two bytes there.
                let length = self.u32_in(at, end)?;
                if length % 2 != 0 {
                    return Err(self.malformed(*at, "expected an even number of bytes in a wide string"));
                }
                self.u32_out(length / 2);
                let start = *at;
                self.take(at, u64::from(length), end)?;
                self.out.extend_from_slice(&self.data[start..*at]);
                Ok(())
            }
            Base::Prim(prim) => self.numbers(prim, 1, at, end),
        }
    }
}

struct Member {
    id: u32,
    start: usize,
    end: usize,
}
