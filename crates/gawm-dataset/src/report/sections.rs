//! The sections of the page.

use std::{collections::BTreeMap, fmt::Write};

use base64::Engine;
use gawm_image::{Limits, decode_thumbnail, encode_jpeg};

use super::{Material, chart, escape};
use crate::{
    read::FrameBytes,
    validate::{Finding, Severity, rule},
};

/// Findings shown per rule.
const SHOWN_FINDINGS: usize = 5;
/// Dims shown per column.
const SHOWN_DIMS: usize = 64;
/// Rows of the episode table.
const SHOWN_EPISODES: usize = 1500;
/// Frames of a contact sheet.
const SHEET_FRAMES: usize = 8;
/// Cameras with a contact sheet.
const SHOWN_CAMERAS: usize = 8;
/// Width of a frame on a contact sheet in pixels.
const FRAME_WIDTH: usize = 192;
/// Clips shown.
const SHOWN_CLIPS: usize = 10;
/// Rows shown on each side of a clip.
const CLIP_MARGIN: usize = 30;

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
        let unit = if lag.rows.abs() == 1 { "row" } else { "rows" };
        facts.push((format!("{} {unit}", lag.rows), "from action to motion"));
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
        "<section id=\"alerts\"><h2>Alerts</h2><p>{} errors, {} warnings, {} notes.</p>",
        counts.error, counts.warning, counts.info
    )
    .ok();
    if counts.error + counts.warning == 0 {
        page.push_str("<p class=\"ok\">Nothing that harms training was found.</p>");
    }
    let (notes, alerts): (Vec<_>, Vec<_>) =
        by_rule(&report.findings).into_iter().partition(|g| g[0].severity == Severity::Info);
    alerts.iter().for_each(|group| alert(material, group, page));
    if !notes.is_empty() {
        write!(page, "<details><summary>{} notes</summary>", counts.info).ok();
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
        let message =
            if material.options.is_shared { shared(&finding.message) } else { finding.message.clone() };
        write!(page, "<li>{}{}</li>", escape(&place(finding)), escape(&message)).ok();
    }
    if group.len() > SHOWN_FINDINGS {
        write!(page, "<li class=\"soft\">and {} more</li>", group.len() - SHOWN_FINDINGS).ok();
    }
    write!(page, "</ul><span class=\"soft\">To do: {}</span></div>", escape(first.hint)).ok();
}

/// Leaves names of sessions and absolute paths out of a message.
fn shared(message: &str) -> String {
    let hidden = |word: &str| {
        let bare = word.trim_matches(|c: char| "\"',:;()".contains(c));
        bare.starts_with('/') && bare.len() > 1 || bare.starts_with("\\\\") || bare.get(1..3) == Some(":\\")
    };
    let words: Vec<&str> = message.split(' ').map(|w| if hidden(w) { "(path)" } else { w }).collect();
    let text = words.join(" ");
    match text.strip_prefix("session \"").and_then(|rest| rest.split_once('"')) {
        Some((_, rest)) => format!("a session{rest}"),
        None => text,
    }
}

