//! The sections of the page.

use std::{collections::BTreeMap, fmt::Write};

use base64::Engine;
use gawm_image::{Limits, encode_jpeg};
use gawm_schema::{Encoding, FeatureData, Kind, Role, Wrap};

use super::{
    Material, chart, escape,
    streams::{Timing, skew},
};
use crate::{
    read::FrameBytes,
    stats::{ColumnTotals, DimTotals},
    validate::{Finding, Severity, rule},
};

/// Findings shown per rule.
const SHOWN_FINDINGS: usize = 5;
/// Dims shown per column.
const SHOWN_DIMS: usize = 64;
/// Dims shown of all columns together.
const SHOWN_DIMS_IN_ALL: usize = 400;
/// Rows of the episode table.
const SHOWN_EPISODES: usize = 1500;
/// Frames of a contact sheet.
const SHEET_FRAMES: usize = 8;
/// Characters of a task in the episode table.
const TASK_CHARS: usize = 80;
/// Cameras with a contact sheet.
const SHOWN_CAMERAS: usize = 8;
/// Width of a frame on a contact sheet in pixels.
const FRAME_WIDTH: usize = 192;

pub(super) fn overview(material: &Material<'_>, page: &mut String) {
    let (report, dataset) = (&material.examination.report, material.dataset);
    let seconds = report.rows as f64 / dataset.info.fps;
    let length =
        if seconds < 120.0 { format!("{seconds:.0} s") } else { format!("{:.1} min", seconds / 60.0) };
    let mut facts = vec![
        (report.episodes.to_string(), "episodes"),
        (report.rows.to_string(), "rows"),
        (format!("{} Hz", dataset.info.fps), "declared rate"),
        (length, "of motion"),
        (format!("{:.1} %", 100.0 * report.windows.share_of_rows), "of rows begin a usable window"),
        (
            format!("LeRobot {}", report.format),
            if dataset.gawm.is_some() { "written by gawm" } else { "format" },
        ),
    ];
    if let Some(robot) = &dataset.info.robot_type {
        facts.push((robot.clone(), "robot"));
    }
    if let Some(lag) = material.examination.action_lag {
        let name = if lag.rows < 0 { "action comes after its motion" } else { "from action to motion" };
        facts.push((counted(lag.rows.unsigned_abs(), "row"), name));
    }
    page.push_str("<ul class=\"facts\">");
    for (value, name) in facts {
        write!(page, "<li><b>{}</b>{}</li>", escape(&value), escape(name)).ok();
    }
    page.push_str("</ul>");
}

/// Returns the findings by rule and severity, worst first.
fn by_rule<'a>(findings: &'a [Finding]) -> Vec<Vec<&'a Finding>> {
    let mut groups: Vec<Vec<&'a Finding>> = Vec::new();
    for finding in findings {
        match groups.last_mut() {
            Some(group) if group[0].code == finding.code && group[0].severity == finding.severity => {
                group.push(finding)
            }
            _ => groups.push(vec![finding]),
        }
    }
    groups
}

pub(super) fn alerts(material: &Material<'_>, page: &mut String) {
    let report = &material.examination.report;
    let counts = report.counts;
    write!(
        page,
        "<section id=\"alerts\"><h2>Alerts</h2><p>{}, {}, {}.</p>",
        counted(counts.error, "error"),
        counted(counts.warning, "warning"),
        counted(counts.info, "note")
    )
    .ok();
    if counts.error + counts.warning == 0 {
        page.push_str("<p class=\"ok\">Nothing that harms training was found.</p>");
    }
    let (notes, alerts): (Vec<_>, Vec<_>) =
        by_rule(&report.findings).into_iter().partition(|g| g[0].severity == Severity::Info);
    alerts.iter().for_each(|group| alert(material, group, page));
    if !notes.is_empty() {
        write!(page, "<details><summary>{}</summary>", counted(counts.info, "note")).ok();
        notes.iter().for_each(|group| alert(material, group, page));
        page.push_str("</details>");
    }
    page.push_str("</section>\n");
}

fn alert(material: &Material<'_>, group: &[&Finding], page: &mut String) {
    let first = group[0];
    let (level, title) = (first.severity.text(), rule(first.code).map_or("", |r| r.title));
    write!(page, "<div class=\"alert {level}\"><span class=\"level\">{level}</span> <span class=\"code\">{}</span> {}<ul>", first.code, escape(title)).ok();
    for finding in group.iter().take(SHOWN_FINDINGS) {
        write!(page, "<li>{}{}</li>", escape(&place(finding)), escape(&said(material, finding))).ok();
    }
    if group.len() > SHOWN_FINDINGS {
        write!(page, "<li class=\"soft\">and {} more</li>", group.len() - SHOWN_FINDINGS).ok();
    }
    write!(page, "</ul><span class=\"soft\">To do: {}</span></div>", escape(first.hint)).ok();
}

