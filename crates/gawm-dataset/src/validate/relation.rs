//! Dims that are not related to the others as in the other episodes: late, drifting, scaled, mirrored, exchanged.
//!
//! Two linear models are fitted to all episodes but the one they judge: the step of a dim by the values of all dims and
//! actions, and its value by those of the others. Where the models hold elsewhere and fail in one episode, something
//! is wrong with the dim in it, or with one that it depends on.

use rayon::prelude::*;

use super::{
    Finding, Thresholds,
    layout::DimKind,
    linear::{Fit, Moments, Standardised},
    profile::{Plan, RunProfile},
    robust::median,
};

/// Most rows of a run that are looked at, and the fewest that are worth it.
const MAX_ROWS: usize = 256;
const MIN_ROWS: usize = 16;
/// Values that are kept of the whole dataset, and those beyond which the rule is silent.
const KEPT_VALUES: usize = 3_000_000;
const MAX_VALUES: usize = 16_000_000;
/// Most dims of states and actions together.
const MAX_DIMS: usize = 256;
/// Fewest runs that are compared.
const MIN_RUNS: usize = 4;
/// Most groups of runs that are left out in turn.
const MAX_FOLDS: usize = 24;
/// Rows per coefficient of a model.
const ROWS_PER_DIM: [usize; 2] = [8, 10];
/// Usual error, relative to the dim's motion or spread, up to which a model holds: of steps, and of values.
const HOLDS: [f64; 2] = [0.35, 0.15];
/// A model of values that leaves out how dims lag behind each other must fail more clearly.
const SURE: [f64; 2] = [1.0, 1.2];
/// Share of the dim's range that steps which the model does not explain add up to, to be a drift, and the usual one.
const DRIFT_SHARE: f64 = 0.3;
const USUAL_DRIFT: f64 = 0.1;
/// How often the runs that are fitted are chosen again.
const TRIMMINGS: usize = 2;
/// An error of this size stands for none.
const NO_ERROR: f64 = 1e-6;

/// Rows of one run: values of all states and actions, then the steps of the states.
#[derive(Debug, Default)]
pub(super) struct Sample {
    /// Row-major.
    values: Vec<f32>,
    stride: usize,
}

/// Returns how many rows of each run are kept; none if the dataset is too large or too wide.
pub(super) fn rows_per_run(n_states: usize, n_actions: usize, n_runs: usize) -> usize {
    let width = 2 * n_states + n_actions;
    let all = width.saturating_mul(n_runs);
    if n_states == 0
        || n_states + n_actions > MAX_DIMS
        || n_runs < MIN_RUNS
        || all.saturating_mul(MIN_ROWS) > MAX_VALUES
    {
        return 0;
    }
    (KEPT_VALUES / all).clamp(MIN_ROWS, MAX_ROWS)
}

/// Takes `n_kept` rows of a run.
pub(super) fn sample(states: &[&Vec<f64>], actions: &[&Vec<f64>], n_kept: usize) -> Sample {
    let n = states.first().map_or(0, |s| s.len());
    if n_kept == 0 || n < MIN_ROWS / 2 {
        return Sample::default();
    }
    let stride = (n - 1).div_ceil(n_kept).max(1);
    let rows = (0..n - 1).step_by(stride);
    let mut values = Vec::with_capacity(rows.len() * (2 * states.len() + actions.len()));
    for t in rows {
        values.extend(states.iter().chain(actions).map(|column| column[t] as f32));
        values.extend(states.iter().map(|column| (column[t + 1] - column[t]) as f32));
    }
    Sample { values, stride }
}

/// One dim of one run that does not fit.
#[derive(Debug, Clone)]
struct Misfit {
    run: usize,
    state: usize,
    ratio: f64,
    usual: f64,
    fit: Fit,
    kind: MisfitKind,
}

#[derive(Debug, Clone, Copy, PartialEq)]
enum MisfitKind {
    Steps,
    Values,
    Drift,
}

/// Rows of all runs in units of usual spread.
struct Model {
    /// Dims that are used, as positions in states and actions.
    dims: Vec<usize>,
    /// Positions in `dims` of states whose steps are judged.
    targets: Vec<usize>,
    /// Usual range of the targets, in units of their usual steps.
    ranges: Vec<f64>,
    runs: Vec<Standardised>,
}

