//! CDR (XCDR1) and ROS 1 payloads: programs compiled from a definition, and the machine that runs them.

pub(crate) mod program;
pub(crate) mod reader;
pub(crate) mod run;
pub(crate) mod whole;
