//! Rules of group SPLIT: duplicates, overlaps and sessions across splits.

use std::collections::{BTreeMap, BTreeSet};

use super::{
    Finding, Thresholds, copies,
    profile::{FINGERPRINT_POINTS, Plan, RunProfile},
    robust::quantile,
};
use crate::read::Dataset;

/// Most findings of one kind that are listed.
pub(super) const MAX_LISTED: usize = 200;

/// Judges duplicates and splits.
pub(super) fn judge(
    dataset: &Dataset,
    plan: &Plan,
    thresholds: &Thresholds,
    runs: &[RunProfile],
) -> Vec<Finding> {
    let mut findings = Vec::new();
    let splits = splits(dataset, &mut findings);
    sessions(dataset, &splits, &mut findings);
    let exact = exact_duplicates(dataset, &splits, runs, &mut findings);
    near_duplicates(plan, thresholds, &splits, runs, &exact, &mut findings);
    overlaps(thresholds, runs, &exact, &mut findings);
    findings
}

/// Returns the split of each episode: by a column `split` of the episode table, or else by the ranges in `info.json`.
fn splits(dataset: &Dataset, findings: &mut Vec<Finding>) -> BTreeMap<i64, String> {
    let mut of_episode: BTreeMap<i64, String> = BTreeMap::new();
    let total = dataset.episodes.len().max(dataset.runs.len()) as i64;
    let mut covered: BTreeMap<i64, &str> = BTreeMap::new();
    for (name, text) in &dataset.info.splits {
        let range = text
            .split_once(':')
            .and_then(|(a, b)| Some((a.trim().parse::<i64>().ok()?, b.trim().parse::<i64>().ok()?)));
        let Some((from, to)) = range else {
            findings.push(Finding::new(
                "SPLIT-004",
                format!("split {name:?} is {text:?}, expected a range such as 0:10"),
            ));
            continue;
        };
        if from < 0 || to < from || to > total {
            let message = format!("split {name:?} is {text}, but there are {total} episodes");
            findings.push(
                Finding::new("SPLIT-004", message)
                    .measured(to as f64, total as f64)
                    .at(severity_of_range(from, to)),
            );
        }
        for episode in from.max(0)..to.min(total) {
            if let Some(other) = covered.insert(episode, name) {
                if findings.iter().filter(|f| f.code == "SPLIT-005").count() < 5 {
                    findings.push(
                        Finding::new("SPLIT-005", format!("in splits {other:?} and {name:?}"))
                            .episode(episode),
                    );
                }
            } else {
                of_episode.insert(episode, name.clone());
            }
        }
    }
    for entry in &dataset.episodes {
        if let Some((_, value)) = entry.extras.iter().find(|(key, _)| is_key(key, "split"))
            && let Some(text) = value.as_str()
        {
            of_episode.insert(entry.episode_index, text.to_owned());
        }
    }
    of_episode
}

/// A range that merely ends too late loads; one that is upside down does not.
fn severity_of_range(from: i64, to: i64) -> super::Severity {
    if from < 0 || to < from { super::Severity::Error } else { super::Severity::Warning }
}

fn is_key(key: &str, name: &str) -> bool {
    key == name || key.rsplit(['.', '/']).next() == Some(name)
}

fn sessions(dataset: &Dataset, splits: &BTreeMap<i64, String>, findings: &mut Vec<Finding>) {
    let mut by_session: BTreeMap<String, BTreeMap<&str, Vec<i64>>> = BTreeMap::new();
    for entry in &dataset.episodes {
        let session = entry.extras.iter().find(|(k, _)| is_key(k, "session") || is_key(k, "session_id"));
        let Some(session) = session.and_then(|(key, _)| entry.extra_text(key)).filter(|s| !s.is_empty())
        else {
            continue;
        };
        if let Some(split) = splits.get(&entry.episode_index) {
            by_session.entry(session).or_default().entry(split).or_default().push(entry.episode_index);
        }
    }
    for (session, sides) in by_session.iter().filter(|(_, sides)| sides.len() > 1).take(MAX_LISTED) {
        let text: Vec<String> =
            sides.iter().map(|(split, episodes)| format!("{split}: {} episodes", episodes.len())).collect();
        let smallest = sides.values().min_by_key(|e| e.len()).and_then(|e| e.first()).copied().unwrap_or(0);
        findings.push(
            Finding::new("SPLIT-003", format!("session {session:?} is in {}", text.join(" and ")))
                .episode(smallest)
                .measured(sides.len() as f64, 1.0),
        );
    }
}

