//! Parser of OMG IDL as ROS 2 writes it (`ros2idl`, `omgidl`): structs, enums, typedefs and constants in modules.

use std::collections::BTreeMap;
use std::fmt;

use super::ros_library::Library;
use super::ros_msg::{Dialect, Fault, library_type};
use super::{Base, Extensibility, Field, Many, Prim, StructType, TypeTable, Wire};

/// Deepest nesting of types and modules.
const MAX_DEPTH: usize = 48;
/// Most fields of one schema with all its types.
const MAX_FIELDS: usize = 50_000;

/// Parses the schema of one channel; `name` is `pkg/msg/Type` or `pkg::msg::Type`.
pub(crate) fn parse_schema(name: &str, data: &[u8], library: &Library) -> Result<TypeTable, Fault> {
    let text = std::str::from_utf8(data).map_err(|e| Fault::NotText { offset: e.valid_up_to() })?;
    let mut parser = Parser { tokens: tokens(text)?, at: 0, scope: Vec::new(), known: BTreeMap::new() };
    parser.definitions(0)?;
    let wanted = name.replace('/', "::");
    let root = parser.known.keys().find(|known| **known == wanted).or_else(|| {
        // Writers leave out `msg`, or give the bare type.
        let last = wanted.rsplit("::").next().unwrap_or(&wanted);
        let first = wanted.split("::").next().unwrap_or(&wanted);
        let fits = |known: &&String| {
            known.rsplit("::").next() == Some(last) && (first == last || known.starts_with(first))
        };
        parser.known.keys().find(fits)
    });
    let Some(root) = root.cloned() else {
        return Err(Fault::UnknownType { field: "schema".to_owned(), type_name: name.to_owned() });
    };
    let mut linker = Linker {
        known: &parser.known,
        library,
        table: TypeTable::default(),
        done: BTreeMap::new(),
        n_fields: 0,
    };
    linker.table.root = linker.structure(&root, 0)?;
    Ok(linker.table)
}

#[derive(Clone, Debug, PartialEq)]
enum Token {
    Word(String),
    Number(u64),
    /// Text, a character, or a number that is no unsigned integer: only annotations and constants have them.
    Literal,
    Mark(char),
    /// `::`
    Scope,
}

impl fmt::Display for Token {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Word(word) => f.write_str(word),
            Self::Number(number) => number.fmt(f),
            Self::Literal => f.write_str("a literal"),
            Self::Mark(mark) => mark.fmt(f),
            Self::Scope => f.write_str("::"),
        }
    }
}

/// A token and its line.
type Placed = (Token, usize);

fn tokens(text: &str) -> Result<Vec<Placed>, Fault> {
    let mut out = Vec::new();
    for (number, raw) in without_block_comments(text).lines().enumerate() {
        let line = number + 1;
        let trimmed = raw.trim();
        let is_border = trimmed.len() >= 3 && trimmed.bytes().all(|b| b == b'=');
        if is_border || trimmed.starts_with("IDL:") || trimmed.starts_with('#') {
            continue;
        }
        line_tokens(raw, line, &mut out)?;
    }
    Ok(out)
}

/// Replaces `/* */` by spaces, line ends kept.
fn without_block_comments(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    let mut rest = text;
    while let Some(start) = rest.find("/*") {
        out.push_str(&rest[..start]);
        let end = rest[start..].find("*/").map_or(rest.len(), |end| start + end + 2);
        out.extend(rest[start..end].chars().filter(|c| *c == '\n'));
        rest = &rest[end..];
    }
    out.push_str(rest);
    out
}

