//! Raw robot and simulator logs to datasets.
#![forbid(unsafe_code)]

pub mod align;
pub mod contract;
pub mod log;
