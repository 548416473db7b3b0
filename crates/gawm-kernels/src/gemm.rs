//! Matrix products on one thread, for operands that lie in the cache of a core.
//!
//! Callers split their work (images, rows, panels) over threads and call [`gemm`] inside each, so that a product never
//! waits for another thread and its result does not depend on their number. Every element of the result is one sum over
//! `k` in order.
//!
//! A register tile of rows x two vectors is kept while `k` runs; an element of A is broadcast straight from where it lies
//! (A is never copied), a row of B is two vectors, either from a matrix or from a panel made by [`Packed`].

use crate::simd::{Level, level};
#[cfg(target_arch = "x86_64")]
use crate::vector::x86;
use crate::vector::{Four, Vector};

pub use crate::pack::{Packed, panel_width};

/// The left operand, read element by element: `a(i, k) = values[i * row_stride + k * k_stride]`.
#[derive(Debug, Clone, Copy)]
pub struct Lhs<'a> {
    /// The elements.
    pub values: &'a [f32],
    /// Distance between rows of the result.
    pub row_stride: usize,
    /// Distance along the sum; 1 for a matrix, its width for the transpose of one.
    pub k_stride: usize,
}

/// The right operand, `[k, n]`, read in rows.
#[derive(Debug, Clone, Copy)]
pub enum Rhs<'a> {
    /// Row `k` begins at `values[k * stride]`.
    Rows {
        /// The elements.
        values: &'a [f32],
        /// Distance between rows.
        stride: usize,
    },
    /// Panels made before, for an operand that is used often.
    Packed(&'a Packed),
}

/// What becomes of the sums.
#[derive(Debug, Clone, Copy, Default)]
pub struct Epilogue<'a> {
    /// Add to what the output holds instead of overwriting it.
    pub accumulate: bool,
    /// Added to each row, `[n]`.
    pub bias: Option<&'a [f32]>,
}

/// Overwrites the output.
pub const STORE: Epilogue<'static> = Epilogue { accumulate: false, bias: None };
/// Adds to the output.
pub const ACCUMULATE: Epilogue<'static> = Epilogue { accumulate: true, bias: None };

/// Computes `C = A B`, with `C [m, n]` in rows of `c_stride` elements and a sum over `k` terms.
///
/// # Panics
///
/// If an operand is too short for its strides, or a packed operand was packed for other sizes or another level.
pub fn gemm(
    [m, n, k]: [usize; 3],
    a: Lhs<'_>,
    b: Rhs<'_>,
    c: &mut [f32],
    c_stride: usize,
    epilogue: Epilogue<'_>,
) {
    product([m, n, k], a, b, c, c_stride, epilogue, Terms::Single);
}

/// [`gemm`] of operands in pairs ([`crate::pairs`]): `k` counts pairs.
///
/// # Panics
///
/// As [`gemm`], and if the processor has no such instruction ([`crate::pairs::available`]).
pub fn gemm_pairs(
    sizes: [usize; 3],
    a: Lhs<'_>,
    b: Rhs<'_>,
    c: &mut [f32],
    c_stride: usize,
    epilogue: Epilogue<'_>,
) {
    assert!(crate::pairs::available(), "gemm: expected a processor with avx512_bf16");
    product(sizes, a, b, c, c_stride, epilogue, Terms::Pairs);
}

/// What an element of an operand holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Terms {
    /// A value.
    Single,
    /// Two values in bf16.
    Pairs,
}

