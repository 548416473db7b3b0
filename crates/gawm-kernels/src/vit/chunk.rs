//! A few images on one thread: patches, all layers, the last norm, and back.

use super::VitShape;
use super::layer::{LayerPass, LayerState};
use super::products::{Matrix, Operands};
use super::weights::{
    CLASS_TOKEN, LAST_NORM, LAYER_PARAMETERS, Layout, OUTER_PARAMETERS, PATCH_BIAS, PATCH_WEIGHT, Packs,
};
use crate::attention::AttentionScratch;
use crate::gemm::Epilogue;
use crate::norm;
use crate::profile::{Kind, span};

/// Standardised images, [images, channels, height, width].
#[derive(Debug, Clone, Copy)]
pub struct Images<'a> {
    values: &'a [f32],
    channels: usize,
    height: usize,
    width: usize,
}

impl<'a> Images<'a> {
    /// Views pixels as images.
    ///
    /// # Panics
    ///
    /// If the values are not a whole number of images.
    pub fn new(values: &'a [f32], channels: usize, height: usize, width: usize) -> Images<'a> {
        assert!(values.len().is_multiple_of(channels * height * width), "images: expected whole images");
        Images { values, channels, height, width }
    }

    /// Number of images.
    pub fn count(&self) -> usize {
        self.values.len() / (self.channels * self.height * self.width)
    }

    /// Views some of the images.
    pub(super) fn part(&self, first: usize, count: usize) -> Images<'a> {
        let size = self.channels * self.height * self.width;
        Images { values: &self.values[first * size..][..count * size], ..*self }
    }

    /// Copies the patches of one image into rows [patches, channels x patch^2].
    fn patches(&self, image: usize, shape: &VitShape, out: &mut [f32]) {
        let p = shape.patch;
        let size = self.channels * self.height * self.width;
        let image = &self.values[image * size..][..size];
        for (index, out) in out.chunks_exact_mut(shape.patch_values()).enumerate() {
            let (row, column) = (index / shape.columns, index % shape.columns);
            for (line, out) in out.chunks_exact_mut(p).enumerate() {
                let (channel, y) = (line / p, row * p + line % p);
                let start = (channel * self.height + y) * self.width + column * p;
                copy_short(&image[start..start + p], out);
            }
        }
    }
}

/// Copies a few values, for which a call of the C library's copy would take longer than the copying.
fn copy_short(from: &[f32], to: &mut [f32]) {
    let ((from, from_rest), (to, to_rest)) = (from.as_chunks::<4>(), to.as_chunks_mut::<4>());
    to.iter_mut().zip(from).for_each(|(to, from)| *to = *from);
    let (from, to) = (from_rest.as_chunks::<2>(), to_rest.as_chunks_mut::<2>());
    to.0.iter_mut().zip(from.0).for_each(|(to, from)| *to = *from);
    to.1.iter_mut().zip(from.1).for_each(|(to, from)| *to = *from);
}

/// Values of a chunk that its backward pass reads.
#[derive(Debug, Default)]
pub(super) struct ChunkState {
    layers: Vec<LayerState>,
    xhat: Vec<f32>,
    rstd: Vec<f32>,
}

/// Memory of one thread.
#[derive(Debug, Default)]
pub(super) struct Scratch {
    /// The residual stream, or its gradient.
    pub(super) x: Vec<f32>,
    pub(super) y: Vec<f32>,
    pub(super) hidden: Vec<f32>,
    pub(super) d_hidden: Vec<f32>,
    pub(super) attended: Vec<f32>,
    pub(super) q: Vec<f32>,
    pub(super) k: Vec<f32>,
    pub(super) v: Vec<f32>,
    pub(super) attention: AttentionScratch,
    pub(super) operands: Operands,
}

/// Returns the first `count` elements, growing the vector where it is shorter; what it held stays or is zero.
pub(super) fn sized(vector: &mut Vec<f32>, count: usize) -> &mut [f32] {
    if vector.len() < count {
        vector.resize(count, 0.0);
    }
    &mut vector[..count]
}

/// What a pass over a chunk reads.
pub(super) struct Pass<'a> {
    pub(super) shape: &'a VitShape,
    pub(super) packs: &'a Packs,
    pub(super) parameters: &'a [&'a [f32]],
    pub(super) positions: &'a [f32],
}

