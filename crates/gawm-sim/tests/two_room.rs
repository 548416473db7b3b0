//! TwoRoom against its formulas: edges, doors, determinism, the oracle and its floors.
#![expect(clippy::unwrap_used, reason = "a failure here is a failed test")]

use gawm_sim::two_room::{
    Door, ExpertConfig, Geometry, TwoRoomExpert, WallAxis, distance_px, oracle_action, straight_line_action,
};
use gawm_sim::{Environment, EnvironmentError, Frame, State, TwoRoom, TwoRoomConfig};
use proptest::prelude::*;
use proptest::test_runner::RngSeed;

fn geometry() -> Geometry {
    Geometry::new(&TwoRoomConfig::default())
}

/// One step of the default task: the wall blocks from 100 to 124, the door is 33.25 to 64.75 along it.
fn check_step(from: [f32; 2], action: [f32; 2], expected: [f32; 2]) {
    assert_eq!(geometry().next_position(from, action), expected, "from {from:?} by {action:?}");
}

#[test]
fn borders_stop_the_agent() {
    check_step([22.0, 22.0], [-1.0, -1.0], [21.0, 21.0]);
    check_step([202.0, 201.0], [1.0, 1.0], [203.0, 203.0]);
    check_step([0.0, 223.0], [0.0, 0.0], [21.0, 203.0]);
}

#[test]
fn actions_are_clipped() {
    check_step([50.0, 150.0], [3.0, -7.0], [55.0, 145.0]);
}

#[test]
fn wall_puts_the_agent_back() {
    check_step([97.0, 150.0], [1.0, 0.0], [99.5, 150.0]);
    check_step([127.0, 150.0], [-1.0, 0.0], [124.5, 150.0]);
    check_step([95.0, 150.0], [1.0, 0.0], [100.0, 150.0]); // touching is not entering
}

#[test]
fn door_lets_the_agent_pass_to_its_margin() {
    check_step([97.0, 64.75], [1.0, 0.0], [102.0, 64.75]);
    check_step([97.0, 64.875], [1.0, 0.0], [99.5, 64.875]);
    check_step([97.0, 33.25], [1.0, 0.0], [102.0, 33.25]);
    check_step([110.0, 49.0], [1.0, 0.0], [115.0, 49.0]);
}

#[test]
fn leaving_the_door_inside_of_the_wall_puts_the_agent_on_its_side() {
    check_step([111.0, 62.0], [0.0, 1.0], [99.5, 67.0]);
    check_step([112.0, 62.0], [0.0, 1.0], [124.5, 67.0]);
}

#[test]
fn only_the_end_of_a_step_meets_the_wall() {
    // From beside the door the middle of this step is in the wall, its end in the door: it passes, as published.
    check_step([99.5, 69.0], [1.0, -1.0], [104.5, 64.0]);
    // The middle is in the door, the end is not: it does not pass.
    check_step([96.0, 63.0], [1.0, 1.0], [99.5, 68.0]);
}

#[test]
fn horizontal_wall_is_the_transposed_vertical_one() {
    let turned =
        Geometry::new(&TwoRoomConfig { wall_axis: WallAxis::Horizontal, ..TwoRoomConfig::default() });
    for i in 0..500_u32 {
        let from = [21.0 + (i * 37 % 1820) as f32 / 10.0, 21.0 + (i * 91 % 1820) as f32 / 10.0];
        let action = [(i as f32).sin(), (i as f32 * 1.7).cos()];
        let [x, y] = geometry().next_position(from, action);
        assert_eq!(turned.next_position([from[1], from[0]], [action[1], action[0]]), [y, x]);
    }
}

fn room() -> TwoRoom {
    TwoRoom::new(TwoRoomConfig::default()).unwrap()
}

#[test]
fn unusable_inputs_change_nothing() {
    let mut room = room();
    room.reset(3);
    let before = room.state();
    let not_finite = |what, index| move |e: EnvironmentError| matches!(e, EnvironmentError::NotFinite { what: w, index: i, .. } if w == what && i == index);
    assert!(room.step(&[0.0, f32::NAN]).is_err_and(not_finite("action", 1)));
    assert_eq!(room.step(&[0.0]), Err(EnvironmentError::Width { what: "action", expected: 2, got: 1 }));
    let state = |system: &[f64], goal: &[f64]| State { system: system.to_vec(), goal: goal.to_vec() };
    assert!(
        room.set_state(&state(&[f64::INFINITY, 0.0], &[0.0, 0.0])).is_err_and(not_finite("system state", 0))
    );
    assert!(room.set_state(&state(&[1.0, 0.0], &[1e300, 0.0])).is_err_and(not_finite("goal", 0)));
    let too_wide = room.set_state(&state(&[1.0, 2.0, 3.0], &[1.0, 1.0]));
    assert_eq!(too_wide, Err(EnvironmentError::Width { what: "system state", expected: 2, got: 3 }));
    assert_eq!(room.state(), before);
}

