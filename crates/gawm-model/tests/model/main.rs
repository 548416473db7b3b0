//! Tests of the model as its users see it, on small models and noise.

mod checkpoints;
mod fixture;
mod gradients;
mod objectives;
mod training;
