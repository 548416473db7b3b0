//! The Mersenne Twister as torch and numpy seed it, and torch's permutation.

const N: usize = 624;
const M: usize = 397;

/// MT19937 (Matsumoto and Nishimura 1998), seeded by `init_genrand` as `torch.Generator().manual_seed` and
/// `numpy.random.RandomState` do.
///
/// ```
/// let mut random = gawm_loader::Mt19937::new(3072);
/// assert_eq!(random.next_u32(), 3745973231);
/// ```
#[derive(Debug, Clone)]
pub struct Mt19937 {
    state: Box<[u32; N]>,
    next: usize,
}

impl Mt19937 {
    /// Seeds a generator; as in torch only the lower 32 bits of a seed count.
    pub fn new(seed: u32) -> Mt19937 {
        let mut state = Box::new([0; N]);
        state[0] = seed;
        for i in 1..N {
            let before: u32 = state[i - 1];
            state[i] = 1_812_433_253_u32.wrapping_mul(before ^ before >> 30).wrapping_add(i as u32);
        }
        Mt19937 { state, next: N }
    }

    /// Returns the next 32 bits.
    pub fn next_u32(&mut self) -> u32 {
        if self.next == N {
            self.twist();
        }
        let mut y = self.state[self.next];
        self.next += 1;
        y ^= y >> 11;
        y ^= y << 7 & 0x9d2c_5680;
        y ^= y << 15 & 0xefc6_0000;
        y ^ y >> 18
    }

    /// Returns what `torch.empty((), dtype=torch.int64).random_()` draws: 63 bits of two draws, the first one high.
    pub fn next_i64(&mut self) -> i64 {
        let high = u64::from(self.next_u32());
        let bits = high << 32 | u64::from(self.next_u32());
        (bits & (i64::MAX as u64)) as i64
    }

    /// Returns `torch.randperm(n)` for n below 2^32 / 20, above which torch draws 64 bits.
    ///
    /// # Panics
    /// If n is not below that bound; `MAX_PERMUTATION` says it.
    pub fn permutation(&mut self, n: u32) -> Vec<u32> {
        assert!(n <= MAX_PERMUTATION, "a permutation of {n} elements");
        let mut order: Vec<u32> = (0..n).collect();
        for i in 0..n.saturating_sub(1) {
            let z = self.next_u32() % (n - i);
            order.swap(i as usize, (i + z) as usize);
        }
        order
    }

    fn twist(&mut self) {
        let state = &mut self.state;
        for i in 0..N {
            let y = state[i] & 0x8000_0000 | state[(i + 1) % N] & 0x7fff_ffff;
            let odd = if y & 1 == 1 { 0x9908_b0df } else { 0 };
            state[i] = state[(i + M) % N] ^ y >> 1 ^ odd;
        }
        self.next = 0;
    }
}

/// Largest permutation that torch draws with 32 bits a step.
pub(crate) const MAX_PERMUTATION: u32 = u32::MAX / 20;

#[cfg(test)]
mod tests {
    use super::*;

    // The values are torch's and numpy's own (`torch.Generator().manual_seed(3072)`).

    #[test]
    fn draws_are_those_of_numpy() {
        let mut random = Mt19937::new(3072);
        let draws: Vec<u32> = (0..4).map(|_| random.next_u32()).collect();
        assert_eq!(draws, [3_745_973_231, 4_155_847_203, 1_773_956_602, 2_511_066_226]);
        assert_eq!(Mt19937::new(3072).next_i64(), 6_865_460_486_137_524_771);
    }

    #[test]
    fn permutations_are_those_of_torch() {
        assert_eq!(Mt19937::new(3072).permutation(10), [1, 4, 0, 7, 9, 5, 6, 8, 3, 2]);
        let long = Mt19937::new(3072).permutation(1000);
        assert_eq!(long[..10], [231, 211, 626, 95, 9, 450, 438, 998, 706, 548]);
        let mut sorted = long;
        sorted.sort_unstable();
        assert!(sorted.into_iter().eq(0..1000));
        assert_eq!(Mt19937::new(3072).permutation(1), [0]);
        assert_eq!(Mt19937::new(3072).permutation(0), [0; 0]);
    }

    #[test]
    fn the_state_is_renewed_as_published() {
        // The 10,000th output for seed 5489, from the C++ standard's definition of std::mt19937.
        let mut random = Mt19937::new(5489);
        let last = (0..10_000).map(|_| random.next_u32()).last();
        assert_eq!(last, Some(4_123_659_995));
    }
}
