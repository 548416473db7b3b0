//! Pipeline files: which sections there are, and overrides `--set section.field=value`.
//!
//! One file serves all programs; each reads its own sections and refuses names that none has.

use std::fmt;
use std::str::FromStr;

use toml::Value;

/// Names of the sections that a pipeline file may have, in the order of the steps that read them.
pub const SECTIONS: [&str; 7] = ["sim", "ingest", "loader", "model", "objectives", "train", "eval"];

/// Returns the first name at the top of a file that is no section: a typo there would switch a whole section off.
pub fn unknown_section(file: &toml::Table) -> Option<&str> {
    file.keys().map(String::as_str).find(|name| !SECTIONS.contains(name))
}

/// One `--set key.key=value`.
#[derive(Debug, Clone, PartialEq)]
pub struct Override {
    /// The keys, outermost first; at least one, none empty.
    path: Vec<String>,
    /// The value.
    value: Value,
}

/// Why an override cannot be applied.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("--set {text}: {message}")]
pub struct OverrideError {
    /// As given.
    pub text: String,
    /// What was expected and what was found.
    pub message: String,
}

impl Override {
    /// Makes an override from keys, outermost first, and a value.
    pub fn new(path: &[&str], value: impl Into<Value>) -> Override {
        Override { path: path.iter().map(|key| (*key).to_owned()).collect(), value: value.into() }
    }

    /// Reads `section.field=value` for a whole pipeline.
    ///
    /// # Errors
    ///
    /// As [`Override::from_str`]; and if the first key is no section, or nothing follows it.
    pub fn of_pipeline(text: &str) -> Result<Override, OverrideError> {
        let change: Override = text.parse()?;
        if change.path.len() >= 2 && SECTIONS.contains(&change.path[0].as_str()) {
            return Ok(change);
        }
        let message = format!("expected section.field=value with a section of {}", SECTIONS.join(", "));
        Err(OverrideError { text: text.to_owned(), message })
    }

    /// Reads `field=value` or `section.field=value` for one section.
    ///
    /// # Errors
    ///
    /// As [`Override::from_str`].
    pub fn of_section(section: &str, text: &str) -> Result<Override, OverrideError> {
        let mut change: Override = text.parse()?;
        if change.path.len() >= 2 && change.path[0] == section {
            change.path.remove(0);
        }
        Ok(change)
    }

    /// Puts the value into a table, making the tables on the way. Entries of lists go by their number from 0, or by
    /// their `name`.
    ///
    /// # Errors
    ///
    /// A key on the way is a plain value, or a list has no such entry.
    pub fn apply(&self, table: &mut toml::Table) -> Result<(), OverrideError> {
        let refuse = |message: String| OverrideError { text: self.to_string(), message };
        let (last, way) = self.path.split_last().expect("a path has at least one key");
        let (Some(first), rest) = (way.first(), way.get(1..).unwrap_or_default()) else {
            table.insert(last.clone(), self.value.clone());
            return Ok(());
        };
        let mut place = table.entry(first).or_insert_with(empty);
        let mut parent = first;
        for key in rest {
            place = below(place, parent, key).map_err(refuse)?;
            parent = key;
        }
        match place {
            Value::Table(inner) => {
                inner.insert(last.clone(), self.value.clone());
            }
            list => *below(list, parent, last).map_err(refuse)? = self.value.clone(),
        }
        Ok(())
    }
}

impl FromStr for Override {
    type Err = OverrideError;

    /// Reads `a.b=value`; the value is TOML, and a text where it is no TOML (`--set train.device=cpu`).
    fn from_str(text: &str) -> Result<Override, OverrideError> {
        let refuse = |message: &str| OverrideError { text: text.to_owned(), message: message.to_owned() };
        let (path, value) = text.split_once('=').ok_or_else(|| refuse("expected key=value, got no `=`"))?;
        let path: Vec<String> = path.split('.').map(|key| key.trim().to_owned()).collect();
        if path.iter().any(String::is_empty) {
            return Err(refuse("expected key=value, got an empty key"));
        }
        let value = value.trim();
        let parsed = format!("value = {value}").parse::<toml::Table>().ok();
        let parsed = parsed.filter(|table| table.len() == 1).and_then(|mut table| table.remove("value"));
        Ok(Override { path, value: parsed.unwrap_or_else(|| Value::String(value.to_owned())) })
    }
}

