//! Fused operations with exact backward: pure slice functions under thin candle adapters.
#![deny(unsafe_op_in_unsafe_fn)]

mod simd;

pub mod adamw;
pub mod attention;
pub mod gelu;
pub mod gemm;
pub mod linear;
pub mod norm;
pub mod pixels;
pub mod profile;
pub mod rollout;
pub mod vit;

mod adapter;
pub mod memory;

pub use adapter::{GradientSink, VitEncoder};
pub use simd::{Level, detect, level, limit_level};