/// Cuts a text after so many characters.
fn clipped(text: &str, n_chars: usize) -> String {
    match text.char_indices().nth(n_chars) {
        Some((at, _)) => format!("{}...", &text[..at]),
        None => text.to_owned(),
    }
}

/// Returns a number with its noun.
fn counted(n: u64, noun: &str) -> String {
    format!("{n} {noun}{}", if n == 1 { "" } else { "s" })
}

/// Returns a finding's message as the page may show it.
pub(super) fn said(material: &Material<'_>, finding: &Finding) -> String {
    if material.options.is_shared { shared(&finding.message) } else { finding.message.clone() }
}

/// Leaves names of sessions, absolute paths, addresses and hosts out of a text.
fn shared(message: &str) -> String {
    let hidden = |word: &str| {
        let bare = word.trim_start_matches(|c: char| "\"'(<[".contains(c));
        let starts = |part: &str| {
            bare.starts_with(part)
                || ["=", ":", ",", "\""].iter().any(|c| bare.contains(&format!("{c}{part}")))
        };
        let is_drive = bare
            .as_bytes()
            .windows(3)
            .any(|w| w[0].is_ascii_alphabetic() && w[1] == b':' && b"\\/".contains(&w[2]));
        let is_host = [".local", ".lan", ".internal", ".home"]
            .iter()
            .any(|end| bare.trim_end_matches(|c: char| "\"'),:;.>]".contains(c)).ends_with(end));
        (starts("/") || starts("~/")) && bare.len() > 1
            || bare.contains("\\\\")
            || is_drive
            || bare.contains("://")
            || bare.contains('@')
            || is_host
    };
    let words: Vec<&str> = message.split(' ').map(|w| if hidden(w) { "(path)" } else { w }).collect();
    let text = words.join(" ");
    match text.strip_prefix("session \"").and_then(|rest| rest.split_once('"')) {
        Some((_, rest)) => format!("a session{rest}"),
        None => text,
    }
}

pub(super) fn place(finding: &Finding) -> String {
    let mut parts = Vec::new();
    parts.extend(finding.episode.map(|e| format!("episode {e}")));
    parts.extend(
        finding.rows.map(|[a, b]| if b == a + 1 { format!("row {a}") } else { format!("rows {a} to {b}") }),
    );
    parts.extend(finding.feature.as_ref().map(|f| match &finding.dim {
        Some(dim) => format!("{f}[{dim}]"),
        None => f.clone(),
    }));
    if parts.is_empty() { String::new() } else { format!("{}: ", parts.join(", ")) }
}

pub(super) fn dims(material: &Material<'_>, page: &mut String) {
    page.push_str("<section id=\"dims\"><h2>Dims</h2>");
    let is_shown = |c: &&ColumnTotals| {
        c.name != "timestamp" && !c.name.starts_with("gawm.valid") && !c.name.contains("age_ms")
    };
    let mut left = SHOWN_DIMS_IN_ALL;
    for column in material.stats.columns.iter().filter(is_shown) {
        // What the model sees follows from the raw values: it is there for who asks.
        let is_encoded = column.name.starts_with("gawm.");
        let (open, close) = if is_encoded {
            let head = format!("<details><summary>{} (encoded)</summary>", escape(&column.name));
            (head, "</details>")
        } else {
            (format!("<h3>{}</h3>", escape(&column.name)), "")
        };
        page.push_str(&open);
        let labels = encodings(material, &column.name);
        let label = |i: usize| labels.get(i).map_or("", String::as_str);
        let is_constant = |d: &DimTotals| {
            let s = d.values.summary();
            s.count > 0 && s.min == s.max && s.n_missing == 0
        };
        let (constant, moving): (Vec<_>, Vec<_>) =
            column.dims.iter().enumerate().partition(|(_, d)| is_constant(d));
        page.push_str("<div class=\"dims\">");
        let n_shown = moving.len().min(SHOWN_DIMS).min(left);
        left -= n_shown;
        moving.iter().take(n_shown).for_each(|(i, d)| dim(material, &column.name, d, label(*i), page));
        page.push_str("</div>");
        if moving.len() > n_shown {
            write!(page, "<p class=\"soft\">and {} more dims</p>", moving.len() - n_shown).ok();
        }
        constants(&column.name, &constant, page);
        page.push_str(close);
    }
    page.push_str("</section>\n");
}