impl fmt::Display for Override {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}={}", self.path.join("."), self.value)
    }
}

fn empty() -> Value {
    Value::Table(toml::Table::new())
}

/// The value one key further in; `parent` names `place` in the error.
fn below<'a>(place: &'a mut Value, parent: &str, key: &str) -> Result<&'a mut Value, String> {
    match place {
        Value::Table(table) => Ok(table.entry(key).or_insert_with(empty)),
        Value::Array(list) => {
            let length = list.len();
            let named = list.iter().position(|entry| entry.get("name").and_then(Value::as_str) == Some(key));
            let index = key.parse().ok().or(named);
            let entry = index.and_then(|index: usize| list.get_mut(index));
            entry.ok_or_else(|| {
                format!("expected the number or name of one of {length} entries of {parent:?}, got {key:?}")
            })
        }
        plain => Err(format!("expected {parent:?} to be a table, got {}", plain.type_str())),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FILE: &str = "[train]\nsteps = 3\n[[ingest.stream]]\nname = \"arm\"\ngap_ms = 1\n\
                        [[ingest.stream]]\nname = \"camera\"\n";

    /// Applies one override to `FILE`, and returns what lies at a path then.
    fn check(text: &str, pointer: &[&str], expected: Value) {
        let mut file: toml::Table = FILE.parse().unwrap();
        text.parse::<Override>().unwrap().apply(&mut file).unwrap();
        let mut at = &Value::Table(file);
        for key in pointer {
            at = match key.parse::<usize>() {
                Ok(index) => &at[index],
                Err(_) => &at[*key],
            };
        }
        assert_eq!(*at, expected, "{text}");
    }

    fn check_refused(text: &str, expected: &[&str]) {
        let mut file: toml::Table = FILE.parse().unwrap();
        let error = match text.parse::<Override>() {
            Ok(change) => change.apply(&mut file).unwrap_err().to_string(),
            Err(error) => error.to_string(),
        };
        for part in expected {
            assert!(error.contains(part), "{text}: {error:?} does not say {part:?}");
        }
    }

    #[test]
    fn a_value_is_toml_or_a_text() {
        check("train.steps=9", &["train", "steps"], 9.into());
        check(" train . rate = 1e-3 ", &["train", "rate"], 1e-3.into());
        check("train.device=cpu", &["train", "device"], "cpu".into());
        check("train.device=\"cuda:0\"", &["train", "device"], "cuda:0".into());
        check("train.x=1\nsteps=2", &["train", "x"], "1\nsteps=2".into());
        check("model.encoder.depth=2", &["model", "encoder", "depth"], 2.into());
        check("seed=4", &["seed"], 4.into());
    }

    #[test]
    fn entries_of_lists_go_by_number_or_name() {
        check("ingest.stream.1.gap_ms=7", &["ingest", "stream", "1", "gap_ms"], 7.into());
        check("ingest.stream.arm.gap_ms=7", &["ingest", "stream", "0", "gap_ms"], 7.into());
        check("ingest.stream.0=5", &["ingest", "stream", "0"], 5.into());
        check_refused("ingest.stream.2.gap_ms=7", &["one of 2 entries of \"stream\"", "\"2\""]);
        check_refused("ingest.stream.hand=7", &["\"hand\""]);
    }

    #[test]
    fn refusals_say_what_was_expected() {
        check_refused("train.steps", &["--set train.steps", "no `=`"]);
        check_refused("train.=3", &["empty key"]);
        check_refused("=3", &["empty key"]);
        check_refused("train.steps.x=3", &["\"steps\" to be a table, got integer"]);
        assert!(Override::of_pipeline("steps=3").unwrap_err().message.contains("a section of sim"));
        assert!(Override::of_pipeline("trian.steps=3").is_err());
    }

    #[test]
    fn a_section_may_be_named_or_not() {
        let long = Override::of_section("eval", "eval.plan.count=3").unwrap();
        assert_eq!(long, Override::of_section("eval", "plan.count=3").unwrap());
        assert_eq!(long, Override::new(&["plan", "count"], 3));
    }

    #[test]
    fn a_name_that_is_no_section_is_found() {
        assert_eq!(unknown_section(&FILE.parse().unwrap()), None);
        assert_eq!(unknown_section(&"[trian]".parse().unwrap()), Some("trian"));
    }
}