fn line_tokens(raw: &str, line: usize, out: &mut Vec<Placed>) -> Result<(), Fault> {
    let mut rest = raw.trim_start();
    while let Some(first) = rest.chars().next() {
        let length = if rest.starts_with("//") {
            return Ok(());
        } else if rest.starts_with("::") {
            out.push((Token::Scope, line));
            2
        } else if first == '"' || first == '\'' {
            out.push((Token::Literal, line));
            quoted_length(rest, first)
        } else if first.is_ascii_alphabetic() || first == '_' {
            let length = rest.find(|c: char| !c.is_ascii_alphanumeric() && c != '_').unwrap_or(rest.len());
            out.push((Token::Word(rest[..length].to_owned()), line));
            length
        } else if first.is_ascii_digit() {
            let length = rest
                .find(|c: char| !c.is_ascii_alphanumeric() && !matches!(c, '.' | '+'))
                .unwrap_or(rest.len());
            let number = rest[..length].parse().ok();
            out.push((number.map_or(Token::Literal, Token::Number), line));
            length
        } else if first.is_ascii_punctuation() {
            out.push((Token::Mark(first), line));
            1
        } else {
            let text = raw.chars().take(80).collect();
            return Err(Fault::Line { line, text, expected: "IDL" });
        };
        rest = rest[length..].trim_start();
    }
    Ok(())
}

fn quoted_length(text: &str, quote: char) -> usize {
    let mut is_escaped = false;
    for (at, char) in text.char_indices().skip(1) {
        if char == quote && !is_escaped {
            return at + char.len_utf8();
        }
        is_escaped = char == '\\' && !is_escaped;
    }
    text.len()
}

/// What a name stands for.
#[derive(Clone, Debug)]
enum Known {
    Struct {
        members: Vec<Member>,
        extensibility: Option<Extensibility>,
    },
    /// 32 bits.
    Enum,
    Alias(TypeRef, Many),
    Constant(u64),
}

#[derive(Clone, Debug)]
struct Member {
    name: String,
    of: TypeRef,
    many: Many,
    id: Option<u32>,
}

#[derive(Clone, Debug)]
enum TypeRef {
    Prim(Prim),
    /// A name, with the scope it was written in.
    Named(String, Vec<String>),
    Sequence(Box<TypeRef>),
}

/// What annotations before a declaration say.
#[derive(Clone, Copy, Debug, Default)]
struct Annotations {
    extensibility: Option<Extensibility>,
    id: Option<u32>,
    is_optional: bool,
}

struct Parser {
    tokens: Vec<Placed>,
    at: usize,
    scope: Vec<String>,
    known: BTreeMap<String, Known>,
}

impl Parser {
    fn fault(&self, expected: &'static str) -> Fault {
        let (text, line) = match (self.tokens.get(self.at), self.tokens.last()) {
            (Some((token, line)), _) => (token.to_string(), *line),
            (None, Some((_, line))) => ("the end of the text".to_owned(), *line),
            (None, None) => ("an empty text".to_owned(), 0),
        };
        Fault::Line { line, text: text.chars().take(80).collect(), expected }
    }

    fn peek(&self) -> Option<&Token> {
        self.tokens.get(self.at).map(|(token, _)| token)
    }

    fn is_mark(&self, mark: char) -> bool {
        self.peek() == Some(&Token::Mark(mark))
    }

    fn take_mark(&mut self, mark: char, expected: &'static str) -> Result<(), Fault> {
        if !self.is_mark(mark) {
            return Err(self.fault(expected));
        }
        self.at += 1;
        Ok(())
    }

    fn word(&mut self, expected: &'static str) -> Result<String, Fault> {
        match self.peek() {
            Some(Token::Word(word)) => {
                let word = word.clone();
                self.at += 1;
                Ok(word)
            }
            _ => Err(self.fault(expected)),
        }
    }

    fn is_word(&self, wanted: &str) -> bool {
        matches!(self.peek(), Some(Token::Word(word)) if word == wanted)
    }

    fn define(&mut self, name: &str, known: Known) {
        let full: Vec<&str> = self.scope.iter().map(String::as_str).chain([name]).collect();
        // Files that several others include are met several times.
        self.known.entry(full.join("::")).or_insert(known);
    }

