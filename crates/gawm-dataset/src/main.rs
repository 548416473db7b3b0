//! The program `gawm-data`.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm_dataset::cli::run(std::env::args_os())
}
