//! Reading and writing contracts.

use std::path::Path;

use gawm_schema::pipeline::{Override, SECTIONS, unknown_section};
use serde::Deserialize;

use super::{Contract, ContractError};

/// Reads a contract from a file: a document of its own, or the `[ingest]` section of a pipeline.
///
/// Each of `overrides` is `a.b=value`, applied before the contract is read; entries of lists go by number or name.
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
    if let Some(name) = table.contains_key("ingest").then(|| unknown_section(&table)).flatten() {
        let detail = format!("unknown section [{name}], expected one of {SECTIONS:?}");
        return Err(ContractError::Syntax { path: file.to_owned(), detail });
    }
    let text = if overrides.is_empty() {
        text.to_owned()
    } else {
        let mut root = table.clone();
        for text in overrides {
            let change = Override::of_section("ingest", text)?;
            match root.get_mut("ingest") {
                None => change.apply(&mut root)?,
                Some(toml::Value::Table(section)) => change.apply(section)?,
                Some(_) => break,
            }
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
