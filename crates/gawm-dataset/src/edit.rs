//! Edits: a new dataset from episodes, or parts of episodes, of others. The sources are only read.
//!
//! All verbs make a [`Plan`] (which rows of which episodes, in which order) and hand it to [`write()`], the one place
//! that writes. A plan over gawm datasets goes through [`DatasetWriter`](crate::DatasetWriter), row by row through the
//! data contract, so that statistics, encodings, standardisation and hashes are those of the new rows. A plan over
//! LeRobot folders copies columns as they are, numbers rows and episodes anew, counts statistics again, and writes
//! LeRobot v3.0 whatever version it read.
//!
//! The output grows in a folder beside its place and gets its name when it is whole. What was done is kept in
//! [`EDITS`](crate::layout::EDITS).

pub mod condition;
mod episode_columns;
mod error;
mod filter;
mod gawm_output;
mod history;
mod input;
pub mod label;
mod lerobot_meta;
mod lerobot_output;
mod merge;
mod output;
mod piece_rows;
mod split;
mod trim;

use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

pub use error::EditError;
pub use filter::{STATISTIC_NAMES, episode_values, filter};
pub use history::{EditInput, EditRecord};
pub use input::{Input, InputOptions};
pub use label::LabelError;
pub use merge::merge;
pub use split::{SplitBy, SplitPart, parse_part, split};
pub use trim::{TrimOptions, TrimmedEpisode, trim};

/// Rows of one episode that go into the output.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Piece {
    /// Position of the input.
    pub input: usize,
    /// Position in the input's [`runs`](crate::read::Dataset::runs).
    pub run: usize,
    /// Rows of the episode.
    pub rows: Range<u64>,
}

/// What an edit does: the rows of the output in their order.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Plan {
    /// Name of the verb.
    pub verb: String,
    /// What was asked for, by the names of the arguments.
    pub arguments: BTreeMap<String, String>,
    /// The episodes of the output.
    pub pieces: Vec<Piece>,
    /// Other labels; the pieces are then all episodes of one input, as they are.
    pub labels: Option<label::Relabelling>,
}

/// What an edit wrote.
#[derive(Debug, Clone, PartialEq, Eq, serde::Serialize)]
pub struct EditSummary {
    /// Episodes in the output.
    pub episodes: u64,
    /// Rows in the output.
    pub rows: u64,
    /// What the user should know of it: what was left out, converted or renamed.
    pub notes: Vec<String>,
}

/// Writes the output of a plan into `out`, which must be absent or empty.
///
/// `progress` is called with the number of rows that were written since the last call.
///
/// # Errors
/// - the plan is empty;
/// - `out` holds something, lies inside an input, or contains one;
/// - inputs cannot be read, or the output cannot be written; nothing is left at `out` then.
pub fn write(
    inputs: &[Input],
    plan: &Plan,
    out: &Path,
    progress: &(dyn Fn(u64) + Sync),
) -> Result<EditSummary, EditError> {
    if plan.pieces.is_empty() {
        return Err(EditError::NothingLeft { verb: plan.verb.clone() });
    }
    let target = output::Target::prepare(out, inputs)?;
    let summary = match inputs {
        [Input { gawm: Some(gawm), .. }] if plan.labels.is_some() => {
            label::write(&inputs[0], gawm, plan, target.folder(), progress)?
        }
        _ if inputs.iter().all(|input| input.gawm.is_some()) => {
            gawm_output::write(inputs, plan, target.folder(), progress)?
        }
        _ => lerobot_output::write(inputs, plan, target.folder(), progress)?,
    };
    target.finish()?;
    Ok(summary)
}

/// Checks that an output of an edit of `inputs` can be written at `out`.
///
/// # Errors
/// `out` holds something, lies inside an input, or contains one.
pub fn check_output(out: &Path, inputs: &[Input]) -> Result<(), EditError> {
    output::check_place(out, inputs.iter().map(|input| input.dataset.root.as_path())).map(|_| ())
}

#[cfg(test)]
mod tests;
