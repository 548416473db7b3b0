//! One self-contained HTML page about a dataset: alerts first, then streams, dims, episodes, cameras and the worst clips.
//!
//! The page loads nothing from anywhere, follows the reader's choice of light or dark, fits a phone, and stays under
//! 5 MB: what there is more of than fits is counted, not shown.

mod chart;
mod sections;

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
    sections::overview(&material, &mut page);
    page.push_str("</header>\n<main>\n");
    sections::alerts(&material, &mut page);
    sections::worst_clips(&material, &mut page);
    sections::streams(&material, &mut page);
    sections::dims(&material, &mut page);
    sections::episodes(&material, &mut page);
    sections::cameras(&material, &mut page);
    write!(page, "</main>\n<script>{SCRIPT}</script>\n</body></html>\n").ok();
    Ok(page)
}

/// Makes text safe inside HTML and its attributes.
pub(crate) fn escape(text: &str) -> String {
    let mut out = String::with_capacity(text.len());
    for c in text.chars() {
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
    }
}
