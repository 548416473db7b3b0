//! Floors as published, failures that stay where they are, and results that depend on nothing else.

use super::*;
use crate::agent::{KnownDynamics, NoOp, Oracle, PlanningAgent, Random, StraightLine};
use crate::planner::{ActionSpace, PlannerConfig, planner};
use crate::problem::{DrawSpec, Filter, ProblemSet, draw_from_simulator, expert_episode, reference_problems};
use crate::world::TwoRoomWorld;
use gawm_sim::{EnvironmentError, EnvironmentSpec, Step, TwoRoomConfig};

const RULES: Rules = Rules { budget_steps: REFERENCE_BUDGET_STEPS, frameskip: 5 };

fn world() -> TwoRoomWorld {
    TwoRoomWorld::new(TwoRoomConfig::default()).unwrap()
}

fn space() -> ActionSpace {
    ActionSpace::new(world().environment().spec(), [(0.0, 0.75), (0.0, 0.75)], 5)
}

fn draw(filter: Filter, count: usize, seed: u64) -> ProblemSet {
    let spec = DrawSpec { name: "test".to_owned(), count, offset: 25, filter, budget_steps: 50, seed };
    draw_from_simulator(&world(), &spec).unwrap()
}

fn known(has_wall: bool) -> PlanningAgent<'static> {
    let config = PlannerConfig::small();
    let dynamics = KnownDynamics { geometry: world().geometry().unwrap().clone(), has_wall, space: space() };
    PlanningAgent::new(planner(&config, &space()).unwrap(), Box::new(dynamics), space(), config)
}

fn rate(problems: &[Problem], agent: &dyn Agent) -> f64 {
    let outcomes = evaluate(&world(), problems, agent, RULES, &|_| ());
    assert!(outcomes.iter().all(|outcome| outcome.failure.is_none()), "{outcomes:?}");
    outcomes.iter().filter(|outcome| outcome.success_any).count() as f64 / problems.len() as f64
}

fn random() -> Random {
    Random { bounds: vec![(-1.0, 1.0); 2], seed: 1 }
}

fn check_within(what: &str, got: f64, low: f64, high: f64) {
    assert!((low..=high).contains(&got), "{what}: expected {low} to {high}, got {got}");
}

#[test]
fn floors_of_the_published_problems_are_as_measured() {
    let world = world();
    let episodes: Vec<_> = (0..400).map(|seed| expert_episode(&world, seed, seed.to_string())).collect();
    let problems = reference_problems(&world, &episodes, 400, 42).unwrap().problems;
    // Published figures: 10 % trivial, a straight line 94 %. Three standard errors of 400 problems.
    check_within("no-op", rate(&problems, &NoOp { action_width: 2 }), 0.055, 0.145);
    check_within("straight line", rate(&problems, &StraightLine { world: &world }), 0.905, 0.98);
}

#[test]
fn floors_of_the_wall_set_are_as_measured() {
    let problems = draw(Filter::Wall, 100, 5).problems;
    assert_eq!(rate(&problems, &NoOp { action_width: 2 }), 0.0);
    assert_eq!(rate(&problems, &StraightLine { world: &world() }), 0.0);
    assert_eq!(rate(&problems, &Oracle), 1.0);
    check_within("random", rate(&problems, &random()), 0.0, 0.07);
    check_within("wall-blind", rate(&problems, &known(false)), 0.05, 0.40);
    check_within("true dynamics", rate(&problems, &known(true)), 0.82, 1.0);
}

/// TwoRoom that breaks right of a line: `step` refuses as if the action were not finite.
struct Fragile {
    room: Box<dyn Environment>,
    breaks_beyond_px: f64,
}

impl Environment for Fragile {
    fn spec(&self) -> &EnvironmentSpec {
        self.room.spec()
    }
    fn reset(&mut self, seed: u64) {
        self.room.reset(seed);
    }
    fn set_state(&mut self, state: &State) -> Result<(), EnvironmentError> {
        self.room.set_state(state)
    }
    fn step(&mut self, action: &[f32]) -> Result<Step, EnvironmentError> {
        if self.room.state().system[0] > self.breaks_beyond_px {
            return Err(EnvironmentError::Width { what: "action", expected: 0, got: 2 });
        }
        self.room.step(action)
    }
    fn render(&self, frame: &mut Frame) {
        self.room.render(frame);
    }
    fn success(&self) -> bool {
        self.room.success()
    }
    fn state(&self) -> State {
        self.room.state()
    }
    fn oracle(&self) -> Vec<f32> {
        self.room.oracle()
    }
}

struct FragileWorld(TwoRoomWorld);

impl World for FragileWorld {
    fn environment(&self) -> Box<dyn Environment> {
        Box::new(Fragile { room: self.0.environment(), breaks_beyond_px: 112.0 })
    }
    fn straight_line(&self, state: &State) -> Option<Vec<f32>> {
        self.0.straight_line(state)
    }
    fn geometry(&self) -> Option<&gawm_sim::two_room::Geometry> {
        self.0.geometry()
    }
}

