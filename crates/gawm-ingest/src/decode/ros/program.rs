//! Compiles what a plan asks for into steps over the bytes of a message.
//!
//! A message is read once from its start to its end. What nobody asks for is skipped in as few steps as possible: runs of
//! fixed-size fields become one table look-up, since their extent depends on nothing but the position modulo 8.

use super::super::resolve::{Hop, PickKind, Request, Requests, Target};
use super::super::schema::{Base, Field, Many, Prim, TypeTable};

/// Sizes saturate here; nothing that large fits a payload.
const HUGE: u64 = u64::MAX / 4;

/// How far a run of fixed-size fields reaches, by the start position modulo 8 (the widest alignment of XCDR1).
pub(crate) type Extent = [u64; 8];

/// How to read all messages of a type.
#[derive(Clone, Debug, Default)]
pub(crate) struct Program {
    pub(crate) steps: Vec<Step>,
    /// Steps that skip a whole struct, by type.
    pub(crate) skips: Vec<Vec<Step>>,
    /// What one element of each type at least occupies.
    pub(crate) min_sizes: Vec<u64>,
    /// Whether a wide string occurs, whose character size implementations disagree on.
    pub(crate) has_wide: bool,
    /// Whether the message has no fields at all.
    pub(crate) is_empty: bool,
}

#[derive(Clone, Debug)]
pub(crate) enum Step {
    Skip(Extent),
    SkipText,
    SkipWide,
    SkipStruct(usize),
    SkipMany(Many, Element),
    /// Runs steps, then returns to where it began: names that stand behind what they pick from.
    Peek(Vec<Step>),
    Read {
        prim: Prim,
        slot: usize,
        /// Whether the next step reads the same value again.
        stay: bool,
    },
    /// An array of bytes, taken whole.
    Bytes {
        many: Many,
        slot: usize,
    },
    /// An array of names that picks from others.
    Keys {
        many: Many,
        wide: bool,
        table: usize,
    },
    /// Elements of an array of numbers.
    Numbers {
        many: Many,
        prim: Prim,
        size: usize,
        picks: Vec<NumberPick>,
    },
    /// Elements of an array of anything else.
    Elements {
        many: Many,
        element: Element,
        /// Picks by position.
        at: Vec<(usize, Vec<Step>)>,
        /// Picks by a member of the element.
        by_member: Vec<MemberPicks>,
    },
}

#[derive(Clone, Debug)]
pub(crate) struct NumberPick {
    /// Index into the plan's picks.
    pub(crate) pick: usize,
    pub(crate) slot: usize,
}

/// Picks that compare the same member.
#[derive(Clone, Debug)]
pub(crate) struct MemberPicks {
    /// Reads the member into slot 0.
    pub(crate) probe: Vec<Step>,
    pub(crate) wanted: Vec<MemberPick>,
}

#[derive(Clone, Debug)]
pub(crate) struct MemberPick {
    pub(crate) value: String,
    pub(crate) steps: Vec<Step>,
}

/// One element of an array, as far as skipping it goes.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Element {
    Fixed { extent: Extent, min_size: u64 },
    Text,
    Wide,
    Struct(usize),
}

/// Compiles the program for a plan. `aligned` holds for CDR, not for ROS 1.
pub(crate) fn compile(types: &TypeTable, requests: &Requests, aligned: bool) -> Program {
    let layouts = Layouts::new(types, aligned);
    let compiler = Compiler { types, requests, layouts: &layouts };
    let tails: Vec<Tail<'_>> =
        requests.all.iter().map(|r| Tail { hops: &r.hops, target: r.target }).collect();
    let steps = compiler.structure(types.root, &tails);
    let skips = (0..types.structs.len()).map(|index| compiler.structure(index, &[])).collect();
    Program {
        steps,
        skips,
        min_sizes: layouts.min_sizes.clone(),
        has_wide: has_wide(types),
        is_empty: types.root().fields.is_empty(),
    }
}

fn has_wide(types: &TypeTable) -> bool {
    types.structs.iter().flat_map(|s| &s.fields).any(|f| f.base == Base::Prim(Prim::WideText))
}

