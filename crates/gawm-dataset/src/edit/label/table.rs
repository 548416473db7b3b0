//! Tables of labels: CSV, a JSON list, or JSON objects line by line.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use gawm_schema::ContentHash;
use gawm_schema::batch::Split;
use serde::de::{Deserialize, Deserializer, MapAccess, Visitor};
use serde_json::Value;

use super::{Label, LabelError, LabelValue};
use crate::csv;

/// Most bytes of a table.
const MAX_BYTES: u64 = 64 << 20;

/// The columns that there are.
const COLUMNS: &str = "episode, episode_id, source_file, task, success, operator, split or tags.NAME";

/// A table of labels.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelTable {
    /// The file, for messages.
    pub path: PathBuf,
    /// Its name without folders.
    pub name: String,
    /// Hash of its bytes.
    pub hash: ContentHash,
    /// Its rows in order.
    pub rows: Vec<LabelRow>,
}

/// What one row says.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct LabelRow {
    /// The line it begins in, from 1.
    pub line: u64,
    /// Names of the episode, at least one; all must be its names.
    pub keys: Vec<EpisodeKey>,
    /// What it says; a label that is absent stays as it is.
    pub labels: BTreeMap<Label, LabelValue>,
}

/// A name of an episode, or of all episodes of a file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum EpisodeKey {
    /// The episode's index.
    Number(i64),
    /// Its stable id.
    Id(String),
    /// The file that it comes from.
    SourceFile(String),
}

impl std::fmt::Display for EpisodeKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            EpisodeKey::Number(number) => write!(f, "episode {number}"),
            EpisodeKey::Id(id) => write!(f, "episode_id {id:?}"),
            EpisodeKey::SourceFile(name) => write!(f, "source_file {name:?}"),
        }
    }
}

/// What a column is.
#[derive(Debug, Clone, PartialEq, Eq)]
enum Column {
    Number,
    Id,
    SourceFile,
    Label(Label),
    /// A JSON object of tags.
    Tags,
}

/// A value on its way from the file to a label.
#[derive(Debug)]
enum Cell<'a> {
    Null,
    Text(&'a str),
    Json(&'a Value),
}

impl LabelTable {
    /// Reads a table.
    ///
    /// # Errors
    /// It cannot be read, or is no table of labels; the error names the line.
    pub fn read(path: &Path) -> Result<LabelTable, LabelError> {
        let read = || -> std::io::Result<Vec<u8>> {
            let mut bytes = Vec::new();
            File::open(path)?.take(MAX_BYTES + 1).read_to_end(&mut bytes)?;
            Ok(bytes)
        };
        let bytes = read().map_err(|source| LabelError::Read { path: path.to_owned(), source })?;
        if bytes.len() as u64 > MAX_BYTES {
            return Err(LabelError::TooLarge { path: path.to_owned(), limit: MAX_BYTES });
        }
        LabelTable::parse(path, &bytes)
    }

    /// Parses the bytes of a table; JSON when they begin with `[` or `{`.
    ///
    /// # Errors
    /// They are no table of labels; the error names the line.
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<LabelTable, LabelError> {
        let hash = ContentHash::of(bytes);
        let bytes = bytes.strip_prefix("\u{feff}".as_bytes()).unwrap_or(bytes);
        let parser = Parser { path };
        let rows = match bytes.iter().find(|byte| !byte.is_ascii_whitespace()) {
            None => return Err(parser.empty("a header line and rows, or a JSON list")),
            Some(b'[' | b'{') => parser.json(bytes)?,
            Some(_) => parser.csv(bytes)?,
        };
        if rows.is_empty() {
            return Err(parser.empty("at least one row"));
        }
        let name = path.file_name().unwrap_or_default().to_string_lossy().into_owned();
        Ok(LabelTable { path: path.to_owned(), name, hash, rows })
    }
}

struct Parser<'a> {
    path: &'a Path,
}