fn product(
    [m, n, k]: [usize; 3],
    a: Lhs<'_>,
    b: Rhs<'_>,
    c: &mut [f32],
    c_stride: usize,
    epilogue: Epilogue<'_>,
    terms: Terms,
) {
    if m == 0 || n == 0 {
        return;
    }
    let width = panel_width();
    assert!(n <= c_stride && (m - 1) * c_stride + n <= c.len(), "gemm: output is too short");
    assert!(epilogue.bias.is_none_or(|bias| bias.len() >= n), "gemm: bias is too short");
    if k == 0 {
        return without_terms([m, n], c, c_stride, epilogue);
    }
    assert!(
        (m - 1) * a.row_stride + (k - 1) * a.k_stride < a.values.len(),
        "gemm: left operand is too short"
    );
    match b {
        Rhs::Rows { values, stride } => {
            assert!((k - 1) * stride + n <= values.len(), "gemm: right operand is too short");
        }
        Rhs::Packed(packed) => {
            let fits = packed.fits(k, n);
            assert!(fits, "gemm: packed for other sizes");
        }
    }
    // Columns that do not fill a tile come from a panel of their own, filled up with zeros.
    let mut rest = Packed::default();
    if let Rhs::Rows { values, stride } = b
        && !n.is_multiple_of(width)
    {
        rest.fill(&values[n - n % width..], [k, n % width], [stride, 1]);
    }
    let job = Job { m, n, k, a, b, rest: rest.values(), c: c.as_mut_ptr(), c_stride, epilogue, terms };
    match level() {
        // SAFETY: `gemm_pairs` found the instruction; the assertions above are the preconditions of `Job::run`.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 if job.terms == Terms::Pairs => unsafe { run_pairs(&job) },
        // SAFETY: AVX-512 F is there at this level; the assertions above are the preconditions of `Job::run`.
        #[cfg(target_arch = "x86_64")]
        Level::Avx512 => unsafe { run_avx512(&job) },
        // SAFETY: AVX2 and FMA are there at this level; the assertions above are the preconditions of `Job::run`.
        #[cfg(target_arch = "x86_64")]
        Level::Avx2 => unsafe { run_avx2(&job) },
        _ => {
            debug_assert_eq!(job.terms, Terms::Single, "gemm: pairs need a level of their own");
            // SAFETY: this level needs nothing; the assertions above are the preconditions of `Job::run`.
            unsafe { job.run::<Four>() }
        }
    }
}

/// The result of empty sums.
fn without_terms([m, n]: [usize; 2], c: &mut [f32], c_stride: usize, epilogue: Epilogue<'_>) {
    for row in c.chunks_mut(c_stride).take(m) {
        for (column, value) in row[..n].iter_mut().enumerate() {
            let kept = if epilogue.accumulate { *value } else { 0.0 };
            *value = kept + epilogue.bias.map_or(0.0, |bias| bias[column]);
        }
    }
}

/// A product whose operands were checked.
struct Job<'a> {
    m: usize,
    n: usize,
    k: usize,
    a: Lhs<'a>,
    b: Rhs<'a>,
    /// The last columns of `b`, if they do not fill a tile and `b` is not packed: `[k][width]`.
    rest: &'a [f32],
    c: *mut f32,
    c_stride: usize,
    epilogue: Epilogue<'a>,
    terms: Terms,
}

/// Widest tile of any level, in elements.
const WIDEST: usize = 32;

impl Job<'_> {
    /// Runs all tiles.
    ///
    /// # Safety
    ///
    /// - The instructions of `V` are there.
    /// - `a`, `b`, `bias` and `c` hold the elements that `m`, `n`, `k` and the strides reach; `rest` holds a panel if `n` is
    ///   not a multiple of the tile and `b` is not packed; packed panels have the width of the tile.
    #[inline(always)]
    unsafe fn run<V: Vector>(&self) {
        let width = 2 * V::LANES;
        for first in (0..self.n).step_by(width) {
            let columns = width.min(self.n - first);
            let (b, stride) = match self.b {
                Rhs::Packed(packed) => (packed.values()[first * self.k..].as_ptr(), width),
                Rhs::Rows { values, stride } if columns == width => (values[first..].as_ptr(), stride),
                Rhs::Rows { .. } => (self.rest.as_ptr(), width),
            };
            for row in (0..self.m).step_by(V::ROWS) {
                let rows = V::ROWS.min(self.m - row);
                let tile = Tile { job: self, row, first, columns, b, b_stride: stride };
                // SAFETY: `row + rows <= m` and `first + columns <= n`; `b` holds k rows of `width` elements that
                // are `stride` apart; the rest is the caller's promise.
                unsafe { tile.run_rows::<V>(rows) };
            }
        }
    }
}

/// One tile of the result: up to `V::ROWS` rows and two vectors.
pub(crate) struct Tile<'a> {
    job: &'a Job<'a>,
    row: usize,
    first: usize,
    columns: usize,
    b: *const f32,
    b_stride: usize,
}

