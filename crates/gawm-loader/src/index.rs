//! Everything that decides what the n-th batch holds.

use std::path::PathBuf;

use gawm_schema::ContentHash;
use gawm_schema::batch::{
    Baselines, BatchId, BatchLayout, BatchShape, DatasetInfo, HELLO_VERSION, Hello, Sequence, Split,
};

use crate::clips::{self, Clips};
use crate::config::{Compat, LoaderConfig, SplitRule};
use crate::error::LoadError;
use crate::mt19937::MAX_PERMUTATION;
use crate::order::{ClipOrder, Share, shares};
use crate::source::{Camera, Source};
use crate::standard::{self, Part};

/// Largest relative difference of rates in a mix: a clip of another rate shows another motion.
const MAX_RATE_DIFFERENCE: f64 = 0.01;

/// What the trainer decides about a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RunLength {
    /// Training steps.
    pub total_steps: u64,
    /// Training steps between validations; 0: one validation at the end.
    pub validate_every: u64,
    /// Batches of a validation; fewer where fewer clips are held out.
    pub validation_batches: u64,
    /// This process's rank.
    pub rank: u32,
    /// Number of ranks that share each step.
    pub ranks: u32,
}

impl Default for RunLength {
    fn default() -> Self {
        RunLength { total_steps: 0, validate_every: 0, validation_batches: 0, rank: 0, ranks: 1 }
    }
}

/// Datasets, opened and indexed for a run.
#[derive(Debug)]
pub struct Index {
    pub(crate) config: LoaderConfig,
    pub(crate) sources: Vec<Source>,
    pub(crate) rank: u32,
    layout: BatchLayout,
    hello: Hello,
    stream_hash: ContentHash,
    clips: Clips,
    order: ClipOrder,
}

impl Index {
    /// Opens datasets and lists their clips; `data` is the first dataset, those of `config.mix` follow.
    ///
    /// # Errors
    /// - [`LoadError::Open`], [`LoadError::Dataset`] if a dataset cannot be used
    /// - [`LoadError::Mix`] if the datasets do not fit together
    /// - [`LoadError::TooFewClips`] if there is not one full batch
    /// - [`LoadError::Batch`], [`LoadError::Sequence`] if shape or run cannot be
    pub fn build(data: &[PathBuf], config: &LoaderConfig, run: RunLength) -> Result<Index, LoadError> {
        let mix = config.mix.iter().map(|entry| (entry.data.clone(), entry.weight));
        let folders: Vec<(PathBuf, f64)> =
            data.iter().map(|d| (d.clone(), config.weight)).chain(mix).collect();
        let mut sources = Vec::with_capacity(folders.len());
        for (folder, _) in &folders {
            let source = Source::open(folder, config)?;
            if let Some(first) = sources.first() {
                check_fits(first, &source)?;
            }
            sources.push(source);
        }
        let state_fit = standard::fit(&sources, Part::State, config.compat);
        let action_fit = standard::fit(&sources, Part::Action, config.compat);
        standard::apply(&mut sources, Part::State, &state_fit);
        standard::apply(&mut sources, Part::Action, &action_fit);
        let clips = clips::list(&sources, config);
        let weights: Vec<f64> = folders.iter().map(|(_, weight)| *weight).collect();
        let (order, drawn) = order(config, &clips, &weights)?;
        let per_epoch = drawn.iter().sum();
        let (layout, sequence) = plan(&sources[0], config, &clips, per_epoch, run)?;
        let uses_all_rows = config.split_rule() == SplitRule::Clip;
        let (state, state_variance) = standard::describe(&sources, Part::State, &state_fit, uses_all_rows);
        let (action, action_variance) =
            standard::describe(&sources, Part::Action, &action_fit, uses_all_rows);
        let infos =
            sources.iter().zip(&folders).zip(&drawn).map(|((source, (path, _)), drawn)| DatasetInfo {
                path: path.to_string_lossy().into_owned(),
                content_hash: source.content_hash,
                schema_hash: source.schema_hash,
                share: *drawn as f64 / per_epoch as f64,
                rows: source.n_rows(),
            });
        let schemas: Vec<String> = sources.iter().map(|s| s.schema_hash.to_string()).collect();
        let hello = Hello {
            format_version: HELLO_VERSION,
            datasets: infos.collect(),
            schema_hash: ContentHash::of(schemas.join("\n").as_bytes()),
            shape: *layout.shape(),
            layout_hash: layout.hash(),
            sequence,
            ranks: run.ranks,
            seed: config.seed,
            compat: match config.compat {
                Compat::Repaired => "repaired".to_owned(),
                Compat::Reference => "reference".to_owned(),
            },
            frameskip: config.frameskip,
            history: config.history,
            span: config.span(),
            rate_hz: sources[0].rate_hz,
            cameras: sources[0].cameras.iter().map(|c| c.name.clone()).collect(),
            state,
            action,
            train: clips.train_counts,
            validation: clips.validation_counts,
            baselines: Baselines { state_variance, action_variance },
        };
        let stream_hash = hello.stream_hash();
        let config = config.clone();
        Ok(Index { config, sources, rank: run.rank, layout, hello, stream_hash, clips, order })
    }

    /// Returns what loaders say about the data.
    pub fn hello(&self) -> &Hello {
        &self.hello
    }

    /// Returns the hash over everything that decides what the n-th batch holds.
    pub fn stream_hash(&self) -> ContentHash {
        self.stream_hash
    }

    /// Returns the layout of batches.
    pub fn layout(&self) -> &BatchLayout {
        &self.layout
    }

