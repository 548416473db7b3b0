//! Field paths against a type table: which values a plan has to pick, in the terms of the schema.

use std::collections::BTreeMap;
use std::ops::Range;

use super::error::CompileError;
use super::path::{FieldPath, Segment, write_segment};
use super::schema::{Base, Field, Many, Prim, TypeTable};

/// Most values that all paths of a plan may stand for.
pub(crate) const MAX_WIDTH: usize = 65_536;

/// Deepest struct that a path may expand to.
const MAX_EXPANSION_DEPTH: usize = 16;

/// What paths of one plan stand for.
#[derive(Clone, Debug, Default)]
pub(crate) struct Requests {
    pub(crate) all: Vec<Request>,
    pub(crate) leaves: Vec<Leaf>,
    pub(crate) picks: Vec<Pick>,
    pub(crate) tables: Vec<KeyTable>,
}

/// One value to read: the way to it, and where it goes.
#[derive(Clone, Debug)]
pub(crate) struct Request {
    pub(crate) hops: Vec<Hop>,
    pub(crate) target: Target,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Hop {
    /// Index of a field of the struct.
    Field(usize),
    /// Index into [`Requests::picks`]: an element of the array.
    Pick(usize),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Target {
    /// Index into [`Requests::leaves`].
    Slot(usize),
    /// Index into [`Requests::tables`]: the array of names itself.
    Keys(usize),
}

/// A value as the plan delivers it.
#[derive(Clone, Debug)]
pub(crate) struct Leaf {
    /// Its path, in full.
    pub(crate) path: String,
    pub(crate) prim: Prim,
    /// Whether a message may lack it.
    pub(crate) is_optional: bool,
}

/// How an element of an array is picked.
#[derive(Clone, Debug)]
pub(crate) struct Pick {
    pub(crate) kind: PickKind,
    /// The path up to and with the selector, for errors.
    pub(crate) path: String,
}

#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum PickKind {
    /// Negative counts from the end.
    Index(i64),
    /// The element whose own member has this value.
    Member { member: Vec<usize>, value: String },
    /// The element whose entry in an array of names has the name `wanted` of the table.
    Parallel { table: usize, wanted: usize },
}

/// An array of names that picks elements of others.
#[derive(Clone, Debug)]
pub(crate) struct KeyTable {
    pub(crate) wanted: Vec<String>,
}

/// What the caller can take at the end of a path.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Want {
    /// Scalars: numbers, and text for those that ask.
    Scalars,
    /// A whole `uint8[]` or `bytes`, borrowed.
    Bytes,
    /// As scalars, where a message has the member; only of messages without a schema.
    Optional,
}

/// Resolves paths one after another; slots are given in order.
pub(crate) struct Resolver<'a> {
    topic: &'a str,
    types: &'a TypeTable,
    requests: Requests,
    pick_ids: BTreeMap<(Vec<Hop>, PickKind), usize>,
    table_ids: BTreeMap<Vec<Hop>, usize>,
    wanted_ids: BTreeMap<(usize, String), usize>,
}

/// Where a path has come to.
#[derive(Clone, Copy)]
enum Place {
    Struct(usize),
    Scalar(Prim),
    Array(Base, Many),
}

impl<'a> Resolver<'a> {
    pub(crate) fn new(topic: &'a str, types: &'a TypeTable) -> Self {
        Self {
            topic,
            types,
            requests: Requests::default(),
            pick_ids: BTreeMap::new(),
            table_ids: BTreeMap::new(),
            wanted_ids: BTreeMap::new(),
        }
    }

    /// Adds the values of one path; returns their slots.
    pub(crate) fn add(&mut self, path: &FieldPath, want: Want) -> Result<Range<usize>, CompileError> {
        let start = self.requests.leaves.len();
        let mut walk = Walk { path, hops: Vec::new(), scopes: vec![(0, self.types.root)] };
        self.descend(&mut walk, Place::Struct(self.types.root), path.segments(), want)?;
        Ok(start..self.requests.leaves.len())
    }

    pub(crate) fn finish(self) -> Requests {
        self.requests
    }

