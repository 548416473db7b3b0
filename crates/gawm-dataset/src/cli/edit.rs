//! What all verbs that write new datasets share.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use clap::{Args, ValueEnum};
use serde_json::{Value, json};

use super::{EXIT_CHECK_FAILED, Failure, print_result, progress};
use crate::edit::{EditError, EditSummary, Input, InputOptions, Plan, write};

/// Arguments of all verbs that write new datasets.
#[derive(Debug, Args)]
pub(super) struct EditArguments {
    /// Leave damaged episodes out instead of refusing the dataset
    #[arg(long)]
    pub(super) skip_damaged: bool,
    /// Leave out cameras in video files
    #[arg(long)]
    pub(super) without_videos: bool,
    /// Leave out one camera; may be given several times
    #[arg(long, value_name = "CAMERA")]
    pub(super) without_camera: Vec<String>,
    /// Say what would be done and write nothing
    #[arg(short = 'n', long)]
    pub(super) dry_run: bool,
    /// Form of the summary on standard output
    #[arg(long, value_enum, default_value_t = Format::Text)]
    pub(super) format: Format,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub(super) enum Format {
    Text,
    Json,
}

impl EditArguments {
    pub(super) fn open(&self, dir: &Path) -> Result<Input, Failure> {
        let options = InputOptions {
            skips_damaged: self.skip_damaged,
            drops_videos: self.without_videos,
            dropped_cameras: self.without_camera.clone(),
        };
        Ok(Input::open(dir, options)?)
    }

    /// Writes an output; returns what was written.
    pub(super) fn write(
        &self,
        inputs: &[Input],
        plan: &Plan,
        out: &Path,
        quiet: bool,
    ) -> Result<Written, Failure> {
        let rows: u64 = plan.pieces.iter().map(|piece| piece.rows.end - piece.rows.start).sum();
        let before: u64 = inputs.iter().map(|input| input.dataset.n_rows()).sum();
        let n_before: u64 = inputs.iter().map(|input| input.dataset.runs.len() as u64).sum();
        let summary = if self.dry_run {
            if plan.pieces.is_empty() {
                return Err(EditError::NothingLeft { verb: plan.verb.clone() }.into());
            }
            EditSummary { episodes: plan.pieces.len() as u64, rows, notes: Vec::new() }
        } else {
            let bar = progress::bar(quiet, "writing", rows);
            let summary = write(inputs, plan, out, &|n| bar.inc(n));
            bar.finish_and_clear();
            summary?
        };
        Ok(Written { out: out.to_owned(), before: (n_before, before), summary })
    }

    /// Prints what was written; exit code 3 when something was left out that nobody asked to leave out.
    pub(super) fn report(
        &self,
        inputs: &[Input],
        written: &[Written],
        details: Value,
        quiet: bool,
    ) -> Result<u8, Failure> {
        let left_out: Vec<&String> = inputs.iter().flat_map(|input| &input.notes).collect();
        if !quiet {
            left_out.iter().for_each(|note| say!("warning: {note}"));
            let notes: BTreeSet<&String> = written.iter().flat_map(|w| &w.summary.notes).collect();
            notes.iter().for_each(|note| say!("note: {note}"));
        }
        let text = match self.format {
            Format::Json => {
                let outputs: Vec<Value> = written
                    .iter()
                    .map(|w| {
                        json!({"out": w.out.display().to_string(), "episodes": w.summary.episodes,
                               "rows": w.summary.rows, "notes": w.summary.notes})
                    })
                    .collect();
                let all = json!({"dry_run": self.dry_run, "outputs": outputs, "left_out": left_out, "details": details});
                serde_json::to_string_pretty(&all)? + "\n"
            }
            Format::Text => written.iter().map(|w| w.line(self.dry_run)).collect(),
        };
        print_result(&text)?;
        Ok(if left_out.is_empty() { 0 } else { EXIT_CHECK_FAILED })
    }
}

/// An output that was written.
pub(super) struct Written {
    out: PathBuf,
    before: (u64, u64),
    summary: EditSummary,
}

impl Written {
    fn line(&self, is_dry: bool) -> String {
        let ((episodes, rows), s) = (self.before, &self.summary);
        let verb = if is_dry { "would write" } else { "wrote" };
        let out = self.out.display();
        format!("{verb} {out}: {} of {episodes} episodes, {} of {rows} rows\n", s.episodes, s.rows)
    }
}
