//! Training windows that survive: those that touch no bad row.

use serde::Serialize;

/// How many windows of consecutive rows can be used for training.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct WindowYield {
    /// Rows of a window.
    pub rows_per_window: u64,
    /// Windows that lie inside an episode.
    pub windows: u64,
    /// Windows without a value that is not finite or not valid.
    pub surviving: u64,
    /// Surviving windows, as a share of the rows: what boundaries and bad rows leave.
    pub share_of_rows: f64,
}

/// Counts the windows of `n` rows in one episode, and those without a bad row.
pub(super) fn count(bad: &[bool], n: usize) -> (u64, u64) {
    if n == 0 || bad.len() < n {
        return (0, 0);
    }
    let (mut since_bad, mut good) = (0usize, 0u64);
    for is_bad in bad {
        since_bad = if *is_bad { 0 } else { since_bad + 1 };
        good += u64::from(since_bad >= n);
    }
    ((bad.len() + 1 - n) as u64, good)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn windows_avoid_bad_rows_and_boundaries() {
        assert_eq!(count(&[false; 10], 4), (7, 7));
        let mut bad = [false; 10];
        bad[5] = true;
        assert_eq!(count(&bad, 4), (7, 3));
        assert_eq!(count(&[false; 3], 4), (0, 0));
    }
}
