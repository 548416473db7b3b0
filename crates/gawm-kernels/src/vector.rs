//! Vector registers of each level, for register tiles of products.

use crate::gemm::Tile;

/// A vector register.
pub(crate) trait Vector: Copy {
    /// Elements of a register.
    const LANES: usize;
    /// Rows of a tile: as many as leave registers for B and a broadcast, and at most 12.
    const ROWS: usize;
    /// Calls [`Tile::run`] in a function of its own: with all tiles in one, the compiler ran out of registers for what
    /// surrounds their loops, and short sums took up to a quarter longer.
    ///
    /// # Safety
    ///
    /// As [`Tile::run`].
    unsafe fn tile<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>);
    /// # Safety
    ///
    /// Needs the instructions of the type.
    unsafe fn zero() -> Self;
    /// # Safety
    ///
    /// Needs the instructions of the type, and `LANES` elements to read.
    unsafe fn load(from: *const f32) -> Self;
    /// # Safety
    ///
    /// Needs the instructions of the type, and `LANES` elements to write.
    unsafe fn store(self, to: *mut f32);
    /// # Safety
    ///
    /// Needs the instructions of the type.
    unsafe fn splat(value: f32) -> Self;
    /// # Safety
    ///
    /// Needs the instructions of the type.
    unsafe fn mul_add(self, b: Self, c: Self) -> Self;
    /// # Safety
    ///
    /// Needs the instructions of the type.
    unsafe fn add(self, b: Self) -> Self;
}

/// Four lanes that every target has.
#[derive(Clone, Copy)]
pub(crate) struct Four([f32; 4]);

impl Vector for Four {
    const LANES: usize = 4;
    const ROWS: usize = 4;
    #[inline(never)]
    unsafe fn tile<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>) {
        // SAFETY: the caller's promise.
        unsafe { tile.run::<Self, ROWS, VECTORS>() }
    }
    #[inline(always)]
    unsafe fn zero() -> Self {
        Four([0.0; 4])
    }
    #[inline(always)]
    unsafe fn load(from: *const f32) -> Self {
        // SAFETY: the caller has four elements to read; the type has the alignment of its elements.
        Four(unsafe { from.cast::<[f32; 4]>().read() })
    }
    #[inline(always)]
    unsafe fn store(self, to: *mut f32) {
        // SAFETY: the caller has four elements to write; the type has the alignment of its elements.
        unsafe { to.cast::<[f32; 4]>().write(self.0) }
    }
    #[inline(always)]
    unsafe fn splat(value: f32) -> Self {
        Four([value; 4])
    }
    #[inline(always)]
    unsafe fn mul_add(self, b: Self, c: Self) -> Self {
        Four(std::array::from_fn(|i| self.0[i] * b.0[i] + c.0[i]))
    }
    #[inline(always)]
    unsafe fn add(self, b: Self) -> Self {
        Four(std::array::from_fn(|i| self.0[i] + b.0[i]))
    }
}

#[cfg(target_arch = "x86_64")]
pub(crate) mod x86 {
    use std::arch::x86_64::*;

    use super::Vector;
    use crate::gemm::Tile;

