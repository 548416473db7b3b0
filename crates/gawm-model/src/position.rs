//! Bicubic interpolation of a square position table, as torch resizes (`align_corners = false`, a = -0.75).

use candle_core::Tensor;

use crate::Result;

/// Resizes a table of `side` x `side` positions to `rows` x `columns`.
///
/// `table` has shape [side^2, W], row-major; returns [rows x columns, W]. Differentiable: it is one product with a
/// constant matrix.
pub(crate) fn resize_table(table: &Tensor, side: usize, rows: usize, columns: usize) -> Result<Tensor> {
    let (vertical, horizontal) = (bicubic(side, rows), bicubic(side, columns));
    let mut weights = Vec::with_capacity(rows * columns * side * side);
    for row in vertical.chunks_exact(side) {
        for column in horizontal.chunks_exact(side) {
            weights.extend(row.iter().flat_map(|v| column.iter().map(move |h| v * h)));
        }
    }
    let weights = Tensor::from_vec(weights, (rows * columns, side * side), table.device())?;
    weights.matmul(table) // [rows x columns, W]
}

/// Returns the [outputs, inputs] matrix of a bicubic resize along one axis, row-major.
fn bicubic(inputs: usize, outputs: usize) -> Vec<f32> {
    let mut matrix = vec![0.0; outputs * inputs];
    let scale = inputs as f32 / outputs as f32;
    for (output, row) in matrix.chunks_exact_mut(inputs).enumerate() {
        let source = scale * (output as f32 + 0.5) - 0.5;
        let base = source.floor();
        for (tap, weight) in (-1..3).zip(cubic_weights(source - base)) {
            // Taps beyond the edge repeat it.
            let input = (base as i64 + tap).clamp(0, inputs as i64 - 1);
            row[input as usize] += weight;
        }
    }
    matrix
}

/// Weights of the taps at -1, 0, 1, 2 for a position `t` in [0, 1) (cubic convolution with a = -0.75).
fn cubic_weights(t: f32) -> [f32; 4] {
    const A: f32 = -0.75;
    let near = |x: f32| ((A + 2.0) * x - (A + 3.0)) * x * x + 1.0; // |x| <= 1
    let far = |x: f32| ((A * x - 5.0 * A) * x + 8.0 * A) * x - 4.0 * A; // 1 < |x| < 2
    [far(t + 1.0), near(t), near(1.0 - t), far(2.0 - t)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_size_changes_nothing() {
        for (index, weight) in bicubic(7, 7).into_iter().enumerate() {
            assert_eq!(weight, if index / 7 == index % 7 { 1.0 } else { 0.0 });
        }
    }

    #[test]
    fn rows_sum_to_one_and_straight_lines_stay_straight() {
        let matrix = bicubic(8, 5);
        for (output, row) in matrix.chunks_exact(8).enumerate() {
            assert!((row.iter().sum::<f32>() - 1.0).abs() < 1e-6);
            if (1..4).contains(&output) {
                let value: f32 = row.iter().enumerate().map(|(input, weight)| input as f32 * weight).sum();
                let expected = 8.0 / 5.0 * (output as f32 + 0.5) - 0.5;
                // Cubic convolution with a = -0.75 reproduces lines only nearly: at most 0.1 apart.
                assert!((value - expected).abs() < 0.1, "{value} for {expected}");
            }
        }
    }
}
