//! How fast batches are made and handed over.
//!
//! Loaders run as threads of this process, each with a publisher of its own, and this process is also the trainer that
//! takes every batch and looks at one byte per page of it. The decode-only rate beside it is the same frames in the same
//! order, their bytes already in memory, decoded into one buffer by as many threads; the memcpy rate is frames copied from
//! memory to such buffers.

use std::hint::black_box;
use std::sync::atomic::AtomicBool;
use std::thread;
use std::time::{Duration, Instant};

use gawm_image::decode_rgb_into;
use gawm_shm::{Claim, Place, Slot, Subscriber};
use serde::Serialize;

use crate::cache::{Cache, CachePlan};
use crate::clips;
use crate::error::LoadError;
use crate::index::Index;
use crate::maker::BatchMaker;
use crate::serve::{ServeError, ServeOptions, ServeReport, serve};

/// Longest wait for a batch.
const PATIENCE: Duration = Duration::from_secs(60);
/// Most frames whose bytes are held for the decode-only rate.
const MAX_HELD_FRAMES: usize = 4096;
/// Batches at the end that are only taken when they are queued, to time that.
pub(crate) const LATENCY_BATCHES: u64 = 40;
/// How long each rate is measured.
const RATE_TIME: Duration = Duration::from_millis(1500);
/// Bytes of a buffer that is copied: beyond any cache.
const COPY_BYTES: usize = 77_070_336;
/// Bytes between two that the consumer looks at.
const PAGE_BYTES: usize = 4096;

/// What was measured.
#[derive(Debug, Clone, Serialize)]
pub(crate) struct BenchReport {
    /// `files` or `cache`.
    pub(crate) source: &'static str,
    pub(crate) loaders: u32,
    pub(crate) threads_per_loader: usize,
    pub(crate) clips_per_batch: usize,
    pub(crate) slot_bytes: usize,
    pub(crate) batches: u64,
    pub(crate) seconds: f64,
    pub(crate) clips_per_s: f64,
    pub(crate) frames_per_s: f64,
    pub(crate) pixels_gb_per_s: f64,
    /// User and system time of the process while batches were made, in seconds; all threads.
    pub(crate) cpu_s: f64,
    pub(crate) decode_only_clips_per_s: Option<f64>,
    pub(crate) share_of_decode_only: Option<f64>,
    pub(crate) memcpy_clips_per_s: f64,
    pub(crate) share_of_memcpy: f64,
    /// Bytes copied between cache and slot per clip, without what the decoder writes.
    pub(crate) bytes_copied_per_clip: usize,
    /// Bytes copied between slot and view.
    pub(crate) bytes_copied_to_view: usize,
    /// Batches of a loader that were queued or viewed, on average after publishing one.
    pub(crate) mean_queue_depth: f64,
    /// Time from asking for a batch that is queued to its view, in microseconds.
    pub(crate) queued_to_view_us: Quantiles,
    /// Resident memory that is not shared, in bytes.
    pub(crate) rss_anon_bytes: Option<u64>,
}

/// Quantiles of a few hundred measurements.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub(crate) struct Quantiles {
    pub(crate) p50: f64,
    pub(crate) p99: f64,
    pub(crate) max: f64,
    pub(crate) n: usize,
}

/// Measures an index; `warmup` batches are taken before the clock starts.
pub(crate) fn measure(
    index: &Index,
    place: &Place,
    warmup: u64,
    with_decode_only: bool,
    stop: &AtomicBool,
) -> Result<BenchReport, ServeError> {
    let is_cached = index.config.cache;
    let shape = *index.layout().shape();
    let measured = stream(index, place, warmup, stop)?;
    let clips_per_s = measured.clips as f64 / measured.seconds;
    let decode_only = match with_decode_only && !is_cached {
        true => Some(decode_only(index)?),
        false => None,
    };
    let memcpy = memcpy_only(index);
    let frames = (shape.frames * shape.views) as f64;
    let numbers = shape.frames * (4 * shape.action_width + 5 * shape.state_width + 1 + shape.views);
    let pixels = shape.frames * shape.views * shape.frame_bytes();
    Ok(BenchReport {
        source: if is_cached { "cache" } else { "files" },
        loaders: index.config.loaders,
        threads_per_loader: index.config.threads,
        clips_per_batch: shape.clips,
        slot_bytes: index.layout().total_bytes(),
        batches: measured.batches,
        seconds: measured.seconds,
        clips_per_s,
        frames_per_s: clips_per_s * frames,
        pixels_gb_per_s: clips_per_s * pixels as f64 / 1e9,
        cpu_s: measured.cpu_s,
        decode_only_clips_per_s: decode_only,
        share_of_decode_only: decode_only.map(|rate| clips_per_s / rate),
        memcpy_clips_per_s: memcpy,
        share_of_memcpy: clips_per_s / memcpy,
        bytes_copied_per_clip: numbers + if is_cached { pixels } else { 0 },
        bytes_copied_to_view: 0,
        mean_queue_depth: measured.queued as f64 / measured.published.max(1) as f64,
        queued_to_view_us: measured.latency,
        rss_anon_bytes: status_kib("RssAnon:").map(|kib| kib * 1024),
    })
}