    fn definitions(&mut self, depth: usize) -> Result<(), Fault> {
        if depth > MAX_DEPTH {
            return Err(Fault::TooLarge);
        }
        while self.peek().is_some() && !self.is_mark('}') {
            let annotations = self.annotations()?;
            match self.word("module, struct, enum, typedef or const")?.as_str() {
                "module" => {
                    let name = self.word("the name of a module")?;
                    self.take_mark('{', "{")?;
                    self.scope.push(name);
                    self.definitions(depth + 1)?;
                    self.scope.pop();
                    self.take_mark('}', "} at the end of the module")?;
                }
                "struct" => self.structure(annotations)?,
                "enum" => {
                    let name = self.word("the name of an enum")?;
                    self.skip_to('}')?;
                    self.define(&name, Known::Enum);
                }
                "typedef" => {
                    let of = self.type_ref(0)?;
                    let name = self.word("the name of a type")?;
                    let many = self.extent()?;
                    self.define(&name, Known::Alias(of, many));
                }
                "const" => {
                    self.type_ref(0)?;
                    let name = self.word("the name of a constant")?;
                    self.take_mark('=', "=")?;
                    if let Some(Token::Number(value)) = self.peek() {
                        let value = *value;
                        self.define(&name, Known::Constant(value));
                    }
                    while self.peek().is_some() && !self.is_mark(';') {
                        self.at += 1;
                    }
                }
                _ => {
                    self.at -= 1;
                    return Err(
                        self.fault("module, struct, enum, typedef or const (unions are not supported)")
                    );
                }
            }
            if self.is_mark(';') {
                self.at += 1;
            }
        }
        Ok(())
    }

    /// Skips up to and with a mark, nested ones in between included.
    fn skip_to(&mut self, mark: char) -> Result<(), Fault> {
        while self.peek().is_some() {
            self.at += 1;
            if self.tokens[self.at - 1].0 == Token::Mark(mark) {
                return Ok(());
            }
        }
        Err(self.fault("} at the end"))
    }

    fn annotations(&mut self) -> Result<Annotations, Fault> {
        let mut found = Annotations::default();
        while self.is_mark('@') {
            self.at += 1;
            let name = self.word("the name of an annotation")?;
            let mut first = None;
            if self.is_mark('(') {
                let mut depth = 0_usize;
                loop {
                    match self.peek() {
                        None => return Err(self.fault(") at the end of the annotation")),
                        Some(Token::Mark('(')) => depth += 1,
                        Some(Token::Mark(')')) => depth -= 1,
                        Some(token) => first = first.or(Some(token.clone())),
                    }
                    self.at += 1;
                    if depth == 0 {
                        break;
                    }
                }
            }
            let named = match (name.as_str(), &first) {
                ("extensibility", Some(Token::Word(word))) => word.to_ascii_lowercase(),
                _ => name.to_ascii_lowercase(),
            };
            match (named.as_str(), first) {
                ("final", _) => found.extensibility = Some(Extensibility::Final),
                ("appendable", _) => found.extensibility = Some(Extensibility::Appendable),
                ("mutable", _) => found.extensibility = Some(Extensibility::Mutable),
                ("id", Some(Token::Number(id))) => found.id = u32::try_from(id).ok(),
                ("optional", _) => found.is_optional = true,
                _ => {}
            }
        }
        Ok(found)
    }

    fn structure(&mut self, annotations: Annotations) -> Result<(), Fault> {
        let name = self.word("the name of a struct")?;
        if self.is_mark(':') {
            return Err(self.fault("{ (inheritance is not supported)"));
        }
        self.take_mark('{', "{")?;
        let mut members = Vec::new();
        while !self.is_mark('}') {
            let member = self.annotations()?;
            if member.is_optional {
                return Err(self.fault("a member without @optional, which is not supported"));
            }
            let of = self.type_ref(0)?;
            loop {
                let name = self.word("the name of a member")?;
                let many = self.extent()?;
                members.push(Member { name, of: of.clone(), many, id: member.id });
                if members.len() > MAX_FIELDS {
                    return Err(Fault::TooLarge);
                }
                if !self.is_mark(',') {
                    break;
                }
                self.at += 1;
            }
            self.take_mark(';', "; at the end of the member")?;
        }
        self.take_mark('}', "} at the end of the struct")?;
        self.define(&name, Known::Struct { members, extensibility: annotations.extensibility });
        Ok(())
    }

