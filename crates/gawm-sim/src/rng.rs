//! The seeded generator of all environments and policies: equal draws on every machine of one kind.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// What a stream of random numbers is for. Streams of one seed are independent of each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stream {
    /// Start and goal of an episode.
    Reset = 1,
    /// Noise of a policy.
    Policy = 2,
    /// The seeds of a collection's episodes.
    Episodes = 3,
}

/// A stream of random numbers.
#[derive(Clone, Debug)]
pub(crate) struct Rng(ChaCha8Rng);

impl Rng {
    /// Returns the stream of `seed` for one purpose.
    pub(crate) fn new(seed: u64, stream: Stream) -> Self {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        rng.set_stream(stream as u64);
        Rng(rng)
    }

    /// Returns number `index` of the stream of 64-bit numbers of `seed`, without drawing those before it.
    pub(crate) fn nth(seed: u64, stream: Stream, index: u64) -> u64 {
        let mut rng = Rng::new(seed, stream);
        rng.0.set_word_pos(u128::from(index) * 2);
        rng.0.next_u64()
    }

    /// Draws from [0, 1) in steps of 2^-53.
    pub(crate) fn unit(&mut self) -> f64 {
        (self.0.next_u64() >> 11) as f64 / (1_u64 << 53) as f64
    }

    /// Draws from [low, high).
    pub(crate) fn uniform(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.unit()
    }

    /// Draws from the standard normal distribution (Box and Muller).
    pub(crate) fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.unit()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.unit()).cos()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nth_is_the_stream() {
        let mut rng = Rng::new(7, Stream::Episodes);
        for index in 0..20 {
            assert_eq!(Rng::nth(7, Stream::Episodes, index), rng.0.next_u64(), "index {index}");
        }
    }

    #[test]
    fn normal_has_its_moments() {
        let mut rng = Rng::new(1, Stream::Policy);
        let draws: Vec<f64> = (0..100_000).map(|_| rng.normal()).collect();
        let mean = draws.iter().sum::<f64>() / draws.len() as f64;
        let variance = draws.iter().map(|d| (d - mean).powi(2)).sum::<f64>() / draws.len() as f64;
        // Six standard errors.
        assert!(mean.abs() < 0.019, "mean {mean}");
        assert!((variance - 1.0).abs() < 0.027, "variance {variance}");
    }
}
