//! Numbers and comparisons that the tests share.

use std::sync::Mutex;

use gawm_kernels::{Level, detect, limit_level};

/// Levels are a setting of the process, so that tests of all levels take turns.
static TURN: Mutex<()> = Mutex::new(());

/// Runs `check` at every level that this processor has.
pub(crate) fn at_all_levels(check: impl Fn()) {
    let _turn = TURN.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
    for level in [Level::Portable, Level::Avx2, Level::Avx512] {
        if level <= detect() {
            assert_eq!(limit_level(level), level);
            check();
        }
    }
}

/// `count` numbers in [-1, 1) that look random, the same for the same seed.
pub(crate) fn noise(seed: u64, count: usize) -> Vec<f32> {
    let mut state = seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) | 1;
    let mut next = || {
        state ^= state << 13;
        state ^= state >> 7;
        state ^= state << 17;
        (state >> 40) as f32 / (1u64 << 23) as f32 - 1.0
    };
    (0..8).for_each(|_| {
        next();
    });
    (0..count).map(|_| next()).collect()
}

/// Asserts that `got` is `expected` to within `allowed` times (1 + |expected|), and names the worst element.
pub(crate) fn assert_close(what: &str, got: &[f32], expected: &[f64], allowed: f64) {
    assert_eq!(got.len(), expected.len(), "{what}: length");
    let error =
        |index: usize| (f64::from(got[index]) - expected[index]).abs() / (1.0 + expected[index].abs());
    let Some(worst) = (0..got.len()).max_by(|&a, &b| error(a).total_cmp(&error(b))) else { return };
    let level = gawm_kernels::level();
    assert!(
        error(worst) <= allowed,
        "{what} at {level:?}, element {worst}: expected {}, got {} (error {:e} of {allowed:e})",
        expected[worst],
        got[worst],
        error(worst)
    );
}

pub(crate) fn wide(values: &[f32]) -> Vec<f64> {
    values.iter().copied().map(f64::from).collect()
}
