//! `gawm-loader`: batches of clips for a trainer.
#![forbid(unsafe_code)]

use std::process::ExitCode;

fn main() -> ExitCode {
    gawm_loader::cli::main(std::env::args_os())
}
