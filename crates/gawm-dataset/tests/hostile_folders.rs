//! Datasets that are cut or changed anywhere: every verb gives an answer or an error, and touches nothing else.

#![expect(clippy::unwrap_used, reason = "a test stops where its set-up fails")]

use std::collections::BTreeMap;
use std::fs;
use std::path::{Path, PathBuf};

use gawm_dataset::edit::{Input, InputOptions, filter, merge, trim, write};
use gawm_dataset::preview::{PreviewOptions, preview_html, preview_png};
use gawm_dataset::read::{Dataset, ReadLimits};
use gawm_dataset::report::{ReportOptions, render_report};
use gawm_dataset::stats::{dataset_stats, lerobot_stats};
use gawm_dataset::validate::{ValidateOptions, validate};
use gawm_dataset::{
    DatasetSpec, DatasetWriter, EpisodeInfo, ImageColumn, RecordingInfo, Rows, Trajectory, VectorColumn,
    WriteMode,
};

const SCHEMA: &str = r#"
rate_hz = 10.0
streams = []
[[features]]
name = "observation.state"
role = "state"
data = { type = "vector", dtype = "float32", parts = [
    { kind = "angle", wrap = "pi", dims = [{ name = "elbow", unit = "rad", source = "/j:position[0]" }] },
    { kind = "linear", dims = [{ name = "lift", unit = "m", source = "/j:position[1]" }] },
] }
[[features]]
name = "action"
role = "action"
data = { type = "vector", dtype = "float32", parts = [
    { kind = "linear", dims = [{ name = "elbow", unit = "rad", source = "/c:data[0]" }, { name = "lift", unit = "m", source = "/c:data[1]" }] },
] }
[[features]]
name = "observation.images.front"
role = "image"
data = { type = "image", height = 4, width = 6, channels = 3 }
"#;

/// Writes three short episodes.
fn write_dataset(dir: &Path) {
    let schema: gawm_schema::Schema = toml::from_str(SCHEMA).unwrap();
    let spec = DatasetSpec::new(schema.clone(), "fps = 10\n", "test 1");
    let mut writer = DatasetWriter::create(dir, spec, WriteMode::New).unwrap();
    let content_hash = gawm_schema::ContentHash::of(b"log");
    writer
        .begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: BTreeMap::new() })
        .unwrap();
    for episode in 0..3u8 {
        let info = EpisodeInfo {
            task: format!("task {episode}"),
            session: "s".to_owned(),
            ..EpisodeInfo::default()
        };
        writer.begin_episode(info).unwrap();
        let n = 14 + usize::from(episode);
        let values =
            |k: f64| (0..n).flat_map(|t| [(t as f64 * 0.3 * k).sin(), t as f64 * 0.01 * k]).collect();
        let column = |k: f64| VectorColumn { values: values(k), valid: vec![true; n] };
        let frame = |t: usize| {
            let pixels = (0..4 * 6 * 3).map(|i| (i * 3 + t * 7) as u8 ^ episode).collect();
            let image = gawm_image::Image::try_new(6, 4, gawm_image::Pixels::Rgb8(pixels)).unwrap();
            gawm_image::encode_png(&image).unwrap().into()
        };
        let mut action = column(1.1);
        *action.valid.last_mut().unwrap() = false;
        let rows = Rows {
            time_ns: (0..n as i64).map(|t| t * 100_000_000).collect(),
            vectors: vec![column(1.0), action],
            images: vec![ImageColumn { frames: (0..n).map(frame).collect(), valid: vec![true; n] }],
            ..Rows::default()
        };
        writer.write(Trajectory::try_new(&schema, rows).unwrap()).unwrap();
        writer.end_episode().unwrap();
    }
    writer.end_recording().unwrap();
    writer.finish().unwrap();
}

fn files(dir: &Path) -> Vec<PathBuf> {
    let mut found = Vec::new();
    for entry in fs::read_dir(dir).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() { found.extend(files(&path)) } else { found.push(path) }
    }
    found.sort();
    found
}