/// Judges all runs.
pub(super) fn judge(plan: &Plan, thresholds: &Thresholds, runs: &[RunProfile]) -> Vec<Finding> {
    let known: Vec<&RunProfile> = runs.iter().filter(|r| !r.relations.values.is_empty()).collect();
    let Some(model) = (known.len() >= MIN_RUNS).then(|| Model::new(plan, &known)).flatten() else {
        return Vec::new();
    };
    let mut trusting = vec![true; known.len()];
    let mut fits = model.fit(&trusting);
    for _ in 0..TRIMMINGS {
        // Runs that fit worst say nothing of what is usual.
        let next = trusted(&fits, known.len());
        if next == trusting {
            break;
        }
        trusting = next;
        fits = model.fit(&trusting);
    }
    let misfits = model.misfits(&fits, thresholds, &known);
    (0..known.len()).filter_map(|run| model.finding(plan, &known, &misfits, run)).collect()
}

/// Returns which runs are fitted: all but up to a quarter that are far from the others in a dim.
fn trusted(fits: &[Vec<[Fit; 2]>], n_runs: usize) -> Vec<bool> {
    let n_dims = fits.first().map_or(0, Vec::len);
    // How far a run is from the others in any dim, and in how many.
    let mut distance = vec![0.0f64; n_runs];
    let mut is_far = vec![false; n_runs];
    for dim in 0..n_dims {
        for kind in 0..2 {
            let errors: Vec<f64> = fits.iter().map(|run| run[dim][kind].plain_error).collect();
            let usual = median(&errors).max(NO_ERROR);
            for (run, error) in errors.iter().enumerate() {
                distance[run] += (error / usual).max(1.0).ln().powi(2);
                is_far[run] |= *error > 2.0 * usual;
            }
        }
    }
    let mut order: Vec<usize> = (0..n_runs).filter(|run| is_far[*run]).collect();
    order.sort_by(|a, b| distance[*b].total_cmp(&distance[*a]).then(a.cmp(b)));
    order.truncate((n_runs / 4).max(1));
    (0..n_runs).map(|run| !order.contains(&run)).collect()
}

impl Model {
    fn new(plan: &Plan, runs: &[&RunProfile]) -> Option<Model> {
        let (n_states, n_actions) = (plan.states.len(), plan.actions.len());
        let (n_values, width) = (n_states + n_actions, 2 * n_states + n_actions);
        let column = |run: &RunProfile, c: usize| {
            run.relations.values.iter().skip(c).step_by(width).map(|v| f64::from(*v)).collect::<Vec<f64>>()
        };
        // The usual spread around the median, and the usual size of steps around 0.
        let scale_of = |c: usize| {
            let columns: Vec<Vec<f64>> = runs.iter().map(|run| column(run, c)).collect();
            let centre = if c < n_values { median(&columns.concat()) } else { 0.0 };
            (centre, median(&columns.iter().map(|v| mean_square(v, centre).sqrt()).collect::<Vec<_>>()))
        };
        let scales: Vec<(f64, f64)> = (0..width).into_par_iter().map(scale_of).collect();
        let is_plain = |c: usize| {
            let (feature, dim) = if c < n_states { plan.states[c] } else { plan.actions[c - n_states] };
            let wraps = runs
                .iter()
                .any(|run| run.features[feature].as_ref().is_some_and(|p| p.dims[dim].n_wraps > 0));
            !wraps && !matches!(plan.layouts[feature].kinds[dim], DimKind::Wrapped { .. })
        };
        let is_used = |c: &usize| scales[*c].1 > 1e-6 * scales[*c].0.abs().max(1e-6) && is_plain(*c);
        let dims: Vec<usize> = (0..n_values).filter(is_used).collect();
        let moves = |state: usize| scales[n_values + state].1 > 1e-6 * scales[state].1;
        let targets: Vec<usize> =
            (0..dims.len()).filter(|k| dims[*k] < n_states && moves(dims[*k])).collect();
        if targets.is_empty() {
            return None;
        }
        let standardise = |run: &&RunProfile| {
            let mut out = Standardised { x: vec![], steps: vec![], n_rows: 0, rows: vec![] };
            let rows = run.relations.values.chunks_exact(width).enumerate();
            for (t, row) in rows.filter(|(_, row)| row.iter().all(|v| v.is_finite())) {
                out.x.push(1.0);
                out.x.extend(dims.iter().map(|c| (f64::from(row[*c]) - scales[*c].0) / scales[*c].1));
                let step = |k: &usize| f64::from(row[n_values + dims[*k]]) / scales[n_values + dims[*k]].1;
                out.steps.extend(targets.iter().map(step));
                out.n_rows += 1;
                out.rows.push(t * run.relations.stride);
            }
            out
        };
        let standardised: Vec<Standardised> = runs.par_iter().map(standardise).collect();
        let range = |k: &usize| {
            let (feature, dim) = plan.states[dims[*k]];
            let of =
                |run: &&RunProfile| run.features[feature].as_ref().map_or(f64::NAN, |p| p.dims[dim].range());
            median(&runs.iter().map(of).collect::<Vec<_>>()) / scales[n_values + dims[*k]].1
        };
        let ranges = targets.iter().map(range).collect();
        Some(Model { ranges, dims, targets, runs: standardised })
    }

