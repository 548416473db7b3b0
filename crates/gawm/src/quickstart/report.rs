//! The page of a quickstart: what was done, what was learned, how it plans, what it costs.

use std::path::Path;

use gawm_eval::figures::{Line, Page, lines, plan_page};
use gawm_eval::suite::{PlanReport, Rate, SetResult, Solver};
use serde_json::Value;

use super::{QuickstartError, Summary, read, read_json};
use crate::pipeline::{Layout, Outcome};

/// Figures of the diagnosis that the page shows, in order, as far as they are there.
const MAX_FIGURES: usize = 12;
/// Where curves of skill are cut off.
const LOWEST_SKILL: f64 = -1.0;

/// Makes the page.
pub(super) fn page(
    layout: &Layout,
    plan: &PlanReport,
    summary: &Summary,
    outcome: &Outcome,
) -> Result<String, QuickstartError> {
    let mut page = Page::new("A world model of TwoRoom, from raw logs");
    page.note(&summary.verdict);
    page.table(&headline(plan));
    page.note(
        "Success is a share of the problems, with its 95 % interval, counted when the agent is within 16 px of the goal \
         after any step. A rate means nothing without its floors: a straight line that ignores the wall solves most problems of TwoRoom, \
         so the wall set holds only those that it fails.",
    );
    steps(&mut page, outcome, summary);
    data(&mut page, layout)?;
    curves(&mut page, layout)?;
    let mut sheets = Vec::new();
    for set in &plan.sets {
        let path = layout.plan.join(format!("sheet-{}.png", set.name));
        if path.exists() {
            sheets.push((set.name.clone(), Solver::Model, read(&path)?));
        }
    }
    page.append(&plan_page(plan, &sheets));
    diagnosis(&mut page, layout)?;
    Ok(page.finish())
}

/// The model, its floors and the ceiling on every set.
fn headline(plan: &PlanReport) -> Vec<Vec<String>> {
    let solvers = [
        ("the model", Solver::Model),
        ("floor: nothing", Solver::NoOp),
        ("floor: random", Solver::Random),
        ("floor: straight line", Solver::StraightLine),
        ("floor: untrained encoder", Solver::Untrained),
        ("floor: search blind for the wall", Solver::WallBlind),
        ("ceiling: search that knows the dynamics", Solver::TrueDynamics),
    ];
    let set_name = |name: &str| match name {
        "wall" => "problems that need the door".to_owned(),
        name => format!("{name} problems"),
    };
    let head = plan.sets.iter().map(|set| format!("{}, n = {}", set_name(&set.name), set.n));
    let mut rows = vec![std::iter::once("solver".to_owned()).chain(head).collect()];
    for (name, solver) in solvers {
        let cell = |set: &SetResult| {
            let Rate { rate, interval, .. } = set.solver(solver)?.any;
            let [rate, low, high] = [rate, interval.low, interval.high].map(|fraction| 100.0 * fraction);
            Some(format!("{rate:.0} % [{low:.0}, {high:.0}]"))
        };
        let cells = plan.sets.iter().map(|set| cell(set).unwrap_or_else(|| "-".to_owned()));
        rows.push(std::iter::once(name.to_owned()).chain(cells).collect());
    }
    rows
}

fn steps(page: &mut Page, outcome: &Outcome, summary: &Summary) {
    page.heading("What was done");
    let mut rows = vec![["step", "seconds", "exit code"].map(str::to_owned).to_vec()];
    for step in &outcome.steps {
        rows.push(vec![step.name.as_str().to_owned(), format!("{:.1}", step.seconds), step.exit.to_string()]);
    }
    rows.push(vec!["all".to_owned(), format!("{:.1}", summary.seconds), String::new()]);
    page.table(&rows);
    page.note("The command line of each step is in pipeline.json, the whole configuration in pipeline.toml.");
}

