//! One self-contained HTML page about a dataset: alerts first, then streams, dims, episodes, cameras and the worst clips.
//!
//! The page loads nothing from anywhere, follows the reader's choice of light or dark, fits a phone, and stays under
//! 5 MB: what there is more of than fits is counted, not shown.

mod chart;
mod clips;
mod sections;
mod streams;

use std::fmt::Write;

use crate::{
    read::{Dataset, ScanError},
    stats::{DatasetStats, dataset_stats},
    validate::{Examination, ValidateOptions, examine},
};

/// What the page shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ReportOptions {
    /// Leave out paths, host names, operators and sessions.
    pub is_shared: bool,
}

/// Everything that the sections draw from.
struct Material<'a> {
    dataset: &'a Dataset,
    examination: Examination,
    stats: DatasetStats,
    options: ReportOptions,
}

/// Forbids the page to load anything, whatever a dataset managed to put into it.
pub(crate) const POLICY: &str = "<meta http-equiv=\"Content-Security-Policy\" content=\"default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:\">";
const STYLE: &str = include_str!("report/style.css");
/// Sections by their ids, in order.
const SECTIONS: [(&str, &str); 6] = [
    ("alerts", "Alerts"),
    ("clips", "Worst clips"),
    ("streams", "Streams"),
    ("dims", "Dims"),
    ("episodes", "Episodes"),
    ("cameras", "Cameras"),
];
/// Characters of a text that are shown: a name of megabytes must not fill the page.
const SHOWN_CHARS: usize = 400;
const SCRIPT: &str = include_str!("report/sort.js");

/// Renders the page.
///
/// # Errors
/// An episode is too long to be held at once.
pub fn render_report(dataset: &Dataset, options: ReportOptions) -> Result<String, ScanError> {
    let material = Material {
        dataset,
        examination: examine(dataset, &ValidateOptions::default())?,
        stats: dataset_stats(dataset)?,
        options,
    };
    let title = if options.is_shared { "dataset".to_owned() } else { escape(&dataset.name()) };
    let mut page = String::with_capacity(1 << 20);
    // Writing to a String cannot fail.
    write!(
        page,
        "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width, initial-scale=1\">\
         {POLICY}<meta name=\"color-scheme\" content=\"light dark\"><title>{title}: gawm report</title>\n<style>{STYLE}</style></head>\n<body>\n<header><h1>{title}</h1>"
    )
    .ok();
    let timing = streams::measure(&material);
    let mut body = String::with_capacity(1 << 20);
    sections::alerts(&material, &mut body);
    clips::worst_clips(&material, &mut body);
    streams::streams(&material, timing.as_ref(), &mut body);
    sections::dims(&material, &mut body);
    sections::episodes(&material, &mut body);
    sections::cameras(&material, timing.as_ref(), &mut body);
    sections::overview(&material, &mut page);
    page.push_str("<nav>");
    for (id, name) in SECTIONS.iter().filter(|(id, _)| body.contains(&format!("<section id=\"{id}\">"))) {
        write!(page, "<a href=\"#{id}\">{name}</a> ").ok();
    }
    page.push_str("</nav></header>\n<main>\n");
    page.push_str(&body);
    write!(page, "</main>\n<script>{SCRIPT}</script>\n</body></html>\n").ok();
    Ok(page)
}

/// Makes text safe inside HTML and its attributes, and cuts one that is very long.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len().min(4 * SHOWN_CHARS));
    for (i, c) in text.chars().enumerate() {
        if i == SHOWN_CHARS {
            out.push_str("...");
            break;
        }
        match c {
            '&' => out.push_str("&amp;"),
            '<' => out.push_str("&lt;"),
            '>' => out.push_str("&gt;"),
            '"' => out.push_str("&quot;"),
            '\'' => out.push_str("&#39;"),
            c => out.push(c),
        }
    }
    out
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn hostile_names_do_not_become_markup() {
        assert_eq!(escape("<script>\"a\"&'b'"), "&lt;script&gt;&quot;a&quot;&amp;&#39;b&#39;");
        assert_eq!(escape(&"<".repeat(1_000_000)).len(), 4 * SHOWN_CHARS + 3);
    }
}
