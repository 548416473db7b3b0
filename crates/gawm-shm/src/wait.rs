//! Waiting by polling.

use std::thread;
use std::time::{Duration, Instant};

/// Polls that only give the processor away: whoever is about to answer usually does so by then.
const YIELDS: u32 = 32;
/// First and longest pause. A batch takes milliseconds to make; a pause of 1 ms costs the waiter about 1 % of a core.
const FIRST_PAUSE: Duration = Duration::from_micros(50);
const LONGEST_PAUSE: Duration = Duration::from_millis(1);

/// A wait that ends at a deadline.
pub(crate) struct Wait {
    start: Instant,
    deadline: Instant,
    polls: u32,
    pause: Duration,
}

impl Wait {
    pub(crate) fn until(deadline: Instant) -> Wait {
        Wait { start: Instant::now(), deadline, polls: 0, pause: FIRST_PAUSE }
    }

    /// Returns how long it has lasted.
    pub(crate) fn waited(&self) -> Duration {
        self.start.elapsed()
    }

    /// Returns whether it has begun to pause, so that a system call per poll costs nothing.
    pub(crate) fn is_slow(&self) -> bool {
        self.polls >= YIELDS
    }

    /// Pauses; false when the deadline has passed.
    pub(crate) fn again(&mut self) -> bool {
        if self.polls < YIELDS {
            self.polls += 1;
            thread::yield_now();
            return true;
        }
        let now = Instant::now();
        if now >= self.deadline {
            return false;
        }
        thread::sleep(self.pause.min(self.deadline - now));
        self.pause = (self.pause * 2).min(LONGEST_PAUSE);
        true
    }
}
