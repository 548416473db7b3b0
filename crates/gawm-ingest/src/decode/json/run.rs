//! Runs a [`Node`] over one JSON message.

use std::borrow::Cow;

use base64::Engine as _;
use base64::engine::general_purpose::{GeneralPurpose, GeneralPurposeConfig};

use super::super::error::DecodeError;
use super::super::protobuf::run::finish;
use super::super::resolve::{Hop, PickKind, Requests, Target, closest_first};
use super::super::ros::run::element_index;
use super::super::row::{Emit, Number, Probe, Scratch};
use super::super::schema::Prim;
use super::node::{Keyed, Node};
use super::scan::Scan;

/// Base64 with or without padding: writers do not agree on it.
const BASE64: GeneralPurpose = GeneralPurpose::new(
    &base64::alphabet::STANDARD,
    GeneralPurposeConfig::new().with_decode_padding_mode(base64::engine::DecodePaddingMode::Indifferent),
);

/// Most names that an error lists.
const MAX_LISTED: usize = 64;

/// The objects around a place, innermost first.
#[derive(Clone, Copy)]
struct Scope<'s> {
    /// Position of the object's brace.
    start: usize,
    outer: Option<&'s Scope<'s>>,
}

/// Runs `node` over a message; the first `width` slots must get values.
pub(crate) fn run<'a, E: Emit<'a>>(
    node: &Node,
    requests: &Requests,
    payload: &'a [u8],
    width: usize,
    scratch: &mut Scratch,
    emit: &mut E,
) -> Result<(), DecodeError> {
    scratch.matched.fill(false);
    scratch.set.fill(false);
    scratch.lengths.fill(usize::MAX);
    scratch.positions.clear();
    let mut scan = Scan::new(payload);
    let mut machine = Machine { requests, scratch, width };
    machine.value(node, &mut scan, None, emit)?;
    scan.end()?;
    for request in &requests.all {
        let Target::Slot(slot) = request.target else { continue };
        if slot >= width || scratch.set[slot] || requests.leaves[slot].is_optional {
            continue;
        }
        // A list that is not there is a fault; one without the element is only a message without it.
        let unmatched = request.hops.iter().find_map(|hop| match hop {
            Hop::Pick(id) if !scratch.matched[*id] => Some(*id),
            _ => None,
        });
        let path = match unmatched {
            None => &requests.leaves[slot].path,
            Some(id) if scratch.lengths[id] == usize::MAX => &requests.picks[id].path,
            Some(_) => continue,
        };
        return Err(DecodeError::FieldAbsent { path: path.clone(), present: names_at(payload, path) });
    }
    finish(requests, width, scratch)
}

/// Lists the members that stand where a path ends, closest first.
fn names_at(payload: &[u8], path: &str) -> Vec<String> {
    let plain = path.split(['[', '"']).next().unwrap_or("");
    let mut scan = Scan::new(payload);
    for part in plain.split('.') {
        let start = scan.pos();
        if !find_member(&mut scan, start, part).unwrap_or(false) {
            let mut names = Vec::new();
            scan.seek(start);
            collect_names(&mut scan, &mut names).ok(); // What was read until a fault is still of use.
            closest_first(&mut names, part);
            return names;
        }
    }
    Vec::new()
}

fn collect_names(scan: &mut Scan<'_>, names: &mut Vec<String>) -> Result<(), DecodeError> {
    let mut more = scan.open(b'{', b'}', "an object")?;
    while more && names.len() < MAX_LISTED {
        names.push(scan.key()?.into_owned());
        scan.skip()?;
        more = scan.more(b'}')?;
    }
    Ok(())
}

/// Goes to a member of the object at `start`; returns whether it is there.
fn find_member(scan: &mut Scan<'_>, start: usize, name: &str) -> Result<bool, DecodeError> {
    scan.seek(start);
    if scan.peek() != b'{' {
        return Ok(false);
    }
    let mut more = scan.open(b'{', b'}', "an object")?;
    while more {
        if scan.key()? == name {
            return Ok(true);
        }
        scan.skip()?;
        more = scan.more(b'}')?;
    }
    Ok(false)
}

struct Machine<'p, 's> {
    requests: &'p Requests,
    scratch: &'s mut Scratch,
    /// Slots from here on are parts of the stamp, which may be of any shape or missing.
    width: usize,
}

