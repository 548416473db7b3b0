//! The kernels against naive references in f64 and finite differences, at every level of instructions.
#![expect(clippy::unwrap_used, reason = "a test ends where its helper does")]

mod attention;
mod gemm;
mod linear;
mod pointwise;
mod reference;
mod vit;
