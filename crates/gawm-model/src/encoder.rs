//! Frame encoders: what turns an image into a vector.

use candle_core::{IndexOp, Tensor};
use gawm_kernels::VitEncoder;
use gawm_kernels::vit::{Products, VitShape};

use crate::Result;
use crate::config::Architecture;
use crate::layers::{LayerNorm, Linear, attention, gelu, join_heads, split_heads};
use crate::parameters::{Init, Parameters, Specs, weight};
use crate::pass::{Pass, Precision};
use crate::position::resize_table;

/// A frame encoder. One variant today; a frozen patch encoder (DINO-WM) becomes another, whose patches
/// [`Encoder::patches`] returns and whose tensors are not trainable in [`Specs`].
#[derive(Debug, Clone)]
#[non_exhaustive]
pub enum Encoder {
    /// A vision transformer trained with the rest.
    Vit(Vit),
}

impl Encoder {
    /// Returns one vector per image: [N, C, H, W] to [N, W'].
    pub fn forward(&self, images: &Tensor, pass: &Pass) -> Result<Tensor> {
        match self {
            Encoder::Vit(vit) => vit.class_tokens(images, pass), // [N, W']
        }
    }

    /// Returns one vector per patch: [N, C, H, W] to [N, P, W'].
    pub fn patches(&self, images: &Tensor, pass: &Pass) -> Result<Tensor> {
        match self {
            Encoder::Vit(vit) => vit.tokens(images, pass)?.i((.., 1..)), // [N, P, W']
        }
    }
}

/// Vision transformer (pre-norm) with a class token, as `transformers.ViTModel` without pooler.
#[derive(Debug, Clone)]
pub struct Vit {
    /// The class token by fused operations; all else is the composed form of the same.
    fused: VitEncoder,
    patch_size: usize,
    patch_projection: Linear,
    cls_token: Tensor,
    position_embeddings: Tensor,
    table_side: usize,
    layers: Vec<Layer>,
    layernorm: LayerNorm,
}

#[derive(Debug, Clone)]
struct Layer {
    heads: usize,
    layernorm_before: LayerNorm,
    q_proj: Linear,
    k_proj: Linear,
    v_proj: Linear,
    o_proj: Linear,
    layernorm_after: LayerNorm,
    fc1: Linear,
    fc2: Linear,
}

/// Parts of a layer in the order of [`gawm_kernels::vit::LAYER_PARAMETERS`].
const FUSED_PARTS: [&str; 8] = [
    "layernorm_before",
    "attention.q_proj",
    "attention.k_proj",
    "attention.v_proj",
    "attention.o_proj",
    "layernorm_after",
    "mlp.fc1",
    "mlp.fc2",
];

impl Vit {
    /// Added to the variance in its layer norms.
    const EPSILON: f64 = 1e-12;
    /// Start of linear and convolution weights (transformers 5).
    const WEIGHTS: Init = Init::Normal { std: 0.02 };
    /// Start of the class token and the position table.
    const TOKENS: Init = Init::TruncatedNormal { std: 0.02, bound: 2.0 };

    /// Adds the tensors under `encoder`.
    pub fn specs(specs: &mut Specs, architecture: &Architecture) {
        let config = &architecture.config().encoder;
        let (width, patch) = (config.width, config.patch_size);
        let positions = architecture.table_side().pow(2) + 1;
        weight(specs, "encoder.embeddings.cls_token".to_owned(), &[1, 1, width], Vit::TOKENS);
        weight(
            specs,
            "encoder.embeddings.position_embeddings".to_owned(),
            &[1, positions, width],
            Vit::TOKENS,
        );
        let projection = "encoder.embeddings.patch_embeddings.projection";
        weight(specs, format!("{projection}.weight"), &[width, 3, patch, patch], Vit::WEIGHTS);
        weight(specs, format!("{projection}.bias"), &[width], Init::Zeros);
        for layer in 0..config.depth {
            let name = format!("encoder.layers.{layer}");
            for part in ["q_proj", "k_proj", "v_proj", "o_proj"] {
                Linear::specs_with(specs, &format!("{name}.attention.{part}"), width, width, Vit::WEIGHTS);
            }
            LayerNorm::specs(specs, &format!("{name}.layernorm_before"), width);
            LayerNorm::specs(specs, &format!("{name}.layernorm_after"), width);
            Linear::specs_with(specs, &format!("{name}.mlp.fc1"), width, config.mlp_width, Vit::WEIGHTS);
            Linear::specs_with(specs, &format!("{name}.mlp.fc2"), config.mlp_width, width, Vit::WEIGHTS);
        }
        LayerNorm::specs(specs, "encoder.layernorm", width);
    }