impl Machine<'_, '_> {
    fn value<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        scan: &mut Scan<'a>,
        scope: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let start = scan.pos();
        match scan.peek() {
            b'{' if !node.fields.is_empty() => self.object(node, scan, scope, emit)?,
            b'[' if !(node.at.is_empty() && node.keyed.is_empty()) => self.array(node, scan, scope, emit)?,
            _ if node.slots.is_empty() => return scan.skip(),
            _ => {}
        }
        if !node.slots.is_empty() {
            scan.seek(start);
            self.leaf(&node.slots, scan, emit)?;
        }
        Ok(())
    }

    fn object<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        scan: &mut Scan<'a>,
        outer: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let scope = Scope { start: scan.pos(), outer };
        let mut more = scan.open(b'{', b'}', "an object")?;
        while more {
            let key = scan.key()?;
            match node.fields.iter().find(|(name, _)| *name == key) {
                Some((_, inner)) => self.value(inner, scan, Some(&scope), emit)?,
                None => scan.skip()?,
            }
            more = scan.more(b'}')?;
        }
        Ok(())
    }

    fn array<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        scan: &mut Scan<'a>,
        scope: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let start = scan.pos();
        let base = self.scratch.positions.len();
        let mut more = scan.open(b'[', b']', "an array")?;
        while more {
            scan.peek();
            self.scratch.positions.push(scan.pos());
            scan.skip()?;
            more = scan.more(b']')?;
        }
        let end = scan.pos();
        let result = self.picks(node, (start, base), scan, scope, emit);
        self.scratch.positions.truncate(base);
        scan.seek(end);
        result
    }

    /// Reads the picked elements of the array at `start`, whose elements' positions begin at `base`.
    fn picks<'a, E: Emit<'a>>(
        &mut self,
        node: &Node,
        (start, base): (usize, usize),
        scan: &mut Scan<'a>,
        scope: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let count = self.scratch.positions.len() - base;
        for (pick, inner) in &node.at {
            self.scratch.lengths[*pick] = count;
            if let PickKind::Index(index) = self.requests.picks[*pick].kind
                && let Some(i) = element_index(index, count)
            {
                scan.seek(self.scratch.positions[base + i]);
                self.scratch.matched[*pick] = true;
                self.value(inner, scan, scope, emit)?;
            }
        }
        for keyed in &node.keyed {
            scan.seek(start);
            let is_struct = scan.open(b'[', b']', "an array")? && scan.peek() == b'{';
            let own = is_struct && self.by_member(keyed, base, count, scan, scope, emit)?;
            if !own {
                self.by_parallel(keyed, base, count, scan, scope, emit)?;
            }
        }
        Ok(())
    }

    /// Picks objects by their own member; returns false if the first does not have it.
    fn by_member<'a, E: Emit<'a>>(
        &mut self,
        keyed: &Keyed,
        base: usize,
        count: usize,
        scan: &mut Scan<'a>,
        scope: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<bool, DecodeError> {
        for i in 0..count {
            let at = self.scratch.positions[base + i];
            scan.seek(at);
            let probe = probe(keyed, scan)?;
            if i == 0 && probe.held.is_none() {
                return Ok(false);
            }
            for (pick, value, inner) in &keyed.wanted {
                self.scratch.lengths[*pick] = count;
                if !self.scratch.matched[*pick] && probe.is(value) {
                    self.scratch.matched[*pick] = true;
                    scan.seek(at);
                    self.value(inner, scan, scope, emit)?;
                }
            }
        }
        Ok(true)
    }

    /// Picks elements by an array of names beside this one or around it.
    fn by_parallel<'a, E: Emit<'a>>(
        &mut self,
        keyed: &Keyed,
        base: usize,
        count: usize,
        scan: &mut Scan<'a>,
        scope: Option<&Scope<'_>>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let names = match (&keyed.member[..], scope) {
            ([name], Some(scope)) => names_array(scan, scope, name)?,
            _ => None,
        };
        let Some(names) = names else {
            // An empty array of objects is a message without the element.
            let is_empty = count == 0;
            for (pick, ..) in &keyed.wanted {
                self.scratch.lengths[*pick] = count;
                if !is_empty {
                    let path = self.requests.picks[*pick].path.clone();
                    return Err(DecodeError::FieldAbsent { path, present: Vec::new() });
                }
            }
            return Ok(());
        };
        for (pick, value, inner) in &keyed.wanted {
            let path = &self.requests.picks[*pick].path;
            self.scratch.lengths[*pick] = count;
            if names.len() != count {
                return Err(DecodeError::LengthMismatch {
                    path: path.clone(),
                    names: names.len(),
                    values: count,
                });
            }
            let Some(i) = names.iter().position(|name| name == value) else {
                let present = names.iter().take(MAX_LISTED).map(|n| n.clone().into_owned()).collect();
                return Err(DecodeError::NameAbsent { path: path.clone(), name: value.clone(), present });
            };
            scan.seek(self.scratch.positions[base + i]);
            self.scratch.matched[*pick] = true;
            self.value(inner, scan, scope, emit)?;
        }
        Ok(())
    }

    fn leaf<'a, E: Emit<'a>>(
        &mut self,
        slots: &[usize],
        scan: &mut Scan<'a>,
        emit: &mut E,
    ) -> Result<(), DecodeError> {
        let start = scan.pos();
        for &slot in slots {
            scan.seek(start);
            let leaf = &self.requests.leaves[slot];
            let wrong = |expected, got: &str| DecodeError::WrongType {
                path: leaf.path.clone(),
                expected,
                got: got.to_owned(),
            };
            if leaf.prim == Prim::Bytes {
                emit.bytes(slot, Cow::Owned(blob(scan, &leaf.path)?));
                self.scratch.set[slot] = true;
                continue;
            }
            match scan.peek() {
                b'"' => emit.text(slot, scan.string()?),
                b't' | b'f' if scan.literal("true") => emit.number(slot, Number::Bool(true)),
                b't' | b'f' if scan.literal("false") => emit.number(slot, Number::Bool(false)),
                b'n' if scan.literal("null") => continue,
                b'{' | b'[' if slot >= self.width => continue,
                b'{' => return Err(wrong("a value", "an object")),
                b'[' => return Err(wrong("a value", "an array")),
                _ => emit.number(slot, scan.number()?),
            }
            self.scratch.set[slot] = true;
        }
        // Whatever was read of it, the value ends where it ends.
        scan.seek(start);
        scan.skip()
    }
}

