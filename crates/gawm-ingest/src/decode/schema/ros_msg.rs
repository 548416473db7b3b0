//! Parser of ROS message definitions (`ros1msg`, `ros2msg`): the text of a .msg file, then blocks for the types it uses.

use std::collections::BTreeMap;

use super::ros_library::Library;
use super::{Base, Field, Many, Prim, StructType, TypeTable, Wire};

/// Deepest nesting of types; ROS itself has no need for more than about ten.
const MAX_DEPTH: usize = 48;

/// Most fields of one schema with all its types.
const MAX_FIELDS: usize = 50_000;

/// Which of the two ROS generations wrote the text; they share a grammar but not all type names.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Dialect {
    Ros1,
    Ros2,
}

/// Why a definition is refused.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Fault {
    NotText { offset: usize },
    Service,
    Line { line: usize, text: String, expected: &'static str },
    UnknownType { field: String, type_name: String },
    Recursive { type_name: String },
    TooLarge,
}

/// The fields of one definition, with the types by name.
#[derive(Clone, Debug, Default)]
struct Definition {
    fields: Vec<Member>,
}

#[derive(Clone, Debug)]
struct Member {
    name: String,
    type_name: String,
    many: Many,
}

/// Parses the schema of one channel. Types that the text does not define come from `library`.
pub(crate) fn parse_schema(
    name: &str,
    data: &[u8],
    dialect: Dialect,
    library: &Library,
) -> Result<TypeTable, Fault> {
    let text = std::str::from_utf8(data).map_err(|e| Fault::NotText { offset: e.valid_up_to() })?;
    let root = canonical(name);
    let mut blocks: BTreeMap<String, Definition> = BTreeMap::new();
    let mut current = (root.clone(), Definition::default());
    let mut in_first = true;
    for (i, raw) in text.trim_start_matches('\u{feff}').lines().enumerate() {
        let line = raw.trim();
        if is_separator(line) {
            in_first = false;
            continue;
        }
        if let Some(next) = line.strip_prefix("MSG:") {
            let (name, definition) =
                std::mem::replace(&mut current, (canonical(next.trim()), Definition::default()));
            blocks.entry(name).or_insert(definition);
            continue;
        }
        if in_first && line == "---" {
            return Err(Fault::Service);
        }
        if let Some(member) = parse_line(line, i + 1)? {
            current.1.fields.push(member);
        }
    }
    blocks.entry(current.0).or_insert(current.1);
    Linker {
        blocks: &blocks,
        dialect,
        library,
        table: TypeTable::default(),
        done: BTreeMap::new(),
        n_fields: 0,
    }
    .link(&root)
}

/// Builds the type `name` from the library alone; `None` if the library does not have it.
pub(crate) fn library_type(
    name: &str,
    dialect: Dialect,
    library: &Library,
) -> Option<Result<TypeTable, Fault>> {
    let text = library.find(&canonical(name), dialect)?;
    Some(parse_schema(name, text.as_bytes(), dialect, library))
}

/// Parses one file of a library.
pub(crate) fn check_text(name: &str, data: &[u8]) -> Result<(), Fault> {
    let text = std::str::from_utf8(data).map_err(|e| Fault::NotText { offset: e.valid_up_to() })?;
    for (i, line) in text.lines().enumerate() {
        if line.trim() == "---" {
            return Err(Fault::Service);
        }
        parse_line(line.trim(), i + 1)?;
    }
    debug_assert!(!name.is_empty(), "a message file has a name");
    Ok(())
}

/// Turns `pkg/msg/Type` into `pkg/Type`.
pub(crate) fn canonical(name: &str) -> String {
    let mut parts = name.split('/').filter(|p| !p.is_empty());
    let (first, last) = (parts.next().unwrap_or(""), parts.next_back());
    last.map_or_else(|| first.to_owned(), |last| format!("{first}/{last}"))
}

fn is_separator(line: &str) -> bool {
    line.len() >= 3 && line.bytes().all(|b| b == b'=')
}

/// Parses one line; `None` for blank lines, comments and constants.
fn parse_line(line: &str, number: usize) -> Result<Option<Member>, Fault> {
    let fault = |expected| Fault::Line { line: number, text: line.chars().take(80).collect(), expected };
    let code = line.split('#').next().unwrap_or("").trim();
    if code.is_empty() {
        return Ok(None);
    }
    let (type_text, rest) =
        code.split_once(char::is_whitespace).ok_or_else(|| fault("a type and a field name"))?;
    let rest = rest.trim_start();
    let name_len = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
    let (name, tail) = rest.split_at(name_len);
    if name.is_empty() || name.starts_with(|c: char| c.is_ascii_digit()) {
        return Err(fault("a field name of letters, digits and _"));
    }
    if tail.trim_start().starts_with('=') {
        return Ok(None); // a constant
    }
    if !tail.is_empty() && !tail.starts_with(char::is_whitespace) {
        return Err(fault("the end of the line, a default or \"=\" after the name"));
    }
    let (type_name, many) =
        parse_type(type_text).ok_or_else(|| fault("a type such as float64[3] or pkg/Type"))?;
    Ok(Some(Member { name: name.to_owned(), type_name, many }))
}

