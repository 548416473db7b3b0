//! Pages in a real browser: nothing is loaded, nothing is reported on the console, the table sorts.

#![expect(clippy::unwrap_used, reason = "a test stops where its set-up fails")]

use std::fs;
use std::path::Path;
use std::process::Command;

use gawm_dataset::preview::{PreviewOptions, preview_html};
use gawm_dataset::read::{Dataset, ReadLimits};
use gawm_dataset::report::{ReportOptions, render_report};
use gawm_dataset::{
    DatasetSpec, DatasetWriter, EpisodeInfo, ImageColumn, RecordingInfo, Rows, Trajectory, VectorColumn,
    WriteMode,
};

const SCHEMA: &str = r#"
rate_hz = 10.0
streams = [{ name = "joints", source = "/j" }]
[[features]]
name = "observation.state"
role = "state"
data = { type = "vector", dtype = "float32", parts = [{ kind = "linear", dims = [{ name = "</script><b>lift", unit = "m", source = "/j:position[0]" }] }] }
[[features]]
name = "observation.images.front"
role = "image"
data = { type = "image", height = 4, width = 6, channels = 3 }
"#;

/// Episodes of 30, 12 and 21 rows, with names that would be markup if they could.
fn write_dataset(dir: &Path) {
    let schema: gawm_schema::Schema = toml::from_str(SCHEMA).unwrap();
    let spec = DatasetSpec::new(schema.clone(), "", "test 1");
    let mut writer = DatasetWriter::create(dir, spec, WriteMode::New).unwrap();
    let content_hash = gawm_schema::ContentHash::of(b"log");
    writer
        .begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: Default::default() })
        .unwrap();
    for n in [30usize, 12, 21] {
        let task = "<img src=x onerror=console.error(1)>".to_owned();
        writer.begin_episode(EpisodeInfo { task, ..EpisodeInfo::default() }).unwrap();
        let frame = |t: usize| {
            let pixels = gawm_image::Pixels::Rgb8((0..72).map(|i| (i * 3 + t * n) as u8).collect());
            let image = gawm_image::Image::try_new(6, 4, pixels).unwrap();
            gawm_image::encode_png(&image).unwrap().into()
        };
        let values = (0..n).map(|t| (t as f64 * 0.3).sin()).collect();
        let rows = Rows {
            time_ns: (0..n as i64).map(|t| t * 100_000_000).collect(),
            vectors: vec![VectorColumn { values, valid: vec![true; n] }],
            images: vec![ImageColumn { frames: (0..n).map(frame).collect(), valid: vec![true; n] }],
            ages: gawm_dataset::AgeColumns { age_ms: vec![3.0; n], arrival_age_ms: vec![4.0; n] },
        };
        writer.write(Trajectory::try_new(&schema, rows).unwrap()).unwrap();
        writer.end_episode().unwrap();
    }
    writer.end_recording().unwrap();
    writer.finish().unwrap();
}

/// Tells the page's state in its title after two clicks on the column of rows.
const PROBE: &str = r#"<script>
window.addEventListener("load", () => {
  const rows = () => [...document.querySelectorAll("table.sortable tbody tr")].map((r) => r.children[1].textContent).join(" ");
  const button = document.querySelectorAll("table.sortable th button")[1];
  const seen = [];
  if (button) { button.click(); seen.push(rows()); button.click(); seen.push(rows()); }
  const loaded = performance.getEntriesByType("resource").filter((r) => !r.name.startsWith("data:")).length;
  const wide = document.documentElement.scrollWidth > window.innerWidth;
  const broken = [...document.images].filter((i) => !i.naturalWidth).length;
  document.title = `sorted ${seen.join(" / ")}; loaded ${loaded}; wide ${wide}; broken ${broken}; images ${document.images.length}`;
});
</script></body>"#;

/// Opens a page and returns its title; fails if anything was said on the console. `None` without a browser.
fn title(folder: &Path, page: &str, size: &str) -> Option<String> {
    let path = folder.join("page.html");
    fs::write(&path, page.replace("</body>", PROBE)).unwrap();
    let profile = tempfile::tempdir().unwrap();
    let programs = ["chromium", "chromium-browser", "google-chrome"];
    let output = programs.into_iter().find_map(|program| {
        let flags = [
            "--headless",
            "--no-sandbox",
            "--disable-gpu",
            "--no-first-run",
            "--disable-background-networking",
            "--disable-component-update",
            "--disable-sync",
            "--enable-logging=stderr",
            "--virtual-time-budget=5000",
            "--dump-dom",
        ];
        let mut command = Command::new(program);
        command.args(flags).arg(format!("--window-size={size}"));
        command.arg(format!("--user-data-dir={}", profile.path().display()));
        command.arg(format!("file://{}", path.display())).output().ok()
    });
    let Some(output) = output else {
        println!("skipped: no chromium");
        return None;
    };
    let (dom, log) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    let said: Vec<&str> = log.lines().filter(|line| line.contains("CONSOLE")).collect();
    assert!(said.is_empty(), "{said:#?}");
    let title = dom.split_once("<title>").and_then(|(_, rest)| rest.split_once("</title>"));
    Some(title.expect("the page has a title").0.to_owned())
}

#[test]
fn the_report_sorts_and_loads_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("dataset");
    write_dataset(&dir);
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let page = render_report(&dataset, ReportOptions::default()).unwrap();
    for size in ["1200,900", "500,900"] {
        let Some(title) = title(folder.path(), &page, size) else { return };
        assert!(
            title.starts_with("sorted 30 21 12 / 12 21 30; loaded 0; wide false; broken 0; images "),
            "{title}"
        );
    }
}

#[test]
fn the_report_tells_streams_and_encodings_and_keeps_secrets() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("pc7-dataset");
    write_dataset(&dir);
    let episodes = dir.join("meta/info.json");
    let info = fs::read_to_string(&episodes).unwrap();
    fs::write(&episodes, info.replace("\"total_frames\": 63", "\"total_frames\": 64")).unwrap();
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let page = render_report(&dataset, ReportOptions::default()).unwrap();
    for part in [
        "<p>1 error,",
        "STRUCT-013",
        // Rate, longest gap and ages of a stream whose samples are as old in each row.
        "<tr><td>joints</td><td>10.0</td><td>100.0</td><td>3.0</td>",
        "<small>linear, kept as it is; mean",
        "<summary>gawm.state (encoded)</summary>",
        "<a href=\"#episodes\">Episodes</a>",
        "<h1>pc7-dataset</h1>",
    ] {
        assert!(page.contains(part), "{part}");
    }
    let shared = render_report(&dataset, ReportOptions { is_shared: true }).unwrap();
    assert!(!shared.contains("pc7") && !shared.contains(folder.path().to_str().unwrap()));
}

#[test]
fn the_preview_fits_and_loads_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("dataset");
    write_dataset(&dir);
    let dataset = Dataset::open(&dir, ReadLimits::default()).unwrap();
    let page = preview_html(&dataset, &PreviewOptions::default()).unwrap();
    let Some(title) = title(folder.path(), &page, "500,900") else { return };
    assert_eq!(title, "sorted ; loaded 0; wide false; broken 0; images 24");
}
