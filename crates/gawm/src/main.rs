//! `gawm`: every program of gawm in one, pipelines, and a quickstart.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm::cli::main(std::env::args_os())
}
