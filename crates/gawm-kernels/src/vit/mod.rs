//! A whole vision transformer, from frames to class tokens, forward and backward.
//!
//! Images do not see each other, so that a *chunk* of them (about 256 tokens) goes through all layers on one thread while
//! its values stay in the cache of a core; chunks run in parallel. The last layer works on class tokens only: nothing
//! else of its output is asked for, neither forward nor backward.
//!
//! Gradients of weights are summed over chunks in a fixed number of groups, each in order, then over groups in order, so
//! that they are equal to the bit at any number of threads.

mod chunk;
mod layer;
mod products;
mod weights;

use std::sync::Mutex;

use rayon::prelude::*;

use crate::norm;
use crate::profile::{Kind, span};

pub use chunk::Images;
pub use weights::{LAYER_PARAMETERS, OUTER_PARAMETERS};

use chunk::{ChunkState, Scratch};
use weights::Packs;

/// Sizes of a vision transformer.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VitShape {
    /// Side of a patch in pixels.
    pub patch: usize,
    /// Patches per column of an image.
    pub rows: usize,
    /// Patches per row of an image.
    pub columns: usize,
    /// Channels of an image.
    pub channels: usize,
    /// Width of a token.
    pub width: usize,
    /// Number of layers, at least 1.
    pub depth: usize,
    /// Number of attention heads; divides the width.
    pub heads: usize,
    /// Hidden width of the MLPs.
    pub mlp_width: usize,
    /// Added to the variance in the norms.
    pub epsilon: f32,
    /// How products of linear layers are computed.
    pub products: Products,
}

/// How the products of linear layers are computed; attention, norms and sums are f32 always.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Products {
    /// In f32.
    #[default]
    Single,
    /// Operands rounded to bf16, sums in f32; only where [`crate::pairs::available`].
    Pairs,
}

/// Tokens that a chunk has at least, unless there are no more.
const CHUNK_TOKENS: usize = 256;
/// Groups that gradients of weights are summed in: at most so many threads work on a backward pass.
const GROUPS: usize = 8;

impl VitShape {
    /// Tokens of an image: the class token and the patches.
    pub fn tokens(&self) -> usize {
        1 + self.rows * self.columns
    }

    /// Values of a patch.
    pub fn patch_values(&self) -> usize {
        self.channels * self.patch * self.patch
    }

    /// Number of parameters that [`Vit::forward`] takes.
    pub fn parameters(&self) -> usize {
        OUTER_PARAMETERS + LAYER_PARAMETERS * self.depth
    }

    fn images_per_chunk(&self) -> usize {
        CHUNK_TOKENS.div_ceil(self.tokens()).max(1)
    }
}

/// Memory of passes over images, kept between them.
#[derive(Debug, Default)]
pub struct Vit {
    states: Mutex<Vec<ChunkState>>,
    scratches: Mutex<Vec<Scratch>>,
    packs: Mutex<Vec<Packs>>,
    sums: Mutex<Vec<Vec<f32>>>,
}

/// What a forward pass keeps for the backward pass.
#[derive(Debug)]
pub struct VitState(Vec<ChunkState>);

/// The gradients of a backward pass.
#[derive(Debug)]
pub struct VitGradients {
    /// Of the parameters, in their order and shapes.
    pub parameters: Vec<Vec<f32>>,
    /// Of the position table, [tokens, width].
    pub positions: Vec<f32>,
}

impl Vit {
    /// Starts without memory.
    pub fn new() -> Vit {
        Vit::default()
    }

