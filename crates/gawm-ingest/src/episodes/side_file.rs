//! Side files: one row of labels per log or per episode.

use std::collections::BTreeMap;
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
}

impl SideFile {
    /// Reads a CSV (with a header) or a JSON file (a list of objects, or an object of objects by log name).
    ///
    /// # Errors
    /// The file cannot be read or is neither.
    pub fn read(path: &Path, key_column: Option<&str>) -> Result<SideFile, LabelError> {
        let fail = |detail: String| LabelError::SideFile { path: path.to_owned(), detail };
        let length = std::fs::metadata(path).map_err(|error| fail(error.to_string()))?.len();
        if length > MAX_BYTES {
            return Err(fail(format!("expected at most {MAX_BYTES} bytes, got {length}")));
        }
        let text = std::fs::read_to_string(path).map_err(|error| fail(error.to_string()))?;
        let is_json = path.extension().is_some_and(|ending| ending.eq_ignore_ascii_case("json"));
        if is_json { from_json(&text, key_column).map_err(fail) } else { from_csv(&text).map_err(fail) }
    }

    /// Returns the row of a log (by the end of its path) and, with an episode column, of an episode.
    pub fn find(
        &self,
        log: &Path,
        key_column: Option<&str>,
        episode: Option<(&str, u64)>,
    ) -> Option<&BTreeMap<String, String>> {
        self.rows.iter().find(|row| {
            let is_log = match key_column {
                None => true,
                Some(column) => row.get(column).is_some_and(|name| {
                    !name.is_empty()
                        && (log.ends_with(name) || log.file_stem().is_some_and(|stem| stem == name.as_str()))
                }),
            };
            let is_episode = episode.is_none_or(|(column, number)| {
                row.get(column).is_some_and(|text| text.trim().parse() == Ok(number))
            });
            is_log && is_episode
        })
    }
}

fn from_json(text: &str, key_column: Option<&str>) -> Result<SideFile, String> {
    let value: serde_json::Value = serde_json::from_str(text).map_err(|error| error.to_string())?;
    let row = |object: &serde_json::Map<String, serde_json::Value>| -> BTreeMap<String, String> {
        object.iter().map(|(name, value)| (name.clone(), super::value::text_of(value))).collect()
    };
    let rows = match &value {
        serde_json::Value::Array(items) => items
            .iter()
            .map(|item| item.as_object().map(row).ok_or("expected a list of objects".to_owned()))
            .collect::<Result<_, _>>()?,
        serde_json::Value::Object(by_log) => by_log
            .iter()
            .map(|(log, item)| {
                let mut row = item.as_object().map(row).ok_or("expected an object of objects".to_owned())?;
                row.insert(key_column.unwrap_or("log").to_owned(), log.clone());
                Ok(row)
            })
            .collect::<Result<_, String>>()?,
        _ => return Err("expected a list of objects, or an object of objects".to_owned()),
    };
    Ok(SideFile { rows })
}

fn from_csv(text: &str) -> Result<SideFile, String> {
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
    Ok(SideFile { rows })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn reads_csv_with_quotes() {
        let file = from_csv("log,task\r\na.mcap,\"stack, \"\"two\"\"\"\n\nb.mcap,x\n").unwrap();
        assert_eq!(file.rows.len(), 2);
        assert_eq!(file.find(Path::new("d/a.mcap"), Some("log"), None).unwrap()["task"], "stack, \"two\"");
        assert_eq!(file.find(Path::new("d/b.mcap"), Some("log"), None).unwrap()["task"], "x");
        assert!(file.find(Path::new("d/c.mcap"), Some("log"), None).is_none());
        let spreadsheet = from_csv("\u{feff}log; task\r\na.mcap;x, y\r\n").unwrap();
        assert_eq!(spreadsheet.rows[0]["task"], "x, y");
    }

    #[test]
    fn broken_csv_names_its_line() {
        let error = |text: &str| from_csv(text).unwrap_err();
        assert_eq!(error("a,b\n\n1\n"), "line 3: expected 2 cells as in the header, got 1");
        assert!(error("a,b\n1,\"b\n").starts_with("line 2: "));
        assert!(error("a,b\n1,2\n3,x\"y\"\n").starts_with("line 3: "));
        assert!(error("a,b,a\n").contains("\"a\" twice"));
        assert!(error("\n").contains("empty file"));
    }

    #[test]
    fn reads_json_lists_and_objects() {
        let list = from_json(r#"[{"log": "a.mcap", "episode": 1, "success": true}]"#, None).unwrap();
        let row = list.find(Path::new("a.mcap"), Some("log"), Some(("episode", 1))).unwrap();
        assert_eq!(row["success"], "true");
        assert!(list.find(Path::new("a.mcap"), Some("log"), Some(("episode", 0))).is_none());
        let object = from_json(r#"{"a": {"task": "t"}}"#, Some("name")).unwrap();
        assert_eq!(object.find(Path::new("x/a.mcap"), Some("name"), None).unwrap()["task"], "t");
    }
}
