//! Video files that are open, each read by one thread at a time, in order where the callers come in order.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

use super::file::VideoFile;
use super::{RgbFrame, VideoError};

/// Files that stay open; those that were not read for longest are closed.
const MAX_OPEN: usize = 32;

/// Video files that are read by several threads.
#[derive(Debug, Default)]
pub struct VideoLanes {
    lanes: Mutex<State>,
    changed: Condvar,
}

#[derive(Debug, Default)]
struct State {
    lanes: BTreeMap<PathBuf, Lane>,
    /// Counts calls, so that the lane that rested longest is known.
    clock: u64,
}

#[derive(Debug)]
struct Lane {
    /// Absent while a thread reads.
    file: Option<Box<VideoFile>>,
    is_busy: bool,
    used: u64,
}

impl VideoLanes {
    /// Reads the frames at these times, which rise; `take` gets each of them, or why there is none.
    pub fn read(
        &self,
        path: &Path,
        wanted_secs: &[f64],
        mut take: impl FnMut(usize, Result<RgbFrame, VideoError>),
    ) {
        let mut lane = self.check_out(path);
        for (at, wanted) in wanted_secs.iter().enumerate() {
            if lane.file.is_none() {
                match VideoFile::open(path) {
                    Ok(opened) => lane.file = Some(Box::new(opened)),
                    Err(error) => {
                        (at..wanted_secs.len()).for_each(|at| take(at, Err(error.clone())));
                        break;
                    }
                }
            }
            if let Some(file) = &mut lane.file {
                take(at, file.frame_at(*wanted));
            }
        }
    }

    fn lock(&self) -> MutexGuard<'_, State> {
        self.lanes.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes the open file, waiting while another thread reads it: what that thread reads lies before, mostly.
    fn check_out<'a>(&'a self, path: &'a Path) -> Borrowed<'a> {
        let mut state = self.lock();
        while state.lanes.get(path).is_some_and(|lane| lane.is_busy) {
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
        state.clock += 1;
        let used = state.clock;
        let lane = state.lanes.entry(path.to_owned()).or_insert(Lane { file: None, is_busy: false, used });
        (lane.is_busy, lane.used) = (true, used);
        let file = lane.file.take();
        if state.lanes.len() > MAX_OPEN {
            let resting = state.lanes.iter().filter(|(_, lane)| !lane.is_busy);
            let oldest = resting.min_by_key(|(_, lane)| lane.used).map(|(path, _)| path.clone());
            if let Some(oldest) = oldest {
                state.lanes.remove(&oldest);
            }
        }
        Borrowed { lanes: self, path, file }
    }
}

/// A file that one thread reads; given back when it is dropped, also by a panic.
struct Borrowed<'a> {
    lanes: &'a VideoLanes,
    path: &'a Path,
    file: Option<Box<VideoFile>>,
}

impl Drop for Borrowed<'_> {
    fn drop(&mut self) {
        let mut state = self.lanes.lock();
        if let Some(lane) = state.lanes.get_mut(self.path) {
            (lane.file, lane.is_busy) = (self.file.take(), false);
        }
        self.lanes.changed.notify_all();
    }
}
