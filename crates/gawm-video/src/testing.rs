//! The videos of `fixtures/`, for tests of what reads videos.

use std::path::PathBuf;
use std::{fs, io};

/// Returns the path of a fixture.
pub fn fixture(name: &str) -> PathBuf {
    PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("fixtures").join(name)
}

/// Returns the number that is drawn into a frame of `width` pixels; `rgb` are its rows.
pub fn number_of(width: usize, rgb: &[u8]) -> usize {
    (0..5).filter(|bit| rgb[(10 * width + bit * 12 + 6) * 3] > 128).map(|bit| 1 << bit).sum()
}

/// Returns the packets of `packets.h264`, which begin with access unit delimiters.
///
/// # Errors
/// The file cannot be read.
pub fn packets() -> io::Result<Vec<Vec<u8>>> {
    let bytes = fs::read(fixture("packets.h264"))?;
    let starts: Vec<usize> =
        (0..bytes.len() - 5).filter(|&at| bytes[at..at + 5] == [0, 0, 0, 1, 9]).collect();
    let ends = starts.iter().skip(1).copied().chain([bytes.len()]);
    Ok(starts.iter().zip(ends).map(|(start, end)| bytes[*start..end].to_vec()).collect())
}
