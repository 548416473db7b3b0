//! Pixel statistics of cameras from frames spread over the dataset.

use std::collections::BTreeMap;

use rayon::prelude::*;
use serde::Serialize;

use crate::{
    picture,
    read::{Dataset, FrameBytes},
};

/// Frames that are looked at per camera.
const SAMPLED_FRAMES: usize = 256;

/// Statistics of one camera per channel, pixels in 0..1.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CameraSummary {
    /// Frames looked at.
    pub frames: u64,
    /// Per channel: minimum, maximum, mean, standard deviation and the quantiles 0.01, 0.1, 0.5, 0.9, 0.99.
    pub channels: Vec<[f64; 9]>,
}

/// Looks at up to 256 frames of each camera in the data files, evenly spread.
pub fn camera_summaries(dataset: &Dataset) -> BTreeMap<String, CameraSummary> {
    let cameras = dataset.image_columns();
    let n_rows = dataset.n_rows().max(1);
    let stride = n_rows.div_ceil(SAMPLED_FRAMES as u64).max(1);
    let wanted = |run: &crate::read::Run| -> Vec<usize> {
        (0..run.n_rows)
            .filter(|r| (run.global_start + r).is_multiple_of(stride))
            .map(|r| r as usize)
            .collect()
    };
    let summarise = |camera: &String| {
        let counts: Vec<([[u64; 256]; 3], u64)> = dataset
            .runs
            .par_iter()
            .enumerate()
            .map(|(index, run)| {
                let rows = wanted(run);
                let mut counts = ([[0; 256]; 3], 0);
                let frames = if rows.is_empty() {
                    Vec::new()
                } else {
                    dataset.read_frames(index, camera, &rows).unwrap_or_default()
                };
                for frame in frames {
                    let FrameBytes::Encoded(bytes) = frame else { continue };
                    let Ok((_, picture)) = picture::decode(&bytes, 64) else { continue };
                    picture
                        .rgb
                        .chunks_exact(3)
                        .for_each(|p| (0..3).for_each(|c| counts.0[c][usize::from(p[c])] += 1));
                    counts.1 += 1;
                }
                counts
            })
            .collect();
        let mut total = ([[0u64; 256]; 3], 0);
        for (channels, frames) in counts {
            total
                .0
                .iter_mut()
                .zip(&channels)
                .for_each(|(t, c)| t.iter_mut().zip(c).for_each(|(a, b)| *a += b));
            total.1 += frames;
        }
        (total.1 > 0).then(|| {
            (
                camera.clone(),
                CameraSummary { frames: total.1, channels: total.0.iter().map(channel).collect() },
            )
        })
    };
    cameras.iter().filter_map(summarise).collect()
}

fn channel(counts: &[u64; 256]) -> [f64; 9] {
    let n = counts.iter().sum::<u64>().max(1);
    let level = |i: usize| i as f64 / 255.0;
    let mean = counts.iter().enumerate().map(|(i, c)| *c as f64 * level(i)).sum::<f64>() / n as f64;
    let variance =
        counts.iter().enumerate().map(|(i, c)| *c as f64 * (level(i) - mean).powi(2)).sum::<f64>() / n as f64;
    let at = |q: f64| {
        let rank = ((n - 1) as f64 * q).round() as u64;
        let mut end = 0;
        counts.iter().position(|c| {
            end += c;
            rank < end
        })
    };
    let quantile = |q: f64| level(at(q).unwrap_or(0));
    [
        quantile(0.0),
        quantile(1.0),
        mean,
        variance.sqrt(),
        quantile(0.01),
        quantile(0.1),
        quantile(0.5),
        quantile(0.9),
        quantile(0.99),
    ]
}
