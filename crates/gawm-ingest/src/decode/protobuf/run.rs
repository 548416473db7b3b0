//! Runs a [`Node`] over the bytes of one message.

use std::borrow::Cow;

use super::super::error::DecodeError;
use super::super::resolve::{Hop, PickKind, Requests, Target};
use super::super::ros::run::element_index;
use super::super::row::{Emit, Held, Number, Probe, Scratch};
use super::super::schema::{Prim, Wire};
use super::node::{Action, Content, Fallback, MemberPicks, Node, Repeated};
use super::wire::{LEN, Wires, fixed_size, wire_type};

/// Most names that are kept for an error.
const MAX_LISTED: usize = 64;

/// Runs `node` over a message; the first `width` slots must get values.
pub(crate) fn run<'a, E: Emit<'a>>(
    (node, n_counters): (&Node, usize),
    requests: &Requests,
    payload: &'a [u8],
    width: usize,
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    scratch.matched.fill(false);
    scratch.set.fill(false);
    scratch.lengths.fill(0);
    // Running counts, then totals of the scan.
    scratch.counters.clear();
    scratch.counters.resize(2 * n_counters, 0);
    let mut machine = Machine { requests, scratch, n_counters };
    machine.scope(node, payload, 0, emit)?;
    finish(requests, width, scratch)
}

/// Accounts for the slots that got no value.
pub(crate) fn finish(requests: &Requests, width: usize, scratch: &mut Scratch) -> Result<(), DecodeError> {
    for (id, pick) in requests.picks.iter().enumerate() {
        if matches!(pick.kind, PickKind::Member { .. }) {
            if scratch.matched[id] {
                scratch.found += 1;
            } else {
                scratch.missing += 1;
            }
        }
    }
    if scratch.set[..width].iter().all(|set| *set) {
        return Ok(());
    }
    for request in &requests.all {
        let Target::Slot(slot) = request.target else { continue };
        if slot >= width || scratch.set[slot] || requests.leaves[slot].is_optional {
            continue;
        }
        let unmatched = request.hops.iter().find_map(|hop| match hop {
            Hop::Pick(id) if !scratch.matched[*id] => Some(*id),
            _ => None,
        });
        let Some(id) = unmatched else {
            return Err(DecodeError::FieldAbsent {
                path: requests.leaves[slot].path.clone(),
                present: Vec::new(),
            });
        };
        let path = requests.picks[id].path.clone();
        match &requests.picks[id].kind {
            PickKind::Member { .. } => {}
            PickKind::Index(_) => {
                return Err(DecodeError::IndexOutOfRange { path, length: scratch.lengths[id] });
            }
            PickKind::Parallel { table, wanted } => {
                let state = &scratch.tables[*table];
                if state.index[*wanted] != u32::MAX {
                    return Err(DecodeError::LengthMismatch { path, names: state.count, values: 0 });
                }
                let name = requests.tables[*table].wanted[*wanted].clone();
                return Err(DecodeError::NameAbsent { path, name, present: listed(&state.cached) });
            }
        }
    }
    Ok(())
}

fn listed(names: &[u8]) -> Vec<String> {
    names
        .split(|b| *b == 0)
        .filter(|n| !n.is_empty())
        .map(|n| String::from_utf8_lossy(n).into_owned())
        .collect()
}

struct Machine<'p, 's> {
    requests: &'p Requests,
    scratch: &'s mut Scratch,
    n_counters: usize,
}

