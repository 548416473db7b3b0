//! Gates as tests, golden parity, interop with other people's software.
#![forbid(unsafe_code)]

mod cuda;
mod golden;
mod interop;
mod process;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Tasks of this repository that are not part of any program.
#[derive(Debug, Parser)]
#[command(name = "xtask", version)]
struct Arguments {
    #[command(subcommand)]
    task: Task,
}

#[derive(Debug, Subcommand)]
enum Task {
    /// Compare the model with answers of the published PyTorch modules.
    Golden(golden::Arguments),
    /// Build with CUDA on a machine that has none: a compiler from PyPI, stub libraries to link.
    CudaCheck(cuda::Arguments),
    /// Exchange files with other people's software.
    Interop(interop::Arguments),
}

fn main() -> ExitCode {
    let result = match Arguments::parse().task {
        Task::Golden(arguments) => golden::run(&arguments),
        Task::CudaCheck(arguments) => cuda::check(&arguments),
        Task::Interop(arguments) => interop::run(&arguments),
    };
    match result {
        Ok(code) => code,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::from(1)
        }
    }
}
