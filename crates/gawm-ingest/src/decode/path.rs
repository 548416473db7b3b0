//! Paths to the values of a message: `position[name="elbow"]`, `transforms[child_frame_id="tool0"].translation.x`.

use std::fmt;
use std::str::FromStr;

use serde::{Deserialize, Deserializer, Serialize, Serializer};

/// Most elements that one slice may name; a wider slice in a contract is a typing error, not a feature.
const MAX_SLICE: u32 = 65_536;

/// Deepest path that is accepted, in segments.
const MAX_SEGMENTS: usize = 64;

/// A path from a message to one or more of its values.
///
/// ```text
/// pose.position.x                        a member of a member
/// data[3]  data[-1]                      an element, counted from the start or from the end
/// data[0:7]  data[:]                     several elements; without an end only where the schema fixes the length
/// position[name="elbow"]                 the element whose entry in the parallel array `name` is "elbow"
/// transforms[child_frame_id="tool0"].x   the element whose own member is "tool0"
/// "odd key".x                            a member whose name holds other characters than letters, digits, _ - / $ @
/// ```
///
/// [`Display`](fmt::Display) prints the canonical text, which parses back to the same path.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub struct FieldPath {
    segments: Vec<Segment>,
}

/// One step of a [`FieldPath`].
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum Segment {
    /// A member of a struct, by name.
    Field(String),
    /// An element of an array; negative counts from the end.
    Index(i64),
    /// The elements `start..end` of an array.
    Slice {
        /// First element.
        start: u32,
        /// One past the last element; `None` = up to the length that the schema fixes.
        end: Option<u32>,
    },
    /// The element that a name picks.
    Key {
        /// Path of the member (of the element) or of the parallel array that holds the names.
        member: Vec<String>,
        /// The name to look for.
        value: String,
    },
}

/// Why a text is not a [`FieldPath`].
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("bad field path {path:?} at character {offset}: expected {expected}, got {got}")]
#[non_exhaustive]
pub struct PathError {
    /// The text.
    pub path: String,
    /// Byte offset of the fault in the text.
    pub offset: usize,
    /// What could have stood there.
    pub expected: &'static str,
    /// What stands there.
    pub got: String,
}

impl FieldPath {
    /// Makes a path of plain members.
    pub fn from_members<S: Into<String>>(members: impl IntoIterator<Item = S>) -> Self {
        Self { segments: members.into_iter().map(|m| Segment::Field(m.into())).collect() }
    }

    /// Makes a path of segments; the first must be a field.
    pub(crate) fn from_segments(segments: Vec<Segment>) -> Self {
        Self { segments }
    }

    /// Returns the steps from the message to the value.
    pub fn segments(&self) -> &[Segment] {
        &self.segments
    }
}

impl FromStr for FieldPath {
    type Err = PathError;

    fn from_str(text: &str) -> Result<Self, PathError> {
        Parser { text, pos: 0 }.path()
    }
}

impl fmt::Display for FieldPath {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (i, segment) in self.segments.iter().enumerate() {
            write_segment(f, segment, i == 0)?;
        }
        Ok(())
    }
}

impl Serialize for FieldPath {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for FieldPath {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let text = String::deserialize(deserializer)?;
        text.parse().map_err(serde::de::Error::custom)
    }
}

/// Writes one segment as [`FieldPath`]'s canonical text has it.
pub(crate) fn write_segment(f: &mut dyn fmt::Write, segment: &Segment, first: bool) -> fmt::Result {
    match segment {
        Segment::Field(name) => {
            if !first {
                f.write_char('.')?;
            }
            write_member(f, name)
        }
        Segment::Index(index) => write!(f, "[{index}]"),
        Segment::Slice { start, end: Some(end) } => write!(f, "[{start}:{end}]"),
        Segment::Slice { start, end: None } => write!(f, "[{start}:]"),
        Segment::Key { member, value } => {
            f.write_char('[')?;
            for (i, name) in member.iter().enumerate() {
                if i > 0 {
                    f.write_char('.')?;
                }
                write_member(f, name)?;
            }
            f.write_char('=')?;
            write_quoted(f, value)?;
            f.write_char(']')
        }
    }
}

