//! Planners, the evaluation harness, diagnostics and figures.

#![forbid(unsafe_code)]