impl Parser<'_> {
    fn empty(&self, expected: &'static str) -> LabelError {
        LabelError::Empty { path: self.path.to_owned(), expected }
    }

    fn syntax(&self, line: u64, detail: String) -> LabelError {
        LabelError::Syntax { path: self.path.to_owned(), line, detail }
    }

    fn value(&self, line: u64, column: &str, expected: &str, cell: &Cell<'_>) -> LabelError {
        let got = match cell {
            Cell::Null => "null".to_owned(),
            Cell::Text(text) => format!("{text:?}"),
            Cell::Json(value) => value.to_string(),
        };
        LabelError::Value {
            path: self.path.to_owned(),
            line,
            column: column.to_owned(),
            expected: expected.to_owned(),
            got,
        }
    }

    fn column(&self, line: u64, name: &str) -> Result<Column, LabelError> {
        Ok(match name.trim() {
            "episode" | "episode_index" => Column::Number,
            "episode_id" | "gawm/episode_id" => Column::Id,
            "source_file" | "gawm/source_file" => Column::SourceFile,
            "task" => Column::Label(Label::Task),
            "success" => Column::Label(Label::Success),
            "operator" => Column::Label(Label::Operator),
            "split" => Column::Label(Label::Split),
            "tags" => Column::Tags,
            other => match other.strip_prefix("tags.").filter(|tag| !tag.is_empty()) {
                Some(tag) => Column::Label(Label::Tag(tag.to_owned())),
                None => {
                    return Err(LabelError::UnknownColumn {
                        path: self.path.to_owned(),
                        line,
                        column: name.to_owned(),
                        expected: COLUMNS.to_owned(),
                    });
                }
            },
        })
    }

    /// Returns the columns that names stand for.
    fn columns<'n>(
        &self,
        line: u64,
        names: impl Iterator<Item = &'n str>,
    ) -> Result<Vec<Column>, LabelError> {
        let mut columns = Vec::new();
        for name in names {
            let column = self.column(line, name)?;
            if columns.contains(&column) {
                let (path, column) = (self.path.to_owned(), name.to_owned());
                return Err(LabelError::RepeatedColumn { path, line, column });
            }
            columns.push(column);
        }
        let is_label = |column: &Column| matches!(column, Column::Label(_) | Column::Tags);
        let missing = |expected| LabelError::Missing { path: self.path.to_owned(), line, expected };
        if columns.iter().all(is_label) {
            return Err(missing("a column that names the episode: episode, episode_id or source_file"));
        }
        if !columns.iter().any(is_label) {
            return Err(missing("a label: task, success, operator, split or tags.NAME"));
        }
        Ok(columns)
    }

    fn csv(&self, bytes: &[u8]) -> Result<Vec<LabelRow>, LabelError> {
        let text = std::str::from_utf8(bytes).map_err(|error| {
            self.syntax(
                line_at(bytes, error.valid_up_to()),
                "expected UTF-8 text, got other bytes".to_owned(),
            )
        })?;
        let records = csv::parse(text).map_err(|(line, detail)| self.syntax(line, detail))?;
        let Some(((line, header), records)) = records.split_first() else { return Ok(Vec::new()) };
        let columns = self.columns(*line, header.iter().map(String::as_str))?;
        let mut rows = Vec::with_capacity(records.len());
        for (line, cells) in records {
            if cells.len() != header.len() {
                let detail = format!("expected {} cells as in the header, got {}", header.len(), cells.len());
                return Err(self.syntax(*line, detail));
            }
            let named = header.iter().zip(&columns).zip(cells);
            rows.push(
                self.row(*line, named.map(|((name, column), cell)| (name.trim(), column, Cell::Text(cell))))?,
            );
        }
        Ok(rows)
    }

    fn json(&self, bytes: &[u8]) -> Result<Vec<LabelRow>, LabelError> {
        let objects = json_objects(bytes).map_err(|(line, detail)| self.syntax(line, detail))?;
        let mut rows = Vec::with_capacity(objects.len());
        for (line, Entries(entries)) in &objects {
            let columns = self.columns(*line, entries.iter().map(|(name, _)| name.as_str()))?;
            let named = entries.iter().zip(&columns).map(|((name, value), column)| {
                let cell = match value {
                    Value::Null => Cell::Null,
                    Value::String(text) => Cell::Text(text),
                    other => Cell::Json(other),
                };
                (name.as_str(), column, cell)
            });
            rows.push(self.row(*line, named)?);
        }
        Ok(rows)
    }

    fn row<'c>(
        &self,
        line: u64,
        cells: impl Iterator<Item = (&'c str, &'c Column, Cell<'c>)>,
    ) -> Result<LabelRow, LabelError> {
        let mut row = LabelRow { line, keys: Vec::new(), labels: BTreeMap::new() };
        for (name, column, cell) in cells {
            // An empty cell leaves things as they are; null takes a label away.
            if matches!(cell, Cell::Text(text) if text.trim().is_empty()) {
                continue;
            }
            match column {
                Column::Number => {
                    let number = match &cell {
                        Cell::Text(text) => text.trim().parse::<i64>().ok(),
                        Cell::Json(value) => value.as_i64(),
                        Cell::Null => None,
                    };
                    let number = number.filter(|number| *number >= 0);
                    let number =
                        number.ok_or_else(|| self.value(line, name, "an episode's number", &cell))?;
                    row.keys.push(EpisodeKey::Number(number));
                }
                Column::Id | Column::SourceFile => {
                    let Cell::Text(text) = cell else {
                        return Err(self.value(line, name, "text", &cell));
                    };
                    let text = text.trim().to_owned();
                    let is_id = *column == Column::Id;
                    row.keys.push(if is_id { EpisodeKey::Id(text) } else { EpisodeKey::SourceFile(text) });
                }
                Column::Label(label) => {
                    row.labels.insert(label.clone(), self.label(line, name, label, &cell)?);
                }
                Column::Tags => self.tags(line, name, &cell, &mut row.labels)?,
            }
        }
        if row.keys.is_empty() {
            let expected = "a name of the episode in episode, episode_id or source_file";
            return Err(LabelError::Missing { path: self.path.to_owned(), line, expected });
        }
        Ok(row)
    }

    fn label(&self, line: u64, name: &str, label: &Label, cell: &Cell<'_>) -> Result<LabelValue, LabelError> {
        let word = match cell {
            Cell::Text(text) => text.trim().to_lowercase(),
            Cell::Json(value) => value.to_string(),
            Cell::Null => String::new(),
        };
        match label {
            Label::Success => match word.as_str() {
                "true" | "yes" | "1" | "success" => Ok(LabelValue::Bool(true)),
                "false" | "no" | "0" | "failure" => Ok(LabelValue::Bool(false)),
                "unknown" | "" => Ok(LabelValue::Unknown),
                _ => Err(self.value(line, name, "true, false, unknown or nothing", cell)),
            },
            Label::Split => match word.as_str() {
                "train" | "training" => Ok(LabelValue::Split(Split::Train)),
                "val" | "validation" => Ok(LabelValue::Split(Split::Validation)),
                _ => Err(self.value(line, name, "train, val or nothing", cell)),
            },
            _ => match cell {
                Cell::Null => Ok(LabelValue::Unknown),
                Cell::Text(text) => Ok(LabelValue::Text((*text).to_owned())),
                Cell::Json(value) if value.is_number() || value.is_boolean() => {
                    Ok(LabelValue::Text(value.to_string()))
                }
                Cell::Json(_) => Err(self.value(line, name, "text", cell)),
            },
        }
    }

    fn tags(
        &self,
        line: u64,
        name: &str,
        cell: &Cell<'_>,
        labels: &mut BTreeMap<Label, LabelValue>,
    ) -> Result<(), LabelError> {
        let wrong = || self.value(line, name, "an object of texts", cell);
        let parsed: Value = match cell {
            Cell::Text(text) => serde_json::from_str(text).map_err(|_no_json| wrong())?,
            Cell::Json(value) => (*value).clone(),
            Cell::Null => return Err(wrong()),
        };
        for (tag, value) in parsed.as_object().ok_or_else(wrong)? {
            let cell = match value {
                Value::Null => Cell::Null,
                Value::String(text) => Cell::Text(text),
                other => Cell::Json(other),
            };
            let label = Label::Tag(tag.clone());
            let value = self.label(line, &label.column(), &label, &cell)?;
            if labels.get(&label).is_some_and(|before| *before != value) {
                let (path, column) = (self.path.to_owned(), label.column());
                return Err(LabelError::RepeatedColumn { path, line, column });
            }
            labels.insert(label, value);
        }
        Ok(())
    }
}

