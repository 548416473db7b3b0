//! `gawm-train` as its own `main` starts it.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm_train::cli::run(std::env::args_os(), gawm_train::loaders::LoaderProgram::Beside)
}
