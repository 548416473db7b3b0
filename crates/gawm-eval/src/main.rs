//! The program `gawm-eval`: see `gawm-eval --help`.
#![forbid(unsafe_code)]

fn main() -> std::process::ExitCode {
    gawm_eval::cli::main(std::env::args_os())
}
