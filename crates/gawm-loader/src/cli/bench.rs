//! `gawm-loader bench`

use clap::Args;

use super::clean::Format;
use super::{DataArgs, Failure, Global, cache::open_cache, print, run::describe, stop_flag};
use crate::bench::{BenchReport, LATENCY_BATCHES, measure};
use crate::index::{Index, RunLength};

/// Arguments of `bench`.
#[derive(Debug, Args)]
pub(crate) struct BenchArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Batches to measure
    #[arg(long, value_name = "N", default_value_t = 30)]
    steps: u64,
    /// Batches before the clock starts
    #[arg(long, value_name = "N", default_value_t = 4)]
    warmup: u64,
    /// Skip the decode-only rate
    #[arg(long)]
    no_decode_only: bool,
    /// Form of the result
    #[arg(long, value_enum, default_value_t = Format::Text)]
    format: Format,
}

/// Runs the command.
pub(crate) fn run(args: &BenchArgs, global: &Global) -> Result<(), Failure> {
    let Some(config) = args.data.load()? else { return Ok(()) };
    let stop = stop_flag();
    let total_steps = args.steps.saturating_add(args.warmup).saturating_add(LATENCY_BATCHES);
    let index = Index::build(&args.data.data, &config, RunLength { total_steps, ..RunLength::default() })?;
    describe(&index, global);
    drop(open_cache(&index, &stop, global)?);
    let report = measure(&index, &global.place(), args.warmup, !args.no_decode_only, &stop)?;
    match args.format {
        Format::Json => {
            let json = serde_json::to_string(&report).map_err(anyhow::Error::from);
            print(&(json.map_err(|error| Failure { code: 1, error, hint: None })? + "\n"));
        }
        Format::Text => print(&text(&report)),
    }
    Ok(())
}

fn text(report: &BenchReport) -> String {
    let mut lines = vec![
        format!(
            "from {}: {:.1} clips/s ({:.0} frames/s, {:.2} GB/s of pixels)",
            report.source, report.clips_per_s, report.frames_per_s, report.pixels_gb_per_s
        ),
        format!(
            "{} batches of {} clips ({} bytes) in {:.2} s, {:.2} s of processor; {} loaders of {} threads",
            report.batches,
            report.clips_per_batch,
            report.slot_bytes,
            report.seconds,
            report.cpu_s,
            report.loaders,
            report.threads_per_loader
        ),
    ];
    if let (Some(rate), Some(share)) = (report.decode_only_clips_per_s, report.share_of_decode_only) {
        lines.push(format!("decode only: {rate:.1} clips/s; the loader reaches {:.1} %", share * 100.0));
    }
    let share = report.share_of_memcpy * 100.0;
    lines.push(format!("memcpy: {:.1} clips/s; the loader reaches {share:.1} %", report.memcpy_clips_per_s));
    lines.push(format!(
        "bytes copied: {} per clip into the slot beside decoding, {} from slot to view",
        report.bytes_copied_per_clip, report.bytes_copied_to_view
    ));
    let us = report.queued_to_view_us;
    lines.push(format!(
        "queued batch to view: {:.1} us median, {:.1} us p99, {:.1} us max of {}",
        us.p50, us.p99, us.max, us.n
    ));
    lines.push(format!("queue depth: {:.2} slots on average", report.mean_queue_depth));
    if let Some(bytes) = report.rss_anon_bytes {
        lines.push(format!("resident memory that is not shared: {bytes} bytes"));
    }
    lines.join("\n") + "\n"
}
