//! Compiles paths into a tree that follows the members of a JSON message.
//!
//! A JSON schema is optional and often incomplete, so names are not checked when the plan is compiled: a member that a message
//! lacks is an error of that message, which lists what is there.

use std::collections::BTreeMap;

use super::super::error::CompileError;
use super::super::path::{FieldPath, Segment};
use super::super::resolve::{
    Hop, Leaf, MAX_WIDTH, NANOS, Pick, PickKind, Request, Requests, SECONDS, Target, Want,
};
use super::super::schema::{Base, Many, Prim, TypeTable};

/// Deepest struct that a path may expand to.
const MAX_EXPANSION_DEPTH: usize = 16;

/// What is wanted of a value.
#[derive(Clone, Debug, Default)]
pub(crate) struct Node {
    pub(crate) fields: Vec<(String, Node)>,
    /// Picks by position.
    pub(crate) at: Vec<(usize, Node)>,
    pub(crate) keyed: Vec<Keyed>,
    /// Slots of the value itself.
    pub(crate) slots: Vec<usize>,
}

/// Picks by names under the same member.
#[derive(Clone, Debug)]
pub(crate) struct Keyed {
    pub(crate) member: Vec<String>,
    /// Pick, name, content.
    pub(crate) wanted: Vec<(usize, String, Node)>,
}

/// Compiles paths one after another; slots are given in order.
pub(crate) struct Compiler<'a> {
    topic: &'a str,
    types: &'a TypeTable,
    pub(crate) root: Node,
    pub(crate) requests: Requests,
    pick_ids: BTreeMap<Vec<Segment>, usize>,
}

impl<'a> Compiler<'a> {
    pub(crate) fn new(topic: &'a str, types: &'a TypeTable) -> Self {
        Self { topic, types, root: Node::default(), requests: Requests::default(), pick_ids: BTreeMap::new() }
    }

    /// Adds the values of one path; returns their slots.
    pub(crate) fn add(
        &mut self,
        path: &FieldPath,
        want: Want,
    ) -> Result<std::ops::Range<usize>, CompileError> {
        let start = self.requests.leaves.len();
        let mut done = Vec::new();
        self.expand(path, &mut done, path.segments(), want)?;
        Ok(start..self.requests.leaves.len())
    }

    /// Writes slices out, then what the schema knows of the end of the path.
    fn expand(
        &mut self,
        path: &FieldPath,
        done: &mut Vec<Segment>,
        rest: &[Segment],
        want: Want,
    ) -> Result<(), CompileError> {
        let Some((segment, rest)) = rest.split_first() else {
            return self.expand_end(path, done, want, 0);
        };
        let Segment::Slice { start, end } = segment else {
            done.push(segment.clone());
            let result = self.expand(path, done, rest, want);
            done.pop();
            return result;
        };
        let end = match (end, self.place(done)) {
            (Some(end), _) => *end,
            (None, Some((_, Many::Fixed(n)))) if n <= MAX_WIDTH => u32::try_from(n).unwrap_or(u32::MAX),
            (None, _) => {
                return Err(self.wrong_shape(path, "a slice with an end such as [0:7]", "an open slice"));
            }
        };
        for i in *start..end {
            done.push(Segment::Index(i64::from(i)));
            let result = self.expand(path, done, rest, want);
            done.pop();
            result?;
        }
        Ok(())
    }

    fn expand_end(
        &mut self,
        path: &FieldPath,
        done: &mut Vec<Segment>,
        want: Want,
        depth: usize,
    ) -> Result<(), CompileError> {
        if depth > MAX_EXPANSION_DEPTH {
            return Err(self.wrong_shape(
                path,
                "a path that ends at values",
                "a struct nested more than 16 deep",
            ));
        }
        match self.place(done) {
            Some((Base::Struct(index), Many::One)) if self.is_numeric(index, 0) => {
                let types = self.types;
                for field in &types.structs[index].fields {
                    done.push(Segment::Field(field.name.clone()));
                    let result = self.expand_end(path, done, want, depth + 1);
                    done.pop();
                    result?;
                }
                Ok(())
            }
            Some((_, Many::Fixed(n))) if want == Want::Scalars && n <= MAX_WIDTH => {
                for i in 0..n {
                    done.push(Segment::Index(i64::try_from(i).unwrap_or(i64::MAX)));
                    let result = self.expand_end(path, done, want, depth + 1);
                    done.pop();
                    result?;
                }
                Ok(())
            }
            Some((_, Many::Dynamic)) if want == Want::Scalars => Err(self.wrong_shape(
                path,
                "a selection such as [0:7] or [name=\"...\"], since the schema does not fix the length",
                "a whole array",
            )),
            _ => self.leaf(path, done, want),
        }
    }

    /// Tells whether a struct is declared with nothing but numbers.
    fn is_numeric(&self, index: usize, depth: usize) -> bool {
        let fields = &self.types.structs[index].fields;
        depth < MAX_EXPANSION_DEPTH
            && !fields.is_empty()
            && fields.iter().all(|f| match (f.base, f.many) {
                (_, Many::Dynamic) => false,
                (Base::Prim(prim), _) => prim.is_number(),
                (Base::Struct(inner), _) => self.is_numeric(inner, depth + 1),
            })
    }

