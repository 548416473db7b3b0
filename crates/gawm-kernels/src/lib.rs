//! Fused operations with exact backward: pure slice functions under thin candle adapters.
//!
//! candle's element-wise operations run on one thread, allocate afresh each time, and add every gradient to a zeroed
//! tensor first. This crate replaces what a training step and a plan spend their time in, on CPUs in f32:
//!
//! | what | slices | candle |
//! |---|---|---|
//! | transformer from frames to class tokens | [`vit::Vit`] | [`VitEncoder`] |
//! | latents under actions, for planners | [`rollout::Rollout`] | [`rollout::Roller`] |
//! | predictor in training | [`predictor::PredictorShape`] | [`predictor::Predictor`] |
//! | projectors and heads | [`head::HeadShape`] | [`head::Head`] |
//! | linear layers | [`linear::LinearShape`] | [`linear::linear`] |
//! | AdamW with clipping | [`adamw::update`] | [`adamw::adamw`], [`adamw::squared_norm`] |
//! | bytes to standardised planes | | [`pixels::standardize`] |
//!
//! They are made of [`gemm`], [`attention`], [`norm`] and [`gelu`]. `gawm-model` calls them where a composed expression
//! stood; that expression stays for other devices, and is what tests compare with. Operands of the transformer's linear
//! layers may be rounded to bf16 ([`pairs`], [`vit::Products`]).
//!
//! # Decision: parallel over data, not over operations
//!
//! A thread takes some images (or sequences) through all layers while their values stay in the cache of its core, so that
//! threads meet once per pass and not once per operation, and products run at the speed of the first caches. The price is
//! that gradients of weights are summed per group of images first.
//!
//! **Invariant**: no result depends on the number of threads. Sums that cross threads are split at fixed places and added
//! up in order. Results do depend on the [`Level`] of instructions, in their last bits.
#![deny(unsafe_op_in_unsafe_fn)]

mod simd;

pub mod profile;

pub mod gemm;
mod pack;
pub mod pairs;
mod vector;

pub mod attention;
pub mod gelu;
pub mod norm;

pub mod vit;

mod adapter;

pub mod adamw;
pub mod head;
pub mod linear;
pub mod pixels;
pub mod predictor;
pub mod rollout;
mod rows;

pub use adapter::{GradientSink, VitEncoder};
pub use simd::{Level, detect, level, limit_level};
