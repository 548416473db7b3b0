//! Side files: one row of labels per log or per episode.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use gawm_dataset::csv;

use super::LabelError;

/// Largest side file that is read.
const MAX_BYTES: u64 = 256 << 20;

/// A table of labels.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct SideFile {
    /// Rows, by column.
    pub rows: Vec<BTreeMap<String, String>>,
    /// Column of the log's name.
    key: Option<String>,
    /// Column of the number of the episode.
    episode: Option<String>,
}

impl SideFile {
    /// Reads a CSV (with a header) or a JSON file (a list of objects, or an object of objects by log name); `keys` are the
    /// columns of the log's name and of the number of the episode.
    ///
    /// # Errors
    /// The file cannot be read or is neither, or two rows are of the same log and episode.
    pub fn read(path: &Path, keys: (Option<&str>, Option<&str>)) -> Result<SideFile, LabelError> {
        let fail = |detail: String| LabelError::SideFile { path: path.to_owned(), detail };
        let length = std::fs::metadata(path).map_err(|error| fail(error.to_string()))?.len();
        if length > MAX_BYTES {
            return Err(fail(format!("expected at most {MAX_BYTES} bytes, got {length}")));
        }
        let text = std::fs::read_to_string(path).map_err(|error| fail(error.to_string()))?;
        let is_json = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
        let file = if is_json { from_json(&text, keys) } else { from_csv(&text, keys) };
        file.and_then(SideFile::checked).map_err(fail)
    }

    /// Refuses rows that cannot be told apart.
    fn checked(self) -> Result<SideFile, String> {
        if self.key.is_none() && self.episode.is_none() && self.rows.len() > 1 {
            return Err(format!(
                "expected labels.side_key, the column that names the log of each of the {} rows, got none",
                self.rows.len()
            ));
        }
        let mut seen = BTreeSet::new();
        for row in &self.rows {
            let cell = |column: &Option<String>| {
                column.as_ref().and_then(|column| row.get(column)).map(|cell| cell.trim())
            };
            let place = (cell(&self.key), cell(&self.episode));
            let is_named = self.key.is_none() || place.0.is_some_and(|name| !name.is_empty());
            if is_named && !seen.insert(place) {
                let episode = place.1.map(|number| format!(" and episode {number}")).unwrap_or_default();
                return Err(format!(
                    "expected one row of a log{}, got two of {:?}{episode}",
                    if self.episode.is_some() { " and episode" } else { "" },
                    place.0.unwrap_or_default()
                ));
            }
        }
        Ok(self)
    }

    /// Returns the row of a log (by the end of its path) and, with an episode column, of an episode.
    pub fn find(&self, log: &Path, episode: u64) -> Option<&BTreeMap<String, String>> {
        self.rows.iter().find(|row| {
            let is_log = self.key.as_ref().is_none_or(|column| {
                row.get(column).map(|name| name.trim()).is_some_and(|name| {
                    !name.is_empty()
                        && (log.ends_with(name) || log.file_stem().is_some_and(|stem| stem == name))
                })
            });
            let is_episode = self
                .episode
                .as_ref()
                .is_none_or(|column| row.get(column).is_some_and(|text| text.trim().parse() == Ok(episode)));
            is_log && is_episode
        })
    }
}

/// Name of the column that logs of a JSON object by log get, unless the contract gives another.
const LOG_COLUMN: &str = "log";

fn from_json(text: &str, (key, episode): (Option<&str>, Option<&str>)) -> Result<SideFile, String> {
    let mut key = key;
    let value: serde_json::Value = serde_json::from_str(text).map_err(|error| error.to_string())?;
    let row = |object: &serde_json::Map<String, serde_json::Value>| -> BTreeMap<String, String> {
        object.iter().map(|(name, value)| (name.clone(), super::value::text_of(value))).collect()
    };
    let rows = match &value {
        serde_json::Value::Array(items) => items
            .iter()
            .map(|item| item.as_object().map(row).ok_or("expected a list of objects".to_owned()))
            .collect::<Result<_, _>>()?,
        serde_json::Value::Object(by_log) => {
            let column = *key.get_or_insert(LOG_COLUMN);
            by_log
                .iter()
                .map(|(log, item)| {
                    let mut row =
                        item.as_object().map(row).ok_or("expected an object of objects".to_owned())?;
                    row.insert(column.to_owned(), log.clone());
                    Ok(row)
                })
                .collect::<Result<_, String>>()?
        }
        _ => return Err("expected a list of objects, or an object of objects".to_owned()),
    };
    Ok(SideFile { rows, key: key.map(str::to_owned), episode: episode.map(str::to_owned) })
}

