//! The kernels against naive references in f64 and finite differences, at every level of instructions.
#![expect(clippy::unwrap_used, reason = "a test ends where its helper does")]

mod attention;
mod composed;
mod gemm;
mod head;
mod linear;
mod pairs;
mod pointwise;
mod predictor;
mod reference;
mod vit;