    /// Returns the fits of steps and of values per run and target, by models of the trusted runs of other folds.
    fn fit(&self, trusted: &[bool]) -> Vec<Vec<[Fit; 2]>> {
        let n_folds = self.runs.len().min(MAX_FOLDS);
        let moments: Vec<Option<Moments>> = self
            .runs
            .par_iter()
            .enumerate()
            .map(|(i, run)| {
                (trusted[i] && run.n_rows > 0)
                    .then(|| Moments::of(run, 1 + self.dims.len(), self.targets.len()))
            })
            .collect();
        let mut whole = Moments::zero(1 + self.dims.len(), self.targets.len());
        moments.iter().flatten().for_each(|m| whole.add(m, 1.0));
        let coefficients: Vec<_> = (0..n_folds)
            .into_par_iter()
            .map(|fold| {
                let mut others = whole.clone();
                moments.iter().skip(fold).step_by(n_folds).flatten().for_each(|m| others.add(m, -1.0));
                others.solve(&self.targets)
            })
            .collect();
        let fit = |(i, run): (usize, &Standardised)| match &coefficients[i % n_folds] {
            Some(coefficients) => coefficients.fit(run, &self.targets),
            None => vec![[Fit::default(); 2]; self.targets.len()],
        };
        self.runs.par_iter().enumerate().map(fit).collect()
    }

    fn misfits(&self, fits: &[Vec<[Fit; 2]>], thresholds: &Thresholds, runs: &[&RunProfile]) -> Vec<Misfit> {
        let n_rows: usize = self.runs.iter().map(|r| r.n_rows).sum();
        let bounds = &thresholds.semantic;
        let mut found = Vec::new();
        for (t, k) in self.targets.iter().enumerate() {
            for (kind, label) in [(0, MisfitKind::Steps), (1, MisfitKind::Values)] {
                if n_rows < ROWS_PER_DIM[kind] * (1 + self.dims.len()) {
                    continue;
                }
                let errors: Vec<f64> = fits.iter().map(|run| run[t][kind].error).collect();
                if median(&errors) < HOLDS[kind] {
                    let least = SURE[kind] * bounds.relation_error;
                    let mut far = outlying(&errors, least, bounds.relation_ratio);
                    if far.is_empty() {
                        // Where the others agree closely, less is clear as well.
                        far = outlying(&errors, 0.5 * least, bounds.relation_ratio.powi(2));
                    }
                    found.extend(far.into_iter().map(|(run, ratio, usual)| {
                        let fit = fits[run][t][kind];
                        Misfit { run, state: self.dims[*k], ratio, usual, fit, kind: label }
                    }));
                }
            }
            // What the steps lack adds up.
            let drift = |(run, fits): (&&RunProfile, &Vec<[Fit; 2]>)| {
                fits[t][0].bias.abs() * run.n_rows as f64 / self.ranges[t]
            };
            let drifts: Vec<f64> = runs.iter().zip(fits).map(drift).collect();
            if median(&drifts) < USUAL_DRIFT && n_rows >= ROWS_PER_DIM[0] * (1 + self.dims.len()) {
                let far = outlying(&drifts, DRIFT_SHARE, 2.0 * bounds.relation_ratio);
                found.extend(far.into_iter().map(|(run, ratio, usual)| {
                    let fit = Fit { error: drifts[run], ..fits[run][t][0] };
                    Misfit { run, state: self.dims[*k], ratio, usual, fit, kind: MisfitKind::Drift }
                }));
            }
        }
        found
    }

