//! Problems: how many, which, and from where.

use super::*;
use gawm_sim::TwoRoomConfig;

fn world() -> TwoRoomWorld {
    TwoRoomWorld::new(TwoRoomConfig::default()).unwrap()
}

/// An episode that walks right along y = 50.
fn walk(id: &str, rows: usize) -> EpisodeStates {
    EpisodeStates { id: id.to_owned(), rows: (0..rows).map(|t| vec![25.0 + t as f64, 50.0]).collect() }
}

fn spec(name: &str, filter: Filter, count: usize, seed: u64) -> DrawSpec {
    DrawSpec { name: name.to_owned(), count, offset: 25, filter, budget_steps: 50, seed }
}

#[test]
fn published_pairs_are_numpys() {
    // 30 + 5 + 1 valid starts, in the order of the rows; the last is never chosen.
    let episodes = [walk("a", 55), walk("short", 25), walk("b", 30), walk("c", 26)];
    let set = reference_problems(&world(), &episodes, 5, 42).unwrap();
    let chosen = numpy::sorted_choice(42, 35, 5);
    let expected: Vec<String> = chosen
        .iter()
        .map(|&index| if index < 30 { format!("a/{index}+24") } else { format!("b/{}+24", index - 30) })
        .collect();
    assert_eq!(set.problems.iter().map(|problem| problem.id.clone()).collect::<Vec<_>>(), expected);
    let first = &set.problems[0];
    assert_eq!(first.goal_row, first.start_row + 24);
    assert_eq!(first.state.goal[0] - first.state.system[0], 24.0);
    assert!(!first.is_trivial, "24 px apart");
    let error = reference_problems(&world(), &episodes, 36, 42).unwrap_err();
    assert!(matches!(error, ProblemError::TooFew { expected: 36, got: 36, .. }), "{error}");
}

#[test]
fn sets_repeat_and_differ_by_name_and_seed() {
    let world = world();
    let draw = |name, seed| draw_from_simulator(&world, &spec(name, Filter::NonTrivial, 20, seed)).unwrap();
    let starts = |set: &ProblemSet| set.problems.iter().map(|p| p.state.system.clone()).collect::<Vec<_>>();
    let tuning = draw("tuning", 1);
    assert_eq!(tuning, draw("tuning", 1));
    for other in [draw("final", 1), draw("tuning", 2)] {
        assert!(starts(&other).iter().all(|start| !starts(&tuning).contains(start)));
    }
    assert!(tuning.problems.iter().all(|problem| !problem.is_trivial));
    assert_eq!(tuning.most_per_episode, 1);
}

#[test]
fn wall_problems_need_the_door() {
    let world = world();
    let set = draw_from_simulator(&world, &spec("test", Filter::Wall, 10, 3)).unwrap();
    let mut environment = world.environment();
    for problem in &set.problems {
        let line = |e: &dyn Environment| Ok(world.straight_line(&e.state()).unwrap());
        assert!(!solves(environment.as_mut(), problem, 50, line).unwrap());
        assert!(solves(environment.as_mut(), problem, 50, |e| Ok(e.oracle())).unwrap());
    }
}

#[test]
fn few_episodes_are_used_evenly_and_too_few_are_an_error() {
    let episodes: Vec<EpisodeStates> = (0..3).map(|i| walk(&format!("e{i}"), 40)).collect();
    let set = draw_from_episodes(&world(), &episodes, &spec("x", Filter::NonTrivial, 8, 1)).unwrap();
    let mut ids: Vec<&str> = set.problems.iter().map(|problem| problem.id.as_str()).collect();
    ids.sort_unstable();
    ids.dedup();
    assert_eq!((ids.len(), set.most_per_episode), (8, 3));
    let error = draw_from_episodes(&world(), &episodes, &spec("x", Filter::Wall, 1, 1)).unwrap_err();
    assert!(
        error.to_string().contains("not enough wall problems at +25: expected 1, got 0 of 45"),
        "{error}"
    );
    let broken = EpisodeStates { id: "nan".to_owned(), rows: vec![vec![f64::NAN, 1.0]; 40] };
    let error = draw_from_episodes(&world(), &[broken], &spec("x", Filter::All, 1, 1)).unwrap_err();
    assert!(matches!(error, ProblemError::State { .. }), "{error}");
}
