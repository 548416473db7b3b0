//! `gawm-ingest`: raw robot and simulator logs to datasets.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm_ingest::cli::main(std::env::args_os())
}
