//! The order of clips: a pure function of seed and epoch.

use std::sync::{Arc, Mutex, PoisonError};

use gawm_schema::ContentHash;
use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

use crate::mt19937::Mt19937;

/// The order in which training clips are drawn.
#[derive(Debug)]
pub(crate) struct ClipOrder {
    rule: Rule,
    /// The epoch that was asked for last.
    latest: Mutex<Option<(u64, Arc<Vec<u32>>)>>,
}

#[derive(Debug)]
enum Rule {
    /// A permutation of all clips per epoch, as torch's `DataLoader` draws it.
    Reference { seed: u32, clips: u32 },
    /// Each dataset's clips pass by in permutations of their own, mixed by its share.
    Mixed { seed: u64, datasets: Vec<Share> },
}

/// How a dataset takes part in an epoch.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) struct Share {
    /// Its clips.
    pub(crate) clips: u32,
    /// Clips drawn from it per epoch.
    pub(crate) drawn: u32,
}

impl ClipOrder {
    pub(crate) fn reference(seed: u64, clips: u32) -> ClipOrder {
        // torch seeds its Mersenne Twister with the lower 32 bits.
        ClipOrder::with(Rule::Reference { seed: seed as u32, clips })
    }

    pub(crate) fn mixed(seed: u64, datasets: Vec<Share>) -> ClipOrder {
        ClipOrder::with(Rule::Mixed { seed, datasets })
    }

    fn with(rule: Rule) -> ClipOrder {
        ClipOrder { rule, latest: Mutex::new(None) }
    }

    /// Returns the clips of an epoch in order, as positions in the list of training clips.
    pub(crate) fn epoch(&self, epoch: u64) -> Arc<Vec<u32>> {
        let mut latest = self.latest.lock().unwrap_or_else(PoisonError::into_inner);
        match latest.as_ref() {
            Some((known, order)) if *known == epoch => order.clone(),
            _ => {
                let order = Arc::new(self.rule.epoch(epoch));
                *latest = Some((epoch, order.clone()));
                order
            }
        }
    }
}

impl Rule {
    fn epoch(&self, epoch: u64) -> Vec<u32> {
        match self {
            Rule::Reference { seed, clips } => {
                // One generator runs through all epochs: a base seed for workers, the permutation, and a second one that
                // the sampler draws and does not use.
                let mut random = Mt19937::new(*seed);
                for _ in 0..epoch {
                    random.next_i64();
                    (0..2 * u64::from(clips.saturating_sub(1))).for_each(|_| {
                        random.next_u32();
                    });
                }
                random.next_i64();
                random.permutation(*clips)
            }
            Rule::Mixed { seed, datasets } => {
                let mut order = Vec::new();
                let mut first = 0;
                for (number, share) in datasets.iter().enumerate() {
                    draw(*seed, number as u64, *share, epoch, |clip| order.push(first + clip));
                    first += share.clips;
                }
                if datasets.len() > 1 {
                    shuffle(&mut random(*seed, u64::MAX, epoch), &mut order);
                }
                order
            }
        }
    }
}

/// Emits the clips of one dataset in an epoch: the next `drawn` of its endless sequence of permutations.
fn draw(seed: u64, dataset: u64, share: Share, epoch: u64, mut emit: impl FnMut(u32)) {
    let (clips, drawn) = (u128::from(share.clips), u128::from(share.drawn));
    if clips == 0 {
        return;
    }
    let (mut at, end) = (u128::from(epoch) * drawn, (u128::from(epoch) + 1) * drawn);
    while at < end {
        let pass = at / clips;
        let order = permutation(seed, dataset, pass as u64, share.clips);
        let from = (at % clips) as usize;
        let to = (end - pass * clips).min(clips) as usize;
        order[from..to].iter().for_each(|clip| emit(*clip));
        at += (to - from) as u128;
    }
}

/// Returns a permutation that depends on nothing but the arguments.
pub(crate) fn permutation(seed: u64, stream: u64, epoch: u64, n: u32) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n).collect();
    shuffle(&mut random(seed, stream, epoch), &mut order);
    order
}

fn random(seed: u64, stream: u64, epoch: u64) -> ChaCha8Rng {
    let mut bytes = b"gawm clip order 1".to_vec();
    for number in [seed, stream, epoch] {
        bytes.extend(number.to_le_bytes());
    }
    ChaCha8Rng::from_seed(ContentHash::of(&bytes).0)
}

/// Shuffles by Fisher and Yates, without bias.
fn shuffle(random: &mut ChaCha8Rng, order: &mut [u32]) {
    for i in (1..order.len()).rev() {
        order.swap(i, below(random, i as u64 + 1) as usize);
    }
}

/// Returns a number below `bound`, all equally likely (Lemire 2019, arXiv:1805.10941).
fn below(random: &mut ChaCha8Rng, bound: u64) -> u64 {
    let threshold = bound.wrapping_neg() % bound;
    loop {
        let product = u128::from(random.next_u64()) * u128::from(bound);
        if product as u64 >= threshold {
            return (product >> 64) as u64;
        }
    }
}

