//! Compiles what a plan asks for into a tree that follows the message types.

use super::super::resolve::{Hop, PickKind, Requests, Target};
use super::super::schema::{Base, Field, Many, Prim, TypeTable, Wire};

/// What is wanted of a message of one type.
#[derive(Clone, Debug, Default)]
pub(crate) struct Node {
    /// By field number.
    pub(crate) fields: Vec<(u32, Action)>,
    /// Values of scalars that a writer leaves out when they are the default.
    pub(crate) defaults: Vec<Fallback>,
    /// Counters of this scope (the message or array element, with all that it holds singly).
    pub(crate) counters: std::ops::Range<usize>,
    /// Whether names or lengths must be known before the values are read.
    pub(crate) needs_scan: bool,
}

/// A default to fill in.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Fallback {
    pub(crate) slot: usize,
    pub(crate) prim: Prim,
    pub(crate) value: f64,
}

#[derive(Clone, Debug)]
pub(crate) enum Action {
    Scalar { prim: Prim, wire: Wire, slots: Vec<usize> },
    Message(Node),
    Repeated(Repeated),
}

/// A repeated field.
#[derive(Clone, Debug)]
pub(crate) struct Repeated {
    pub(crate) counter: usize,
    /// The elements' type; `None` = messages.
    pub(crate) scalar: Option<(Prim, Wire)>,
    /// Names that pick elsewhere.
    pub(crate) keys: Option<usize>,
    /// Picks by position.
    pub(crate) at: Vec<(usize, Content)>,
    /// Picks by a member of the element.
    pub(crate) by_member: Vec<MemberPicks>,
}

/// What is wanted of a picked element.
#[derive(Clone, Debug)]
pub(crate) enum Content {
    Slots(Vec<usize>),
    Message(Node),
}

#[derive(Clone, Debug)]
pub(crate) struct MemberPicks {
    /// Fields that lead to the member.
    pub(crate) member: Vec<(u32, Wire)>,
    pub(crate) prim: Prim,
    /// Pick, name, content.
    pub(crate) wanted: Vec<(usize, String, Node)>,
}

/// Compiles the tree; returns it with the number of counters it needs.
pub(crate) fn compile(types: &TypeTable, requests: &Requests) -> (Node, usize) {
    let tails: Vec<Tail<'_>> =
        requests.all.iter().map(|r| Tail { hops: &r.hops, target: r.target }).collect();
    let mut compiler = Compiler { types, requests, n_counters: 0 };
    let root = compiler.scope(types.root, &tails);
    (root, compiler.n_counters)
}

#[derive(Clone, Copy)]
struct Tail<'a> {
    hops: &'a [Hop],
    target: Target,
}

struct Compiler<'a> {
    types: &'a TypeTable,
    requests: &'a Requests,
    n_counters: usize,
}

impl Compiler<'_> {
    /// Compiles a message that counts its own repeated fields.
    fn scope(&mut self, index: usize, tails: &[Tail<'_>]) -> Node {
        let start = self.n_counters;
        let mut node = self.message(index, tails);
        node.counters = start..self.n_counters;
        node
    }

    fn message(&mut self, index: usize, tails: &[Tail<'_>]) -> Node {
        let mut node = Node::default();
        let types = self.types;
        for (at, field) in types.structs[index].fields.iter().enumerate() {
            let mine: Vec<Tail<'_>> = tails
                .iter()
                .filter(|t| t.hops.first() == Some(&Hop::Field(at)))
                .map(|t| Tail { hops: &t.hops[1..], target: t.target })
                .collect();
            if !mine.is_empty() {
                let action = self.field(field, &mine, &mut node);
                node.fields.push((field.wire.number, action));
            }
        }
        node
    }

    fn field(&mut self, field: &Field, tails: &[Tail<'_>], node: &mut Node) -> Action {
        match (field.many, field.base) {
            (Many::One, Base::Struct(index)) => {
                let inner = self.message(index, tails);
                node.needs_scan |= inner.needs_scan;
                Action::Message(inner)
            }
            (Many::One, Base::Prim(prim)) => {
                let slots = slots(tails);
                if let Some(value) = field.wire.default {
                    node.defaults.extend(slots.iter().map(|slot| Fallback { slot: *slot, prim, value }));
                }
                Action::Scalar { prim, wire: field.wire, slots }
            }
            (_, base) => {
                let repeated = self.repeated(field, base, tails);
                node.needs_scan |= repeated.keys.is_some() || self.needs_totals(tails);
                Action::Repeated(repeated)
            }
        }
    }

    fn needs_totals(&self, tails: &[Tail<'_>]) -> bool {
        tails.iter().any(|tail| match tail.hops.first() {
            Some(Hop::Pick(id)) => match self.requests.picks[*id].kind {
                PickKind::Index(index) => index < 0,
                PickKind::Parallel { .. } => true,
                PickKind::Member { .. } => false,
            },
            _ => false,
        })
    }

    fn repeated(&mut self, field: &Field, base: Base, tails: &[Tail<'_>]) -> Repeated {
        let counter = self.n_counters;
        self.n_counters += 1;
        let mut out = Repeated {
            counter,
            scalar: match base {
                Base::Prim(prim) => Some((prim, field.wire)),
                Base::Struct(_) => None,
            },
            keys: tails.iter().find_map(|t| match (t.hops.is_empty(), t.target) {
                (true, Target::Keys(table)) => Some(table),
                _ => None,
            }),
            at: Vec::new(),
            by_member: Vec::new(),
        };
        let mut seen: Vec<usize> = Vec::new();
        for tail in tails {
            let Some(Hop::Pick(id)) = tail.hops.first() else { continue };
            if seen.contains(id) {
                continue;
            }
            seen.push(*id);
            let mine: Vec<Tail<'_>> = tails
                .iter()
                .filter(|t| t.hops.first() == Some(&Hop::Pick(*id)))
                .map(|t| Tail { hops: &t.hops[1..], target: t.target })
                .collect();
            self.pick(base, *id, &mine, &mut out);
        }
        out
    }

    fn pick(&mut self, base: Base, id: usize, tails: &[Tail<'_>], out: &mut Repeated) {
        let Base::Struct(index) = base else {
            out.at.push((id, Content::Slots(slots(tails))));
            return;
        };
        let node = self.scope(index, tails);
        let PickKind::Member { member, value } = &self.requests.picks[id].kind else {
            out.at.push((id, Content::Message(node)));
            return;
        };
        let (member, prim) = self.member(index, member);
        let picked = (id, value.clone(), node);
        match out.by_member.iter_mut().find(|p| p.member == member) {
            Some(picks) => picks.wanted.push(picked),
            None => out.by_member.push(MemberPicks { member, prim, wanted: vec![picked] }),
        }
    }

    fn member(&self, index: usize, member: &[usize]) -> (Vec<(u32, Wire)>, Prim) {
        let mut index = index;
        let mut prim = Prim::Text;
        let mut out = Vec::with_capacity(member.len());
        for at in member {
            let field = &self.types.structs[index].fields[*at];
            out.push((field.wire.number, field.wire));
            match field.base {
                Base::Struct(inner) => index = inner,
                Base::Prim(last) => prim = last,
            }
        }
        (out, prim)
    }
}

fn slots(tails: &[Tail<'_>]) -> Vec<usize> {
    tails
        .iter()
        .filter_map(|t| match t.target {
            Target::Slot(slot) => Some(slot),
            Target::Keys(_) => None,
        })
        .collect()
}
