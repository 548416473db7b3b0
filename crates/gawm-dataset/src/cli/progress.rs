//! Bars on standard error for long work; nothing when it is no terminal, or when quiet.

use std::io::IsTerminal;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// How often rows that others count are looked at.
const INTERVAL: Duration = Duration::from_millis(100);

/// Returns whether bars are drawn.
fn is_shown(quiet: bool) -> bool {
    !quiet && std::io::stderr().is_terminal()
}

/// A bar over a known number of rows.
pub(super) fn bar(quiet: bool, what: &'static str, n_rows: u64) -> ProgressBar {
    if !is_shown(quiet) {
        return ProgressBar::hidden();
    }
    let bar = ProgressBar::with_draw_target(Some(n_rows), ProgressDrawTarget::stderr_with_hz(10));
    let style = ProgressStyle::with_template("{msg} [{wide_bar}] {human_pos}/{human_len} rows, {eta} left");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()).progress_chars("=> "));
    bar.set_message(what);
    bar
}

/// Shows how many rows have been read, until it is dropped.
pub(super) struct RowCounter {
    bar: ProgressBar,
    is_done: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Watches a counter of rows; passes over the data may be several.
pub(super) fn watch(quiet: bool, what: &'static str, rows: &Arc<AtomicU64>) -> RowCounter {
    let is_done = Arc::new(AtomicBool::new(false));
    if !is_shown(quiet) {
        return RowCounter { bar: ProgressBar::hidden(), is_done, thread: None };
    }
    let bar = ProgressBar::with_draw_target(None, ProgressDrawTarget::stderr_with_hz(10));
    let style = ProgressStyle::with_template("{spinner} {msg}: {human_pos} rows read, {elapsed}");
    bar.set_style(style.unwrap_or_else(|_| ProgressStyle::default_spinner()));
    bar.set_message(what);
    let (rows, shown, done) = (Arc::clone(rows), bar.clone(), Arc::clone(&is_done));
    let thread = std::thread::spawn(move || {
        while !done.load(Ordering::Relaxed) {
            shown.set_position(rows.load(Ordering::Relaxed));
            shown.tick();
            std::thread::park_timeout(INTERVAL);
        }
    });
    RowCounter { bar, is_done, thread: Some(thread) }
}

impl Drop for RowCounter {
    fn drop(&mut self) {
        self.is_done.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            thread.thread().unpark();
            thread.join().ok(); // It only draws.
        }
        self.bar.finish_and_clear();
    }
}
