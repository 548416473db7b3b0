//! Pixel statistics of cameras from frames spread over the dataset.

use std::collections::BTreeMap;

use gawm_image::Limits;
use rayon::prelude::*;
use serde::Serialize;

use crate::{
    episode::FeatureStats,
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

/// Counts of pixel levels per channel over some frames of one run.
#[derive(Debug, Clone, PartialEq)]
pub(crate) struct CameraCounts {
    frames: u64,
    channels: [[u64; 256]; 3],
}

impl CameraCounts {
    const EMPTY: CameraCounts = CameraCounts { frames: 0, channels: [[0; 256]; 3] };

    fn merge(&mut self, other: &CameraCounts) {
        self.frames += other.frames;
        for (own, other) in self.channels.iter_mut().zip(&other.channels) {
            own.iter_mut().zip(other).for_each(|(a, b)| *a += b);
        }
    }

    fn summary(&self) -> CameraSummary {
        CameraSummary { frames: self.frames, channels: self.channels.iter().map(channel).collect() }
    }

    /// Returns LeRobot's statistics of the run.
    pub(crate) fn feature_stats(&self) -> FeatureStats {
        let channels = self.summary().channels;
        let values = |k: usize| channels.iter().map(|c| c[k]).collect();
        FeatureStats {
            min: values(0),
            max: values(1),
            mean: values(2),
            std: values(3),
            q01: values(4),
            q10: values(5),
            q50: values(6),
            q90: values(7),
            q99: values(8),
            count: self.frames,
        }
    }
}

/// Looks at up to 256 frames of each camera in the data files, evenly spread, and at least one of each run.
pub fn camera_summaries(dataset: &Dataset) -> BTreeMap<String, CameraSummary> {
    camera_counts(dataset).0
}

/// [`camera_summaries`], and the counts of each run.
pub(crate) fn camera_counts(
    dataset: &Dataset,
) -> (BTreeMap<String, CameraSummary>, BTreeMap<String, Vec<CameraCounts>>) {
    let stride = dataset.n_rows().div_ceil(SAMPLED_FRAMES as u64).max(1);
    let wanted = |run: &crate::read::Run| -> Vec<usize> {
        let first = run.global_start.next_multiple_of(stride) - run.global_start;
        let rows: Vec<usize> = (first..run.n_rows).step_by(stride as usize).map(|row| row as usize).collect();
        if rows.is_empty() && run.n_rows > 0 { vec![run.n_rows as usize / 2] } else { rows }
    };
    let (mut summaries, mut all_runs) = (BTreeMap::new(), BTreeMap::new());
    for camera in dataset.frame_columns() {
        let runs: Vec<CameraCounts> = (0..dataset.runs.len())
            .into_par_iter()
            .map(|index| {
                let frames = dataset.read_frames(index, &camera, &wanted(&dataset.runs[index]));
                counts_of(&frames.unwrap_or_default())
            })
            .collect();
        let mut total = CameraCounts::EMPTY;
        runs.iter().for_each(|run| total.merge(run));
        if total.frames > 0 {
            summaries.insert(camera.clone(), total.summary());
        }
        all_runs.insert(camera, runs);
    }
    (summaries, all_runs)
}

fn counts_of(frames: &[FrameBytes]) -> CameraCounts {
    let mut counts = CameraCounts::EMPTY;
    for frame in frames {
        let Ok((_, picture)) = frame.thumbnail(64, &Limits::default()) else { continue };
        for pixel in picture.rgb.chunks_exact(3) {
            (0..3).for_each(|c| counts.channels[c][usize::from(pixel[c])] += 1);
        }
        counts.frames += 1;
    }
    counts
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