#[test]
fn configurations_out_of_range_are_refused() {
    let check = |change: fn(&mut TwoRoomConfig), expected: &str| {
        let mut config = TwoRoomConfig::default();
        change(&mut config);
        let error = TwoRoom::new(config).unwrap_err().to_string();
        assert!(error.contains(expected), "{error}");
    };
    check(|c| c.wall_thickness_px = 42, "wall_thickness_px is out of range: expected 7 to 41, got 42");
    check(|c| c.speed_px = f32::NAN, "speed_px is out of range");
    check(|c| c.agent_radius_px = 6.9, "agent_radius_px");
    check(|c| c.doors.clear(), "number of doors");
    check(
        |c| c.doors[0].half_extent_px = 7,
        "no door fits the agent: expected a half extent of at least 7.7",
    );
}

#[test]
fn frames_show_only_the_state() {
    let mut room = room();
    let (mut first, mut second) = (Frame::default(), Frame { width: 1, height: 1, rgb: vec![9; 3] });
    room.reset(5);
    room.render(&mut first);
    room.step(&[1.0, 1.0]).unwrap();
    let moved = room.state();
    room.reset(5);
    room.render(&mut second);
    assert_eq!(first, second);
    room.set_state(&moved).unwrap();
    room.render(&mut second);
    assert_ne!(first, second);
    // Far outside, where no step leads, only the rooms are left.
    room.set_state(&State { system: vec![-1e6, 3e30], goal: vec![0.0, 0.0] }).unwrap();
    room.render(&mut second);
    assert!(second.rgb.chunks_exact(3).all(|pixel| pixel == [0; 3] || pixel == [255; 3]));
}

/// Follows `act` until success or `n_steps`; returns the number of steps, or `None`.
fn solve(room: &mut TwoRoom, n_steps: usize, act: impl Fn(&TwoRoom) -> [f32; 2]) -> Option<usize> {
    for step in 0..n_steps {
        if room.success() {
            return Some(step);
        }
        let action = act(room);
        room.advance(action);
    }
    room.success().then_some(n_steps)
}

