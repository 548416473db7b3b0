//! `gawm-data label`.

use std::path::PathBuf;

use clap::Args;
use serde_json::{Value, json};

use super::edit::{EditArguments, Format};
use super::{Failure, print_result};
use crate::edit::Plan;
use crate::edit::label::{LabelTable, label, template};

/// Write a dataset with other labels: task, success, operator, split, tags
///
///   gawm-data label DIR --template > labels.csv
///   gawm-data label DIR --labels labels.csv --out OUT
///
/// The table is CSV with a header, a JSON list of objects, or JSON objects line by line. Columns: episode (index),
/// episode_id or source_file say which episodes; task, success (true, false, unknown), operator, split (train, val) and
/// tags.NAME say what. A label that is empty or absent stays as it is; null in JSON takes it away.
///
/// Of gawm datasets only what changes is written: data files are linked, images are never encoded again.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
pub(super) struct LabelArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// Folder to write; absent or empty
    #[arg(short, long, required_unless_present_any = ["template", "dry_run"])]
    out: Option<PathBuf>,
    /// Table of labels: CSV or JSON
    #[arg(short, long, required_unless_present = "template")]
    labels: Option<PathBuf>,
    /// Print the present labels as CSV and stop
    #[arg(long, conflicts_with_all = ["labels", "out"])]
    template: bool,
    /// Copy files that stay as they are, instead of linking them
    #[arg(long)]
    copy: bool,
    /// Say what would be done and write nothing
    #[arg(short = 'n', long)]
    dry_run: bool,
    /// Form of the summary on standard output
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
}

pub(super) fn run(arguments: &LabelArguments, quiet: bool) -> Result<u8, Failure> {
    let edit = EditArguments {
        skip_damaged: false,
        without_videos: false,
        without_camera: Vec::new(),
        dry_run: arguments.dry_run,
        format: arguments.format,
    };
    let inputs = [edit.open(&arguments.dir)?];
    if arguments.template {
        print_result(&template(&inputs[0]))?;
        return Ok(0);
    }
    let path = arguments.labels.clone().unwrap_or_default();
    let table = LabelTable::read(&path).map_err(crate::edit::EditError::from)?;
    let mut plan = label(&inputs[0], &table)?;
    if let Some(labels) = plan.labels.as_mut() {
        labels.copies = arguments.copy;
    }
    let changes = changes(&plan, |run| inputs[0].dataset.runs[run].episode_index);
    if arguments.format == Format::Text && !quiet {
        if changes.is_empty() {
            say!("note: all labels are as the table says already");
        }
        if arguments.dry_run {
            changes.iter().for_each(|(episode, labels)| say!("episode {episode}: {labels}"));
        }
    }
    let out = arguments.out.clone().unwrap_or_else(|| PathBuf::from("(nothing)"));
    let written = edit.write(&inputs, &plan, &out, quiet)?;
    let changes: serde_json::Map<String, Value> =
        changes.into_iter().map(|(episode, labels)| (episode.to_string(), Value::from(labels))).collect();
    edit.report(&inputs, &[written], json!({"changed": changes}), quiet)
}

/// Returns what changes in each episode, in words.
fn changes(plan: &Plan, index: impl Fn(usize) -> i64) -> Vec<(i64, String)> {
    let episodes = plan.labels.iter().flat_map(|labels| &labels.episodes);
    episodes
        .map(|(position, labels)| {
            let words = labels.iter().map(|(label, value)| format!("{} = {value}", label.column()));
            (index(plan.pieces[*position].run), words.collect::<Vec<_>>().join(", "))
        })
        .collect()
}
