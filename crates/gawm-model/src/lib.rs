//! The world model in candle: encoder, predictor, heads, objectives, optimiser, planner, checkpoints.
//!
//! A [`WorldModel`] maps frames and action chunks to latents and predicts the latents that follow. An [`Architecture`]
//! (checked sizes, made from a [`ModelConfig`]) says how it is built, [`Parameters`] hold its weights under the names of
//! the published `state_dict`, [`losses`] turns a batch of [`Clips`] into one weighted table of terms, [`AdamW`] updates
//! the parameters, [`plan`] searches action sequences in latent space, [`checkpoint`] keeps it all on disk.
//!
//! ```text
//! frames  [B, T, C, H, W] --encoder--> CLS [B*T, W] --projector--> z [B, T, D]
//! actions [B, T, A]       --action embedder---------------------> c [B, T, D]
//! z[:, ..T-1], c[:, ..T-1] --predictor--> [B, T-1, D] --pred_proj--> z_hat, compared with z[:, 1..]
//! (z[t-1], z[t]) --G--> state [B, T, S]         (z[t], z[t+1]) --H--> action [B, T-1, A]
//! ```
//!
//! # Shapes
//!
//! | letter | meaning | letter | meaning |
//! |---|---|---|---|
//! | `B` | clips in a batch | `W` | width of the encoder (in `[.., H, W]`: columns of pixels) |
//! | `T` | frames in a clip | `N` | samples of a planner, or images where no clip is left |
//! | `C, H, W` | channels, rows, columns of a frame | `K` | elites |
//! | `P` | patches of a frame | `L` | planning horizon in chunks |
//! | `D` | width of a latent | `S` | width of a state target |
//! | `A` | width of an action chunk (frameskip x raw action) | `E` | environments planned together |
//!
//! All tensors are f32 unless their documentation says otherwise. A line that changes a shape ends with the new one.
//!
//! # Decision: composed from differentiable primitives
//!
//! candle's fused layer norm, softmax and rotary have no backward pass and *silently* end the gradient; its `gelu` is the
//! tanh form; its random numbers on the CPU cannot be seeded; its AdamW neither clips nor shows its state. Everything of
//! that kind is therefore in this crate, in plain operations (`docs/model.md` lists them). Speed comes from
//! `gawm-kernels`, which stands in for the encoder, linear layers, the roll-out of a plan and the optimiser on CPUs in f32
//! and must agree with the plain operations.
//!
//! **Invariant**: a forward pass is a function of parameters, inputs and a [`Pass`]; nothing else decides a number.
//!
//! ```
//! use gawm_model::{Device, ModelConfig, Pass, Tensor, WorldModel};
//!
//! let architecture = ModelConfig::preset("micro")?.resolve(gawm_model::DataWidths { action: 4, state: 2 })?;
//! let model = WorldModel::new(architecture, 7, &Device::Cpu)?;
//! let frames = Tensor::zeros((1, 4, 3, 16, 16), gawm_model::DType::F32, &Device::Cpu)?;
//! let z = model.encode(&frames, &Pass::eval())?; // [B, T, D]
//! assert_eq!(z.dims(), [1, 4, 16]);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
#![forbid(unsafe_code)]

mod config;
mod pass;
mod random;

mod parameters;

pub mod layers;
mod position;

mod encoder;
mod projector;

mod action;
mod predictor;

mod heads;

mod frames;
mod model;

pub mod objective;

mod optimizer;
mod schedule;

pub mod plan;

pub mod diagnostics;

pub mod checkpoint;

pub mod golden;

/// A result whose error is candle's unless stated.
pub type Result<T, E = candle_core::Error> = std::result::Result<T, E>;

pub use candle_core::{DType, Device, Tensor};

pub use action::ActionEmbedder;
pub use config::{
    Architecture, ConfigError, DataWidths, EncoderConfig, InverseInput, ModelConfig, PRESETS, PredictorConfig,
};
pub use encoder::{Encoder, Vit};
pub use frames::{IMAGE_MEAN, IMAGE_STD, standardize_frames};
pub use heads::{InverseDynamics, StateProbe};
pub use model::WorldModel;
pub use objective::{Clips, Control, Losses, Objectives, Term, latent_losses, losses};
pub use optimizer::{AdamW, AdamWConfig, Decay, Gradients, OptimizerError, StepReport};
pub use parameters::{Init, ParameterError, ParameterSpec, Parameters, Specs};
pub use pass::{Pass, Precision};
pub use predictor::Predictor;
pub use projector::Projector;
pub use random::{Stream, permutation};
pub use schedule::WarmupCosine;