/// The rest of a request, seen from a place on its way.
#[derive(Clone, Copy)]
struct Tail<'a> {
    hops: &'a [Hop],
    target: Target,
}

impl<'a> Tail<'a> {
    fn of(request: &'a Request, from: usize) -> Self {
        Self { hops: &request.hops[from..], target: request.target }
    }

    fn rest(self) -> Self {
        Self { hops: &self.hops[1..], target: self.target }
    }
}

/// Extents of the types whose size is fixed, and least sizes of all.
pub(crate) struct Layouts {
    aligned: bool,
    /// By struct; `None` = its size varies.
    extents: Vec<Option<Extent>>,
    min_sizes: Vec<u64>,
}

impl Layouts {
    /// Structs come after the structs they hold, since the parser adds them in that order.
    pub(crate) fn new(types: &TypeTable, aligned: bool) -> Self {
        let mut layouts = Self { aligned, extents: Vec::new(), min_sizes: Vec::new() };
        for item in &types.structs {
            let mut extent = Some([0_u64; 8]);
            let mut min_size = 0_u64;
            for field in &item.fields {
                extent = extent.and_then(|e| Some(join(&e, &layouts.field_extent(field)?)));
                min_size = min_size.saturating_add(layouts.field_min(field)).min(HUGE);
            }
            // XCDR1 gives an empty struct one dummy byte.
            if item.fields.is_empty() && aligned {
                (extent, min_size) = (Some([1; 8]), 1);
            }
            layouts.extents.push(extent);
            layouts.min_sizes.push(min_size);
        }
        layouts
    }

    fn base_extent(&self, base: Base) -> Option<Extent> {
        match base {
            Base::Prim(prim) => {
                let size = prim.size()? as u64;
                let mut extent = [size; 8];
                if self.aligned {
                    for (phase, reach) in extent.iter_mut().enumerate() {
                        *reach += (size - phase as u64 % size) % size;
                    }
                }
                Some(extent)
            }
            Base::Struct(index) => self.extents[index],
        }
    }

    fn field_extent(&self, field: &Field) -> Option<Extent> {
        let one = self.base_extent(field.base)?;
        match field.many {
            Many::One => Some(one),
            Many::Fixed(n) => Some(std::array::from_fn(|phase| repeat(&one, phase, n as u64))),
            Many::Dynamic => None,
        }
    }

    pub(crate) fn base_min(&self, base: Base) -> u64 {
        match base {
            Base::Prim(prim) => prim.size().unwrap_or(4) as u64,
            Base::Struct(index) => self.min_sizes[index],
        }
    }

    fn field_min(&self, field: &Field) -> u64 {
        match field.many {
            Many::One => self.base_min(field.base),
            Many::Fixed(n) => self.base_min(field.base).saturating_mul(n as u64).min(HUGE),
            Many::Dynamic => 4,
        }
    }

    fn element(&self, base: Base) -> Element {
        match (self.base_extent(base), base) {
            (Some(extent), _) => Element::Fixed { extent, min_size: self.base_min(base) },
            (None, Base::Prim(Prim::WideText)) => Element::Wide,
            (None, Base::Prim(_)) => Element::Text,
            (None, Base::Struct(index)) => Element::Struct(index),
        }
    }
}

/// Puts one extent behind another.
fn join(first: &Extent, second: &Extent) -> Extent {
    std::array::from_fn(|phase| {
        let reach = first[phase];
        let next = (phase as u64 + reach) % 8;
        reach.saturating_add(second[usize::try_from(next).unwrap_or(0)]).min(HUGE)
    })
}

/// Returns how far `n` elements reach from a position with the given remainder modulo 8.
///
/// The remainders form a cycle of at most 8 after at most 8 elements, so this costs no more for a million elements.
pub(crate) fn repeat(extent: &Extent, phase: usize, n: u64) -> u64 {
    let mut phase = phase % 8;
    let mut total = 0_u64;
    let mut left = n;
    let step = |phase: &mut usize| {
        let reach = extent[*phase];
        *phase = (*phase + usize::try_from(reach % 8).unwrap_or(0)) % 8;
        reach
    };
    for _ in 0..8 {
        if left == 0 {
            return total.min(HUGE);
        }
        total = total.saturating_add(step(&mut phase));
        left -= 1;
    }
    let (start, mut length, mut sum) = (phase, 0_u64, 0_u64);
    loop {
        sum = sum.saturating_add(step(&mut phase));
        length += 1;
        if phase == start {
            break;
        }
    }
    total = total.saturating_add((left / length).saturating_mul(sum));
    for _ in 0..left % length {
        total = total.saturating_add(step(&mut phase));
    }
    total.min(HUGE)
}