    /// Takes the tensors under `encoder` from the store.
    pub fn load(parameters: &Parameters, architecture: &Architecture) -> Result<Vit> {
        let config = &architecture.config().encoder;
        let projection = "encoder.embeddings.patch_embeddings.projection";
        let kernel = parameters.get(&format!("{projection}.weight"))?.flatten_from(1)?; // [W, 3 x patch^2]
        Ok(Vit {
            fused: Vit::fuse(parameters, config.depth)?,
            patch_size: config.patch_size,
            patch_projection: Linear::new(kernel, Some(parameters.get(&format!("{projection}.bias"))?)),
            cls_token: parameters.get("encoder.embeddings.cls_token")?,
            position_embeddings: parameters.get("encoder.embeddings.position_embeddings")?,
            table_side: architecture.table_side(),
            layers: (0..config.depth)
                .map(|layer| Layer::load(parameters, &format!("encoder.layers.{layer}"), config.heads))
                .collect::<Result<_>>()?,
            layernorm: LayerNorm::load(parameters, "encoder.layernorm", Vit::EPSILON)?,
        })
    }

    /// Hands the parameters to the fused encoder, in the order of [`gawm_kernels::vit`].
    fn fuse(parameters: &Parameters, depth: usize) -> Result<VitEncoder> {
        let projection = "encoder.embeddings.patch_embeddings.projection";
        let mut names = vec![format!("{projection}.weight"), format!("{projection}.bias")];
        names.push("encoder.embeddings.cls_token".to_owned());
        names.extend(["weight", "bias"].map(|which| format!("encoder.layernorm.{which}")));
        for layer in 0..depth {
            for part in FUSED_PARTS {
                names
                    .extend(["weight", "bias"].map(|which| format!("encoder.layers.{layer}.{part}.{which}")));
            }
        }
        let tensors = names.iter().map(|name| parameters.get(name)).collect::<Result<_>>()?;
        Ok(VitEncoder::new(tensors, parameters.sink().clone()))
    }

    /// Encodes images to normalised class tokens: [N, 3, H, W] to [N, W'].
    ///
    /// By fused operations where they take the input, else the first of [`Vit::tokens`].
    pub fn class_tokens(&self, images: &Tensor, pass: &Pass) -> Result<Tensor> {
        let products = match pass.precision {
            Precision::F32 => Some(Products::Single),
            Precision::Bf16 => gawm_kernels::pairs::available().then_some(Products::Pairs),
        };
        let Some(products) = products.filter(|_| VitEncoder::takes(images)) else {
            return self.tokens(images, pass)?.i((.., 0)); // [N, W']
        };
        let (rows, columns) = self.grid(images)?;
        let layer = self.layers.first();
        let shape = VitShape {
            patch: self.patch_size,
            rows,
            columns,
            channels: images.dim(1)?,
            width: self.cls_token.dim(2)?,
            depth: self.layers.len(),
            heads: layer.map_or(1, |layer| layer.heads),
            mlp_width: layer.map_or(Ok(1), |layer| layer.fc1.outputs())?,
            epsilon: Vit::EPSILON as f32,
            products,
        };
        self.fused.forward(images, &self.positions(rows, columns)?, shape, pass.training)
    }

