//! What cameras show, compared with each other and with other episodes: exchanged, doubled, foreign and turned views.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    Finding,
    image::{CameraRun, FrameMeasure, THUMB, THUMB_SIDE},
    profile::RunProfile,
    relation::outlying,
    robust::median,
};

/// Least distance in levels of an episode's mean picture from the others' that is looked into.
const FAR: f64 = 10.0;
/// Share of an episode's frames that another camera or episode must have.
const SHARED_SHARE: f64 = 0.5;
/// One frame in this many is compared with other episodes.
const KEPT_FRAMES: u64 = 4;
/// Least contrast of frames that tell something.
const FLAT: f32 = 6.0;

/// How many times farther than the others an episode's mean picture is.
const FAR_RATIO: f64 = 2.5;
/// Fewest episodes of which one can be unlike the others.
const MIN_RUNS: usize = 6;

/// The frames of all cameras in one run.
type Measured = (usize, Vec<CameraRun>);

/// Judges all cameras in all runs.
pub(super) fn judge(
    cameras: &[String],
    measured: &[Measured],
    by_index: &BTreeMap<usize, &RunProfile>,
    findings: &mut Vec<Finding>,
) {
    let views = Views { cameras, measured, by_index };
    views.doubled(findings);
    for camera in 0..cameras.len() {
        views.foreign(camera, findings);
    }
    if measured.len() >= 3 {
        let thumbs: Vec<Vec<Vec<f64>>> =
            measured.iter().map(|(_, m)| m.iter().map(mean_thumb).collect()).collect();
        let usual: Vec<Vec<f64>> = (0..cameras.len())
            .map(|c| {
                (0..THUMB).map(|i| median(&thumbs.iter().map(|t| t[c][i]).collect::<Vec<_>>())).collect()
            })
            .collect();
        views.exchanged(&thumbs, &usual, findings);
        views.turned(&thumbs, &usual, findings);
        views.unlike(&thumbs, &usual, findings);
    }
}

struct Views<'a> {
    cameras: &'a [String],
    measured: &'a [Measured],
    by_index: &'a BTreeMap<usize, &'a RunProfile>,
}

fn mean_thumb(camera: &CameraRun) -> Vec<f64> {
    let n = camera.frames.len().max(1) as f64;
    (0..THUMB).map(|i| camera.frames.iter().map(|f| f64::from(f.thumb[i])).sum::<f64>() / n).collect()
}

fn far(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(x, y)| (x - y).abs()).sum::<f64>() / THUMB as f64
}

fn shows_something(frame: &FrameMeasure) -> bool {
    frame.is_picture && frame.std > FLAT
}

