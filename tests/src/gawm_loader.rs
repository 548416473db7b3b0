//! `gawm-loader` as its own `main` starts it.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm_loader::cli::main(std::env::args_os())
}