    /// Parses `[3]`, `[2][3]` (flattened) or nothing.
    fn extent(&mut self) -> Result<Many, Fault> {
        let mut many = Many::One;
        while self.is_mark('[') {
            self.at += 1;
            let count = self.count()?;
            self.take_mark(']', "]")?;
            many = match many {
                Many::Fixed(before) => Many::Fixed(before.checked_mul(count).ok_or(Fault::TooLarge)?),
                _ => Many::Fixed(count),
            };
        }
        Ok(many)
    }

    fn count(&mut self) -> Result<usize, Fault> {
        let value = match self.peek() {
            Some(Token::Number(value)) => *value,
            Some(Token::Word(word)) => {
                let word = word.clone();
                let found = self.find(&word, &self.scope.clone());
                match found.and_then(|name| self.known.get(&name)) {
                    Some(Known::Constant(value)) => *value,
                    _ => return Err(self.fault("a number or a constant")),
                }
            }
            _ => return Err(self.fault("a number")),
        };
        self.at += 1;
        usize::try_from(value).map_err(|_beyond| Fault::TooLarge)
    }

    /// Finds the full name of what a name stands for, from the inner scope to the outer.
    fn find(&self, name: &str, scope: &[String]) -> Option<String> {
        find(&self.known, name, scope)
    }

    fn type_ref(&mut self, depth: usize) -> Result<TypeRef, Fault> {
        if depth > MAX_DEPTH {
            return Err(Fault::TooLarge);
        }
        let word = self.word("a type")?;
        let prim = match word.as_str() {
            "boolean" => Prim::Bool,
            "octet" | "uint8" => Prim::U8,
            "char" => Prim::U8,
            "int8" => Prim::I8,
            "short" | "int16" => Prim::I16,
            "uint16" => Prim::U16,
            "int32" => Prim::I32,
            "uint32" => Prim::U32,
            "int64" => Prim::I64,
            "uint64" => Prim::U64,
            "float" => Prim::F32,
            "double" => Prim::F64,
            "long" if self.is_word("long") => {
                self.at += 1;
                Prim::I64
            }
            "long" if self.is_word("double") => {
                return Err(self.fault("a type (long double is not supported)"));
            }
            "long" => Prim::I32,
            "unsigned" => match self.word("short or long")?.as_str() {
                "short" => Prim::U16,
                "long" if self.is_word("long") => {
                    self.at += 1;
                    Prim::U64
                }
                "long" => Prim::U32,
                _ => return Err(self.fault("short or long")),
            },
            "string" | "wstring" => {
                if self.is_mark('<') {
                    self.at += 1;
                    self.count()?;
                    self.take_mark('>', ">")?;
                }
                if word == "string" { Prim::Text } else { Prim::WideText }
            }
            "sequence" => {
                self.take_mark('<', "<")?;
                let item = self.type_ref(depth + 1)?;
                if self.is_mark(',') {
                    self.at += 1;
                    self.count()?;
                }
                self.take_mark('>', ">")?;
                return Ok(TypeRef::Sequence(Box::new(item)));
            }
            _ => {
                let mut name = word;
                while self.peek() == Some(&Token::Scope) {
                    self.at += 1;
                    name = format!("{name}::{}", self.word("a name after ::")?);
                }
                return Ok(TypeRef::Named(name, self.scope.clone()));
            }
        };
        Ok(TypeRef::Prim(prim))
    }
}

fn find(known: &BTreeMap<String, Known>, name: &str, scope: &[String]) -> Option<String> {
    (0..=scope.len()).rev().find_map(|depth| {
        let full: Vec<&str> = scope[..depth].iter().map(String::as_str).chain([name]).collect();
        let full = full.join("::");
        known.contains_key(&full).then_some(full)
    })
}

struct Linker<'a> {
    known: &'a BTreeMap<String, Known>,
    library: &'a Library,
    table: TypeTable,
    /// Index of each struct; none while it is being linked.
    done: BTreeMap<String, Option<usize>>,
    n_fields: usize,
}

