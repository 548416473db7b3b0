//! Tests of the model as its users see it, on small models and noise.
#![expect(clippy::unwrap_used, reason = "a test ends where its helper does")]

mod checkpoints;
mod fixture;
mod gradients;
mod objectives;
mod shapes;
mod training;
