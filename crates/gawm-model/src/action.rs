//! The action embedder: one vector per action chunk.

use candle_core::Tensor;

use crate::Result;
use crate::config::Architecture;
use crate::layers::{Linear, silu};
use crate::parameters::{Init, Parameters, Specs, weight};
use crate::pass::Pass;

/// `Linear(A -> bottleneck) -> Linear -> SiLU -> Linear(-> D)`; the first layer has no nonlinearity, as published.
#[derive(Debug, Clone)]
pub struct ActionEmbedder {
    patch_embed: Linear,
    expand: Linear,
    contract: Linear,
}

impl ActionEmbedder {
    /// Hidden width over latent width.
    const MLP_SCALE: usize = 4;

    /// Adds the tensors under `action_encoder`.
    pub fn specs(specs: &mut Specs, architecture: &Architecture) {
        let (actions, bottleneck) = (architecture.widths().action, architecture.config().action_bottleneck);
        let latent = architecture.config().latent_width;
        let init = Init::Uniform { bound: 1.0 / (actions as f64).sqrt() };
        weight(specs, "action_encoder.patch_embed.weight".to_owned(), &[bottleneck, actions, 1], init);
        weight(specs, "action_encoder.patch_embed.bias".to_owned(), &[bottleneck], init);
        Linear::specs(specs, "action_encoder.embed.0", bottleneck, ActionEmbedder::MLP_SCALE * latent);
        Linear::specs(specs, "action_encoder.embed.2", ActionEmbedder::MLP_SCALE * latent, latent);
    }

    /// Takes the tensors under `action_encoder` from the store.
    pub fn load(parameters: &Parameters) -> Result<ActionEmbedder> {
        // Published as a convolution with kernel 1, which is a linear map of each step.
        let kernel = parameters.get("action_encoder.patch_embed.weight")?.squeeze(2)?; // [bottleneck, A]
        let bias = parameters.get("action_encoder.patch_embed.bias")?;
        Ok(ActionEmbedder {
            patch_embed: Linear::new(kernel, Some(bias)),
            expand: Linear::load(parameters, "action_encoder.embed.0")?,
            contract: Linear::load(parameters, "action_encoder.embed.2")?,
        })
    }

    /// Embeds standardised chunks: [B, T, A] to [B, T, D].
    pub fn forward(&self, actions: &Tensor, pass: &Pass) -> Result<Tensor> {
        let x = self.patch_embed.forward(actions, pass)?; // [B, T, bottleneck]
        self.contract.forward(&silu(&self.expand.forward(&x, pass)?)?, pass) // [B, T, D]
    }
}