/// An object's entries as they are, so that a name that is there twice is seen.
struct Entries(Vec<(String, Value)>);

impl<'de> Deserialize<'de> for Entries {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        struct Take;
        impl<'de> Visitor<'de> for Take {
            type Value = Entries;
            fn expecting(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str("an object with the labels of an episode")
            }
            fn visit_map<A: MapAccess<'de>>(self, mut map: A) -> Result<Entries, A::Error> {
                let mut entries = Vec::new();
                while let Some(entry) = map.next_entry()? {
                    entries.push(entry);
                }
                Ok(Entries(entries))
            }
        }
        deserializer.deserialize_map(Take)
    }
}

/// Returns the objects of a JSON list, or of objects one after the other, with the lines that they begin in.
fn json_objects(bytes: &[u8]) -> Result<Vec<(u64, Entries)>, (u64, String)> {
    let wrong = |first: usize, error: &serde_json::Error| {
        let at = error.to_string();
        let detail = at.split(" at line ").next().unwrap_or_default().to_owned();
        (line_at(bytes, first) + (error.line() as u64).saturating_sub(1), detail)
    };
    let start = bytes.iter().position(|byte| !byte.is_ascii_whitespace()).unwrap_or(0);
    let is_list = bytes.get(start) == Some(&b'[');
    let mut objects = Vec::new();
    let (mut position, mut line) = (0, 1);
    let mut place = |at: usize| {
        line += bytes[position..at].iter().filter(|byte| **byte == b'\n').count() as u64;
        position = at;
        line
    };
    if is_list {
        let found: Vec<Entries> = serde_json::from_slice(bytes).map_err(|error| wrong(0, &error))?;
        let starts = object_starts(bytes);
        objects.extend(starts.into_iter().map(&mut place).zip(found));
    } else {
        let mut at = start;
        while at < bytes.len() {
            let mut stream = serde_json::Deserializer::from_slice(&bytes[at..]).into_iter::<Entries>();
            match stream.next() {
                None => break,
                Some(Ok(entries)) => {
                    let gap = bytes[at..].iter().position(|byte| !byte.is_ascii_whitespace()).unwrap_or(0);
                    objects.push((place(at + gap), entries));
                    at += stream.byte_offset();
                }
                Some(Err(error)) => return Err(wrong(at, &error)),
            }
        }
    }
    Ok(objects)
}

fn line_at(bytes: &[u8], at: usize) -> u64 {
    1 + bytes[..at].iter().filter(|byte| **byte == b'\n').count() as u64
}

/// Returns where the objects of a list begin, in JSON that was parsed already.
fn object_starts(bytes: &[u8]) -> Vec<usize> {
    let (mut depth, mut is_text, mut is_escaped) = (0usize, false, false);
    let mut starts = Vec::new();
    for (at, byte) in bytes.iter().enumerate() {
        if is_text {
            is_text = is_escaped || *byte != b'"';
            is_escaped = *byte == b'\\' && !is_escaped;
            continue;
        }
        match byte {
            b'"' => is_text = true,
            b'[' | b'{' => {
                if depth == 1 {
                    starts.push(at);
                }
                depth += 1;
            }
            b']' | b'}' => depth = depth.saturating_sub(1),
            _ => {}
        }
    }
    starts
}
