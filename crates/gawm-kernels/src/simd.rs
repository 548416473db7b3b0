//! Which vector instructions this processor has, and functions compiled once per set of them.
//!
//! A function written inside [`vectorized!`] is compiled three times, for AVX-512, for AVX2 with FMA, and for the target
//! of the build; the compiler vectorises its loops for each. Which copy runs is decided by [`level`] at run time.

use std::sync::atomic::{AtomicU8, Ordering};

/// A set of vector instructions.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Level {
    /// What the build targets; on x86-64 that is SSE2.
    Portable = 1,
    /// AVX2 and FMA: 8 lanes.
    Avx2 = 2,
    /// AVX-512 F, VL, DQ and BW: 16 lanes.
    Avx512 = 3,
}

/// The level in use; 0 until it is found.
static LEVEL: AtomicU8 = AtomicU8::new(0);

/// Returns the level in use: the best that this processor has, unless [`limit_level`] lowered it.
pub fn level() -> Level {
    match LEVEL.load(Ordering::Relaxed) {
        0 => {
            let found = detect();
            LEVEL.store(found as u8, Ordering::Relaxed);
            found
        }
        1 => Level::Portable,
        2 => Level::Avx2,
        _ => Level::Avx512,
    }
}

/// Uses no better level than `limit` from now on, in the whole process, and returns the level in use.
///
/// For tests and measurements. Results of two levels differ in their last bits.
pub fn limit_level(limit: Level) -> Level {
    let chosen = detect().min(limit);
    LEVEL.store(chosen as u8, Ordering::Relaxed);
    chosen
}

/// Returns the best level that this processor has.
pub fn detect() -> Level {
    #[cfg(target_arch = "x86_64")]
    {
        let fma = is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma");
        let wide = is_x86_feature_detected!("avx512f")
            && is_x86_feature_detected!("avx512vl")
            && is_x86_feature_detected!("avx512dq")
            && is_x86_feature_detected!("avx512bw");
        if fma && wide {
            return Level::Avx512;
        }
        if fma {
            return Level::Avx2;
        }
    }
    Level::Portable
}

