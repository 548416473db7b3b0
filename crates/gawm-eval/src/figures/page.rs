//! One HTML file that holds everything: text, tables, figures, pictures.

use base64::Engine;
use base64::engine::general_purpose::STANDARD;

const STYLE: &str = "
:root{color-scheme:light dark;--fg:#1f2328;--bg:#ffffff;--muted:#656d76;--line:#d0d7de;--soft:#f6f8fa}
@media(prefers-color-scheme:dark){:root{--fg:#e6edf3;--bg:#0d1117;--muted:#8b949e;--line:#30363d;--soft:#161b22}}
body{font:15px/1.5 system-ui,sans-serif;color:var(--fg);background:var(--bg);max-width:70rem;margin:2rem auto;padding:0 1rem}
h1{font-size:1.5rem}h2{font-size:1.15rem;margin-top:2.2rem;border-bottom:1px solid var(--line)}
p.note{color:var(--muted);max-width:48rem}table{border-collapse:collapse;font-size:.9rem;display:block;overflow-x:auto}
td,th{border:1px solid var(--line);padding:.25rem .6rem;text-align:right}td:first-child,th:first-child{text-align:left}
th{background:var(--soft)}figure{display:inline-block;margin:.4rem .6rem .4rem 0;max-width:100%;overflow-x:auto}
img,svg{max-width:100%;height:auto}code{font-size:.9em}";

/// A page under construction.
#[derive(Debug, Clone)]
pub struct Page {
    title: String,
    body: String,
}

impl Page {
    /// Begins a page.
    pub fn new(title: &str) -> Page {
        Page { title: title.to_owned(), body: format!("<h1>{}</h1>\n", escape(title)) }
    }

    /// Adds a heading.
    pub fn heading(&mut self, text: &str) {
        self.body += &format!("<h2>{}</h2>\n", escape(text));
    }

    /// Adds a paragraph in muted ink.
    pub fn note(&mut self, text: &str) {
        self.body += &format!("<p class=\"note\">{}</p>\n", escape(text));
    }

    /// Adds a table; the first row is its head.
    pub fn table(&mut self, rows: &[Vec<String>]) {
        self.body += "<table>\n";
        for (index, row) in rows.iter().enumerate() {
            let tag = if index == 0 { "th" } else { "td" };
            let cells: String = row.iter().map(|cell| format!("<{tag}>{}</{tag}>", escape(cell))).collect();
            self.body += &format!("<tr>{cells}</tr>\n");
        }
        self.body += "</table>\n";
    }

    /// Adds a figure that is SVG already.
    pub fn figure(&mut self, svg: &str) {
        self.body += &format!("<figure>{svg}</figure>\n");
    }

    /// Adds a picture.
    pub fn png(&mut self, bytes: &[u8], caption: &str) {
        let (data, caption) = (STANDARD.encode(bytes), escape(caption));
        self.body += &format!(
            "<figure><img alt=\"{caption}\" src=\"data:image/png;base64,{data}\"><figcaption>{caption}</figcaption></figure>\n"
        );
    }

    /// Returns the file.
    pub fn finish(&self) -> String {
        let Page { title, body } = self;
        let title = escape(title);
        format!(
            "<!doctype html>\n<html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" content=\"width=device-width\">\n<title>{title}</title>\n<style>{STYLE}</style></head>\n<body>\n{body}</body></html>\n"
        )
    }

    /// Returns what is between the tags of the body, for a page that holds several.
    pub fn body(&self) -> &str {
        &self.body
    }

    /// Adds what another page holds.
    pub fn append(&mut self, other: &Page) {
        self.body += &other.body;
    }
}

/// Escapes text for HTML and SVG.
pub fn escape(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
