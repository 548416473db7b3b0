//! The program `gawm-train`.
#![forbid(unsafe_code)]

use std::process::ExitCode;

use gawm_train::loaders::LoaderProgram;

fn main() -> ExitCode {
    gawm_train::cli::run(std::env::args_os(), LoaderProgram::Beside)
}
