//! A table of the present labels, to be filled in.

use std::collections::BTreeSet;

use super::{Input, Label, LabelValue, current_labels, split_name};
use crate::csv::quoted;

/// Returns CSV with one row per episode: its names and present labels.
pub fn template(input: &Input) -> String {
    let runs: Vec<usize> = input.pieces(0).iter().map(|piece| piece.run).collect();
    let labels: Vec<_> = runs.iter().map(|run| current_labels(input, *run)).collect();
    let tags: BTreeSet<&Label> = labels
        .iter()
        .flat_map(|labels| labels.keys())
        .filter(|label| matches!(label, Label::Tag(_)))
        .collect();
    let name_of = |run: usize, column: &str| {
        let entry = input.dataset.entry(input.dataset.runs[run].episode_index);
        entry.and_then(|entry| entry.extra_text(column))
    };
    // What a LeRobot folder does not know is no column.
    let names: Vec<&str> = ["gawm/episode_id", "gawm/source_file"]
        .into_iter()
        .filter(|column| runs.iter().any(|run| name_of(*run, column).is_some()))
        .collect();
    let columns = [Label::Task, Label::Success, Label::Operator, Label::Split];
    let columns: Vec<&Label> = columns.iter().chain(tags).collect();
    let mut record = vec!["episode".to_owned()];
    record.extend(names.iter().map(|name| name.trim_start_matches("gawm/").to_owned()));
    record.extend(columns.iter().map(|label| label.column()));
    let mut table = line_of(&record);
    for (run, labels) in runs.iter().zip(&labels) {
        let mut record = vec![input.dataset.runs[*run].episode_index.to_string()];
        record.extend(names.iter().map(|name| name_of(*run, name).unwrap_or_default()));
        record.extend(columns.iter().map(|label| match labels.get(label) {
            None | Some(LabelValue::Unknown) => String::new(),
            Some(LabelValue::Text(text)) => text.clone(),
            Some(LabelValue::Bool(value)) => value.to_string(),
            Some(LabelValue::Split(split)) => split_name(*split).to_owned(),
        }));
        table += &line_of(&record);
    }
    table
}

fn line_of(cells: &[String]) -> String {
    cells.iter().map(|cell| quoted(cell)).collect::<Vec<_>>().join(",") + "\n"
}
