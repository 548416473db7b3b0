//! The figures and pages of our reports.

use gawm_model::diagnostics::principal_components;

use super::{Bar, Line, Page, Picture, bars, lines, pictures};
use crate::compare::CompareTable;
use crate::diagnose::{DiagnoseReport, Diagnosis};
use crate::suite::{PlanReport, Rate, SetResult, Solver};

/// Trajectories of which a picture is drawn.
const PICTURES: usize = 4;

/// Draws one figure per set: success of all solvers with intervals. Returns file stems and SVG.
pub fn plan_figures(report: &PlanReport) -> Vec<(String, String)> {
    let figure = |set: &SetResult| {
        let bar = |result: &crate::suite::SolverResult| Bar {
            label: result.solver.name().to_owned(),
            value: 100.0 * result.any.rate,
            interval: Some((100.0 * result.any.interval.low, 100.0 * result.any.interval.high)),
            kind: match result.solver {
                Solver::Model => 0,
                solver if solver.is_floor() => 1,
                _ => 2,
            },
        };
        let all: Vec<Bar> = set.solvers.iter().map(bar).collect();
        let title = format!("{} {}: solved at any step (n = {})", report.task, set.name, set.n);
        (format!("success-{}", set.name), bars(&title, "percent, with 95 % Wilson interval", &all, 100.0))
    };
    report.sets.iter().map(figure).collect()
}

/// Makes the page of a protocol; `sheets` are (set, who acted, PNG).
pub fn plan_page(report: &PlanReport, sheets: &[(String, Solver, Vec<u8>)]) -> Page {
    let name = report.model.as_ref().map_or_else(|| "floors".to_owned(), |model| model.method.clone());
    let mut page = Page::new(&format!("Planning: {name} on {} ({} protocol)", report.task, report.protocol));
    let planner = &report.options.planner;
    page.note(&format!(
        "{} samples x {} iterations, {} elites, horizon {} chunks, replanned after {}; budget {} steps; seeds: planner {}, floors {}. Blue is tested, grey are floors, green are ceilings.",
        planner.samples, planner.iterations, planner.elites, planner.horizon, planner.receding,
        report.options.budget_steps, planner.seed, report.options.floor_seed
    ));
    for (set, (_, figure)) in report.sets.iter().zip(plan_figures(report)) {
        page.heading(&format!("Set: {}", set.name));
        page.note(&format!(
            "{} problems from {}; {} pairs looked at, {} solved at the start, at most {} from one episode.",
            set.n, set.source, set.pairs_seen, set.n_trivial, set.most_per_episode
        ));
        page.figure(&figure);
        page.table(&set_table(set));
        if !set.comparisons.is_empty() {
            page.table(&comparison_table(set));
        }
        for (_, solver, png) in sheets.iter().filter(|(name, _, _)| *name == set.name) {
            page.png(png, &format!("{}: start, six moments, goal; green solved, red not", solver.name()));
        }
    }
    page
}

fn percent(rate: &Rate) -> String {
    if rate.n == 0 {
        return String::new();
    }
    format!("{:.1} [{:.1}, {:.1}]", 100.0 * rate.rate, 100.0 * rate.interval.low, 100.0 * rate.interval.high)
}

fn set_table(set: &SetResult) -> Vec<Vec<String>> {
    let head = ["solver", "any step %", "last step %", "non-trivial %", "median last distance", "failed"];
    let row = |result: &crate::suite::SolverResult| {
        let distance = result.median_last_distance.map(|d| format!("{d:.1}")).unwrap_or_default();
        vec![
            result.solver.name().to_owned(),
            percent(&result.any),
            percent(&result.last),
            percent(&result.non_trivial),
            distance,
            result.failed.to_string(),
        ]
    };
    std::iter::once(head.map(str::to_owned).to_vec()).chain(set.solvers.iter().map(row)).collect()
}

fn comparison_table(set: &SetResult) -> Vec<Vec<String>> {
    let head =
        ["model minus", "difference", "95 % (Newcombe, paired)", "only model / only other", "p (McNemar)"];
    let row = |comparison: &crate::suite::Comparison| {
        let difference = &comparison.difference;
        vec![
            comparison.against.name().to_owned(),
            format!("{:+.1}", 100.0 * difference.difference),
            format!("{:+.1} to {:+.1}", 100.0 * difference.interval.low, 100.0 * difference.interval.high),
            format!("{} / {}", difference.pairs.only_first, difference.pairs.only_second),
            format!("{:.2e}", difference.p_value),
        ]
    };
    std::iter::once(head.map(str::to_owned).to_vec()).chain(set.comparisons.iter().map(row)).collect()
}

