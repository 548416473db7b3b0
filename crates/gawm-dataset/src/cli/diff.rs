//! `gawm-data diff`.

use std::{fmt::Write, path::PathBuf};

use clap::{Args, ValueEnum};

use super::progress::watch;
use super::{Failure, open, print_result};
use crate::read::Dataset;
use crate::stats::{Difference, dataset_stats, difference};

/// Compare two datasets: features, counts, and the distribution of each dim
#[derive(Debug, Args)]
pub(super) struct DiffArguments {
    /// First dataset folder
    first: PathBuf,
    /// Second dataset folder
    second: PathBuf,
    /// Form of the output
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
enum Format {
    Text,
    Json,
}

pub(super) fn run(arguments: &DiffArguments, quiet: bool) -> Result<u8, Failure> {
    let (first, second) = (open(&arguments.first)?, open(&arguments.second)?);
    let measured = |dataset: &Dataset| {
        let _watch = watch(quiet, "measuring", &dataset.rows_read);
        dataset_stats(dataset)
    };
    let found = difference(&measured(&first)?, &measured(&second)?);
    let text = match arguments.format {
        Format::Text => table(&found),
        Format::Json => serde_json::to_string_pretty(&found)? + "\n",
    };
    print_result(&text)?;
    Ok(0)
}

fn table(found: &Difference) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    writeln!(
        out,
        "rows {} and {}, episodes {} and {}",
        found.rows[0], found.rows[1], found.episodes[0], found.episodes[1]
    )
    .ok();
    found.schema.iter().for_each(|line| {
        writeln!(out, "{line}").ok();
    });
    writeln!(out, "\n{:<44} {:>6} {:>8} {:>24} {:>24}", "dim", "KS", "PSI", "mean", "std").ok();
    for dim in &found.dims {
        let name = format!("{}[{}]", dim.column, dim.dim);
        let pair = |v: [f64; 2]| format!("{:>11.5} {:>11.5}", v[0], v[1]);
        writeln!(
            out,
            "{name:<44} {:>6.3} {:>8.3} {:>24} {:>24}",
            dim.ks,
            dim.psi,
            pair(dim.mean),
            pair(dim.std)
        )
        .ok();
    }
    out
}
