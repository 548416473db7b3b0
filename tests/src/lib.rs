//! End-to-end tests that spawn the real programs; see `tests/`.