    /// Returns the ids of the clips of a batch: the number of the dataset in the upper 16 bits, the first row in the others.
    ///
    /// A training batch is full. A validation batch is shorter when the held-out clips end in it.
    pub fn clips_of(&self, batch: BatchId) -> Vec<u64> {
        let size = self.layout.shape().clips;
        match batch.split {
            Split::Train => {
                let order = self.order.epoch(batch.epoch);
                let steps = self.hello.sequence.steps_per_epoch;
                let step = (batch.step % steps) as usize;
                let first = (step * self.hello.ranks as usize + self.rank as usize) * size;
                order[first..first + size].iter().map(|i| self.clips.train[*i as usize]).collect()
            }
            Split::Validation => {
                let step = batch.step as usize * self.hello.ranks as usize + self.rank as usize;
                let all = &self.clips.validation;
                // With several ranks the last ones may find nothing left; they take the first clips again.
                let first = if step * size < all.len() { step * size } else { 0 };
                all[first..all.len().min(first + size)].to_vec()
            }
        }
    }

    /// Returns the cameras of the first dataset; all datasets have them.
    pub(crate) fn cameras(&self) -> &[Camera] {
        &self.sources[0].cameras
    }
}

/// Returns the order of training clips, and how many are drawn per epoch from each dataset.
///
/// When single clips are held out, datasets are one pool, whose clips count for the first.
fn order(config: &LoaderConfig, clips: &Clips, weights: &[f64]) -> Result<(ClipOrder, Vec<u64>), LoadError> {
    let n = clips.train.len();
    let too_many = n as u64 > u64::from(MAX_PERMUTATION);
    if too_many && config.split_rule() == SplitRule::Clip {
        let path = config.mix.first().map(|m| m.data.clone()).unwrap_or_default();
        return Err(LoadError::dataset(&path, format!("at most {MAX_PERMUTATION} clips"), n.to_string()));
    }
    let mut pooled = vec![0; weights.len()];
    pooled[0] = n as u64;
    if config.compat == Compat::Reference {
        return Ok((ClipOrder::reference(config.seed, n as u32), pooled));
    }
    let shares: Vec<Share> = match config.split_rule() {
        SplitRule::Dataset => shares(&clips.train_of, weights),
        SplitRule::Clip => {
            let pool = vec![Share { clips: n as u32, drawn: n as u32 }];
            return Ok((ClipOrder::mixed(config.seed, pool), pooled));
        }
    };
    let drawn = shares.iter().map(|s| u64::from(s.drawn)).collect();
    Ok((ClipOrder::mixed(config.seed, shares), drawn))
}

/// Returns layout and sequence of the run.
fn plan(
    source: &Source,
    config: &LoaderConfig,
    clips: &Clips,
    per_epoch: u64,
    run: RunLength,
) -> Result<(BatchLayout, Sequence), LoadError> {
    let [height, width] = image_size(source, config)?;
    let shape = BatchShape {
        clips: config.batch,
        frames: config.frames(),
        views: source.cameras.len(),
        height,
        width,
        channels: 3,
        action_width: config.frameskip * source.action.dims.len(),
        state_width: source.state.dims.len(),
    };
    let layout = BatchLayout::try_new(shape)?;
    let per_step = config.batch as u64 * u64::from(run.ranks);
    let steps_per_epoch = per_epoch / per_step;
    if steps_per_epoch == 0 {
        let counts = clips.train_counts;
        return Err(LoadError::TooFewClips {
            expected: per_step,
            got: per_epoch,
            excluded: counts.excluded,
            short: counts.short_episodes,
        });
    }
    let available = (clips.validation.len() as u64).div_ceil(per_step);
    let sequence = Sequence {
        total_steps: run.total_steps,
        validate_every: run.validate_every,
        validation_batches: run.validation_batches.min(available),
        steps_per_epoch,
    };
    sequence.check()?;
    Ok((layout, sequence))
}

/// Returns height and width of frames in a slot.
fn image_size(source: &Source, config: &LoaderConfig) -> Result<[usize; 2], LoadError> {
    if let Some(size) = config.image_size {
        return Ok(size);
    }
    let sizes: Vec<[usize; 2]> =
        source.cameras.iter().map(|c| [c.spec.height as usize, c.spec.width as usize]).collect();
    match sizes.as_slice() {
        [first, rest @ ..] if rest.iter().all(|size| size == first) => Ok(*first),
        _ => Err(LoadError::dataset(
            &source.path,
            "cameras of one size, or [loader] image_size",
            format!("sizes {sizes:?}"),
        )),
    }
}

/// Checks that a further dataset of a mix means the same as the first.
fn check_fits(first: &Source, other: &Source) -> Result<(), LoadError> {
    let differs = |what, expected: String, got: String| {
        let (first, second) = (first.path.clone(), other.path.clone());
        Err(LoadError::Mix { what, expected, got, first, second })
    };
    let cameras = |s: &Source| s.cameras.iter().map(|c| c.name.clone()).collect::<Vec<_>>().join(", ");
    if cameras(first) != cameras(other) {
        return differs("cameras", cameras(first), cameras(other));
    }
    let dims = |encoded: &crate::source::Encoded| {
        let dims = encoded.dims.iter().map(|d| format!("{} in {} ({:?})", d.name, d.unit.0, d.encoding));
        dims.collect::<Vec<_>>().join(", ")
    };
    if dims(&first.state) != dims(&other.state) {
        return differs("state dims", dims(&first.state), dims(&other.state));
    }
    if dims(&first.action) != dims(&other.action) {
        return differs("action dims", dims(&first.action), dims(&other.action));
    }
    if (first.rate_hz - other.rate_hz).abs() > MAX_RATE_DIFFERENCE * first.rate_hz {
        return differs("rows per second", first.rate_hz.to_string(), other.rate_hz.to_string());
    }
    Ok(())
}
