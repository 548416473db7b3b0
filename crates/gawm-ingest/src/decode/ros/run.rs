//! Runs a [`Program`] over the body of one message.

use std::borrow::Cow;

use super::super::error::DecodeError;
use super::super::resolve::{PickKind, Requests};
use super::super::row::{Emit, Probe, Scratch, TableState};
use super::super::schema::{Many, Prim};
use super::program::{Element, Extent, MemberPicks, NumberPick, Program, Step, repeat};
use super::reader::Reader;

/// Most names that an error lists.
const MAX_LISTED: usize = 64;

/// Surplus that is always taken as padding; longer surplus must be zeros.
const MAX_PADDING: usize = 8;

/// Runs `program` over the payload of a CDR message, which begins with the encapsulation header.
pub(crate) fn run_cdr<'a, E: Emit<'a>>(
    program: &Program,
    requests: &Requests,
    payload: &'a [u8],
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    let (body, big) = open_cdr(payload)?;
    if big {
        with_wide::<true, true, E>(program, requests, body, 4, scratch, emit)
    } else {
        with_wide::<true, false, E>(program, requests, body, 4, scratch, emit)
    }
}

/// Runs `program` over a ROS 1 message.
pub(crate) fn run_ros1<'a, E: Emit<'a>>(
    program: &Program,
    requests: &Requests,
    payload: &'a [u8],
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    with_wide::<false, false, E>(program, requests, payload, 0, scratch, emit)
}

/// Checks the encapsulation header; returns the body and whether it is big-endian.
pub(crate) fn open_cdr(payload: &[u8]) -> Result<(&[u8], bool), DecodeError> {
    let Some((header, body)) = payload.split_first_chunk::<4>() else {
        return Err(DecodeError::Truncated { offset: 0, needed: 4, available: payload.len() });
    };
    let id = u16::from_be_bytes([header[0], header[1]]);
    let name = match id {
        0x0000 => return Ok((body, true)),
        0x0001 => return Ok((body, false)),
        0x0002 => "PL_CDR_BE",
        0x0003 => "PL_CDR_LE",
        0x0006 => "CDR2_BE",
        0x0007 => "CDR2_LE",
        0x0008 => "D_CDR2_BE",
        0x0009 => "D_CDR2_LE",
        0x000a => "PL_CDR2_BE",
        0x000b => "PL_CDR2_LE",
        0x0004 => "XML",
        0x0422 => "an LZ4 frame; compressed bodies are unpacked only if zstd compressed them",
        0x1f8b => "gzip; compressed bodies are unpacked only if zstd compressed them",
        0x7b00..=0x7bff => "JSON text; the channel is labelled wrongly",
        _ => "unknown",
    };
    Err(DecodeError::UnsupportedCdr { id, name })
}

/// Characters of wide strings have four bytes in older, two in newer middleware; what fits is right.
fn with_wide<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
    program: &Program,
    requests: &Requests,
    body: &'a [u8],
    before: usize,
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    let first = whole::<ALIGN, BIG, E>(program, requests, body, (before, 4), scratch, emit);
    if !program.has_wide || first.is_ok() {
        return first;
    }
    scratch.found = 0;
    scratch.missing = 0;
    whole::<ALIGN, BIG, E>(program, requests, body, (before, 2), scratch, emit).or(first)
}

fn whole<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
    program: &Program,
    requests: &Requests,
    body: &'a [u8],
    (before, wide): (usize, usize),
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    if body.is_empty() && program.is_empty {
        return Ok(()); // An empty message whose dummy byte was left out.
    }
    let mut reader = Reader::<ALIGN, BIG>::new(body, before, wide);
    Machine { program, requests, scratch }.steps(&program.steps, &mut reader, emit)?;
    check_end(&reader)
}

/// Refuses a message that goes on with content: its schema is not the one it was written with.
pub(crate) fn check_end<const ALIGN: bool, const BIG: bool>(
    reader: &Reader<'_, ALIGN, BIG>,
) -> Result<(), DecodeError> {
    // ROS 1 pads nothing.
    let most = if ALIGN { MAX_PADDING } else { 0 };
    check_surplus(reader.rest(), reader.offset(), most)
}

