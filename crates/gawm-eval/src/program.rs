//! What the programs do, as functions: from a run and a configuration to results and files.
//!
//! The command line and the front door call these; they return what they made and print nothing.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use gawm_sim::TwoRoomConfig;
use thiserror::Error;

use crate::compare::{CompareTable, OutcomeLine};
use crate::config::{PlanConfig, Protocol, Source};
use crate::data::{Data, DataError};
use crate::diagnose::{DiagnoseError, Diagnosis, check_schema};
use crate::figures::{Page, compare_page, diagnose_figures, diagnose_page, plan_figures, plan_page};
use crate::output::{OutputError, Table, write, write_json};
use crate::problem::{
    EpisodeStates, Filter, ProblemError, draw_from_episodes, draw_from_simulator, expert_episode,
    reference_problems,
};
use crate::run::Run;
use crate::sheet::contact_sheet;
use crate::suite::{
    Models, NamedSet, PLAN_VERSION, PlanReport, Solver, SuiteError, SuiteOptions, honest_specs, run_suite,
};
use crate::world::{TwoRoomWorld, World};

/// Simulated episodes that stand in for the published file where there is no dataset.
const SIMULATED_EPISODES: u64 = 1000;

/// Why a program fails.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum ProgramError {
    /// The environment.
    #[error(transparent)]
    World(#[from] gawm_sim::two_room::ConfigError),
    /// The problems.
    #[error(transparent)]
    Problems(#[from] ProblemError),
    /// The dataset.
    #[error(transparent)]
    Data(#[from] DataError),
    /// The dataset does not fit the run.
    #[error(transparent)]
    Diagnose(#[from] DiagnoseError),
    /// The protocol.
    #[error(transparent)]
    Suite(#[from] SuiteError),
    /// A result cannot be written.
    #[error(transparent)]
    Output(#[from] OutputError),
    /// Problems of a dataset were asked for, and none was given.
    #[error("plan.source is dataset, and no dataset was given")]
    NoData,
    /// The dataset's states are not the environment's.
    #[error(
        "feature {feature:?} is no state of {task}: expected {expected} dims, got {got} (episode {episode})"
    )]
    System {
        /// The feature.
        feature: String,
        /// The environment.
        task: &'static str,
        /// Dims of its state.
        expected: usize,
        /// Dims found.
        got: usize,
        /// The episode.
        episode: String,
    },
}

/// What [`plan`] makes.
#[derive(Debug, Clone)]
pub struct PlanResult {
    /// The report; outcomes of each problem are inside.
    pub report: PlanReport,
    /// The problems.
    pub sets: Vec<NamedSet>,
}

/// Makes the problem sets of a configuration.
///
/// # Errors
/// - [`ProgramError`] if the dataset does not fit or there are too few problems.
pub fn problem_sets(
    world: &TwoRoomWorld,
    data: Option<&Data>,
    config: &PlanConfig,
) -> Result<Vec<NamedSet>, ProgramError> {
    if config.protocol == Protocol::Reference {
        let episodes = match data {
            Some(data) => episode_states(world, data, config, |_| true)?,
            None => (0..SIMULATED_EPISODES)
                .map(|index| {
                    expert_episode(world, config.seed.wrapping_add(index), format!("simulated-{index}"))
                })
                .collect(),
        };
        let mut set = reference_problems(world, &episodes, config.count, config.seed)?;
        if let Some(data) = data {
            attach_goals(&mut set.problems, data)?;
        }
        return Ok(vec![NamedSet { name: "published".to_owned(), spec: None, set }]);
    }
    let specs = honest_specs(&config.problems, config.count, config.offset, config.budget_steps, config.seed);
    specs
        .into_iter()
        .map(|spec| {
            let set = match config.source {
                Source::Simulator => draw_from_simulator(world, &spec)?,
                Source::Dataset => {
                    let data = data.ok_or(ProgramError::NoData)?;
                    let (held_out, _) = data.held_out();
                    // Halves by the hash of the id, so that tuning never sees an episode of the final sets.
                    let is_tuning = config.problems == "tuning";
                    let in_half = |index: usize| {
                        let id = format!("{}/tuning", data.episodes[index].id);
                        held_out.contains(&index) && gawm_schema::is_training(&id, 0.5) == is_tuning
                    };
                    let episodes = episode_states(world, data, config, in_half)?;
                    let mut set = draw_from_episodes(world, &episodes, &spec)?;
                    attach_goals(&mut set.problems, data)?;
                    set
                }
            };
            let name = spec.filter.name().to_owned();
            Ok(NamedSet { name, spec: Some(spec), set })
        })
        .collect()
}

fn episode_states(
    world: &TwoRoomWorld,
    data: &Data,
    config: &PlanConfig,
    is_wanted: impl Fn(usize) -> bool,
) -> Result<Vec<EpisodeStates>, ProgramError> {
    let environment = world.environment();
    let spec = environment.spec();
    let expected = spec.state.len();
    let wanted = data.episodes.iter().enumerate().filter(|(index, _)| is_wanted(*index));
    wanted
        .map(|(_, episode)| {
            let got = episode.system.len() / episode.n_rows.max(1);
            if got != expected {
                return Err(ProgramError::System {
                    feature: config.system_feature.clone(),
                    task: spec.name,
                    expected,
                    got,
                    episode: episode.id.clone(),
                });
            }
            let rows = episode.system.chunks_exact(expected).map(<[f64]>::to_vec).collect();
            Ok(EpisodeStates { id: episode.id.clone(), rows })
        })
        .collect()
}

/// Reads the goal images of problems from the dataset.
fn attach_goals(problems: &mut [crate::problem::Problem], data: &Data) -> Result<(), DataError> {
    for problem in problems {
        let episode = data.episodes.iter().find(|episode| episode.id == problem.episode);
        if let Some(episode) = episode {
            problem.goal_image = data.frames(episode, &[problem.goal_row])?.pop().map(Arc::new);
        }
    }
    Ok(())
}

/// Plans: the protocol of the configuration, the model and all floors on the same problems.
///
/// Without a run, only floors and ceilings are run. `progress` is told set, solver and steps taken.
///
/// # Errors
/// - [`ProgramError`]; problems that fail are no error but a record in the report.
pub fn plan(
    run: Option<&Run>,
    shuffled: Option<&Run>,
    data: Option<&Data>,
    config: &PlanConfig,
    progress: &dyn Fn(&str, Solver, usize),
) -> Result<PlanResult, ProgramError> {
    let world = TwoRoomWorld::new(TwoRoomConfig::default())?;
    if let (Some(run), Some(data)) = (run, data) {
        check_schema(run, data)?;
    }
    let sets = problem_sets(&world, data, config)?;
    let options = SuiteOptions {
        planner: config.planner(),
        budget_steps: config.budget_steps,
        floor_seed: config.floor_seed,
    };
    let models = run.map(|run| Models { run, shuffled });
    let results = run_suite(&world, &sets, models, &options, progress)?;
    let protocol = match config.protocol {
        Protocol::Honest => format!("honest {}", config.problems),
        Protocol::Reference => "reference".to_owned(),
    };
    let report = PlanReport {
        format_version: PLAN_VERSION,
        protocol,
        task: world.environment().spec().name.to_owned(),
        model: run.map(crate::suite::ModelFacts::of),
        options,
        sets: results,
    };
    Ok(PlanResult { report, sets })
}

/// Opens the dataset of a run for evaluation.
///
/// # Errors
/// - [`DataError`] names what the run was trained on and the dataset has not.
pub fn open_data(run: &Run, path: &Path, system_feature: &str) -> Result<Data, DataError> {
    Data::open(path, &run.hello.cameras[0], &run.hello.state, &run.hello.action, system_feature)
}

/// Writes the results of [`plan`]: `plan.json`, `outcomes-SET.jsonl`, tables, figures, contact sheets, `index.html`.
///
/// Returns the page, for reports that hold several.
///
/// # Errors
/// - [`OutputError`] names the file.
pub fn write_plan(folder: &Path, result: &PlanResult, sheet_rows: usize) -> Result<Page, ProgramError> {
    let world = TwoRoomWorld::new(TwoRoomConfig::default())?;
    let report = &result.report;
    let mut sheets = Vec::new();
    for (set, named) in report.sets.iter().zip(&result.sets) {
        let mut lines = String::new();
        for solver in &set.solvers {
            for outcome in &solver.outcomes {
                let line = OutcomeLine { solver: solver.solver, outcome: outcome.clone() };
                lines += &serde_json::to_string(&line).expect("structs of numbers and texts become JSON");
                lines.push('\n');
            }
        }
        write(&folder.join(format!("outcomes-{}.jsonl", set.name)), lines.as_bytes())?;
        let shown = set.solver(Solver::Model).or_else(|| set.solver(Solver::TrueDynamics));
        if let Some(shown) = shown {
            let path = folder.join(format!("sheet-{}.png", set.name));
            let png = contact_sheet(&world, &named.set.problems, &shown.outcomes, sheet_rows)
                .map_err(|cause| OutputError::Image { path: path.clone(), cause })?;
            write(&path, &png)?;
            sheets.push((set.name.clone(), shown.solver, png));
        }
    }
    success_table(report).write(folder, "success")?;
    for (name, svg) in plan_figures(report) {
        write(&folder.join(format!("{name}.svg")), svg.as_bytes())?;
    }
    let page = plan_page(report, &sheets);
    write(&folder.join("index.html"), page.finish().as_bytes())?;
    write_json(&folder.join("plan.json"), report)?; // last: a folder with it is whole
    Ok(page)
}

fn success_table(report: &PlanReport) -> Table {
    let rows: Vec<(&str, &crate::suite::SolverResult)> = report
        .sets
        .iter()
        .flat_map(|set| set.solvers.iter().map(move |solver| (set.name.as_str(), solver)))
        .collect();
    let number =
        |value: fn(&crate::suite::SolverResult) -> f64| rows.iter().map(move |(_, s)| Some(value(s)));
    Table::default()
        .text("set", rows.iter().map(|(set, _)| (*set).to_owned()))
        .text("solver", rows.iter().map(|(_, solver)| solver.solver.name().to_owned()))
        .number("problems", number(|s| s.any.n as f64))
        .number("success_any", number(|s| s.any.rate))
        .number("success_any_low", number(|s| s.any.interval.low))
        .number("success_any_high", number(|s| s.any.interval.high))
        .number("success_last", number(|s| s.last.rate))
        .number("success_non_trivial", number(|s| s.non_trivial.rate))
        .number("failed", number(|s| s.failed as f64))
}

/// Writes a diagnosis: `diagnose.json`, tables, figures, `index.html`. Returns the page.
///
/// # Errors
/// - [`OutputError`] names the file.
pub fn write_diagnosis(folder: &Path, diagnosis: &Diagnosis) -> Result<Page, OutputError> {
    let each = || diagnosis.trajectories.iter().zip(&diagnosis.geometries);
    Table::default()
        .text("trajectory", each().map(|(trajectory, _)| trajectory.id.clone()))
        .number("rows", each().map(|(trajectory, _)| Some(trajectory.n_rows as f64)))
        .number("straightening", each().map(|(_, geometry)| geometry.straightness.score))
        .number("r95", each().map(|(_, geometry)| Some(geometry.r95 as f64)))
        .write(folder, "trajectories")?;
    let local =
        || each().flat_map(|(t, g)| g.straightness.local.iter().enumerate().map(move |(row, s)| (t, row, s)));
    Table::default()
        .text("trajectory", local().map(|(trajectory, _, _)| trajectory.id.clone()))
        .number("step", local().map(|(_, row, _)| Some(row as f64)))
        .number("straightening", local().map(|(_, _, score)| *score))
        .write(folder, "local_straightening")?;
    let energy = &diagnosis.report.geometry.mean_cumulative_energy;
    Table::default()
        .number("directions", (1..=energy.len()).map(|k| Some(k as f64)))
        .number("mean_cumulative_energy", energy.iter().map(|value| Some(*value)))
        .write(folder, "energy")?;
    let horizons = &diagnosis.report.rollouts.horizons;
    Table::default()
        .number("chunks", horizons.iter().map(|h| Some(h.chunks as f64)))
        .number("prediction", horizons.iter().map(|h| Some(h.prediction)))
        .number("identity", horizons.iter().map(|h| Some(h.identity)))
        .number("shuffled", horizons.iter().map(|h| Some(h.shuffled)))
        .write(folder, "prediction")?;
    probe_table(&diagnosis.report.probe).write(folder, "probes")?;
    for (name, svg) in diagnose_figures(diagnosis) {
        write(&folder.join(format!("{name}.svg")), svg.as_bytes())?;
    }
    let page = diagnose_page(diagnosis);
    write(&folder.join("index.html"), page.finish().as_bytes())?;
    write_json(&folder.join("diagnose.json"), &diagnosis.report)?;
    Ok(page)
}

/// Returns the scores of probes as a table.
pub fn probe_table(report: &crate::probe::ProbeReport) -> Table {
    let scores = &report.scores;
    Table::default()
        .text("dim", scores.iter().map(|score| score.dim.clone()))
        .text("probe", scores.iter().map(|score| score.probe.clone()))
        .number("chunks", scores.iter().map(|score| Some(score.chunks as f64)))
        .number("r2", scores.iter().map(|score| score.r2))
        .number("pearson", scores.iter().map(|score| score.pearson))
        .number("rmse", scores.iter().map(|score| Some(score.rmse)))
        .text("unit", scores.iter().map(|score| score.unit.clone()))
        .number("n", scores.iter().map(|score| Some(score.n as f64)))
}

/// Writes a comparison: `compare.json`, `compare.md`, `index.html`.
///
/// # Errors
/// - [`OutputError`] names the file.
pub fn write_comparison(folder: &Path, table: &CompareTable) -> Result<(), OutputError> {
    write(&folder.join("compare.md"), table.to_markdown().as_bytes())?;
    write(&folder.join("index.html"), compare_page(table).finish().as_bytes())?;
    write_json(&folder.join("compare.json"), table)
}

/// Returns where the results of planning for a run go unless told otherwise.
pub fn plan_folder(run: &Path, config: &PlanConfig) -> PathBuf {
    run.join(match config.protocol {
        Protocol::Honest => format!("plan-{}", config.problems),
        Protocol::Reference => "plan-reference".to_owned(),
    })
}

/// Whether all problems of a report went to their end.
pub fn is_whole(report: &PlanReport) -> bool {
    report.sets.iter().flat_map(|set| &set.solvers).all(|solver| solver.failed == 0)
}

/// Returns the filters of a report's sets, for summaries.
pub fn set_of(report: &PlanReport, filter: Filter) -> Option<&crate::suite::SetResult> {
    report.sets.iter().find(|set| set.name == filter.name())
}