/// Reads base64 text, or an array of byte values.
fn blob(scan: &mut Scan<'_>, path: &str) -> Result<Vec<u8>, DecodeError> {
    let wrong = |got: String| DecodeError::WrongType {
        path: path.to_owned(),
        expected: "base64 text or an array of bytes",
        got,
    };
    if scan.peek() == b'"' {
        let text = scan.string()?;
        return match BASE64.decode(text.as_bytes()) {
            Ok(bytes) => Ok(bytes),
            Err(e) => Err(wrong(format!("text that is not base64 ({e})"))),
        };
    }
    if scan.peek() != b'[' {
        return Err(wrong("another type".to_owned()));
    }
    let mut out = Vec::new();
    let mut more = scan.open(b'[', b']', "an array")?;
    while more {
        match scan.number()? {
            Number::I64(v) if (-128..256).contains(&v) => out.push((v & 0xff) as u8),
            other => return Err(wrong(format!("the number {}", other.widen()))),
        }
        more = scan.more(b']')?;
    }
    Ok(out)
}

/// Finds the array of names in the innermost object that has one.
fn names_array<'a>(
    scan: &mut Scan<'a>,
    scope: &Scope<'_>,
    name: &str,
) -> Result<Option<Vec<Cow<'a, str>>>, DecodeError> {
    let mut at = Some(scope);
    while let Some(scope) = at {
        if find_member(scan, scope.start, name)? && scan.peek() == b'[' {
            let mut names = Vec::new();
            let mut more = scan.open(b'[', b']', "an array")?;
            while more {
                names.push(scan.string()?);
                more = scan.more(b']')?;
            }
            return Ok(Some(names));
        }
        at = scope.outer;
    }
    Ok(None)
}

/// Reads the member that names the object at the current place; leaves the place anywhere.
fn probe<'a>(keyed: &Keyed, scan: &mut Scan<'a>) -> Result<Probe<'a>, DecodeError> {
    let mut probe = Probe { held: None };
    for name in &keyed.member {
        let start = scan.pos();
        if !find_member(scan, start, name)? {
            return Ok(probe);
        }
    }
    match scan.peek() {
        b'"' => probe.text(0, scan.string()?),
        b'{' | b'[' | b'n' | b't' | b'f' => {}
        _ => probe.number(0, scan.number()?),
    }
    Ok(probe)
}