/// Refuses what is left of a message from `offset` on, unless it is padding.
pub(crate) fn check_rest(rest: &[u8], offset: usize) -> Result<(), DecodeError> {
    check_surplus(rest, offset, MAX_PADDING)
}

/// Refuses more than `most` bytes, unless all are zeros.
fn check_surplus(rest: &[u8], offset: usize, most: usize) -> Result<(), DecodeError> {
    if rest.len() > most && rest.iter().any(|b| *b != 0) {
        return Err(DecodeError::TrailingBytes { offset, surplus: rest.len() });
    }
    Ok(())
}

struct Machine<'p, 's> {
    program: &'p Program,
    requests: &'p Requests,
    scratch: &'s mut Scratch,
}

impl Machine<'_, '_> {
    fn steps<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
        &mut self,
        steps: &[Step],
        reader: &mut Reader<'a, ALIGN, BIG>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        for step in steps {
            match step {
                Step::Skip(extent) => reader.skip(extent[reader.pos() % 8])?,
                Step::SkipText => reader.skip_text()?,
                Step::SkipWide => reader.skip_wide()?,
                Step::SkipStruct(index) => skip_struct(self.program, *index, reader)?,
                Step::SkipMany(many, element) => skip_many(self.program, *many, *element, reader)?,
                Step::Peek(inner) => {
                    let start = reader.pos();
                    self.steps(inner, reader, emit)?;
                    reader.seek(start);
                }
                Step::Read { prim, slot, stay } => {
                    let start = reader.pos();
                    read(*prim, *slot, reader, emit)?;
                    if *stay {
                        reader.seek(start);
                    }
                }
                Step::Bytes { many, slot } => {
                    let n = reader.count(*many, 1)?;
                    emit.bytes(*slot, Cow::Borrowed(reader.take(n)?));
                }
                Step::Keys { many, wide, table } => self.keys(*many, *wide, *table, reader)?,
                Step::Numbers { many, prim, size, picks } => {
                    self.numbers(*many, (*prim, *size), picks, reader, emit)?
                }
                Step::Elements { many, element, at, by_member } => {
                    self.elements(*many, *element, at, by_member, reader, emit)?;
                }
            }
        }
        Ok(())
    }

    /// Finds the wanted names. Names rarely change: bytes equal to the last message's need no second look.
    fn keys<const ALIGN: bool, const BIG: bool>(
        &mut self,
        many: Many,
        wide: bool,
        table: usize,
        reader: &mut Reader<'_, ALIGN, BIG>,
    ) -> Result<(), DecodeError> {
        let wanted = &self.requests.tables[table].wanted;
        let state = &mut self.scratch.tables[table];
        let start = reader.pos();
        state.at = start;
        let n = state.cached.len();
        if n > 0 && state.cached_phase == start % 8 && reader.rest().get(..n) == Some(&state.cached[..]) {
            return reader.skip(n as u64);
        }
        state.cached.clear();
        state.index.fill(u32::MAX);
        let count = reader.count(many, 4)?;
        state.count = count;
        for i in 0..count {
            if wide {
                let text = reader.wide_text()?;
                note(state, wanted, i, text.as_bytes());
            } else {
                let text = reader.text_bytes()?;
                note(state, wanted, i, text);
            }
        }
        state.cached.extend_from_slice(reader.between(start, reader.pos()));
        state.cached_phase = start % 8;
        Ok(())
    }

    fn numbers<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
        &mut self,
        many: Many,
        (prim, size): (Prim, usize),
        picks: &[NumberPick],
        reader: &mut Reader<'a, ALIGN, BIG>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let mut count = reader.count(many, size as u64)?;
        if count > 0 {
            reader.align(size);
            // The padding may have taken what the first check counted.
            count = reader.count(Many::Fixed(count), size as u64)?;
        }
        let start = reader.pos();
        for pick in picks {
            let i = self.position(pick.pick, count, reader)?;
            reader.seek(start + i * size);
            emit.number(pick.slot, reader.number(prim)?);
        }
        reader.seek(start + count * size);
        Ok(())
    }

    /// Returns the position of a picked element in an array of `count`.
    #[inline]
    fn position<const ALIGN: bool, const BIG: bool>(
        &self,
        pick: usize,
        count: usize,
        reader: &Reader<'_, ALIGN, BIG>,
    ) -> Result<usize, DecodeError> {
        match &self.requests.picks[pick].kind {
            PickKind::Index(index) => {
                element_index(*index, count).ok_or_else(|| self.out_of_range(pick, count))
            }
            PickKind::Parallel { table, wanted } => {
                let state = &self.scratch.tables[*table];
                if state.count != count {
                    return Err(self.lengths_differ(pick, state.count, count));
                }
                match state.index[*wanted] {
                    u32::MAX => Err(self.name_absent(pick, *table, *wanted, reader)),
                    i => Ok(i as usize),
                }
            }
            PickKind::Member { .. } => Err(self.out_of_range(pick, count)),
        }
    }

    #[cold]
    fn out_of_range(&self, pick: usize, length: usize) -> DecodeError {
        DecodeError::IndexOutOfRange { path: self.requests.picks[pick].path.clone(), length }
    }

    #[cold]
    fn lengths_differ(&self, pick: usize, names: usize, values: usize) -> DecodeError {
        DecodeError::LengthMismatch { path: self.requests.picks[pick].path.clone(), names, values }
    }

    #[cold]
    fn name_absent<const ALIGN: bool, const BIG: bool>(
        &self,
        pick: usize,
        table: usize,
        wanted: usize,
        reader: &Reader<'_, ALIGN, BIG>,
    ) -> DecodeError {
        let state = &self.scratch.tables[table];
        let mut names = reader.clone();
        names.seek(state.at);
        let mut present = Vec::new();
        if names.u32().is_ok_and(|n| n as usize == state.count) {
            while present.len() < state.count.min(MAX_LISTED) {
                let Ok(name) = names.text() else { break };
                present.push(name.into_owned());
            }
        }
        let name = self.requests.tables[table].wanted[wanted].clone();
        DecodeError::NameAbsent { path: self.requests.picks[pick].path.clone(), name, present }
    }

    fn elements<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
        &mut self,
        many: Many,
        element: Element,
        at: &[(usize, Vec<Step>)],
        by_member: &[MemberPicks],
        reader: &mut Reader<'a, ALIGN, BIG>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let count = reader.count(many, min_size(self.program, element))?;
        let start = reader.pos();
        // Positions first: they are known by now. Then one pass for what the elements say themselves.
        for (pick, steps) in at {
            let i = self.position(*pick, count, reader)?;
            skip_elements(self.program, i, element, reader)?;
            self.steps(steps, reader, emit)?;
            reader.seek(start);
        }
        for picks in by_member {
            self.members(count, element, picks, reader, emit)?;
            reader.seek(start);
        }
        skip_elements(self.program, count, element, reader)
    }

    fn members<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
        &mut self,
        count: usize,
        element: Element,
        picks: &MemberPicks,
        reader: &mut Reader<'a, ALIGN, BIG>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let mut done = 0_u64;
        let mut found = 0_usize;
        let mut done_beyond: Vec<usize> = Vec::new();
        for _ in 0..count {
            if found == picks.wanted.len() {
                break;
            }
            let start = reader.pos();
            let mut probe = Probe { held: None };
            self.steps(&picks.probe, reader, &mut probe)?;
            for (w, wanted) in picks.wanted.iter().enumerate() {
                let is_done = if w < 64 { done >> w & 1 == 1 } else { done_beyond.contains(&w) };
                if is_done || !probe.is(&wanted.value) {
                    continue;
                }
                if w < 64 {
                    done |= 1 << w;
                } else {
                    done_beyond.push(w);
                }
                found += 1;
                reader.seek(start);
                self.steps(&wanted.steps, reader, emit)?;
            }
            reader.seek(start);
            skip_elements(self.program, 1, element, reader)?;
        }
        self.scratch.found += u32::try_from(found).unwrap_or(u32::MAX);
        self.scratch.missing += u32::try_from(picks.wanted.len() - found).unwrap_or(u32::MAX);
        Ok(())
    }
}