fn exact_duplicates(
    dataset: &Dataset,
    splits: &BTreeMap<i64, String>,
    runs: &[RunProfile],
    findings: &mut Vec<Finding>,
) -> BTreeSet<(i64, i64)> {
    let mut by_hash: BTreeMap<[u8; 16], Vec<&RunProfile>> = BTreeMap::new();
    for run in runs.iter().filter(|r| r.n_rows > 1 && !r.fingerprint.is_empty()) {
        by_hash.entry(run.content_hash).or_default().push(run);
    }
    let mut pairs = BTreeSet::new();
    for twins in by_hash.values().filter(|t| t.len() > 1) {
        for twin in &twins[1..] {
            let first = twins[0].episode;
            pairs.insert((first, twin.episode));
            let message = format!("states and actions are those of episode {first}, row for row");
            findings.push(
                Finding::new("SPLIT-001", message)
                    .episode(twin.episode)
                    .rows(0, twin.n_rows)
                    .measured(0.0, 0.0),
            );
            across("SPLIT-006", first, twin.episode, splits, findings);
            conflict(dataset, first, twin, findings);
        }
    }
    pairs
}

pub(super) fn across(
    code: &'static str,
    a: i64,
    b: i64,
    splits: &BTreeMap<i64, String>,
    findings: &mut Vec<Finding>,
) {
    if let (Some(x), Some(y)) = (splits.get(&a), splits.get(&b))
        && x != y
    {
        findings
            .push(Finding::new(code, format!("episode {a} is in {x:?}, its copy {b} in {y:?}")).episode(b));
    }
}

fn conflict(dataset: &Dataset, first: i64, twin: &RunProfile, findings: &mut Vec<Finding>) {
    let (Some(a), Some(b)) = (dataset.entry(first), dataset.entry(twin.episode)) else { return };
    let success = |e: &crate::read::EpisodeEntry| {
        e.extras.iter().find(|(k, v)| is_key(k, "success") && !v.is_null()).map(|(_, v)| v.to_string())
    };
    if let (Some(x), Some(y)) = (success(a), success(b))
        && x != y
    {
        findings.push(
            Finding::new("SPLIT-007", format!("success is {y}, in the equal episode {first} it is {x}"))
                .episode(twin.episode),
        );
    }
    if a.tasks != b.tasks && !a.tasks.is_empty() {
        findings.push(
            Finding::new(
                "SPLIT-007",
                format!("the task is {:?}, in the equal episode {first} it is {:?}", b.tasks, a.tasks),
            )
            .episode(twin.episode),
        );
    }
}

fn near_duplicates(
    plan: &Plan,
    thresholds: &Thresholds,
    splits: &BTreeMap<i64, String>,
    runs: &[RunProfile],
    exact: &BTreeSet<(i64, i64)>,
    findings: &mut Vec<Finding>,
) {
    let n_dims = plan.states.len() + plan.actions.len();
    // Of equal runs one speaks for all.
    let mut seen = BTreeSet::new();
    let is_usable = |r: &&RunProfile| r.fingerprint.len() == n_dims * FINGERPRINT_POINTS && r.n_rows > 4;
    let usable: Vec<&RunProfile> =
        runs.iter().filter(is_usable).filter(|r| seen.insert(r.content_hash)).collect();
    if usable.len() < 2 || n_dims == 0 {
        return;
    }
    let spreads = spreads(&usable, n_dims);
    copies::judge(thresholds, splits, &usable, &spreads, exact, findings);
    let Some(points) = normalised(&usable, &spreads) else { return };
    let width = points[0].len();
    let bound = thresholds.split.near_sigmas * (width as f64).sqrt();
    // Vectors that are close have close sums: only neighbours in that order are compared.
    let sums: Vec<f64> =
        points.iter().map(|p| p.iter().map(|v| f64::from(*v)).sum::<f64>() / (width as f64).sqrt()).collect();
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|a, b| sums[*a].total_cmp(&sums[*b]));
    let mut n_listed = 0;
    for (i, &a) in order.iter().enumerate() {
        for &b in order[i + 1..].iter().take_while(|b| sums[**b] - sums[a] <= bound) {
            let (first, second) = if usable[a].episode < usable[b].episode { (a, b) } else { (b, a) };
            let (x, y) = (usable[first], usable[second]);
            let is_exact = exact.contains(&(x.episode, y.episode)) || x.content_hash == y.content_hash;
            let distance =
                if is_exact { f64::INFINITY } else { distance_within(&points[a], &points[b], bound) };
            if distance <= bound && n_listed < MAX_LISTED {
                n_listed += 1;
                let sigmas = distance / (width as f64).sqrt();
                let message = format!(
                    "the motion is that of episode {} within {sigmas:.4} standard deviations ({} rows and {})",
                    x.episode, y.n_rows, x.n_rows
                );
                findings.push(
                    Finding::new("SPLIT-002", message)
                        .episode(y.episode)
                        .measured(sigmas, thresholds.split.near_sigmas),
                );
                across("SPLIT-006", x.episode, y.episode, splits, findings);
            }
        }
    }
}