fn write_member(f: &mut dyn fmt::Write, name: &str) -> fmt::Result {
    if !name.is_empty() && name.chars().all(is_plain) { f.write_str(name) } else { write_quoted(f, name) }
}

fn write_quoted(f: &mut dyn fmt::Write, text: &str) -> fmt::Result {
    f.write_char('"')?;
    for c in text.chars() {
        if matches!(c, '"' | '\\') {
            f.write_char('\\')?;
        }
        f.write_char(c)?;
    }
    f.write_char('"')
}

fn is_plain(c: char) -> bool {
    c.is_alphanumeric() || matches!(c, '_' | '-' | '/' | '$' | '@')
}

struct Parser<'a> {
    text: &'a str,
    pos: usize,
}

impl Parser<'_> {
    fn path(mut self) -> Result<FieldPath, PathError> {
        let mut segments = vec![Segment::Field(self.member()?)];
        while let Some(c) = self.peek() {
            let segment = match c {
                '.' => {
                    self.pos += 1;
                    Segment::Field(self.member()?)
                }
                '[' => {
                    self.pos += 1;
                    self.selector()?
                }
                _ => return Err(self.fault("\".\", \"[\" or the end")),
            };
            segments.push(segment);
            if segments.len() > MAX_SEGMENTS {
                return Err(self.fault("at most 64 segments"));
            }
        }
        Ok(FieldPath { segments })
    }

    /// Parses what follows `[`, including `]`.
    fn selector(&mut self) -> Result<Segment, PathError> {
        let segment = match self.peek() {
            Some('0'..='9' | '-' | ':') if self.is_position() => self.index_or_slice()?,
            _ => self.key()?,
        };
        self.expect(']', "\"]\"")?;
        Ok(segment)
    }

    /// Tells an index or slice from a member that begins with a digit: only the former ends at the bracket.
    fn is_position(&self) -> bool {
        let rest =
            self.text[self.pos..].trim_start_matches(|c: char| c.is_ascii_digit() || matches!(c, '-' | ':'));
        rest.is_empty() || rest.starts_with(']')
    }

    fn index_or_slice(&mut self) -> Result<Segment, PathError> {
        let start = if self.peek() == Some(':') { None } else { Some(self.integer()?) };
        if self.peek() != Some(':') {
            return match start {
                Some(index) => Ok(Segment::Index(index)),
                None => Err(self.fault("an index")),
            };
        }
        let at = self.pos;
        self.pos += 1;
        let end = if self.peek() == Some(']') { None } else { Some(self.integer()?) };
        let bounds = (u32::try_from(start.unwrap_or(0)), end.map(u32::try_from).transpose());
        match bounds {
            (Ok(start), Ok(None)) => Ok(Segment::Slice { start, end: None }),
            (Ok(start), Ok(Some(end))) if start < end && end - start <= MAX_SLICE => {
                Ok(Segment::Slice { start, end: Some(end) })
            }
            _ => {
                self.pos = at;
                Err(self.fault("a slice start:end with 0 <= start < end and at most 65536 elements"))
            }
        }
    }

    fn integer(&mut self) -> Result<i64, PathError> {
        let rest = &self.text[self.pos..];
        let digits = rest.find(|c: char| !c.is_ascii_digit() && c != '-').unwrap_or(rest.len());
        match rest[..digits].parse::<i64>() {
            Ok(value) if value.unsigned_abs() <= u64::from(u32::MAX) => {
                self.pos += digits;
                Ok(value)
            }
            _ => Err(self.fault("an integer")),
        }
    }

    fn key(&mut self) -> Result<Segment, PathError> {
        let mut member = vec![self.member()?];
        while self.peek() == Some('.') && member.len() < MAX_SEGMENTS {
            self.pos += 1;
            member.push(self.member()?);
        }
        self.expect('=', "\"=\" and a quoted name")?;
        let value = match self.peek() {
            Some(quote @ ('"' | '\'')) => self.quoted(quote)?,
            _ => {
                let rest = &self.text[self.pos..];
                let end = rest.find(']').unwrap_or(rest.len());
                self.pos += end;
                rest[..end].to_owned()
            }
        };
        Ok(Segment::Key { member, value })
    }

    fn member(&mut self) -> Result<String, PathError> {
        if let Some(quote @ ('"' | '\'')) = self.peek() {
            return self.quoted(quote);
        }
        let rest = &self.text[self.pos..];
        let end = rest.find(|c: char| !is_plain(c)).unwrap_or(rest.len());
        if end == 0 {
            return Err(self.fault("a field name"));
        }
        self.pos += end;
        Ok(rest[..end].to_owned())
    }

    fn quoted(&mut self, quote: char) -> Result<String, PathError> {
        self.pos += 1;
        let mut out = String::new();
        let mut chars = self.text[self.pos..].char_indices();
        while let Some((i, c)) = chars.next() {
            if c == quote {
                self.pos += i + 1;
                return Ok(out);
            }
            if c == '\\' {
                match chars.next() {
                    Some((_, escaped)) => out.push(escaped),
                    None => break,
                }
            } else {
                out.push(c);
            }
        }
        self.pos = self.text.len();
        Err(self.fault("a closing quote"))
    }

    fn expect(&mut self, c: char, expected: &'static str) -> Result<(), PathError> {
        if self.peek() != Some(c) {
            return Err(self.fault(expected));
        }
        self.pos += c.len_utf8();
        Ok(())
    }

    fn peek(&self) -> Option<char> {
        self.text[self.pos..].chars().next()
    }

    fn fault(&self, expected: &'static str) -> PathError {
        let got = self.peek().map_or_else(|| "the end".to_owned(), |c| format!("{c:?}"));
        PathError { path: self.text.to_owned(), offset: self.pos, expected, got }
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn check_canonical(text: &str, canonical: &str) {
        let path: FieldPath = text.parse().unwrap();
        assert_eq!(path.to_string(), canonical);
        assert_eq!(canonical.parse::<FieldPath>().unwrap(), path);
    }

    fn check_rejected(text: &str, offset: usize) {
        assert_eq!(text.parse::<FieldPath>().unwrap_err().offset, offset, "{text}");
    }

    #[test]
    fn canonical_text() {
        check_canonical("a.b", "a.b");
        check_canonical("data[3]", "data[3]");
        check_canonical("data[-1]", "data[-1]");
        check_canonical("data[0:7]", "data[0:7]");
        check_canonical("data[:7]", "data[0:7]");
        check_canonical("data[:]", "data[0:]");
        check_canonical("position[name=elbow]", "position[name=\"elbow\"]");
        check_canonical("position[name='el\"bow']", "position[name=\"el\\\"bow\"]");
        check_canonical("t[header.frame_id=\"world\"].x", "t[header.frame_id=\"world\"].x");
        check_canonical("\"odd key\".x", "\"odd key\".x");
        check_canonical("a[0][1].b", "a[0][1].b");
        check_canonical("a[0=\"x\"]", "a[0=\"x\"]");
    }

    #[test]
    fn faults_name_the_place() {
        check_rejected("", 0);
        check_rejected("a..b", 2);
        check_rejected("a[", 2);
        check_rejected("a[1", 3);
        check_rejected("a[5:2]", 3);
        check_rejected("a[name=\"x]", 10);
        check_rejected("a b", 1);
        check_rejected("a[99999999999]", 2);
        check_rejected("a[0:99999999]", 3);
    }

    fn any_segment() -> impl Strategy<Value = Segment> {
        prop_oneof![
            any::<String>().prop_map(Segment::Field),
            (-1000i64..1000).prop_map(Segment::Index),
            (0u32..50, 1u32..50).prop_map(|(s, n)| Segment::Slice { start: s, end: Some(s + n) }),
            (0u32..50).prop_map(|start| Segment::Slice { start, end: None }),
            (prop::collection::vec(any::<String>(), 1..3), any::<String>())
                .prop_map(|(member, value)| Segment::Key { member, value }),
        ]
    }

    proptest! {
        #![proptest_config(ProptestConfig { rng_seed: proptest::test_runner::RngSeed::Fixed(7), ..ProptestConfig::default() })]

        #[test]
        fn display_parses_back(first in any::<String>(), rest in prop::collection::vec(any_segment(), 0..6)) {
            let path = FieldPath { segments: [vec![Segment::Field(first)], rest].concat() };
            prop_assert_eq!(path.to_string().parse::<FieldPath>().unwrap(), path);
        }

        #[test]
        fn any_text_is_met(text in any::<String>()) {
            drop(text.parse::<FieldPath>());
        }
    }
}