/// Makes the page of a comparison.
pub fn compare_page(table: &CompareTable) -> Page {
    let mut page = Page::new("Comparison of runs");
    page.note("Percent of problems solved at any step: mean over runs, 95 % Wilson interval of all problems pooled.");
    let head = std::iter::once("method".to_owned()).chain(table.columns.iter().cloned()).collect();
    let row = |name: &String| {
        let cell = |column: &String| {
            let found = table.cells.iter().find(|cell| cell.row == *name && cell.column == *column);
            found.map(|cell| percent(&cell.pooled)).unwrap_or_default()
        };
        std::iter::once(name.clone()).chain(table.columns.iter().map(cell)).collect()
    };
    let rows: Vec<Vec<String>> = std::iter::once(head).chain(table.rows.iter().map(row)).collect();
    page.table(&rows);
    for column in &table.columns {
        let cells = table.rows.iter().filter_map(|row| {
            let cell = table.cells.iter().find(|cell| cell.row == *row && cell.column == *column)?;
            let interval = Some((100.0 * cell.pooled.interval.low, 100.0 * cell.pooled.interval.high));
            Some(Bar { label: row.clone(), value: 100.0 * cell.pooled.rate, interval, kind: 0 })
        });
        page.figure(&bars(column, "percent, with 95 % Wilson interval", &cells.collect::<Vec<_>>(), 100.0));
    }
    page
}

/// Draws the figures of a diagnosis. Returns file stems and SVG.
pub fn diagnose_figures(diagnosis: &Diagnosis) -> Vec<(String, String)> {
    let report = &diagnosis.report;
    let mut figures = vec![("pca".to_owned(), pca_figure(diagnosis))];
    let energy: Vec<(f64, f64)> = report
        .geometry
        .mean_cumulative_energy
        .iter()
        .enumerate()
        .map(|(k, e)| ((k + 1) as f64, *e))
        .collect();
    let shown = energy.iter().take_while(|(_, e)| *e < 0.9999).count().max(3).min(energy.len());
    let energy = vec![Line { name: "energy".to_owned(), points: energy[..shown].to_vec() }];
    let title = "Mean cumulative energy of transitions";
    figures.push((
        "energy".to_owned(),
        lines(title, ("directions", "share"), &energy, &[0.95], Some((0.0, 1.02))),
    ));
    let scores = diagnosis.geometries.iter().filter_map(|one| one.straightness.score);
    figures.push((
        "straightening".to_owned(),
        histogram("Straightening per trajectory", "mean local score", scores),
    ));
    if !report.rollouts.horizons.is_empty() {
        let series = |name: &str, value: fn(&crate::diagnose::HorizonReport) -> f64| Line {
            name: name.to_owned(),
            points: report.rollouts.horizons.iter().map(|h| (h.chunks as f64, value(h))).collect(),
        };
        let all = [
            series("prediction", |h| h.prediction),
            series("identity", |h| h.identity),
            series("shuffled actions", |h| h.shuffled),
        ];
        let title = "Open-loop error of latents";
        figures.push((
            "prediction".to_owned(),
            lines(title, ("chunks ahead", "mean squared error"), &all, &[], None),
        ));
    }
    if !report.probe.scores.is_empty() {
        let bar = |score: &crate::probe::ProbeScore| Bar {
            label: format!("{} {}", score.dim, score.probe),
            value: score.r2.unwrap_or(0.0),
            interval: None,
            kind: usize::from(score.probe == "linear"),
        };
        let encoded: Vec<Bar> =
            report.probe.scores.iter().filter(|score| score.chunks == 0).map(bar).collect();
        figures.push((
            "probes".to_owned(),
            bars("Probes on encoded latents", "R2 on other episodes", &encoded, 1.0),
        ));
    }
    figures
}

fn pca_figure(diagnosis: &Diagnosis) -> String {
    let picture =
        |(trajectory, geometry): (&crate::diagnose::Trajectory, &crate::diagnose::TrajectoryGeometry)| {
            let z = trajectory.strided(diagnosis.report.options.stride);
            let points = principal_components(&z, trajectory.latent_width, 2);
            Picture { name: trajectory.id.clone(), points, local: geometry.straightness.local.clone() }
        };
    let all = diagnosis.trajectories.iter().zip(&diagnosis.geometries).take(PICTURES);
    pictures(
        "Latents: two principal components by time, local straightening below",
        &all.map(picture).collect::<Vec<_>>(),
    )
}

