//! The weights of a predictor, in panels.

use super::RolloutShape;
use crate::gemm::Packed;

/// The parameters of a predictor and what surrounds it, in order; weights of linear layers are [outputs, inputs].
#[derive(Debug, Clone)]
pub struct RolloutParameters<'a> {
    /// Action embedder: weight and bias of its three linear layers (SiLU before the last).
    pub embedder: [&'a [f32]; 6],
    /// Position table, [history, latent].
    pub positions: &'a [f32],
    /// Of each block: weight and bias of the modulation, of the norm before attention, weight of q, k, v together (no
    /// bias), weight and bias of the output, of the norm before the MLP, of its expansion and its contraction.
    pub blocks: Vec<[&'a [f32]; 13]>,
    /// Weight and bias of the last norm.
    pub norm: [&'a [f32]; 2],
    /// Projector: weight and bias of its first layer; weight, bias, mean and variance of the batch norm; weight and bias
    /// of its last layer.
    pub projector: [&'a [f32]; 8],
}

/// A linear layer.
#[derive(Debug)]
pub(super) struct Linear {
    pub(super) weight: Packed,
    pub(super) bias: Option<Vec<f32>>,
    pub(super) inputs: usize,
    pub(super) outputs: usize,
}

impl Linear {
    fn new(weight: &[f32], bias: &[f32]) -> Linear {
        Linear::of(weight, bias.len(), Some(bias.to_vec()))
    }

    /// The columns `first..first + inputs` of a weight [outputs, stride].
    fn of_columns(weight: &[f32], [outputs, stride]: [usize; 2], first: usize, inputs: usize) -> Linear {
        let mut packed = Packed::default();
        packed.fill(&weight[first..], [inputs, outputs], [1, stride]);
        Linear { weight: packed, bias: None, inputs, outputs }
    }

    fn of(weight: &[f32], outputs: usize, bias: Option<Vec<f32>>) -> Linear {
        let inputs = weight.len() / outputs;
        assert_eq!(weight.len(), inputs * outputs, "rollout: size of a weight");
        Linear { weight: Packed::of_transposed(weight, [outputs, inputs]), bias, inputs, outputs }
    }
}

/// Two linear layers with a GELU between, in blocks of hidden columns: a block's hidden values stay in the cache from the
/// first layer to the second, and every weight is read once per group of sequences.
#[derive(Debug)]
pub(super) struct Mlp {
    /// Expansion to the columns of a block, and contraction of them; the first contraction adds the bias.
    pub(super) blocks: Vec<[Linear; 2]>,
    pub(super) outputs: usize,
}

/// Hidden columns of a block.
const HIDDEN: usize = 256;

impl Mlp {
    fn new(expand: &[f32], expand_bias: &[f32], contract: &[f32], contract_bias: &[f32]) -> Mlp {
        let (hidden, outputs) = (expand_bias.len(), contract_bias.len());
        let inputs = expand.len() / hidden;
        assert_eq!(contract.len(), hidden * outputs, "rollout: size of a weight");
        let block = |first: usize| {
            let count = HIDDEN.min(hidden - first);
            let rows = &expand[first * inputs..(first + count) * inputs];
            let up = Linear::new(rows, &expand_bias[first..first + count]);
            let mut down = Linear::of_columns(contract, [outputs, hidden], first, count);
            down.bias = (first == 0).then(|| contract_bias.to_vec());
            [up, down]
        };
        Mlp { blocks: (0..hidden).step_by(HIDDEN).map(block).collect(), outputs }
    }
}

/// Some heads of an attention, whose queries, keys and values stay in the cache until their output is added.
#[derive(Debug)]
pub(super) struct Heads {
    pub(super) q: Linear,
    pub(super) k: Linear,
    pub(super) v: Linear,
    /// What these heads add to the output; the first ones add the bias.
    pub(super) output: Linear,
}

impl Heads {
    /// Splits all heads into groups of about [`HIDDEN`] columns.
    fn all(shape: &RolloutShape, qkv: &[f32], output: &[f32], bias: &[f32]) -> Vec<Heads> {
        let (inner, latent) = (shape.heads * shape.head_width, shape.latent);
        assert_eq!(
            [qkv.len(), output.len()],
            [3 * inner * latent, bias.len() * inner],
            "rollout: sizes of weights of attention"
        );
        let columns = (HIDDEN / shape.head_width).max(1) * shape.head_width;
        let group = |first: usize| {
            let count = columns.min(inner - first);
            let part = |index: usize| {
                let rows = &qkv[(index * inner + first) * latent..][..count * latent];
                Linear::of(rows, count, None)
            };
            let mut down = Linear::of_columns(output, [bias.len(), inner], first, count);
            down.bias = (first == 0).then(|| bias.to_vec());
            Heads { q: part(0), k: part(1), v: part(2), output: down }
        };
        (0..inner).step_by(columns).map(group).collect()
    }
}

/// Weight and bias of a norm.
#[derive(Debug)]
pub(super) struct Norm {
    pub(super) weight: Vec<f32>,
    pub(super) bias: Vec<f32>,
}

impl Norm {
    fn new(weight: &[f32], bias: &[f32]) -> Norm {
        Norm { weight: weight.to_vec(), bias: bias.to_vec() }
    }
}

#[derive(Debug)]
pub(super) struct Block {
    pub(super) modulation: Linear,
    pub(super) attn_norm: Norm,
    pub(super) heads: Vec<Heads>,
    pub(super) mlp_norm: Norm,
    pub(super) mlp: Mlp,
}

#[derive(Debug)]
pub(super) struct Packs {
    pub(super) embedder: [Linear; 3],
    pub(super) positions: Vec<f32>,
    pub(super) blocks: Vec<Block>,
    pub(super) norm: Norm,
    /// The projector, with the batch norm of running statistics folded into its first layer: `w' = w s`,
    /// `b' = (b - mean) s + shift`, `s = scale / sqrt(var + epsilon)`.
    pub(super) project: Mlp,
}

impl Packs {
    pub(super) fn new(shape: &RolloutShape, parameters: &RolloutParameters<'_>) -> Packs {
        let [a, a_bias, b, b_bias, c, c_bias] = parameters.embedder;
        let block = |parameters: &[&[f32]; 13]| {
            let [ada, ada_bias, norm1, bias1, qkv, out, out_bias, norm2, bias2, up, up_bias, down, down_bias] =
                *parameters;
            Block {
                modulation: Linear::new(ada, ada_bias),
                attn_norm: Norm::new(norm1, bias1),
                heads: Heads::all(shape, qkv, out, out_bias),
                mlp_norm: Norm::new(norm2, bias2),
                mlp: Mlp::new(up, up_bias, down, down_bias),
            }
        };
        let [first, first_bias, scale, shift, mean, variance, last, last_bias] = parameters.projector;
        let factors: Vec<f32> = (scale.iter().zip(variance))
            .map(|(scale, variance)| scale / (variance + shape.batch_epsilon).sqrt())
            .collect();
        let rows = first.chunks_exact(shape.latent).zip(&factors);
        let folded: Vec<f32> = rows.flat_map(|(row, factor)| row.iter().map(move |w| w * factor)).collect();
        let centred = first_bias.iter().zip(mean).map(|(bias, mean)| bias - mean);
        let folded_bias: Vec<f32> =
            centred.zip(&factors).zip(shift).map(|((bias, factor), shift)| bias * factor + shift).collect();
        assert_eq!(
            parameters.positions.len(),
            shape.history * shape.latent,
            "rollout: size of the positions"
        );
        Packs {
            embedder: [Linear::new(a, a_bias), Linear::new(b, b_bias), Linear::new(c, c_bias)],
            positions: parameters.positions.to_vec(),
            blocks: parameters.blocks.iter().map(block).collect(),
            norm: Norm::new(parameters.norm[0], parameters.norm[1]),
            project: Mlp::new(&folded, &folded_bias, last, last_bias),
        }
    }
}