/// Returns the position that an index, possibly from the end, means in an array of `count`.
pub(crate) fn element_index(index: i64, count: usize) -> Option<usize> {
    let magnitude = usize::try_from(index.unsigned_abs()).ok()?;
    let position = if index < 0 { count.checked_sub(magnitude)? } else { magnitude };
    (position < count).then_some(position)
}

/// Remembers the position of a name, if it is wanted; the first of equal names counts.
fn note(state: &mut TableState, wanted: &[String], i: usize, name: &[u8]) {
    for (cell, wanted) in state.index.iter_mut().zip(wanted) {
        if *cell == u32::MAX && wanted.as_bytes() == name {
            *cell = u32::try_from(i).unwrap_or(u32::MAX);
        }
    }
}

#[inline]
fn read<'a, const ALIGN: bool, const BIG: bool, E: Emit<'a>>(
    prim: Prim,
    slot: usize,
    reader: &mut Reader<'a, ALIGN, BIG>,
    emit: &mut E,
) -> Result<(), DecodeError> {
    match prim {
        Prim::Text => emit.text(slot, reader.text()?),
        Prim::WideText => emit.text(slot, Cow::Owned(reader.wide_text()?)),
        _ => emit.number(slot, reader.number(prim)?),
    }
    Ok(())
}

