//! Reading and writing contracts.

use std::path::Path;

use serde::Deserialize;

use super::{Contract, ContractError};

/// Reads a contract from a file: a document of its own, or the `[ingest]` section of a pipeline.
///
/// Each of `overrides` is `a.b=value`, applied before the contract is read; list entries are numbered from 0.
pub fn load(path: &Path, overrides: &[String]) -> Result<Contract, ContractError> {
    let text = std::fs::read_to_string(path)
        .map_err(|source| ContractError::Read { path: path.to_owned(), source })?;
    let mut contract = parse(&text, &path.display().to_string(), overrides)?;
    super::task::expand(&mut contract, path.parent().unwrap_or(Path::new("")))?;
    Ok(contract)
}

/// Reads a contract from text; `file` is only named in errors.
pub fn parse(text: &str, file: &str, overrides: &[String]) -> Result<Contract, ContractError> {
    let table: toml::Table = toml::from_str(text).map_err(|error| syntax(file, &error))?;
    let text = if overrides.is_empty() {
        text.to_owned()
    } else {
        let mut root = toml::Value::Table(table.clone());
        let prefix = if table.contains_key("ingest") { "ingest." } else { "" };
        for text in overrides {
            apply(&mut root, prefix, text)?;
        }
        toml::to_string(&root)
            .map_err(|error| ContractError::Syntax { path: "--set".to_owned(), detail: error.to_string() })?
    };
    let shown = if overrides.is_empty() { file.to_owned() } else { format!("{file} with --set") };
    if table.contains_key("ingest") {
        #[derive(Deserialize)]
        struct Pipeline {
            ingest: Contract,
        }
        toml::from_str::<Pipeline>(&text).map(|pipeline| pipeline.ingest)
    } else {
        toml::from_str::<Contract>(&text)
    }
    .map_err(|error| syntax(&shown, &error))
}

/// Writes a contract with all its defaults.
pub fn to_toml(contract: &Contract) -> Result<String, ContractError> {
    toml::to_string(contract).map_err(|error| ContractError::Syntax {
        path: "resolved contract".to_owned(),
        detail: error.to_string(),
    })
}

fn syntax(file: &str, error: &toml::de::Error) -> ContractError {
    ContractError::Syntax { path: file.to_owned(), detail: error.to_string().trim_end().to_owned() }
}

/// Sets one value; `key=value` with `value` read as TOML, or as text where that fails.
fn apply(root: &mut toml::Value, prefix: &str, text: &str) -> Result<(), ContractError> {
    let fail = |detail: String| ContractError::Syntax { path: "--set".to_owned(), detail };
    let (key, value) = text
        .split_once('=')
        .ok_or_else(|| fail(format!("expected key=value such as ticks.rate_hz=10, got {text:?}")))?;
    let key = key.trim();
    let key = key.strip_prefix("ingest.").unwrap_or(key);
    let value = value.trim();
    let value = format!("v = {value}")
        .parse::<toml::Table>()
        .ok()
        .and_then(|mut table| table.remove("v"))
        .unwrap_or_else(|| toml::Value::String(value.to_owned()));
    let full = format!("{prefix}{key}");
    let parts: Vec<&str> = full.split('.').collect();
    let Some((last, path)) = parts.split_last() else {
        return Err(fail(format!("expected a key, got {text:?}")));
    };
    let mut at = root;
    for part in path {
        at = step(at, part).ok_or_else(|| fail(format!("no such key: {part:?} in {key:?}")))?;
    }
    match at {
        toml::Value::Table(table) => {
            table.insert((*last).to_owned(), value);
            Ok(())
        }
        toml::Value::Array(items) => {
            match last.parse::<usize>().ok().and_then(|index| items.get_mut(index)) {
                Some(item) => {
                    *item = value;
                    Ok(())
                }
                None => Err(fail(format!("no entry {last:?} in {key:?}"))),
            }
        }
        _ => Err(fail(format!("{key:?} goes on below a plain value"))),
    }
}

fn step<'a>(at: &'a mut toml::Value, part: &str) -> Option<&'a mut toml::Value> {
    match at {
        toml::Value::Table(table) => {
            Some(table.entry(part.to_owned()).or_insert_with(|| toml::Value::Table(toml::Table::new())))
        }
        toml::Value::Array(items) => {
            let named =
                items.iter().position(|item| item.get("name").and_then(toml::Value::as_str) == Some(part));
            let index = part.parse::<usize>().ok().or(named)?;
            items.get_mut(index)
        }
        _ => None,
    }
}
