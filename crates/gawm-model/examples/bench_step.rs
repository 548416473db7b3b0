//! Times a training step, encoding, or a plan, with the shares of time of the fused operations.
//!
//! `cargo run --release -p gawm-model --example bench_step -- MODE [PRESET] [CLIPS] [REPEATS]`, where MODE is `step`,
//! `encode` or `plan` (where CLIPS is the number of iterations); `bench_peer.py` prints the same lines for PyTorch. `RAYON_NUM_THREADS` sets the threads.
//! `--bf16` rounds operands of products (step and encode). With `--profile` a further repeat is counted by the kernels: seconds of all threads and GFLOP/s per kind.
//! A line has the smallest wall time and the smallest CPU time (user and system, all threads) of a repeat, after one repeat that is not counted.

use std::time::Instant;

use anyhow::{Context, bail};
use gawm_kernels::profile;
use gawm_model::objective::StateRule;
use gawm_model::plan::{CemConfig, SeededNoise, Start, plan_to_goal};
use gawm_model::{
    AdamW, AdamWConfig, Clips, DataWidths, Device, Gradients, ModelConfig, Objectives, Pass, Precision,
    Stream, Tensor, WorldModel, losses,
};

const WIDTHS: DataWidths = DataWidths { action: 10, state: 6 };

fn main() -> anyhow::Result<()> {
    let mut arguments: Vec<String> = std::env::args().skip(1).collect();
    let profiled = arguments.iter().any(|argument| argument == "--profile");
    let precision = match arguments.iter().any(|argument| argument == "--bf16") {
        true => Precision::Bf16,
        false => Precision::F32,
    };
    arguments.retain(|argument| argument != "--profile" && argument != "--bf16");
    let argument = |index: usize| arguments.get(index).map(String::as_str);
    let mode = argument(0).context("expected step, encode or plan")?;
    let preset = argument(1).unwrap_or("tiny-14");
    let number = |index, default| argument(index).map_or(Ok(default), str::parse::<usize>);
    let (clips, repeats) = (number(2, 8)?, number(3, 3)?);

    let architecture = ModelConfig::preset(preset)?.resolve(WIDTHS)?;
    let size = architecture.config().image_size;
    let model = WorldModel::new(architecture, 1, &Device::Cpu)?;
    let frames = normal("frames", &[clips, 4, 3, size, size])?;
    let best = match mode {
        "step" => {
            let (actions, states) = (
                normal("actions", &[clips, 4, WIDTHS.action])?,
                normal("states", &[clips, 4, WIDTHS.state])?,
            );
            let clips = Clips::try_new(frames, actions, states, None, &StateRule::default())?;
            let mut optimizer = AdamW::new(AdamWConfig::default());
            measure(repeats, profiled, || {
                let pass = Pass { precision, ..Pass::train(9, optimizer.step_count()) };
                let losses = losses(&model, &clips, &Objectives::default(), &pass)?;
                let gradients = Gradients::of(&losses.total, model.parameters())?;
                optimizer.step(model.parameters(), &gradients, 5e-5)?;
                Ok(())
            })?
        }
        "encode" => measure(repeats, profiled, || {
            model.encode(&frames, &Pass { precision, ..Pass::eval() })?.detach();
            Ok(())
        })?,
        "plan" => measure(repeats, profiled, || plan(&model, size, clips))?,
        other => bail!("unknown mode {other:?}: expected step, encode or plan"),
    };
    println!(
        "{{\"who\": \"gawm\", \"mode\": \"{mode}\", \"preset\": \"{preset}\", \"clips\": {clips}, \"wall_s\": {:.4}, \"cpu_s\": {:.4}, \"peak_mib\": {}}}",
        best.wall_secs,
        best.cpu_secs,
        peak_mib()?
    );
    Ok(())
}

/// Plans from one frame to another with the published search.
fn plan(model: &WorldModel, size: usize, iterations: usize) -> anyhow::Result<()> {
    let pair = normal("pair", &[1, 2, 3, size, size])?;
    let z = model.encode(&pair, &Pass::eval())?.detach().squeeze(0)?; // [2, D]
    let start = Start { latents: z.narrow(0, 0, 1)?, executed: None, goal: z.get(1)? };
    let mut noise = SeededNoise { seed: 1, plan: 0 };
    plan_to_goal(model, &[start], &[None], &CemConfig { iterations, ..CemConfig::default() }, &mut noise)?;
    Ok(())
}

fn normal(name: &str, shape: &[usize]) -> anyhow::Result<Tensor> {
    let values = Stream::new(1, name, 0).normals(shape.iter().product());
    Ok(Tensor::from_vec(values, shape, &Device::Cpu)?)
}

struct Best {
    wall_secs: f64,
    cpu_secs: f64,
}

fn measure(
    repeats: usize,
    profiled: bool,
    mut work: impl FnMut() -> anyhow::Result<()>,
) -> anyhow::Result<Best> {
    work()?;
    let mut best = Best { wall_secs: f64::INFINITY, cpu_secs: f64::INFINITY };
    for _ in 0..repeats {
        let (cpu, wall) = (cpu_secs()?, Instant::now());
        work()?;
        best.wall_secs = best.wall_secs.min(wall.elapsed().as_secs_f64());
        best.cpu_secs = best.cpu_secs.min(cpu_secs()? - cpu);
    }
    if profiled {
        print_profile(&mut work)?;
    }
    Ok(best)
}

/// Prints what the kernels counted in one repeat, and what that repeat took besides.
fn print_profile(work: &mut impl FnMut() -> anyhow::Result<()>) -> anyhow::Result<()> {
    let cpu = cpu_secs()?;
    profile::start();
    work()?;
    let shares = profile::stop();
    let total = cpu_secs()? - cpu;
    for share in &shares {
        let rate = if share.secs > 0.0 { share.gflop / share.secs } else { 0.0 };
        let kind = format!("{:?}", share.kind);
        println!(
            "{kind:<22} {:>8.4} s {:>5.1} % {rate:>7.1} GFLOP/s",
            share.secs,
            100.0 * share.secs / total
        );
    }
    let rest = total - shares.iter().map(|share| share.secs).sum::<f64>();
    println!("{:<22} {rest:>8.4} s {:>5.1} %", "elsewhere", 100.0 * rest / total);
    Ok(())
}

/// CPU time of all threads of this process, user and system.
fn cpu_secs() -> anyhow::Result<f64> {
    let mut nanoseconds = 0u64;
    for task in std::fs::read_dir("/proc/self/task")? {
        let path = task?.path().join("schedstat");
        let text = std::fs::read_to_string(&path)?;
        let first =
            text.split_whitespace().next().with_context(|| format!("{}: is empty", path.display()))?;
        nanoseconds += first.parse::<u64>()?;
    }
    Ok(nanoseconds as f64 * 1e-9)
}

/// Largest resident memory of this process so far.
fn peak_mib() -> anyhow::Result<u64> {
    let status = std::fs::read_to_string("/proc/self/status")?;
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).context("expected VmHWM")?;
    Ok(line.trim().trim_end_matches("kB").trim().parse::<u64>()? / 1024)
}
