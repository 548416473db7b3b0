//! Raw robot and simulator logs to datasets.

pub mod tabular;
