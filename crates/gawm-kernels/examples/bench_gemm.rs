//! Products per second of CPU time on one thread: our kernel, beside the ceiling of the machine.
//!
//! `cargo run --release -p gawm-kernels --example bench_gemm`. The ceiling is a loop of independent fused
//! multiply-adds on registers. Shapes are those of a chunk of 257 tokens in the published encoder, and of 260 in `nano`.

use std::hint::black_box;
use std::time::Instant;

use gawm_kernels::attention::{Attention, AttentionGradients, AttentionInputs, AttentionScratch};
use gawm_kernels::gemm::{Epilogue, Lhs, Packed, Rhs, gemm};

fn main() {
    println!("level {:?}, ceiling {:.1} GFLOP/s", gawm_kernels::level(), ceiling());
    for [m, n, k] in [
        [257, 192, 192],
        [257, 768, 192],
        [257, 192, 768],
        [260, 64, 64],
        [260, 256, 64],
        [260, 64, 256],
        [48, 272, 64],
    ] {
        let (a, b) = (vec![0.5; m * k], vec![0.25; n * k]);
        let packed = Packed::of(&b, [k, n]);
        let mut c = vec![0.0; m * n];
        let forward = rate(2 * m * n * k, || {
            let a = Lhs { values: &a, row_stride: k, k_stride: 1 };
            gemm([m, n, k], a, Rhs::Packed(&packed), &mut c, n, Epilogue::default());
            black_box(&c);
        });
        // The gradient of the weight: n x k, summed over m.
        let (dy, mut dw) = (vec![0.5; m * n], vec![0.0; n * k]);
        let weight = rate(2 * m * n * k, || {
            let dy = Lhs { values: &dy, row_stride: 1, k_stride: n };
            gemm(
                [n, k, m],
                dy,
                Rhs::Rows { values: &a, stride: k },
                &mut dw,
                k,
                Epilogue { accumulate: true, bias: None },
            );
            black_box(&dw);
        });
        println!(
            "{m:>4} x {n:>4} x {k:>4}: forward {forward:>6.1} GFLOP/s, gradient of the weight {weight:>6.1}"
        );
    }
    attention(257, 3, 64);
    attention(65, 2, 32);
}

/// Prints what attention of one image reaches, its data in the cache.
fn attention(tokens: usize, heads: usize, head_width: usize) {
    let sizes = Attention { queries: tokens, keys: tokens, heads, head_width };
    let count = tokens * heads * head_width;
    let input = |shift: usize| -> Vec<f32> {
        (0..count).map(|i| ((i * 7 + shift) % 13) as f32 * 0.1 - 0.6).collect()
    };
    let (q, k, v, d_output) = (input(0), input(1), input(2), input(3));
    let inputs = AttentionInputs { q: &q, k: &k, v: &v };
    let (mut output, mut sums, mut scratch) =
        (vec![0.0; count], vec![0.0; heads * tokens], AttentionScratch::default());
    let forward = rate(sizes.operations(), || {
        sizes.forward(inputs, &mut output, &mut sums, &mut scratch);
        black_box(&output);
    });
    let (mut dq, mut dk, mut dv) = (vec![0.0; count], vec![0.0; count], vec![0.0; count]);
    let backward = rate(sizes.operations() * 5 / 2, || {
        let mut gradients = AttentionGradients { q: &mut dq, k: &mut dk, v: &mut dv };
        sizes.backward(inputs, (&output, &sums), &d_output, &mut gradients, &mut scratch);
        black_box(&gradients);
    });
    println!(
        "attention {tokens} tokens, {heads} heads of {head_width}: forward {forward:>6.1} GFLOP/s, backward {backward:>6.1}"
    );
}

/// GFLOP/s of the fastest of 30 repeats of at least 2 milliseconds.
fn rate(operations: usize, mut work: impl FnMut()) -> f64 {
    let mut best = f64::INFINITY;
    let mut repeats = 1;
    for _ in 0..30 {
        loop {
            let start = Instant::now();
            (0..repeats).for_each(|_| work());
            let secs = start.elapsed().as_secs_f64();
            if secs > 2e-3 {
                best = best.min(secs / repeats as f64);
                break;
            }
            repeats *= 2;
        }
    }
    operations as f64 / best * 1e-9
}

/// GFLOP/s of a product that stays in registers and the first cache: 48 rows, one panel, a long sum.
fn ceiling() -> f64 {
    let (m, n, k) = (12, gawm_kernels::gemm::panel_width(), 128);
    let (a, b) = (vec![0.5; m * k], Packed::of(&vec![0.25; n * k], [k, n]));
    let mut c = vec![0.0; m * n];
    rate(2 * m * n * k, || {
        let a = Lhs { values: &a, row_stride: k, k_stride: 1 };
        gemm([m, n, k], a, Rhs::Packed(&b), &mut c, n, Epilogue::default());
        black_box(&c);
    })
}
