//! Attention against a naive one in f64, and its gradients against differences.

use gawm_kernels::attention::{Attention, AttentionGradients, AttentionInputs, AttentionScratch};

use crate::reference::{assert_close, at_all_levels, noise, wide};

/// `softmax(q k^T / sqrt(d)) v` per head, over rows that hold all heads.
fn naive(sizes: &Attention, q: &[f64], k: &[f64], v: &[f64]) -> Vec<f64> {
    let Attention { queries, keys, heads, head_width: d } = *sizes;
    let width = heads * d;
    let mut output = vec![0.0; queries * width];
    for (i, head) in (0..queries).flat_map(|i| (0..heads).map(move |head| (i, head))) {
        let at = |row: usize| row * width + head * d;
        let score = |j: usize| (0..d).map(|c| q[at(i) + c] * k[at(j) + c]).sum::<f64>() / (d as f64).sqrt();
        let scores: Vec<f64> = (0..keys).map(score).collect();
        let largest = scores.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let weights: Vec<f64> = scores.iter().map(|score| (score - largest).exp()).collect();
        let sum: f64 = weights.iter().sum();
        for c in 0..d {
            output[at(i) + c] = (0..keys).map(|j| weights[j] / sum * v[at(j) + c]).sum();
        }
    }
    output
}

fn check_attention(queries: usize, keys: usize, heads: usize, head_width: usize, size: f32) {
    let sizes = Attention { queries, keys, heads, head_width };
    let width = heads * head_width;
    let scaled = |seed, count| noise(seed, count).into_iter().map(|x| size * x).collect::<Vec<f32>>();
    let (q, k, v) = (scaled(1, queries * width), scaled(2, keys * width), noise(3, keys * width));
    let d_output = noise(4, queries * width);
    let inputs = AttentionInputs { q: &q, k: &k, v: &v };
    // What a larger image left behind must not matter.
    let mut scratch = AttentionScratch::default();
    let larger = Attention { queries: 60, keys: 70, heads: 1, head_width: 8 };
    let (junk, mut out, mut sums) = (vec![f32::NAN; 70 * 8], vec![0.0; 60 * 8], vec![0.0; 60]);
    larger.forward(AttentionInputs { q: &junk, k: &junk, v: &junk }, &mut out, &mut sums, &mut scratch);

    let (mut output, mut log_sums) = (vec![f32::NAN; q.len()], vec![f32::NAN; heads * queries]);
    sizes.forward(inputs, &mut output, &mut log_sums, &mut scratch);
    let what = format!("attention {queries} on {keys}, {heads} heads of {head_width}, inputs to {size}");
    let exact = [wide(&q), wide(&k), wide(&v)];
    // Scores of size s are exact to s * 2^-24, and so are the logarithms of probabilities.
    let slack = 1.0 + f64::from(size * size) * (head_width as f64).sqrt() * 0.1;
    assert_close(&what, &output, &naive(&sizes, &exact[0], &exact[1], &exact[2]), 2e-6 * slack);

    let (mut dq, mut dk, mut dv) =
        (vec![f32::NAN; q.len()], vec![f32::NAN; k.len()], vec![f32::NAN; v.len()]);
    let mut gradients = AttentionGradients { q: &mut dq, k: &mut dk, v: &mut dv };
    sizes.backward(inputs, (&output, &log_sums), &d_output, &mut gradients, &mut scratch);
    for (which, got) in [dq, dk, dv].iter().enumerate() {
        let difference = |index: usize| {
            let step = 1e-5;
            let moved = |sign: f64| {
                let mut inputs = exact.clone();
                inputs[which][index] += sign * step;
                let output = naive(&sizes, &inputs[0], &inputs[1], &inputs[2]);
                output.iter().zip(&d_output).map(|(y, dy)| y * f64::from(*dy)).sum::<f64>()
            };
            (moved(1.0) - moved(-1.0)) / (2.0 * step)
        };
        // Every element of small inputs, some of large ones.
        let stride = got.len().div_ceil(60);
        let indices: Vec<usize> = (0..got.len()).step_by(stride).collect();
        let expected: Vec<f64> = indices.iter().map(|&index| difference(index)).collect();
        let got: Vec<f32> = indices.iter().map(|&index| got[index]).collect();
        assert_close(&format!("{what}: gradient {which}"), &got, &expected, 1e-5 * slack);
    }
}

#[test]
fn attention_equals_naive_attention_and_differences() {
    at_all_levels(|| {
        for (queries, keys, heads, head_width) in
            [(1, 1, 1, 1), (1, 17, 2, 8), (5, 5, 3, 5), (50, 65, 2, 16), (65, 65, 1, 32)]
        {
            check_attention(queries, keys, heads, head_width, 1.0);
            check_attention(queries, keys, heads, head_width, 4.0);
        }
    });
}

#[test]
fn huge_scores_choose_one_key() {
    at_all_levels(|| {
        let sizes = Attention { queries: 1, keys: 3, heads: 1, head_width: 1 };
        let inputs = AttentionInputs { q: &[1e18], k: &[1e18, -1e18, 2e18], v: &[1.0, 2.0, 3.0] };
        let (mut output, mut log_sums) = ([0.0], [0.0]);
        sizes.forward(inputs, &mut output, &mut log_sums, &mut AttentionScratch::default());
        assert_eq!(output, [3.0]);
        assert!(log_sums[0].is_finite());
    });
}
