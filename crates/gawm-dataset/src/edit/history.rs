//! What edits a dataset went through: `meta/gawm-edits.json`.

use std::collections::BTreeMap;
use std::path::Path;

use gawm_schema::ContentHash;
use serde::{Deserialize, Serialize};
use serde_json::Value;

use super::{EditError, Input, Plan};
use crate::durable::Disk;
use crate::journal::to_json;
use crate::layout::EDITS;

/// Most edits that are kept; more come only from a hostile file.
const MAX_EDITS: usize = 10_000;

/// One edit.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditRecord {
    /// Name of the verb.
    pub verb: String,
    /// What was asked for, by the names of the arguments.
    pub arguments: BTreeMap<String, String>,
    /// The program.
    pub software: String,
    /// The datasets that were read.
    pub inputs: Vec<EditInput>,
    /// Episodes of the output.
    pub episodes: u64,
    /// Rows of the output.
    pub rows: u64,
}

/// A dataset that an edit read.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct EditInput {
    /// BLAKE3 over the content hashes of its episodes; of a LeRobot folder over the names, lengths and footers of its
    /// data files.
    pub hash: ContentHash,
    /// Its episodes.
    pub episodes: u64,
    /// Its rows.
    pub rows: u64,
    /// Episodes that went into the output, as ranges of episode indices: `0..3 7..8`.
    pub taken: String,
}

/// Writes the edits of the inputs and this one.
pub(super) fn write(
    dir: &Path,
    inputs: &[Input],
    plan: &Plan,
    (episodes, rows): (u64, u64),
) -> Result<(), EditError> {
    let mut edits: Vec<EditRecord> = Vec::new();
    for edit in inputs.iter().flat_map(|input| &input.edits) {
        if !edits.contains(edit) && edits.len() < MAX_EDITS {
            edits.push(edit.clone());
        }
    }
    edits.push(EditRecord {
        verb: plan.verb.clone(),
        arguments: plan.arguments.clone(),
        software: software(),
        inputs: inputs.iter().enumerate().map(|(i, input)| record_of(input, i, plan)).collect(),
        episodes,
        rows,
    });
    let path = dir.join(EDITS);
    if let Some(folder) = path.parent() {
        std::fs::create_dir_all(folder).map_err(EditError::io("create", folder))?;
    }
    let bytes = to_json(&path, &edits)?;
    Disk::default().write_whole(&path, &bytes).map_err(EditError::io("write", &path))
}

/// Name and version of this program.
pub(super) fn software() -> String {
    concat!("gawm-data ", env!("CARGO_PKG_VERSION")).to_owned()
}

fn record_of(input: &Input, position: usize, plan: &Plan) -> EditInput {
    let mut taken: Vec<i64> = plan
        .pieces
        .iter()
        .filter(|piece| piece.input == position)
        .map(|piece| input.dataset.runs[piece.run].episode_index)
        .collect();
    taken.sort_unstable();
    EditInput {
        hash: input.hash,
        episodes: input.dataset.runs.len() as u64,
        rows: input.dataset.n_rows(),
        taken: ranges(&taken),
    }
}

/// Returns sorted numbers as half-open ranges.
pub(super) fn ranges(numbers: &[i64]) -> String {
    let mut parts: Vec<(i64, i64)> = Vec::new();
    for &number in numbers {
        match parts.last_mut() {
            Some((_, end)) if *end == number => *end += 1,
            _ => parts.push((number, number.saturating_add(1))),
        }
    }
    parts.iter().map(|(from, to)| format!("{from}..{to}")).collect::<Vec<_>>().join(" ")
}

/// Returns the edits of a dataset from its file, or what is wrong with it.
pub(super) fn parse(value: Option<Value>) -> Result<Vec<EditRecord>, String> {
    let edits: Vec<EditRecord> = match value {
        None => Vec::new(),
        Some(value) => serde_json::from_value(value).map_err(|error| error.to_string())?,
    };
    if edits.len() > MAX_EDITS { Err(format!("{} edits", edits.len())) } else { Ok(edits) }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_are_listed_as_ranges() {
        assert_eq!(ranges(&[0, 1, 2, 7, 9, 10]), "0..3 7..8 9..11");
        assert_eq!(ranges(&[]), "");
    }
}