fn random_config() -> impl Strategy<Value = TwoRoomConfig> {
    let doors = proptest::collection::vec((21_u16..203, 1_u16..=21), 0..=2);
    (any::<bool>(), 7_u16..=41, 7.0_f32..14.0, 1.75_f32..10.5, 40_u16..184, doors).prop_map(
        |(horizontal, wall_thickness_px, agent_radius_px, speed_px, first, others)| TwoRoomConfig {
            wall_axis: if horizontal { WallAxis::Horizontal } else { WallAxis::Vertical },
            wall_thickness_px,
            agent_radius_px,
            speed_px,
            doors: std::iter::once((first, 21))
                .chain(others)
                .map(|(center_px, half_extent_px)| Door { center_px, half_extent_px })
                .collect(),
            ..TwoRoomConfig::default()
        },
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, rng_seed: RngSeed::Fixed(3), failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn steps_obey_the_formulas(
        config in random_config(),
        from in [21.0_f32..203.0, 21.0_f32..203.0],
        action in [-2.0_f32..2.0, -2.0_f32..2.0],
    ) {
        let g = Geometry::new(&config);
        let to = g.next_position(from, action);
        let (across, along) = (g.axis.across(), g.axis.along());
        prop_assert!(to.iter().all(|c| (g.room_low_px..=g.room_high_px).contains(c)));
        let in_wall = f64::from(to[across]) > g.wall_low_px && f64::from(to[across]) < g.wall_high_px;
        prop_assert!(!in_wall || g.in_passage(to[along]), "in the wall beside a door: {to:?}");
        let crossed = (from[across] < 112.0) != (to[across] < 112.0);
        prop_assert!(!crossed || g.in_passage(to[along]), "through the wall: {from:?} to {to:?}");
        let free = g.next_position_without_wall(from, action);
        prop_assert_eq!(to[along], free[along]);
        prop_assert!((free[along] - from[along]).abs() <= g.speed_px * 1.0001 + (g.room_low_px - from[along]).max(from[along] - g.room_high_px).max(0.0));
    }

    #[test]
    fn oracle_solves_every_problem(config in random_config(), seed in any::<u64>()) {
        let mut room = TwoRoom::new(config.clone()).unwrap();
        room.reset(seed);
        // The longest way round is under 600 px.
        let n_steps = (600.0 / config.speed_px) as usize + 20;
        let problem = room.state();
        let steps = solve(&mut room, n_steps, |room| oracle_action(room.geometry(), room.agent(), room.target()));
        // A target deep in a thick wall is out of reach; the oracle then stops at the nearest place, a pushback away.
        let (g, target) = (room.geometry(), room.target());
        let depth = f64::from(target[g.axis.across()]);
        let depth = (depth - g.wall_low_px).min(g.wall_high_px - depth);
        if depth > 15.0 && !g.in_passage(target[g.axis.along()]) {
            let past_border = f64::from(config.agent_radius_px);
            prop_assert!(f64::from(distance_px(room.agent(), target)) < depth + past_border + 1.5);
        } else {
            prop_assert!(steps.is_some(), "{problem:?} in {config:?} ended at {:?}", room.agent());
        }
    }

    #[test]
    fn same_calls_same_states(seed in any::<u64>(), actions in proptest::collection::vec([-1.5_f32..1.5, -1.5_f32..1.5], 1..40)) {
        let (mut a, mut b) = (room(), room());
        b.reset(seed ^ 1);
        b.step(&[1.0, 0.5]).unwrap();
        a.reset(seed);
        b.reset(seed);
        for action in &actions {
            prop_assert_eq!(a.step(action), b.step(action));
        }
        // A state that was read can be put back and goes on alike.
        let state = a.state();
        b.reset(seed.wrapping_add(9));
        b.set_state(&state).unwrap();
        for action in &actions {
            prop_assert_eq!(a.step(action), b.step(action));
            prop_assert_eq!(a.state(), b.state());
        }
    }
}

#[test]
fn resets_cover_both_rooms_and_leave_the_wall_free() {
    let mut room = room();
    let (mut left, mut targets_in_wall) = (0, 0);
    for seed in 0..2000 {
        room.reset(seed);
        let (agent, target) = (room.agent(), room.target());
        assert!(agent.iter().chain(&target).all(|c| (14.0..209.0).contains(c)));
        assert!(!(100.0..=124.0).contains(&agent[0]), "agent in the wall: {agent:?}");
        left += u32::from(agent[0] < 112.0);
        targets_in_wall += u32::from((100.0..=124.0).contains(&target[0]));
    }
    assert!((850..1170).contains(&left), "{left} of 2000 start left");
    assert!(
        (180..320).contains(&targets_in_wall),
        "{targets_in_wall} of 2000 targets in the wall; 246 expected"
    );
}

#[test]
fn straight_line_stops_at_the_wall_and_the_oracle_does_not() {
    let mut room = room();
    let problem = State { system: vec![60.0, 180.0], goal: vec![170.0, 180.0] };
    room.set_state(&problem).unwrap();
    assert_eq!(solve(&mut room, 200, |r| straight_line_action(r.geometry(), r.agent(), r.target())), None);
    assert_eq!(room.agent(), [99.5, 180.0]);
    room.set_state(&problem).unwrap();
    let steps = solve(&mut room, 200, |r| oracle_action(r.geometry(), r.agent(), r.target())).unwrap();
    // Round the door's near corner, 64.25 along the wall: 122.6 + 25 + 124.8 px less the 16 of success, at 5 px a step.
    assert!((51..=54).contains(&steps), "{steps} steps");
}

#[test]
fn oracle_is_no_longer_than_the_straight_way() {
    let mut room = room();
    for seed in 0..300 {
        room.reset(seed);
        let problem = room.state();
        let straight_px = distance_px(room.agent(), room.target());
        let straight = solve(&mut room, 300, |r| straight_line_action(r.geometry(), r.agent(), r.target()));
        room.set_state(&problem).unwrap();
        let oracle = solve(&mut room, 300, |r| oracle_action(r.geometry(), r.agent(), r.target()));
        let oracle = oracle.unwrap_or_else(|| panic!("seed {seed} unsolved"));
        assert!(
            oracle as f32 >= ((straight_px - 16.0) / 5.0).floor(),
            "seed {seed}: {oracle} steps over {straight_px} px"
        );
        if let Some(straight) = straight {
            // A straight line that slides along the wall into the door may gain a few steps by cutting its corner.
            assert!(oracle <= straight + 3, "seed {seed}: oracle {oracle}, straight line {straight}");
        }
    }
}

#[test]
fn expert_is_seeded_and_its_options_do_not_share_draws() {
    let config = TwoRoomConfig::default();
    let run = |expert: ExpertConfig, seed| {
        let mut expert = TwoRoomExpert::new(expert, seed);
        (0..400).map(|_| expert.act(&config, [50.0, 50.0], [150.0, 150.0])).collect::<Vec<_>>()
    };
    let default = run(ExpertConfig::default(), 1);
    assert_eq!(default, run(ExpertConfig::default(), 1));
    assert_ne!(default, run(ExpertConfig::default(), 2));
    assert!(default.iter().flatten().all(|a| (-1.0..=1.0).contains(a)));
    let never = run(ExpertConfig { action_repeat: 0.0, ..ExpertConfig::default() }, 1);
    let repeated = default.iter().zip(&never).filter(|(a, b)| a != b).count();
    assert!((5..=40).contains(&repeated), "{repeated} of 400 actions repeat; 20 expected");
    let always = run(ExpertConfig { action_repeat: 1.0, ..ExpertConfig::default() }, 1);
    assert!(always.iter().all(|a| *a == always[0]));
}
