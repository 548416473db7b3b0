//! The world model: modules joined, latents in and out.

use candle_core::{Device, Tensor};
use gawm_kernels::rollout::{Roller, RolloutShape, RolloutTensors};

use crate::Result;
use crate::action::ActionEmbedder;
use crate::config::Architecture;
use crate::encoder::{Encoder, Vit};
use crate::heads::{InverseDynamics, StateProbe};
use crate::parameters::{Parameters, Specs};
use crate::pass::Pass;
use crate::predictor::{BLOCK_PARTS, Predictor};
use crate::projector::Projector;

/// A world model: an encoder of frames, an embedder of actions, a predictor of latents, heads for training.
///
/// There is no target network, no stop-gradient and no moving average: all latents come from one encoder.
#[derive(Debug, Clone)]
pub struct WorldModel {
    architecture: Architecture,
    parameters: Parameters,
    encoder: Encoder,
    projector: Projector,
    action_encoder: ActionEmbedder,
    predictor: Predictor,
    pred_proj: Projector,
    state_probe: Option<StateProbe>,
    idm_head: Option<InverseDynamics>,
    roller: Roller,
}

impl WorldModel {
    /// Lists the tensors of an architecture, without allocating any.
    pub fn specs(architecture: &Architecture) -> Specs {
        let config = architecture.config();
        let latent = config.latent_width;
        let mut specs = Specs::new();
        Vit::specs(&mut specs, architecture);
        Projector::specs(&mut specs, "projector", config.encoder.width, config.projector_width, latent);
        ActionEmbedder::specs(&mut specs, architecture);
        Predictor::specs(&mut specs, architecture);
        Projector::specs(&mut specs, "pred_proj", latent, config.projector_width, latent);
        if config.state_head {
            StateProbe::specs(&mut specs, architecture);
        }
        if config.inverse_head {
            InverseDynamics::specs(&mut specs, architecture);
        }
        specs
    }

    /// Makes an untrained model, each tensor drawn from its own stream of `seed`.
    pub fn new(architecture: Architecture, seed: u64, device: &Device) -> Result<WorldModel> {
        let parameters = Parameters::init(&WorldModel::specs(&architecture), seed, device)?;
        WorldModel::with_parameters(architecture, parameters)
    }

    /// Makes a model of given parameters, sharing their storage.
    ///
    /// # Errors
    ///
    /// - if a tensor that the architecture needs is not in `parameters`.
    pub fn with_parameters(architecture: Architecture, parameters: Parameters) -> Result<WorldModel> {
        let config = architecture.config();
        let state_probe = if config.state_head { Some(StateProbe::load(&parameters)?) } else { None };
        let idm_head =
            if config.inverse_head { Some(InverseDynamics::load(&parameters, &architecture)?) } else { None };
        Ok(WorldModel {
            encoder: Encoder::Vit(Vit::load(&parameters, &architecture)?),
            projector: Projector::load(&parameters, "projector")?,
            action_encoder: ActionEmbedder::load(&parameters)?,
            predictor: Predictor::load(&parameters, &architecture)?,
            pred_proj: Projector::load(&parameters, "pred_proj")?,
            state_probe,
            idm_head,
            roller: roller(&parameters, &architecture)?,
            architecture,
            parameters,
        })
    }

    /// The sizes.
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// The tensors; changing them changes the model.
    pub fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    /// The frame encoder.
    pub fn encoder(&self) -> &Encoder {
        &self.encoder
    }

    /// Rolls latents forward by fused operations; [`rollout`](crate::plan::rollout) says when.
    pub(crate) fn roller(&self) -> &Roller {
        &self.roller
    }

    /// Encodes standardised frames to latents: [B, T, C, H, W] to [B, T, D].
    ///
    /// In training, batch norm sees all B x T rows at once.
    pub fn encode(&self, frames: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (b, t, c, h, w) = frames.dims5()?;
        let x = self.encoder.forward(&frames.reshape((b * t, c, h, w))?, pass)?; // [B*T, W']
        let z = self.projector.forward(&x, pass)?; // [B*T, D]
        z.reshape((b, t, ())) // [B, T, D]
    }

