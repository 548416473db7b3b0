//! VALUE-020: quaternions whose components are in another order than in the other episodes.

use super::{
    Finding,
    layout::{Group, GroupKind},
    robust::median,
    value::Judge,
};

/// Fewest runs whose comparison says something about one of them.
const MIN_RUNS: usize = 4;
/// Least distance of an episode's mean quaternion from the others' that is looked into.
const FAR: f64 = 0.5;

/// Judges one quaternion in all runs.
pub(super) fn judge_order(judge: &Judge, group: Group, findings: &mut Vec<Finding>) {
    if group.kind != GroupKind::Quaternion || judge.profiles.len() < MIN_RUNS {
        return;
    }
    let means: Vec<[f64; 4]> =
        judge.profiles.iter().map(|(_, p)| std::array::from_fn(|k| p.dims[group.start + k].mean)).collect();
    let usual: [f64; 4] = std::array::from_fn(|k| median(&means.iter().map(|m| m[k]).collect::<Vec<_>>()));
    let spread = median(&means.iter().map(|m| far(m, &usual)).collect::<Vec<_>>());
    for ((run, _), mean) in judge.profiles.iter().zip(&means) {
        let own = far(mean, &usual);
        let [a, b, c, d] = *mean;
        let other = far(&[b, c, d, a], &usual).min(far(&[d, a, b, c], &usual));
        if own > FAR && own > 4.0 * spread && other < 0.4 * own {
            let message = "the components are in another order than in the other episodes (wxyz for xyzw)";
            let finding = judge.finding("VALUE-020", group.start, message.to_owned());
            findings.push(finding.episode(run.episode).rows(0, run.n_rows).measured(own, FAR));
        }
    }
}

/// Returns the distance of two mean quaternions, whose sign means nothing.
fn far(a: &[f64; 4], b: &[f64; 4]) -> f64 {
    let distance = |sign: f64| a.iter().zip(b).map(|(x, y)| (x - sign * y).powi(2)).sum::<f64>().sqrt();
    distance(1.0).min(distance(-1.0))
}