    /// Returns what the schema says of a path, where it says something.
    fn place(&self, segments: &[Segment]) -> Option<(Base, Many)> {
        let mut at = (Base::Struct(self.types.root), Many::One);
        for segment in segments {
            at = match (segment, at) {
                (Segment::Field(name), (Base::Struct(index), Many::One)) => {
                    let item = &self.types.structs[index];
                    let field = &item.fields[item.find(name)?];
                    (field.base, field.many)
                }
                (Segment::Index(_) | Segment::Key { .. }, (base, Many::Fixed(_) | Many::Dynamic)) => {
                    (base, Many::One)
                }
                _ => return None,
            };
        }
        Some(at)
    }

    fn leaf(&mut self, path: &FieldPath, done: &[Segment], want: Want) -> Result<(), CompileError> {
        let slot = self.requests.leaves.len();
        if slot >= MAX_WIDTH {
            return Err(CompileError::TooWide {
                topic: self.topic.to_owned(),
                path: path.to_string(),
                limit: MAX_WIDTH,
            });
        }
        let declared = match self.place(done) {
            Some((Base::Prim(prim), Many::One)) => prim,
            _ => Prim::F64,
        };
        let prim = if want == Want::Bytes { Prim::Bytes } else { declared };
        if prim == Prim::Bytes && want == Want::Scalars {
            return Err(self.wrong_shape(path, "a number, bool or text", "base64 bytes"));
        }
        let is_optional = want == Want::Optional;
        self.requests.leaves.push(Leaf { path: text(done), prim, is_optional });
        let hops = self.insert(done, slot);
        self.requests.all.push(Request { hops, target: Target::Slot(slot) });
        Ok(())
    }

    /// Puts a slot into the tree; returns the picks on the way.
    fn insert(&mut self, segments: &[Segment], slot: usize) -> Vec<Hop> {
        let mut hops = Vec::new();
        let mut node = &mut self.root;
        for (i, segment) in segments.iter().enumerate() {
            if let Segment::Field(name) = segment {
                node = field_node(node, name);
                continue;
            }
            let next = self.pick_ids.len();
            let id = *self.pick_ids.entry(segments[..=i].to_vec()).or_insert(next);
            let kind = match segment {
                Segment::Index(index) => PickKind::Index(*index),
                Segment::Key { value, .. } => PickKind::Member { member: Vec::new(), value: value.clone() },
                Segment::Field(_) | Segment::Slice { .. } => continue,
            };
            if id == next {
                self.requests.picks.push(Pick { kind, path: text(&segments[..=i]) });
            }
            hops.push(Hop::Pick(id));
            node = picked_node(node, id, segment);
        }
        node.slots.push(slot);
        hops
    }

    fn wrong_shape(&self, path: &FieldPath, expected: &str, got: &str) -> CompileError {
        CompileError::WrongShape {
            topic: self.topic.to_owned(),
            path: path.to_string(),
            expected: expected.to_owned(),
            got: got.to_owned(),
        }
    }
}

fn text(segments: &[Segment]) -> String {
    FieldPath::from_segments(segments.to_vec()).to_string()
}

fn field_node<'n>(node: &'n mut Node, name: &str) -> &'n mut Node {
    let at = node.fields.iter().position(|(n, _)| n == name).unwrap_or_else(|| {
        node.fields.push((name.to_owned(), Node::default()));
        node.fields.len() - 1
    });
    &mut node.fields[at].1
}

fn picked_node<'n>(node: &'n mut Node, id: usize, segment: &Segment) -> &'n mut Node {
    let Segment::Key { member, value } = segment else {
        let at = node.at.iter().position(|(p, _)| *p == id).unwrap_or_else(|| {
            node.at.push((id, Node::default()));
            node.at.len() - 1
        });
        return &mut node.at[at].1;
    };
    let group = node.keyed.iter().position(|k| k.member == *member).unwrap_or_else(|| {
        node.keyed.push(Keyed { member: member.clone(), wanted: Vec::new() });
        node.keyed.len() - 1
    });
    let wanted = &mut node.keyed[group].wanted;
    let at = wanted.iter().position(|(p, ..)| *p == id).unwrap_or_else(|| {
        wanted.push((id, value.clone(), Node::default()));
        wanted.len() - 1
    });
    &mut wanted[at].2
}

impl Compiler<'_> {
    /// Adds the places at which a message may have its stamp, of itself or of the element that `prefix` leads to.
    ///
    /// They all share the two slots from `width` on; what a message lacks is not filled in.
    pub(crate) fn add_stamps(&mut self, prefix: &[Segment], width: usize) {
        let prefixes: &[&[Segment]] = if prefix.is_empty() { &[&[]] } else { &[&[], prefix] };
        for prefix in prefixes {
            for way in [&["header", "stamp"][..], &["stamp"], &["timestamp"]] {
                let way = way.iter().map(|name| Segment::Field((*name).to_owned()));
                let way: Vec<Segment> = prefix.iter().cloned().chain(way).collect();
                self.add_stamp(&way, width);
            }
        }
    }

    /// Adds one place: an object of seconds and nanoseconds, or one value.
    pub(crate) fn add_stamp(&mut self, way: &[Segment], width: usize) {
        for slot in [width, width + 1] {
            if self.requests.leaves.len() <= slot {
                self.requests.leaves.push(Leaf { path: text(way), prim: Prim::F64, is_optional: true });
            }
        }
        self.insert(way, width);
        for (names, slot) in [(&SECONDS[..], width), (&NANOS[..], width + 1)] {
            for name in names {
                let mut way = way.to_vec();
                way.push(Segment::Field((*name).to_owned()));
                self.insert(&way, slot);
            }
        }
    }
}
