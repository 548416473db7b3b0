//! What a run writes while it goes: JSON lines, TensorBoard event files, a line of progress.
//!
//! `metrics.jsonl` holds nothing but numbers that the run determines, so that two runs can be compared byte by byte.
//! Times of day and rates go to the event files and the terminal.

mod jsonl;
mod progress;
mod record;
mod tensorboard;

pub use jsonl::{MetricsError, MetricsLog, read};
pub use progress::Progress;
pub use record::{Baseline, DimReport, Record, TermValue, TrainRecord, ValidationRecord};
pub use tensorboard::{EventFile, scalars_of};