struct Streamed {
    batches: u64,
    clips: u64,
    seconds: f64,
    cpu_s: f64,
    published: u64,
    queued: u64,
    latency: Quantiles,
}

/// Runs the loaders against a consumer in this process.
fn stream(index: &Index, place: &Place, warmup: u64, stop: &AtomicBool) -> Result<Streamed, ServeError> {
    let service = format!("bench-{}", std::process::id());
    let deadline = || Instant::now() + PATIENCE;
    let claim = Claim::take(place, &service, deadline())?;
    let loaders = index.config.loaders;
    let subscribers = (0..loaders).map(|loader| claim.subscribe(loader, loaders, deadline()));
    let mut subscribers: Vec<Subscriber> = subscribers.collect::<Result<_, _>>()?;
    thread::scope(|scope| {
        let run = |loader: u32| {
            let service = service.clone();
            move || -> Result<ServeReport, ServeError> {
                let cache = open_cache(index, stop)?;
                let maker = BatchMaker::new(index, cache, loader, loaders)?;
                let place = place.clone();
                let options =
                    ServeOptions { place, service, token: None, loader, loaders, start: 0, wait: PATIENCE };
                serve(index, &maker, &options, stop)
            }
        };
        let threads: Vec<_> = (0..loaders).map(|loader| scope.spawn(run(loader))).collect();
        let consumed = consume(index, &mut subscribers, warmup);
        // Loaders that still run see that nobody listens.
        drop(subscribers);
        let mut report = ServeReport::default();
        for thread in threads {
            let part = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            report.batches += part.batches;
            report.queued += part.queued;
        }
        let mut streamed = consumed?;
        (streamed.published, streamed.queued) = (report.batches, report.queued);
        Ok(streamed)
    })
}

fn open_cache(index: &Index, stop: &AtomicBool) -> Result<Option<Cache>, LoadError> {
    match index.config.cache {
        true => CachePlan::of(index).open_or_make(index, stop, &|_| {}).map(Some),
        false => Ok(None),
    }
}

fn consume(index: &Index, subscribers: &mut [Subscriber], warmup: u64) -> Result<Streamed, ServeError> {
    let batches = index.hello().sequence.batches();
    let end = batches.saturating_sub(LATENCY_BATCHES).max(warmup);
    let mut start = (Instant::now(), cpu_s());
    let mut clips = 0;
    for n in 0..end {
        if n == warmup {
            start = (Instant::now(), cpu_s());
            clips = 0;
        }
        let subscriber = &mut subscribers[(n % u64::from(index.config.loaders)) as usize];
        let slot = subscriber.next(n, Instant::now() + PATIENCE)?;
        clips += slot.header().clips as u64;
        look_at(&slot);
    }
    let (seconds, cpu_s) = (start.0.elapsed().as_secs_f64(), cpu_s() - start.1);
    let mut times_us = Vec::new();
    for n in end..batches {
        let subscriber = &mut subscribers[(n % u64::from(index.config.loaders)) as usize];
        let patience = Instant::now() + PATIENCE;
        while !subscriber.is_queued()? && Instant::now() < patience {
            thread::yield_now();
        }
        let asked = Instant::now();
        let slot = subscriber.next(n, asked + PATIENCE)?;
        black_box(slot.view().map_err(LoadError::Batch)?);
        times_us.push(asked.elapsed().as_secs_f64() * 1e6);
    }
    let (batches, latency) = (end - warmup.min(end), quantiles(times_us));
    Ok(Streamed { batches, clips, seconds, cpu_s, published: 0, queued: 0, latency })
}

/// Reads one byte of every page, so that what is measured has been seen by the consumer.
fn look_at(slot: &Slot) {
    black_box(slot.iter().step_by(PAGE_BYTES).fold(0_u64, |sum, byte| sum + u64::from(*byte)));
}

fn quantiles(mut values: Vec<f64>) -> Quantiles {
    values.sort_by(f64::total_cmp);
    let at = |share: f64| {
        let last = values.len().saturating_sub(1);
        values.get((share * last as f64).round() as usize).copied().unwrap_or(0.0)
    };
    Quantiles { p50: at(0.5), p99: at(0.99), max: at(1.0), n: values.len() }
}