/// Splits `total` by weights so that the parts add up: largest remainder, ties to the first.
pub(crate) fn shares(clips: &[u32], weights: &[f64]) -> Vec<Share> {
    let wanted: Vec<f64> = clips.iter().zip(weights).map(|(n, w)| f64::from(*n) * w).collect();
    let sum: f64 = wanted.iter().sum();
    let total: u64 = clips.iter().map(|n| u64::from(*n)).sum();
    let exact: Vec<f64> =
        wanted.iter().map(|w| if sum > 0.0 { w / sum * total as f64 } else { 0.0 }).collect();
    let mut drawn: Vec<u64> = exact.iter().map(|e| e.floor() as u64).collect();
    let mut by_remainder: Vec<usize> = (0..clips.len()).collect();
    by_remainder.sort_by(|a, b| {
        let remainder = |i: usize| exact[i] - exact[i].floor();
        remainder(*b).total_cmp(&remainder(*a)).then(a.cmp(b))
    });
    let given: u64 = drawn.iter().sum();
    let missing = if sum > 0.0 { total.saturating_sub(given) } else { 0 };
    for i in by_remainder.into_iter().filter(|i| wanted[*i] > 0.0).cycle().take(missing as usize) {
        drawn[i] += 1;
    }
    let share =
        |(clips, drawn): (&u32, u64)| Share { clips: *clips, drawn: drawn.min(u64::from(u32::MAX)) as u32 };
    clips.iter().zip(drawn).map(share).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_reference_order_is_that_of_a_data_loader() {
        // DataLoader(range(20), batch_size=20, shuffle=True, generator=torch.Generator().manual_seed(3072))
        let order = ClipOrder::reference(3072, 20);
        assert_eq!(*order.epoch(0), [2, 7, 1, 18, 4, 15, 6, 3, 16, 5, 13, 9, 14, 19, 17, 8, 0, 10, 11, 12]);
        assert_eq!(*order.epoch(1), [0, 17, 1, 12, 10, 3, 2, 7, 18, 14, 11, 16, 4, 8, 5, 6, 9, 19, 15, 13]);
        assert_eq!(*order.epoch(2), [7, 18, 3, 12, 2, 10, 9, 11, 13, 19, 14, 16, 15, 4, 17, 6, 1, 5, 8, 0]);
        // A later epoch is that of one generator running on.
        let mut random = Mt19937::new(3072);
        for _ in 0..3 {
            random.next_i64();
            random.permutation(20);
            random.permutation(20);
        }
        random.next_i64();
        assert_eq!(*order.epoch(3), random.permutation(20));
        assert_eq!(order.epoch(0)[..3], [2, 7, 1]);
    }

    #[test]
    fn an_epoch_of_one_dataset_has_every_clip_once() {
        let order = ClipOrder::mixed(7, shares(&[1000], &[1.0]));
        let (first, second) = (order.epoch(0), order.epoch(1));
        assert_ne!(first, second);
        for epoch in [first, second] {
            let mut clips = epoch.to_vec();
            clips.sort_unstable();
            assert!(clips.into_iter().eq(0..1000));
        }
        assert_ne!(ClipOrder::mixed(8, shares(&[1000], &[1.0])).epoch(0), order.epoch(0));
    }

    fn check_shares(clips: &[u32], weights: &[f64], expected: &[u32]) {
        let drawn: Vec<u32> = shares(clips, weights).iter().map(|s| s.drawn).collect();
        assert_eq!(drawn, expected, "{clips:?} {weights:?}");
    }

    #[test]
    fn weights_share_an_epoch() {
        check_shares(&[10], &[5.0], &[10]);
        check_shares(&[10, 30], &[1.0, 1.0], &[10, 30]);
        check_shares(&[10, 30], &[3.0, 1.0], &[20, 20]);
        check_shares(&[10, 30], &[0.0, 1.0], &[0, 40]);
        check_shares(&[1, 1, 1], &[1.0, 1.0, 2.0], &[1, 1, 1]);
        check_shares(&[10, 30], &[0.0, 0.0], &[0, 0]);
        check_shares(&[], &[], &[]);
    }

    #[test]
    fn a_dataset_that_is_drawn_more_often_passes_by_in_whole_permutations() {
        let order = ClipOrder::mixed(7, shares(&[10, 30], &[3.0, 1.0]));
        let mut counts = [0; 40];
        for epoch in 0..3 {
            let clips = order.epoch(epoch);
            assert_eq!(clips.len(), 40);
            clips.iter().for_each(|clip| counts[*clip as usize] += 1);
        }
        assert_eq!(counts[..10], [6; 10]);
        assert_eq!(counts[10..], [2; 30]);
    }
}