/// Draws one dim: moments, histogram, trace.
fn dim(material: &Material<'_>, column: &str, dim: &DimTotals, encoding: &str, page: &mut String) {
    let s = dim.values.summary();
    let motion = dim.motion.summary(material.stats.fps);
    // "1" says that there is no unit.
    let has_unit = !dim.unit.is_empty() && dim.unit != "1";
    let unit = if has_unit { format!(" [{}]", escape(&dim.unit)) } else { String::new() };
    let missing = if s.n_missing > 0 { format!(", {} missing", s.n_missing) } else { String::new() };
    let name = if dim.name.is_empty() { column } else { &dim.name };
    let encoding = if encoding.is_empty() { String::new() } else { format!("{encoding}; ") };
    write!(
        page,
        "<div class=\"dim\"><b>{}</b>{unit}<small>{encoding}mean {:.4}, std {:.4}, {:.4} to {:.4}{missing}; speed {:.3}/s, idle {:.0} %</small>{}{}</div>",
        escape(name),
        s.mean, s.std, s.min, s.max, motion.mean_speed, 100.0 * motion.idle_share,
        chart::histogram(dim.values.histogram.counts(), &format!("histogram of {name}")),
        chart::trace(&dim.trace, &format!("{name} in the first episode"), None)
    )
    .ok();
}

/// Names the dims that never change, in one line.
fn constants(column: &str, dims: &[(usize, &DimTotals)], page: &mut String) {
    if dims.is_empty() {
        return;
    }
    let name = |d: &DimTotals| if d.name.is_empty() { column.to_owned() } else { d.name.clone() };
    let listed =
        dims.iter().take(SHOWN_DIMS).map(|(_, d)| format!("{} = {}", name(d), d.values.summary().min));
    let more = dims.len().saturating_sub(SHOWN_DIMS);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    let listed: Vec<String> = listed.map(|text| escape(&text)).collect();
    write!(page, "<p class=\"soft\">Never change: {}{more}.</p>", listed.join(", ")).ok();
}

/// Returns what each dim of a column of a gawm dataset is, and how it is encoded.
fn encodings(material: &Material<'_>, column: &str) -> Vec<String> {
    let features = material.dataset.schema.iter().flat_map(|schema| &schema.features);
    let Some(feature) = features.into_iter().find(|f| f.name == column) else { return Vec::new() };
    let FeatureData::Vector { parts, .. } = &feature.data else { return Vec::new() };
    let encoding = |kind: Kind| match feature.role {
        Role::State => Some(Encoding::of_state(kind)),
        Role::Action => Some(Encoding::of_action(kind)),
        _ => None,
    };
    let text = |kind: Kind| {
        let name = match kind {
            Kind::Linear => "linear",
            Kind::Angle { wrap: Wrap::None } => "angle",
            Kind::Angle { wrap: Wrap::Pi } => "angle in [-pi, pi)",
            Kind::Angle { wrap: Wrap::TwoPi } => "angle in [0, 2 pi)",
            Kind::Quaternion { .. } => "quaternion",
            Kind::Rotvec => "rotation vector",
            Kind::Euler { .. } => "Euler angle",
            Kind::Matrix => "rotation matrix",
            Kind::Gripper => "gripper",
            Kind::Bool => "truth value",
            Kind::Direction => "direction",
            _ => return String::new(),
        };
        let encoding = encoding(kind).map_or("", |encoding| match encoding {
            Encoding::Identity => ", kept as it is",
            Encoding::SinCos => ", encoded as sine and cosine",
            Encoding::Rotation6d => ", encoded as 6-D rotation",
            Encoding::RotationVector => ", encoded as rotation vector",
            _ => "",
        });
        format!("{name}{encoding}")
    };
    parts.iter().flat_map(|part| part.dims.iter().map(move |_| text(part.kind))).collect()
}