/// Decodes the frames of the first batches over and over, their bytes already in memory.
fn decode_only(index: &Index) -> Result<f64, LoadError> {
    let shape = *index.layout().shape();
    let per_clip = shape.frames * shape.views;
    let mut held: Vec<Vec<u8>> = Vec::new();
    let mut page = Vec::new();
    let n_clips = (MAX_HELD_FRAMES / per_clip).max(1);
    for n in 0..index.hello().sequence.batches() {
        let batch = index.hello().sequence.batch(n).expect("n is below the number of batches");
        for id in index.clips_of(batch) {
            if held.len() / per_clip >= n_clips {
                break;
            }
            let (dataset, first) = clips::parts(id);
            for at in 0..per_clip {
                let row = first + (at / shape.views * index.config.frameskip) as u64;
                held.push(index.sources[dataset].frames.read(at % shape.views, row, &mut page)?.to_vec());
            }
        }
    }
    let cameras = index.cameras();
    let threads = index.config.loaders as usize * index.config.threads;
    let part = |thread: usize| -> Result<(usize, f64), LoadError> {
        let mut out =
            vec![0; cameras.iter().map(|c| (c.spec.width * c.spec.height * 3) as usize).max().unwrap_or(0)];
        let start = Instant::now();
        let (mut clips, mut at) = (0, thread);
        while start.elapsed() < RATE_TIME {
            for i in 0..per_clip {
                let spec = &cameras[i % shape.views].spec;
                let bytes = &held[(at * per_clip + i) % held.len()];
                let size = (spec.width * spec.height * 3) as usize;
                let decoded = decode_rgb_into(bytes, spec.width, spec.height, &mut out[..size]);
                decoded.map_err(|source| LoadError::Frame {
                    path: index.sources[0].path.clone(),
                    camera: cameras[i % shape.views].name.clone(),
                    row: 0,
                    source,
                })?;
                black_box(&mut out);
            }
            (clips, at) = (clips + 1, at + threads);
        }
        Ok((clips, start.elapsed().as_secs_f64()))
    };
    on_threads(threads, part)
}

/// Copies as many bytes as a clip's frames have, from a large buffer to a clip's place in another.
fn memcpy_only(index: &Index) -> f64 {
    let shape = *index.layout().shape();
    let clip = shape.frames * shape.views * shape.frame_bytes();
    let threads = index.config.loaders as usize * index.config.threads;
    let copies = (COPY_BYTES / clip).clamp(1, shape.clips.max(1));
    let part = |_thread: usize| -> Result<(usize, f64), LoadError> {
        let source = vec![1_u8; copies * clip];
        let mut target = vec![2_u8; copies * clip];
        let start = Instant::now();
        let mut clips = 0;
        while start.elapsed() < RATE_TIME {
            for (from, to) in source.chunks_exact(clip).zip(target.chunks_exact_mut(clip)) {
                to.copy_from_slice(from);
                black_box(to);
                clips += 1;
            }
        }
        Ok((clips, start.elapsed().as_secs_f64()))
    };
    on_threads(threads, part).unwrap_or(0.0)
}

/// Returns the clips per second of all threads together.
fn on_threads(
    threads: usize,
    part: impl Fn(usize) -> Result<(usize, f64), LoadError> + Sync,
) -> Result<f64, LoadError> {
    thread::scope(|scope| {
        let part = &part;
        let running: Vec<_> = (0..threads).map(|i| scope.spawn(move || part(i))).collect();
        let mut rate = 0.0;
        for thread in running {
            let (clips, seconds) = thread.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
            rate += clips as f64 / seconds;
        }
        Ok(rate)
    })
}

/// Returns user and system time of this process in seconds.
fn cpu_s() -> f64 {
    // Fields 14 and 15 of /proc/self/stat, in ticks of 10 ms; the name before them may hold spaces.
    let stat = std::fs::read_to_string("/proc/self/stat").unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or("").split_whitespace().collect();
    let ticks = |at: usize| fields.get(at).and_then(|field| field.parse::<f64>().ok()).unwrap_or(0.0);
    (ticks(11) + ticks(12)) / 100.0
}

/// Returns a line of /proc/self/status in KiB.
fn status_kib(name: &str) -> Option<u64> {
    let status = std::fs::read_to_string("/proc/self/status").ok()?;
    let line = status.lines().find_map(|line| line.strip_prefix(name))?;
    line.split_whitespace().next()?.parse().ok()
}