fn data(page: &mut Page, layout: &Layout) -> Result<(), QuickstartError> {
    let info: Value = read_json(&layout.dataset.join("meta/info.json"))?;
    let validation: Value = read_json(&layout.validation)?;
    page.heading("The data");
    let findings = validation["findings"].as_array();
    let count = |severity: &str| {
        let is = |finding: &&Value| finding["severity"] == severity;
        findings.map_or(0, |findings| findings.iter().filter(is).count())
    };
    let (errors, warnings) = (count("error"), count("warning"));
    page.note(&format!(
        "{} episodes, {} frames at {} Hz, ingested from MCAP logs; validation has {errors} errors and {warnings} warnings \
         (validation.json; docs/validation.md says what they mean). dataset.html shows every stream and episode.",
        info["total_episodes"], info["total_frames"], info["fps"]
    ));
    Ok(())
}

/// Draws what `metrics.jsonl` says about validations.
fn curves(page: &mut Page, layout: &Layout) -> Result<(), QuickstartError> {
    let path = layout.run.join("metrics.jsonl");
    let text = String::from_utf8_lossy(&read(&path)?).into_owned();
    let records: Vec<Value> = text
        .lines()
        .map(serde_json::from_str)
        .collect::<Result<_, _>>()
        .map_err(|error| QuickstartError::Content { path, detail: error.to_string() })?;
    let validations: Vec<&Value> = records.iter().filter(|record| record["kind"] == "validation").collect();
    page.heading("What was learned");
    page.note(
        "Held-out episodes. Skill is 1 - loss / loss of the baseline: 0 is no better than it, 1 is perfect.",
    );
    let series = |name: &str, value: &dyn Fn(&Value) -> Option<f64>| Line {
        name: name.to_owned(),
        points: validations
            .iter()
            .filter_map(|record| Some((record["step"].as_f64()?, value(record)?)))
            .collect(),
    };
    // Early validations can lie far below: running statistics lag behind weights that move fast (docs/training.md).
    let skill = |value: Option<f64>| value.map(|value| value.max(LOWEST_SKILL));
    let skills = [
        series("prediction against identity", &|record| skill(record["skill"].as_f64())),
        series("with shuffled actions", &|record| skill(record["skill_shuffled_actions"].as_f64())),
    ];
    page.figure(&lines(
        "Skill of the prediction, cut off at -1",
        ("step", "skill"),
        &skills,
        &[0.0],
        Some((LOWEST_SKILL, 1.0)),
    ));
    let of_term = |record: &Value, name: &str| {
        let terms = record["terms"].as_array()?;
        terms.iter().find(|term| term["term"] == name)?["baseline"]["skill"].as_f64()
    };
    let heads = [
        series("state", &|record| skill(of_term(record, "state-alignment"))),
        series("action", &|record| skill(of_term(record, "inverse-dynamics"))),
    ];
    page.figure(&lines(
        "Skill of the heads, cut off at -1",
        ("step", "skill"),
        &heads,
        &[0.0],
        Some((LOWEST_SKILL, 1.0)),
    ));
    let rank = [series("effective rank", &|record| record["effective_rank"].as_f64())];
    page.figure(&lines("Effective rank of the latents", ("step", "rank"), &rank, &[1.0], None));
    Ok(())
}

fn diagnosis(page: &mut Page, layout: &Layout) -> Result<(), QuickstartError> {
    page.heading("What the latents hold");
    page.note("Details, tables and definitions: diagnose/index.html and docs/evaluation.md.");
    for path in figures(&layout.diagnosis)?.into_iter().take(MAX_FIGURES) {
        page.figure(&String::from_utf8_lossy(&read(&path)?));
    }
    Ok(())
}

fn figures(folder: &Path) -> Result<Vec<std::path::PathBuf>, QuickstartError> {
    let io = |source| QuickstartError::Io { path: folder.to_owned(), source };
    let mut paths = Vec::new();
    for entry in std::fs::read_dir(folder).map_err(io)? {
        let path = entry.map_err(io)?.path();
        if path.extension().is_some_and(|extension| extension == "svg") {
            paths.push(path);
        }
    }
    paths.sort();
    Ok(paths)
}