fn histogram(title: &str, label: &str, values: impl Iterator<Item = f64>) -> String {
    const BINS: usize = 20;
    let values: Vec<f64> = values.collect();
    let (low, high) = super::svg::range(values.iter().copied());
    let mut counts = [0usize; BINS];
    for value in &values {
        counts[(((value - low) / (high - low) * BINS as f64) as usize).min(BINS - 1)] += 1;
    }
    let edge = |bin: usize| low + (high - low) * bin as f64 / BINS as f64;
    let steps = |(bin, count): (usize, &usize)| [(edge(bin), *count as f64), (edge(bin + 1), *count as f64)];
    let points = counts.iter().enumerate().flat_map(steps).collect();
    lines(title, (label, "trajectories"), &[Line { name: "count".to_owned(), points }], &[], None)
}

/// Makes the page of a diagnosis.
pub fn diagnose_page(diagnosis: &Diagnosis) -> Page {
    let report = &diagnosis.report;
    let mut page = Page::new(&format!("Diagnostics: {} ({})", report.model.method, report.model.run));
    let origin = if report.is_held_out { "held-out episodes" } else { "episodes (none is held out)" };
    page.note(&format!(
        "{} fixed trajectories of {origin}, {} latents, stride {}; their ids are in diagnose.json.",
        report.trajectory_ids.len(),
        report.frames,
        report.geometry.stride
    ));
    page.table(&numbers(report));
    let figures = diagnose_figures(diagnosis);
    figures.iter().for_each(|(_, figure)| page.figure(figure));
    if !report.rollouts.horizons.is_empty() {
        page.heading("Prediction");
        page.table(&rollout_table(report));
    }
    if !report.probe.scores.is_empty() {
        page.heading("Probes");
        page.note("Fitted on encoded latents of some episodes, scored on others; chunks ahead 0 means encoded latents, more means predicted ones.");
        page.table(&probe_table(report));
    }
    page
}

fn optional(value: Option<f64>) -> String {
    value.map(|value| format!("{value:.3}")).unwrap_or_default()
}

fn numbers(report: &DiagnoseReport) -> Vec<Vec<String>> {
    let mut rows = vec![vec!["measure".to_owned(), "value".to_owned()]];
    let mut add = |name: &str, value: String| rows.push(vec![name.to_owned(), value]);
    if let Some(spread) = report.geometry.straightening {
        add("straightening, mean +- std", format!("{:.3} +- {:.3}", spread.mean, spread.std));
    }
    if let Some(spread) = report.geometry.r95 {
        add("directions for 95 % of transitions", format!("{:.1} +- {:.1}", spread.mean, spread.std));
    }
    add("effective rank", format!("{:.1} of {}", report.rank.effective_rank, report.rank.latent_width));
    add("RankMe", format!("{:.1}", report.rank.rankme));
    add("mean std of latents", format!("{:.4}", report.rank.mean_std));
    if let Some(last) = report.rollouts.horizons.last() {
        add(&format!("error after {} chunks / standing still", last.chunks), optional(last.against_identity));
        add("error with shuffled actions / with true ones", optional(last.action_sensitivity));
    }
    if let Some(retrieval) = report.retrieval {
        add("state distance of the frame nearest to a goal's latent", format!("{:.3}", retrieval.latent));
        add("the same, best / random", format!("{:.3} / {:.3}", retrieval.best, retrieval.random));
        add("rank correlation of latent and state distance", format!("{:.3}", retrieval.rank_correlation));
    }
    rows
}

fn rollout_table(report: &DiagnoseReport) -> Vec<Vec<String>> {
    let head = [
        "chunks ahead",
        "prediction",
        "identity",
        "shuffled",
        "prediction / identity",
        "shuffled / prediction",
    ];
    let row = |h: &crate::diagnose::HorizonReport| {
        let errors = [h.prediction, h.identity, h.shuffled].map(|value| format!("{value:.4}"));
        let ratios = [h.against_identity, h.action_sensitivity].map(optional);
        std::iter::once(h.chunks.to_string()).chain(errors).chain(ratios).collect()
    };
    std::iter::once(head.map(str::to_owned).to_vec())
        .chain(report.rollouts.horizons.iter().map(row))
        .collect()
}

fn probe_table(report: &DiagnoseReport) -> Vec<Vec<String>> {
    let head = ["dim", "probe", "chunks ahead", "R2", "Pearson r", "RMSE", "unit", "n"];
    let row = |s: &crate::probe::ProbeScore| {
        vec![
            s.dim.clone(),
            s.probe.clone(),
            s.chunks.to_string(),
            optional(s.r2),
            optional(s.pearson),
            format!("{:.3}", s.rmse),
            s.unit.clone(),
            s.n.to_string(),
        ]
    };
    std::iter::once(head.map(str::to_owned).to_vec()).chain(report.probe.scores.iter().map(row)).collect()
}