    /// Rows and columns of whole patches in images [N, 3, H, W].
    fn grid(&self, images: &Tensor) -> Result<(usize, usize)> {
        let (_, _, height, width) = images.dims4()?;
        let p = self.patch_size;
        if height < p || width < p {
            candle_core::bail!(
                "image is smaller than a patch: expected at least {p}x{p}, got {height}x{width}"
            );
        }
        Ok((height / p, width / p))
    }

    /// Encodes images to tokens: [N, 3, H, W] to [N, 1 + P, W'], class token first, patches row by row.
    ///
    /// `P` is (H / patch) x (W / patch), rounded down as a convolution does; pixels beyond are not seen.
    pub fn tokens(&self, images: &Tensor, pass: &Pass) -> Result<Tensor> {
        let (n, c, _, _) = images.dims4()?;
        let p = self.patch_size;
        let (rows, columns) = self.grid(images)?;
        let images = images.i((.., .., ..rows * p, ..columns * p))?;
        let grid = images.reshape(&[n, c, rows, p, columns, p])?; // [N, C, rows, p, columns, p]
        let patches = grid.permute([0, 2, 4, 1, 3, 5])?; // [N, rows, columns, C, p, p]
        let patches = patches.reshape((n, rows * columns, c * p * p))?; // [N, P, C x p^2]
        let x = self.patch_projection.forward(&patches, pass)?; // [N, P, W']
        let cls = self.cls_token.broadcast_as((n, 1, self.cls_token.dim(2)?))?;
        let x = Tensor::cat(&[&cls, &x], 1)?; // [N, 1 + P, W']
        let mut x = x.broadcast_add(&self.positions(rows, columns)?)?;
        for layer in &self.layers {
            x = layer.forward(&x, pass)?;
        }
        self.layernorm.forward(&x)
    }

    /// Returns the position table for a grid, [1, 1 + P, W']: as stored where it fits, else interpolated.
    fn positions(&self, rows: usize, columns: usize) -> Result<Tensor> {
        let side = self.table_side;
        if (rows, columns) == (side, side) {
            return Ok(self.position_embeddings.clone());
        }
        let table = self.position_embeddings.i((0, 1..))?; // [side^2, W']
        let table = resize_table(&table.contiguous()?, side, rows, columns)?.unsqueeze(0)?; // [1, P, W']
        Tensor::cat(&[&self.position_embeddings.i((.., ..1))?, &table], 1) // [1, 1 + P, W']
    }
}

impl Layer {
    fn load(parameters: &Parameters, name: &str, heads: usize) -> Result<Layer> {
        let linear = |part: &str| Linear::load(parameters, &format!("{name}.{part}"));
        let norm = |part: &str| LayerNorm::load(parameters, &format!("{name}.{part}"), Vit::EPSILON);
        Ok(Layer {
            heads,
            layernorm_before: norm("layernorm_before")?,
            q_proj: linear("attention.q_proj")?,
            k_proj: linear("attention.k_proj")?,
            v_proj: linear("attention.v_proj")?,
            o_proj: linear("attention.o_proj")?,
            layernorm_after: norm("layernorm_after")?,
            fc1: linear("mlp.fc1")?,
            fc2: linear("mlp.fc2")?,
        })
    }

    /// `x + Attn(LN(x))`, then `x + MLP(LN(x))`. Shape [N, 1 + P, W'], kept.
    fn forward(&self, x: &Tensor, pass: &Pass) -> Result<Tensor> {
        let y = self.layernorm_before.forward(x)?;
        let q = split_heads(&self.q_proj.forward(&y, pass)?, self.heads)?; // [N, heads, 1 + P, d]
        let k = split_heads(&self.k_proj.forward(&y, pass)?, self.heads)?;
        let v = split_heads(&self.v_proj.forward(&y, pass)?, self.heads)?;
        let y = attention([&q, &k, &v], None, pass, |probabilities| Ok(probabilities.clone()))?;
        let x = (x + self.o_proj.forward(&join_heads(&y)?, pass)?)?;
        let y = gelu(&self.fc1.forward(&self.layernorm_after.forward(&x)?, pass)?)?;
        x + self.fc2.forward(&y, pass)?
    }
}
