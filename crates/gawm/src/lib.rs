//! The front door: every program in one binary, pipelines, and a quickstart.

#![forbid(unsafe_code)]
