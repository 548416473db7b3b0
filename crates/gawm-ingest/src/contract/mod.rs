//! The contract: how topics of a log become columns, rows and episodes.
//!
//! [`Contract`] is what is written (TOML); [`CheckedContract`] is what it means: defaults filled in, times in
//! nanoseconds, units resolved, every rule that needs no log checked.

mod check;
mod error;
mod load;
mod pattern;
mod spec;
mod task;

pub use check::{
    CheckedContract, CheckedStream, Clock, EpisodeRule, ImageRule, StreamData, TickRule, VectorRule, check,
};
pub use error::ContractError;
pub use load::{load, parse, to_toml};
pub use pattern::TopicPattern;
pub use spec::{
    ActionSpec, ActionTimingSpec, AlignSpec, CalibrationSpec, CaptureLabel, Causal, ColumnLabel, Contract,
    DeltaFrame, DerivedSpec, EpisodeSource, EpisodesSpec, GapRule, ImageFormat, ImageSpec, KindSpec,
    LabelSource, LabelsSpec, MarkerValue, MetadataLabel, NonFiniteRule, ReduceSpec, RoleSpec, SplitSpec,
    StreamSpec, TickMode, TicksSpec, TimeUnit, TopicLabel,
};
pub use task::{StateTarget, TargetName, TaskSchema, TaskSchemaSpec};
