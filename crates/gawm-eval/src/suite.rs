//! A protocol: problem sets, the model, and all floors and ceilings on the same problems.

use serde::{Deserialize, Serialize};
use thiserror::Error;

use crate::agent::{KnownDynamics, NoOp, Oracle, PlanningAgent, Random, StraightLine};
use crate::evaluate::{Agent, Outcome, Rules, evaluate};
use crate::latent::LatentDynamics;
use crate::planner::{
    ActionSpace, Compat, Method, ObjectiveWeights, PlannerConfig, PlannerConfigError, planner,
};
use crate::problem::{DrawSpec, Filter, Problem, ProblemSet};
use crate::run::{Run, RunError};
use crate::statistics::{Interval, PairedDifference, paired_difference, wilson};
use crate::world::World;

/// Share of the range of an action by which recorded commands may leave it; environments clip them.
const ACTION_SLACK: f64 = 0.25;

/// Version of `plan.json`.
pub const PLAN_VERSION: u32 = 1;

/// Which solver an outcome is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Solver {
    /// Planning over the world model of the run.
    Model,
    /// Does nothing.
    NoOp,
    /// Uniform actions.
    Random,
    /// Straight to the goal, blind for walls.
    StraightLine,
    /// The same search over the same architecture with untrained weights.
    Untrained,
    /// The same search over a model that was trained on shuffled actions.
    ShuffledActions,
    /// The same search over the true dynamics without the wall.
    WallBlind,
    /// The same search over the true dynamics: a ceiling.
    TrueDynamics,
    /// The solver with full knowledge: a ceiling.
    Oracle,
}

impl Solver {
    /// Returns the name that reports show.
    pub fn name(self) -> &'static str {
        match self {
            Solver::Model => "model",
            Solver::NoOp => "no-op",
            Solver::Random => "random",
            Solver::StraightLine => "straight-line",
            Solver::Untrained => "untrained",
            Solver::ShuffledActions => "shuffled-actions",
            Solver::WallBlind => "wall-blind",
            Solver::TrueDynamics => "true-dynamics",
            Solver::Oracle => "oracle",
        }
    }

    /// Whether a good model must do better.
    pub fn is_floor(self) -> bool {
        !matches!(self, Solver::Model | Solver::TrueDynamics | Solver::Oracle)
    }
}

/// How a protocol is run.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SuiteOptions {
    /// The search.
    pub planner: PlannerConfig,
    /// Steps that a solver has.
    pub budget_steps: usize,
    /// Seed of the random floor and of the untrained weights.
    pub floor_seed: u64,
}

impl Default for SuiteOptions {
    fn default() -> Self {
        let planner = PlannerConfig::default();
        SuiteOptions { planner, budget_steps: crate::evaluate::REFERENCE_BUDGET_STEPS, floor_seed: 1 }
    }
}

/// A named problem set and how it was drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct NamedSet {
    /// Name in reports and file names, such as `non-trivial`.
    pub name: String,
    /// How it was drawn; `None` for the published choice.
    pub spec: Option<DrawSpec>,
    /// The problems.
    pub set: ProblemSet,
}

/// A success rate with its interval.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Rate {
    /// Problems solved.
    pub successes: usize,
    /// Problems.
    pub n: usize,
    /// Fraction; 0 for no problem.
    pub rate: f64,
    /// 95 % Wilson interval.
    pub interval: Interval,
}

impl Rate {
    /// Counts outcomes.
    pub fn of(outcomes: impl IntoIterator<Item = bool>) -> Rate {
        let (mut successes, mut n) = (0, 0);
        for is_success in outcomes {
            n += 1;
            successes += usize::from(is_success);
        }
        let rate = if n == 0 { 0.0 } else { successes as f64 / n as f64 };
        Rate { successes, n, rate, interval: wilson(successes, n) }
    }
}

/// What one solver did on one set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SolverResult {
    /// Which solver.
    pub solver: Solver,
    /// Solved after any step, as published.
    pub any: Rate,
    /// Solved after the last step.
    pub last: Rate,
    /// Solved after any step, of the problems whose start is no solution.
    pub non_trivial: Rate,
    /// Problems that an environment or a plan ended early.
    pub failed: usize,
    /// Median distance to the goal after the last step, in the unit of the goal.
    pub median_last_distance: Option<f64>,
    /// What happened on each problem, in the order of the set. In a file of its own on disk.
    #[serde(skip)]
    pub outcomes: Vec<Outcome>,
    /// Time that it took. Never written.
    #[serde(skip)]
    pub seconds: f64,
}

