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
    let spec =
        DrawSpec { name: "test".to_owned(), count, offset: 25, filter, budget_steps: 50, seed };
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
fn explore() {
    let world = world();
    let episodes: Vec<_> = (0..1000).map(|i| expert_episode(&world, 77 + i, i.to_string())).collect();
    let published = reference_problems(&world, &episodes, 500, 42).unwrap().problems;
    let line = StraightLine { world: &world };
    println!("published: line {} noop {} random {} known {} blind {}", rate(&published, &line), rate(&published, &NoOp { action_width: 2 }), rate(&published, &random()), rate(&published, &known(true)), rate(&published, &known(false)));
    for (f, n) in [(Filter::NonTrivial, 500), (Filter::Wall, 300)] {
        let set = draw(f, n, 5);
        let p = &set.problems;
        println!("{f:?} seen {}: line {} noop {} random {} known {} blind {} oracle {}", set.pairs_seen, rate(p, &line), rate(p, &NoOp { action_width: 2 }), rate(p, &random()), rate(p, &known(true)), rate(p, &known(false)), rate(p, &Oracle));
    }
}