impl Linker<'_> {
    fn structure(&mut self, name: &str, depth: usize) -> Result<usize, Fault> {
        if depth > MAX_DEPTH {
            return Err(Fault::TooLarge);
        }
        match self.done.get(name) {
            Some(Some(index)) => return Ok(*index),
            Some(None) => return Err(Fault::Recursive { type_name: name.to_owned() }),
            None => {}
        }
        let Some(Known::Struct { members, extensibility }) = self.known.get(name) else {
            return Err(Fault::UnknownType { field: String::new(), type_name: name.to_owned() });
        };
        self.done.insert(name.to_owned(), None);
        let mut fields = Vec::with_capacity(members.len());
        let mut member_ids = Vec::with_capacity(members.len());
        let mut next_id = 0;
        for member in members {
            // A struct of nothing holds one byte that ROS adds; it is no field of the message.
            let (base, many) = self.resolve(&member.of, member.many, &member.name, depth)?;
            let id = member.id.unwrap_or(next_id);
            next_id = id.wrapping_add(1);
            member_ids.push(id);
            fields.push(Field { name: member.name.clone(), base, many, wire: Wire::default() });
            self.n_fields += 1;
            if self.n_fields > MAX_FIELDS {
                return Err(Fault::TooLarge);
            }
        }
        let index = self.table.structs.len();
        self.table.structs.push(StructType {
            name: name.to_owned(),
            fields,
            extensibility: *extensibility,
            member_ids,
        });
        self.done.insert(name.to_owned(), Some(index));
        Ok(index)
    }

    fn resolve(
        &mut self,
        of: &TypeRef,
        many: Many,
        field: &str,
        depth: usize,
    ) -> Result<(Base, Many), Fault> {
        if depth > MAX_DEPTH {
            return Err(Fault::TooLarge);
        }
        match of {
            TypeRef::Prim(prim) => Ok((Base::Prim(*prim), many)),
            TypeRef::Sequence(item) => {
                let (base, inner) = self.resolve(item, Many::One, field, depth + 1)?;
                both(inner, Many::Dynamic)
                    .and_then(|inner| both(inner, many))
                    .map(|many| (base, many))
                    .ok_or_else(|| unsupported(field, "sequence of sequences or arrays"))
            }
            TypeRef::Named(name, scope) => {
                let Some(full) = find(self.known, name, scope) else {
                    return Ok((Base::Struct(self.of_library(name, field)?), many));
                };
                match &self.known[&full] {
                    Known::Struct { .. } => Ok((Base::Struct(self.structure(&full, depth + 1)?), many)),
                    Known::Enum => Ok((Base::Prim(Prim::I32), many)),
                    Known::Constant(_) => Err(unsupported(field, name)),
                    Known::Alias(of, inner) => {
                        let (base, inner) = self.resolve(of, *inner, field, depth + 1)?;
                        both(inner, many)
                            .map(|many| (base, many))
                            .ok_or_else(|| unsupported(field, "sequence of arrays"))
                    }
                }
            }
        }
    }

    /// Takes a type that the text does not define from the built-in ones.
    fn of_library(&mut self, name: &str, field: &str) -> Result<usize, Fault> {
        if let Some(Some(index)) = self.done.get(name) {
            return Ok(*index);
        }
        let found = library_type(&name.replace("::", "/"), Dialect::Ros2, self.library);
        let Some(table) = found else { return Err(unsupported(field, name)) };
        let mut table = table?;
        let base = self.table.structs.len();
        for item in &mut table.structs {
            for field in &mut item.fields {
                if let Base::Struct(index) = &mut field.base {
                    *index += base;
                }
            }
        }
        self.n_fields += table.structs.iter().map(|item| item.fields.len()).sum::<usize>();
        let root = base + table.root;
        self.table.structs.append(&mut table.structs);
        self.done.insert(name.to_owned(), Some(root));
        Ok(root)
    }
}

fn unsupported(field: &str, type_name: &str) -> Fault {
    Fault::UnknownType { field: field.to_owned(), type_name: type_name.to_owned() }
}

/// Joins what a type is with what a member makes of it: arrays of arrays are flattened, arrays of sequences are not known.
fn both(inner: Many, outer: Many) -> Option<Many> {
    match (inner, outer) {
        (Many::One, many) | (many, Many::One) => Some(many),
        (Many::Fixed(a), Many::Fixed(b)) => a.checked_mul(b).map(Many::Fixed),
        _ => None,
    }
}