/// The model against another solver on the same problems.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Comparison {
    /// The other solver.
    pub against: Solver,
    /// Rate of the model minus rate of the other.
    pub difference: PairedDifference,
}

/// All solvers on one set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct SetResult {
    /// Name of the set.
    pub name: String,
    /// How it was drawn.
    pub spec: Option<DrawSpec>,
    /// Where the problems come from.
    pub source: String,
    /// Problems.
    pub n: usize,
    /// Pairs that were looked at to find them.
    pub pairs_seen: usize,
    /// Problems whose start is a solution already.
    pub n_trivial: usize,
    /// Most problems that share an episode; above 1 the intervals are too narrow.
    pub most_per_episode: usize,
    /// The solvers.
    pub solvers: Vec<SolverResult>,
    /// The model against all others.
    pub comparisons: Vec<Comparison>,
}

impl SetResult {
    /// Returns the result of a solver, if it was run.
    pub fn solver(&self, solver: Solver) -> Option<&SolverResult> {
        self.solvers.iter().find(|result| result.solver == solver)
    }
}

/// The result of a protocol: `plan.json`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct PlanReport {
    /// [`PLAN_VERSION`].
    pub format_version: u32,
    /// `reference` or `honest`.
    pub protocol: String,
    /// The environment.
    pub task: String,
    /// What was trained; `None` when only floors were run.
    pub model: Option<ModelFacts>,
    /// How it was run, all seeds included.
    pub options: SuiteOptions,
    /// One entry per problem set.
    pub sets: Vec<SetResult>,
}

/// What a report says about a model.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelFacts {
    /// Name of the run folder, without the folders above it.
    pub run: String,
    /// The objective's preset, or the name of the folder.
    pub method: String,
    /// Seed of the training.
    pub seed: Option<u64>,
    /// `best` or `last`.
    pub checkpoint: String,
    /// Parameters of the model.
    pub parameters: usize,
    /// Hash of the schema of the data.
    pub schema_hash: String,
    /// Content hashes of the datasets.
    pub dataset_hashes: Vec<String>,
}

impl ModelFacts {
    /// Describes a run.
    pub fn of(run: &Run) -> ModelFacts {
        let canonical = run.path.canonicalize().unwrap_or_else(|_| run.path.clone());
        ModelFacts {
            run: canonical.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default(),
            method: run.method.clone(),
            seed: run.seed,
            checkpoint: run.checkpoint.clone(),
            parameters: run.model.parameters().count(),
            schema_hash: run.hello.schema_hash.to_string(),
            dataset_hashes: run
                .hello
                .datasets
                .iter()
                .map(|dataset| dataset.content_hash.to_string())
                .collect(),
        }
    }
}

/// Why a protocol cannot be run.
#[derive(Debug, Error)]
#[non_exhaustive]
pub enum SuiteError {
    /// A setting of the planner.
    #[error(transparent)]
    Planner(#[from] PlannerConfigError),
    /// Untrained weights cannot be made.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The model acts in another space than the environment.
    #[error("the model was trained on {got} action dims, expected {expected} as {task} has")]
    ActionWidth {
        /// The environment.
        task: &'static str,
        /// Its action dims.
        expected: usize,
        /// The model's.
        got: usize,
    },
    /// The model was trained on larger actions than the environment has.
    #[error(
        "the model was trained on actions of another task: expected {dim} from {} to {} as {task} has, got {:.3} to {:.3}",
        expected.0, expected.1, got.0, got.1
    )]
    ActionRange {
        /// The environment.
        task: &'static str,
        /// The dim of the action.
        dim: String,
        /// The environment's smallest and largest value.
        expected: (f64, f64),
        /// Those of the training data.
        got: (f64, f64),
    },
    /// A weight needs a head that the model has not.
    #[error("planner.objective.state needs a state head, and this model has none (model.state_head)")]
    NoStateHead,
}

/// A run and, if there is one, the same model trained on shuffled actions.
#[derive(Debug, Clone, Copy)]
pub struct Models<'a> {
    /// The run.
    pub run: &'a Run,
    /// The control.
    pub shuffled: Option<&'a Run>,
}