impl Machine<'_, '_> {
    /// Reads a message that counts its own repeated fields.
    fn scope<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        data: &'a [u8],
        before: usize,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        self.scratch.counters[node.counters.clone()].fill(0);
        if node.needs_scan {
            let totals = node.counters.start + self.n_counters..node.counters.end + self.n_counters;
            self.scratch.counters[totals].fill(0);
            self.begin_tables(node);
            self.scan(node, data, before)?;
        }
        self.read(node, data, before, emit)
    }

    fn begin_tables(&mut self, node: &Node) {
        for (_, action) in &node.fields {
            match action {
                Action::Repeated(Repeated { keys: Some(table), .. }) => {
                    let state = &mut self.scratch.tables[*table];
                    state.index.fill(u32::MAX);
                    state.count = 0;
                    state.cached.clear();
                }
                Action::Message(inner) if inner.needs_scan => self.begin_tables(inner),
                _ => {}
            }
        }
    }

    /// Learns names and lengths; reads no values.
    fn scan(&mut self, node: &Node, data: &[u8], before: usize) -> Result<(), DecodeError> {
        let mut wires = Wires::new(data, before);
        while !wires.is_done() {
            let (number, kind) = wires.tag()?;
            match find(node, number) {
                Some(Action::Message(inner)) if inner.needs_scan && kind == LEN => {
                    let (data, before) = wires.bytes()?;
                    self.scan(inner, data, before)?;
                }
                Some(Action::Repeated(repeated)) => self.scan_repeated(repeated, kind, number, &mut wires)?,
                _ => wires.skip(number, kind)?,
            }
        }
        Ok(())
    }

    fn scan_repeated(
        &mut self,
        repeated: &Repeated,
        kind: u8,
        number: u32,
        wires: &mut Wires<'_>,
    ) -> Result<(), DecodeError> {
        let total = self.n_counters + repeated.counter;
        match (repeated.scalar, repeated.keys) {
            (Some((Prim::Text, _)), Some(table)) if kind == LEN => {
                let (name, _) = wires.bytes()?;
                self.note(table, name);
                self.scratch.counters[total] += 1;
            }
            (Some((prim, wire)), _) if kind == LEN && wire_type(prim, wire) != LEN => {
                let (packed, before) = wires.bytes()?;
                self.scratch.counters[total] += match fixed_size(prim, wire) {
                    Some(size) => packed.len() / size,
                    None => {
                        let mut inner = Wires::new(packed, before);
                        let mut n = 0;
                        while !inner.is_done() {
                            inner.varint()?;
                            n += 1;
                        }
                        n
                    }
                };
            }
            _ => {
                wires.skip(number, kind)?;
                self.scratch.counters[total] += 1;
            }
        }
        Ok(())
    }

    fn note(&mut self, table: usize, name: &[u8]) {
        let state = &mut self.scratch.tables[table];
        for (cell, wanted) in state.index.iter_mut().zip(&self.requests.tables[table].wanted) {
            if *cell == u32::MAX && wanted.as_bytes() == name {
                *cell = u32::try_from(state.count).unwrap_or(u32::MAX);
            }
        }
        if state.count < MAX_LISTED {
            state.cached.extend_from_slice(name);
            state.cached.push(0);
        }
        state.count += 1;
    }

    fn read<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        data: &'a [u8],
        before: usize,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        for fallback in &node.defaults {
            if !self.scratch.set[fallback.slot] {
                self.scratch.set[fallback.slot] = true;
                emit_default(fallback, emit);
            }
        }
        let mut wires = Wires::new(data, before);
        while !wires.is_done() {
            let (number, kind) = wires.tag()?;
            match find(node, number) {
                None => wires.skip(number, kind)?,
                Some(Action::Scalar { prim, wire, slots }) => {
                    let value = checked(&mut wires, kind, number, *prim, *wire)?;
                    self.put(slots, value, emit);
                }
                Some(Action::Message(inner)) if kind == LEN => {
                    let (data, before) = wires.bytes()?;
                    self.read(inner, data, before, emit)?;
                }
                Some(Action::Repeated(repeated)) => {
                    self.repeated(repeated, kind, number, &mut wires, emit)?
                }
                Some(Action::Message(_)) => {
                    return Err(
                        wires.malformed(format!("field {number} has wire type {kind}, expected a message"))
                    );
                }
            }
        }
        Ok(())
    }

    fn put<'a, E: Emit<'a>>(&mut self, slots: &[usize], value: Held<'a>, emit: &mut E) {
        for slot in slots {
            self.scratch.set[*slot] = true;
            match &value {
                Held::Number(number) => emit.number(*slot, *number),
                Held::Text(text) => emit.text(*slot, text.clone()),
                Held::Bytes(bytes) => emit.bytes(*slot, bytes.clone()),
            }
        }
    }

    fn repeated<'a, E: Emit<'a>>(
        &mut self,
        repeated: &Repeated,
        kind: u8,
        number: u32,
        wires: &mut Wires<'a>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let Some((prim, wire)) = repeated.scalar else {
            if kind != LEN {
                return Err(
                    wires.malformed(format!("field {number} has wire type {kind}, expected a message"))
                );
            }
            let (data, before) = wires.bytes()?;
            return self.element(repeated, data, before, emit);
        };
        if repeated.at.is_empty() {
            return wires.skip(number, kind);
        }
        if kind == LEN && wire_type(prim, wire) != LEN {
            let (packed, before) = wires.bytes()?;
            return self.packed(repeated, (prim, wire), packed, before, emit);
        }
        let value = checked(wires, kind, number, prim, wire)?;
        let i = self.next(repeated);
        self.scalar_element(repeated, i, value, emit)
    }

    fn next(&mut self, repeated: &Repeated) -> usize {
        let i = self.scratch.counters[repeated.counter];
        self.scratch.counters[repeated.counter] = i + 1;
        i
    }

    fn packed<'a, E: Emit<'a>>(
        &mut self,
        repeated: &Repeated,
        (prim, wire): (Prim, Wire),
        packed: &'a [u8],
        before: usize,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let Some(size) = fixed_size(prim, wire) else {
            let mut inner = Wires::new(packed, before);
            while !inner.is_done() {
                let value = Held::Number(inner.number(prim, wire)?);
                let i = self.next(repeated);
                self.scalar_element(repeated, i, value, emit)?;
            }
            return Ok(());
        };
        if !packed.len().is_multiple_of(size) {
            return Err(Wires::new(packed, before)
                .malformed(format!("{} bytes of packed {size}-byte values", packed.len())));
        }
        let first = self.scratch.counters[repeated.counter];
        let n = packed.len() / size;
        self.scratch.counters[repeated.counter] = first + n;
        for (pick, content) in &repeated.at {
            self.scratch.lengths[*pick] = first + n;
            let Some(position) = self.position(*pick, repeated.counter)? else { continue };
            let Some(i) = position.checked_sub(first).filter(|i| *i < n) else { continue };
            self.scratch.matched[*pick] = true;
            let value = Wires::new(&packed[i * size..], before + i * size).number(prim, wire)?;
            if let Content::Slots(slots) = content {
                self.put(slots, Held::Number(value), emit);
            }
        }
        Ok(())
    }

    fn scalar_element<'a, E: Emit<'a>>(
        &mut self,
        repeated: &Repeated,
        i: usize,
        value: Held<'a>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        for (pick, content) in &repeated.at {
            self.scratch.lengths[*pick] = i + 1;
            if self.position(*pick, repeated.counter)? != Some(i) {
                continue;
            }
            self.scratch.matched[*pick] = true;
            if let Content::Slots(slots) = content {
                self.put(slots, value.clone(), emit);
            }
        }
        Ok(())
    }

    fn element<'a, E: Emit<'a>>(
        &mut self,
        repeated: &Repeated,
        data: &'a [u8],
        before: usize,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let i = self.next(repeated);
        for (pick, content) in &repeated.at {
            self.scratch.lengths[*pick] = i + 1;
            if self.position(*pick, repeated.counter)? != Some(i) {
                continue;
            }
            self.scratch.matched[*pick] = true;
            if let Content::Message(node) = content {
                self.scope(node, data, before, emit)?;
            }
        }
        for picks in &repeated.by_member {
            if picks.wanted.iter().all(|(pick, ..)| self.scratch.matched[*pick]) {
                continue;
            }
            let probe = probe(picks, data, before)?;
            for (pick, value, node) in &picks.wanted {
                if !self.scratch.matched[*pick] && probe.is(value) {
                    self.scratch.matched[*pick] = true;
                    self.scope(node, data, before, emit)?;
                }
            }
        }
        Ok(())
    }

    /// Returns the position that a pick means; `None` if a name of it is not in this message.
    fn position(&self, pick: usize, counter: usize) -> Result<Option<usize>, DecodeError> {
        let total = self.scratch.counters[self.n_counters + counter];
        match &self.requests.picks[pick].kind {
            PickKind::Index(index) if *index >= 0 => Ok(usize::try_from(*index).ok()),
            PickKind::Index(index) => Ok(element_index(*index, total)),
            PickKind::Parallel { table, wanted } => {
                let state = &self.scratch.tables[*table];
                if state.count != total {
                    let path = self.requests.picks[pick].path.clone();
                    return Err(DecodeError::LengthMismatch { path, names: state.count, values: total });
                }
                Ok(Some(state.index[*wanted]).filter(|i| *i != u32::MAX).map(|i| i as usize))
            }
            PickKind::Member { .. } => Ok(None),
        }
    }
}

