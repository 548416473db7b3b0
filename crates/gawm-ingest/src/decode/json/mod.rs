//! JSON payloads: a scanner that reads what a plan asks for and steps over the rest, without a tree of values.

pub(crate) mod node;
pub(crate) mod run;
pub(crate) mod scan;
pub(crate) mod whole;
