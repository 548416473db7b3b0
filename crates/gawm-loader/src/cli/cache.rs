//! `gawm-loader cache`, and the cache of the other commands.

use std::sync::Mutex;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

use clap::Args;

use super::{DataArgs, Failure, Global, print, say, stop_flag};
use crate::cache::{Cache, CachePlan};
use crate::error::LoadError;
use crate::index::{Index, RunLength};

/// Time between two lines of progress.
const PERIOD: Duration = Duration::from_secs(2);

/// Arguments of `cache`.
#[derive(Debug, Args)]
pub(crate) struct CacheArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Print the size of the cache and end
    #[arg(long)]
    dry_run: bool,
    /// Read the whole cache and compare it with its hash
    #[arg(long)]
    verify: bool,
}

/// Runs the command.
pub(crate) fn run(args: &CacheArgs, global: &Global) -> Result<(), Failure> {
    let Some(mut config) = args.data.load()? else { return Ok(()) };
    config.cache = true;
    // One clip is enough: no batches are made.
    config.batch = 1;
    let stop = stop_flag();
    let index = Index::build(&args.data.data, &config, RunLength::default())?;
    let plan = CachePlan::of(&index);
    print(&format!("{}: {} frames, {} bytes\n", plan.path.display(), plan.frames, plan.bytes));
    if args.dry_run {
        return Ok(());
    }
    let cache = open_cache(&index, &stop, global)?;
    if args.verify && cache.is_some_and(|cache| !cache.is_intact()) {
        let (expected, got) = ("frames with the hash in its header".to_owned(), "others".to_owned());
        return Err(LoadError::Cache { path: plan.path, expected, got }.into());
    }
    Ok(())
}

/// Opens the cache if the configuration wants one; says its size before it is made.
pub(crate) fn open_cache(
    index: &Index,
    stop: &AtomicBool,
    global: &Global,
) -> Result<Option<Cache>, Failure> {
    if !index.config.cache {
        return Ok(None);
    }
    let plan = CachePlan::of(index);
    plan.check_budget(index.config.cache_budget_gib)?;
    if !plan.exists && !global.quiet {
        let gib = plan.bytes as f64 / (1_u64 << 30) as f64;
        say(&format!(
            "cache: {} frames, {} bytes ({gib:.2} GiB) in {}",
            plan.frames,
            plan.bytes,
            plan.path.display()
        ));
    }
    let state = Mutex::new((0, Instant::now()));
    let progress = |frames: u64| {
        let Ok(mut state) = state.lock() else { return };
        state.0 += frames;
        if !global.quiet && state.1.elapsed() >= PERIOD {
            state.1 = Instant::now();
            say(&format!("cache: {} of {} frames", state.0, plan.frames));
        }
    };
    Ok(Some(plan.open_or_make(index, stop, &progress)?))
}
