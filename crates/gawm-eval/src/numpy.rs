//! numpy's seeded choice, so that the published evaluation picks the published problems.
//!
//! `numpy.random.default_rng(seed).choice(n, k, replace=False)` is SeedSequence, PCG64 (XSL-RR 128/64), Lemire's bounded
//! integers and Floyd's sampling (or a shuffle of the tail). All are repeated here bit for bit.

use std::collections::BTreeSet;

const INIT_A: u32 = 0x43b0_d7e5;
const MULT_A: u32 = 0x931e_8875;
const INIT_B: u32 = 0x8b51_f9dd;
const MULT_B: u32 = 0x58f3_8ded;
const MIX_L: u32 = 0xca01_f9dd;
const MIX_R: u32 = 0x4973_f715;
const XSHIFT: u32 = 16;
const POOL: usize = 4;

/// PCG64 as `numpy.random.default_rng(seed)` seeds it.
#[derive(Debug, Clone)]
pub struct Pcg64 {
    state: u128,
    increment: u128,
    spare: Option<u32>,
}

impl Pcg64 {
    const MULTIPLIER: u128 = 0x2360_ED05_1FC6_5DA4_4385_DF64_9FCC_F645;

    /// Seeds the generator as `default_rng(seed)` does.
    pub fn new(seed: u64) -> Pcg64 {
        let words = seed_sequence(seed);
        let wide = |high: u64, low: u64| (u128::from(high) << 64) | u128::from(low);
        let increment = wide(words[2], words[3]).wrapping_shl(1) | 1;
        let mut generator = Pcg64 { state: 0, increment, spare: None };
        generator.step();
        generator.state = generator.state.wrapping_add(wide(words[0], words[1]));
        generator.step();
        generator
    }

    fn step(&mut self) {
        self.state = self.state.wrapping_mul(Self::MULTIPLIER).wrapping_add(self.increment);
    }

    /// Returns the next 64-bit word.
    pub fn next_u64(&mut self) -> u64 {
        self.step();
        let folded = (self.state >> 64) as u64 ^ self.state as u64;
        folded.rotate_right((self.state >> 122) as u32)
    }

    /// Returns the low half of a word, then its high half.
    pub fn next_u32(&mut self) -> u32 {
        if let Some(high) = self.spare.take() {
            return high;
        }
        let word = self.next_u64();
        self.spare = Some((word >> 32) as u32);
        word as u32
    }

    /// Returns a number from 0 to `last`, inclusive, each equally likely (Lemire).
    pub fn up_to(&mut self, last: u32) -> u32 {
        if last == u32::MAX {
            return self.next_u32();
        }
        if last == 0 {
            return 0; // numpy draws nothing here
        }
        let count = last + 1;
        let mut product = u64::from(self.next_u32()) * u64::from(count);
        if (product as u32) < count {
            let threshold = (u32::MAX - last) % count;
            while (product as u32) < threshold {
                product = u64::from(self.next_u32()) * u64::from(count);
            }
        }
        (product >> 32) as u32
    }
}

/// Mixes a seed into four 64-bit words, as `SeedSequence(seed).generate_state(4, uint64)`.
fn seed_sequence(seed: u64) -> [u64; 4] {
    let entropy = [seed as u32, (seed >> 32) as u32];
    let entropy = if entropy[1] == 0 { &entropy[..1] } else { &entropy[..] };
    let mut hash = INIT_A;
    let mut hashed = |value: u32| {
        let value = value ^ hash;
        hash = hash.wrapping_mul(MULT_A);
        let value = value.wrapping_mul(hash);
        value ^ (value >> XSHIFT)
    };
    let mix = |x: u32, y: u32| {
        let value = MIX_L.wrapping_mul(x).wrapping_sub(MIX_R.wrapping_mul(y));
        value ^ (value >> XSHIFT)
    };
    let mut pool = [0u32; POOL];
    for (index, slot) in pool.iter_mut().enumerate() {
        *slot = hashed(entropy.get(index).copied().unwrap_or(0));
    }
    for from in 0..POOL {
        for to in (0..POOL).filter(|to| *to != from) {
            pool[to] = mix(pool[to], hashed(pool[from]));
        }
    }
    let mut hash = INIT_B;
    let mut word = |index: usize| {
        let value = pool[index % POOL] ^ hash;
        hash = hash.wrapping_mul(MULT_B);
        let value = value.wrapping_mul(hash);
        u64::from(value ^ (value >> XSHIFT))
    };
    std::array::from_fn(|index| word(2 * index) | (word(2 * index + 1) << 32))
}

/// Returns `sorted(default_rng(seed).choice(n, k, replace=False))`; all of `0..n` if `k` is not below `n`.
pub fn sorted_choice(seed: u64, n: u32, k: u32) -> Vec<u32> {
    if k >= n {
        return (0..n).collect();
    }
    let mut generator = Pcg64::new(seed);
    if n > 10_000 && k > n / 50 {
        return tail_of_shuffle(&mut generator, n, k);
    }
    let mut chosen = BTreeSet::new();
    for last in n - k..n {
        let drawn = generator.up_to(last);
        if !chosen.insert(drawn) {
            chosen.insert(last);
        }
    }
    chosen.into_iter().collect()
}

/// Shuffles only the last `k` of `0..n` and returns them, sorted.
fn tail_of_shuffle(generator: &mut Pcg64, n: u32, k: u32) -> Vec<u32> {
    let mut order: Vec<u32> = (0..n).collect();
    for last in ((n - k).max(1)..n).rev() {
        order.swap(last as usize, generator.up_to(last) as usize);
    }
    let mut tail = order.split_off((n - k) as usize);
    tail.sort_unstable();
    tail
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn words_are_numpys() {
        let mut generator = Pcg64::new(42);
        assert_eq!(generator.next_u64(), 14_276_969_152_011_380_360);
        assert_eq!(generator.next_u64(), 8_095_878_257_575_067_585);
    }

    fn check_choice(seed: u64, n: u32, k: u32, head: &[u32], tail: &[u32]) {
        let chosen = sorted_choice(seed, n, k);
        assert_eq!(chosen.len(), k as usize);
        assert_eq!(&chosen[..head.len()], head, "n = {n}");
        assert_eq!(&chosen[chosen.len() - tail.len()..], tail, "n = {n}");
    }

    /// Printed by `sorted(numpy.random.default_rng(seed).choice(n, k, replace=False))`, numpy 2.2.
    #[test]
    fn choices_are_numpys() {
        check_choice(42, 1000, 50, &[62, 67, 82, 84, 90, 124], &[938, 966, 982]);
        check_choice(
            42,
            123_456,
            50,
            &[7877, 8384, 10_606, 11_014, 11_373, 11_622],
            &[114_390, 119_834, 120_409],
        );
        let head = [127_633, 135_839, 171_887, 178_497, 184_270, 188_350];
        check_choice(42, 2_000_000, 50, &head, &[1_853_505, 1_941_392, 1_951_207]);
    }

    #[test]
    fn dense_choices_shuffle_the_tail_and_wide_seeds_have_two_words() {
        check_choice(7, 12_000, 400, &[37, 44, 60, 63, 90, 140], &[11_902, 11_911, 11_913]);
        check_choice((1 << 40) + 5, 20_000, 50, &[94, 197, 282, 612, 851, 1002], &[18_296, 18_535, 19_680]);
        check_choice(0, 10_000, 300, &[26, 52, 80, 145, 158, 160], &[9973, 9977, 9996]);
        check_choice(5, 50, 50, &[0, 1, 2], &[48, 49]);
        check_choice(3, 4, 1, &[3], &[]);
    }
}
