//! The clock of the rows, the streams behind them, the way from action to motion, and how far apart cameras are.

use std::{
    collections::BTreeMap,
    fmt::Write,
    sync::{Mutex, PoisonError},
};

use gawm_schema::Role;

use super::{Material, escape};
use crate::{layout::TIME_NS, read::EpisodeRows};

/// Streams shown.
const SHOWN_STREAMS: usize = 200;
/// Cameras of which each pair is compared.
const COMPARED_CAMERAS: usize = 8;
/// A sample is new when its time moved by more than this.
const SAME_SAMPLE_NS: f64 = 20e3;
/// Resolution of the time between the samples of two cameras, and its largest value in steps.
const SKEW_STEP_MS: f64 = 0.1;
const MAX_SKEW_STEPS: f64 = 100_000.0;

/// What the ages of samples tell about the streams.
pub(super) struct Timing {
    /// In the order of `gawm.age_ms`.
    streams: Vec<Arrivals>,
    /// Pairs of cameras: position of both streams, and how often their samples were so many steps apart.
    skews: Vec<(usize, usize, BTreeMap<u32, u64>)>,
}

/// The samples of one stream that rows show.
#[derive(Clone, Copy, Default)]
struct Arrivals {
    /// Samples that were new.
    n_new: u64,
    /// From first to last sample, over all episodes.
    span_ns: f64,
    longest_ns: f64,
}

/// Measures the streams of a gawm dataset in one pass; `None` where ages are not recorded.
pub(super) fn measure(material: &Material<'_>) -> Option<Timing> {
    let dataset = material.dataset;
    let width = dataset.info.feature("gawm.age_ms")?.width();
    let columns = ["gawm.age_ms".to_owned(), TIME_NS.to_owned()];
    let cameras: Vec<usize> = camera_streams(material).into_iter().take(COMPARED_CAMERAS).collect();
    let pairs: Vec<(usize, usize)> = cameras
        .iter()
        .enumerate()
        .flat_map(|(i, a)| cameras[i + 1..].iter().map(move |b| (*a, *b)))
        .filter(|(a, b)| *a < width && *b < width)
        .collect();
    // Counts add up in any order, so that threads do not change them.
    let skews = Mutex::new(vec![BTreeMap::new(); pairs.len()]);
    let (runs, _) = dataset
        .scan(&columns, |rows| {
            let mut own = vec![BTreeMap::new(); pairs.len()];
            for ((a, b), counts) in pairs.iter().zip(&mut own) {
                count_skew(&rows, *a, *b, counts);
            }
            let mut all = skews.lock().unwrap_or_else(PoisonError::into_inner);
            for (all, own) in all.iter_mut().zip(own) {
                own.into_iter().for_each(|(step, n): (u32, u64)| *all.entry(step).or_default() += n);
            }
            drop(all);
            (0..width).map(|stream| arrivals(&rows, stream)).collect::<Vec<_>>()
        })
        .ok()?;
    let mut streams = vec![Arrivals::default(); width];
    for run in runs {
        for (total, own) in streams.iter_mut().zip(run) {
            total.n_new += own.n_new;
            total.span_ns += own.span_ns;
            total.longest_ns = total.longest_ns.max(own.longest_ns);
        }
    }
    let counts = skews.into_inner().unwrap_or_else(PoisonError::into_inner);
    Some(Timing { streams, skews: pairs.into_iter().zip(counts).map(|((a, b), c)| (a, b, c)).collect() })
}

/// Returns the streams that carry pictures, by what is declared or else by name.
fn camera_streams(material: &Material<'_>) -> Vec<usize> {
    let declared = material.dataset.schema.as_ref().map_or(&[][..], |schema| &schema.streams);
    let roles: BTreeMap<&str, Role> =
        declared.iter().filter_map(|s| s.role.map(|role| (s.name.as_str(), role))).collect();
    let is_camera = |name: &str| match roles.get(name) {
        Some(role) => *role == Role::Image,
        None => ["cam", "image", "rgb", "video"].iter().any(|word| name.to_ascii_lowercase().contains(word)),
    };
    let ages = material.stats.columns.iter().find(|c| c.name == "gawm.age_ms");
    let names = ages.map_or(&[][..], |c| &c.dims).iter().enumerate();
    names.filter(|(_, dim)| is_camera(&dim.name)).map(|(i, _)| i).collect()
}

/// Follows the samples of one stream through a run.
fn arrivals(rows: &EpisodeRows, stream: usize) -> Arrivals {
    let mut found = Arrivals::default();
    let times = rows.ints(TIME_NS).unwrap_or_default();
    let ages = rows.column("gawm.age_ms").and_then(|c| c.dims().get(stream));
    let Some(origin) = times.first() else { return found };
    let mut last: Option<f64> = None;
    for (time, age) in times.iter().zip(ages.into_iter().flatten()).filter(|(_, age)| age.is_finite()) {
        let sample = time.saturating_sub(*origin) as f64 - age * 1e6;
        let Some(before) = last else {
            last = Some(sample);
            continue;
        };
        let step = sample - before;
        if step > SAME_SAMPLE_NS {
            found.n_new += 1;
            found.span_ns += step;
            found.longest_ns = found.longest_ns.max(step);
            last = Some(sample);
        }
    }
    found
}

fn count_skew(rows: &EpisodeRows, a: usize, b: usize, counts: &mut BTreeMap<u32, u64>) {
    let Some(ages) = rows.column("gawm.age_ms").map(|c| c.dims()) else { return };
    let (Some(a), Some(b)) = (ages.get(a), ages.get(b)) else { return };
    for apart in a.iter().zip(b).map(|(a, b)| (a - b).abs()).filter(|apart| apart.is_finite()) {
        *counts.entry((apart / SKEW_STEP_MS).round().min(MAX_SKEW_STEPS) as u32).or_default() += 1;
    }
}

