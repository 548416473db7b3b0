//! Small charts as inline SVG.

use std::fmt::Write;

/// Width of a chart in its own units.
const WIDTH: f64 = 280.0;
/// Height of a chart in its own units.
const HEIGHT: f64 = 46.0;
/// Most bars of a histogram.
const BARS: usize = 64;

/// Draws a histogram.
pub(super) fn histogram(counts: &[u64], title: &str) -> String {
    let counts = rebinned(counts);
    let most = counts.iter().copied().max().unwrap_or(0).max(1) as f64;
    let width = WIDTH / counts.len().max(1) as f64;
    let mut out = open(title);
    for (i, count) in counts.iter().enumerate().filter(|(_, c)| **c > 0) {
        // A count that is not zero is seen.
        let height = (HEIGHT * *count as f64 / most).max(1.0);
        let (x, y) = (i as f64 * width, HEIGHT - height);
        write!(
            out,
            "<rect class=\"bar\" x=\"{x:.1}\" y=\"{y:.1}\" width=\"{:.1}\" height=\"{height:.1}\"/>",
            (width - 0.5).max(0.5)
        )
        .ok();
    }
    out + "</svg>"
}

/// Joins neighbouring bins until there are few enough, leaving empty ends out.
fn rebinned(counts: &[u64]) -> Vec<u64> {
    let first = counts.iter().position(|c| *c > 0).unwrap_or(0);
    let last = counts.iter().rposition(|c| *c > 0).map_or(0, |i| i + 1);
    let used = counts.get(first..last).unwrap_or_default();
    used.chunks(used.len().div_ceil(BARS).max(1)).map(|c| c.iter().sum()).collect()
}

/// Draws a trace; values that are not finite leave a gap. `mark` shades a share of the width.
pub(super) fn trace(values: &[f64], title: &str, mark: Option<(f64, f64)>) -> String {
    let finite = values.iter().copied().filter(|v| v.is_finite());
    let (low, high) = finite.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), v| (a.min(v), b.max(v)));
    let mut out = open(title);
    if let Some((from, to)) = mark {
        write!(
            out,
            "<rect class=\"mark\" x=\"{:.1}\" y=\"0\" width=\"{:.1}\" height=\"{HEIGHT}\"/>",
            from * WIDTH,
            ((to - from) * WIDTH).max(2.0)
        )
        .ok();
    }
    let range = if high > low { high - low } else { 1.0 };
    let step = WIDTH / (values.len().max(2) - 1) as f64;
    let mut path = String::new();
    let mut is_drawing = false;
    for (i, value) in values.iter().enumerate() {
        if !value.is_finite() {
            is_drawing = false;
            continue;
        }
        let (x, y) = (i as f64 * step, HEIGHT - 2.0 - (HEIGHT - 4.0) * (value - low) / range);
        write!(path, "{}{x:.1} {y:.1}", if is_drawing { "L" } else { "M" }).ok();
        is_drawing = true;
    }
    write!(out, "<path class=\"trace\" d=\"{path}\"/></svg>").ok();
    out
}

fn open(title: &str) -> String {
    format!(
        "<svg viewBox=\"0 0 {WIDTH} {HEIGHT}\" preserveAspectRatio=\"none\" role=\"img\" aria-label=\"{}\">",
        super::escape(title)
    )
}