    fn descend(
        &mut self,
        walk: &mut Walk<'_>,
        place: Place,
        rest: &[Segment],
        want: Want,
    ) -> Result<(), CompileError> {
        let Some((segment, rest)) = rest.split_first() else {
            return self.expand(walk, place, want, 0);
        };
        match (segment, place) {
            (Segment::Field(name), Place::Struct(index)) => {
                let types = self.types;
                let at = self.find(walk.path, index, name)?;
                self.enter(walk, &types.structs[index].fields[at], at, |this, walk, place| {
                    this.descend(walk, place, rest, want)
                })
            }
            (Segment::Index(i), Place::Array(base, many)) => {
                self.check_index(walk, *i, many)?;
                self.pick(walk, base, PickKind::Index(*i), rest, want)
            }
            (Segment::Slice { start, end }, Place::Array(base, many)) => {
                let end = self.slice_end(walk, *end, many)?;
                for i in *start..end {
                    self.check_index(walk, i64::from(i), many)?;
                    self.pick(walk, base, PickKind::Index(i64::from(i)), rest, want)?;
                }
                Ok(())
            }
            (Segment::Key { member, value }, Place::Array(base, _)) => {
                let kind = self.key_kind(walk, base, member, value)?;
                self.pick(walk, base, kind, rest, want)
            }
            (segment, place) => Err(self.misfit(walk, segment, place)),
        }
    }

