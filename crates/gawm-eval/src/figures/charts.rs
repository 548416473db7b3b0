//! The kinds of figures.

use super::svg::{COLORS, Canvas, Frame, number, range};

/// A named series of points.
#[derive(Debug, Clone, PartialEq)]
pub struct Line {
    /// Name in the legend.
    pub name: String,
    /// Points; a gap where one is not finite.
    pub points: Vec<(f64, f64)>,
}

/// A bar with an interval.
#[derive(Debug, Clone, PartialEq)]
pub struct Bar {
    /// Its label.
    pub label: String,
    /// Its length.
    pub value: f64,
    /// Ends of its interval, if it has one.
    pub interval: Option<(f64, f64)>,
    /// Colour: 0 for what is tested, 1 for floors, 2 for ceilings.
    pub kind: usize,
}

/// Draws lines over common axes; `marks` are dashed horizontal lines. `y` fixes the range.
pub fn lines(
    title: &str,
    labels: (&str, &str),
    series: &[Line],
    marks: &[f64],
    y: Option<(f64, f64)>,
) -> String {
    let mut canvas = Canvas::new(460.0, 300.0, title);
    let points = || series.iter().flat_map(|line| line.points.iter().copied());
    let frame = Frame {
        left: 58.0,
        top: 32.0,
        width: 380.0,
        height: 205.0,
        x: range(points().map(|point| point.0)),
        y: y.unwrap_or_else(|| range(points().map(|point| point.1).chain(marks.iter().copied()))),
    };
    canvas.axes(&frame, labels.0, labels.1);
    for mark in marks {
        canvas.line(frame.at(frame.x.0, *mark), frame.at(frame.x.1, *mark), "dash");
    }
    let mut legend = 62.0;
    for (index, line) in series.iter().enumerate() {
        let color = COLORS[index % COLORS.len()];
        let places: Vec<(f64, f64)> = line.points.iter().map(|(x, y)| frame.at(*x, *y)).collect();
        canvas.path(&places, color);
        if series.len() > 1 {
            canvas.add(&format!(
                "<rect x=\"{legend:.1}\" y=\"280\" width=\"12\" height=\"4\" fill=\"{color}\"/>"
            ));
            canvas.text(legend + 16.0, 286.0, "start", "small", &line.name);
            legend += 30.0 + 6.2 * line.name.chars().count() as f64;
        }
    }
    canvas.finish()
}

/// Draws horizontal bars from 0 to `most` with their intervals.
pub fn bars(title: &str, label: &str, bars: &[Bar], most: f64) -> String {
    let row = 22.0;
    let mut canvas = Canvas::new(520.0, 72.0 + row * bars.len() as f64, title);
    let low = bars.iter().map(|bar| bar.value).fold(0.0, f64::min);
    let height = row * bars.len() as f64;
    let frame =
        Frame { left: 150.0, top: 30.0, width: 300.0, height, x: (low.max(-most), most), y: (0.0, 1.0) };
    for tick in super::svg::ticks(frame.x) {
        let (x, _) = frame.at(tick, 0.0);
        canvas.line((x, 30.0), (x, 30.0 + height), "grid");
        canvas.text(x, 44.0 + height, "middle", "small", &number(tick));
    }
    canvas.text(300.0, 62.0 + height, "middle", "small", label);
    for (index, bar) in bars.iter().enumerate() {
        let y = 30.0 + row * index as f64;
        let place = |value: f64| frame.at(value.clamp(frame.x.0, most), 0.0).0;
        let (from, to) = (place(0.0), place(bar.value));
        let color = COLORS[[0, 5, 2][bar.kind.min(2)]];
        let (left, width) = (from.min(to), (to - from).abs());
        let middle = y + row / 2.0;
        canvas.add(&format!(
            "<rect x=\"{left:.1}\" y=\"{:.1}\" width=\"{width:.1}\" height=\"13\" rx=\"2\" fill=\"{color}\" opacity=\"0.85\"/>",
            y + 4.0
        ));
        if let Some((low, high)) = bar.interval {
            canvas.line((place(low), middle), (place(high), middle), "axis");
            for end in [low, high] {
                canvas.line((place(end), middle - 4.0), (place(end), middle + 4.0), "axis");
            }
        }
        canvas.text(144.0, middle + 4.0, "end", "small", &bar.label);
        canvas.text(456.0, middle + 4.0, "start", "small", &number(bar.value));
    }
    canvas.finish()
}

/// A trajectory to draw.
#[derive(Debug, Clone, PartialEq)]
pub struct Picture {
    /// Its name.
    pub name: String,
    /// Two components per row, [T, 2] row-major.
    pub points: Vec<f64>,
    /// Local straightening; a gap where there is none.
    pub local: Vec<Option<f64>>,
}