/// Returns the standard deviation of each dim within episodes.
fn spreads(runs: &[&RunProfile], n_dims: usize) -> Vec<f64> {
    let mut all = Vec::new();
    for dim in 0..n_dims {
        let range = dim * FINGERPRINT_POINTS..(dim + 1) * FINGERPRINT_POINTS;
        // The spread within episodes: that between them would hide motion on top of different offsets.
        let spreads: Vec<f64> = runs
            .iter()
            .map(|r| {
                let values: Vec<f64> = r.fingerprint[range.clone()].iter().map(|v| f64::from(*v)).collect();
                quantile(&values, 0.9) - quantile(&values, 0.1)
            })
            .collect();
        all.push(quantile(&spreads, 0.75) / 2.56);
    }
    all
}

/// Scales fingerprints to unit standard deviation per dim; dims that hardly move are left out.
fn normalised(runs: &[&RunProfile], spreads: &[f64]) -> Option<Vec<Vec<f32>>> {
    let range = |dim: usize| dim * FINGERPRINT_POINTS..(dim + 1) * FINGERPRINT_POINTS;
    let moving = spreads.iter().enumerate().filter(|(_, s)| **s > 1e-9);
    let kept: Vec<_> = moving.map(|(dim, s)| (range(dim), *s as f32)).collect();
    if kept.is_empty() {
        return None;
    }
    let scale = |run: &&RunProfile| {
        kept.iter()
            .flat_map(|(range, spread)| {
                run.fingerprint[range.clone()]
                    .iter()
                    .map(move |v| if v.is_finite() { v / spread } else { 0.0 })
            })
            .collect()
    };
    Some(runs.iter().map(scale).collect())
}

fn distance_within(a: &[f32], b: &[f32], bound: f64) -> f64 {
    let mut sum = 0.0;
    for (x, y) in a.chunks(64).zip(b.chunks(64)) {
        sum += x.iter().zip(y).map(|(x, y)| f64::from(x - y).powi(2)).sum::<f64>();
        if sum > bound * bound {
            return f64::INFINITY;
        }
    }
    sum.sqrt()
}

/// Finds episodes that share a share of their rows, value for value.
fn overlaps(
    thresholds: &Thresholds,
    runs: &[RunProfile],
    exact: &BTreeSet<(i64, i64)>,
    findings: &mut Vec<Finding>,
) {
    let mut owners: BTreeMap<u64, Vec<usize>> = BTreeMap::new();
    for (i, run) in runs.iter().enumerate() {
        for hash in &run.row_hashes {
            let list = owners.entry(*hash).or_default();
            // A row that many episodes have is a rest position.
            if list.len() < 4 {
                list.push(i);
            }
        }
    }
    let mut shared: BTreeMap<(usize, usize), usize> = BTreeMap::new();
    for list in owners.values().filter(|l| (2..4).contains(&l.len())) {
        for (k, a) in list.iter().enumerate() {
            for b in &list[k + 1..] {
                *shared.entry((*a, *b)).or_default() += 1;
            }
        }
    }
    for ((a, b), n) in shared.into_iter().take(100_000) {
        let (x, y) = (&runs[a], &runs[b]);
        let share = n as f64 / x.row_hashes.len().min(y.row_hashes.len()).max(1) as f64;
        let is_known = exact.contains(&(x.episode, y.episode)) || x.content_hash == y.content_hash;
        if n >= 3 && share >= thresholds.split.shared_rows_share && !is_known {
            let message = format!(
                "about {:.0} % of the shorter one's rows are rows of episode {}",
                100.0 * share,
                x.episode
            );
            findings.push(
                Finding::new("SPLIT-008", message)
                    .episode(y.episode)
                    .measured(share, thresholds.split.shared_rows_share),
            );
        }
    }
}