pub(super) fn episodes(material: &Material<'_>, page: &mut String) {
    let mut alerts: BTreeMap<i64, (u64, u64)> = BTreeMap::new();
    for finding in &material.examination.report.findings {
        if let Some(episode) = finding.episode {
            let counts = alerts.entry(episode).or_default();
            counts.0 += u64::from(finding.severity == Severity::Error);
            counts.1 += u64::from(finding.severity == Severity::Warning);
        }
    }
    let head = [
        "episode",
        "rows",
        "seconds",
        "errors",
        "warnings",
        "idle %",
        "jitter %",
        "longest step, periods",
        "success",
        "task",
    ];
    page.push_str("<section id=\"episodes\"><h2>Episodes</h2><div class=\"scroll\"><table class=\"sortable\"><thead><tr>");
    head.iter().for_each(|name| {
        let class = if matches!(*name, "success" | "task") { " class=\"text\"" } else { "" };
        write!(page, "<th{class}><button type=\"button\">{name}</button></th>").ok();
    });
    page.push_str("</tr></thead><tbody>");
    for e in material.examination.episodes.iter().take(SHOWN_EPISODES) {
        let (errors, warnings) = alerts.get(&e.episode).copied().unwrap_or_default();
        let entry = material.dataset.entry(e.episode);
        let success = entry.and_then(|x| x.extra_text("success")).unwrap_or_default();
        let task = entry.and_then(|x| x.tasks.first()).map_or(String::new(), |t| clipped(t, TASK_CHARS));
        let task = if material.options.is_shared { shared(&task) } else { task };
        write!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{:.1}</td><td>{errors}</td><td>{warnings}</td><td>{:.0}</td><td>{:.1}</td><td>{:.2}</td><td class=\"text\">{}</td><td class=\"text\">{}</td></tr>",
            e.episode, e.rows, e.rows as f64 / material.stats.fps, 100.0 * e.idle_share, 100.0 * e.jitter_periods, e.longest_periods, escape(&success), escape(&task)
        )
        .ok();
    }
    page.push_str("</tbody></table></div>");
    if material.examination.episodes.len() > SHOWN_EPISODES {
        write!(
            page,
            "<p class=\"soft\">and {} more episodes</p>",
            material.examination.episodes.len() - SHOWN_EPISODES
        )
        .ok();
    }
    page.push_str("</section>\n");
}

pub(super) fn cameras(material: &Material<'_>, timing: Option<&Timing>, page: &mut String) {
    let dataset = material.dataset;
    let cameras = dataset.frame_columns();
    let videos: Vec<&str> = dataset
        .info
        .features
        .iter()
        .filter(|f| f.is_camera() && !cameras.contains(&f.name))
        .map(|f| f.name.as_str())
        .collect();
    if cameras.is_empty() && videos.is_empty() {
        return;
    }
    page.push_str("<section id=\"cameras\"><h2>Cameras</h2>");
    if let Some(timing) = timing {
        skew(material, timing, page);
    }
    for camera in cameras.iter().take(SHOWN_CAMERAS) {
        write!(page, "<h3>{}</h3><div class=\"sheet\">", escape(camera)).ok();
        let n_runs = dataset.runs.len();
        for k in 0..SHEET_FRAMES.min(n_runs.max(1) * 4) {
            // Frames spread over episodes and over each episode.
            let run_index = k * n_runs / SHEET_FRAMES.min(n_runs.max(1) * 4);
            let Some(run) = dataset.runs.get(run_index) else { continue };
            let row = (run.n_rows as usize * (2 * k + 1) / (2 * SHEET_FRAMES)).min(run.n_rows as usize - 1);
            let frame =
                dataset.read_frames(run_index, camera, &[row]).ok().and_then(|f| f.into_iter().next());
            let caption = format!("episode {}, row {row}", run.episode_index);
            match frame.and_then(|f| embedded(&f)) {
                Some(source) => write!(page, "<figure><img alt=\"{caption}\" src=\"{source}\"><figcaption>{caption}</figcaption></figure>"),
                None => write!(page, "<figure><figcaption>{caption}: no picture</figcaption></figure>"),
            }
            .ok();
        }
        page.push_str("</div>");
    }
    if !videos.is_empty() {
        write!(page, "<p class=\"soft\">In video files, not shown: {}</p>", escape(&videos.join(", "))).ok();
    }
    page.push_str("</section>\n");
}

/// Returns a frame as a small picture inside the page.
pub(super) fn embedded(frame: &FrameBytes) -> Option<String> {
    let (_, picture) = frame.thumbnail(FRAME_WIDTH / 2, &Limits::default()).ok()?;
    let small = if picture.width > FRAME_WIDTH {
        picture.shrunk(FRAME_WIDTH, (picture.height * FRAME_WIDTH / picture.width).max(1))
    } else {
        picture
    };
    let jpeg = encode_jpeg(&small.to_image().ok()?, 75).ok()?;
    Some(format!("data:image/jpeg;base64,{}", base64::engine::general_purpose::STANDARD.encode(jpeg)))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn check_shared(text: &str, expected: &str) {
        assert_eq!(shared(text), expected);
    }

    #[test]
    fn paths_addresses_and_hosts_are_left_out() {
        check_shared("meta/info.json: expected 3 / 4 episodes", "meta/info.json: expected 3 / 4 episodes");
        check_shared("file \"/mnt/joe/a.mcap\", row 3", "file (path) row 3");
        check_shared("from path=/data/x and C:\\logs and \\\\nas\\logs", "from (path) and (path) and (path)");
        check_shared("s3://bucket/x of joe@lab.org on pc7.local.", "(path) of (path) on (path)");
        check_shared("session \"monday of joe\" is on both sides", "a session is on both sides");
    }
}
