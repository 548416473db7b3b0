//! The predictor: a causal transformer whose blocks are modulated by the actions (AdaLN-zero).

use candle_core::{D, Tensor};
use gawm_kernels::predictor::{BlockMasks, Predictor as FusedPredictor, PredictorShape};

use crate::Result;
use crate::config::Architecture;
use crate::layers::{
    LayerNorm, Linear, attention, causal_mask, gelu, join_heads, normalize, silu, split_heads,
};
use crate::parameters::{Init, Parameters, Specs, weight};
use crate::pass::Pass;

/// Causal transformer over latents, conditioned on action embeddings.
///
/// ```text
/// [shift1, scale1, gate1, shift2, scale2, gate2] = W SiLU(c) + b          (W, b start at zero)
/// x = x + gate1 * Attn(LN0(x) * (1 + scale1) + shift1)
/// x = x + gate2 *  MLP(LN0(x) * (1 + scale2) + shift2)
/// ```
///
/// `LN0` has no scale and shift; `Attn` and `MLP` begin with a layer norm of their own, so everything is normalised
/// twice, as published.
#[derive(Debug, Clone)]
pub struct Predictor {
    /// All of it in one operation, for training; the rest is the composed form of the same.
    fused: FusedPredictor,
    head_width: usize,
    pos_embedding: Tensor,
    blocks: Vec<Block>,
    norm: LayerNorm,
}

#[derive(Debug, Clone)]
struct Block {
    site: String,
    heads: usize,
    dropout: f64,
    modulation: Linear,
    attn_norm: LayerNorm,
    to_qkv: Linear,
    to_out: Linear,
    mlp_norm: LayerNorm,
    expand: Linear,
    contract: Linear,
}

/// Epsilon of the norms with scale and shift.
pub(crate) const AFFINE_EPSILON: f64 = 1e-5;
/// Epsilon of the norms without.
pub(crate) const PLAIN_EPSILON: f64 = 1e-6;

impl Predictor {
    /// Adds the tensors under `predictor`.
    pub fn specs(specs: &mut Specs, architecture: &Architecture) {
        let (config, latent) = (&architecture.config().predictor, architecture.config().latent_width);
        let inner = config.heads * config.head_width;
        let positions = [1, config.history, latent];
        weight(specs, "predictor.pos_embedding".to_owned(), &positions, Init::Normal { std: 1.0 });
        for block in 0..config.depth {
            let name = format!("predictor.transformer.layers.{block}");
            Linear::specs_with(specs, &format!("{name}.adaLN_modulation.1"), latent, 6 * latent, Init::Zeros);
            LayerNorm::specs(specs, &format!("{name}.attn.norm"), latent);
            let init = Init::Uniform { bound: 1.0 / (latent as f64).sqrt() };
            weight(specs, format!("{name}.attn.to_qkv.weight"), &[3 * inner, latent], init);
            Linear::specs(specs, &format!("{name}.attn.to_out.0"), inner, latent);
            LayerNorm::specs(specs, &format!("{name}.mlp.net.0"), latent);
            Linear::specs(specs, &format!("{name}.mlp.net.1"), latent, config.mlp_width);
            Linear::specs(specs, &format!("{name}.mlp.net.4"), config.mlp_width, latent);
        }
        LayerNorm::specs(specs, "predictor.transformer.norm", latent);
    }

    /// Takes the tensors under `predictor` from the store.
    pub fn load(parameters: &Parameters, architecture: &Architecture) -> Result<Predictor> {
        let config = &architecture.config().predictor;
        let block = |index: usize| {
            let name = format!("predictor.transformer.layers.{index}");
            let linear = |part: &str| Linear::load(parameters, &format!("{name}.{part}"));
            let norm = |part: &str| LayerNorm::load(parameters, &format!("{name}.{part}"), AFFINE_EPSILON);
            Ok(Block {
                site: format!("predictor.{index}"),
                heads: config.heads,
                dropout: config.dropout,
                modulation: linear("adaLN_modulation.1")?,
                attn_norm: norm("attn.norm")?,
                to_qkv: linear("attn.to_qkv")?,
                to_out: linear("attn.to_out.0")?,
                mlp_norm: norm("mlp.net.0")?,
                expand: linear("mlp.net.1")?,
                contract: linear("mlp.net.4")?,
            })
        };
        Ok(Predictor {
            fused: Predictor::fuse(parameters, config.depth)?,
            head_width: config.head_width,
            pos_embedding: parameters.get("predictor.pos_embedding")?,
            blocks: (0..config.depth).map(block).collect::<Result<_>>()?,
            norm: LayerNorm::load(parameters, "predictor.transformer.norm", AFFINE_EPSILON)?,
        })
    }