fn copy(from: &Path, to: &Path) {
    for path in files(from) {
        let target = to.join(path.strip_prefix(from).unwrap());
        fs::create_dir_all(target.parent().unwrap()).unwrap();
        fs::copy(path, target).unwrap();
    }
}

/// Runs every verb; errors must say something, panics fail the test.
fn run_all(dir: &Path, out: &Path) {
    let say = |error: String| assert!(error.len() > 10, "{error:?}");
    match Dataset::open(dir, ReadLimits::default()) {
        Err(error) => say(error.to_string()),
        Ok(dataset) => {
            validate(&dataset, &ValidateOptions::default())
                .map(|_| ())
                .unwrap_or_else(|e| say(e.to_string()));
            match dataset_stats(&dataset) {
                Ok(stats) => drop(lerobot_stats(&dataset, &stats, &BTreeMap::new())),
                Err(error) => say(error.to_string()),
            }
            render_report(&dataset, ReportOptions::default())
                .map(drop)
                .unwrap_or_else(|e| say(e.to_string()));
            let options = PreviewOptions::default();
            preview_png(&dataset, &options).map(drop).unwrap_or_else(|e| say(e.to_string()));
            preview_html(&dataset, &options).map(drop).unwrap_or_else(|e| say(e.to_string()));
        }
    }
    for skips_damaged in [false, true] {
        let options = InputOptions { skips_damaged, ..InputOptions::default() };
        let input = match Input::open(dir, options) {
            Ok(input) => [input],
            Err(error) => {
                say(error.to_string());
                continue;
            }
        };
        let plans = [filter(&input[0], "length > 2 and mean(action[0]) < 99"), Ok(merge(&input))];
        let trimmed = trim(&input[0], &Default::default()).map(|(plan, _)| plan);
        for (i, plan) in plans.into_iter().chain([trimmed]).enumerate() {
            let out = out.join(format!("{i}"));
            let outcome = plan.and_then(|plan| write(&input, &plan, &out, &|_| {}));
            match outcome {
                // What was written is sound.
                Ok(_) => drop(Dataset::open(&out, ReadLimits::default()).unwrap()),
                Err(error) => say(error.to_string()),
            }
            fs::remove_dir_all(&out).ok();
        }
    }
}

/// A small generator of fixed numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, n: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 % n.max(1) as u64) as usize
    }
}

/// How many times more each file is changed when `GAWM_SWEEP` is set: a long search by hand.
fn n_times() -> usize {
    std::env::var("GAWM_SWEEP").ok().and_then(|text| text.parse().ok()).unwrap_or(1)
}

/// Applies `change` to a file many times and runs everything on the result.
fn sweep(is_gawm: bool, n_changes: usize, change: impl Fn(&mut Vec<u8>, &mut Random)) {
    let folder = tempfile::tempdir().unwrap();
    let (sound, work, out) =
        (folder.path().join("sound"), folder.path().join("work"), folder.path().join("out"));
    write_dataset(&sound);
    if !is_gawm {
        fs::remove_file(sound.join("meta/gawm.json")).unwrap();
    }
    copy(&sound, &work);
    fs::create_dir(&out).unwrap();
    run_all(&work, &out);
    let mut random = Random(0x9e37_79b9_7f4a_7c15);
    for path in files(&sound) {
        let target = work.join(path.strip_prefix(&sound).unwrap());
        let bytes = fs::read(&path).unwrap();
        for _ in 0..n_changes * n_times() {
            let mut changed = bytes.clone();
            change(&mut changed, &mut random);
            fs::write(&target, changed).unwrap();
            run_all(&work, &out);
        }
        fs::write(&target, bytes).unwrap();
    }
    // Nothing but the three folders, and nothing new in the sound one.
    let names: Vec<_> = fs::read_dir(folder.path()).unwrap().map(|e| e.unwrap().file_name()).collect();
    assert_eq!(names.len(), 3, "{names:?}");
    assert_eq!(files(&sound).len(), files(&work).len());
    assert!(files(&out).is_empty(), "{:?}", files(&out));
}

#[test]
fn cut_files_are_answered() {
    let cut = |bytes: &mut Vec<u8>, random: &mut Random| bytes.truncate(random.below(bytes.len()));
    sweep(true, 2, cut);
    sweep(false, 1, cut);
}

