//! Writes a first contract from logs, every guess with its reason.
//!
//! [`suggest`] looks at the logs (`survey`), decides what each topic is (`guess`), measures how commands and
//! states hang together (`measure`, `lag`) and writes the contract with comments (`render`).

mod clock;
mod commands;
mod episodes;
mod fields;
mod guess;
mod lag;
mod measure;
mod names;
mod render;
mod survey;
mod urdf;

use std::path::PathBuf;

use thiserror::Error;

use crate::contract::Contract;
use crate::decode::SchemaLibrary;
use crate::log::{OpenLogError, OpenOptions};

pub use survey::DecodingProbe;

/// Why no contract can be suggested.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SuggestError {
    /// No log can be read.
    #[error("no log can be read: {}", reasons.join("; "))]
    NoLog {
        /// Why, one per input.
        reasons: Vec<String>,
        /// What to do about the first.
        hint: Option<String>,
    },
    /// No topic holds numbers or images that can be decoded.
    #[error("no topic holds numbers or images that can be mapped; the log has {}", topics.join(", "))]
    NothingToMap {
        /// Topics, each with what keeps it from being mapped.
        topics: Vec<String>,
    },
    /// A log cannot be opened again.
    #[error(transparent)]
    Open(#[from] OpenLogError),
}

impl SuggestError {
    /// Returns what the reader can do about it.
    pub fn hint(&self) -> Option<String> {
        match self {
            SuggestError::NoLog { hint, .. } => hint.clone(),
            SuggestError::NothingToMap { .. } => {
                Some("`gawm-ingest inspect LOG` says why topics cannot be decoded; `schemas = [folder]` gives types that the log lacks".to_owned())
            }
            SuggestError::Open(error) => error.hint(),
        }
    }
}

/// A contract with its reasons.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Suggestion {
    /// The contract.
    pub contract: Contract,
    /// Reasons for each stream.
    pub stream_reasons: Vec<Vec<String>>,
    /// Reasons for other keys: section to lines.
    pub reasons: std::collections::BTreeMap<&'static str, Vec<String>>,
    /// Topics that are not mapped, and why.
    pub unmapped: Vec<String>,
}

/// Suggests a contract for logs.
///
/// # Errors
/// No log can be read, or none of their topics can be mapped.
pub fn suggest(
    inputs: &[PathBuf],
    library: &SchemaLibrary,
    options: &OpenOptions,
) -> Result<Suggestion, SuggestError> {
    let survey = survey::survey(inputs, library, options)?;
    let mut suggestion = guess::guess(&survey, library);
    if suggestion.contract.stream.is_empty() {
        return Err(SuggestError::NothingToMap { topics: suggestion.unmapped });
    }
    measure::refine(&mut suggestion, &survey, library);
    episodes::guess(&mut suggestion, &survey);
    Ok(suggestion)
}

/// Returns the contract as TOML with comments.
pub fn to_toml(suggestion: &Suggestion) -> String {
    render::render(suggestion)
}