struct Compiler<'a> {
    types: &'a TypeTable,
    requests: &'a Requests,
    layouts: &'a Layouts,
}

impl Compiler<'_> {
    fn structure(&self, index: usize, tails: &[Tail<'_>]) -> Vec<Step> {
        let item = &self.types.structs[index];
        let mut out = Steps::default();
        if item.fields.is_empty() {
            out.skip(self.layouts.extents[index].unwrap_or([0; 8]));
        }
        out.steps.extend(self.peek(index, tails));
        for (at, field) in item.fields.iter().enumerate() {
            let mine: Vec<Tail<'_>> =
                tails.iter().filter(|t| t.hops.first() == Some(&Hop::Field(at))).map(|t| t.rest()).collect();
            self.field(field, &mine, &mut out);
        }
        out.steps
    }

    /// Names that stand behind a field that needs them are read ahead.
    fn peek(&self, index: usize, tails: &[Tail<'_>]) -> Option<Step> {
        let first = |tail: &Tail<'_>| match tail.hops.first() {
            Some(Hop::Field(at)) => *at,
            _ => usize::MAX,
        };
        let late: Vec<Tail<'_>> = tails
            .iter()
            .filter(|keys| {
                let Target::Keys(table) = keys.target else { return false };
                tails.iter().any(|user| self.uses(user, table) && first(user) <= first(keys))
            })
            .copied()
            .collect();
        let last = late.iter().map(first).max()?;
        let item = &self.types.structs[index];
        let mut out = Steps::default();
        for (at, field) in item.fields.iter().enumerate().take(last + 1) {
            let mine: Vec<Tail<'_>> =
                late.iter().filter(|t| t.hops.first() == Some(&Hop::Field(at))).map(|t| t.rest()).collect();
            self.field(field, &mine, &mut out);
        }
        Some(Step::Peek(out.steps))
    }

    fn uses(&self, tail: &Tail<'_>, table: usize) -> bool {
        tail.hops.iter().any(|hop| match hop {
            Hop::Pick(id) => {
                matches!(self.requests.picks[*id].kind, PickKind::Parallel { table: used, .. } if used == table)
            }
            Hop::Field(_) => false,
        })
    }

    fn field(&self, field: &Field, tails: &[Tail<'_>], out: &mut Steps) {
        if tails.is_empty() {
            return self.skip(field, out);
        }
        match field.many {
            Many::One => self.single(field.base, tails, out),
            many => self.array(many, field.base, tails, out),
        }
    }

    fn skip(&self, field: &Field, out: &mut Steps) {
        if let Some(extent) = self.layouts.field_extent(field) {
            return out.skip(extent);
        }
        out.steps.push(match (field.many, self.layouts.element(field.base)) {
            (Many::One, Element::Text) => Step::SkipText,
            (Many::One, Element::Wide) => Step::SkipWide,
            (Many::One, Element::Struct(index)) => Step::SkipStruct(index),
            (many, element) => Step::SkipMany(many, element),
        });
    }

    fn single(&self, base: Base, tails: &[Tail<'_>], out: &mut Steps) {
        match base {
            Base::Struct(index) => out.steps.extend(self.structure(index, tails)),
            Base::Prim(prim) => {
                for (i, tail) in tails.iter().enumerate() {
                    let Target::Slot(slot) = tail.target else { continue };
                    out.steps.push(Step::Read { prim, slot, stay: i + 1 < tails.len() });
                }
            }
        }
    }

    fn array(&self, many: Many, base: Base, tails: &[Tail<'_>], out: &mut Steps) {
        let wide = base == Base::Prim(Prim::WideText);
        let (whole, picked): (Vec<Tail<'_>>, Vec<Tail<'_>>) = tails.iter().partition(|t| t.hops.is_empty());
        for (i, tail) in whole.iter().enumerate() {
            let step = match tail.target {
                Target::Keys(table) => Step::Keys { many, wide, table },
                Target::Slot(slot) => Step::Bytes { many, slot },
            };
            let is_last = i + 1 == whole.len() && picked.is_empty();
            out.steps.push(if is_last { step } else { Step::Peek(vec![step]) });
        }
        if picked.is_empty() {
            return;
        }
        out.steps.push(match base {
            Base::Prim(prim) if prim.is_number() => {
                let picks = picked.iter().filter_map(|tail| match (tail.hops, tail.target) {
                    ([Hop::Pick(pick)], Target::Slot(slot)) => Some(NumberPick { pick: *pick, slot }),
                    _ => None,
                });
                Step::Numbers { many, prim, size: prim.size().unwrap_or(1), picks: picks.collect() }
            }
            _ => self.elements(many, base, &picked),
        });
    }

    fn elements(&self, many: Many, base: Base, tails: &[Tail<'_>]) -> Step {
        let mut ids: Vec<usize> = Vec::new();
        for tail in tails {
            if let Some(Hop::Pick(id)) = tail.hops.first()
                && !ids.contains(id)
            {
                ids.push(*id);
            }
        }
        let mut at = Vec::new();
        let mut by_member: Vec<(Vec<usize>, MemberPicks)> = Vec::new();
        for id in ids {
            let mine: Vec<Tail<'_>> =
                tails.iter().filter(|t| t.hops.first() == Some(&Hop::Pick(id))).map(|t| t.rest()).collect();
            let mut steps = Steps::default();
            self.single(base, &mine, &mut steps);
            let PickKind::Member { member, value } = &self.requests.picks[id].kind else {
                at.push((id, steps.steps));
                continue;
            };
            let pick = MemberPick { value: value.clone(), steps: steps.steps };
            match by_member.iter_mut().find(|(key, _)| key == member) {
                Some((_, picks)) => picks.wanted.push(pick),
                None => {
                    let probe = self.probe(base, member);
                    by_member.push((member.clone(), MemberPicks { probe, wanted: vec![pick] }));
                }
            }
        }
        let by_member = by_member.into_iter().map(|(_, picks)| picks).collect();
        Step::Elements { many, element: self.layouts.element(base), at, by_member }
    }

    /// Reads one member of an element; what follows it is not looked at.
    fn probe(&self, base: Base, member: &[usize]) -> Vec<Step> {
        let request =
            Request { hops: member.iter().map(|at| Hop::Field(*at)).collect(), target: Target::Slot(0) };
        let mut out = Steps::default();
        self.single(base, &[Tail::of(&request, 0)], &mut out);
        let end = out.steps.iter().position(|s| matches!(s, Step::Read { .. })).map_or(0, |i| i + 1);
        out.steps.truncate(end);
        out.steps
    }
}

/// Steps in the making; neighbouring skips become one.
#[derive(Default)]
struct Steps {
    steps: Vec<Step>,
}

impl Steps {
    fn skip(&mut self, extent: Extent) {
        if let Some(Step::Skip(last)) = self.steps.last_mut() {
            *last = join(last, &extent);
        } else {
            self.steps.push(Step::Skip(extent));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn repeat_equals_single_steps() {
        // A struct of u8 and f64, one of three bytes, and one of u16 and u8.
        let cases: [Extent; 3] = [[16, 15, 14, 13, 12, 11, 10, 9], [3; 8], [3, 4, 3, 4, 3, 4, 3, 4]];
        for extent in cases {
            for phase in 0..8 {
                for n in 0..70_u64 {
                    let mut pos = phase as u64;
                    for _ in 0..n {
                        pos += extent[usize::try_from(pos % 8).unwrap()];
                    }
                    assert_eq!(repeat(&extent, phase, n), pos - phase as u64, "{extent:?} {phase} {n}");
                }
            }
        }
        assert_eq!(repeat(&[HUGE; 8], 0, u64::MAX), HUGE);
    }
}