impl Pass<'_> {
    pub(super) fn forward(
        &self,
        images: Images<'_>,
        keep: bool,
        state: &mut ChunkState,
        scratch: &mut Scratch,
        output: &mut [f32],
    ) {
        self.embed(images, scratch);
        // Without a backward pass to come, one state serves every layer.
        state.layers.resize_with(if keep { self.shape.depth } else { 1 }, LayerState::default);
        for layer in 0..self.shape.depth {
            let state = &mut state.layers[if keep { layer } else { 0 }];
            self.layer(layer, images.count()).forward(state, scratch);
        }
        let (w, n) = (self.shape.width, images.count());
        let (weight, bias) = (self.parameters[LAST_NORM], self.parameters[LAST_NORM + 1]);
        let xhat = sized(&mut state.xhat, n * w);
        norm::normalize(&scratch.x[..n * w], w, self.shape.epsilon, xhat, sized(&mut state.rstd, n));
        norm::scale_shift(xhat, weight, bias, output);
    }

    pub(super) fn backward(
        &self,
        images: Images<'_>,
        state: &mut ChunkState,
        d_output: &[f32],
        layout: &Layout,
        sums: &mut [f32],
        scratch: &mut Scratch,
    ) {
        let (w, n) = (self.shape.width, images.count());
        let dy = sized(&mut scratch.y, n * w);
        dy.copy_from_slice(d_output);
        let (d_weight, d_bias) = layout.pair(sums, LAST_NORM);
        norm::scale_shift_backward(dy, &state.xhat[..n * w], d_weight, d_bias);
        let dx = sized(&mut scratch.x, n * w);
        dx.fill(0.0);
        norm::normalize_backward(dy, &state.xhat[..n * w], &state.rstd, self.parameters[LAST_NORM], dx);
        for layer in (0..self.shape.depth).rev() {
            self.layer(layer, n).backward(&mut state.layers[layer], layout, sums, scratch);
        }
        self.embed_backward(images, layout, sums, scratch);
    }

    fn layer(&self, layer: usize, images: usize) -> LayerPass<'_> {
        let first = OUTER_PARAMETERS + layer * LAYER_PARAMETERS;
        let last = layer + 1 == self.shape.depth;
        LayerPass {
            shape: self.shape,
            packs: self.packs,
            index: layer,
            first,
            parameters: &self.parameters[first..first + LAYER_PARAMETERS],
            images,
            queries: if last { 1 } else { self.shape.tokens() },
        }
    }

    /// Fills the residual stream: class token and projected patches, plus positions.
    fn embed(&self, images: Images<'_>, scratch: &mut Scratch) {
        let (shape, w, values) = (self.shape, self.shape.width, self.shape.patch_values());
        let n_patches = shape.rows * shape.columns;
        let patches = sized(&mut scratch.hidden, n_patches * values);
        let x = sized(&mut scratch.x, images.count() * shape.tokens() * w);
        for (image, tokens) in x.chunks_exact_mut(shape.tokens() * w).enumerate() {
            span(Kind::Patches, 0, || images.patches(image, shape, patches));
            let (class, projected) = tokens.split_at_mut(w);
            class.copy_from_slice(self.parameters[CLASS_TOKEN]);
            let epilogue = Epilogue { accumulate: false, bias: Some(self.parameters[PATCH_BIAS]) };
            let x = Matrix { values: patches, stride: values };
            span(Kind::LinearForward, 2 * n_patches * w * values, || {
                let sizes = [n_patches, w, values];
                scratch.operands.by_weight(
                    shape.products,
                    sizes,
                    x,
                    self.packs.patch(),
                    (projected, w),
                    epilogue,
                );
            });
            norm::add(self.positions, tokens);
        }
    }

    /// Takes the gradient of the residual stream to those of the patch projection, the class token and the positions.
    fn embed_backward(&self, images: Images<'_>, layout: &Layout, sums: &mut [f32], scratch: &mut Scratch) {
        let (shape, w, values) = (self.shape, self.shape.width, self.shape.patch_values());
        let n_patches = shape.rows * shape.columns;
        let patches = sized(&mut scratch.hidden, n_patches * values);
        let dx = sized(&mut scratch.x, images.count() * shape.tokens() * w);
        for (image, tokens) in dx.chunks_exact(shape.tokens() * w).enumerate() {
            span(Kind::Patches, 0, || images.patches(image, shape, patches));
            let (class, projected) = tokens.split_at(w);
            span(Kind::ColumnSums, 0, || {
                norm::add(class, layout.one(sums, CLASS_TOKEN));
                norm::add(tokens, layout.one(sums, layout.positions()));
                norm::add_columns(projected, layout.one(sums, PATCH_BIAS));
            });
            let (dy, x) =
                (Matrix { values: projected, stride: w }, Matrix { values: patches, stride: values });
            span(Kind::LinearWeightGradient, 2 * n_patches * w * values, || {
                let d_weight = layout.one(sums, PATCH_WEIGHT);
                scratch.operands.of_weight(shape.products, [n_patches, w, values], dy, x, d_weight);
            });
        }
    }
}
