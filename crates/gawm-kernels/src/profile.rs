//! Where the time goes: nanoseconds and floating-point operations per kind of operation, over all threads.
//!
//! Off unless [`start`] was called; then a span costs two readings of the thread's CPU clock (of the monotonic clock where
//! there is none), so that waiting for a core on a busy machine is not counted.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

/// A kind of operation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[non_exhaustive]
pub enum Kind {
    /// Copying pixels into rows of patches.
    Patches,
    /// Arranging weights for products.
    Packing,
    /// Products of linear layers, forward.
    LinearForward,
    /// Products that give gradients of inputs.
    LinearInputGradient,
    /// Products that give gradients of weights.
    LinearWeightGradient,
    /// Attention, forward.
    AttentionForward,
    /// Attention, backward.
    AttentionBackward,
    /// Layer norms, both directions.
    Norm,
    /// GELU, both directions.
    Gelu,
    /// Gates, dropout, SiLU and positions of the predictor.
    Pointwise,
    /// Sums over rows: gradients of biases and of the position table.
    ColumnSums,
    /// Adding up the gradients of groups of images.
    Reduction,
    /// Clipping and AdamW.
    Optimizer,
}

/// All kinds, in the order of the report.
pub const KINDS: [Kind; 13] = [
    Kind::Patches,
    Kind::Packing,
    Kind::LinearForward,
    Kind::LinearInputGradient,
    Kind::LinearWeightGradient,
    Kind::AttentionForward,
    Kind::AttentionBackward,
    Kind::Norm,
    Kind::Gelu,
    Kind::Pointwise,
    Kind::ColumnSums,
    Kind::Reduction,
    Kind::Optimizer,
];

static ON: AtomicBool = AtomicBool::new(false);
static NANOSECONDS: [AtomicU64; KINDS.len()] = [const { AtomicU64::new(0) }; KINDS.len()];
static OPERATIONS: [AtomicU64; KINDS.len()] = [const { AtomicU64::new(0) }; KINDS.len()];

/// What one kind of operation took since [`start`], over all threads.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Share {
    /// The kind.
    pub kind: Kind,
    /// CPU time inside its spans, seconds, summed over threads.
    pub secs: f64,
    /// Floating-point operations counted (products only), in units of 10^9.
    pub gflop: f64,
}

/// Forgets what was counted and begins to count.
pub fn start() {
    for counter in NANOSECONDS.iter().chain(&OPERATIONS) {
        counter.store(0, Ordering::Relaxed);
    }
    ON.store(true, Ordering::Relaxed);
}

/// Stops counting and returns the shares, in the order of [`KINDS`].
pub fn stop() -> Vec<Share> {
    ON.store(false, Ordering::Relaxed);
    let read = |counter: &AtomicU64| counter.load(Ordering::Relaxed) as f64 * 1e-9;
    let counters = NANOSECONDS.iter().zip(&OPERATIONS);
    KINDS
        .iter()
        .zip(counters)
        .map(|(&kind, (time, work))| Share { kind, secs: read(time), gflop: read(work) })
        .collect()
}

/// Runs `work` and counts its time, and `operations` floating-point operations, under `kind`.
#[inline]
pub(crate) fn span<T>(kind: Kind, operations: usize, work: impl FnOnce() -> T) -> T {
    if !ON.load(Ordering::Relaxed) {
        return work();
    }
    let start = thread_nanoseconds();
    let result = work();
    let elapsed = thread_nanoseconds().saturating_sub(start);
    NANOSECONDS[kind as usize].fetch_add(elapsed, Ordering::Relaxed);
    OPERATIONS[kind as usize].fetch_add(operations as u64, Ordering::Relaxed);
    result
}

/// CPU time of this thread.
#[cfg(target_os = "linux")]
fn thread_nanoseconds() -> u64 {
    let mut time = libc::timespec { tv_sec: 0, tv_nsec: 0 };
    // SAFETY: the pointer is to a valid timespec, which the call fills; a failed call leaves it zero.
    unsafe { libc::clock_gettime(libc::CLOCK_THREAD_CPUTIME_ID, &raw mut time) };
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Time since the first call.
#[cfg(not(target_os = "linux"))]
fn thread_nanoseconds() -> u64 {
    static START: std::sync::OnceLock<std::time::Instant> = std::sync::OnceLock::new();
    START.get_or_init(std::time::Instant::now).elapsed().as_nanos() as u64
}
