//! Weights, batches and noise of the golden files: closed formulas, so that only answers are stored.

use crate::parameters::{Init, ParameterSpec};

/// `frac(sin(i * a) * b)` for i in 0..n, in [0, 1).
pub(super) fn sequence(n: usize, a: f64, b: f64) -> impl Iterator<Item = f64> {
    (0..n).map(move |i| fraction((i as f64 * a).sin() * b))
}

/// The sequence stretched to [-scale, scale).
pub(super) fn signed(n: usize, a: f64, b: f64, scale: f64) -> Vec<f32> {
    sequence(n, a, b).map(|u| (scale * (2.0 * u - 1.0)) as f32).collect()
}

/// The values of a parameter, or the start of running statistics.
pub(super) fn parameter(name: &str, spec: &ParameterSpec) -> Vec<f32> {
    let n = spec.shape.iter().product::<usize>();
    if !spec.trainable {
        return vec![if spec.init == Init::Ones { 1.0 } else { 0.0 }; n];
    }
    let (offset, scale) = if spec.init == Init::Ones {
        (1.0, 0.1) // the weight of a norm
    } else if name.ends_with("bias") {
        (0.0, 0.1)
    } else {
        let token = name.contains("token") || name.contains("pos");
        let fan_in = match spec.shape.as_slice() {
            [.., last] if token || spec.shape.len() == 1 => *last,
            [_, inputs @ ..] => inputs.iter().product(),
            [] => 1,
        };
        (0.0, (3.0 / fan_in as f64).sqrt())
    };
    let phase = f64::from(crc32(name) % 1000) * 0.618;
    let value = |j: usize| {
        let u = fraction((j as f64 * 12.9898 + phase).sin() * 43_758.545_3);
        (offset + scale * (2.0 * u - 1.0)) as f32
    };
    (0..n).map(value).collect()
}

fn fraction(x: f64) -> f64 {
    x - x.floor()
}

/// CRC-32 (IEEE) of a name.
fn crc32(name: &str) -> u32 {
    !name.bytes().fold(u32::MAX, |crc, byte| {
        (0..8).fold(crc ^ u32::from(byte), |crc, _| (crc >> 1) ^ (0xedb8_8320 & (crc & 1).wrapping_neg()))
    })
}

#[cfg(test)]
mod tests {
    #[test]
    fn crc_of_the_check_string() {
        assert_eq!(super::crc32("123456789"), 0xcbf4_3926);
    }
}
