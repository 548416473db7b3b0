//! Which clips there are, and what is held out.

use gawm_schema::batch::ClipCounts;

use crate::config::{Compat, LoaderConfig, SplitRule};
use crate::mt19937::{MAX_PERMUTATION, Mt19937};
use crate::order::permutation;
use crate::source::{Episode, Source};

/// Bits of a clip id that are the row; the others are the number of the dataset.
const ROW_BITS: u32 = 48;

/// The clips of a mix, as ids.
#[derive(Debug, Default)]
pub(crate) struct Clips {
    /// Training clips: dataset by dataset, then by episode and start (`split = "clip"`: in the permutation's order).
    pub(crate) train: Vec<u64>,
    /// Of each dataset, its training clips.
    pub(crate) train_of: Vec<u32>,
    /// Held-out clips in the order in which validation takes them.
    pub(crate) validation: Vec<u64>,
    pub(crate) train_counts: ClipCounts,
    pub(crate) validation_counts: ClipCounts,
}

/// Returns the id of the clip that begins at a row.
pub(crate) fn id(dataset: usize, row: u64) -> u64 {
    (dataset as u64) << ROW_BITS | row
}

/// Returns dataset and first row of a clip.
pub(crate) fn parts(id: u64) -> (usize, u64) {
    ((id >> ROW_BITS) as usize, id & ((1 << ROW_BITS) - 1))
}

/// Lists all clips and splits them.
pub(crate) fn list(sources: &[Source], config: &LoaderConfig) -> Clips {
    match config.split_rule() {
        SplitRule::Dataset => by_episode(sources, config),
        SplitRule::Clip => by_clip(sources, config),
    }
}

fn by_episode(sources: &[Source], config: &LoaderConfig) -> Clips {
    let mut clips = Clips::default();
    let mut validation = Vec::new();
    for (number, source) in sources.iter().enumerate() {
        let before = clips.train.len();
        for episode in &source.episodes {
            let (ids, counts) = if episode.is_training {
                (&mut clips.train, &mut clips.train_counts)
            } else {
                (&mut validation, &mut clips.validation_counts)
            };
            starts(source, episode, config, counts, |row| ids.push(id(number, row)));
        }
        clips.train_of.push((clips.train.len() - before) as u32);
    }
    // A few validation batches should show every episode, so they are drawn; the same ones each time.
    let order = permutation(config.seed, u64::MAX - 1, 0, validation.len() as u32);
    clips.validation = order.into_iter().map(|i| validation[i as usize]).collect();
    clips
}

/// Splits single clips 9 to 1 as `torch.utils.data.random_split(dataset, [0.9, 1 - 0.9])` does.
fn by_clip(sources: &[Source], config: &LoaderConfig) -> Clips {
    let mut all = Vec::new();
    let mut counts = ClipCounts::default();
    for (number, source) in sources.iter().enumerate() {
        for episode in &source.episodes {
            starts(source, episode, config, &mut counts, |row| all.push(id(number, row)));
        }
    }
    let n = all.len().min(MAX_PERMUTATION as usize) as u32;
    let order = Mt19937::new(config.seed as u32).permutation(n);
    let n_train = n_train(n) as usize;
    let mut clips = Clips::default();
    let ids = |positions: &[u32]| positions.iter().map(|i| all[*i as usize]).collect();
    (clips.train, clips.validation) = (ids(&order[..n_train]), ids(&order[n_train..]));
    clips.train_of = vec![clips.train.len() as u32];
    clips.train_counts = ClipCounts { clips: clips.train.len() as u64, ..counts };
    let (clips_held, episodes) = (clips.validation.len() as u64, counts.episodes);
    clips.validation_counts = ClipCounts { clips: clips_held, episodes, ..ClipCounts::default() };
    clips
}

/// Returns the training share of n clips: floors of 0.9 n and (1 - 0.9) n, what remains dealt out from training on.
pub(crate) fn n_train(n: u32) -> u32 {
    let floor = |share: f64| (f64::from(n) * share).floor() as u32;
    let (train, validation) = (floor(0.9), floor(1.0 - 0.9));
    train + (n - train - validation).div_ceil(2)
}

/// Emits the first rows of an episode's clips and counts what is left out.
fn starts(
    source: &Source,
    episode: &Episode,
    config: &LoaderConfig,
    counts: &mut ClipCounts,
    mut emit: impl FnMut(u64),
) {
    counts.episodes += 1;
    let span = config.span();
    if episode.rows < span {
        counts.short_episodes += 1;
        return;
    }
    let views = source.cameras.len();
    for start in 0..=episode.rows - span {
        let row = episode.first_row as usize + start;
        let is_whole = config.compat == Compat::Reference || {
            let mut frames = (0..config.frames()).map(|t| row + t * config.frameskip);
            frames.all(|row| source.rows.is_frame_valid(row, views))
                && source.rows.are_actions_valid(row..row + config.action_rows())
        };
        if is_whole {
            counts.clips += 1;
            emit(row as u64);
        } else {
            counts.excluded += 1;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_split_of_clips_has_the_published_sizes() {
        // len(random_split(range(n), [0.9, 1 - 0.9])[0]) of torch.
        let sizes = [(0, 0), (1, 1), (9, 9), (10, 10), (11, 10), (20, 19), (1000, 901)];
        for (n, expected) in sizes.into_iter().chain([(1_981_721, 1_783_549), (1_820_000, 1_638_001)]) {
            assert_eq!(n_train(n), expected, "{n}");
        }
    }

    #[test]
    fn ids_hold_dataset_and_row() {
        assert_eq!(parts(id(3, 123_456_789)), (3, 123_456_789));
        assert_eq!(id(0, 42), 42);
    }
}
