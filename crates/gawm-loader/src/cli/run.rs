//! `gawm-loader run`

use std::time::Duration;

use clap::Args;

use super::{DataArgs, Failure, Global, cache::open_cache, print, say, stop_flag};
use crate::index::{Index, RunLength};
use crate::maker::BatchMaker;
use crate::serve::{ServeOptions, serve};

/// Arguments of `run`.
#[derive(Debug, Args)]
pub(crate) struct RunArgs {
    #[command(flatten)]
    data: DataArgs,
    /// Name of the trainer's service
    #[arg(long, value_name = "NAME", required_unless_present_any = ["print_config", "hello"])]
    service: Option<String>,
    /// Token of the trainer that starts this loader; without it any trainer of the service is taken
    #[arg(long, value_name = "TOKEN")]
    token: Option<String>,
    /// Number of this loader, from 0
    #[arg(long, value_name = "K", default_value_t = 0)]
    loader: u32,
    /// Number of loaders; this one makes the batches n with n % LOADERS == K. Default: [loader] loaders
    #[arg(long, value_name = "LOADERS")]
    loaders: Option<u32>,
    /// First batch of the run that is still wanted
    #[arg(long, value_name = "N", default_value_t = 0)]
    start: u64,
    /// Training steps of the run
    #[arg(long, value_name = "STEPS", required_unless_present_any = ["print_config", "hello"])]
    total_steps: Option<u64>,
    /// Training steps between validations; 0: one, after the last step
    #[arg(long, value_name = "STEPS", default_value_t = 0)]
    validate_every: u64,
    /// Batches of a validation; fewer where fewer clips are held out
    #[arg(long, value_name = "BATCHES", default_value_t = 0)]
    validation_batches: u64,
    /// Rank this loader works for, from 0
    #[arg(long, value_name = "R", default_value_t = 0)]
    rank: u32,
    /// Number of ranks that share each step
    #[arg(long, value_name = "RANKS", default_value_t = 1)]
    ranks: u32,
    /// Seconds to wait for the trainer to open its service
    #[arg(long, value_name = "SECONDS", default_value_t = 60)]
    wait_s: u64,
    /// Print the hello message as JSON and end: shapes, dims, standardisation, clip counts
    #[arg(long)]
    hello: bool,
}

/// Runs the command.
pub(crate) fn run(args: &RunArgs, global: &Global) -> Result<(), Failure> {
    let Some(config) = args.data.load()? else { return Ok(()) };
    let loaders = args.loaders.unwrap_or(config.loaders);
    let usage = |text: String| Failure { code: 2, error: anyhow::anyhow!(text), hint: None };
    if args.loader >= loaders {
        return Err(usage(format!("expected --loader below {loaders}, got {}", args.loader)));
    }
    if args.rank >= args.ranks {
        return Err(usage(format!("expected --rank below {}, got {}", args.ranks, args.rank)));
    }
    let stop = stop_flag();
    let length = RunLength {
        total_steps: args.total_steps.unwrap_or(0),
        validate_every: args.validate_every,
        validation_batches: args.validation_batches,
        rank: args.rank,
        ranks: args.ranks,
    };
    let index = Index::build(&args.data.data, &config, length)?;
    if args.hello {
        print(&(index.hello().to_json() + "\n"));
        return Ok(());
    }
    describe(&index, global);
    let cache = open_cache(&index, &stop, global)?;
    let maker = BatchMaker::new(&index, cache, args.loader, loaders)?;
    let options = ServeOptions {
        place: global.place(),
        service: args.service.clone().unwrap_or_default(),
        token: args.token.clone(),
        loader: args.loader,
        loaders,
        start: args.start,
        wait: Duration::from_secs(args.wait_s),
    };
    let report = serve(&index, &maker, &options, &stop)?;
    if global.verbose {
        let why = if report.trainer_is_gone { "the trainer is gone" } else { "the run is complete" };
        say(&format!(
            "loader {}: {} batches, {} clips; {:.1} s making, {:.1} s waiting; {why}",
            args.loader,
            report.batches,
            report.clips,
            report.making.as_secs_f64(),
            report.waiting.as_secs_f64()
        ));
    }
    Ok(())
}

/// Says what is trained on and what was left out.
pub(crate) fn describe(index: &Index, global: &Global) {
    if global.quiet {
        return;
    }
    let hello = index.hello();
    if hello.validation.clips == 0 {
        say("warning: no clips are held out, so there is no validation");
    }
    if global.verbose {
        let (train, validation) = (hello.train, hello.validation);
        say(&format!(
            "training: {} clips of {} episodes ({} excluded, {} episodes too short); held out: {} clips of {} episodes",
            train.clips,
            train.episodes,
            train.excluded,
            train.short_episodes,
            validation.clips,
            validation.episodes
        ));
    }
}
