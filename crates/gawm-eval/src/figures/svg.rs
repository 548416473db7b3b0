//! A drawing area with axes.

use super::escape;

/// Colours of series, readable on light and dark ground.
pub(super) const COLORS: [&str; 6] = ["#2f81f7", "#e5534b", "#3fa45b", "#b07219", "#a371f7", "#6e7781"];

/// Style of every figure: ground and ink follow the reader's choice of light or dark.
const STYLE: &str = "<style>svg{color-scheme:light dark}text{font:12px system-ui,sans-serif;fill:#1f2328}\
.title{font-weight:600;font-size:13px}.small{font-size:10px}.axis{stroke:#656d76;fill:none}.grid{stroke:#d0d7de;fill:none}\
.bg{fill:#ffffff}.dash{stroke:#656d76;stroke-dasharray:4 3;fill:none}\
@media(prefers-color-scheme:dark){text{fill:#e6edf3}.axis,.dash{stroke:#8b949e}.grid{stroke:#30363d}.bg{fill:#0d1117}}</style>";

/// A figure under construction.
pub(super) struct Canvas {
    pub(super) width: f64,
    pub(super) height: f64,
    body: String,
}

/// A part of a figure with data coordinates.
#[derive(Debug, Clone, Copy)]
pub(super) struct Frame {
    pub(super) left: f64,
    pub(super) top: f64,
    pub(super) width: f64,
    pub(super) height: f64,
    pub(super) x: (f64, f64),
    pub(super) y: (f64, f64),
}

impl Frame {
    /// Place of a data point.
    pub(super) fn at(&self, x: f64, y: f64) -> (f64, f64) {
        let share =
            |value: f64, (low, high): (f64, f64)| if high > low { (value - low) / (high - low) } else { 0.5 };
        (self.left + share(x, self.x) * self.width, self.top + (1.0 - share(y, self.y)) * self.height)
    }
}

impl Canvas {
    pub(super) fn new(width: f64, height: f64, title: &str) -> Canvas {
        let mut canvas = Canvas { width, height, body: String::new() };
        canvas.add(&format!("<rect class=\"bg\" width=\"{width}\" height=\"{height}\"/>"));
        canvas.text(width / 2.0, 18.0, "middle", "title", title);
        canvas
    }

    pub(super) fn add(&mut self, element: &str) {
        self.body.push_str(element);
        self.body.push('\n');
    }

    pub(super) fn text(&mut self, x: f64, y: f64, anchor: &str, class: &str, text: &str) {
        let text = escape(text);
        self.add(&format!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" class=\"{class}\">{text}</text>"
        ));
    }

    pub(super) fn line(&mut self, from: (f64, f64), to: (f64, f64), class: &str) {
        let ((x1, y1), (x2, y2)) = (from, to);
        self.add(&format!(
            "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\" class=\"{class}\"/>"
        ));
    }

    /// A line through points; a gap where a point is not finite.
    pub(super) fn path(&mut self, points: &[(f64, f64)], color: &str) {
        let mut data = String::new();
        let mut is_down = false;
        for (x, y) in points {
            if x.is_finite() && y.is_finite() {
                data.push_str(&format!("{}{x:.1} {y:.1}", if is_down { "L" } else { "M" }));
                is_down = true;
            } else {
                is_down = false;
            }
        }
        self.add(&format!("<path d=\"{data}\" fill=\"none\" stroke=\"{color}\" stroke-width=\"1.8\"/>"));
    }

    /// Axes with ticks at round numbers, grid lines and labels.
    pub(super) fn axes(&mut self, frame: &Frame, x_label: &str, y_label: &str) {
        for tick in ticks(frame.y) {
            let (x, y) = frame.at(frame.x.0, tick);
            self.line((x, y), (x + frame.width, y), "grid");
            self.text(x - 5.0, y + 4.0, "end", "small", &number(tick));
        }
        for tick in ticks(frame.x) {
            let (x, y) = frame.at(tick, frame.y.0);
            self.line((x, y), (x, y + 4.0), "axis");
            self.text(x, y + 15.0, "middle", "small", &number(tick));
        }
        let (left, bottom) = (frame.left, frame.top + frame.height);
        self.line((left, frame.top), (left, bottom), "axis");
        self.line((left, bottom), (left + frame.width, bottom), "axis");
        self.text(left + frame.width / 2.0, bottom + 30.0, "middle", "small", x_label);
        let (x, y) = (left - 38.0, frame.top + frame.height / 2.0);
        let label = escape(y_label);
        self.add(&format!(
            "<text x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"middle\" class=\"small\" transform=\"rotate(-90 {x:.1} {y:.1})\">{label}</text>"
        ));
    }

    pub(super) fn finish(self) -> String {
        let Canvas { width, height, body } = self;
        format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {width} {height}\" width=\"{width}\" height=\"{height}\" role=\"img\">\n{STYLE}\n{body}</svg>\n"
        )
    }
}

/// Returns about five round numbers within a range.
pub(super) fn ticks((low, high): (f64, f64)) -> Vec<f64> {
    let span = high - low;
    if !(span.is_finite() && span > 0.0) {
        return vec![low];
    }
    let raw = span / 5.0;
    let magnitude = 10f64.powf(raw.log10().floor());
    let step = [1.0, 2.0, 5.0, 10.0].into_iter().map(|m| m * magnitude).find(|s| *s >= raw).unwrap_or(raw);
    let first = (low / step).ceil() as i64;
    (first..first + 12).map(|k| k as f64 * step).take_while(|tick| *tick <= high + 1e-9 * span).collect()
}

/// Writes a number as short as it can be read.
pub(super) fn number(value: f64) -> String {
    if value == 0.0 {
        "0".to_owned()
    } else if value.abs() >= 0.001 && value.abs() < 100_000.0 {
        let text = format!("{value:.3}");
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        format!("{value:.0e}")
    }
}

/// Returns the smallest range that holds all finite values, a little wider.
pub(super) fn range(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (low, high) = values
        .filter(|value| value.is_finite())
        .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| (low.min(value), high.max(value)));
    if low > high {
        return (0.0, 1.0);
    }
    let margin = if high > low { 0.04 * (high - low) } else { low.abs().max(1.0) * 0.1 };
    (low - margin, high + margin)
}