/// Splits `string<=10[<=5]` into the type's name and its array form; bounds do not change the encoding.
fn parse_type(text: &str) -> Option<(String, Many)> {
    let (head, many) = match text.split_once('[') {
        None => (text, Many::One),
        Some((head, tail)) => {
            let inner = tail.strip_suffix(']')?;
            let many = match inner.strip_prefix("<=") {
                Some(bound) => {
                    bound.parse::<u32>().ok()?;
                    Many::Dynamic
                }
                None if inner.is_empty() => Many::Dynamic,
                None => Many::Fixed(usize::try_from(inner.parse::<u32>().ok()?).ok()?),
            };
            (head, many)
        }
    };
    let base = match head.split_once("<=") {
        Some((base, bound)) => {
            bound.parse::<u64>().ok()?;
            base
        }
        None => head,
    };
    let is_name = |b: u8| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'/');
    (!base.is_empty() && base.bytes().all(is_name) && base.as_bytes()[0].is_ascii_alphabetic())
        .then(|| (base.to_owned(), many))
}

fn primitive(name: &str, dialect: Dialect) -> Option<Prim> {
    Some(match name {
        "bool" => Prim::Bool,
        // ROS 1 has byte = int8 and char = uint8; in ROS 2 both are unsigned.
        "byte" => match dialect {
            Dialect::Ros1 => Prim::I8,
            Dialect::Ros2 => Prim::U8,
        },
        "char" | "uint8" => Prim::U8,
        "int8" => Prim::I8,
        "int16" => Prim::I16,
        "uint16" => Prim::U16,
        "int32" => Prim::I32,
        "uint32" => Prim::U32,
        "int64" => Prim::I64,
        "uint64" => Prim::U64,
        "float32" | "float" => Prim::F32,
        "float64" | "double" => Prim::F64,
        "string" => Prim::Text,
        "wstring" => Prim::WideText,
        _ => return None,
    })
}

struct Linker<'a> {
    blocks: &'a BTreeMap<String, Definition>,
    dialect: Dialect,
    library: &'a Library,
    table: TypeTable,
    done: BTreeMap<String, Option<usize>>,
    n_fields: usize,
}