    /// Steps into a field, calls `next` there, and steps back.
    fn enter(
        &mut self,
        walk: &mut Walk<'_>,
        field: &Field,
        index: usize,
        next: impl FnOnce(&mut Self, &mut Walk<'_>, Place) -> Result<(), CompileError>,
    ) -> Result<(), CompileError> {
        walk.hops.push(Hop::Field(index));
        let place = match (field.many, field.base) {
            (Many::One, Base::Prim(prim)) => Place::Scalar(prim),
            (Many::One, Base::Struct(inner)) => {
                walk.scopes.push((walk.hops.len(), inner));
                Place::Struct(inner)
            }
            (many, base) => Place::Array(base, many),
        };
        let depth = walk.scopes.len();
        let result = next(self, walk, place);
        if matches!(place, Place::Struct(_)) {
            walk.scopes.truncate(depth - 1);
        }
        walk.hops.pop();
        result
    }

    fn pick(
        &mut self,
        walk: &mut Walk<'_>,
        base: Base,
        kind: PickKind,
        rest: &[Segment],
        want: Want,
    ) -> Result<(), CompileError> {
        let id = self.pick_id(&walk.hops, kind);
        walk.hops.push(Hop::Pick(id));
        let depth = walk.scopes.len();
        let place = match base {
            Base::Prim(prim) => Place::Scalar(prim),
            Base::Struct(inner) => {
                walk.scopes.push((walk.hops.len(), inner));
                Place::Struct(inner)
            }
        };
        let result = self.descend(walk, place, rest, want);
        walk.scopes.truncate(depth);
        walk.hops.pop();
        result
    }

    /// Ends a path: a scalar, all elements of an array of fixed length, all numbers of a struct.
    fn expand(
        &mut self,
        walk: &mut Walk<'_>,
        place: Place,
        want: Want,
        depth: usize,
    ) -> Result<(), CompileError> {
        match place {
            Place::Scalar(prim) => {
                let is_blob = prim == Prim::Bytes;
                if is_blob != (want == Want::Bytes) && want == Want::Scalars {
                    return Err(self.wrong_shape(walk, "a number, bool or text", "bytes".to_owned()));
                }
                self.leaf(walk, prim)
            }
            Place::Array(Base::Prim(Prim::U8 | Prim::I8), _) if want == Want::Bytes => {
                self.leaf(walk, Prim::Bytes)
            }
            Place::Array(base, Many::Fixed(n)) => {
                for i in 0..n {
                    let id = self.pick_id(&walk.hops, PickKind::Index(i64::try_from(i).unwrap_or(i64::MAX)));
                    walk.hops.push(Hop::Pick(id));
                    let inner = match base {
                        Base::Prim(prim) => Place::Scalar(prim),
                        Base::Struct(index) => Place::Struct(index),
                    };
                    let result = self.expand(walk, inner, want, depth + 1);
                    walk.hops.pop();
                    result?;
                }
                Ok(())
            }
            Place::Array(base, _) => {
                let example = match base {
                    Base::Prim(_) => "[0:7] or [name=\"...\"]",
                    Base::Struct(_) => "[0] or [name=\"...\"], then a field",
                };
                let expected =
                    format!("a selection such as {example}, since the schema does not fix the length");
                Err(self.wrong_shape(walk, &expected, "a whole array".to_owned()))
            }
            Place::Struct(index) => self.expand_struct(walk, index, want, depth),
        }
    }

    fn expand_struct(
        &mut self,
        walk: &mut Walk<'_>,
        index: usize,
        want: Want,
        depth: usize,
    ) -> Result<(), CompileError> {
        let types = self.types;
        let item = &types.structs[index];
        let is_numeric = item.fields.iter().all(|f| {
            f.many != Many::Dynamic
                && match f.base {
                    Base::Prim(prim) => prim.is_number(),
                    Base::Struct(_) => true,
                }
        });
        if !is_numeric || item.fields.is_empty() || depth > MAX_EXPANSION_DEPTH {
            let names: Vec<&str> = item.fields.iter().map(|f| f.name.as_str()).take(40).collect();
            let expected = format!("one of its fields: {}", names.join(", "));
            return Err(self.wrong_shape(walk, &expected, format!("the whole {}", item.name)));
        }
        for (i, field) in item.fields.iter().enumerate() {
            self.enter(walk, field, i, |this, walk, place| this.expand(walk, place, want, depth + 1))?;
        }
        Ok(())
    }

    fn leaf(&mut self, walk: &Walk<'_>, prim: Prim) -> Result<(), CompileError> {
        let slot = self.requests.leaves.len();
        if slot >= MAX_WIDTH {
            return Err(CompileError::TooWide {
                topic: self.topic.to_owned(),
                path: walk.path.to_string(),
                limit: MAX_WIDTH,
            });
        }
        self.requests.leaves.push(Leaf { path: self.text(&walk.hops), prim, is_optional: false });
        self.requests.all.push(Request { hops: walk.hops.clone(), target: Target::Slot(slot) });
        Ok(())
    }

    fn pick_id(&mut self, hops: &[Hop], kind: PickKind) -> usize {
        let key = (hops.to_vec(), kind.clone());
        if let Some(id) = self.pick_ids.get(&key) {
            return *id;
        }
        let id = self.requests.picks.len();
        self.requests.picks.push(Pick { kind, path: String::new() });
        let path = self.text(&[hops, &[Hop::Pick(id)]].concat());
        self.requests.picks[id].path = path;
        self.pick_ids.insert(key, id);
        id
    }

    /// Finds what `[member="value"]` means: the element's own member, else an array of names beside or above the array.
    fn key_kind(
        &mut self,
        walk: &Walk<'_>,
        base: Base,
        member: &[String],
        value: &str,
    ) -> Result<PickKind, CompileError> {
        if let Base::Struct(index) = base
            && let Some(member) = self.member_path(index, member)
        {
            return Ok(PickKind::Member { member, value: value.to_owned() });
        }
        if let [name] = member {
            for &(depth, scope) in walk.scopes.iter().rev() {
                let item = &self.types.structs[scope];
                let Some(at) = item.find(name) else { continue };
                let field = &item.fields[at];
                if field.many != Many::One && matches!(field.base, Base::Prim(Prim::Text | Prim::WideText)) {
                    let hops = [&walk.hops[..depth], &[Hop::Field(at)]].concat();
                    return Ok(self.parallel(hops, value));
                }
            }
        }
        let names: Vec<String> = self.key_candidates(walk, base);
        let expected = if names.is_empty() {
            "an index such as [0], since nothing here holds names".to_owned()
        } else {
            format!("one of the fields that hold names: {}", names.join(", "))
        };
        Err(self.wrong_shape(walk, &expected, format!("[{}=...]", member.join("."))))
    }

    fn parallel(&mut self, hops: Vec<Hop>, value: &str) -> PickKind {
        let table = match self.table_ids.get(&hops) {
            Some(table) => *table,
            None => {
                let table = self.requests.tables.len();
                self.requests.tables.push(KeyTable { wanted: Vec::new() });
                self.requests.all.push(Request { hops: hops.clone(), target: Target::Keys(table) });
                self.table_ids.insert(hops, table);
                table
            }
        };
        let names = &mut self.requests.tables[table].wanted;
        let wanted = *self.wanted_ids.entry((table, value.to_owned())).or_insert_with(|| {
            names.push(value.to_owned());
            names.len() - 1
        });
        PickKind::Parallel { table, wanted }
    }

    fn member_path(&self, index: usize, member: &[String]) -> Option<Vec<usize>> {
        let mut out = Vec::with_capacity(member.len());
        let mut index = index;
        for (i, name) in member.iter().enumerate() {
            let at = self.types.structs[index].find(name)?;
            let field = &self.types.structs[index].fields[at];
            out.push(at);
            match (field.many, field.base, i + 1 == member.len()) {
                (Many::One, Base::Prim(prim), true) if prim != Prim::Bytes => return Some(out),
                (Many::One, Base::Struct(inner), false) => index = inner,
                _ => return None,
            }
        }
        None
    }

    fn key_candidates(&self, walk: &Walk<'_>, base: Base) -> Vec<String> {
        let text_fields = |index: usize, arrays: bool| {
            self.types.structs[index]
                .fields
                .iter()
                .filter(move |f| {
                    matches!(f.base, Base::Prim(Prim::Text | Prim::WideText))
                        && (f.many != Many::One) == arrays
                })
                .map(|f| f.name.clone())
        };
        let mut names: Vec<String> = Vec::new();
        if let Base::Struct(index) = base {
            names.extend(text_fields(index, false));
        }
        for &(_, scope) in walk.scopes.iter().rev() {
            names.extend(text_fields(scope, true));
        }
        names
    }

    fn find(&self, path: &FieldPath, index: usize, name: &str) -> Result<usize, CompileError> {
        let item = &self.types.structs[index];
        if let Some(at) =
            item.find(name).or_else(|| time_alias(item.fields.iter().map(|f| f.name.as_str()), name))
        {
            return Ok(at);
        }
        let mut present: Vec<String> = item.fields.iter().map(|f| f.name.clone()).collect();
        closest_first(&mut present, name);
        Err(CompileError::UnknownField {
            topic: self.topic.to_owned(),
            path: path.to_string(),
            type_name: item.name.clone(),
            name: name.to_owned(),
            present,
        })
    }

    fn check_index(&self, walk: &Walk<'_>, index: i64, many: Many) -> Result<(), CompileError> {
        match many {
            Many::Fixed(n)
                if usize::try_from(index.unsigned_abs()).is_ok_and(|i| i >= n + usize::from(index < 0)) =>
            {
                Err(self.wrong_shape(walk, &format!("an index below {n}"), format!("[{index}]")))
            }
            _ => Ok(()),
        }
    }

    fn slice_end(&self, walk: &Walk<'_>, end: Option<u32>, many: Many) -> Result<u32, CompileError> {
        match (end, many) {
            (Some(end), _) => Ok(end),
            (None, Many::Fixed(n)) if n <= MAX_WIDTH => Ok(u32::try_from(n).unwrap_or(u32::MAX)),
            _ => Err(self.wrong_shape(
                walk,
                "a slice with an end such as [0:7], since the schema does not fix the length",
                "an open slice".to_owned(),
            )),
        }
    }

    fn misfit(&self, walk: &Walk<'_>, segment: &Segment, place: Place) -> CompileError {
        let mut got = String::new();
        write_segment(&mut got, segment, false).expect("writing to a String does not fail");
        let expected = match place {
            Place::Struct(index) => {
                let names: Vec<&str> =
                    self.types.structs[index].fields.iter().map(|f| f.name.as_str()).take(40).collect();
                format!("a field of {}: {}", self.types.structs[index].name, names.join(", "))
            }
            Place::Scalar(prim) => format!("the end of the path, since this is one {}", prim.name()),
            Place::Array(base, _) => {
                let names = self.key_candidates(walk, base);
                let key = names.first().map_or(String::new(), |n| format!(" or [{n}=\"...\"]"));
                format!("an element of the array, [0]{key}")
            }
        };
        self.wrong_shape(walk, &expected, got)
    }

    fn wrong_shape(&self, walk: &Walk<'_>, expected: &str, got: String) -> CompileError {
        CompileError::WrongShape {
            topic: self.topic.to_owned(),
            path: walk.path.to_string(),
            expected: expected.to_owned(),
            got,
        }
    }

    /// Writes the path that hops stand for.
    fn text(&self, hops: &[Hop]) -> String {
        let mut segments = Vec::with_capacity(hops.len());
        let mut index = self.types.root;
        let mut element = Base::Struct(index);
        for hop in hops {
            match hop {
                Hop::Field(at) => {
                    let field = &self.types.structs[index].fields[*at];
                    segments.push(Segment::Field(field.name.clone()));
                    element = field.base;
                    if let (Base::Struct(inner), Many::One) = (field.base, field.many) {
                        index = inner;
                    }
                }
                Hop::Pick(id) => {
                    segments.push(self.pick_segment(*id, element));
                    if let Base::Struct(inner) = element {
                        index = inner;
                    }
                }
            }
        }
        FieldPath::from_segments(segments).to_string()
    }

    fn pick_segment(&self, id: usize, element: Base) -> Segment {
        match &self.requests.picks[id].kind {
            PickKind::Index(i) => Segment::Index(*i),
            PickKind::Member { member, value } => {
                let mut names = Vec::new();
                let mut base = element;
                for at in member {
                    let Base::Struct(index) = base else { break };
                    let field = &self.types.structs[index].fields[*at];
                    names.push(field.name.clone());
                    base = field.base;
                }
                Segment::Key { member: names, value: value.clone() }
            }
            PickKind::Parallel { table, wanted } => {
                let name =
                    self.requests.all.iter().find(|r| r.target == Target::Keys(*table)).and_then(|r| {
                        let Some(Hop::Field(at)) = r.hops.last() else { return None };
                        let owner = self.owner(&r.hops);
                        Some(self.types.structs[owner].fields[*at].name.clone())
                    });
                let value = self.requests.tables[*table].wanted[*wanted].clone();
                Segment::Key { member: vec![name.unwrap_or_default()], value }
            }
        }
    }

    /// Returns the struct whose field the last hop is.
    fn owner(&self, hops: &[Hop]) -> usize {
        let mut index = self.types.root;
        for hop in &hops[..hops.len().saturating_sub(1)] {
            if let Hop::Field(at) = hop
                && let Base::Struct(inner) = self.types.structs[index].fields[*at].base
            {
                index = inner;
            }
        }
        index
    }
}

struct Walk<'p> {
    path: &'p FieldPath,
    hops: Vec<Hop>,
    /// The structs around the current place, outermost first, with the number of hops to each.
    scopes: Vec<(usize, usize)>,
}