    /// Embeds standardised action chunks: [B, T, A] to [B, T, D].
    pub fn embed_actions(&self, actions: &Tensor, pass: &Pass) -> Result<Tensor> {
        self.action_encoder.forward(actions, pass)
    }

    /// Predicts the next latent of each frame from the latents and actions up to it.
    ///
    /// `z` and `c` have shape [B, T, D] with T up to the history; returns [B, T, D]; entry k stands for frame k + 1 and
    /// sees entries 0..=k only.
    pub fn predict(&self, z: &Tensor, c: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (b, t, d) = z.dims3()?;
        let x = self.predictor.forward(z, c, pass)?; // [B, T, D]
        self.pred_proj.forward(&x.reshape((b * t, d))?, pass)?.reshape((b, t, d)) // [B, T, D]
    }

    /// Reads the physical state of each frame from the latents (G): [B, T, D] to [B, T, S].
    ///
    /// # Errors
    ///
    /// - if the model has no such head.
    pub fn read_states(&self, z: &Tensor, pass: &Pass) -> Result<Tensor> {
        match &self.state_probe {
            Some(head) => head.forward(z, pass),
            None => candle_core::bail!("this model has no state head (model.state_head)"),
        }
    }

    /// Reads the chunk between consecutive frames from the latents (H): [B, T, D] to [B, T-1, A].
    ///
    /// # Errors
    ///
    /// - if the model has no such head.
    pub fn read_actions(&self, z: &Tensor, pass: &Pass) -> Result<Tensor> {
        match &self.idm_head {
            Some(head) => head.forward(z, pass),
            None => candle_core::bail!("this model has no inverse dynamics head (model.inverse_head)"),
        }
    }
}

/// Hands what a roll-out needs to the fused form of it.
fn roller(parameters: &Parameters, architecture: &Architecture) -> Result<Roller> {
    let config = architecture.config();
    let shape = RolloutShape {
        history: config.predictor.history,
        latent: config.latent_width,
        action: architecture.widths().action,
        heads: config.predictor.heads,
        head_width: config.predictor.head_width,
        plain_epsilon: crate::predictor::PLAIN_EPSILON as f32,
        affine_epsilon: crate::predictor::AFFINE_EPSILON as f32,
        batch_epsilon: crate::layers::BatchNorm::EPSILON as f32,
    };
    let tensors = RolloutTensors {
        embedder: named(parameters, "action_encoder", EMBEDDER_PARTS)?,
        positions: parameters.get("predictor.pos_embedding")?,
        blocks: (0..config.predictor.depth)
            .map(|block| named(parameters, &format!("predictor.transformer.layers.{block}"), BLOCK_PARTS))
            .collect::<Result<_>>()?,
        norm: named(parameters, "predictor.transformer.norm", ["weight", "bias"])?,
        projector: named(parameters, "pred_proj.net", PROJECTOR_PARTS)?,
    };
    Ok(Roller::new(shape, tensors))
}

/// Returns the tensors `prefix.name`.
fn named<const N: usize>(parameters: &Parameters, prefix: &str, names: [&str; N]) -> Result<[Tensor; N]> {
    let tensors = names.iter().map(|name| parameters.get(&format!("{prefix}.{name}")));
    let tensors: Vec<Tensor> = tensors.collect::<Result<_>>()?;
    Ok(tensors.try_into().expect("one tensor per name"))
}

/// Tensors of the action embedder, in the order of [`RolloutTensors`].
const EMBEDDER_PARTS: [&str; 6] = [
    "patch_embed.weight",
    "patch_embed.bias",
    "embed.0.weight",
    "embed.0.bias",
    "embed.2.weight",
    "embed.2.bias",
];

/// Tensors of the projector, in the order of [`RolloutTensors`].
const PROJECTOR_PARTS: [&str; 8] =
    ["0.weight", "0.bias", "1.weight", "1.bias", "1.running_mean", "1.running_var", "3.weight", "3.bias"];