    /// Hands the parameters to the fused predictor, in the order of [`gawm_kernels::predictor`].
    fn fuse(parameters: &Parameters, depth: usize) -> Result<FusedPredictor> {
        let mut names = vec!["predictor.pos_embedding".to_owned()];
        names.extend(["weight", "bias"].map(|which| format!("predictor.transformer.norm.{which}")));
        for block in 0..depth {
            names.extend(BLOCK_PARTS.map(|part| format!("predictor.transformer.layers.{block}.{part}")));
        }
        let tensors = names.iter().map(|name| parameters.get(name)).collect::<Result<_>>()?;
        Ok(FusedPredictor::new(tensors, parameters.sink().clone()))
    }

    /// [`Predictor::forward`] in training by one fused operation.
    fn forward_fused(&self, z: &Tensor, c: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (clips, frames, latent) = z.dims3()?;
        let (heads, mlp_width) = match self.blocks.first() {
            Some(block) => (block.heads, block.expand.outputs()?),
            None => candle_core::bail!("predictor: expected at least one block"),
        };
        let shape = PredictorShape {
            clips,
            frames,
            latent,
            heads,
            head_width: self.head_width,
            mlp_width,
            plain_epsilon: PLAIN_EPSILON as f32,
            affine_epsilon: AFFINE_EPSILON as f32,
        };
        let dropping = self.blocks.iter().filter(|block| pass.drops(block.dropout));
        let masks = dropping.map(|block| block.masks(&shape, pass)).collect();
        self.fused.forward(z, c, shape, masks)
    }

    /// Maps latents and action embeddings, both [B, T, D] with T up to the history, to [B, T, D].
    ///
    /// Output k sees latents and actions 0..=k only and stands for frame k + 1 (before `pred_proj`).
    pub fn forward(&self, z: &Tensor, c: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (_, t, _) = z.dims3()?;
        let fits = t <= self.pos_embedding.dim(1)? && !self.blocks.is_empty() && c.dims() == z.dims();
        if pass.trains_fused(z) && fits && self.fused.takes(z, c) {
            return self.forward_fused(z, c, pass);
        }
        self.forward_composed(z, c, pass)
    }

    /// [`Predictor::forward`] in composed operations.
    fn forward_composed(&self, z: &Tensor, c: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (_, t, _) = z.dims3()?;
        let mask = causal_mask(t, z.device())?;
        let modulation = silu(c)?;
        let mut x = z.broadcast_add(&self.pos_embedding.narrow(1, 0, t)?)?;
        for block in &self.blocks {
            x = block.forward(&x, &modulation, &mask, pass)?;
        }
        self.norm.forward(&x)
    }
}

/// Tensors of a block, in the order of [`gawm_kernels::predictor`] and [`gawm_kernels::rollout`].
pub(crate) const BLOCK_PARTS: [&str; 13] = [
    "adaLN_modulation.1.weight",
    "adaLN_modulation.1.bias",
    "attn.norm.weight",
    "attn.norm.bias",
    "attn.to_qkv.weight",
    "attn.to_out.0.weight",
    "attn.to_out.0.bias",
    "mlp.net.0.weight",
    "mlp.net.0.bias",
    "mlp.net.1.weight",
    "mlp.net.1.bias",
    "mlp.net.4.weight",
    "mlp.net.4.bias",
];

impl Block {
    /// The dropout masks of a pass, the same that [`Block::forward`] draws.
    fn masks(&self, shape: &PredictorShape, pass: &Pass) -> BlockMasks {
        let rows = shape.clips * shape.frames;
        let mask = |columns: usize, site: &str| {
            pass.dropout_mask(rows * columns, self.dropout, &format!("{}.{site}", self.site))
        };
        BlockMasks {
            probabilities: mask(shape.heads * shape.frames, "probabilities"),
            attention: mask(shape.latent, "attention"),
            hidden: mask(shape.mlp_width, "hidden"),
            mlp: mask(shape.latent, "mlp"),
        }
    }

    /// One block; `x` and `modulation` (SiLU of the action embedding) have shape [B, T, D], kept.
    fn forward(&self, x: &Tensor, modulation: &Tensor, mask: &Tensor, pass: &Pass) -> Result<Tensor> {
        let parts = self.modulation.forward(modulation, pass)?.chunk(6, D::Minus1)?; // 6 x [B, T, D]
        let [shift1, scale1, gate1, shift2, scale2, gate2] = parts.as_slice() else {
            candle_core::bail!("modulation of {}: expected 6 parts, got {}", self.site, parts.len());
        };
        let y = self.attend(&modulate(x, shift1, scale1)?, mask, pass)?;
        let x = (x + (gate1 * y)?)?;
        let y = self.mlp(&modulate(&x, shift2, scale2)?, pass)?;
        x + (gate2 * y)?
    }

