//! Prints what an HDF5 or npz file holds: `cargo run -p gawm-ingest --example table_report -- FILE...`.

use std::path::Path;

use gawm_ingest::tabular::{Limits, open, report};

fn main() {
    for file in std::env::args().skip(1) {
        match open(Path::new(&file), &Limits::default()) {
            Ok(table) => print!("{}", report(&table, None)),
            Err(error) => {
                println!("{error}");
                if let Some(hint) = error.hint() {
                    println!("hint: {hint}");
                }
            }
        }
        println!();
    }
}
