//! Measures row access: `cargo run --release -p gawm-ingest --example table_rows -- FILE COLUMN`.
//!
//! Reads every row once in order and once in a shuffled order of a fixed seed, and prints milliseconds per row.

use std::path::Path;
use std::time::Instant;

use anyhow::{Context, bail};
use gawm_ingest::tabular::{Limits, Table, open};

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [file, column] = &arguments[..] else { bail!("expected FILE COLUMN, got {arguments:?}") };
    let start = Instant::now();
    let table = open(Path::new(file), &Limits::default())?;
    let rows = table.column(column).with_context(|| format!("no column {column:?}"))?.readable_rows;
    println!("opened in {:.2} ms: {rows} rows", start.elapsed().as_secs_f64() * 1e3);
    let in_order: Vec<u64> = (0..rows).collect();
    report("in order, first time", &table, column, &in_order)?;
    report("in order", &table, column, &in_order)?;
    report("shuffled", &table, column, &shuffled(rows))?;
    let start = Instant::now();
    let hash = table.content_hash(column)?;
    println!("content hash {:02x?}.. in {:.1} ms", &hash[..4], start.elapsed().as_secs_f64() * 1e3);
    Ok(())
}

fn report(name: &str, table: &Table, column: &str, rows: &[u64]) -> anyhow::Result<()> {
    let start = Instant::now();
    let (mut bytes, mut buffer) = (0, Vec::new());
    let is_image = table.column(column).is_some_and(|c| c.image_shape().is_some());
    for &row in rows {
        if is_image {
            table.read_image(column, row, &mut buffer)?;
            bytes += buffer.len();
        } else {
            bytes += table.read_rows(column, row..row + 1)?.values.len();
        }
    }
    let ms = start.elapsed().as_secs_f64() * 1e3;
    println!("{name}: {:.4} ms/row ({bytes} bytes or elements)", ms / rows.len().max(1) as f64);
    Ok(())
}

/// Fisher-Yates with a linear congruential generator (Knuth's MMIX constants): the same order every time.
fn shuffled(n: u64) -> Vec<u64> {
    let mut rows: Vec<u64> = (0..n).collect();
    let mut state = 42u64;
    for i in (1..rows.len()).rev() {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        rows.swap(i, (state >> 33) as usize % (i + 1));
    }
    rows
}