impl Views<'_> {
    fn episode(&self, run: usize) -> i64 {
        self.by_index.get(&run).map_or(-1, |r| r.episode)
    }

    /// Finds episodes in which two cameras have changed places.
    fn exchanged(&self, thumbs: &[Vec<Vec<f64>>], usual: &[Vec<f64>], findings: &mut Vec<Finding>) {
        for ((run, _), thumbs) in self.measured.iter().zip(thumbs) {
            for a in 0..self.cameras.len() {
                for b in a + 1..self.cameras.len() {
                    let own = far(&thumbs[a], &usual[a]) + far(&thumbs[b], &usual[b]);
                    let other = far(&thumbs[a], &usual[b]) + far(&thumbs[b], &usual[a]);
                    if other < 0.5 * own && own > FAR {
                        let message = format!(
                            "{} shows what {} shows in the other episodes, and the other way round",
                            self.cameras[a], self.cameras[b]
                        );
                        let finding = Finding::new("IMAGE-009", message).episode(self.episode(*run));
                        findings.push(finding.feature(&self.cameras[a]).measured(own / other.max(1e-9), 2.0));
                    }
                }
            }
        }
    }

    /// Finds episodes in which a camera hangs upside down or its picture is mirrored.
    fn turned(&self, thumbs: &[Vec<Vec<f64>>], usual: &[Vec<f64>], findings: &mut Vec<Finding>) {
        const TURNS: [(&str, bool, bool); 3] = [
            ("turned by half a turn", true, true),
            ("mirrored left to right", true, false),
            ("mirrored top to bottom", false, true),
        ];
        for ((run, _), thumbs) in self.measured.iter().zip(thumbs) {
            for (camera, (thumb, usual)) in thumbs.iter().zip(usual).enumerate() {
                let own = far(thumb, usual);
                let turned = TURNS.iter().map(|(name, x, y)| (*name, far(&turn(thumb, *x, *y), usual)));
                let Some((name, other)) = turned.min_by(|a, b| a.1.total_cmp(&b.1)) else { continue };
                if other < 0.5 * own && own > FAR {
                    let message = format!("the picture is {name} against the other episodes");
                    let finding = Finding::new("IMAGE-018", message).episode(self.episode(*run));
                    findings
                        .push(finding.feature(&self.cameras[camera]).measured(own / other.max(1e-9), 2.0));
                }
            }
        }
    }

    /// Finds episodes whose mean picture is unlike those of the others: a camera that was moved, or shows something else.
    fn unlike(&self, thumbs: &[Vec<Vec<f64>>], usual: &[Vec<f64>], findings: &mut Vec<Finding>) {
        if self.measured.len() < MIN_RUNS {
            return;
        }
        for (camera, name) in self.cameras.iter().enumerate() {
            // A brighter picture is another matter.
            let level = |thumb: &[f64]| thumb.iter().sum::<f64>() / THUMB as f64;
            let distance = |thumb: &Vec<f64>| {
                let by = level(&usual[camera]) - level(thumb);
                far(&thumb.iter().map(|v| v + by).collect::<Vec<_>>(), &usual[camera])
            };
            let distances: Vec<f64> = thumbs.iter().map(|t| distance(&t[camera])).collect();
            for (run, ratio, usual) in outlying(&distances, FAR, FAR_RATIO) {
                let episode = self.episode(self.measured[run].0);
                let is_said = |f: &Finding| {
                    f.episode == Some(episode)
                        && matches!(f.code, "IMAGE-009" | "IMAGE-018")
                        && f.feature.as_deref() == Some(name)
                };
                if findings.iter().any(is_said) {
                    continue;
                }
                let message = format!(
                    "the mean picture differs by {:.0} levels from that of the other episodes, theirs by about {usual:.0}: the camera was moved, or shows something else",
                    distances[run]
                );
                let finding = Finding::new("IMAGE-021", message).episode(episode).feature(name);
                findings.push(finding.measured(distances[run], distances[run] / ratio * FAR_RATIO));
            }
        }
    }

    /// Finds cameras that show the same frames.
    fn doubled(&self, findings: &mut Vec<Finding>) {
        for a in 0..self.cameras.len() {
            for b in a + 1..self.cameras.len() {
                let share = |m: &[CameraRun]| {
                    let pairs = m[a].frames.iter().zip(&m[b].frames).filter(|(x, _)| shows_something(x));
                    let (n, same) =
                        pairs.fold((0, 0), |(n, s), (x, y)| (n + 1, s + usize::from(x.hash == y.hash)));
                    if n < 2 { 0.0 } else { same as f64 / n as f64 }
                };
                let shared: Vec<(usize, f64)> = self
                    .measured
                    .iter()
                    .map(|(run, m)| (*run, share(m)))
                    .filter(|(_, share)| *share > SHARED_SHARE)
                    .collect();
                let finding = |share: f64| {
                    let message = format!(
                        "{} and {} show the same frames in {:.0} % of the rows",
                        self.cameras[a],
                        self.cameras[b],
                        100.0 * share
                    );
                    Finding::new("IMAGE-019", message).feature(&self.cameras[b]).measured(share, SHARED_SHARE)
                };
                if shared.len() == self.measured.len() && !shared.is_empty() {
                    findings.push(finding(median(&shared.iter().map(|s| s.1).collect::<Vec<_>>())));
                } else {
                    findings.extend(shared.iter().map(|(run, s)| finding(*s).episode(self.episode(*run))));
                }
            }
        }
    }

    /// Finds episodes whose frames are those of another episode with other states.
    fn foreign(&self, camera: usize, findings: &mut Vec<Finding>) {
        let mut owners: BTreeMap<u64, usize> = BTreeMap::new();
        for (run, cameras) in self.measured {
            let kept: BTreeSet<u64> = cameras[camera]
                .frames
                .iter()
                .filter(|f| shows_something(f) && f.hash % KEPT_FRAMES == 0)
                .map(|f| f.hash)
                .collect();
            let mut shared: BTreeMap<usize, usize> = BTreeMap::new();
            for hash in &kept {
                let owner = *owners.entry(*hash).or_insert(*run);
                if owner != *run {
                    *shared.entry(owner).or_default() += 1;
                }
            }
            let Some((owner, n)) = shared.into_iter().max_by_key(|(_, n)| *n) else { continue };
            let share = n as f64 / kept.len() as f64;
            let states = |run: &usize| self.by_index.get(run).map(|r| r.content_hash);
            if n >= 5 && share > SHARED_SHARE && states(run) != states(&owner) {
                let message = format!(
                    "{:.0} % of the frames are frames of episode {}, with other states",
                    100.0 * share,
                    self.episode(owner)
                );
                let finding = Finding::new("IMAGE-020", message).episode(self.episode(*run));
                findings.push(finding.feature(&self.cameras[camera]).measured(share, SHARED_SHARE));
            }
        }
    }
}

fn turn(thumb: &[f64], x: bool, y: bool) -> Vec<f64> {
    let at = |i: usize| {
        let (row, column) = (i / THUMB_SIDE, i % THUMB_SIDE);
        let row = if y { THUMB_SIDE - 1 - row } else { row };
        let column = if x { THUMB_SIDE - 1 - column } else { column };
        thumb[row * THUMB_SIDE + column]
    };
    (0..THUMB).map(at).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turning_twice_gives_the_picture_back() {
        let thumb: Vec<f64> = (0..THUMB).map(|i| i as f64).collect();
        let half = turn(&thumb, true, true);
        assert_eq!(half[0], (THUMB - 1) as f64);
        assert_eq!(turn(&half, true, true), thumb);
    }
}