/// Runs the model and all floors and ceilings on all sets. Without a model, only those that need none.
///
/// `progress` is told set, solver and steps taken.
///
/// # Errors
/// - [`SuiteError`]; a problem that fails is no error but a record.
pub fn run_suite(
    world: &dyn World,
    sets: &[NamedSet],
    models: Option<Models<'_>>,
    options: &SuiteOptions,
    progress: &dyn Fn(&str, Solver, usize),
) -> Result<Vec<SetResult>, SuiteError> {
    options.planner.check()?;
    let untrained = models.map(|models| models.run.untrained(options.floor_seed)).transpose()?;
    sets.iter()
        .map(|named| {
            let contest = Contest { world, options, named, models, untrained: untrained.as_ref() };
            contest.run(&|solver, step| progress(&named.name, solver, step))
        })
        .collect()
}

/// Who acts, and how.
type Contestant<'a> = (Solver, Box<dyn Agent + 'a>);

/// All solvers on one set.
struct Contest<'a> {
    world: &'a dyn World,
    options: &'a SuiteOptions,
    named: &'a NamedSet,
    models: Option<Models<'a>>,
    untrained: Option<&'a Run>,
}

impl<'a> Contest<'a> {
    fn run(&self, progress: &dyn Fn(Solver, usize)) -> Result<SetResult, SuiteError> {
        let mut solvers = Vec::new();
        for (solver, agent) in self.agents()? {
            let begin = std::time::Instant::now();
            let problems = &self.named.set.problems;
            let outcomes =
                evaluate(self.world, problems, agent.as_ref(), self.rules(), &|step| progress(solver, step));
            solvers.push(summarise(solver, outcomes, begin.elapsed().as_secs_f64()));
        }
        Ok(finish(self.named, solvers))
    }

    fn rules(&self) -> Rules {
        Rules { budget_steps: self.options.budget_steps, frameskip: self.space().frameskip }
    }

    /// The space of the run; the published frameskip and unit scale without one.
    fn space(&self) -> ActionSpace {
        let environment = self.world.environment();
        match self.models {
            Some(models) => space_of(models.run, environment.spec()),
            None => {
                ActionSpace::new(environment.spec(), environment.spec().action.iter().map(|_| (0.0, 1.0)), 5)
            }
        }
    }

    fn agents(&self) -> Result<Vec<Contestant<'a>>, SuiteError> {
        let environment = self.world.environment();
        let spec = environment.spec();
        let mut agents: Vec<Contestant<'a>> = Vec::new();
        if let Some(models) = self.models {
            let shuffled = models.shuffled.map(|run| (Solver::ShuffledActions, run));
            let untrained = self.untrained.map(|run| (Solver::Untrained, run));
            let runs = [Some((Solver::Model, models.run)), untrained, shuffled];
            for (solver, run) in runs.into_iter().flatten() {
                agents.push((solver, Box::new(latent_agent(self.world, run, &self.options.planner)?)));
            }
        }
        agents.push((Solver::NoOp, Box::new(NoOp { action_width: spec.action.len() })));
        let bounds = spec.action.iter().map(|axis| (axis.low, axis.high)).collect();
        agents.push((Solver::Random, Box::new(Random { bounds, seed: self.options.floor_seed })));
        if self.world.straight_line(&environment.state()).is_some() {
            agents.push((Solver::StraightLine, Box::new(StraightLine { world: self.world })));
        }
        for (solver, has_wall) in [(Solver::WallBlind, false), (Solver::TrueDynamics, true)] {
            if let Some(agent) = known_agent(self.world, &self.space(), &self.options.planner, has_wall)? {
                agents.push((solver, Box::new(agent)));
            }
        }
        agents.push((Solver::Oracle, Box::new(Oracle)));
        Ok(agents)
    }
}

/// Returns the action space of a run in an environment.
fn space_of(run: &Run, spec: &gawm_sim::EnvironmentSpec) -> ActionSpace {
    ActionSpace::new(spec, run.action_standardisation(), run.hello.frameskip)
}

/// Refuses a model that cannot act in an environment, and settings that it cannot be planned with.
fn check_fit(run: &Run, spec: &gawm_sim::EnvironmentSpec, config: &PlannerConfig) -> Result<(), SuiteError> {
    let (expected, got) = (spec.action.len(), run.hello.action.dims.len());
    if expected != got {
        return Err(SuiteError::ActionWidth { task: spec.name, expected, got });
    }
    for (axis, dim) in spec.action.iter().zip(&run.hello.action.dims) {
        let (low, high) = (dim.mean + dim.scale * dim.min, dim.mean + dim.scale * dim.max);
        let slack = ACTION_SLACK * (axis.high - axis.low);
        if low < axis.low - slack || high > axis.high + slack {
            let (dim, expected, got) = (dim.name.clone(), (axis.low, axis.high), (low, high));
            return Err(SuiteError::ActionRange { task: spec.name, dim, expected, got });
        }
    }
    let architecture = run.model.architecture();
    let model = architecture.config();
    if config.objective.state > 0.0 && !(model.state_head && architecture.widths().state > 0) {
        return Err(SuiteError::NoStateHead);
    }
    if config.history > model.predictor.history {
        let got = format!("{} where the model sees {}", config.history, model.predictor.history);
        let expected = "1 to the history of the model";
        return Err(PlannerConfigError { field: "history", expected, got }.into());
    }
    Ok(())
}