#[test]
fn an_environment_that_fails_ends_its_own_problem() {
    let problems = draw(Filter::NonTrivial, 40, 5).problems;
    let outcomes = evaluate(&FragileWorld(world()), &problems, &Oracle, RULES, &|_| ());
    let whole = evaluate(&world(), &problems, &Oracle, RULES, &|_| ());
    let n_failed = outcomes.iter().filter(|outcome| outcome.failure.is_some()).count();
    assert!((5..35).contains(&n_failed), "{n_failed}");
    for (outcome, whole) in outcomes.iter().zip(&whole) {
        match &outcome.failure {
            None => assert_eq!(outcome, whole),
            Some(failure) => {
                assert_eq!((failure.what, failure.step), (FailedPart::Environment, outcome.actions.len()));
                assert!(failure.reason.contains("wrong width") && !outcome.success_last);
                assert_eq!(outcome.distances[..], whole.distances[..failure.step]);
            }
        }
    }
}

/// Acts well on the first problem, gives NaN on the second, nothing on the third, and an error on the fourth.
struct Odd;

impl Agent for Odd {
    fn decide(&self, views: &[View<'_>]) -> Vec<Result<Decision, String>> {
        let act = |view: &View<'_>| match view.index {
            0 => Ok(Decision { actions: vec![view.oracle.clone()], plan: None }),
            1 => Ok(Decision { actions: vec![vec![f32::NAN, 0.0]], plan: None }),
            2 => Ok(Decision { actions: Vec::new(), plan: None }),
            _ => Err("no idea".to_owned()),
        };
        views.iter().map(act).collect()
    }
}

#[test]
fn actions_that_are_no_numbers_are_a_record() {
    let problems = draw(Filter::NonTrivial, 4, 6).problems;
    let outcomes = evaluate(&world(), &problems, &Odd, RULES, &|_| ());
    assert!(outcomes[0].success_any && outcomes[0].failure.is_none());
    let reason = |index: usize| outcomes[index].failure.as_ref().unwrap().reason.clone();
    assert!(reason(1).contains("action[0] is not usable"), "{}", reason(1));
    assert_eq!((reason(2).as_str(), reason(3).as_str()), ("the agent gave no action", "no idea"));
}

fn model_agent<'a>(
    world: &'a TwoRoomWorld,
    run: &'a crate::run::Run,
    config: &PlannerConfig,
) -> PlanningAgent<'a> {
    crate::suite::latent_agent(world, run, config).unwrap()
}

#[test]
fn models_and_settings_that_do_not_fit_are_refused() {
    let world = world();
    let check_refused = |change: &dyn Fn(&mut crate::run::Run, &mut PlannerConfig), says: &str| {
        let (mut run, mut config) = (crate::testing::run(3), PlannerConfig::small());
        change(&mut run, &mut config);
        let error = crate::suite::latent_agent(&world, &run, &config).err().map(|error| error.to_string());
        assert!(error.as_ref().is_some_and(|error| error.contains(says)), "{says}: {error:?}");
    };
    check_refused(&|run, _| run.hello.action.dims[1].max = 40.0, "expected y from -1 to 1 as two-room has");
    check_refused(&|run, _| drop(run.hello.action.dims.pop()), "1 action dims, expected 2");
    check_refused(&|_, config| config.history = 4, "planner.history");
    check_refused(&|_, config| config.deadline_ms = Some(0), "planner.deadline_ms");
}

#[test]
fn planning_over_a_model_does_not_depend_on_threads_or_other_problems() {
    let (world, run) = (world(), crate::testing::run(3));
    let problems = draw(Filter::NonTrivial, 3, 7).problems;
    let config = PlannerConfig {
        samples: 20,
        iterations: 2,
        elites: 4,
        horizon: 2,
        receding: 1,
        history: 3,
        kept_elites: 2,
        ..PlannerConfig::small()
    };
    let rules = Rules { budget_steps: 15, frameskip: 5 };
    let act = |problems: &[Problem]| {
        evaluate(&world, problems, &model_agent(&world, &run, &config), rules, &|_| ())
    };
    let together = act(&problems);
    assert!(
        together.iter().all(|outcome| outcome.failure.is_none() && outcome.plans.len() == 3),
        "{together:?}"
    );
    assert_eq!(act(&problems[1..2])[0], together[1]);
    let one_thread = rayon::ThreadPoolBuilder::new().num_threads(1).build().unwrap();
    assert_eq!(one_thread.install(|| act(&problems)), together);
}

#[test]
fn a_model_that_gives_nan_fails_its_problems_and_says_so() {
    let (world, run) = (world(), crate::testing::run(3));
    let name = "pred_proj.net.3.bias";
    let bias = run.model.parameters().get(name).unwrap();
    run.model.parameters().set(name, &(bias * f64::NAN).unwrap()).unwrap();
    let problems = draw(Filter::NonTrivial, 2, 7).problems;
    let outcomes =
        evaluate(&world, &problems, &model_agent(&world, &run, &PlannerConfig::small()), RULES, &|_| ());
    for outcome in &outcomes {
        let failure = outcome.failure.as_ref().unwrap();
        assert_eq!((failure.what, failure.step), (FailedPart::Agent, 0));
        assert!(failure.reason.contains("finite costs"), "{}", failure.reason);
    }
}