impl Linker<'_> {
    fn link(mut self, root: &str) -> Result<TypeTable, Fault> {
        let definition = self.blocks.get(root).cloned().unwrap_or_default();
        self.table.root = self.add(root, &definition, 0)?;
        Ok(self.table)
    }

    fn add(&mut self, name: &str, definition: &Definition, depth: usize) -> Result<usize, Fault> {
        self.n_fields += definition.fields.len();
        if depth > MAX_DEPTH || self.n_fields > MAX_FIELDS {
            return Err(Fault::TooLarge);
        }
        self.done.insert(name.to_owned(), None);
        let mut fields = Vec::with_capacity(definition.fields.len());
        for member in &definition.fields {
            let base = self.base(name, member, depth)?;
            fields.push(Field { name: member.name.clone(), base, many: member.many, wire: Wire::default() });
        }
        self.table.structs.push(StructType { name: name.to_owned(), fields, ..StructType::default() });
        let index = self.table.structs.len() - 1;
        self.done.insert(name.to_owned(), Some(index));
        Ok(index)
    }

    fn base(&mut self, owner: &str, member: &Member, depth: usize) -> Result<Base, Fault> {
        if let Some(prim) = primitive(&member.type_name, self.dialect) {
            return Ok(Base::Prim(prim));
        }
        let builtin = matches!(member.type_name.as_str(), "time" | "duration");
        let (name, definition) = if builtin && !self.blocks.contains_key(&member.type_name) {
            (member.type_name.clone(), self.time_definition(&member.type_name))
        } else {
            self.resolve(owner, &member.type_name).ok_or_else(|| Fault::UnknownType {
                field: format!("{owner}.{}", member.name),
                type_name: member.type_name.clone(),
            })?
        };
        match self.done.get(&name) {
            Some(Some(index)) => Ok(Base::Struct(*index)),
            Some(None) => Err(Fault::Recursive { type_name: name }),
            None => Ok(Base::Struct(self.add(&name, &definition, depth + 1)?)),
        }
    }

    /// Finds a type as ROS does: a full name, `Header`, the owner's package; then any type of that bare name.
    fn resolve(&self, owner: &str, type_name: &str) -> Option<(String, Definition)> {
        let full = canonical(type_name);
        let mut candidates = Vec::new();
        if full.contains('/') {
            candidates.push(full.clone());
        } else {
            if let Some((package, _)) = owner.split_once('/') {
                candidates.push(format!("{package}/{full}"));
            }
            if full == "Header" {
                candidates.push("std_msgs/Header".to_owned());
            }
            candidates.push(full.clone());
        }
        for name in &candidates {
            if let Some(found) = self.blocks.get(name) {
                return Some((name.clone(), found.clone()));
            }
        }
        for name in &candidates {
            if let Some(text) = self.library.find(name, self.dialect) {
                return Some((name.clone(), Self::parse_library(text)));
            }
        }
        let bare = full.rsplit('/').next().unwrap_or(&full);
        let mut same =
            self.blocks.iter().filter(|(name, _)| name.rsplit('/').next() == Some(bare) && *name != owner);
        match (same.next(), same.next()) {
            (Some((name, found)), None) => Some((name.clone(), found.clone())),
            _ => None,
        }
    }

    fn parse_library(text: &str) -> Definition {
        let fields = text.lines().filter_map(|l| parse_line(l.trim(), 0).ok().flatten()).collect();
        Definition { fields }
    }

    /// The builtin `time` and `duration`: seconds and nanoseconds, unsigned only for ROS 1 `time`.
    fn time_definition(&self, type_name: &str) -> Definition {
        let (seconds, nanos, name) = match (self.dialect, type_name) {
            (Dialect::Ros1, "time") => ("uint32", "uint32", "nsec"),
            (Dialect::Ros1, _) => ("int32", "int32", "nsec"),
            (Dialect::Ros2, _) => ("int32", "uint32", "nanosec"),
        };
        let member = |name: &str, type_name: &str| Member {
            name: name.to_owned(),
            type_name: type_name.to_owned(),
            many: Many::One,
        };
        Definition { fields: vec![member("sec", seconds), member(name, nanos)] }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(name: &str, text: &str) -> Result<TypeTable, Fault> {
        parse_schema(name, text.as_bytes(), Dialect::Ros2, &Library::builtin())
    }

    fn field(table: &TypeTable, i: usize) -> (&str, Base, Many) {
        let f = &table.root().fields[i];
        (&f.name, f.base, f.many)
    }

    #[test]
    fn fields_arrays_bounds_constants_and_comments() {
        let text = "# a comment\nint32 A=5 # constant\nstring B= x # y\nfloat64[3] fixed\nstring<=10[<=5] names\n\
                    uint8[] data  # trailing\nint32 count 7\nstring s \"a # b\"\nint32[] list [1, 2]\nwstring w";
        let table = parse("p/msg/T", text).unwrap();
        assert_eq!(table.root().name, "p/T");
        assert_eq!(field(&table, 0), ("fixed", Base::Prim(Prim::F64), Many::Fixed(3)));
        assert_eq!(field(&table, 1), ("names", Base::Prim(Prim::Text), Many::Dynamic));
        assert_eq!(field(&table, 2), ("data", Base::Prim(Prim::U8), Many::Dynamic));
        assert_eq!(field(&table, 3), ("count", Base::Prim(Prim::I32), Many::One));
        assert_eq!(field(&table, 4), ("s", Base::Prim(Prim::Text), Many::One));
        assert_eq!(field(&table, 5), ("list", Base::Prim(Prim::I32), Many::Dynamic));
        assert_eq!(field(&table, 6), ("w", Base::Prim(Prim::WideText), Many::One));
        assert_eq!(table.root().fields.len(), 7);
    }

    #[test]
    fn types_resolve_as_ros_does() {
        let text = "Header header\nOther o\nq/Thing t\ntime stamp\n====\nMSG: p/Other\nint8 x\n====\nMSG: q/Thing\nPoint p\n====\nMSG: q/Point\nint16 z\n";
        let table = parse("p/msg/T", text).unwrap();
        let Base::Struct(header) = table.root().fields[0].base else { panic!("a struct") };
        assert_eq!(table.structs[header].name, "std_msgs/Header");
        let Base::Struct(thing) = table.root().fields[2].base else { panic!("a struct") };
        let Base::Struct(point) = table.structs[thing].fields[0].base else { panic!("a struct") };
        assert_eq!(table.structs[point].name, "q/Point");
    }

    #[test]
    fn faults_are_named() {
        assert_eq!(parse("p/S", "int64 a\n---\nint64 b").unwrap_err(), Fault::Service);
        assert!(matches!(parse("p/S", "nonsense").unwrap_err(), Fault::Line { line: 1, .. }));
        assert!(matches!(parse("p/S", "float64[x] a").unwrap_err(), Fault::Line { .. }));
        assert_eq!(
            parse("p/S", "q/Missing a").unwrap_err(),
            Fault::UnknownType { field: "p/S.a".into(), type_name: "q/Missing".into() }
        );
        assert_eq!(parse("p/S", "p/S again").unwrap_err(), Fault::Recursive { type_name: "p/S".into() });
        let bytes = b"int8 a\n\xff\xfe";
        let got = parse_schema("p/S", bytes, Dialect::Ros2, &Library::builtin()).unwrap_err();
        assert_eq!(got, Fault::NotText { offset: 7 });
    }
}
