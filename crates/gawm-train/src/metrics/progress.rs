//! The line of progress on a terminal.

use indicatif::{ProgressBar, ProgressDrawTarget, ProgressStyle};

/// A bar with rate and time left on stderr; nothing if stderr is no terminal.
#[derive(Debug)]
pub struct Progress {
    bar: ProgressBar,
    quiet: bool,
}

impl Progress {
    /// Starts at `step` of `steps`.
    pub fn new(step: u64, steps: u64, quiet: bool) -> Progress {
        let target = if quiet { ProgressDrawTarget::hidden() } else { ProgressDrawTarget::stderr_with_hz(4) };
        let bar = ProgressBar::with_draw_target(Some(steps), target);
        let style = "{bar:24} {pos}/{len} steps  {per_sec}  {eta} left  {msg}";
        bar.set_style(ProgressStyle::with_template(style).expect("the template is a constant that parses"));
        bar.set_position(step);
        bar.reset_eta();
        Progress { bar, quiet }
    }

    /// A step was taken.
    pub fn step(&self, total: f32) {
        self.bar.inc(1);
        self.bar.set_message(format!("loss {total:.4}"));
    }

    /// Says something above the bar, also where there is no bar; not when asked to be quiet.
    pub fn say(&self, text: &str) {
        if self.quiet {
            return;
        }
        if self.bar.is_hidden() {
            eprintln!("{text}");
        } else {
            self.bar.println(text);
        }
    }

    /// Removes the bar.
    pub fn finish(&self) {
        self.bar.finish_and_clear();
    }
}

impl Drop for Progress {
    fn drop(&mut self) {
        // An error message must not stand behind half a bar.
        self.finish();
    }
}
