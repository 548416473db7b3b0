//! Measures the writer against plain writing: `cargo run --release -p gawm-dataset --example write_speed -- DIR`.
//!
//! Writes 1 GB of frames (PNG of noise, 196 kB each) and one million rows of 32 numbers, each once through the writer
//! and once as plain bytes with fsync, and prints the times. DIR must not exist; it is left for inspection.

use std::error::Error;
use std::fs::{self, File};
use std::io::Write;
use std::path::Path;
use std::time::Instant;

use bytes::Bytes;
use gawm_dataset::{
    DatasetSpec, DatasetWriter, EpisodeInfo, ImageColumn, RecordingInfo, Rows, Trajectory, VectorColumn,
    WriteMode,
};
use gawm_schema::{ContentHash, Schema};

const SIDE: u32 = 256;
const FRAMES: usize = 5200;
const ROWS: usize = 1_000_000;
const WIDTH: usize = 32;
/// Rows per piece.
const PIECE: usize = 100;

fn main() -> Result<(), Box<dyn Error>> {
    let dir = std::env::args().nth(1).ok_or("usage: write_speed DIR")?;
    let dir = Path::new(&dir);
    fs::create_dir(dir)?;
    let frame = noise_png()?;
    let camera = format!(
        "rate_hz = 30.0\nstreams = []\nfeatures = [{{ name = \"observation.images.front\", role = \"image\", \
         data = {{ type = \"image\", height = {SIDE}, width = {SIDE}, channels = 3 }} }}]"
    );
    let images = |range: std::ops::Range<usize>| Rows {
        images: vec![ImageColumn {
            frames: vec![frame.clone(); range.len()],
            valid: vec![true; range.len()],
        }],
        ..Rows::default()
    };
    let writer = write(&dir.join("images"), &toml::from_str(&camera)?, FRAMES, images)?;
    let plain = write_plain(&dir.join("images.bin"), (0..FRAMES).map(|_| frame.to_vec()))?;
    report("frames", frame.len() * FRAMES, FRAMES, writer, plain);

    let dims: Vec<String> =
        (0..WIDTH).map(|i| format!("{{ name = \"d{i}\", unit = \"m\", source = \"/t:{i}\" }}")).collect();
    let numbers = format!(
        "rate_hz = 100.0\nstreams = []\nfeatures = [{{ name = \"observation.state\", role = \"state\", data = {{ \
         type = \"vector\", dtype = \"float32\", parts = [{{ kind = \"linear\", dims = [{}] }}] }} }}]",
        dims.join(", ")
    );
    let value = |row: usize, dim: usize| ((row * (dim + 3)) as f64 * 1e-4).sin();
    let numeric = |range: std::ops::Range<usize>| Rows {
        vectors: vec![VectorColumn {
            values: range.clone().flat_map(|row| (0..WIDTH).map(move |dim| value(row, dim))).collect(),
            valid: vec![true; range.len()],
        }],
        ..Rows::default()
    };
    let writer = write(&dir.join("numbers"), &toml::from_str(&numbers)?, ROWS, numeric)?;
    let rows = (0..ROWS / PIECE).map(|piece| {
        let rows = piece * PIECE..(piece + 1) * PIECE;
        rows.flat_map(|row| (0..WIDTH).flat_map(move |dim| (value(row, dim) as f32).to_le_bytes())).collect()
    });
    let plain = write_plain(&dir.join("numbers.bin"), rows)?;
    report("numbers", ROWS * WIDTH * 4, ROWS, writer, plain);
    Ok(())
}

fn write(
    out: &Path,
    schema: &Schema,
    n: usize,
    rows: impl Fn(std::ops::Range<usize>) -> Rows,
) -> Result<f64, Box<dyn Error>> {
    let start = Instant::now();
    let mut writer =
        DatasetWriter::create(out, DatasetSpec::new(schema.clone(), "", "write_speed"), WriteMode::New)?;
    let content_hash = ContentHash::of(b"");
    writer.begin_recording(RecordingInfo { content_hash, files: Vec::new(), notes: Default::default() })?;
    for first in (0..n).step_by(n / 10) {
        writer.begin_episode(EpisodeInfo { task: "measure".to_owned(), ..EpisodeInfo::default() })?;
        let end = (first + n / 10).min(n);
        for piece in (first..end).step_by(PIECE) {
            let range = piece..(piece + PIECE).min(end);
            let time_ns = range.clone().map(|i| i as i64 * 10_000_000).collect();
            writer.write(Trajectory::try_new(schema, Rows { time_ns, ..rows(range) })?)?;
        }
        writer.end_episode()?;
    }
    writer.end_recording()?;
    writer.finish()?;
    Ok(start.elapsed().as_secs_f64())
}

fn write_plain(path: &Path, blocks: impl Iterator<Item = Vec<u8>>) -> Result<f64, Box<dyn Error>> {
    let start = Instant::now();
    let mut file = File::create(path)?;
    for block in blocks {
        file.write_all(&block)?;
    }
    file.sync_all()?;
    Ok(start.elapsed().as_secs_f64())
}

fn report(what: &str, n_bytes: usize, n_rows: usize, writer: f64, plain: f64) {
    println!(
        "{what}: {} MB, writer {writer:.2} s ({:.0} MB/s, {:.0} rows/s), plain {plain:.2} s, ratio {:.2}",
        n_bytes / 1_000_000,
        n_bytes as f64 / writer / 1e6,
        n_rows as f64 / writer,
        writer / plain
    );
}

fn noise_png() -> Result<Bytes, png::EncodingError> {
    let mut state = 1u64;
    let pixels: Vec<u8> = (0..SIDE * SIDE * 3)
        .map(|_| {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            (state >> 56) as u8
        })
        .collect();
    let mut bytes = Vec::new();
    let mut encoder = png::Encoder::new(&mut bytes, SIDE, SIDE);
    encoder.set_color(png::ColorType::Rgb);
    encoder.set_compression(png::Compression::Fast);
    let mut writer = encoder.write_header()?;
    writer.write_image_data(&pixels)?;
    writer.finish()?;
    Ok(Bytes::from(bytes))
}
