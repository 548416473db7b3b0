//! `xtask cuda-check`: builds with `--features cuda` on a machine without CUDA and without a GPU (docs/cuda.md).

use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, ensure};

use crate::process::{root, run};

/// Arguments of `xtask cuda-check`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// Also link a program, against stub libraries made of the symbols that are missing.
    #[arg(long)]
    link: bool,
    /// Compute capability to compile kernels for, without the point; 90 is Hopper (H100, H200).
    #[arg(long, default_value = "90")]
    capability: String,
}

/// The compiler and headers, as PyPI has them; 13.0 fits drivers from 580 on.
const WHEELS: [&str; 5] = [
    "nvidia-cuda-nvcc==13.0.88",
    "nvidia-cuda-crt==13.0.88",
    "nvidia-nvvm==13.0.88",
    "nvidia-cuda-runtime==13.0.96",
    "nvidia-cuda-cccl==13.0.85",
];

/// Libraries of the driver and toolkit, their names at run time, and how their symbols begin. Longer beginnings first.
const LIBRARIES: [(&str, &str, &[&str]); 6] = [
    ("cublasLt", "libcublasLt.so.13", &["cublasLt"]),
    ("cublas", "libcublas.so.13", &["cublas"]),
    ("curand", "libcurand.so.10", &["curand"]),
    ("nvrtc", "libnvrtc.so.13", &["nvrtc"]),
    ("cudart", "libcudart.so.13", &["cuda", "__cuda"]),
    ("cuda", "libcuda.so.1", &["cu"]),
];

pub(crate) fn check(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let folder = root().join("target/cuda");
    let toolkit = toolkit(&folder)?;
    let target = folder.join("build");
    let cargo = |task: &str| {
        let mut command = Command::new(std::env::var_os("CARGO").unwrap_or("cargo".into()));
        let path = std::env::var_os("PATH").unwrap_or_default();
        let paths = std::iter::once(toolkit.join("bin")).chain(std::env::split_paths(&path));
        for name in ["CUDA_HOME", "CUDA_PATH", "CUDA_ROOT", "CUDA_TOOLKIT_ROOT_DIR"] {
            command.env(name, &toolkit);
        }
        let paths = std::env::join_paths(paths).context("PATH has a folder with a colon")?;
        command
            .env("PATH", paths)
            .env("CUDA_COMPUTE_CAP", &arguments.capability)
            .env("CARGO_TARGET_DIR", &target);
        command.current_dir(root()).args([task, "--release", "--features", "cuda", "-p"]);
        anyhow::Ok(command)
    };
    let show = |mut command: Command| -> anyhow::Result<()> {
        let shown = format!("{command:?}");
        let status = command.status().with_context(|| format!("cannot run {shown}"))?;
        ensure!(status.success(), "{shown} failed ({status})");
        Ok(())
    };
    if !arguments.link {
        let mut command = cargo("check")?;
        command.arg("xtask");
        show(command)?;
        println!("type check with --features cuda: ok");
        return Ok(ExitCode::SUCCESS);
    }
    let mut libraries = cargo("build")?;
    libraries.arg("gawm-model");
    show(libraries)?;
    let stubs = stubs(&folder, &target.join("release"))?;
    let mut program = cargo("rustc")?;
    program.args(["xtask", "--", "-L"]).arg(&stubs);
    show(program)?;
    println!(
        "link with --features cuda: ok (stubs in {}; never on a library path at run time)",
        stubs.display()
    );
    Ok(ExitCode::SUCCESS)
}

/// Downloads and unpacks the toolkit once; returns its root.
fn toolkit(folder: &Path) -> anyhow::Result<PathBuf> {
    let toolkit = folder.join("nvidia/cu13");
    let done = folder.join("complete");
    if done.exists() {
        return Ok(toolkit);
    }
    let wheels = folder.join("wheels");
    std::fs::create_dir_all(&wheels).with_context(|| format!("cannot make {}", wheels.display()))?;
    eprintln!("downloading the CUDA compiler (105 MB)");
    let mut download = Command::new("python3");
    download.args(["-m", "pip", "download", "--quiet", "--no-deps", "--dest"]).arg(&wheels).args(WHEELS);
    run(&mut download)?;
    for wheel in list(&wheels)? {
        run(Command::new("python3").args(["-m", "zipfile", "-e"]).arg(&wheel).arg(folder))?;
    }
    for programs in ["bin", "nvvm/bin"] {
        run(Command::new("chmod").arg("-R").arg("+x").arg(toolkit.join(programs)))?; // zip knows no permissions
    }
    std::fs::write(&done, "").with_context(|| format!("cannot write {}", done.display()))?;
    Ok(toolkit)
}

fn list(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = folder.read_dir().with_context(|| format!("cannot list {}", folder.display()))?;
    let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
    paths.sort();
    Ok(paths)
}

/// Makes a library with an empty function for every CUDA symbol that our libraries miss; returns their folder.
fn stubs(folder: &Path, built: &Path) -> anyhow::Result<PathBuf> {
    let mut objects = list(&built.join("deps"))?;
    objects.retain(|path| {
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        let ours = ["libcudarc-", "libcandle_core-", "libcandle_kernels-"];
        name.ends_with(".rlib") && ours.iter().any(|start| name.starts_with(start))
    });
    for build in list(&built.join("build"))? {
        objects.extend(Some(build.join("out/libmoe.a")).filter(|path| path.exists()));
    }
    let mut symbols: BTreeMap<&str, BTreeSet<String>> = BTreeMap::new();
    for line in run(Command::new("nm").args(["--undefined-only", "--quiet"]).args(&objects))?.lines() {
        let Some(symbol) = line.trim().strip_prefix("U ") else { continue };
        let owner =
            LIBRARIES.iter().find(|(_, _, starts)| starts.iter().any(|start| symbol.starts_with(start)));
        if let Some((library, _, _)) = owner {
            symbols.entry(library).or_default().insert(symbol.to_owned());
        }
    }
    let stubs = folder.join("stubs");
    std::fs::create_dir_all(&stubs).with_context(|| format!("cannot make {}", stubs.display()))?;
    for (library, soname, _) in LIBRARIES {
        let mut source = String::new();
        for symbol in symbols.get(library).into_iter().flatten() {
            writeln!(source, "void {symbol}(void) {{}}")?;
        }
        let file = stubs.join(format!("{library}.c"));
        std::fs::write(&file, source).with_context(|| format!("cannot write {}", file.display()))?;
        let output = stubs.join(format!("lib{library}.so"));
        let mut compile = Command::new("gcc");
        compile
            .args(["-shared", "-fPIC", "-w", &format!("-Wl,-soname,{soname}"), "-o"])
            .arg(output)
            .arg(file);
        run(&mut compile)?;
    }
    Ok(stubs)
}
