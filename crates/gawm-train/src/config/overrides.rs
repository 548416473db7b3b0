//! `--set section.field=value`.

use std::str::FromStr;

use super::ConfigError;

/// One `--set section.field=value`.
#[derive(Debug, Clone, PartialEq)]
pub struct Override {
    /// The keys, outermost first.
    pub path: Vec<String>,
    /// The value.
    pub value: toml::Value,
}

impl FromStr for Override {
    type Err = ConfigError;

    /// Reads `a.b=value`; the value is TOML, and a text where it is no TOML (`--set train.device=cpu`).
    fn from_str(text: &str) -> Result<Override, ConfigError> {
        let refuse =
            |message: &str| ConfigError::Override { text: text.to_owned(), message: message.to_owned() };
        let (path, value) =
            text.split_once('=').ok_or_else(|| refuse("expected section.field=value, got no `=`"))?;
        let path: Vec<String> = path.split('.').map(|key| key.trim().to_owned()).collect();
        if path.len() < 2 || path.iter().any(String::is_empty) {
            return Err(refuse("expected section.field=value, got no field"));
        }
        let value = value.trim();
        let parsed = format!("value = {value}").parse::<toml::Table>().ok();
        let parsed = parsed.filter(|table| table.len() == 1).and_then(|mut table| table.remove("value"));
        let value = parsed.unwrap_or_else(|| toml::Value::String(value.to_owned()));
        Ok(Override { path, value })
    }
}

impl Override {
    /// Puts the value into a table, making the tables on the way.
    ///
    /// # Errors
    ///
    /// - [`ConfigError::Override`] if a key on the way is no table.
    pub fn apply(&self, table: &mut toml::Table) -> Result<(), ConfigError> {
        let (last, way) = self.path.split_last().expect("a path has at least two keys");
        let mut inner = table;
        for key in way {
            let entry = inner.entry(key).or_insert_with(|| toml::Value::Table(toml::Table::new()));
            let kind = entry.type_str();
            inner = entry.as_table_mut().ok_or_else(|| ConfigError::Override {
                text: self.path.join("."),
                message: format!("expected {key:?} to be a table, got {kind}"),
            })?;
        }
        inner.insert(last.clone(), self.value.clone());
        Ok(())
    }
}
