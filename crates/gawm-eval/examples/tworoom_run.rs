//! Makes a TwoRoom dataset and trains a small model on it, in one process and without loaders: something to evaluate.
//!
//! `cargo run --release -p gawm-eval --example tworoom_run -- DATA RUN [OBJECTIVE] [STEPS] [EPISODES] [SEED]`
//!
//! The pipeline of programs (`gawm-sim`, `gawm-ingest`, `gawm-loader`, `gawm-train`) is the real way; this is for work on
//! evaluation. DATA is made unless it is there.

use std::path::PathBuf;

#[path = "../tests/support/mod.rs"]
mod support;

fn main() -> support::Outcome<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [data, run, rest @ ..] = arguments.as_slice() else { return Err("expected DATA RUN".into()) };
    let text = |index: usize, default: &str| rest.get(index).map_or(default, String::as_str).to_owned();
    let (data, run) = (PathBuf::from(data), PathBuf::from(run));
    let seed: u64 = text(3, "3072").parse()?;
    if !data.exists() {
        support::write_dataset(&data, text(2, "300").parse()?, 1000, 64, 0.9)?;
    }
    let training = support::Training {
        preset: "nano".to_owned(),
        objective: text(0, "sa-idm"),
        steps: text(1, "1200").parse()?,
        clips: 32,
        rate: 1e-3,
        seed,
    };
    support::train(&data, &run, &training, &|step, loss| {
        if step % 50 == 0 {
            eprintln!("step {step}: loss {loss:.4}");
        }
    })
}