impl Tile<'_> {
    /// Runs the tile with a number of rows that the compiler knows.
    ///
    /// # Safety
    ///
    /// As [`Tile::run`], with `rows <= V::ROWS`.
    #[inline(always)]
    unsafe fn run_rows<V: Vector>(&self, rows: usize) {
        // SAFETY: the caller's promise, for each number of rows.
        unsafe {
            if self.columns <= V::LANES {
                match rows {
                    1 => V::tile::<1, 1>(self),
                    2 => V::tile::<2, 1>(self),
                    3 => V::tile::<3, 1>(self),
                    4 => V::tile::<4, 1>(self),
                    5 => V::tile::<5, 1>(self),
                    6 => V::tile::<6, 1>(self),
                    7 => V::tile::<7, 1>(self),
                    8 => V::tile::<8, 1>(self),
                    9 => V::tile::<9, 1>(self),
                    10 => V::tile::<10, 1>(self),
                    11 => V::tile::<11, 1>(self),
                    _ => V::tile::<12, 1>(self),
                }
            } else {
                match rows {
                    1 => V::tile::<1, 2>(self),
                    2 => V::tile::<2, 2>(self),
                    3 => V::tile::<3, 2>(self),
                    4 => V::tile::<4, 2>(self),
                    5 => V::tile::<5, 2>(self),
                    6 => V::tile::<6, 2>(self),
                    7 => V::tile::<7, 2>(self),
                    8 => V::tile::<8, 2>(self),
                    9 => V::tile::<9, 2>(self),
                    10 => V::tile::<10, 2>(self),
                    11 => V::tile::<11, 2>(self),
                    _ => V::tile::<12, 2>(self),
                }
            }
        }
    }

    /// Sums over `k` in registers and writes the tile.
    ///
    /// # Safety
    ///
    /// - The instructions of `V` are there.
    /// - Rows `row..row + ROWS` of A and C exist; `b` holds `k` rows of `2 * V::LANES` elements, `b_stride` apart;
    ///   columns `first..first + columns` of C and of the bias exist.
    #[inline(always)]
    pub(crate) unsafe fn run<V: Vector, const ROWS: usize, const VECTORS: usize>(&self) {
        let job = self.job;
        let a_k = job.a.k_stride;
        let mut a = [job.a.values.as_ptr(); ROWS];
        // SAFETY: every pointer made and read here lies in its operand by the promise above: `a` at row + i < m and
        // kk < k, `b` at kk < k and below two vectors, which tiles of one vector (at most LANES columns) do not leave.
        unsafe {
            for (i, a) in a.iter_mut().enumerate() {
                *a = a.add((self.row + i) * job.a.row_stride);
            }
            let mut sums = [[V::zero(); VECTORS]; ROWS];
            let mut b = self.b;
            let mut along = 0usize;
            for _ in 0..job.k {
                let mut columns = [V::zero(); VECTORS];
                for (v, column) in columns.iter_mut().enumerate() {
                    *column = V::load(b.add(v * V::LANES));
                }
                for (a, sums) in a.iter().zip(&mut sums) {
                    let x = V::splat(*a.add(along));
                    for (sum, column) in sums.iter_mut().zip(&columns) {
                        *sum = V::mul_add(x, *column, *sum);
                    }
                }
                // Wrapping, since the steps after the last one may leave the operands; they are not read there.
                b = b.wrapping_add(self.b_stride);
                along = along.wrapping_add(a_k);
            }
            self.write::<V, ROWS, VECTORS>(&sums);
        }
    }

    /// Writes a tile of sums through the epilogue.
    ///
    /// # Safety
    ///
    /// As [`Tile::run`].
    #[inline(always)]
    unsafe fn write<V: Vector, const ROWS: usize, const VECTORS: usize>(&self, sums: &[[V; VECTORS]; ROWS]) {
        let Epilogue { accumulate, bias } = self.job.epilogue;
        // SAFETY: row + i < m and first + columns <= n, so that each row of C holds `columns` elements from here on, and
        // so does the bias; whole vectors are only read and written when `columns` fills them.
        unsafe {
            let c = self.job.c.add(self.row * self.job.c_stride + self.first);
            if self.columns != VECTORS * V::LANES {
                return self.write_part(sums, c);
            }
            let mut shift = [V::zero(); VECTORS];
            if let Some(bias) = bias {
                for (v, shift) in shift.iter_mut().enumerate() {
                    *shift = V::load(bias.as_ptr().add(self.first + v * V::LANES));
                }
            }
            // Three loops and not one with branches inside: unrolled, they leave the sums in their registers.
            match (accumulate, bias.is_some()) {
                (false, false) => self.store_rows(sums, c, |sum, _, _| sum),
                (true, false) => self.store_rows(sums, c, |sum, _, c| V::add(sum, V::load(c))),
                (false, true) => self.store_rows(sums, c, |sum, v, _| V::add(sum, shift[v])),
                (true, true) => {
                    self.store_rows(sums, c, |sum, v, c| V::add(V::add(sum, shift[v]), V::load(c)))
                }
            }
        }
    }

    /// Writes `value(sum, index of the vector, where it goes)` for every sum.
    ///
    /// # Safety
    ///
    /// `c` is followed by as many elements as the rows of whole vectors have, each `c_stride` after the last; the rest is
    /// as for [`Tile::run`].
    #[inline(always)]
    unsafe fn store_rows<V: Vector, const ROWS: usize, const VECTORS: usize>(
        &self,
        sums: &[[V; VECTORS]; ROWS],
        mut c: *mut f32,
        value: impl Fn(V, usize, *const f32) -> V,
    ) {
        for sums in sums {
            for (v, sum) in sums.iter().enumerate() {
                // SAFETY: the caller's promise.
                unsafe {
                    let c = c.add(v * V::LANES);
                    V::store(value(*sum, v, c), c);
                }
            }
            // Wrapping, since the step after the last row may leave the output; it is not written there.
            c = c.wrapping_add(self.job.c_stride);
        }
    }

    /// Writes a tile of which only some columns belong to the output, which begins at `c`.
    ///
    /// # Safety
    ///
    /// As [`Tile::run`].
    #[inline(always)]
    unsafe fn write_part<V: Vector, const ROWS: usize, const VECTORS: usize>(
        &self,
        sums: &[[V; VECTORS]; ROWS],
        c: *mut f32,
    ) {
        let mut spill = [[0f32; WIDEST]; ROWS];
        for (spill, sums) in spill.iter_mut().zip(sums) {
            for (v, sum) in sums.iter().enumerate() {
                // SAFETY: the spill is 32 elements wide, as the widest tile.
                unsafe { V::store(*sum, spill.as_mut_ptr().add(v * V::LANES)) };
            }
        }
        let Epilogue { accumulate, bias } = self.job.epilogue;
        for (i, spill) in spill.iter().enumerate() {
            for (column, value) in spill[..self.columns].iter().enumerate() {
                // SAFETY: row + i < m and first + columns <= n.
                unsafe {
                    let c = c.add(i * self.job.c_stride + column);
                    let kept = if accumulate { *c } else { 0.0 };
                    *c = kept + (value + bias.map_or(0.0, |bias| bias[self.first + column]));
                }
            }
        }
    }
}

/// # Safety
///
/// As [`Job::run`], on a processor with AVX-512 F.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx2,fma")]
unsafe fn run_avx512(job: &Job<'_>) {
    // SAFETY: the caller's promise.
    unsafe { job.run::<x86::Sixteen>() }
}

/// # Safety
///
/// As [`Job::run`], on a processor with AVX-512 F and BF16.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx512f,avx512bf16,avx2,fma")]
unsafe fn run_pairs(job: &Job<'_>) {
    // SAFETY: the caller's promise.
    unsafe { job.run::<x86::Pairs>() }
}

/// # Safety
///
/// As [`Job::run`], on a processor with AVX2 and FMA.
#[cfg(target_arch = "x86_64")]
#[target_feature(enable = "avx2,fma")]
unsafe fn run_avx2(job: &Job<'_>) {
    // SAFETY: the caller's promise.
    unsafe { job.run::<x86::Eight>() }
}
