//! `gawm-data filter`.

use std::path::PathBuf;

use clap::Args;
use serde_json::json;

use super::edit::{EditArguments, Format};
use super::{Failure, print_result};
use crate::edit::condition::{Condition, EpisodeValue};
use crate::edit::{Input, STATISTIC_NAMES, episode_values, filter};

/// Write a dataset of the episodes of which a condition is true
///
/// The condition compares what is known of an episode with numbers and texts:
///
///   length > 100 and success
///   task ~ 'cube' and not (session in ['a', 'b'])
///   max(action) < 3.2 and std(observation.state.elbow) > 0.01
///   errors == 0 and idle_share < 0.5
///
/// Names: all columns of the episode table, episode_index, length, duration_s, task, tags.NAME, errors and warnings (of
/// gawm-data validate), idle_share, and mean std min max q01 q10 q50 q90 q99 count missing mean_speed max_speed mean_jerk
/// idle_share of COLUMN.DIM or COLUMN[N]. Operators: == != < <= > >= ~ (contains) in, and or not. Unknown values are never
/// taken; `success == null` asks for them. --list-names prints what there is.
#[derive(Debug, Args)]
#[command(verbatim_doc_comment)]
pub(super) struct FilterArguments {
    /// Dataset folder (gawm, LeRobot v2.0, v2.1 or v3.0)
    dir: PathBuf,
    /// Folder to write; absent or empty
    #[arg(short, long, required_unless_present_any = ["list_names", "dry_run"])]
    out: Option<PathBuf>,
    /// The condition
    #[arg(short = 'w', long = "where", required_unless_present = "list_names")]
    condition: Option<String>,
    /// Print the names that a condition can ask for, with their values in the first episode, and stop
    #[arg(long)]
    list_names: bool,
    #[command(flatten)]
    edit: EditArguments,
}

pub(super) fn run(arguments: &FilterArguments, quiet: bool) -> Result<u8, Failure> {
    let input = arguments.edit.open(&arguments.dir)?;
    if arguments.list_names {
        print_result(&names(&input)?)?;
        return Ok(0);
    }
    let condition = arguments.condition.as_deref().unwrap_or_default();
    let plan = filter(&input, condition)?;
    let kept: Vec<i64> = plan.pieces.iter().map(|p| input.dataset.runs[p.run].episode_index).collect();
    if arguments.edit.dry_run && arguments.edit.format == Format::Text && !quiet {
        say!("episodes {kept:?}");
    }
    let out = arguments.out.clone().unwrap_or_else(|| PathBuf::from("(nothing)"));
    let inputs = [input];
    let written = arguments.edit.write(&inputs, &plan, &out, quiet)?;
    arguments.edit.report(&inputs, &[written], json!({"episodes": kept}), quiet)
}

/// Lists what a condition can ask for, with the values of the first episode.
fn names(input: &Input) -> Result<String, Failure> {
    // A name that is none asks for everything.
    let all = episode_values(input, &Condition::parse("`` == 0").map_err(Failure::usage)?)?;
    let shown = |value: &EpisodeValue| match value {
        EpisodeValue::Null => "null".to_owned(),
        EpisodeValue::Bool(t) => t.to_string(),
        EpisodeValue::Number(n) => n.to_string(),
        EpisodeValue::Text(text) => format!("{text:?}"),
    };
    let Some(first) = all.values().next() else { return Ok(String::new()) };
    let mut lines: String = first
        .iter()
        .filter(|(name, _)| !name.contains('('))
        .map(|(name, value)| format!("{name:<24} {}\n", shown(value)))
        .collect();
    let inner = |name: &str, statistic: &str| {
        Some(name.strip_prefix(statistic)?.strip_prefix('(')?.strip_suffix(')')?.to_owned())
    };
    let dims: Vec<String> = first.keys().filter_map(|name| inner(name, "mean")).collect();
    let whole: Vec<String> = first.keys().filter_map(|name| inner(name, "max")).collect();
    let list = |names: &[String]| names.join(", ");
    lines += &format!("\nSTATISTIC(DIM) with {}\n", STATISTIC_NAMES.join(", "));
    lines += &format!("and DIM one of {}\n", list(&dims));
    let whole: Vec<String> = whole.into_iter().filter(|name| !dims.contains(name)).collect();
    if !whole.is_empty() {
        lines += &format!("\nmin, max, missing, max_speed over all dims: {}\n", list(&whole));
    }
    Ok(lines)
}