    /// Makes one finding of all that does not fit in a run.
    fn finding(&self, plan: &Plan, runs: &[&RunProfile], misfits: &[Misfit], run: usize) -> Option<Finding> {
        let mut here: Vec<&Misfit> = misfits.iter().filter(|m| m.run == run).collect();
        here.sort_by(|a, b| b.ratio.total_cmp(&a.ratio).then(a.state.cmp(&b.state)));
        let worst = *here.first()?;
        let name = |state: usize| plan.name(plan.states[state]);
        let (feature, dim) = name(worst.state);
        let mut others: Vec<&str> = Vec::new();
        for misfit in &here {
            let other = name(misfit.state).1;
            if misfit.state != worst.state && !others.contains(&other) && others.len() < 4 {
                others.push(other);
            }
        }
        let also = if others.is_empty() { String::new() } else { format!("; nor do {}", others.join(", ")) };
        let (error, usual) = (100.0 * worst.fit.error, 100.0 * worst.usual);
        let text = match worst.kind {
            MisfitKind::Steps => format!(
                "steps do not follow from the dims and actions as elsewhere: off by {error:.0} % of their size, elsewhere {usual:.1} %, and {:.2} times what is expected",
                worst.fit.gain
            ),
            MisfitKind::Values => format!(
                "values do not follow from the other dims and actions as elsewhere: off by {error:.0} % of their spread, elsewhere {usual:.1} %, and {:.2} times what is expected",
                worst.fit.gain
            ),
            MisfitKind::Drift => format!(
                "the signal drifts by {error:.0} % of its range against what the other dims and actions say, elsewhere {usual:.1} %"
            ),
        };
        let row = self.runs[run].rows.get(worst.fit.worst_row).copied().unwrap_or(0);
        let place =
            if worst.kind == MisfitKind::Drift { String::new() } else { format!(", most at row {row}") };
        let finding = Finding::new("SEMANTIC-016", text + &place + &also).episode(runs[run].episode);
        let finding = finding.rows(0, runs[run].n_rows);
        Some(finding.feature(feature).dim(dim).measured(worst.fit.error, worst.fit.error / worst.ratio))
    }
}

/// Returns runs above the widest gap between measures, up to a quarter of all, with the gap and the usual measure.
pub(super) fn outlying(measures: &[f64], least: f64, ratio: f64) -> Vec<(usize, f64, f64)> {
    let n = measures.len();
    let usual = median(measures);
    let mut order: Vec<usize> = (0..n).collect();
    order.sort_by(|a, b| measures[*a].total_cmp(&measures[*b]).then(a.cmp(b)));
    let at = |k: usize| measures[order[k]].max(NO_ERROR);
    let from = n - (n / 4).max(1);
    let gaps = (from.max(1)..n).filter(|k| at(*k) >= least && at(*k) > 3.0 * usual);
    let Some(k) = gaps.max_by(|a, b| (at(*a) / at(a - 1)).total_cmp(&(at(*b) / at(b - 1)))) else {
        return Vec::new();
    };
    // Fewer episodes say less of what is usual.
    let exponent = match n {
        ..=4 => 1.75,
        5..=6 => 1.5,
        7..=9 => 1.25,
        _ => 1.0,
    };
    let gap = at(k) / at(k - 1);
    if gap < ratio.powf(exponent) {
        return Vec::new();
    }
    order[k..].iter().map(|run| (*run, measures[*run] / at(k - 1), usual)).collect()
}

fn mean_square(values: &[f64], centre: f64) -> f64 {
    let finite = values.iter().filter(|v| v.is_finite());
    let (n, sum) = finite.fold((0usize, 0.0), |(n, s), v| (n + 1, s + (v - centre) * (v - centre)));
    sum / n.max(1) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_run_far_above_the_others_stands_out() {
        let mut errors = vec![0.1, 0.12, 0.09, 0.11, 0.1, 0.13, 0.1, 0.1, 0.12, 0.11];
        assert!(outlying(&errors, 0.5, 2.2).is_empty());
        errors[3] = 0.9;
        assert_eq!(outlying(&errors, 0.5, 2.2).iter().map(|o| o.0).collect::<Vec<_>>(), [3]);
        // Two of ten may share a defect.
        errors[7] = 1.1;
        assert_eq!(outlying(&errors, 0.5, 2.2).iter().map(|o| o.0).collect::<Vec<_>>(), [3, 7]);
        // A third of all is nature.
        errors[8] = 1.0;
        assert!(outlying(&errors, 0.5, 2.2).is_empty());
    }
}
