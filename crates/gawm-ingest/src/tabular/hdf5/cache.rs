//! The chunks that were decoded last.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex, PoisonError};

/// A decoded chunk: its dataset, its place in the grid, its bytes.
type Kept = (u64, u64, Arc<Vec<u8>>);

/// Decoded chunks of filters that cannot be undone in part, so that the next row does not inflate again.
pub(crate) struct ChunkCache {
    /// Newest last.
    kept: Mutex<VecDeque<Kept>>,
    max_bytes: u64,
}

impl ChunkCache {
    /// Makes an empty cache.
    pub(crate) fn new(max_bytes: u64) -> Self {
        Self { kept: Mutex::new(VecDeque::new()), max_bytes }
    }

    /// Returns a chunk that is kept.
    pub(crate) fn get(&self, dataset: u64, place: u64) -> Option<Arc<Vec<u8>>> {
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        let at = kept.iter().rposition(|(d, p, _)| (*d, *p) == (dataset, place))?;
        let found = kept.remove(at)?;
        let data = Arc::clone(&found.2);
        kept.push_back(found);
        Some(data)
    }

    /// Keeps a chunk and lets go of the ones unused longest.
    pub(crate) fn insert(&self, dataset: u64, place: u64, data: Vec<u8>) -> Arc<Vec<u8>> {
        let data = Arc::new(data);
        let mut kept = self.kept.lock().unwrap_or_else(PoisonError::into_inner);
        kept.push_back((dataset, place, Arc::clone(&data)));
        let mut bytes: u64 = kept.iter().map(|(_, _, d)| d.len() as u64).sum();
        while bytes > self.max_bytes {
            let Some((_, _, oldest)) = kept.pop_front() else { break };
            bytes -= oldest.len() as u64;
        }
        data
    }
}
