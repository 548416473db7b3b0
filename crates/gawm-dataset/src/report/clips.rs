//! The worst clips: the signal, or the pictures, around the places that findings name.

use std::{collections::BTreeMap, fmt::Write};

use super::{
    Material, chart, escape,
    sections::{embedded, place, said},
};
use crate::{
    read::{Dataset, EpisodeRows},
    validate::{Finding, Severity},
};

/// Clips shown.
const SHOWN_CLIPS: usize = 10;
/// Clips of one rule while others have none.
const CLIPS_PER_RULE: usize = 3;
/// Rows shown on each side of a clip.
const CLIP_MARGIN: usize = 30;
/// Points of a drawn clip.
const CLIP_POINTS: usize = 300;

/// Draws what the worst findings that name a place are about.
pub(super) fn worst_clips(material: &Material<'_>, page: &mut String) {
    let clips = chosen(material);
    let drawn = draw_signals(material.dataset, &clips);
    let mut section = String::new();
    for (i, finding) in clips.iter().enumerate() {
        let title = format!("{} {}", finding.code, place(finding).trim_end_matches(": "));
        let picture = match drawn.iter().find(|(k, _)| *k == i) {
            Some((_, clip)) => chart::trace(&clip.values, &title, Some(clip.mark)),
            None => pictures(material.dataset, finding).unwrap_or_default(),
        };
        if !picture.is_empty() {
            let message = said(material, finding);
            write!(
                section,
                "<div class=\"dim\"><b>{}</b><small>{}</small>{picture}</div>",
                escape(&title),
                escape(&message)
            )
            .ok();
        }
    }
    if !section.is_empty() {
        let head = "<section id=\"clips\"><h2>Worst clips</h2><div class=\"dims\">";
        writeln!(page, "{head}{section}</div></section>").ok();
    }
}

/// Chooses findings that name rows of a signal or of a camera: the worst first, one per rule and episode, and not all
/// of one rule.
fn chosen<'a>(material: &'a Material<'_>) -> Vec<&'a Finding> {
    let cameras = material.dataset.frame_columns();
    let is_clip = |f: &&Finding| {
        let is_camera = f.feature.as_ref().is_some_and(|name| cameras.contains(name));
        f.severity >= Severity::Warning
            && f.rows.is_some()
            && f.episode.is_some()
            && (f.dim.is_some() || is_camera)
    };
    let mut per_rule: BTreeMap<&str, Vec<Option<i64>>> = BTreeMap::new();
    let (mut first, mut rest) = (Vec::new(), Vec::new());
    for finding in material.examination.report.findings.iter().filter(is_clip) {
        let episodes = per_rule.entry(finding.code).or_default();
        if episodes.contains(&finding.episode) || episodes.len() >= SHOWN_CLIPS {
            continue;
        }
        episodes.push(finding.episode);
        if episodes.len() <= CLIPS_PER_RULE { first.push(finding) } else { rest.push(finding) }
    }
    first.into_iter().chain(rest).take(SHOWN_CLIPS).collect()
}

struct Clip {
    values: Vec<f64>,
    mark: (f64, f64),
}

/// Returns the signals around those findings that name a dim, with their positions.
fn draw_signals(dataset: &Dataset, clips: &[&Finding]) -> Vec<(usize, Clip)> {
    let has_dim = |f: &&&Finding| f.dim.is_some();
    let mut columns: Vec<String> = clips.iter().filter(has_dim).filter_map(|f| f.feature.clone()).collect();
    columns.sort();
    columns.dedup();
    if columns.is_empty() {
        return Vec::new();
    }
    let is_wanted = |run: usize| clips.iter().any(|f| f.episode == Some(dataset.runs[run].episode_index));
    let scanned = dataset.scan_some(&columns, is_wanted, |rows| {
        let wanted = clips.iter().enumerate().filter(|(_, f)| f.episode == Some(rows.run.episode_index));
        wanted.filter_map(|(i, f)| Some((i, clip(dataset, &rows, f)?))).collect::<Vec<_>>()
    });
    scanned.map_or(Vec::new(), |(found, _)| found.into_iter().flatten().collect())
}

fn clip(dataset: &Dataset, rows: &EpisodeRows, finding: &Finding) -> Option<Clip> {
    let (feature, dim, [first, end]) = (finding.feature.as_ref()?, finding.dim.as_ref()?, finding.rows?);
    let labels = crate::validate::dim_labels(dataset, feature);
    let dim = labels.iter().position(|l| l.name == *dim).or_else(|| dim.parse().ok())?;
    let values = rows.column(feature)?.dims().get(dim)?;
    let (first, end) = (first as usize, (end as usize).min(values.len()));
    let (from, to) = (first.saturating_sub(CLIP_MARGIN), end.saturating_add(CLIP_MARGIN).min(values.len()));
    let shown = values.get(from..to).filter(|v| v.len() > 1)?;
    let share = |row: usize| (row - from) as f64 / (to - from) as f64;
    let stride = shown.len().div_ceil(CLIP_POINTS);
    Some(Clip {
        values: shown.iter().step_by(stride).copied().collect(),
        mark: (share(first), share(end.max(first))),
    })
}

/// Returns the frames before, at the beginning, at the end, and after a finding about a camera.
fn pictures(dataset: &Dataset, finding: &Finding) -> Option<String> {
    let (camera, episode, [first, end]) = (finding.feature.as_ref()?, finding.episode?, finding.rows?);
    let run_index = dataset.runs.iter().position(|run| run.episode_index == episode)?;
    let n_rows = dataset.runs[run_index].n_rows;
    let mut rows: Vec<usize> = [first.saturating_sub(1), first, end.saturating_sub(1), end]
        .into_iter()
        .filter(|row| *row < n_rows)
        .map(|row| row as usize)
        .collect();
    rows.sort_unstable();
    rows.dedup();
    let frames = dataset.read_frames(run_index, camera, &rows).ok()?;
    let mut out = "<div class=\"sheet\">".to_owned();
    for (row, frame) in rows.iter().zip(&frames) {
        let mark = if (first..end).contains(&(*row as u64)) { " class=\"marked\"" } else { "" };
        match embedded(frame) {
            Some(source) => write!(
                out,
                "<figure{mark}><img alt=\"row {row}\" src=\"{source}\"><figcaption>row {row}</figcaption></figure>"
            ),
            None => write!(out, "<figure{mark}><figcaption>row {row}: no picture</figcaption></figure>"),
        }
        .ok();
    }
    Some(out + "</div>")
}