/// Plans over the world model of a run.
///
/// # Errors
/// - [`SuiteError`] if the model's actions are not the environment's, or a setting does not fit.
pub fn latent_agent<'a>(
    world: &'a dyn World,
    run: &'a Run,
    config: &PlannerConfig,
) -> Result<PlanningAgent<'a>, SuiteError> {
    let environment = world.environment();
    let spec = environment.spec();
    check_fit(run, spec, config)?;
    let space = space_of(run, spec);
    let dynamics = LatentDynamics::new(&run.model, world, space.clone(), run.image_size(), config);
    Ok(PlanningAgent::new(planner(config, &space)?, Box::new(dynamics), space, config.clone()))
}

/// Plans over known dynamics with the settings of the model's search; `None` for environments without such.
///
/// The gradient method and other objectives than the distance need a model: here it is the sampling search.
fn known_agent<'a>(
    world: &'a dyn World,
    space: &ActionSpace,
    config: &PlannerConfig,
    has_wall: bool,
) -> Result<Option<PlanningAgent<'a>>, SuiteError> {
    let Some(geometry) = world.geometry() else { return Ok(None) };
    let method = if config.method == Method::Gradient { Method::Cem } else { config.method };
    let objective = ObjectiveWeights::default();
    let config = PlannerConfig { method, objective, ..config.clone() };
    let dynamics = KnownDynamics { geometry: geometry.clone(), has_wall, space: space.clone() };
    Ok(Some(PlanningAgent::new(planner(&config, space)?, Box::new(dynamics), space.clone(), config)))
}

fn summarise(solver: Solver, outcomes: Vec<Outcome>, seconds: f64) -> SolverResult {
    let lasts: Vec<f64> = outcomes.iter().filter_map(|outcome| outcome.distances.last().copied()).collect();
    SolverResult {
        solver,
        any: Rate::of(outcomes.iter().map(|outcome| outcome.success_any)),
        last: Rate::of(outcomes.iter().map(|outcome| outcome.success_last)),
        non_trivial: Rate::of(outcomes.iter().filter(|o| !o.is_trivial).map(|o| o.success_any)),
        failed: outcomes.iter().filter(|outcome| outcome.failure.is_some()).count(),
        median_last_distance: crate::statistics::median(&lasts),
        outcomes,
        seconds,
    }
}

fn finish(named: &NamedSet, solvers: Vec<SolverResult>) -> SetResult {
    let model = solvers.iter().find(|result| result.solver == Solver::Model);
    let comparisons = model.into_iter().flat_map(|model| {
        solvers.iter().filter(|other| other.solver != Solver::Model).map(|other| {
            let pairs =
                model.outcomes.iter().zip(&other.outcomes).map(|(a, b)| (a.success_any, b.success_any));
            Comparison { against: other.solver, difference: paired_difference(pairs) }
        })
    });
    let comparisons = comparisons.collect();
    let problems: &[Problem] = &named.set.problems;
    SetResult {
        name: named.name.clone(),
        spec: named.spec.clone(),
        source: named.set.source.clone(),
        n: problems.len(),
        pairs_seen: named.set.pairs_seen,
        n_trivial: problems.iter().filter(|problem| problem.is_trivial).count(),
        most_per_episode: named.set.most_per_episode,
        solvers,
        comparisons,
    }
}

/// The sets of the honest protocol: non-trivial problems, and the wall set where there is one.
pub fn honest_specs(
    name: &str,
    count: usize,
    offset: usize,
    budget_steps: usize,
    seed: u64,
) -> Vec<DrawSpec> {
    let spec = |filter| DrawSpec { name: name.to_owned(), count, offset, filter, budget_steps, seed };
    vec![spec(Filter::NonTrivial), spec(Filter::Wall)]
}

/// Settings of the published evaluation.
pub fn reference_options() -> SuiteOptions {
    let planner = PlannerConfig { compat: Compat::Reference, ..PlannerConfig::default() };
    SuiteOptions { planner, ..SuiteOptions::default() }
}
