//! Random numbers as functions of a seed, a name and a step: ChaCha streams, no global state.

use rand_chacha::ChaCha8Rng;
use rand_chacha::rand_core::{RngCore, SeedableRng};

/// A stream of random numbers that depends on a seed, a name and a step, and on nothing else.
///
/// The name says what the numbers are for (`"init/encoder.layernorm.weight"`, `"dropout/predictor.3.mlp"`), so that two
/// uses never share numbers and adding a use changes no other. ChaCha8 is counter-based: the n-th 32-bit word is a
/// function of (seed, name, step, n).
#[derive(Debug, Clone)]
pub struct Stream {
    rng: ChaCha8Rng,
    spare: Option<f64>,
}

impl Stream {
    /// Opens the stream of `name` at `step`.
    pub fn new(seed: u64, name: &str, step: u64) -> Stream {
        // Two FNV hashes with different bases make 128 bits of the name part of the key.
        let words = [seed, step, fnv1a(name, 0xcbf2_9ce4_8422_2325), fnv1a(name, 0x6c62_272e_07bb_0142)];
        let mut key = [0u8; 32];
        for (bytes, word) in key.chunks_exact_mut(8).zip(words) {
            bytes.copy_from_slice(&word.to_le_bytes());
        }
        Stream { rng: ChaCha8Rng::from_seed(key), spare: None }
    }

    /// Returns the next word.
    pub fn next_u32(&mut self) -> u32 {
        self.rng.next_u32()
    }

    /// Returns a number in [0, 1) with 32 random bits.
    pub fn uniform(&mut self) -> f64 {
        f64::from(self.next_u32()) / 4_294_967_296.0
    }

    /// Returns a standard normal number (Box-Muller; two words give two numbers).
    pub fn normal(&mut self) -> f64 {
        if let Some(spare) = self.spare.take() {
            return spare;
        }
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt(); // 1 - u lies in (0, 1]
        let (sin, cos) = (std::f64::consts::TAU * self.uniform()).sin_cos();
        self.spare = Some(radius * sin);
        radius * cos
    }

    /// Returns a number below `bound`, each equally likely.
    ///
    /// # Panics
    ///
    /// If `bound` is 0.
    pub fn below(&mut self, bound: u32) -> u32 {
        let reject = bound.wrapping_neg() % bound; // Lemire: words below this would make small results likelier
        loop {
            let product = u64::from(self.next_u32()) * u64::from(bound);
            if product as u32 >= reject {
                return (product >> 32) as u32;
            }
        }
    }

    /// Returns `n` standard normal numbers.
    pub fn normals(&mut self, n: usize) -> Vec<f32> {
        (0..n).map(|_| self.normal() as f32).collect()
    }
}

/// Returns 0..n in random order (Fisher-Yates).
pub fn permutation(stream: &mut Stream, n: u32) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n).collect();
    for last in (1..n).rev() {
        order.swap(last as usize, stream.below(last + 1) as usize);
    }
    order
}

fn fnv1a(name: &str, basis: u64) -> u64 {
    name.bytes().fold(basis, |hash, byte| (hash ^ u64::from(byte)).wrapping_mul(0x0000_0100_0000_01b3))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn words(seed: u64, name: &str, step: u64) -> Vec<u32> {
        let mut stream = Stream::new(seed, name, step);
        (0..8).map(|_| stream.next_u32()).collect()
    }

    #[test]
    fn streams_depend_on_seed_name_and_step() {
        assert_eq!(words(1, "a", 2), words(1, "a", 2));
        for other in [words(2, "a", 2), words(1, "b", 2), words(1, "a", 3)] {
            assert_ne!(words(1, "a", 2), other);
        }
    }

    #[test]
    fn moments_are_right() {
        let mut stream = Stream::new(3, "moments", 0);
        let n = 200_000;
        let draws: Vec<f64> = (0..n).map(|_| stream.normal()).collect();
        let mean = draws.iter().sum::<f64>() / n as f64;
        let moment = |power| draws.iter().map(|x| (x - mean).powi(power)).sum::<f64>() / n as f64;
        // Standard errors: 1/sqrt(n) = 0.0022 for the mean, sqrt(2/n) = 0.0032 and sqrt(96/n) = 0.022 for the moments.
        assert!(mean.abs() < 0.01, "mean {mean}");
        assert!((moment(2) - 1.0).abs() < 0.015, "variance {}", moment(2));
        assert!((moment(4) - 3.0).abs() < 0.1, "fourth moment {}", moment(4));
        let uniform = (0..n).map(|_| stream.uniform()).sum::<f64>() / n as f64;
        assert!((uniform - 0.5).abs() < 0.004, "uniform mean {uniform}");
    }

    #[test]
    fn permutations_hold_every_index_once() {
        let mut order = permutation(&mut Stream::new(5, "p", 0), 1000);
        assert_ne!(order[..10], [0, 1, 2, 3, 4, 5, 6, 7, 8, 9]);
        order.sort_unstable();
        assert!(order.iter().copied().eq(0..1000));
    }
}