/// Draws trajectories side by side: two components coloured by time, and local straightening below with its mean dashed.
///
/// Start is a circle, end a cross.
pub fn pictures(title: &str, pictures: &[Picture]) -> String {
    let cell = 220.0;
    let mut canvas = Canvas::new(20.0 + cell * pictures.len().max(1) as f64, 330.0, title);
    for (index, Picture { name, points, local }) in pictures.iter().enumerate() {
        let left = 40.0 + cell * index as f64;
        let column = |offset: usize| points.iter().copied().skip(offset).step_by(2);
        let frame =
            Frame { left, top: 46.0, width: 170.0, height: 150.0, x: range(column(0)), y: range(column(1)) };
        canvas.text(left + 85.0, 38.0, "middle", "small", name);
        scatter(&mut canvas, &frame, points);
        let below = Frame {
            left,
            top: 220.0,
            width: 170.0,
            height: 70.0,
            x: (0.0, local.len().max(1) as f64),
            y: (-1.0, 1.0),
        };
        canvas.axes(&below, "row", "");
        let places: Vec<(f64, f64)> =
            local.iter().enumerate().map(|(t, s)| below.at(t as f64, s.unwrap_or(f64::NAN))).collect();
        canvas.path(&places, COLORS[0]);
        let found: Vec<f64> = local.iter().flatten().copied().collect();
        if let Some((mean, _)) = crate::statistics::mean_std(&found) {
            canvas.line(below.at(below.x.0, mean), below.at(below.x.1, mean), "dash");
            canvas.text(left + 168.0, 216.0, "end", "small", &format!("mean {mean:.2}"));
        }
    }
    canvas.finish()
}

fn scatter(canvas: &mut Canvas, frame: &Frame, points: &[f64]) {
    let n = points.len() / 2;
    let (left, top, width, height) = (frame.left, frame.top, frame.width, frame.height);
    canvas.add(&format!(
        "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{width:.1}\" height=\"{height:.1}\" class=\"grid\"/>"
    ));
    for (t, pair) in points.chunks_exact(2).enumerate() {
        let (x, y) = frame.at(pair[0], pair[1]);
        let color = time_color(t as f64 / (n.max(2) - 1) as f64);
        canvas.add(&format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"2.2\" fill=\"{color}\"/>"));
    }
    if let ([first, second, ..], Some([x, y])) = (points, points.chunks_exact(2).next_back()) {
        let (cx, cy) = frame.at(*first, *second);
        canvas.add(&format!("<circle cx=\"{cx:.1}\" cy=\"{cy:.1}\" r=\"5\" class=\"axis\"/>"));
        let (x, y) = frame.at(*x, *y);
        canvas.line((x - 4.0, y - 4.0), (x + 4.0, y + 4.0), "axis");
        canvas.line((x - 4.0, y + 4.0), (x + 4.0, y - 4.0), "axis");
    }
}

/// Returns a colour from violet (0) over green to yellow (1), even to the eye.
fn time_color(share: f64) -> String {
    const ANCHORS: [[f64; 3]; 5] = [
        [68.0, 1.0, 84.0],
        [59.0, 82.0, 139.0],
        [33.0, 145.0, 140.0],
        [94.0, 201.0, 98.0],
        [253.0, 231.0, 37.0],
    ];
    let place = share.clamp(0.0, 1.0) * 4.0;
    let index = (place as usize).min(3);
    let blend = place - index as f64;
    let channel = |c: usize| ANCHORS[index][c] * (1.0 - blend) + ANCHORS[index + 1][c] * blend;
    format!("#{:02x}{:02x}{:02x}", channel(0) as u8, channel(1) as u8, channel(2) as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn figures_hold_their_data_and_survive_gaps() {
        let line = |points| Line { name: "a<b".to_owned(), points };
        let gap = line(vec![(0.0, 1.0), (1.0, f64::NAN), (2.0, 3.0)]);
        let svg = lines("t & u", ("x", "y"), &[gap.clone(), gap], &[2.0], None);
        assert!(svg.contains("t &amp; u") && svg.contains("a&lt;b") && !svg.contains("NaN"), "{svg}");
        let bar = Bar { label: "model".to_owned(), value: 0.5, interval: Some((0.4, 0.6)), kind: 0 };
        assert!(bars("rates", "success", &[bar], 1.0).contains("model"));
        assert!(
            !pictures("empty", &[Picture { name: "e".to_owned(), points: Vec::new(), local: vec![None] }])
                .contains("NaN")
        );
        assert!(!lines("none", ("x", "y"), &[], &[], None).contains("NaN"));
    }
}
