//! Work on the rows of a matrix, on all threads where there is enough of it, with results that do not depend on how many.

use rayon::prelude::*;

/// Values that one thread works on at once; below this, a matrix is done by the caller.
const BLOCK: usize = 16 * 1024;

/// Rows of `width` values in a block.
fn rows_per_block(width: usize) -> usize {
    (BLOCK / width.max(1)).max(1)
}

/// Calls `work` with the first row and the values of each block of rows.
pub(crate) fn over_rows(values: &mut [f32], width: usize, work: impl Fn(usize, &mut [f32]) + Sync) {
    let rows = rows_per_block(width);
    if values.len() <= rows * width {
        return work(0, values);
    }
    values.par_chunks_mut(rows * width).enumerate().for_each(|(block, values)| work(block * rows, values));
}

/// [`over_rows`] of two matrices of equal size.
pub(crate) fn over_two(
    a: &mut [f32],
    b: &mut [f32],
    width: usize,
    work: impl Fn(usize, &mut [f32], &mut [f32]) + Sync,
) {
    let rows = rows_per_block(width);
    if a.len() <= rows * width {
        return work(0, a, b);
    }
    let blocks = a.par_chunks_mut(rows * width).zip(b.par_chunks_mut(rows * width));
    blocks.enumerate().for_each(|(block, (a, b))| work(block * rows, a, b));
}

/// Returns what `add` adds up over the rows, `[width]`: of each block of rows first, then of the blocks in order.
pub(crate) fn sum_rows(values: &[f32], width: usize, add: impl Fn(&[f32], &mut [f32]) + Sync) -> Vec<f32> {
    let mut sums = vec![0.0; width];
    let rows = rows_per_block(width);
    if values.len() <= rows * width {
        add(values, &mut sums);
        return sums;
    }
    let blocks = values.par_chunks(rows * width).map(|values| {
        let mut sums = vec![0.0; width];
        add(values, &mut sums);
        sums
    });
    let blocks: Vec<Vec<f32>> = blocks.collect();
    for block in blocks {
        crate::norm::add(&block, &mut sums);
    }
    sums
}