    fn attend(&self, x: &Tensor, mask: &Tensor, pass: &Pass) -> Result<Tensor> {
        let qkv = self.to_qkv.forward(&self.attn_norm.forward(x)?, pass)?.chunk(3, D::Minus1)?;
        let heads = qkv.iter().map(|part| split_heads(part, self.heads)).collect::<Result<Vec<_>>>()?;
        let [q, k, v] = heads.as_slice() else {
            candle_core::bail!("attention of {}: expected 3 parts, got {}", self.site, heads.len());
        };
        let drop = |p: &Tensor| pass.dropout(p, self.dropout, &format!("{}.probabilities", self.site));
        let y = attention([q, k, v], Some(mask), pass, drop)?; // [B, heads, T, d]
        let y = self.to_out.forward(&join_heads(&y)?, pass)?; // [B, T, D]
        pass.dropout(&y, self.dropout, &format!("{}.attention", self.site))
    }

    fn mlp(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let y = gelu(&self.expand.forward(&self.mlp_norm.forward(x)?, pass)?)?; // [B, T, hidden]
        let y = pass.dropout(&y, self.dropout, &format!("{}.hidden", self.site))?;
        let y = self.contract.forward(&y, pass)?; // [B, T, D]
        pass.dropout(&y, self.dropout, &format!("{}.mlp", self.site))
    }
}

/// `LN0(x) * (1 + scale) + shift`. Shapes [B, T, D].
fn modulate(x: &Tensor, shift: &Tensor, scale: &Tensor) -> Result<Tensor> {
    (normalize(x, PLAIN_EPSILON)? * (scale + 1.0)?)? + shift
}

#[cfg(test)]
mod tests {
    use candle_core::Device;

    use super::*;
    use crate::config::{DataWidths, ModelConfig};
    use crate::model::WorldModel;
    use crate::random::Stream;

    /// Largest difference between the fused and the composed form, and between training without dropout and evaluation.
    fn check(clips: usize, frames: usize, change: impl FnOnce(&mut ModelConfig), dropout: f64) {
        let mut config = ModelConfig::preset("micro").unwrap();
        change(&mut config);
        config.predictor.dropout = dropout;
        let architecture = config.resolve(DataWidths { action: 4, state: 3 }).unwrap();
        let normal = |name: &str, dims: &[usize]| {
            let values = Stream::new(1, name, 0).normals(dims.iter().product());
            Tensor::from_vec(values, dims, &Device::Cpu).unwrap()
        };
        let model = WorldModel::new(architecture, 1, &Device::Cpu).unwrap();
        for (name, tensor) in model.parameters().iter().filter(|(name, _)| name.contains("adaLN")) {
            model.parameters().set(name, &(normal(name, tensor.dims()) * 0.3).unwrap()).unwrap();
        }
        let predictor = Predictor::load(model.parameters(), model.architecture()).unwrap();
        let latent = model.architecture().config().latent_width;
        let (z, c) = (normal("z", &[clips, frames, latent]), normal("c", &[clips, frames, latent]));
        let difference = |a: &Tensor, b: &Tensor| {
            (a - b).unwrap().abs().unwrap().max_all().unwrap().to_scalar::<f32>().unwrap()
        };
        let pass = Pass::train(3, 5);
        let fused = predictor.forward(&z, &c, &pass).unwrap();
        let composed = predictor.forward_composed(&z, &c, &pass).unwrap();
        assert!(difference(&fused, &composed) < 2e-5, "{clips} x {frames} at rate {dropout}");
        let evaluated = predictor.forward(&z, &c, &Pass::eval()).unwrap();
        assert_eq!(difference(&fused, &evaluated) < 2e-5, dropout == 0.0, "{clips} x {frames}");
    }

    #[test]
    fn fused_and_composed_predictors_draw_the_same_dropout() {
        for dropout in [0.0, 0.3] {
            check(1, 1, |_| {}, dropout);
            check(2, 3, |_| {}, dropout);
            check(40, 2, |_| {}, dropout);
            // Widths that fill no vector, and a single head.
            check(2, 3, |config| (config.predictor.heads, config.predictor.head_width) = (3, 5), dropout);
            check(3, 2, |config| (config.predictor.heads, config.predictor.mlp_width) = (1, 7), dropout);
        }
    }
}