fn min_size(program: &Program, element: Element) -> u64 {
    match element {
        Element::Fixed { min_size, .. } => min_size,
        Element::Text | Element::Wide => 4,
        Element::Struct(index) => program.min_sizes[index],
    }
}

fn skip_many<const ALIGN: bool, const BIG: bool>(
    program: &Program,
    many: Many,
    element: Element,
    reader: &mut Reader<'_, ALIGN, BIG>,
) -> Result<(), DecodeError> {
    let count = reader.count(many, min_size(program, element))?;
    skip_elements(program, count, element, reader)
}

fn skip_elements<const ALIGN: bool, const BIG: bool>(
    program: &Program,
    count: usize,
    element: Element,
    reader: &mut Reader<'_, ALIGN, BIG>,
) -> Result<(), DecodeError> {
    match element {
        Element::Fixed { extent, .. } => skip_fixed(&extent, count, reader),
        Element::Text => (0..count).try_for_each(|_| reader.skip_text()),
        Element::Wide => (0..count).try_for_each(|_| reader.skip_wide()),
        Element::Struct(index) => (0..count).try_for_each(|_| skip_struct(program, index, reader)),
    }
}

#[inline]
fn skip_fixed<const ALIGN: bool, const BIG: bool>(
    extent: &Extent,
    count: usize,
    reader: &mut Reader<'_, ALIGN, BIG>,
) -> Result<(), DecodeError> {
    reader.skip(repeat(extent, reader.pos(), count as u64))
}

/// Skips a struct of varying size. Types do not nest deeper than the parser allows.
fn skip_struct<const ALIGN: bool, const BIG: bool>(
    program: &Program,
    index: usize,
    reader: &mut Reader<'_, ALIGN, BIG>,
) -> Result<(), DecodeError> {
    for step in &program.skips[index] {
        match step {
            Step::Skip(extent) => reader.skip(extent[reader.pos() % 8])?,
            Step::SkipText => reader.skip_text()?,
            Step::SkipWide => reader.skip_wide()?,
            Step::SkipStruct(inner) => skip_struct(program, *inner, reader)?,
            Step::SkipMany(many, element) => skip_many(program, *many, *element, reader)?,
            _ => {}
        }
    }
    Ok(())
}
