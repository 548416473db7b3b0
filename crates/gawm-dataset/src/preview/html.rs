//! A contact sheet as a page that loads nothing.

use std::fmt::Write;

use base64::Engine;
use gawm_image::{Thumbnail, encode_jpeg};

use super::{COLOURS, Clip, Traces};
use crate::report::{POLICY, escape};

const STYLE: &str = include_str!("../report/style.css");
const WIDTH: f64 = 1000.0;
const HEIGHT: f64 = 120.0;

/// Renders the page.
pub(super) fn page(name: &str, clips: &[Clip]) -> String {
    let name = escape(name);
    // Writing to a String cannot fail.
    let mut out = format!(
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         {POLICY}<meta name=\"color-scheme\" content=\"light dark\"><title>{name}: gawm preview</title>\n<style>{STYLE}</style></head>\n<body>\n\
         <header><h1>{name}</h1></header>\n<main>\n"
    );
    for clip in clips {
        write!(out, "<section id=\"episode-{}\"><h2>{}</h2>", clip.episode, escape(&clip.title)).ok();
        for strip in &clip.cameras {
            if strip
                .frames
                .iter()
                .all(|(_, frame)| frame.as_ref().is_err_and(|reason| reason == super::IN_VIDEO))
            {
                write!(out, "<p class=\"soft\">{}: in video files, not shown</p>", escape(&strip.name)).ok();
                continue;
            }
            write!(out, "<h3>{}</h3><div class=\"sheet\">", escape(&strip.name)).ok();
            for (row, frame) in &strip.frames {
                let caption = format!("row {row}");
                match frame.as_ref().map(embedded) {
                    Ok(Some(source)) => write!(out, "<figure><img alt=\"{caption}\" src=\"{source}\"><figcaption>{caption}</figcaption></figure>"),
                    Ok(None) => write!(out, "<figure><figcaption>{caption}: no picture</figcaption></figure>"),
                    Err(reason) => write!(out, "<figure><figcaption>{caption}: {}</figcaption></figure>", escape(reason)),
                }
                .ok();
            }
            out.push_str("</div>");
        }
        clip.traces.iter().for_each(|traces| plot(traces, &mut out));
        out.push_str("</section>\n");
    }
    out + "</main>\n</body></html>\n"
}

fn embedded(picture: &Thumbnail) -> Option<String> {
    let jpeg = encode_jpeg(&picture.to_image().ok()?, 80).ok()?;
    Some(format!("data:image/jpeg;base64,{}", base64::engine::general_purpose::STANDARD.encode(jpeg)))
}

fn plot(traces: &Traces, out: &mut String) {
    let name = escape(&traces.name);
    write!(
        out,
        "<h3>{name}</h3><svg class=\"plot\" viewBox=\"0 0 {WIDTH} {HEIGHT}\" preserveAspectRatio=\"none\" role=\"img\" aria-label=\"{name}\">"
    )
    .ok();
    for mark in &traces.marks {
        let x = mark * WIDTH;
        write!(out, "<line class=\"grid\" x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"0\" y2=\"{HEIGHT}\"/>").ok();
    }
    for (dim, [r, g, b]) in traces.dims.iter().zip(COLOURS) {
        let step = WIDTH / (dim.values.len().max(2) - 1) as f64;
        let mut path = String::new();
        let mut is_drawing = false;
        for (i, value) in dim.values.iter().enumerate() {
            if value.is_finite() {
                let y = 3.0 + (1.0 - dim.share(*value)) * (HEIGHT - 6.0);
                let verb = if is_drawing { "L" } else { "M" };
                write!(path, "{verb}{:.1} {y:.1}", i as f64 * step).ok();
            }
            is_drawing = value.is_finite();
        }
        write!(
            out,
            "<path class=\"line\" stroke=\"rgb({r},{g},{b})\" d=\"{path}\"><title>{}</title></path>",
            escape(&dim.name)
        )
        .ok();
    }
    out.push_str("</svg><p class=\"legend\">");
    for (dim, [r, g, b]) in traces.dims.iter().zip(COLOURS) {
        write!(out, "<span><i style=\"background:rgb({r},{g},{b})\"></i>{}</span> ", escape(&dim.legend()))
            .ok();
    }
    if traces.n_hidden > 0 {
        write!(out, "<span>and {} more dims</span>", traces.n_hidden).ok();
    }
    out.push_str("</p>");
}
