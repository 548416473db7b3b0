//! Raw robot and simulator logs to datasets.
#![forbid(unsafe_code)]

pub mod align;
pub mod cli;
pub mod contract;
pub mod decode;
pub mod episodes;
pub mod explain;
pub mod inspect;
pub mod lerobot;
pub mod log;
pub mod records;
mod rows;
pub mod run;
pub mod suggest;
pub mod tabular;
mod video;
