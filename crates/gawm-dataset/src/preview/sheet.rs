//! A contact sheet as a picture.

use gawm_image::{Image, ImageError, Pixels};

use super::canvas::{Canvas, LETTER};
use super::{COLOURS, Clip, FRAME_WIDTH, Traces};

const MARGIN: usize = 12;
const GAP: usize = 4;
const LINE: usize = 14;
const PLOT_HEIGHT: usize = 110;
/// Width of a sheet without pictures.
const MIN_WIDTH: usize = 900;

const PAPER: [u8; 3] = [255, 255, 255];
const INK: [u8; 3] = [30, 30, 30];
const SOFT: [u8; 3] = [110, 110, 110];
const PALE: [u8; 3] = [228, 228, 228];
const PANEL: [u8; 3] = [246, 246, 246];

/// Draws all clips one below the other.
pub(super) fn draw(name: &str, clips: &[Clip]) -> Result<Image, ImageError> {
    let n_frames = clips.iter().flat_map(|c| &c.cameras).map(|c| c.frames.len()).max().unwrap_or(0);
    let inner = (n_frames * (FRAME_WIDTH + GAP)).max(MIN_WIDTH);
    let height = 2 * MARGIN + 2 * LINE + clips.iter().map(|clip| clip_height(clip, inner)).sum::<usize>();
    let mut canvas = Canvas::new(inner + 2 * MARGIN, height, PAPER);
    canvas.text((MARGIN, MARGIN), inner, 1, &format!("{name}: {} episodes", clips.len()), SOFT);
    let mut y = MARGIN + 2 * LINE;
    for clip in clips {
        draw_clip(&mut canvas, clip, y, inner);
        y += clip_height(clip, inner);
    }
    let side = |n: usize| u32::try_from(n).unwrap_or(u32::MAX);
    Image::try_new(side(canvas.width), side(canvas.height), Pixels::Rgb8(canvas.rgb))
}

fn strip_height(strip: &super::CameraStrip) -> usize {
    let pictures = strip.frames.iter().filter_map(|(_, frame)| frame.as_ref().ok());
    pictures.map(|picture| picture.height).max().unwrap_or(3 * LINE)
}

fn clip_height(clip: &Clip, inner: usize) -> usize {
    let strips: usize = clip.cameras.iter().map(|strip| strip_height(strip) + 2 * LINE + GAP).sum();
    let plots: usize =
        clip.traces.iter().map(|t| PLOT_HEIGHT + LINE * (1 + legend(t, inner).len()) + 2 * GAP).sum();
    2 * LINE + strips + plots + LINE
}

/// Returns the lines of a legend: position, dim and text.
fn legend(traces: &Traces, inner: usize) -> Vec<Vec<(usize, usize, String)>> {
    let mut lines: Vec<Vec<(usize, usize, String)>> = vec![Vec::new()];
    let mut x = 0;
    for (i, dim) in traces.dims.iter().enumerate() {
        let text = dim.legend();
        let width = (text.chars().count() + 3) * LETTER;
        if x + width > inner && x > 0 {
            lines.push(Vec::new());
            x = 0;
        }
        if let Some(line) = lines.last_mut() {
            line.push((x, i, text));
        }
        x += width;
    }
    lines
}

fn draw_clip(canvas: &mut Canvas, clip: &Clip, top: usize, inner: usize) {
    canvas.fill(MARGIN, top, inner, 2, INK);
    let mut y = top + 8;
    canvas.text((MARGIN, y), inner, 1, &clip.title, INK);
    y += 2 * LINE - 8;
    for strip in &clip.cameras {
        canvas.text((MARGIN, y), inner, 1, &strip.name, SOFT);
        y += LINE;
        let height = strip_height(strip);
        for (k, (row, frame)) in strip.frames.iter().enumerate() {
            let x = MARGIN + k * (FRAME_WIDTH + GAP);
            match frame {
                Ok(picture) => canvas.picture(x, y, picture),
                Err(reason) => {
                    canvas.fill(x, y, FRAME_WIDTH, height, PALE);
                    canvas.text((x + GAP, y + height / 2 - 4), FRAME_WIDTH - 2 * GAP, 1, reason, SOFT);
                }
            }
            canvas.text((x, y + height + 3), FRAME_WIDTH, 1, &format!("row {row}"), SOFT);
        }
        y += height + LINE + GAP;
    }
    for traces in &clip.traces {
        y = draw_traces(canvas, traces, y, inner);
    }
}

fn draw_traces(canvas: &mut Canvas, traces: &Traces, top: usize, inner: usize) -> usize {
    let hidden =
        if traces.n_hidden > 0 { format!(" (and {} more dims)", traces.n_hidden) } else { String::new() };
    canvas.text((MARGIN, top), inner, 1, &format!("{}{hidden}", traces.name), SOFT);
    let y = top + LINE;
    canvas.fill(MARGIN, y, inner, PLOT_HEIGHT, PANEL);
    for mark in &traces.marks {
        canvas.fill(MARGIN + (mark * (inner - 1) as f64) as usize, y, 1, PLOT_HEIGHT, PALE);
    }
    for (dim, colour) in traces.dims.iter().zip(COLOURS) {
        let step = (inner - 1) as f64 / (dim.values.len().max(2) - 1) as f64;
        let place = |(i, value): (usize, f64)| {
            let share = dim.share(value);
            (MARGIN as f64 + i as f64 * step, (y + 4) as f64 + (1.0 - share) * (PLOT_HEIGHT - 9) as f64)
        };
        for (i, pair) in dim.values.windows(2).enumerate() {
            if pair.iter().all(|v| v.is_finite()) {
                canvas.line(place((i, pair[0])), place((i + 1, pair[1])), colour);
            }
        }
    }
    let mut y = y + PLOT_HEIGHT + GAP;
    for line in legend(traces, inner) {
        for (x, i, text) in line {
            canvas.fill(MARGIN + x, y, LETTER, LETTER, COLOURS[i]);
            canvas.text((MARGIN + x + LETTER + 4, y), inner - x, 1, &text, INK);
        }
        y += LINE;
    }
    y + GAP
}