#[test]
fn flipped_bits_are_answered() {
    let flip = |bytes: &mut Vec<u8>, random: &mut Random| {
        for _ in 0..=random.below(3) {
            let at = random.below(bytes.len());
            bytes[at] ^= 1 << random.below(8);
        }
    };
    sweep(true, 3, flip);
    sweep(false, 1, flip);
}

#[test]
fn flipped_bits_in_footers_are_answered() {
    let flip = |bytes: &mut Vec<u8>, random: &mut Random| {
        let end = bytes.len();
        let at = end - 1 - random.below(end.min(600));
        bytes[at] = random.below(256) as u8;
    };
    sweep(true, 2, flip);
}

/// Changes a text in the sound dataset and expects an error, or findings, that name it.
fn check_hostile(file: &str, from: &str, to: &str, part: &str) {
    let folder = tempfile::tempdir().unwrap();
    let dir = folder.path().join("in");
    write_dataset(&dir);
    fs::write(folder.path().join("secret"), "secret").unwrap();
    let path = dir.join(file);
    let text = fs::read_to_string(&path).unwrap();
    assert!(text.contains(from), "{file} has no {from}");
    fs::write(&path, text.replace(from, to)).unwrap();
    let mut said = match Dataset::open(&dir, ReadLimits::default()) {
        Err(error) => error.to_string(),
        Ok(dataset) => format!("{:?}", validate(&dataset, &ValidateOptions::default()).map(|r| r.findings)),
    };
    let out = folder.path().join("out");
    fs::create_dir(&out).unwrap();
    run_all(&dir, &out);
    if let Err(error) = Input::open(&dir, InputOptions::default()) {
        said += &error.to_string();
    }
    assert!(said.contains(part), "{to}: {said}");
    assert_eq!(fs::read_dir(folder.path()).unwrap().count(), 3);
}

#[test]
fn hostile_metadata_are_named() {
    let info = "meta/info.json";
    let template = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet";
    check_hostile(info, template, "../../{file_index:03d}.parquet", "leaves the folder");
    check_hostile(info, template, "/etc/passwd{file_index}", "leaves the folder");
    check_hostile(info, template, "data/{file_index:99999999d}", "digits");
    check_hostile(info, "\"fps\": 10", "\"fps\": -1", "fps, a positive number");
    check_hostile(info, "\"fps\": 10", "\"fps\": 1e308", "fps");
    check_hostile(info, "\"total_frames\": 45", "\"total_frames\": 18446744073709551615", "total_frames");
    check_hostile(info, "\"total_episodes\": 3", "\"total_episodes\": -3", "total_episodes");
    check_hostile(info, "\"dtype\": \"float32\"", "\"dtype\": \"float99\"", "float99");
    check_hostile("meta/gawm.json", "\"format_version\": 1", "\"format_version\": 999", "999");
    check_hostile("meta/gawm.json", "\"max_file_bytes\"", "\"max_file_byts\"", "max_file_byts");
    let deep = format!("\"robot_type\": {}{}", "[".repeat(50_000), "]".repeat(50_000));
    check_hostile(info, "\"robot_type\": null", &deep, "recursion");
}

/// Puts a pipe, whose opening would wait for ever, at the place of a file.
#[cfg(unix)]
fn check_pipe(file: &str) {
    let folder = tempfile::tempdir().unwrap();
    let (dir, out) = (folder.path().join("in"), folder.path().join("out"));
    write_dataset(&dir);
    fs::create_dir(&out).unwrap();
    fs::remove_file(dir.join(file)).ok();
    assert!(std::process::Command::new("mkfifo").arg(dir.join(file)).status().unwrap().success());
    run_all(&dir, &out);
}

#[cfg(unix)]
#[test]
fn pipes_are_not_waited_for() {
    for file in ["meta/info.json", "meta/gawm.json", "meta/stats.json", "meta/tasks.parquet"] {
        check_pipe(file);
    }
    check_pipe("data/chunk-000/file-000.parquet");
    check_pipe("meta/episodes/chunk-000/file-000.parquet");
}