    /// Maps images to class tokens, normalised by the last norm: `output` [images, width].
    ///
    /// `parameters` are those of [`OUTER_PARAMETERS`] and of each layer ([`LAYER_PARAMETERS`]) in the order given there,
    /// `positions` [tokens, width] is added to the tokens. Returns what [`Vit::backward`] needs if `keep` is set.
    ///
    /// # Panics
    ///
    /// If a slice has not the size that the shape says.
    pub fn forward(
        &self,
        shape: &VitShape,
        images: Images<'_>,
        parameters: &[&[f32]],
        positions: &[f32],
        keep: bool,
        output: &mut [f32],
    ) -> Option<VitState> {
        assert_eq!(parameters.len(), shape.parameters(), "vit: number of parameters");
        assert_eq!(positions.len(), shape.tokens() * shape.width, "vit: size of the position table");
        let per_chunk = shape.images_per_chunk();
        let mut packs = take(&self.packs);
        span(Kind::Packing, 0, || packs.pack_forward(shape, parameters));
        let n_chunks = images.count().div_ceil(per_chunk);
        let chunks = output.par_chunks_mut(per_chunk * shape.width).enumerate();
        let states: Vec<Option<ChunkState>> = chunks
            .map(|(index, output)| {
                let images = images.part(index * per_chunk, output.len() / shape.width);
                let (mut state, mut scratch) = (take(&self.states), take(&self.scratches));
                let pass = chunk::Pass { shape, packs: &packs, parameters, positions };
                pass.forward(images, keep, &mut state, &mut scratch, output);
                put(&self.scratches, scratch);
                if keep {
                    return Some(state);
                }
                put(&self.states, state);
                None
            })
            .collect();
        put(&self.packs, packs);
        debug_assert_eq!(states.len(), n_chunks);
        states.into_iter().collect::<Option<Vec<_>>>().map(VitState)
    }

    /// Returns the gradients, given that of the class tokens: `d_output` [images, width].
    ///
    /// The other arguments are those of the forward pass that kept `state`.
    ///
    /// # Panics
    ///
    /// If a slice has not the size that the shape says.
    pub fn backward(
        &self,
        shape: &VitShape,
        images: Images<'_>,
        parameters: &[&[f32]],
        state: VitState,
        d_output: &[f32],
    ) -> VitGradients {
        let layout = weights::Layout::new(shape);
        let per_chunk = shape.images_per_chunk();
        let mut packs = take(&self.packs);
        span(Kind::Packing, 0, || packs.pack_backward(shape, parameters));
        let VitState(mut states) = state;
        let n_chunks = states.len();
        let per_group = n_chunks.div_ceil(GROUPS).max(1);
        let groups: Vec<Vec<f32>> = states
            .par_chunks_mut(per_group)
            .enumerate()
            .map(|(group, states)| {
                let mut sums = take(&self.sums);
                sums.clear();
                sums.resize(layout.total(), 0.0);
                let mut scratch = take(&self.scratches);
                for (offset, state) in states.iter_mut().enumerate() {
                    let first = (group * per_group + offset) * per_chunk;
                    let images = images.part(first, per_chunk.min(images.count() - first));
                    let d_output = &d_output[first * shape.width..][..images.count() * shape.width];
                    let pass = chunk::Pass { shape, packs: &packs, parameters, positions: &[] };
                    pass.backward(images, state, d_output, &layout, &mut sums, &mut scratch);
                }
                put(&self.scratches, scratch);
                sums
            })
            .collect();
        put(&self.packs, packs);
        for state in states {
            put(&self.states, state);
        }
        let gradients = span(Kind::Reduction, 0, || layout.reduce(&groups));
        for sums in groups {
            put(&self.sums, sums);
        }
        gradients
    }

    /// Gives the memory of a state back that no backward pass will read.
    pub fn discard(&self, VitState(states): VitState) {
        for state in states {
            put(&self.states, state);
        }
    }
}

/// Elements that a thread sums at once in [`weights::Layout::reduce`].
const SUM_ELEMENTS: usize = 16 * 1024;

/// Returns the sum of one range of all groups, group by group.
fn sum_range(groups: &[Vec<f32>], start: usize, count: usize) -> Vec<f32> {
    let mut sum = vec![0.0; count];
    sum.par_chunks_mut(SUM_ELEMENTS).enumerate().for_each(|(index, sum)| {
        let first = start + index * SUM_ELEMENTS;
        for group in groups {
            norm::add(&group[first..first + sum.len()], sum);
        }
    });
    sum
}

/// Takes kept memory, or none yet.
fn take<T: Default>(pool: &Mutex<Vec<T>>) -> T {
    // A thread that panicked inside left whole values behind: the lock is only held to push and pop.
    pool.lock().unwrap_or_else(std::sync::PoisonError::into_inner).pop().unwrap_or_default()
}

fn put<T>(pool: &Mutex<Vec<T>>, value: T) {
    pool.lock().unwrap_or_else(std::sync::PoisonError::into_inner).push(value);
}