/// Returns a quantile of counted steps in milliseconds.
fn skew_ms(counts: &BTreeMap<u32, u64>, q: f64) -> f64 {
    let wanted = (q * counts.values().sum::<u64>() as f64).ceil().max(1.0) as u64;
    let mut seen = 0;
    let step = counts.iter().find(|(_, n)| {
        seen += **n;
        seen >= wanted
    });
    step.map_or(0.0, |(step, _)| f64::from(*step) * SKEW_STEP_MS)
}

/// Writes the clock of the rows, the streams, and the lag from action to motion.
pub(super) fn streams(material: &Material<'_>, timing: Option<&Timing>, page: &mut String) {
    page.push_str("<section id=\"streams\"><h2>Clock and streams</h2>");
    clock(material, page);
    match timing {
        Some(timing) => table(material, timing, page),
        None => page.push_str("<p class=\"soft\">The dataset does not record the ages of samples.</p>"),
    }
    match material.examination.action_lag {
        Some(lag) => write!(
            page,
            "<p>The motion from row t to t+1 is explained best by the action of row t{}: it explains {:.0} % of what the state's own momentum does not.</p>",
            match lag.rows { 0 => String::new(), n if n > 0 => format!("-{n}"), n => format!("+{}", -n) },
            100.0 * lag.explained
        ),
        None => write!(page, "<p class=\"soft\">How far the motion lags behind the actions is not known: no dim of the action moves one of the state.</p>"),
    }
    .ok();
    page.push_str("</section>\n");
}

fn clock(material: &Material<'_>, page: &mut String) {
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
    write!(
        page,
        "<p>Rows come at {:.3} Hz (median over episodes; lowest {:.3}, highest {:.3}). The longest step between rows is {:.2} periods, jitter {:.1} % of a period (95th percentile, worst episode).</p>",
        at(&rate, 0.5), at(&rate, 0.0), at(&rate, 1.0), at(&gap, 1.0), 100.0 * at(&jitter, 1.0)
    )
    .ok();
}

fn table(material: &Material<'_>, timing: &Timing, page: &mut String) {
    let column = |name: &str| material.stats.columns.iter().find(|c| c.name == name);
    let Some(ages) = column("gawm.age_ms") else { return };
    let arrivals = column("gawm.arrival_age_ms");
    page.push_str("<div class=\"scroll\"><table><thead><tr><th>stream</th><th>rate, Hz</th><th>longest gap, ms</th><th>age p50, ms</th><th>p90</th><th>p99</th><th>max</th><th>stamp to log p50, ms</th></tr></thead><tbody>");
    for (i, (dim, stream)) in ages.dims.iter().zip(&timing.streams).enumerate().take(SHOWN_STREAMS) {
        let s = dim.values.summary();
        let offset = arrivals.and_then(|a| a.dims.get(i)).map_or(0.0, |a| s.q50 - a.values.summary().q50);
        let (rate, gap) = match stream.n_new {
            0 => ("".to_owned(), "".to_owned()),
            n => {
                (format!("{:.1}", n as f64 * 1e9 / stream.span_ns), format!("{:.1}", stream.longest_ns / 1e6))
            }
        };
        write!(page, "<tr><td>{}</td><td>{rate}</td><td>{gap}</td><td>{:.1}</td><td>{:.1}</td><td>{:.1}</td><td>{:.1}</td><td>{offset:.1}</td></tr>", escape(&dim.name), s.q50, s.q90, s.q99, s.max).ok();
    }
    page.push_str("</tbody></table></div>");
    if ages.dims.len() > SHOWN_STREAMS {
        write!(page, "<p class=\"soft\">and {} more streams</p>", ages.dims.len() - SHOWN_STREAMS).ok();
    }
    page.push_str("<p class=\"soft\">Rate and gap are those of the samples that rows show: a stream faster than the rows has their rate. The age of a sample is counted at its row.</p>");
}

/// Says how far apart the samples of each two cameras are within a row.
pub(super) fn skew(material: &Material<'_>, timing: &Timing, page: &mut String) {
    let Some(ages) = material.stats.columns.iter().find(|c| c.name == "gawm.age_ms") else { return };
    let name = |i: usize| ages.dims.get(i).map_or("", |d| &d.name);
    let seen: Vec<_> = timing.skews.iter().filter(|(_, _, counts)| !counts.is_empty()).collect();
    if seen.is_empty() {
        return;
    }
    page.push_str("<p>Time between the samples of two cameras in a row:</p><div class=\"scroll\"><table><thead><tr><th>cameras</th><th>p50, ms</th><th>p95</th><th>max</th></tr></thead><tbody>");
    for (a, b, counts) in seen {
        let [p50, p95, max] = [0.5, 0.95, 1.0].map(|q| skew_ms(counts, q));
        let (a, b) = (escape(name(*a)), escape(name(*b)));
        write!(page, "<tr><td>{a} and {b}</td><td>{p50:.1}</td><td>{p95:.1}</td><td>{max:.1}</td></tr>").ok();
    }
    page.push_str("</tbody></table></div>");
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn quantiles_of_counted_steps() {
        let counts = BTreeMap::from([(10, 50), (200, 45), (3000, 5)]);
        assert_eq!([0.5, 0.95, 1.0].map(|q| skew_ms(&counts, q)), [1.0, 20.0, 300.0]);
        assert_eq!(skew_ms(&BTreeMap::new(), 0.5), 0.0);
    }
}