#[inline]
fn find(node: &Node, number: u32) -> Option<&Action> {
    node.fields.iter().find(|(n, _)| *n == number).map(|(_, action)| action)
}

/// Reads a scalar after checking that it is written as its type says.
fn checked<'a>(
    wires: &mut Wires<'a>,
    kind: u8,
    number: u32,
    prim: Prim,
    wire: Wire,
) -> Result<Held<'a>, DecodeError> {
    let expected = wire_type(prim, wire);
    if kind != expected {
        return Err(wires.malformed(format!("field {number} has wire type {kind}, expected {expected}")));
    }
    wires.held(prim, wire)
}

/// Reads the member that names an element; absent means empty or 0.
fn probe<'a>(picks: &MemberPicks, data: &'a [u8], before: usize) -> Result<Probe<'a>, DecodeError> {
    let Some(((number, wire), way)) = picks.member.split_last() else { return Ok(Probe { held: None }) };
    let (mut data, mut before) = (data, before);
    for (number, _) in way {
        let mut wires = Wires::new(data, before);
        (data, before) = (&[], wires.offset());
        while !wires.is_done() {
            let (found, kind) = wires.tag()?;
            if found == *number && kind == LEN {
                (data, before) = wires.bytes()?;
            } else {
                wires.skip(found, kind)?;
            }
        }
    }
    let mut held = match picks.prim {
        Prim::Text | Prim::WideText | Prim::Bytes => Held::Text(Cow::Borrowed("")),
        _ => Held::Number(Number::I64(0)),
    };
    let mut wires = Wires::new(data, before);
    while !wires.is_done() {
        let (found, kind) = wires.tag()?;
        if found == *number {
            held = checked(&mut wires, kind, found, picks.prim, *wire)?;
        } else {
            wires.skip(found, kind)?;
        }
    }
    Ok(Probe { held: Some(held) })
}

fn emit_default<'a, E: Emit<'a>>(fallback: &Fallback, emit: &mut E) {
    let Fallback { slot, prim, value } = *fallback;
    match prim {
        Prim::Text | Prim::WideText => emit.text(slot, Cow::Borrowed("")),
        Prim::Bytes => emit.bytes(slot, Cow::Borrowed(&[])),
        Prim::F32 | Prim::F64 => emit.number(slot, Number::F64(value)),
        Prim::Bool => emit.number(slot, Number::Bool(value != 0.0)),
        Prim::U8 | Prim::U16 | Prim::U32 | Prim::U64 => emit.number(slot, Number::U64(value as u64)),
        _ => emit.number(slot, Number::I64(value as i64)),
    }
}