fn place(finding: &Finding) -> String {
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

/// Draws the signals of the worst findings that name a place.
pub(super) fn worst_clips(material: &Material<'_>, page: &mut String) {
    let dataset = material.dataset;
    let mut seen: BTreeMap<(&str, Option<i64>), usize> = BTreeMap::new();
    let is_clip = |f: &&Finding| {
        f.severity >= Severity::Warning && f.rows.is_some() && f.episode.is_some() && f.dim.is_some()
    };
    let clips: Vec<&Finding> = material
        .examination
        .report
        .findings
        .iter()
        .filter(is_clip)
        .filter(|f| {
            let n = seen.entry((f.code, f.episode)).or_default();
            *n += 1;
            *n == 1
        })
        .take(SHOWN_CLIPS)
        .collect();
    if clips.is_empty() {
        return;
    }
    let mut columns: Vec<String> = clips.iter().filter_map(|f| f.feature.clone()).collect();
    columns.sort();
    columns.dedup();
    let scanned = dataset.scan(&columns, |rows| {
        let wanted = clips.iter().enumerate().filter(|(_, f)| f.episode == Some(rows.run.episode_index));
        wanted
            .filter_map(|(i, f)| clip_values(dataset, &rows, f).map(|values| (i, values)))
            .collect::<Vec<_>>()
    });
    let Ok((found, _)) = scanned else { return };
    let mut found: Vec<(usize, Clip)> = found.into_iter().flatten().collect();
    found.sort_by_key(|(i, _)| *i);
    if found.is_empty() {
        return;
    }
    page.push_str("<section id=\"clips\"><h2>Worst clips</h2><div class=\"dims\">");
    for (i, clip) in found {
        let finding = clips[i];
        let title = format!("{} {}", finding.code, place(finding).trim_end_matches(": "));
        let drawing = chart::trace(&clip.values, &title, Some(clip.mark));
        write!(
            page,
            "<div class=\"dim\"><b>{}</b><small>{}</small>{drawing}</div>",
            escape(&title),
            escape(&finding.message)
        )
        .ok();
    }
    page.push_str("</div></section>\n");
}

struct Clip {
    values: Vec<f64>,
    mark: (f64, f64),
}

fn clip_values(
    dataset: &crate::read::Dataset,
    rows: &crate::read::EpisodeRows,
    finding: &Finding,
) -> Option<Clip> {
    let (feature, dim, [first, end]) = (finding.feature.as_ref()?, finding.dim.as_ref()?, finding.rows?);
    let labels = crate::validate::dim_labels(dataset, feature);
    let dim = labels.iter().position(|l| l.name == *dim).or_else(|| dim.parse().ok())?;
    let values = rows.column(feature)?.dims().get(dim)?;
    let (first, end) = (first as usize, (end as usize).min(values.len()));
    let (from, to) = (first.saturating_sub(CLIP_MARGIN), (end + CLIP_MARGIN).min(values.len()));
    let shown = values.get(from..to).filter(|v| v.len() > 1)?;
    let share = |row: usize| (row - from) as f64 / (to - from) as f64;
    let stride = shown.len().div_ceil(300);
    Some(Clip {
        values: shown.iter().step_by(stride).copied().collect(),
        mark: (share(first), share(end.max(first))),
    })
}

pub(super) fn streams(material: &Material<'_>, page: &mut String) {
    let episodes = &material.examination.episodes;
    let of = |f: fn(&crate::validate::EpisodeMeasures) -> f64| -> Vec<f64> {
        let mut values: Vec<f64> = episodes.iter().map(f).filter(|v| v.is_finite()).collect();
        values.sort_by(f64::total_cmp);
        values
    };
    let at = |values: &[f64], q: f64| {
        values.get(((values.len().max(1) - 1) as f64 * q) as usize).copied().unwrap_or(0.0)
    };
    let (rate, gap, jitter) = (of(|e| e.rate_hz), of(|e| e.longest_periods), of(|e| e.jitter_periods));
    page.push_str("<section id=\"streams\"><h2>Clock and streams</h2>");
    write!(
        page,
        "<p>Rows come at {:.3} Hz (median over episodes; lowest {:.3}, highest {:.3}). The longest step between rows is {:.2} periods, jitter {:.1} % of a period (95th percentile, worst episode).</p>",
        at(&rate, 0.5), at(&rate, 0.0), at(&rate, 1.0), at(&gap, 1.0), 100.0 * at(&jitter, 1.0)
    )
    .ok();
    let column = |name: &str| material.stats.columns.iter().find(|c| c.name == name);
    if let Some(ages) = column("gawm.age_ms") {
        page.push_str("<div class=\"scroll\"><table><thead><tr><th>stream</th><th>age p50, ms</th><th>p90</th><th>p99</th><th>max</th><th>stamp to log p50, ms</th></tr></thead><tbody>");
        let arrivals = column("gawm.arrival_age_ms");
        for (i, dim) in ages.dims.iter().enumerate() {
            let s = dim.values.summary();
            let offset = arrivals.and_then(|a| a.dims.get(i)).map_or(0.0, |a| s.q50 - a.values.summary().q50);
            write!(page, "<tr><td>{}</td><td>{:.1}</td><td>{:.1}</td><td>{:.1}</td><td>{:.1}</td><td>{offset:.1}</td></tr>", escape(&dim.name), s.q50, s.q90, s.q99, s.max).ok();
        }
        page.push_str("</tbody></table></div>");
    } else {
        page.push_str("<p class=\"soft\">The dataset does not record the ages of samples.</p>");
    }
    match material.examination.action_lag {
        Some(lag) => write!(
            page,
            "<p>The motion from row t to t+1 is explained best by the action of row t{}: it explains {:.0} % of what the state's own momentum does not.</p>",
            match lag.rows { 0 => String::new(), n if n > 0 => format!("-{n}"), n => format!("+{}", -n) },
            100.0 * lag.explained
        ),
        None => write!(page, "<p class=\"soft\">Actions and states cannot be compared dim by dim.</p>"),
    }
    .ok();
    page.push_str("</section>\n");
}

pub(super) fn dims(material: &Material<'_>, page: &mut String) {
    page.push_str("<section id=\"dims\"><h2>Dims</h2>");
    for column in
        material.stats.columns.iter().filter(|c| {
            c.name != "timestamp" && !c.name.starts_with("gawm.valid") && !c.name.contains("age_ms")
        })
    {
        let encoding =
            if column.name.starts_with("gawm.") { " <span class=\"soft\">encoded</span>" } else { "" };
        write!(page, "<h3>{}{encoding}</h3><div class=\"dims\">", escape(&column.name)).ok();
        for dim in column.dims.iter().take(SHOWN_DIMS) {
            let s = dim.values.summary();
            let motion = dim.motion.summary(material.stats.fps);
            // "1" says that there is no unit.
            let has_unit = !dim.unit.is_empty() && dim.unit != "1";
            let unit = if has_unit { format!(" [{}]", dim.unit) } else { String::new() };
            let missing = if s.n_missing > 0 { format!(", {} missing", s.n_missing) } else { String::new() };
            let name = if dim.name.is_empty() { column.name.clone() } else { dim.name.clone() };
            write!(
                page,
                "<div class=\"dim\"><b>{}</b>{}<small>mean {:.4}, std {:.4}, {:.4} to {:.4}{missing}; speed {:.3}/s, idle {:.0} %</small>{}{}</div>",
                escape(&name),
                escape(&unit),
                s.mean, s.std, s.min, s.max, motion.mean_speed, 100.0 * motion.idle_share,
                chart::histogram(dim.values.histogram.counts(), &format!("histogram of {name}")),
                chart::trace(&dim.trace, &format!("{name} in the first episode"), None)
            )
            .ok();
        }
        page.push_str("</div>");
        if column.dims.len() > SHOWN_DIMS {
            write!(page, "<p class=\"soft\">and {} more dims</p>", column.dims.len() - SHOWN_DIMS).ok();
        }
    }
    page.push_str("</section>\n");
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
        "longest step",
        "success",
        "task",
    ];
    page.push_str("<section id=\"episodes\"><h2>Episodes</h2><div class=\"scroll\"><table class=\"sortable\"><thead><tr>");
    head.iter().for_each(|name| {
        write!(page, "<th><button type=\"button\">{name}</button></th>").ok();
    });
    page.push_str("</tr></thead><tbody>");
    for e in material.examination.episodes.iter().take(SHOWN_EPISODES) {
        let (errors, warnings) = alerts.get(&e.episode).copied().unwrap_or_default();
        let entry = material.dataset.entry(e.episode);
        let success = entry.and_then(|x| x.extra_text("success")).unwrap_or_default();
        let task: String =
            entry.and_then(|x| x.tasks.first()).map_or(String::new(), |t| t.chars().take(60).collect());
        write!(
            page,
            "<tr><td>{}</td><td>{}</td><td>{:.1}</td><td>{errors}</td><td>{warnings}</td><td>{:.0}</td><td>{:.1}</td><td>{:.2}</td><td>{}</td><td>{}</td></tr>",
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

pub(super) fn cameras(material: &Material<'_>, page: &mut String) {
    let dataset = material.dataset;
    let cameras = dataset.image_columns();
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
    skew(material, page);
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

/// Says how far apart the cameras' samples are, from the ages of their streams.
fn skew(material: &Material<'_>, page: &mut String) {
    let Some(ages) = material.stats.columns.iter().find(|c| c.name == "gawm.age_ms") else { return };
    let is_camera = |name: &str| {
        let name = name.to_ascii_lowercase();
        ["cam", "image", "rgb", "video"].iter().any(|word| name.contains(word))
            || material
                .dataset
                .info
                .features
                .iter()
                .any(|f| f.is_camera() && f.name.to_ascii_lowercase().ends_with(&name))
    };
    let cameras: Vec<_> = ages.dims.iter().filter(|d| is_camera(&d.name)).collect();
    for (i, a) in cameras.iter().enumerate() {
        for b in &cameras[i + 1..] {
            let apart = (a.values.summary().q50 - b.values.summary().q50).abs();
            write!(
                page,
                "<p>Samples of {} and {} are {apart:.1} ms apart in the median.</p>",
                escape(&a.name),
                escape(&b.name)
            )
            .ok();
        }
    }
}

/// Returns a frame as a small picture inside the page.
fn embedded(frame: &FrameBytes) -> Option<String> {
    let FrameBytes::Encoded(bytes) = frame else { return None };
    let (_, picture) = decode_thumbnail(bytes, FRAME_WIDTH / 2, &Limits::default()).ok()?;
    let small = if picture.width > FRAME_WIDTH {
        picture.shrunk(FRAME_WIDTH, (picture.height * FRAME_WIDTH / picture.width).max(1))
    } else {
        picture
    };
    let jpeg = encode_jpeg(&small.to_image().ok()?, 75).ok()?;
    Some(format!("data:image/jpeg;base64,{}", base64::engine::general_purpose::STANDARD.encode(jpeg)))
}
