//! TwoRoom against what the published environment did (`fixtures/tworoom`, made by its `make.py`).
#![expect(clippy::unwrap_used, reason = "a failure here is a failed test")]

use std::path::Path;

use gawm_sim::two_room::{Colors, Door, WallAxis, distance_px, expert_direction};
use gawm_sim::{Environment, Frame, State, TwoRoom, TwoRoomConfig};
use serde::Deserialize;
use serde::de::DeserializeOwned;

#[derive(Deserialize)]
struct PublishedConfig {
    axis: u8,
    thickness: u16,
    radius: f32,
    speed: f32,
    doors: Vec<(u16, u16)>,
    target_radius: f32,
    render_target: bool,
    colors: Colors,
}

fn room(config: Option<&PublishedConfig>) -> TwoRoom {
    let config = config.map_or_else(TwoRoomConfig::default, |c| TwoRoomConfig {
        wall_axis: if c.axis == 1 { WallAxis::Vertical } else { WallAxis::Horizontal },
        wall_thickness_px: c.thickness,
        doors: c
            .doors
            .iter()
            .map(|&(center_px, half_extent_px)| Door { center_px, half_extent_px })
            .collect(),
        agent_radius_px: c.radius,
        speed_px: c.speed,
        render_target: c.render_target,
        target_radius_px: c.target_radius,
        colors: c.colors,
    });
    TwoRoom::new(config).unwrap()
}

fn fixture<T: DeserializeOwned>(name: &str) -> Vec<T> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../fixtures/tworoom").join(name);
    serde_json::from_str(&std::fs::read_to_string(path).unwrap()).unwrap()
}

fn state(agent: [f32; 2], target: [f32; 2]) -> State {
    State { system: agent.map(f64::from).to_vec(), goal: target.map(f64::from).to_vec() }
}

/// CRC-32 of the frame's pixels, as Python's zlib computes it.
fn frame_crc32(room: &TwoRoom) -> u32 {
    let mut frame = Frame::default();
    room.render(&mut frame);
    crc32fast::hash(&frame.rgb)
}

#[derive(Deserialize)]
struct Trace {
    config: Option<PublishedConfig>,
    start: [f32; 2],
    target: [f32; 2],
    /// `None` where the agent was put to the position instead.
    actions: Vec<Option<[f32; 2]>>,
    positions: Vec<[f32; 2]>,
    distances: Vec<Option<f64>>,
    frame_crc32: Vec<(usize, u32)>,
}

#[test]
fn every_step_of_the_traces_is_equal() {
    let mut n_steps = 0;
    for (number, trace) in fixture::<Trace>("traces.json").iter().enumerate() {
        let mut room = room(trace.config.as_ref());
        room.set_state(&state(trace.start, trace.target)).unwrap();
        for (i, action) in trace.actions.iter().enumerate() {
            match action {
                None => room.set_state(&state(trace.positions[i], trace.target)).unwrap(),
                Some(action) => {
                    let step = room.step(action).unwrap();
                    assert_eq!(Some(step.distance), trace.distances[i], "trace {number}, step {i}");
                    assert_eq!(step.terminated, step.distance < 16.0, "trace {number}, step {i}");
                    n_steps += 1;
                }
            }
            assert_eq!(room.agent(), trace.positions[i], "trace {number}, step {i}");
            if let Some((_, expected)) = trace.frame_crc32.iter().find(|(at, _)| *at == i) {
                assert_eq!(frame_crc32(&room), *expected, "trace {number}, frame of step {i}");
            }
        }
    }
    assert!(n_steps > 1000, "{n_steps} steps compared");
}

#[derive(Deserialize)]
struct Renders {
    config: Option<PublishedConfig>,
    target: [f32; 2],
    positions: Vec<[f32; 2]>,
    crc32: Vec<u32>,
}

#[test]
fn every_pixel_of_the_renders_is_equal() {
    for (number, renders) in fixture::<Renders>("renders.json").iter().enumerate() {
        let mut room = room(renders.config.as_ref());
        for (position, expected) in renders.positions.iter().zip(&renders.crc32) {
            room.set_state(&state(*position, renders.target)).unwrap();
            assert_eq!(frame_crc32(&room), *expected, "configuration {number}, agent at {position:?}");
        }
    }
}

#[derive(Deserialize)]
struct ExpertCases {
    config: Option<PublishedConfig>,
    /// Agent, target, action without noise.
    cases: Vec<[[f32; 2]; 3]>,
}

#[test]
fn expert_without_noise_is_equal() {
    for (number, set) in fixture::<ExpertCases>("expert.json").iter().enumerate() {
        let room = room(set.config.as_ref());
        for &[agent, target, expected] in &set.cases {
            let got = expert_direction(room.config(), 10.5, agent, target);
            assert_eq!(got, expected, "configuration {number}, agent at {agent:?}, target at {target:?}");
        }
    }
}

#[derive(Deserialize)]
struct Row {
    step: usize,
    state: [f32; 2],
    goal: [f32; 2],
    /// `None` in the last row of an episode.
    action: Option<[f32; 2]>,
    distance: f64,
    terminated: bool,
    crc32: u32,
}

#[test]
fn recorded_episodes_replay() {
    let rows = fixture::<Row>("recording.json");
    assert_eq!(rows.len(), 155);
    let mut room = TwoRoom::new(TwoRoomConfig::default()).unwrap();
    let mut action: Option<[f32; 2]> = None;
    for (i, row) in rows.iter().enumerate() {
        if row.step == 0 {
            assert_eq!(action, None, "row {i} follows an action");
            room.set_state(&state(row.state, row.goal)).unwrap();
        } else {
            let step = room.step(&action.expect("only the last row of an episode has no action")).unwrap();
            assert_eq!((step.distance, step.terminated), (row.distance, row.terminated), "row {i}");
        }
        assert_eq!(room.agent(), row.state, "row {i}");
        assert_eq!(f64::from(distance_px(room.agent(), row.goal)), row.distance, "row {i}");
        assert_eq!(frame_crc32(&room), row.crc32, "frame of row {i}");
        action = row.action;
    }
}
