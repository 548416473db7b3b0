//! Makes batches for a trainer until the run ends or the trainer is gone.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use gawm_shm::{Place, Publisher, PublisherOptions, ShmError, SlotMut};

use crate::error::LoadError;
use crate::index::Index;
use crate::maker::BatchMaker;

/// Longest wait without a look at the stop flag.
const PATIENCE: Duration = Duration::from_millis(100);

/// Which part of which run this process makes.
#[derive(Debug, Clone)]
pub struct ServeOptions {
    /// Where the trainer is.
    pub place: Place,
    /// The name of its service.
    pub service: String,
    /// The token of the trainer that started this process, [`gawm_shm::Subscriber::token`]; `None` if started by hand.
    pub token: Option<String>,
    /// The number of this loader.
    pub loader: u32,
    /// The number of loaders; this one makes the batches n with `n % loaders == loader`.
    pub loaders: u32,
    /// The first batch of the run that is still wanted.
    pub start: u64,
    /// How long to wait for the trainer to open its service.
    pub wait: Duration,
}

/// What was made.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct ServeReport {
    /// Batches that were published.
    pub batches: u64,
    /// Their clips.
    pub clips: u64,
    /// Time spent making them.
    pub making: Duration,
    /// Time spent waiting for a free slot.
    pub waiting: Duration,
    /// Sum over batches of how many were queued or viewed right after publishing.
    pub queued: u64,
    /// Whether the trainer went away before the run's end.
    pub trainer_is_gone: bool,
}

/// Why serving ended early.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum ServeError {
    /// A batch could not be made.
    #[error(transparent)]
    Load(#[from] LoadError),
    /// It could not be handed over.
    #[error(transparent)]
    Shm(#[from] ShmError),
}

/// Connects to the trainer and makes this loader's batches in order.
///
/// Ends when the last batch has been taken, when the trainer is gone (which is no error), or when `stop` is set.
///
/// # Errors
/// - [`ServeError::Shm`] if there is no trainer, another loader has the number, or the slots do not fit
/// - [`ServeError::Load`] if a frame cannot be read, or with [`LoadError::Interrupted`] when `stop` was set
pub fn serve(
    index: &Index,
    maker: &BatchMaker<'_>,
    options: &ServeOptions,
    stop: &AtomicBool,
) -> Result<ServeReport, ServeError> {
    let mut report = ServeReport::default();
    let mut publisher = match connect(index, options, stop) {
        Ok(publisher) => publisher,
        Err(ServeError::Shm(ShmError::TrainerGone { .. })) => {
            return Ok(ServeReport { trainer_is_gone: true, ..report });
        }
        Err(error) => return Err(error),
    };
    match make_all(index, maker, options, stop, &mut publisher, &mut report) {
        Err(ServeError::Shm(ShmError::TrainerGone { .. })) => report.trainer_is_gone = true,
        other => other?,
    }
    Ok(report)
}

fn connect(index: &Index, options: &ServeOptions, stop: &AtomicBool) -> Result<Publisher, ServeError> {
    let ServeOptions { loader, loaders, .. } = *options;
    let (slots, token) = (index.config.slots, options.token.clone());
    let shm = PublisherOptions { loader, loaders, slots, token };
    let start = Instant::now();
    loop {
        let deadline = Instant::now() + PATIENCE;
        match Publisher::connect(&options.place, &options.service, index.hello(), shm.clone(), deadline) {
            Ok(publisher) => return Ok(publisher),
            Err(ShmError::NoTrainer { .. } | ShmError::LoaderInUse { .. })
                if start.elapsed() < options.wait => {}
            Err(ShmError::NoTrainer { name, .. }) => {
                return Err(ShmError::NoTrainer { name, waited: start.elapsed() }.into());
            }
            Err(error) => return Err(error.into()),
        }
        if stop.load(Ordering::Relaxed) {
            return Err(LoadError::Interrupted.into());
        }
    }
}

fn make_all(
    index: &Index,
    maker: &BatchMaker<'_>,
    options: &ServeOptions,
    stop: &AtomicBool,
    publisher: &mut Publisher,
    report: &mut ServeReport,
) -> Result<(), ServeError> {
    let (loader, loaders) = (u64::from(options.loader), u64::from(options.loaders));
    let until_mine = (loader + loaders - options.start % loaders) % loaders;
    let mut n = options.start.saturating_add(until_mine);
    while n < index.hello().sequence.batches() {
        let before = Instant::now();
        let mut slot = loan(publisher, stop)?;
        let loaned = Instant::now();
        let header = maker.fill(n, &mut slot, stop)?;
        publisher.publish(slot, &header)?;
        report.waiting += loaned - before;
        report.making += loaned.elapsed();
        report.batches += 1;
        report.clips += header.clips as u64;
        report.queued += (index.config.slots - publisher.credits()?) as u64;
        n = n.saturating_add(loaders);
    }
    // What has not been taken would end with this process.
    loop {
        match publisher.drain(Instant::now() + PATIENCE) {
            Err(ShmError::Timeout { .. }) if stop.load(Ordering::Relaxed) => {
                return Err(LoadError::Interrupted.into());
            }
            Err(ShmError::Timeout { .. }) => {}
            other => return Ok(other?),
        }
    }
}

fn loan(publisher: &mut Publisher, stop: &AtomicBool) -> Result<SlotMut, ServeError> {
    loop {
        match publisher.loan(Instant::now() + PATIENCE) {
            Err(ShmError::Timeout { .. }) if stop.load(Ordering::Relaxed) => {
                return Err(LoadError::Interrupted.into());
            }
            Err(ShmError::Timeout { .. }) => {}
            other => return Ok(other?),
        }
    }
}