/// Defines functions that are compiled for each [`Level`] and dispatched at run time.
///
/// The body sees a constant `FMA: bool`, to be handed to [`mul_add`](crate::simd::mul_add).
macro_rules! vectorized {
    ($($(#[$meta:meta])* $vis:vis fn $name:ident($($arg:ident: $ty:ty),* $(,)?) $(-> $ret:ty)? $body:block)*) => {$(
        $(#[$meta])*
        $vis fn $name($($arg: $ty),*) $(-> $ret)? {
            #[inline(always)]
            fn body<const FMA: bool>($($arg: $ty),*) $(-> $ret)? $body

            #[cfg(target_arch = "x86_64")]
            {
                #[target_feature(enable = "avx512f,avx512vl,avx512dq,avx512bw,avx2,fma")]
                fn avx512($($arg: $ty),*) $(-> $ret)? {
                    body::<true>($($arg),*)
                }
                #[target_feature(enable = "avx2,fma")]
                fn avx2($($arg: $ty),*) $(-> $ret)? {
                    body::<true>($($arg),*)
                }
                match $crate::simd::level() {
                    // SAFETY: the level is only in use if `detect` found these features on this processor.
                    $crate::simd::Level::Avx512 => return unsafe { avx512($($arg),*) },
                    // SAFETY: as above.
                    $crate::simd::Level::Avx2 => return unsafe { avx2($($arg),*) },
                    $crate::simd::Level::Portable => {}
                }
            }
            body::<false>($($arg),*)
        }
    )*};
}
pub(crate) use vectorized;

/// Returns `a * b + c`, rounded once where the hardware has such an instruction (`FMA`), else twice.
#[inline(always)]
pub(crate) fn mul_add<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA { a.mul_add(b, c) } else { a * b + c }
}

/// Lanes of the partial sums of reductions; a multiple of every vector width, so that all levels vectorise.
pub(crate) const LANES: usize = 16;

/// Sums `x` in 16 interleaved partial sums: a fixed order, whatever the threads.
#[inline(always)]
pub(crate) fn sum(x: &[f32]) -> f32 {
    let mut lanes = [0f32; LANES];
    let mut chunks = x.chunks_exact(LANES);
    for chunk in &mut chunks {
        for (lane, x) in lanes.iter_mut().zip(chunk) {
            *lane += x;
        }
    }
    for (lane, x) in lanes.iter_mut().zip(chunks.remainder()) {
        *lane += x;
    }
    fold(lanes, |a, b| a + b)
}

/// Sums the products of `a` and `b`, in the order of [`sum`].
#[inline(always)]
pub(crate) fn dot<const FMA: bool>(a: &[f32], b: &[f32]) -> f32 {
    let mut lanes = [0f32; LANES];
    let (mut chunks, mut others) = (a.chunks_exact(LANES), b.chunks_exact(LANES));
    for (a, b) in (&mut chunks).zip(&mut others) {
        for ((lane, a), b) in lanes.iter_mut().zip(a).zip(b) {
            *lane = mul_add::<FMA>(*a, *b, *lane);
        }
    }
    for ((lane, a), b) in lanes.iter_mut().zip(chunks.remainder()).zip(others.remainder()) {
        *lane = mul_add::<FMA>(*a, *b, *lane);
    }
    fold(lanes, |a, b| a + b)
}

/// Combines 16 lanes pairwise.
#[inline(always)]
pub(crate) fn fold(mut lanes: [f32; LANES], f: impl Fn(f32, f32) -> f32) -> f32 {
    let mut half = LANES / 2;
    while half > 0 {
        for lane in 0..half {
            lanes[lane] = f(lanes[lane], lanes[lane + half]);
        }
        half /= 2;
    }
    lanes[0]
}

/// Returns the largest value of `x`, minus infinity if there is none. NaN is passed over.
#[inline(always)]
pub(crate) fn max_of(x: &[f32]) -> f32 {
    let mut lanes = [f32::NEG_INFINITY; LANES];
    let mut chunks = x.chunks_exact(LANES);
    for chunk in &mut chunks {
        for (lane, value) in lanes.iter_mut().zip(chunk) {
            *lane = if *value > *lane { *value } else { *lane };
        }
    }
    for (lane, value) in lanes.iter_mut().zip(chunks.remainder()) {
        *lane = if *value > *lane { *value } else { *lane };
    }
    fold(lanes, |a, b| if b > a { b } else { a })
}

/// Returns e^x with a relative error below 2e-7; 0 below -87.3, and e^88.3 (two thirds of the largest f32) above 88.3.
///
/// Cody-Waite reduction to [-ln 2 / 2, ln 2 / 2] and the Taylor-like minimax polynomial of Cephes' `expf`.
#[inline(always)]
pub(crate) fn exp<const FMA: bool>(x: f32) -> f32 {
    const ROUND: f32 = 12_582_912.0; // 1.5 * 2^23: adding it rounds to an integer in the low bits
    // The upper end keeps n at 127, which has a power of two of its own.
    let clamped = x.clamp(-87.336_54, 88.3);
    let shifted = mul_add::<FMA>(clamped, std::f32::consts::LOG2_E, ROUND);
    let n = shifted - ROUND;
    let r = mul_add::<FMA>(n, -0.693_359_4, clamped);
    let r = mul_add::<FMA>(n, 2.121_944_4e-4, r);
    let mut p = 1.987_569_1e-4;
    p = mul_add::<FMA>(p, r, 1.398_199_9e-3);
    p = mul_add::<FMA>(p, r, 8.333_452e-3);
    p = mul_add::<FMA>(p, r, 4.166_579_6e-2);
    p = mul_add::<FMA>(p, r, 1.666_666_5e-1);
    p = mul_add::<FMA>(p, r, 5e-1);
    let p = mul_add::<FMA>(p, r * r, r + 1.0);
    // 2^n by its exponent bits.
    let n = (shifted.to_bits() as i32).wrapping_sub(ROUND.to_bits() as i32);
    let y = p * f32::from_bits((n.wrapping_add(127) as u32) << 23);
    if x < -87.336_54 { 0.0 } else { y }
}

/// Returns erf(x) with an absolute error below 5e-7 (the rational minimax approximation of Eigen); +-1 from +-4 on.
#[inline(always)]
pub(crate) fn erf<const FMA: bool>(x: f32) -> f32 {
    let (argument, x) = (x, x.clamp(-4.0, 4.0));
    let x2 = x * x;
    let mut p = -2.726_142_3e-10;
    p = mul_add::<FMA>(p, x2, 2.770_681_5e-8);
    p = mul_add::<FMA>(p, x2, -2.101_024e-6);
    p = mul_add::<FMA>(p, x2, -5.692_506_6e-5);
    p = mul_add::<FMA>(p, x2, -7.349_906e-4);
    p = mul_add::<FMA>(p, x2, -2.954_6e-3);
    p = mul_add::<FMA>(p, x2, -1.609_603_3e-2);
    let mut q = -1.456_607_2e-5;
    q = mul_add::<FMA>(q, x2, -2.133_740_6e-4);
    q = mul_add::<FMA>(q, x2, -1.682_827e-3);
    q = mul_add::<FMA>(q, x2, -7.373_329e-3);
    q = mul_add::<FMA>(q, x2, -1.426_474e-2);
    let y = x * p / q;
    if argument.abs() >= 4.0 { x * 0.25 } else { y }
}

/// Returns the standard normal distribution function, Phi(x).
#[inline(always)]
pub(crate) fn normal_cdf<const FMA: bool>(x: f32) -> f32 {
    0.5 + 0.5 * erf::<FMA>(x * std::f32::consts::FRAC_1_SQRT_2)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// erf by its Taylor series or continued fraction, in f64.
    fn erf_f64(x: f64) -> f64 {
        if x.abs() > 5.0 {
            return x.signum();
        }
        let (mut term, mut sum) = (x, x);
        for n in 1..200 {
            term *= -x * x / f64::from(n);
            sum += term / f64::from(2 * n + 1);
        }
        sum * 2.0 / std::f64::consts::PI.sqrt()
    }

    fn check<const FMA: bool>() {
        let mut worst = (0f64, 0f64);
        for i in -89_000..=89_000 {
            let x = i as f32 * 1e-3;
            let exact = f64::from(x).exp();
            if (-87.0..88.3).contains(&x) {
                worst.0 = worst.0.max((f64::from(exp::<FMA>(x)) / exact - 1.0).abs());
            }
            let x = x * 0.1;
            worst.1 = worst.1.max((f64::from(erf::<FMA>(x)) - erf_f64(f64::from(x))).abs());
        }
        assert!(worst.0 < 2e-7 && worst.1 < 5e-7, "exp {:e}, erf {:e}", worst.0, worst.1);
        assert_eq!((exp::<FMA>(f32::NEG_INFINITY), exp::<FMA>(-1e4)), (0.0, 0.0));
        assert_eq!((exp::<FMA>(0.0), erf::<FMA>(1e30), erf::<FMA>(-9.0)), (1.0, 1.0, -1.0));
        assert!(exp::<FMA>(f32::NAN).is_nan() && erf::<FMA>(f32::NAN).is_nan());
    }

    #[test]
    fn exp_and_erf_are_close_to_exact() {
        check::<true>();
        check::<false>();
    }

    #[test]
    fn reductions_see_every_element() {
        for n in [0, 1, 15, 16, 17, 33] {
            let x: Vec<f32> = (0..n).map(|i| i as f32).collect();
            assert_eq!(sum(&x), (0..n).map(|i| i as f32).sum::<f32>());
            assert_eq!(dot::<false>(&x, &x), (0..n).map(|i| (i * i) as f32).sum::<f32>());
            assert_eq!(max_of(&x), x.iter().copied().fold(f32::NEG_INFINITY, f32::max));
        }
    }
}