    /// Implements [`Vector`] by the intrinsics of one set of instructions.
    macro_rules! vector {
        ($name:ident, $features:literal, $register:ty, $lanes:literal, $rows:literal, $zero:ident, $load:ident, $store:ident, $splat:ident, $fma:ident, $add:ident) => {
            #[derive(Clone, Copy)]
            pub(crate) struct $name($register);

            impl Vector for $name {
                const LANES: usize = $lanes;
                const ROWS: usize = $rows;
                #[inline(always)]
                unsafe fn tile<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>) {
                    #[inline(never)]
                    #[target_feature(enable = $features)]
                    unsafe fn alone<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>) {
                        // SAFETY: the caller's promise.
                        unsafe { tile.run::<$name, ROWS, VECTORS>() }
                    }
                    // SAFETY: the caller has these instructions, and promises the rest.
                    unsafe { alone::<ROWS, VECTORS>(tile) }
                }
                #[inline(always)]
                unsafe fn zero() -> Self {
                    // SAFETY: the caller has these instructions.
                    $name(unsafe { $zero() })
                }
                #[inline(always)]
                unsafe fn load(from: *const f32) -> Self {
                    // SAFETY: the caller has these instructions and the elements; the load needs no alignment.
                    $name(unsafe { $load(from) })
                }
                #[inline(always)]
                unsafe fn store(self, to: *mut f32) {
                    // SAFETY: the caller has these instructions and the elements; the store needs no alignment.
                    unsafe { $store(to, self.0) }
                }
                #[inline(always)]
                unsafe fn splat(value: f32) -> Self {
                    // SAFETY: the caller has these instructions.
                    $name(unsafe { $splat(value) })
                }
                #[inline(always)]
                unsafe fn mul_add(self, b: Self, c: Self) -> Self {
                    // SAFETY: the caller has these instructions.
                    $name(unsafe { $fma(self.0, b.0, c.0) })
                }
                #[inline(always)]
                unsafe fn add(self, b: Self) -> Self {
                    // SAFETY: the caller has these instructions.
                    $name(unsafe { $add(self.0, b.0) })
                }
            }
        };
    }

    /// Sixteen sums in f32 of products of pairs in bf16.
    #[derive(Clone, Copy)]
    pub(crate) struct Pairs(Sixteen);

    impl Vector for Pairs {
        const LANES: usize = Sixteen::LANES;
        const ROWS: usize = Sixteen::ROWS;
        #[inline(always)]
        unsafe fn tile<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>) {
            #[inline(never)]
            #[target_feature(enable = "avx512f,avx512bf16,avx2,fma")]
            unsafe fn alone<const ROWS: usize, const VECTORS: usize>(tile: &Tile<'_>) {
                // SAFETY: the caller's promise.
                unsafe { tile.run::<Pairs, ROWS, VECTORS>() }
            }
            // SAFETY: the caller has these instructions, and promises the rest.
            unsafe { alone::<ROWS, VECTORS>(tile) }
        }
        #[inline(always)]
        unsafe fn zero() -> Self {
            // SAFETY: the caller has these instructions.
            Pairs(unsafe { Sixteen::zero() })
        }
        #[inline(always)]
        unsafe fn load(from: *const f32) -> Self {
            // SAFETY: the caller has these instructions and the elements.
            Pairs(unsafe { Sixteen::load(from) })
        }
        #[inline(always)]
        unsafe fn store(self, to: *mut f32) {
            // SAFETY: the caller has these instructions and the elements.
            unsafe { self.0.store(to) }
        }
        #[inline(always)]
        unsafe fn splat(value: f32) -> Self {
            // SAFETY: the caller has these instructions.
            Pairs(unsafe { Sixteen::splat(value) })
        }
        #[inline(always)]
        unsafe fn mul_add(self, b: Self, c: Self) -> Self {
            // SAFETY: the caller has these instructions; both types are 512 bits, each of which may be anything.
            unsafe {
                let pairs = |register: __m512| std::mem::transmute::<__m512, __m512bh>(register);
                let (a, b) = (pairs(self.0.0), pairs(b.0.0));
                Pairs(Sixteen(_mm512_dpbf16_ps(c.0.0, a, b)))
            }
        }
        #[inline(always)]
        unsafe fn add(self, b: Self) -> Self {
            // SAFETY: the caller has these instructions.
            Pairs(unsafe { self.0.add(b.0) })
        }
    }

    // 32 registers: 24 sums, 2 of B, 1 broadcast. 14 rows would fit, but not the pointers to them.
    vector!(
        Sixteen,
        "avx512f,avx2,fma",
        __m512,
        16,
        12,
        _mm512_setzero_ps,
        _mm512_loadu_ps,
        _mm512_storeu_ps,
        _mm512_set1_ps,
        _mm512_fmadd_ps,
        _mm512_add_ps
    );
    // 16 registers: 12 sums, 2 of B, 1 broadcast.
    vector!(
        Eight,
        "avx2,fma",
        __m256,
        8,
        6,
        _mm256_setzero_ps,
        _mm256_loadu_ps,
        _mm256_storeu_ps,
        _mm256_set1_ps,
        _mm256_fmadd_ps,
        _mm256_add_ps
    );
}