fn from_csv(text: &str, (key, episode): (Option<&str>, Option<&str>)) -> Result<SideFile, String> {
    let at = |(line, detail): (u64, String)| format!("line {line}: {detail}");
    let mut records = csv::parse(text).map_err(at)?.into_iter();
    let (line, header) = records.next().ok_or("expected a header line, got an empty file")?;
    let names: Vec<String> = header.iter().map(|name| name.trim().to_owned()).collect();
    if let Some(name) =
        names.iter().enumerate().find_map(|(i, name)| names[..i].contains(name).then_some(name))
    {
        return Err(at((line, format!("expected columns of different names, got {name:?} twice"))));
    }
    let mut rows = Vec::new();
    for (line, cells) in records {
        if cells.len() != names.len() {
            let detail = format!("expected {} cells as in the header, got {}", names.len(), cells.len());
            return Err(at((line, detail)));
        }
        rows.push(names.iter().cloned().zip(cells).collect());
    }
    Ok(SideFile { rows, key: key.map(str::to_owned), episode: episode.map(str::to_owned) })
}

#[cfg(test)]
mod tests {
    use super::*;

    const BY_LOG: (Option<&str>, Option<&str>) = (Some("log"), None);
    const BY_EPISODE: (Option<&str>, Option<&str>) = (Some("log"), Some("episode"));

    #[test]
    fn reads_csv_with_quotes() {
        let file = from_csv("log,task\r\na.mcap,\"stack, \"\"two\"\"\"\n\nb.mcap,x\n", BY_LOG).unwrap();
        assert_eq!(file.rows.len(), 2);
        assert_eq!(file.find(Path::new("d/a.mcap"), 0).unwrap()["task"], "stack, \"two\"");
        assert_eq!(file.find(Path::new("d/b.mcap"), 0).unwrap()["task"], "x");
        assert!(file.find(Path::new("d/c.mcap"), 0).is_none());
        let spreadsheet = from_csv("\u{feff}log; task\r\na.mcap;x, y\r\n", BY_LOG).unwrap();
        assert_eq!(spreadsheet.rows[0]["task"], "x, y");
    }

    #[test]
    fn broken_csv_names_its_line() {
        let error = |text: &str| from_csv(text, BY_LOG).unwrap_err();
        assert_eq!(error("a,b\n\n1\n"), "line 3: expected 2 cells as in the header, got 1");
        assert!(error("a,b\n1,\"b\n").starts_with("line 2: "));
        assert!(error("a,b\n1,2\n3,x\"y\"\n").starts_with("line 3: "));
        assert!(error("a,b,a\n").contains("\"a\" twice"));
        assert!(error("\n").contains("empty file"));
    }

    #[test]
    fn reads_json_lists_and_objects() {
        let list = from_json(r#"[{"log": "a.mcap", "episode": 1, "success": true}]"#, BY_EPISODE).unwrap();
        let row = list.find(Path::new("a.mcap"), 1).unwrap();
        assert_eq!(row["success"], "true");
        assert!(list.find(Path::new("a.mcap"), 0).is_none());
        for keys in [(Some("name"), None), (None, None)] {
            let object = from_json(r#"{"a": {"task": "t"}, "b": {"task": "u"}}"#, keys).unwrap();
            assert_eq!(object.find(Path::new("x/b.mcap"), 0).unwrap()["task"], "u");
            assert!(object.find(Path::new("x/c.mcap"), 0).is_none());
        }
    }

    #[test]
    fn rows_that_cannot_be_told_apart_are_refused() {
        let check = |text: &str, keys, expected: Option<&str>| {
            let got = from_csv(text, keys).and_then(SideFile::checked);
            match expected {
                None => assert!(got.is_ok(), "{got:?}"),
                Some(expected) => assert!(got.as_ref().is_err_and(|e| e.contains(expected)), "{got:?}"),
            }
        };
        check("log,episode\na,0\na,1\n", BY_LOG, Some("got two of \"a\""));
        check("log,episode\na,0\na,1\n", BY_EPISODE, None);
        check("log,episode\na,0\na,0\n", BY_EPISODE, Some("and episode 0"));
        check("log,episode\na,0\nb,0\n", (None, None), Some("labels.side_key"));
        check("task\nx\n", (None, None), None);
    }
}
