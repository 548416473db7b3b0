//! Raw robot and simulator logs to datasets.
#![forbid(unsafe_code)]

pub mod decode;
pub mod inspect;
pub mod log;
pub mod records;
pub mod tabular;
