//! `xtask interop torch`: weights of the published PyTorch modules into ours and back.

use std::collections::HashMap;
use std::fmt::Write;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode};

use anyhow::{Context, bail, ensure};
use gawm_model::checkpoint::{self, ImportOptions, KeyLayout};
use gawm_model::{DType, Device, Pass, Tensor, WorldModel, plan};

use super::{python, record};
use crate::process::{root, run as run_program};

/// Arguments of `xtask interop torch`.
#[derive(Debug, clap::Args)]
pub(crate) struct Arguments {
    /// An interpreter that has the packages of `xtask/interop/requirements.txt`; without it an environment is made.
    #[arg(long)]
    python: Option<PathBuf>,
}

/// Allowed |ours - theirs| / (1 + |theirs|).
const TOLERANCE: f64 = 2e-5;

pub(crate) fn run(arguments: &Arguments) -> anyhow::Result<ExitCode> {
    let folder = root().join("target/interop-torch");
    std::fs::create_dir_all(&folder).with_context(|| format!("cannot make {}", folder.display()))?;
    let interpreter = match &arguments.python {
        Some(python) => python.clone(),
        None => {
            let bare = ["stable-worldmodel==0.1.1", "stable-pretraining==0.1.6"];
            let requirements = root().join("xtask/interop/requirements.txt");
            let size = "PyTorch and the published model: about 7 GB, up to 20 minutes";
            python::environment(&folder.join("venv"), &requirements, &bare, size)?
        }
    };
    let script = root().join("xtask/interop/torch_world_model.py");
    let python = |task: &str| run_program(Command::new(&interpreter).arg(&script).arg(task).arg(&folder));
    python("make")?;

    let mut rows = Vec::new();
    for file in ["weights.pt", "weights_transformers4.pt", "lightning.ckpt", "weights.safetensors"] {
        let model = import(&folder.join(file))?;
        rows.extend(
            compare(&folder, &model)?
                .into_iter()
                .map(|(what, error)| (format!("{file} -> ours, {what}"), error)),
        );
        checkpoint::export(&folder.join("exported.safetensors"), &model, KeyLayout::Transformers5)?;
    }
    // The pickled module runs code when PyTorch loads it; we must not.
    match import(&folder.join("module.pt")) {
        Ok(_) => bail!("a pickled module was imported: expected a refusal"),
        Err(error) => eprintln!("module.pt is refused, as it must be: {error:#}"),
    }

    let report = python("check")?;
    let line = report.lines().rfind(|line| line.starts_with('{')).context("no answer of the script")?;
    let answer: serde_json::Value = serde_json::from_str(line).context("the script's answer is no JSON")?;
    let (equal, all) = (&answer["tensors_equal"], &answer["tensors"]);
    ensure!(equal == all, "{equal} of {all} tensors are equal after the way there and back");
    for what in ["emb", "rollout_1", "rollout_3"] {
        let error = answer[what].as_f64().with_context(|| format!("the script's answer has no {what}"))?;
        rows.push((format!("ours -> exported.safetensors -> PyTorch, {what}"), error));
    }
    finish(&folder, &rows, all)
}

fn import(path: &Path) -> anyhow::Result<WorldModel> {
    Ok(checkpoint::import(path, &ImportOptions::default(), &Device::Cpu)?)
}

/// Returns the errors of our embeddings and rollouts.
fn compare(folder: &Path, model: &WorldModel) -> anyhow::Result<Vec<(String, f64)>> {
    let answers: HashMap<String, Tensor> =
        candle_core::safetensors::load(folder.join("answers.safetensors"), &Device::Cpu)?;
    let answer = |name: &str| answers.get(name).with_context(|| format!("no answer {name}"));
    let candidates = answer("candidates")?;
    let z = model.encode(answer("frames")?, &Pass::eval())?.detach();
    let mut errors = vec![("emb".to_owned(), largest(&z, answer("emb")?)?)];
    let (n, d) = (candidates.dim(0)?, z.dim(2)?);
    for history in [1, 3] {
        let start = z.narrow(0, 0, 1)?.narrow(1, 0, history)?.broadcast_as((n, history, d))?.contiguous()?;
        let predicted = plan::rollout(model, &start, candidates, &Pass::eval())?;
        let name = format!("rollout_{history}");
        let error = largest(&predicted, answer(&name)?)?;
        errors.push((name, error));
    }
    Ok(errors)
}

/// The largest |ours - theirs| / (1 + |theirs|).
fn largest(ours: &Tensor, theirs: &Tensor) -> anyhow::Result<f64> {
    ensure!(ours.dims() == theirs.dims(), "expected shape {:?}, got {:?}", theirs.dims(), ours.dims());
    let read = |tensor: &Tensor| tensor.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
    let (ours, theirs) = (read(ours)?, read(theirs)?);
    let error = |(ours, theirs): (&f64, &f64)| {
        let error = (ours - theirs).abs() / (1.0 + theirs.abs());
        if error.is_nan() { f64::INFINITY } else { error }
    };
    Ok(ours.iter().zip(&theirs).map(error).fold(0.0, f64::max))
}

/// Prints and records the outcome; exit code 3 beyond the tolerance.
fn finish(folder: &Path, rows: &[(String, f64)], tensors: &serde_json::Value) -> anyhow::Result<ExitCode> {
    let versions = std::fs::read_to_string(folder.join("versions.json")).context("no versions.json")?;
    let versions: serde_json::Map<String, serde_json::Value> = serde_json::from_str(&versions)?;
    let versions: Vec<String> = versions
        .iter()
        .map(|(name, version)| format!("{name} {}", version.as_str().unwrap_or("?")))
        .collect();
    let mut table = String::from("| way | largest error | tolerance |\n|---|---|---|\n");
    for (way, error) in rows {
        writeln!(table, "| {way} | {error:.1e} | {TOLERANCE:.0e} |")?;
    }
    print!("{table}");
    let body = format!(
        "`cargo run --release -p xtask -- interop torch` with {}.\n\
         A published SA+IDM model (56 px, patch 14, encoder depth 3, random weights and running statistics), evaluation mode.\n\
         Errors are |x - reference| / (1 + |reference|); all {tensors} tensors come back equal to the bit.\n\
         A pickled module (`torch.save(model)`) is refused, with the name of the first class in it.\n\n{table}",
        versions.join(", ")
    );
    record("PyTorch", &body)?;
    let failed = rows.iter().filter(|(_, error)| *error > TOLERANCE).count();
    Ok(if failed == 0 { ExitCode::SUCCESS } else { ExitCode::from(3) })
}
