//! Raw robot and simulator logs to datasets.
