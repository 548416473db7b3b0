//! The parameters of a vision transformer: their order, their panels, their gradients.

use rayon::prelude::*;

use super::{Products, VitGradients, VitShape, sum_range};
use crate::gemm::Packed;
use crate::pairs::{pair_columns, pair_rows};

/// Parameters outside the layers, first in order: weight [width, channels x patch^2] and bias of the patch projection,
/// class token, weight and bias of the last norm.
pub const OUTER_PARAMETERS: usize = 5;
/// Parameters of a layer, weight and bias of each: norm before attention, q, k, v, output, norm before the MLP, its
/// expansion and its contraction. Weights of linear layers are [outputs, inputs].
pub const LAYER_PARAMETERS: usize = 16;

pub(super) const PATCH_WEIGHT: usize = 0;
pub(super) const PATCH_BIAS: usize = 1;
pub(super) const CLASS_TOKEN: usize = 2;
pub(super) const LAST_NORM: usize = 3;

/// Position of a layer's parameter, from its first; the bias follows each.
pub(super) const NORM_BEFORE: usize = 0;
pub(super) const QUERY: usize = 2;
pub(super) const KEY: usize = 4;
pub(super) const VALUE: usize = 6;
pub(super) const OUTPUT: usize = 8;
pub(super) const NORM_AFTER: usize = 10;
pub(super) const EXPAND: usize = 12;
pub(super) const CONTRACT: usize = 14;

/// The linear layers of a layer, in the order of their panels.
const LINEARS: [usize; 6] = [QUERY, KEY, VALUE, OUTPUT, EXPAND, CONTRACT];

/// Panels of all weights, for one direction.
#[derive(Debug, Default)]
pub(super) struct Packs {
    patch: Packed,
    layers: Vec<[Packed; 6]>,
}

impl Packs {
    /// Panels of the transposed weights, for `x W^T`.
    pub(super) fn pack_forward(&mut self, shape: &VitShape, parameters: &[&[f32]]) {
        let pack = |packed: &mut Packed, weight: &[f32], [outputs, inputs]: [usize; 2]| match shape.products {
            Products::Single => packed.fill(weight, [inputs, outputs], [1, inputs]),
            Products::Pairs => {
                let k = inputs.div_ceil(2);
                let mut pairs = vec![0.0; outputs * k];
                pair_columns(weight, inputs, [outputs, inputs], &mut pairs);
                packed.fill(&pairs, [k, outputs], [1, k]);
            }
        };
        pack(&mut self.patch, parameters[PATCH_WEIGHT], [shape.width, shape.patch_values()]);
        self.pack_layers(shape, parameters, pack);
    }

    /// Panels of the weights, for `dy W`.
    pub(super) fn pack_backward(&mut self, shape: &VitShape, parameters: &[&[f32]]) {
        self.pack_layers(shape, parameters, |packed, weight, [outputs, inputs]| match shape.products {
            Products::Single => packed.fill(weight, [outputs, inputs], [inputs, 1]),
            Products::Pairs => {
                let k = outputs.div_ceil(2);
                let mut pairs = vec![0.0; k * inputs];
                pair_rows(weight, inputs, [outputs, inputs], &mut pairs);
                packed.fill(&pairs, [k, inputs], [inputs, 1]);
            }
        });
    }

    fn pack_layers(
        &mut self,
        shape: &VitShape,
        parameters: &[&[f32]],
        pack: impl Fn(&mut Packed, &[f32], [usize; 2]) + Sync,
    ) {
        self.layers.resize_with(shape.depth, Default::default);
        let of_layers = parameters[OUTER_PARAMETERS..].par_chunks_exact(LAYER_PARAMETERS);
        self.layers.par_iter_mut().zip(of_layers).for_each(|(packs, parameters)| {
            for (packed, linear) in packs.iter_mut().zip(LINEARS) {
                let (weight, outputs) = (parameters[linear], parameters[linear + 1].len());
                pack(packed, weight, [outputs, weight.len() / outputs]);
            }
        });
    }

    pub(super) fn patch(&self) -> &Packed {
        &self.patch
    }

    /// The panels of one of the [`LINEARS`] of a layer.
    pub(super) fn linear(&self, layer: usize, linear: usize) -> &Packed {
        let index =
            LINEARS.iter().position(|&l| l == linear).expect("the linear layers are those of the list");
        &self.layers[layer][index]
    }
}

/// Where the gradient of each parameter lies in the sums of a group.
pub(super) struct Layout {
    starts: Vec<usize>,
    /// Parameters, then the position table.
    sizes: Vec<usize>,
}

impl Layout {
    pub(super) fn new(shape: &VitShape) -> Layout {
        let (w, f) = (shape.width, shape.mlp_width);
        let mut sizes = vec![w * shape.patch_values(), w, w, w, w];
        for _ in 0..shape.depth {
            sizes.extend([w, w]);
            sizes.extend([w * w, w].repeat(4));
            sizes.extend([w, w, f * w, f, w * f, w]);
        }
        sizes.push(shape.tokens() * w);
        let mut end = 0;
        let starts = sizes
            .iter()
            .map(|size| {
                end += size;
                end - size
            })
            .collect();
        Layout { starts, sizes }
    }

    pub(super) fn total(&self) -> usize {
        self.sizes.iter().sum()
    }

    /// Position of the position table, after all parameters.
    pub(super) fn positions(&self) -> usize {
        self.sizes.len() - 1
    }

    /// The sums of one parameter.
    pub(super) fn one<'a>(&self, sums: &'a mut [f32], index: usize) -> &'a mut [f32] {
        &mut sums[self.starts[index]..][..self.sizes[index]]
    }

    /// The sums of a weight and of the bias that follows it.
    pub(super) fn pair<'a>(&self, sums: &'a mut [f32], index: usize) -> (&'a mut [f32], &'a mut [f32]) {
        let both = &mut sums[self.starts[index]..][..self.sizes[index] + self.sizes[index + 1]];
        both.split_at_mut(self.sizes[index])
    }

    /// Adds the groups up, in order.
    pub(super) fn reduce(&self, groups: &[Vec<f32>]) -> VitGradients {
        let spans = self.starts.par_iter().zip(&self.sizes);
        let mut parameters: Vec<Vec<f32>> =
            spans.map(|(&start, &size)| sum_range(groups, start, size)).collect();
        let positions = parameters.pop().unwrap_or_default();
        VitGradients { parameters, positions }
    }
}
