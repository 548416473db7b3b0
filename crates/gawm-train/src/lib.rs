//! The training loop: schedule, clipping, resume, metrics, loader processes.

#![forbid(unsafe_code)]