/// The names under which seconds and nanoseconds go.
pub(crate) const SECONDS: [&str; 4] = ["sec", "secs", "seconds", "s"];
pub(crate) const NANOS: [&str; 6] = ["nanosec", "nsec", "nanos", "nsecs", "nanoseconds", "ns"];

fn time_alias<'a>(names: impl Iterator<Item = &'a str>, wanted: &str) -> Option<usize> {
    let family: &[&str] = if SECONDS.contains(&wanted) {
        &SECONDS
    } else if NANOS.contains(&wanted) {
        &NANOS
    } else {
        return None;
    };
    names.enumerate().find(|(_, n)| family.contains(n)).map(|(i, _)| i)
}

/// Sorts names by their likeness to `wanted`, the most alike first.
pub(crate) fn closest_first(names: &mut [String], wanted: &str) {
    names.sort_by_cached_key(|name| (distance(&name.to_lowercase(), &wanted.to_lowercase()), name.clone()));
}

/// Levenshtein distance of the first 64 bytes.
fn distance(a: &str, b: &str) -> usize {
    let (a, b) = (&a.as_bytes()[..a.len().min(64)], &b.as_bytes()[..b.len().min(64)]);
    let mut row: Vec<usize> = (0..=b.len()).collect();
    for (i, x) in a.iter().enumerate() {
        let mut diagonal = row[0];
        row[0] = i + 1;
        for (j, y) in b.iter().enumerate() {
            let substitute = diagonal + usize::from(x != y);
            diagonal = row[j + 1];
            row[j + 1] = substitute.min(diagonal + 1).min(row[j] + 1);
        }
    }
    row[b.len()]
}
