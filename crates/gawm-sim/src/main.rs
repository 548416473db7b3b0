//! The program `gawm-sim`: see `gawm-sim --help`.
#![forbid(unsafe_code)]

fn main() -> std::process::ExitCode {
    gawm_sim::cli::main(std::env::args_os())
}
