//! Where the random numbers of a search come from.

use gawm_model::Stream;

use super::Task;

/// A source of standard normal numbers; replaceable, so that published searches can be repeated.
pub trait NoiseSource: Send + Sync {
    /// Returns `count` numbers for an iteration of a task: [N, L, A], row-major.
    fn draw(&self, task: &Task, iteration: usize, count: usize) -> Vec<f32>;
}

/// Noise as a function of a seed, the problem's own stream, the plan and the iteration.
#[derive(Debug, Clone, Copy)]
pub struct SeededNoise {
    /// The seed.
    pub seed: u64,
}

impl NoiseSource for SeededNoise {
    fn draw(&self, task: &Task, iteration: usize, count: usize) -> Vec<f32> {
        Stream::new(self.seed, &format!("plan/{}/{iteration}", task.stream), task.plan).normals(count)
    }
}

/// Colours white noise along time: the amplitude of frequency f becomes f^(-beta / 2), as iCEM does.
///
/// A sequence of `n` steps is a sum of cosines and sines with independent weights; the constant has the amplitude of the
/// lowest frequency. Each sequence is scaled to the standard deviation 1 in expectation, not by its own sample, so that a
/// constant push stays possible.
#[derive(Debug, Clone)]
pub(super) struct Colour {
    steps: usize,
    /// [steps, steps]: step t of the result is the product with n white numbers.
    basis: Vec<f32>,
}

impl Colour {
    pub(super) fn new(steps: usize, beta: f64) -> Colour {
        let mut columns: Vec<Vec<f64>> = Vec::with_capacity(steps);
        let wave = |frequency: usize, shift: f64| {
            let angle = |t: usize| std::f64::consts::TAU * frequency as f64 * t as f64 / steps as f64;
            let amplitude = (frequency.max(1) as f64).powf(-beta / 2.0);
            // A wave that is its own mirror image (constant, or alternating) has all its power in one column.
            let is_real = frequency == 0 || 2 * frequency == steps;
            let gain = if is_real { 1.0 } else { 2f64.sqrt() };
            (0..steps).map(|t| gain * amplitude * (angle(t) - shift).cos()).collect::<Vec<f64>>()
        };
        for frequency in 0..=steps / 2 {
            columns.push(wave(frequency, 0.0));
            if frequency != 0 && 2 * frequency != steps {
                columns.push(wave(frequency, std::f64::consts::FRAC_PI_2));
            }
        }
        let power: f64 = columns.iter().flatten().map(|value| value * value).sum::<f64>() / steps as f64;
        let scale = 1.0 / power.sqrt();
        let basis = (0..steps)
            .flat_map(|t| columns.iter().map(move |column| (column[t] * scale) as f32).collect::<Vec<_>>())
            .collect();
        Colour { steps, basis }
    }

    /// Colours a sequence [steps, width] in place, each column by itself.
    pub(super) fn apply(&self, sequence: &mut [f32], width: usize) {
        let white = sequence.to_vec();
        for (t, row) in sequence.chunks_exact_mut(width).enumerate() {
            let weights = &self.basis[t * self.steps..(t + 1) * self.steps];
            for (dim, value) in row.iter_mut().enumerate() {
                *value = weights.iter().zip(white.iter().skip(dim).step_by(width)).map(|(w, x)| w * x).sum();
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn coloured(steps: usize, beta: f64, n: usize) -> Vec<f32> {
        let colour = Colour::new(steps, beta);
        let mut stream = Stream::new(1, "colour", 0);
        (0..n)
            .flat_map(|_| {
                let mut sequence = stream.normals(steps * 2);
                colour.apply(&mut sequence, 2);
                sequence
            })
            .collect()
    }

    #[test]
    fn coloured_noise_has_unit_variance_and_neighbours_agree() {
        for steps in [24, 25] {
            for (beta, low, high) in [(0.0, -0.05, 0.05), (2.0, 0.85, 1.0)] {
                let values = coloured(steps, beta, 4000);
                let n = values.len() as f64;
                let variance = values.iter().map(|x| f64::from(x * x)).sum::<f64>() / n;
                assert!((variance - 1.0).abs() < 0.05, "steps {steps}, beta {beta}: variance {variance}");
                let rows: Vec<&[f32]> = values.chunks_exact(2).collect();
                let pairs =
                    rows.chunks_exact(steps).flat_map(|s| s.windows(2)).map(|w| f64::from(w[0][0] * w[1][0]));
                let neighbours = pairs.sum::<f64>() / (4000 * (steps - 1)) as f64;
                assert!((low..high).contains(&neighbours), "steps {steps}, beta {beta}: {neighbours}");
            }
        }
    }
}
